//! The peer's clock as seen from ours.

use super::drift::{Drift, DriftFit, Point};
use super::window::WindowMinimum;
use super::{BILLION, ClockFault, FourTimes, difference, share_up};

/// What is believed of clocks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ClockSettings {
    /// Length in ns of the window whose least round trip gives the offset.
    pub window_ns: u64,
    /// Greatest drift in parts per billion between two healthy clocks.
    pub max_drift_ppb: u64,
    /// How far in parts per billion the drift may be from its estimate, beside what the estimate itself leaves open.
    pub wander_ppb: u64,
}

impl Default for ClockSettings {
    /// 8 s; 200 ppm are two oscillators at the 100 ppm of the cheapest; 15 ppm is the frequency tolerance `PHI`.
    ///
    /// Source: RFC 5905, section 7.2.
    fn default() -> Self {
        Self { window_ns: 8_000_000_000, max_drift_ppb: 200_000, wander_ppb: 15_000 }
    }
}

/// The peer's clock less ours.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PeerOffset {
    /// The offset in ns.
    pub offset_ns: i64,
    /// How wrong it may be in ns: half the least round trip, and what an unknown drift adds since then.
    pub bound_ns: u64,
}

/// A delay of one way, which is only as good as the offset: for diagnosis.
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
#[expect(clippy::struct_field_names, reason = "they are of one unit")]
struct Reference {
    sent_ns: u64,
    middle_ns: u64,
    offset_ns: i64,
    round_trip_ns: u64,
}

/// Estimates offset and drift of the peer's clock from exchanges.
///
/// The offset is that of the exchange of least round trip in a window, since queues only ever add to it; it is carried
/// on to now by the drift. Two measurements whose ranges do not meet show that a clock stepped: the machine was
/// suspended. Then the estimate begins anew, and says so. A step of less than the bound cannot be told from a change
/// of the path; it works its way in when the window has passed.
///
/// Source: RFC 5905, section 8 (offset, round trip), section 10 (clock filter: least delay in a window, dispersion
/// that grows with time).
#[derive(Clone, Debug, PartialEq)]
pub struct PeerClock {
    settings: ClockSettings,
    window: WindowMinimum<Reference>,
    fit: DriftFit,
    steps: u64,
}

impl PeerClock {
    /// Knows nothing yet.
    pub fn new(settings: ClockSettings) -> Self {
        Self {
            settings,
            window: WindowMinimum::new(settings.window_ns),
            fit: DriftFit::new(settings.max_drift_ppb),
            steps: 0,
        }
    }

    /// Takes an exchange; `received_ns` of successive ones does not decrease.
    ///
    /// On [`ClockFault::Step`] the estimate has begun anew with this exchange. [`ClockFault::Drift`] only reports: the
    /// exchange counts, the drift is not used. On any other fault the exchange is left out.
    pub fn take(&mut self, times: &FourTimes) -> Result<Reading, ClockFault> {
        times.check()?;
        let stepped = self.step_ns(times);
        if stepped.is_some() {
            self.restart();
            self.steps += 1;
        }
        let reference = Reference {
            sent_ns: times.sent_ns,
            middle_ns: times.middle_ns(),
            offset_ns: times.offset_ns(),
            round_trip_ns: times.round_trip_ns(),
        };
        let Reference { middle_ns, offset_ns, round_trip_ns, .. } = reference;
        // Below 2^63 like the times it is made of.
        self.window.add(times.received_ns, round_trip_ns.cast_signed(), reference);
        let fitted = self.fit.add(Point { at_ns: middle_ns, offset_ns, round_trip_ns });
        if let Some(by_ns) = stepped {
            return Err(ClockFault::Step { by_ns });
        }
        if fitted && let Some(Drift { ppb, too_great: true, .. }) = self.fit.drift() {
            return Err(ClockFault::Drift { ppb, allowed_ppb: self.settings.max_drift_ppb });
        }
        Ok(self.reading(times))
    }

    /// How far the offset jumped, if further than the ranges of both measurements reach.
    fn step_ns(&self, times: &FourTimes) -> Option<i64> {
        let known = self.offset(times.received_ns)?;
        let by_ns = times.offset_ns().saturating_sub(self.offset_at(times.middle_ns())?);
        let own = times.round_trip_ns() / 2 + share_up(times.took_ns(), self.settings.max_drift_ppb);
        // Two offsets and two halves are rounded by at most 1 ns each.
        (by_ns.unsigned_abs() > known.bound_ns.saturating_add(own).saturating_add(4)).then_some(by_ns)
    }

    fn reading(&self, times: &FourTimes) -> Reading {
        let round_trip_ns = times.round_trip_ns();
        let known = self.offset(times.received_ns).unwrap_or(PeerOffset { offset_ns: 0, bound_ns: u64::MAX });
        let bound_ns = known.bound_ns;
        let at = |middle| self.offset_at(middle).unwrap_or(0);
        let forward = difference(times.peer_received_ns, times.sent_ns).saturating_sub(at(times.sent_ns));
        let backward = difference(times.received_ns, times.peer_sent_ns).saturating_add(known.offset_ns);
        Reading {
            round_trip_ns,
            forward: OneWay { delay_ns: forward, bound_ns },
            backward: OneWay { delay_ns: backward, bound_ns },
        }
    }

    /// The offset at `now_ns`, not before the newest exchange; none before the first.
    pub fn offset(&self, now_ns: u64) -> Option<PeerOffset> {
        let reference = self.window.least()?.value;
        let since = now_ns.saturating_sub(reference.sent_ns);
        let bound_ns =
            reference.round_trip_ns.div_ceil(2).saturating_add(share_up(since, self.unknown_ppb()));
        Some(PeerOffset { offset_ns: self.offset_at(now_ns)?, bound_ns })
    }

    fn offset_at(&self, at_ns: u64) -> Option<i64> {
        let reference = self.window.least()?.value;
        let since = i128::from(difference(at_ns, reference.middle_ns));
        let drifted = since * i128::from(self.drift_ppb().unwrap_or(0)) / i128::from(BILLION);
        Some(reference.offset_ns.saturating_add(i64::try_from(drifted).unwrap_or(0)))
    }

    /// The delay of a packet that the peer sent at `peer_sent_ns` on its clock; none before the first exchange.
    ///
    /// A packet that arrived before it was sent, by more than the bound, is a fault of a clock.
    pub fn backward_delay(&self, peer_sent_ns: u64, received_ns: u64) -> Result<Option<OneWay>, ClockFault> {
        for seen_ns in [peer_sent_ns, received_ns] {
            if seen_ns > i64::MAX.cast_unsigned() {
                return Err(ClockFault::OutOfRange { seen_ns });
            }
        }
        let Some(PeerOffset { offset_ns, bound_ns }) = self.offset(received_ns) else {
            return Ok(None);
        };
        let delay_ns = difference(received_ns, peer_sent_ns).saturating_add(offset_ns);
        if delay_ns < 0 && delay_ns.unsigned_abs() > bound_ns {
            return Err(ClockFault::NegativeDelay { by_ns: delay_ns.unsigned_abs(), bound_ns });
        }
        Ok(Some(OneWay { delay_ns, bound_ns }))
    }

    /// How much faster the peer's clock runs than ours, in parts per billion; none until it is known.
    pub fn drift_ppb(&self) -> Option<i64> {
        self.fit.drift().map(|drift| drift.ppb).filter(|&ppb| self.believes(ppb))
    }

    fn believes(&self, ppb: i64) -> bool {
        ppb.unsigned_abs() <= self.settings.max_drift_ppb
    }

    /// How fast the offset may leave its estimate.
    fn unknown_ppb(&self) -> u64 {
        let ClockSettings { max_drift_ppb, wander_ppb, .. } = self.settings;
        match self.fit.drift() {
            Some(Drift { ppb, within_ppb: Some(within), .. }) if self.believes(ppb) => {
                within.saturating_add(wander_ppb).min(max_drift_ppb)
            }
            // A drift that was used though nothing bounds it may be wrong by itself and the whole range.
            Some(Drift { ppb, .. }) if self.believes(ppb) => max_drift_ppb.saturating_add(ppb.unsigned_abs()),
            _ => max_drift_ppb,
        }
    }

    /// Least round trip in ns of the window.
    pub fn least_round_trip_ns(&self) -> Option<u64> {
        self.window.least().map(|least| least.value.round_trip_ns)
    }

    /// How often a clock stepped.
    pub fn steps(&self) -> u64 {
        self.steps
    }

    /// Forgets all but the count of steps: for a new session.
    pub fn restart(&mut self) {
        self.window.clear();
        self.fit = DriftFit::new(self.settings.max_drift_ppb);
    }
}
