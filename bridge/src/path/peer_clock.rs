//! The peer's clock less ours: the range that causality leaves, and the proof of a step. For logs alone: no safety
//! decision rests on it.

use super::{BILLION, difference, share_up};

/// Greatest drift in parts per billion between two healthy clocks: two oscillators at the 100 ppm of the cheapest.
pub const MAX_DRIFT_PPB: u64 = 200_000;

/// Latest time in ns that a monotonic clock shows: 292 years. Times beyond it have the highest bit, so that one OR tests several.
const MAX_NS: u64 = i64::MAX.cast_unsigned();

/// The times of a packet there and one back, in ns: the outer two on our clock, the inner two on the peer's.
///
/// A frame with an echo holds three of them: what we wrote as its sending time, the peer's sending time less how long
/// the peer held our packet, and the peer's sending time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TimestampExchange {
    /// `t1`: our packet left.
    pub sent_ns: u64,
    /// `t2`: it arrived there.
    pub peer_received_ns: u64,
    /// `t3`: the answer left there.
    pub peer_sent_ns: u64,
    /// `t4`: it arrived here.
    pub received_ns: u64,
}

impl TimestampExchange {
    /// Whether each clock by itself shows possible times, and both durations fit clocks that part by at most
    /// `max_drift_ppb`.
    fn check(&self, max_drift_ppb: u64) -> Result<(), ClockFault> {
        let Self { sent_ns, peer_received_ns, peer_sent_ns, received_ns } = *self;
        let (took, held) = (self.took_ns(), self.held_ns());
        let all = sent_ns | peer_received_ns | peer_sent_ns | received_ns;
        let is_in_order = sent_ns <= received_ns && peer_received_ns <= peer_sent_ns;
        if all <= MAX_NS && is_in_order && held <= took {
            // Nearly all: no drift needs to explain it.
            return Ok(());
        }
        let times = [sent_ns, peer_received_ns, peer_sent_ns, received_ns];
        if let Some(&seen_ns) = times.iter().find(|&&time| time > MAX_NS) {
            return Err(ClockFault::OutOfRange { seen_ns });
        }
        for (side, first, second) in [("own", sent_ns, received_ns), ("peer", peer_received_ns, peer_sent_ns)]
        {
            if second < first {
                return Err(ClockFault::Backwards { side, by_ns: first - second });
            }
        }
        // Four readings in whole ns.
        if held > took.saturating_add(share_up(took, max_drift_ppb)).saturating_add(4) {
            return Err(ClockFault::NegativeRoundTrip { by_ns: held - took });
        }
        Ok(())
    }

    /// How long the peer held the packet: `t3 - t2`, on its clock.
    pub(super) fn held_ns(&self) -> u64 {
        self.peer_sent_ns.saturating_sub(self.peer_received_ns)
    }

    /// From sending to the answer: `t4 - t1`, on our clock.
    pub(super) fn took_ns(&self) -> u64 {
        self.received_ns.saturating_sub(self.sent_ns)
    }

    /// The peer's clock less ours: `theta = ((t2 - t1) + (t3 - t4)) / 2`, rounded to zero.
    ///
    /// It is wrong by half of what the delays differ, `(forward - backward) / 2`, so by at most half the round trip,
    /// and by what the clocks part meanwhile.
    ///
    /// Source: RFC 5905, section 8.
    fn offset_ns(&self) -> i64 {
        difference(self.peer_received_ns, self.sent_ns)
            .midpoint(difference(self.peer_sent_ns, self.received_ns))
    }
}

/// A clock, the peer's or our own, that did what a monotonic clock does not do.
///
/// None of it is a danger by itself: no safety decision rests on an offset. It is reported, because a machine whose
/// clock jumps was suspended or is broken.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ClockFault {
    /// A time that no monotonic clock shows in 292 years.
    #[error("time of {seen_ns} ns: must be below 2^63 ns")]
    OutOfRange {
        /// The time.
        seen_ns: u64,
    },
    /// An arrival before the sending on one and the same clock.
    #[error("{side} clock went back by {by_ns} ns within an exchange")]
    Backwards {
        /// `own` or `peer`.
        side: &'static str,
        /// How far.
        by_ns: u64,
    },
    /// The peer held a packet for longer than the whole round trip took, and by more than a drift explains.
    #[error("the peer says it held a packet for {by_ns} ns longer than the exchange took")]
    NegativeRoundTrip {
        /// How much longer.
        by_ns: u64,
    },
    /// No clock within the allowed drift fits this exchange and those before it, whatever the delays were: a clock
    /// stepped, or runs faster or slower than allowed. The estimate begins anew.
    #[error(
        "the peer's clock stepped by about {by_ns} ns, at least {at_least_ns} ns, against ours, or drifts by more than \
         {allowed_ppb} ppb; the estimate begins anew"
    )]
    Step {
        /// About the jump; positive if the peer's clock went ahead. An exchange from before it that arrives after one
        /// from after it shows it with the opposite sign.
        by_ns: i64,
        /// The smallest jump that explains it.
        at_least_ns: u64,
        /// The greatest drift in parts per billion that a healthy clock has.
        allowed_ppb: u64,
    },
    /// A packet that arrived before it was sent, on every clock within the allowed drift.
    #[error("a packet arrived at least {by_ns} ns before it was sent, whatever the ways took before")]
    NegativeDelay {
        /// How long before at least.
        by_ns: u64,
    },
}

/// The peer's clock less ours.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PeerOffset {
    /// The offset in ns.
    pub offset_ns: i64,
    /// How wrong it may be in ns, whatever the delays were: half the width of the range.
    pub bound_ns: u64,
}

/// Parts of a nanosecond in which the lines are kept, so that a rate of one in a billion is a whole number.
const PARTS: i128 = BILLION as i128;
/// Readings are whole ns, rounded down: a bound of the difference of two may be off by 1 ns, the difference by another. In
/// parts.
const READING: i128 = 2 * PARTS;

/// The range that holds the peer's clock less ours, `theta`, because no packet arrives before it was sent.
///
/// When a packet of ours left at `t1`, the peer's clock showed at most `t2`, so that `theta(t1) <= t2 - t1`. When one
/// of the peer's arrived at `t4`, its clock showed at least `t3`, so that `theta(t4) >= t3 - t4`. Neither assumes
/// anything of the delays. Healthy clocks drift apart by at most `rho`, so each bound holds later as a line that
/// relaxes with that slope. All lines of one side are parallel: the smallest of the upper ones and the greatest of the
/// lower ones stay so for ever, and the two of them are the intersection of all ranges ever seen.
///
/// There is a clock of drift up to `rho` that fits all bounds if and only if every upper one fits every lower one with
/// `l - u <= rho |t4 - t1|` (a function of bounded slope can be drawn through points that fit in pairs).
///
/// The estimate is the middle of the range: wrong by half of what the smallest delays of the two directions differ, and
/// by no more than half the width of the range.
///
/// An exchange that leaves nothing of the range proves that a clock stepped, because its machine was suspended or it is
/// broken. Then the range begins anew, with exchanges that were sent after the proof arrived: all of their four times
/// are of after the step. A step of less than the width of the range, so of no more than a round trip, looks like a
/// path that changed; it may leave the offset outside its bound by no more than the step, until the range has widened.
///
/// Source: K. Marzullo, S. Owicki (1983), Maintaining the time in a distributed system (intersection of intervals that
/// widen with the drift).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PeerClock {
    max_drift_ppb: u64,
    /// Upper and lower line at time 0, in parts; none before the first exchange.
    lines: Option<Lines>,
    /// The lines hold from here on.
    newest_ns: u64,
    /// Exchanges sent before this are of a time before the last step.
    anew_from_ns: u64,
    steps: u64,
}

/// An upper and a lower line at time 0, in parts.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Lines {
    upper: i128,
    lower: i128,
}

/// By how much an exchange contradicts those before it, in ns.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Contradiction {
    /// The peer's clock is ahead of all that was possible.
    Ahead(u64),
    /// It is behind.
    Behind(u64),
}

impl PeerClock {
    /// No exchange yet; healthy clocks part by at most `max_drift_ppb`.
    pub fn new(max_drift_ppb: u64) -> Self {
        // A clock that drifts by its whole rate stands still: nothing beyond that has a meaning.
        let max_drift_ppb = max_drift_ppb.min(BILLION);
        Self { max_drift_ppb, lines: None, newest_ns: 0, anew_from_ns: 0, steps: 0 }
    }

    /// Takes an exchange, in the order of `received_ns`; whether it was used, not sent before the last step was seen.
    ///
    /// On [`ClockFault::Step`] the range begins anew; on any other fault the exchange is left out.
    pub fn take(&mut self, times: &TimestampExchange) -> Result<bool, ClockFault> {
        times.check(self.max_drift_ppb)?;
        if times.received_ns < self.newest_ns {
            return Err(ClockFault::Backwards { side: "own", by_ns: self.newest_ns - times.received_ns });
        }
        self.newest_ns = times.received_ns;
        if times.sent_ns < self.anew_from_ns {
            return Ok(false);
        }
        let drifted = self.drifted(times.received_ns);
        let new = Lines {
            upper: upper_parts(times) - self.drifted(times.sent_ns),
            lower: lower_parts(times.peer_sent_ns, times.received_ns) + drifted,
        };
        let Some(kept) = self.lines else {
            self.lines = Some(new);
            return Ok(true);
        };
        if new.upper >= kept.upper && new.lower <= kept.lower {
            // Most, where delays vary: neither line gets tighter. Those that are kept fit one another, but for the rounding of
            // `check`, less than 1 ns, so these contradict neither.
            return Ok(true);
        }
        if let Some(contradiction) = contradiction(&kept, &new, drifted) {
            let fault = self.step(times, contradiction);
            self.restart();
            self.anew_from_ns = times.received_ns;
            self.steps += 1;
            return Err(fault);
        }
        self.lines = Some(Lines { upper: kept.upper.min(new.upper), lower: kept.lower.max(new.lower) });
        Ok(true)
    }

    fn step(&self, times: &TimestampExchange, contradiction: Contradiction) -> ClockFault {
        let known_ns = self.offset(times.received_ns).map_or(0, |known| known.offset_ns);
        let about = times.offset_ns().saturating_sub(known_ns);
        let signed = |by_ns: u64| i64::try_from(by_ns).unwrap_or(i64::MAX);
        let (by_ns, at_least_ns) = match contradiction {
            Contradiction::Ahead(by_ns) => (about.max(signed(by_ns)), by_ns),
            Contradiction::Behind(by_ns) => (about.min(-signed(by_ns)), by_ns),
        };
        ClockFault::Step { by_ns, at_least_ns, allowed_ppb: self.max_drift_ppb }
    }

    /// How long before its sending a packet arrived on every clock that fits, in ns; none if on some it did not.
    fn ahead_ns(&self, peer_sent_ns: u64, received_ns: u64) -> Option<u64> {
        let ahead = lower_parts(peer_sent_ns, received_ns) - (self.lines?.upper + self.drifted(received_ns));
        (ahead > 0).then(|| whole_up(ahead))
    }

    /// Checks a packet without an echo, sent at `peer_sent_ns` on the peer's clock.
    ///
    /// One that arrived before it was sent, on every clock that fits all exchanges, is a fault of a clock. It may also
    /// have been sent before the last step; the next exchange shows which.
    pub fn check_arrival(&self, peer_sent_ns: u64, received_ns: u64) -> Result<(), ClockFault> {
        for seen_ns in [peer_sent_ns, received_ns] {
            if seen_ns > MAX_NS {
                return Err(ClockFault::OutOfRange { seen_ns });
            }
        }
        let now_ns = received_ns.max(self.newest_ns);
        self.ahead_ns(peer_sent_ns, now_ns).map_or(Ok(()), |by_ns| Err(ClockFault::NegativeDelay { by_ns }))
    }

    /// The offset at `now_ns`; none before the first exchange, and after a step until an exchange was sent anew.
    pub fn offset(&self, now_ns: u64) -> Option<PeerOffset> {
        let (least, greatest) = self.range(now_ns)?;
        let offset_ns = least.midpoint(greatest.max(least));
        let bound_ns = offset_ns.abs_diff(least).max(greatest.abs_diff(offset_ns));
        Some(PeerOffset { offset_ns, bound_ns })
    }

    /// The smallest and the greatest offset in ns possible at `at_ns`; none before the first exchange.
    pub(super) fn range(&self, at_ns: u64) -> Option<(i64, i64)> {
        // Before the newest exchange the lines do not hold; what they say of that time relaxes backwards.
        let from = self.newest_ns.max(at_ns);
        let widening = self.drifted(from) + self.drifted(from - at_ns);
        let Lines { upper, lower } = self.lines?;
        Some((whole(lower - widening), whole(upper + widening + PARTS - 1)))
    }

    /// How often a clock stepped.
    pub fn steps(&self) -> u64 {
        self.steps
    }

    /// Clears all but the count of steps: for a new session.
    pub fn restart(&mut self) {
        *self = Self { steps: self.steps, newest_ns: self.newest_ns, ..Self::new(self.max_drift_ppb) };
    }

    /// What a clock may part in a time, in parts.
    fn drifted(&self, duration_ns: u64) -> i128 {
        i128::from(duration_ns) * i128::from(self.max_drift_ppb)
    }
}

/// Whether no clock of the allowed drift fits the lines of an exchange and those kept, which have widened by `drifted` in
/// parts at the arrival of its answer.
///
/// What is reported is certain. Reported late is at most `2 rho (t4 - t1)`: the upper bound, of the time `t1`, is held
/// against the lower line at `t4`, for that may have been made by packets after `t1`.
fn contradiction(kept: &Lines, new: &Lines, drifted: i128) -> Option<Contradiction> {
    let apart = 2 * drifted;
    let (upper, lower) = (kept.upper + apart, kept.lower - apart);
    if new.lower > upper {
        return Some(Contradiction::Ahead(whole_up(new.lower - upper)));
    }
    (lower > new.upper).then(|| Contradiction::Behind(whole_up(lower - new.upper)))
}

fn upper_parts(times: &TimestampExchange) -> i128 {
    // One multiplication of 64 bits by 64.
    i128::from(difference(times.peer_received_ns, times.sent_ns)) * PARTS + READING
}

fn lower_parts(peer_sent_ns: u64, received_ns: u64) -> i128 {
    i128::from(difference(peer_sent_ns, received_ns)) * PARTS - READING
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
