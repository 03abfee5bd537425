//! Path to the peer, from frames only: their age, loss and order, and the peer's clock.
//!
//! The sides' monotonic clocks differ in origin and rate. [`PacketAge`] needs only ours, so the ladder holds by it.
//! [`PeerClock`] bounds their difference, for logs. No function takes a wall time, so its steps have no effect.

mod age;
mod meter;
mod peer_clock;
#[cfg(test)]
mod tests;

use crate::wire::Echo;

pub use age::{AgeBaseline, PacketAge};
pub use meter::{Bursts, Jitter, PathMeter, PathStatistics, Reordering};
pub use peer_clock::{ClockFault, MAX_DRIFT_PPB, PeerClock, PeerOffset, TimestampExchange};

pub(crate) const BILLION: u64 = 1_000_000_000;

/// Age and counts of the peer's frames, and its clock, for its living run.
///
/// Call [`Self::sent`] per frame sent, [`Self::arrived`] per authentic frame in order of arrival, and
/// [`Self::newest`] per frame newer than all before. All times are on one monotonic clock.
#[derive(Clone, Debug)]
pub struct PeerPath {
    age: PacketAge,
    baseline: AgeBaseline,
    /// Not used for decisions; `None` if nobody reads it.
    reported: Option<Box<Reported>>,
}

/// Estimates for reports only.
#[derive(Clone, Debug)]
struct Reported {
    clock: PeerClock,
    meter: PathMeter,
    clock_faults: u64,
    last_fault: Option<ClockFault>,
}

/// Path from the peer, for records and the summary of a run.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[non_exhaustive]
pub struct PathReport {
    /// Loss, bursts, order, jitter, rate and gaps of the peer's frames.
    pub statistics: PathStatistics,
    /// Peer's clock minus ours.
    pub offset: Option<PeerOffset>,
    /// Number of proven clock steps.
    pub steps: u64,
    /// Number of exchanges that contradict healthy clocks, including steps.
    pub clock_faults: u64,
    /// Last of these faults.
    pub last_fault: Option<ClockFault>,
    /// Level of the ages in ns that the ladder compares with.
    pub baseline_age_ns: Option<u64>,
}

impl Default for PeerPath {
    fn default() -> Self {
        Self {
            age: PacketAge::new(MAX_DRIFT_PPB),
            baseline: AgeBaseline::new(),
            reported: Some(Box::new(Reported {
                clock: PeerClock::new(MAX_DRIFT_PPB),
                meter: PathMeter::new(),
                clock_faults: 0,
                last_fault: None,
            })),
        }
    }
}

impl PeerPath {
    /// Records that frame `sequence` was sent at `now_ns`.
    pub fn sent(&mut self, sequence: u64, now_ns: u64) {
        self.age.sent(sequence, now_ns);
    }

    /// Disables reports and keeps only the age of frames, by which the ladder holds.
    pub(crate) fn leave_out_reports(&mut self) {
        self.reported = None;
    }

    /// Count a frame that arrived by `now_ns`, including late and repeated ones.
    pub fn arrived(&mut self, sequence: u64, sent_ns: u64, now_ns: u64) {
        if let Some(reported) = &mut self.reported {
            reported.meter.arrived(sequence, sent_ns, now_ns);
        }
    }

    /// Take a frame newer than all before, sent at `sent_ns` on the peer's clock; `echo` is of our run.
    ///
    /// It is taken at `now_ns` and arrived by `by_ns`, later in a late loop. Only counter and hold time of the echo
    /// are used: our send times are known here.
    #[inline(always)] // takes a frame: docs/decisions/060-ticks-in-a-row.md
    pub fn newest(&mut self, sent_ns: u64, echo: Option<&Echo>, now_ns: u64, by_ns: u64) {
        let exchanged = echo.and_then(|echo| Some((self.age.sent_at(echo.sequence)?, echo.held_ns)));
        let aged =
            exchanged.map_or(Ok(()), |(own_sent_ns, held_ns)| self.age.echoed(by_ns, own_sent_ns, held_ns));
        if let Some(age_ns) = self.age.max_ns(now_ns) {
            self.baseline.take(now_ns, age_ns);
        }
        let Some(reported) = &mut self.reported else { return };
        let clocked = match exchanged {
            Some((own_sent_ns, held_ns)) => reported
                .clock
                .take(&TimestampExchange {
                    sent_ns: own_sent_ns,
                    peer_received_ns: sent_ns.saturating_sub(held_ns),
                    peer_sent_ns: sent_ns,
                    received_ns: by_ns,
                })
                .map(|_| ()),
            None => reported.clock.check_arrival(sent_ns, by_ns),
        };
        if let Err(fault) = clocked.and(aged) {
            reported.clock_faults += 1;
            reported.last_fault = Some(fault);
        }
    }

    /// Restarts clock, sequences and age for a new run of the peer.
    pub fn begin(&mut self) {
        self.age.restart();
        self.baseline.restart();
        if let Some(reported) = &mut self.reported {
            reported.clock.restart();
            reported.meter.restart();
        }
    }

    /// Anchors the baseline at the present ages, when the sides engage.
    pub fn anchor(&mut self) {
        self.baseline.anchor();
    }

    /// Maximum age in ns of the newest frame at `now_ns`; `None` before the peer's first echo.
    pub fn max_age_ns(&self, now_ns: u64) -> Option<u64> {
        self.age.max_ns(now_ns)
    }

    /// Excess in ns of that age over the level of this link; `None` before the peer's first echo.
    pub fn over_baseline_ns(&self, now_ns: u64) -> Option<u64> {
        Some(self.max_age_ns(now_ns)?.saturating_sub(self.baseline.level_ns()?))
    }

    /// Report as of `now_ns`.
    pub fn report(&self, now_ns: u64) -> PathReport {
        let baseline_age_ns = self.baseline.level_ns();
        let Some(reported) = &self.reported else {
            return PathReport { baseline_age_ns, ..PathReport::default() };
        };
        PathReport {
            statistics: reported.meter.statistics(now_ns),
            offset: reported.clock.offset(now_ns),
            steps: reported.clock.steps(),
            clock_faults: reported.clock_faults,
            last_fault: reported.last_fault,
            baseline_age_ns,
        }
    }
}

/// Product of a duration and a rate in parts per billion, rounded up, for bounds.
pub(crate) fn share_up(duration_ns: u64, ppb: u64) -> u64 {
    if let Some(product) = duration_ns.checked_mul(ppb) {
        // Less than a day at any drift of a clock: avoids a division of 128 bits.
        return product.div_ceil(BILLION);
    }
    let product = u128::from(duration_ns) * u128::from(ppb);
    u64::try_from(product.div_ceil(u128::from(BILLION))).unwrap_or(u64::MAX)
}

/// `later - earlier` in ns. Both are checked on input to be below 2^63, so the difference fits.
pub(crate) fn difference(later: u64, earlier: u64) -> i64 {
    later.cast_signed().wrapping_sub(earlier.cast_signed())
}
