//! The peer's clock as seen from ours.

use super::causal::{CausalBounds, Contradiction};
use super::drift::{DriftFit, Point};
use super::window::WindowMinimum;
use super::{BILLION, ClockFault, FourTimes, difference};

/// What is believed of clocks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ClockSettings {
    /// Length in ns of the window whose least round trip gives the offset.
    pub window_ns: u64,
    /// Greatest drift in parts per billion between two healthy clocks.
    pub max_drift_ppb: u64,
}

impl Default for ClockSettings {
    /// 8 s; 200 ppm are two oscillators at the 100 ppm of the cheapest.
    fn default() -> Self {
        Self { window_ns: 8_000_000_000, max_drift_ppb: 200_000 }
    }
}

/// The peer's clock less ours.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PeerOffset {
    /// The offset in ns.
    pub offset_ns: i64,
    /// How wrong it may be in ns, whatever the ways took: about half the least round trip, and what drift adds since.
    pub bound_ns: u64,
}

/// A delay of one way on the peer's clock, which is only as good as the offset: for diagnosis.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct OneWay {
    /// The delay in ns; negative within the bound says nothing.
    pub delay_ns: i64,
    /// How wrong it may be in ns.
    pub bound_ns: u64,
}

/// What one exchange says.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Reading {
    /// Its time on the way in ns.
    pub round_trip_ns: u64,
    /// The way there.
    pub forward: OneWay,
    /// The way back.
    pub backward: OneWay,
}

/// The exchange of least round trip, as far as the offset needs it.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Reference {
    middle_ns: u64,
    offset_ns: i64,
}

/// Estimates offset and drift of the peer's clock from exchanges.
///
/// Certain is a range: no packet arrives before it was sent, so each exchange bounds the offset, and what was bounded
/// once gives way no faster than the clocks part. The estimate is that of the exchange of least round trip in a window,
/// since queues only ever add to it, carried on to now by the drift and moved into that range. So it is within its bound
/// whatever the ways take and however that changes, as long as the clocks part by at most `max_drift_ppb`.
///
/// An exchange that leaves nothing of the range proves that a clock stepped, because its machine was suspended or it is
/// broken. Then the estimate begins anew, with exchanges that were sent after the proof arrived: all of their four
/// times are of after the step. A step of less than the width of the range, so of no more than a round trip, looks like
/// a path that changed; it may leave the offset outside its bound by no more than the step, until the range has widened.
///
/// Source: RFC 5905, section 8 (offset, round trip), section 10 (clock filter: least delay in a window); the range as in
/// K. Marzullo, S. Owicki (1983), Maintaining the time in a distributed system.
#[derive(Clone, Debug, PartialEq)]
pub struct PeerClock {
    settings: ClockSettings,
    bounds: CausalBounds,
    window: WindowMinimum<Reference>,
    fit: DriftFit,
    newest_ns: u64,
    /// Exchanges sent before this are of a time before the last step.
    anew_from_ns: u64,
    steps: u64,
}

impl PeerClock {
    /// Knows nothing yet.
    pub fn new(settings: ClockSettings) -> Self {
        Self {
            settings,
            bounds: CausalBounds::new(settings.max_drift_ppb),
            window: WindowMinimum::new(settings.window_ns),
            fit: DriftFit::new(settings.max_drift_ppb),
            newest_ns: 0,
            anew_from_ns: 0,
            steps: 0,
        }
    }

    /// Takes an exchange, in the order of `received_ns`; none if it was sent before the last step was seen.
    ///
    /// On [`ClockFault::Step`] the estimate begins anew; on any other fault the exchange is left out.
    pub fn take(&mut self, times: &FourTimes) -> Result<Option<Reading>, ClockFault> {
        Ok(if self.learn(times)? { self.reading(times) } else { None })
    }

    /// The same without what the exchange says, which costs as much again; whether it was taken.
    pub fn learn(&mut self, times: &FourTimes) -> Result<bool, ClockFault> {
        times.check(self.settings.max_drift_ppb)?;
        if times.received_ns < self.newest_ns {
            return Err(ClockFault::Backwards { side: "own", by_ns: self.newest_ns - times.received_ns });
        }
        self.newest_ns = times.received_ns;
        if times.sent_ns < self.anew_from_ns {
            return Ok(false);
        }
        if let Some(contradiction) = self.bounds.contradicted(times) {
            let fault = self.step(times, contradiction);
            self.restart();
            self.anew_from_ns = times.received_ns;
            self.steps += 1;
            return Err(fault);
        }
        let (middle_ns, offset_ns) = (times.middle_ns(), times.offset_ns());
        let round_trip_ns = times.round_trip_ns();
        self.bounds.narrow(times);
        // Below 2^63 like the times it is made of.
        self.window.add(times.received_ns, round_trip_ns.cast_signed(), Reference { middle_ns, offset_ns });
        self.fit.add(Point { at_ns: middle_ns, offset_ns, round_trip_ns });
        Ok(true)
    }

    fn step(&self, times: &FourTimes, contradiction: Contradiction) -> ClockFault {
        let known_ns = self.offset(times.received_ns).map_or(0, |known| known.offset_ns);
        let about = times.offset_ns().saturating_sub(known_ns);
        let signed = |by_ns: u64| i64::try_from(by_ns).unwrap_or(i64::MAX);
        let (by_ns, at_least_ns) = match contradiction {
            Contradiction::Ahead(by_ns) => (about.max(signed(by_ns)), by_ns),
            Contradiction::Behind(by_ns) => (about.min(-signed(by_ns)), by_ns),
        };
        ClockFault::Step { by_ns, at_least_ns, allowed_ppb: self.settings.max_drift_ppb }
    }

    fn reading(&self, times: &FourTimes) -> Option<Reading> {
        let (there, back) = (self.offset(times.sent_ns)?, self.offset(times.received_ns)?);
        let forward = difference(times.peer_received_ns, times.sent_ns).saturating_sub(there.offset_ns);
        let backward = difference(times.received_ns, times.peer_sent_ns).saturating_add(back.offset_ns);
        Some(Reading {
            round_trip_ns: times.round_trip_ns(),
            forward: OneWay { delay_ns: forward, bound_ns: there.bound_ns },
            backward: OneWay { delay_ns: backward, bound_ns: back.bound_ns },
        })
    }

    /// The offset at `now_ns`; none before the first exchange, and after a step until an exchange was sent anew.
    pub fn offset(&self, now_ns: u64) -> Option<PeerOffset> {
        let (least, greatest) = self.bounds.range(now_ns)?;
        let offset_ns = self.estimate_ns(now_ns)?.clamp(least, greatest.max(least));
        let bound_ns = offset_ns.abs_diff(least).max(greatest.abs_diff(offset_ns));
        Some(PeerOffset { offset_ns, bound_ns })
    }

    fn estimate_ns(&self, at_ns: u64) -> Option<i64> {
        let reference = self.window.least()?.value;
        let since = i128::from(at_ns) - i128::from(reference.middle_ns);
        let drifted = since * i128::from(self.drift_ppb().unwrap_or(0)) / i128::from(BILLION);
        Some(reference.offset_ns.saturating_add(i64::try_from(drifted).unwrap_or(0)))
    }

    /// The delay of a packet that the peer sent at `peer_sent_ns` on its clock; none while the offset is not known.
    ///
    /// A packet that arrived before it was sent, on every clock that fits all exchanges, is a fault of a clock. It may
    /// also have been sent before the last step; the next exchange tells.
    pub fn backward_delay(&self, peer_sent_ns: u64, received_ns: u64) -> Result<Option<OneWay>, ClockFault> {
        for seen_ns in [peer_sent_ns, received_ns] {
            if seen_ns > i64::MAX.cast_unsigned() {
                return Err(ClockFault::OutOfRange { seen_ns });
            }
        }
        let now_ns = received_ns.max(self.newest_ns);
        if let Some(by_ns) = self.bounds.ahead_ns(peer_sent_ns, now_ns) {
            return Err(ClockFault::NegativeDelay { by_ns });
        }
        let delay = |PeerOffset { offset_ns, bound_ns }| OneWay {
            delay_ns: difference(received_ns, peer_sent_ns).saturating_add(offset_ns),
            bound_ns,
        };
        Ok(self.offset(received_ns).map(delay))
    }

    /// How much faster the peer's clock runs than ours, in parts per billion: an estimate; none until it is known.
    pub fn drift_ppb(&self) -> Option<i64> {
        self.fit.drift_ppb()
    }

    /// Least round trip in ns of the window.
    pub fn least_round_trip_ns(&self) -> Option<u64> {
        self.window.least().map(|least| least.key.unsigned_abs())
    }

    /// How often a clock stepped.
    pub fn steps(&self) -> u64 {
        self.steps
    }

    /// Forgets all but the count of steps: for a new session.
    pub fn restart(&mut self) {
        self.bounds = CausalBounds::new(self.settings.max_drift_ppb);
        self.window.clear();
        self.fit = DriftFit::new(self.settings.max_drift_ppb);
        self.anew_from_ns = 0;
    }
}
