//! Tick times of a loop: on time, late, or stalled.

use haptether_netsim::EndpointClock;

/// Time of a tick.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct TickTime {
    /// Start of the run in ns.
    pub start_ns: u64,
    /// True time of the tick in ns, used by the plant.
    pub now_ns: u64,
    /// Deadline in ns on the endpoint's own clock; live, the same.
    pub clock_ns: u64,
    /// Lateness in ns; in virtual time only if the endpoint's clock is set.
    pub overshoot_ns: u64,
    /// Ticks skipped since the last one.
    pub missed: u64,
}

impl TickTime {
    /// A punctual tick, on a true clock.
    pub fn at(now_ns: u64) -> Self {
        Self { now_ns, clock_ns: now_ns, ..Self::default() }
    }
}

/// A loop later than this discards the backlog and holds, since its inputs are old.
const MAX_LATE_NS: u64 = 20_000_000;

/// Wake-up of a loop from a deadline.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Wake {
    /// Time of the tick: the deadline, plus the skipped ticks.
    pub(crate) deadline_ns: u64,
    /// Lateness in ns.
    pub(crate) overshoot_ns: u64,
    /// Skipped ticks: one wake-up is one tick, since catching up would let the force exceed its rate limit.
    pub(crate) missed: u64,
}

impl Wake {
    pub(crate) fn new(deadline_ns: u64, woken_ns: u64, period_ns: u64) -> Self {
        let overshoot_ns = woken_ns.saturating_sub(deadline_ns);
        let missed = overshoot_ns / period_ns;
        Self { deadline_ns: deadline_ns + missed * period_ns, overshoot_ns, missed }
    }

    /// Return whether pending datagrams are too old to act on.
    pub(crate) fn is_stalled(&self) -> bool {
        self.overshoot_ns > MAX_LATE_NS
    }
}

/// Clock value for a reading of 0: no offset makes it negative.
const ORIGIN_NS: u64 = 1 << 62;

/// Loop in virtual time: waits on the endpoint's clock, runs in true time.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Pace {
    /// `None` for true time.
    clock: Option<EndpointClock>,
    period_ns: u64,
    /// True time of the next tick.
    pub(crate) true_ns: u64,
    /// The same tick on the endpoint's clock.
    deadline_ns: u64,
}

impl Pace {
    /// Create a loop whose first tick is at true time 0.
    pub(crate) fn new(clock: Option<EndpointClock>, period_ns: u64) -> Self {
        let deadline_ns = clock.map_or(0, |clock| shown_ns(&clock, 0));
        Self { clock, period_ns, true_ns: 0, deadline_ns }
    }

    /// Wake-up of the due tick.
    pub(crate) fn wake(&self) -> Wake {
        match &self.clock {
            None => Wake { deadline_ns: self.deadline_ns, overshoot_ns: 0, missed: 0 },
            Some(clock) => Wake::new(self.deadline_ns, shown_ns(clock, self.true_ns), self.period_ns),
        }
    }

    /// Lateness in ns after the tick's own time.
    pub(crate) fn late_ns(&self, wake: &Wake) -> u64 {
        wake.overshoot_ns - wake.missed * self.period_ns
    }

    /// Waits for the tick after `wake`.
    pub(crate) fn wait_after(&mut self, wake: &Wake) {
        self.deadline_ns = wake.deadline_ns + self.period_ns;
        self.true_ns = match &self.clock {
            None => self.deadline_ns,
            // A reading that a clock step skips is reached at the step.
            Some(clock) => clock.true_ns(self.deadline_ns.wrapping_sub(ORIGIN_NS).cast_signed()),
        };
    }
}

fn shown_ns(clock: &EndpointClock, true_ns: u64) -> u64 {
    ORIGIN_NS.wrapping_add_signed(clock.reading_ns(true_ns))
}

/// Inverse share of a device's lateness added to its pace per tick. A clock slow by 100 ppm is then met 0.1 periods
/// late, instead of ever later.
const PACE_SHARE: u64 = 1024;

/// Minimum time between ticks at a device's samples, in eighths of the period. Force grows per tick, so a burst or
/// twice the rate must not make it grow faster.
const MIN_EIGHTHS: u64 = 7;

/// Ticks of a loop paced by a device: at its samples, which may be late but not early.
#[derive(Clone, Copy, Debug)]
#[allow(clippy::struct_field_names)] // times carry their unit
pub(crate) struct DevicePace {
    period_ns: u64,
    /// Due time of the next sample.
    next_ns: u64,
    /// Earliest time of the next tick.
    earliest_ns: u64,
}

impl DevicePace {
    pub(crate) fn new(period_ns: u64) -> Self {
        Self { period_ns, next_ns: 0, earliest_ns: 0 }
    }

    pub(crate) fn begin(&mut self, now_ns: u64) {
        self.next_ns = now_ns;
    }

    pub(crate) fn next_ns(&self) -> u64 {
        self.next_ns
    }

    /// Earliest time of the next tick; an earlier sample waits until then.
    pub(crate) fn earliest_ns(&self) -> u64 {
        self.earliest_ns
    }

    /// Wake-up of a tick that waited for this side's clock.
    pub(crate) fn waited(&mut self, now_ns: u64) -> Wake {
        let wake = Wake::new(self.next_ns, now_ns, self.period_ns);
        self.next_ns = wake.deadline_ns + self.period_ns;
        self.earliest_ns = 0;
        wake
    }

    /// Tick at a sample that arrived now; an early sample is on time, since it sets the pace.
    ///
    /// The tick's time is that of the sample, not its due time: datagrams arrived by then were sent before.
    pub(crate) fn sampled(&mut self, now_ns: u64) -> Wake {
        let wake = Wake::new(self.next_ns.min(now_ns), now_ns, self.period_ns);
        let late_ns = now_ns - wake.deadline_ns;
        self.next_ns = wake.deadline_ns + late_ns / PACE_SHARE + self.period_ns;
        self.earliest_ns = now_ns + self.period_ns * MIN_EIGHTHS / 8;
        Wake { deadline_ns: now_ns, ..wake }
    }
}

#[cfg(test)]
mod tests;
