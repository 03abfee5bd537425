//! When a loop ticks: on time, late, or far too late.

use haptether_netsim::EndpointClock;

/// When a tick is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct TickTime {
    /// When the run began, in ns.
    pub start_ns: u64,
    /// True time of the tick in ns, which the plant lives by.
    pub now_ns: u64,
    /// The tick's deadline in ns on the endpoint's own clock; live, both are the same.
    pub clock_ns: u64,
    /// How late the loop woke, in ns; in virtual time only where the endpoint's clock is set.
    pub overshoot_ns: u64,
    /// Ticks left out since the last one.
    pub missed: u64,
}

impl TickTime {
    /// A tick on time, on a clock that is right.
    pub fn at(now_ns: u64) -> Self {
        Self { now_ns, clock_ns: now_ns, ..Self::default() }
    }
}

/// A loop that wakes later than this discards the backlog and holds: what it knows is old.
const MAX_LATE_NS: u64 = 20_000_000;

/// What a loop does that waited for a deadline and woke.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Wake {
    /// The tick's own time: its deadline, later by the ticks that are left out.
    pub(crate) deadline_ns: u64,
    /// How late the loop woke.
    pub(crate) overshoot_ns: u64,
    /// Ticks left out: one wake-up is one tick, for a backlog worked off at once would let the force grow faster
    /// than its limit.
    pub(crate) missed: u64,
}

impl Wake {
    pub(crate) fn new(deadline_ns: u64, woken_ns: u64, period_ns: u64) -> Self {
        let overshoot_ns = woken_ns.saturating_sub(deadline_ns);
        let missed = overshoot_ns / period_ns;
        Self { deadline_ns: deadline_ns + missed * period_ns, overshoot_ns, missed }
    }

    /// Whether what has arrived meanwhile is too old to act on.
    pub(crate) fn is_stalled(&self) -> bool {
        self.overshoot_ns > MAX_LATE_NS
    }
}

/// What a clock shows whose reading is 0: no reading lies below 0, as far back as an offset goes.
const ORIGIN_NS: u64 = 1 << 62;

/// A loop in virtual time: it waits on the endpoint's own clock, but happens in true time.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Pace {
    /// Without one the endpoint's clock is true time.
    clock: Option<EndpointClock>,
    period_ns: u64,
    /// True time of the next tick.
    pub(crate) true_ns: u64,
    /// The same tick on the endpoint's clock.
    deadline_ns: u64,
}

impl Pace {
    /// A loop whose first tick is at true time 0.
    pub(crate) fn new(clock: Option<EndpointClock>, period_ns: u64) -> Self {
        let deadline_ns = clock.map_or(0, |clock| shown_ns(&clock, 0));
        Self { clock, period_ns, true_ns: 0, deadline_ns }
    }

    /// The tick that is due.
    pub(crate) fn wake(&self) -> Wake {
        match &self.clock {
            None => Wake { deadline_ns: self.deadline_ns, overshoot_ns: 0, missed: 0 },
            Some(clock) => Wake::new(self.deadline_ns, shown_ns(clock, self.true_ns), self.period_ns),
        }
    }

    /// How far beyond the tick's time the loop woke.
    pub(crate) fn late_ns(&self, wake: &Wake) -> u64 {
        wake.overshoot_ns - wake.missed * self.period_ns
    }

    /// Waits for the next tick after one.
    pub(crate) fn wait_after(&mut self, wake: &Wake) {
        self.deadline_ns = wake.deadline_ns + self.period_ns;
        self.true_ns = match &self.clock {
            None => self.deadline_ns,
            // A reading that a step skips is reached at the step.
            Some(clock) => clock.true_ns(self.deadline_ns.wrapping_sub(ORIGIN_NS).cast_signed()),
        };
    }
}

fn shown_ns(clock: &EndpointClock, true_ns: u64) -> u64 {
    ORIGIN_NS.wrapping_add_signed(clock.reading_ns(true_ns))
}

/// Share of a device's lateness that is taken for its pace, each tick: a device whose clock is slow by 100 ppm is met
/// 0.1 periods late instead of ever later.
const PACE_SHARE: u64 = 1024;

/// Shortest time between two ticks at a device's samples, in eighths of the period: force grows by so much a tick, so a
/// device that sends its samples in a burst, or at twice the rate, must not make it grow faster.
const MIN_EIGHTHS: u64 = 7;

/// When a loop ticks that a device paces: at its samples, each of which may be late, but none before its time.
#[derive(Clone, Copy, Debug)]
#[allow(clippy::struct_field_names)] // times carry their unit
pub(crate) struct DevicePace {
    period_ns: u64,
    /// When the next sample is due.
    next_ns: u64,
    /// Before which no sample is taken.
    earliest_ns: u64,
}

impl DevicePace {
    pub(crate) fn new(period_ns: u64) -> Self {
        Self { period_ns, next_ns: 0, earliest_ns: 0 }
    }

    /// The first sample is due.
    pub(crate) fn begin(&mut self, now_ns: u64) {
        self.next_ns = now_ns;
    }

    /// When the next tick is due.
    pub(crate) fn next_ns(&self) -> u64 {
        self.next_ns
    }

    /// Before which there is no tick: a sample that is earlier is kept until then.
    pub(crate) fn earliest_ns(&self) -> u64 {
        self.earliest_ns
    }

    /// A tick that this side's clock was waited for.
    pub(crate) fn waited(&mut self, now_ns: u64) -> Wake {
        let wake = Wake::new(self.next_ns, now_ns, self.period_ns);
        self.next_ns = wake.deadline_ns + self.period_ns;
        self.earliest_ns = 0;
        wake
    }

    /// A tick whose sample the device has given now: due then where it is early, for it sets the pace.
    ///
    /// The tick's time is that of the sample, and not when it was due: what has arrived by then was sent before.
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
