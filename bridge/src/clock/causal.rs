//! What causality alone says of an offset.

use super::{BILLION, FourTimes, difference};

/// Parts of a nanosecond in which the lines are kept, so that a rate of one in a billion is a whole number.
const PARTS: i128 = BILLION as i128;
/// Readings are whole ns, rounded down: a bound of the difference of two may be off by 1 ns, the difference by another.
const READING_NS: i128 = 2;

/// The range that holds the peer's clock less ours, `theta`, because no packet arrives before it was sent.
///
/// When a packet of ours left at `t1`, the peer's clock showed at most `t2`, so that `theta(t1) <= t2 - t1`. When one of
/// the peer's arrived at `t4`, its clock showed at least `t3`, so that `theta(t4) >= t3 - t4`. Neither takes a belief in
/// how long the ways are. Healthy clocks part by at most `rho`, so each bound holds later as a line that gives
/// way with that slope. All lines of one side are parallel: the least of the upper ones and the greatest of the lower
/// ones stay so for ever, and the two of them are the intersection of all ranges ever seen.
///
/// There is a clock of drift up to `rho` that fits all bounds if and only if every upper one fits every lower one with
/// `l - u <= rho |t4 - t1|` (a function of bounded slope can be drawn through points that fit in pairs).
///
/// Source: K. Marzullo, S. Owicki (1983), Maintaining the time in a distributed system (intersection of intervals that
/// widen with the drift).
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct CausalBounds {
    max_drift_ppb: u64,
    /// Upper line at time 0, in parts.
    upper: Option<i128>,
    /// Lower line at time 0, in parts.
    lower: Option<i128>,
    /// The lines hold from here on.
    newest_ns: u64,
}

/// By how much an exchange contradicts those before it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Contradiction {
    /// The peer's clock is ahead of all that was possible.
    Ahead(u64),
    /// It is behind.
    Behind(u64),
}

impl CausalBounds {
    pub(crate) fn new(max_drift_ppb: u64) -> Self {
        // A clock that drifts by its whole rate stands still: nothing beyond that has a meaning.
        Self { max_drift_ppb: max_drift_ppb.min(BILLION), upper: None, lower: None, newest_ns: 0 }
    }

    /// Takes an exchange; `received_ns` does not decrease.
    pub(crate) fn narrow(&mut self, times: &FourTimes) {
        let upper = upper_parts(times) - self.drifted(times.sent_ns);
        let lower = lower_parts(times.peer_sent_ns, times.received_ns) + self.drifted(times.received_ns);
        self.upper = Some(self.upper.map_or(upper, |kept| kept.min(upper)));
        self.lower = Some(self.lower.map_or(lower, |kept| kept.max(lower)));
        self.newest_ns = self.newest_ns.max(times.received_ns);
    }

    /// Whether no clock of the allowed drift fits an exchange and all those taken.
    ///
    /// What is told is certain. Told late is at most `2 rho (t4 - t1)`: the upper bound, of the time `t1`, is held
    /// against the lower line at `t4`, for that may have been made by packets after `t1`.
    pub(crate) fn contradicted(&self, times: &FourTimes) -> Option<Contradiction> {
        let now_ns = times.received_ns;
        if let Some(by_ns) = self.ahead_ns(times.peer_sent_ns, now_ns) {
            return Some(Contradiction::Ahead(by_ns));
        }
        let upper = upper_parts(times) + self.drifted(now_ns) - self.drifted(times.sent_ns);
        let behind = self.lower? - self.drifted(now_ns) - upper;
        (behind > 0).then(|| Contradiction::Behind(whole_up(behind)))
    }

    /// How long before its sending a packet arrived on every clock that fits, in ns; none if on some it did not.
    pub(crate) fn ahead_ns(&self, peer_sent_ns: u64, received_ns: u64) -> Option<u64> {
        let ahead = lower_parts(peer_sent_ns, received_ns) - (self.upper? + self.drifted(received_ns));
        (ahead > 0).then(|| whole_up(ahead))
    }

    /// The least and the greatest offset in ns possible at `at_ns`; none before the first exchange.
    pub(crate) fn range(&self, at_ns: u64) -> Option<(i64, i64)> {
        // Before the newest exchange the lines do not hold; what they say of that time gives way backwards.
        let from = self.newest_ns.max(at_ns);
        let way = self.drifted(from) + self.drifted(from - at_ns);
        Some((whole(self.lower? - way), whole(self.upper? + way + PARTS - 1)))
    }

    /// What a clock may part in a time, in parts.
    fn drifted(&self, duration_ns: u64) -> i128 {
        i128::from(duration_ns) * i128::from(self.max_drift_ppb)
    }
}

fn upper_parts(times: &FourTimes) -> i128 {
    (i128::from(difference(times.peer_received_ns, times.sent_ns)) + READING_NS) * PARTS
}

fn lower_parts(peer_sent_ns: u64, received_ns: u64) -> i128 {
    (i128::from(difference(peer_sent_ns, received_ns)) - READING_NS) * PARTS
}

/// Rounded down; beyond 64 bits it stays at their end.
fn whole(parts: i128) -> i64 {
    let whole = parts.div_euclid(PARTS);
    i64::try_from(whole).unwrap_or(if whole < 0 { i64::MIN } else { i64::MAX })
}

/// Of a positive number, rounded up.
fn whole_up(parts: i128) -> u64 {
    u64::try_from((parts + PARTS - 1) / PARTS).unwrap_or(u64::MAX)
}
