//! What one end knows of the path to its peer, from the frames alone: age, loss and order of the frames, the peer's
//! clock.
//!
//! Two sides have two monotonic clocks with different beginnings and rates. [`PacketAge`] needs none but ours, so the
//! ladder holds by it. [`PeerClock`] bounds how they differ, for logs. No function here takes a wall time, therefore a
//! step of the wall clock changes nothing.

mod age;
mod meter;
mod peer_clock;
#[cfg(test)]
mod tests;

use crate::wire::Echo;

pub use age::{AgeBaseline, PacketAge};
pub use meter::{Bursts, Jitter, PathMeter, PathStatistics, Reordering};
pub use peer_clock::{ClockFault, MAX_DRIFT_PPB, PeerClock, PeerOffset, TimestampExchange};

/// Parts per billion in one.
pub(crate) const BILLION: u64 = 1_000_000_000;

/// Age and counts of the peer's frames and its clock, of the run of the peer that lives.
///
/// [`Self::sent`] with each frame sent, [`Self::arrived`] with each authentic frame of the peer in the order of arrival,
/// [`Self::newest`] with each of them that is newer than all before. Times are those of one monotonic clock.
#[derive(Clone, Debug)]
pub struct PeerPath {
    age: PacketAge,
    baseline: AgeBaseline,
    /// What decides nothing; none where nobody reads it.
    reported: Option<Box<Reported>>,
}

/// What of the path is followed for reports alone.
#[derive(Clone, Debug)]
struct Reported {
    clock: PeerClock,
    meter: PathMeter,
    clock_faults: u64,
    last_fault: Option<ClockFault>,
}

/// The path to the peer, for records and the summary of a run.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[non_exhaustive]
pub struct PathReport {
    /// Loss, bursts, order, jitter, rate and gaps of the peer's frames.
    pub statistics: PathStatistics,
    /// The peer's clock less ours.
    pub offset: Option<PeerOffset>,
    /// How often a clock was proven to step.
    pub steps: u64,
    /// Exchanges that no healthy clocks make, steps included.
    pub clock_faults: u64,
    /// The last of them.
    pub last_fault: Option<ClockFault>,
    /// Level of the ages in ns that the ladder measures against.
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
    /// Notes that the frame `sequence` left at `now_ns`.
    pub fn sent(&mut self, sequence: u64, now_ns: u64) {
        self.age.sent(sequence, now_ns);
    }

    /// Follows the age of frames alone, by which the ladder holds.
    pub(crate) fn leave_out_reports(&mut self) {
        self.reported = None;
    }

    /// Counts a frame that arrived by `now_ns`, be it late or there before.
    pub fn arrived(&mut self, sequence: u64, sent_ns: u64, now_ns: u64) {
        if let Some(reported) = &mut self.reported {
            reported.meter.arrived(sequence, sent_ns, now_ns);
        }
    }

    /// Takes a frame newer than all before that the peer sent at `sent_ns` on its clock; `echo` is of our run.
    ///
    /// It is taken at `now_ns` and had arrived by `by_ns`, which is later where the loop woke late. When ours left we
    /// know ourselves; of the echo only the counter and the time held are used.
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

    /// The peer began a new run: its clock, its sequences and the age of its frames begin anew.
    pub fn begin(&mut self) {
        self.age.restart();
        self.baseline.restart();
        if let Some(reported) = &mut self.reported {
            reported.clock.restart();
            reported.meter.restart();
        }
    }

    /// The two sides engage: ages are measured against what they are now.
    pub fn anchor(&mut self) {
        self.baseline.anchor();
    }

    /// Largest age in ns that the newest frame of the peer can have at `now_ns`; none until the peer has echoed
    /// anything.
    pub fn max_age_ns(&self, now_ns: u64) -> Option<u64> {
        self.age.max_ns(now_ns)
    }

    /// By how much the newest of the peer may be older at `now_ns` than the level of this link, in ns; none until the
    /// peer has echoed anything.
    pub fn over_baseline_ns(&self, now_ns: u64) -> Option<u64> {
        Some(self.max_age_ns(now_ns)?.saturating_sub(self.baseline.level_ns()?))
    }

    /// What is known at `now_ns`.
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

/// What a rate of `ppb` makes of a duration, rounded up: for bounds.
pub(crate) fn share_up(duration_ns: u64, ppb: u64) -> u64 {
    if let Some(product) = duration_ns.checked_mul(ppb) {
        // Of less than a day at any drift of a clock: no division of 128 bits.
        return product.div_ceil(BILLION);
    }
    let product = u128::from(duration_ns) * u128::from(ppb);
    u64::try_from(product.div_ceil(u128::from(BILLION))).unwrap_or(u64::MAX)
}

/// `later - earlier` in ns. Both are below 2^63, which is checked where they enter, so that the difference always fits.
pub(crate) fn difference(later: u64, earlier: u64) -> i64 {
    later.cast_signed().wrapping_sub(earlier.cast_signed())
}
