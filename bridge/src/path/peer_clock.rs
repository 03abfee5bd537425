//! Offset of the peer's clock: its causal range, and the proof of a step. For logs only, not for safety decisions.

use super::{BILLION, difference, share_up};

/// Maximum drift in parts per billion between two healthy clocks: two oscillators at the 100 ppm of the cheapest.
pub const MAX_DRIFT_PPB: u64 = 200_000;

/// Maximum time of a monotonic clock in ns: 292 years. Larger ones have the highest bit set, so one OR tests several.
const MAX_NS: u64 = i64::MAX.cast_unsigned();

/// Times of a packet there and one back, in ns: the outer two on our clock, the inner two on the peer's.
///
/// A frame with an echo gives three: our send time, the peer's send time minus its hold time, the peer's send time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TimestampExchange {
    /// `t1`: our packet was sent.
    pub sent_ns: u64,
    /// `t2`: it arrived at the peer.
    pub peer_received_ns: u64,
    /// `t3`: the answer was sent.
    pub peer_sent_ns: u64,
    /// `t4`: it arrived here.
    pub received_ns: u64,
}

impl TimestampExchange {
    /// Checks that each clock's times are valid, and both durations agree up to a drift of `max_drift_ppb`.
    fn check(&self, max_drift_ppb: u64) -> Result<(), ClockFault> {
        let Self { sent_ns, peer_received_ns, peer_sent_ns, received_ns } = *self;
        let (took, held) = (self.took_ns(), self.held_ns());
        let all = sent_ns | peer_received_ns | peer_sent_ns | received_ns;
        let is_in_order = sent_ns <= received_ns && peer_received_ns <= peer_sent_ns;
        if all <= MAX_NS && is_in_order && held <= took {
            // Nearly all: valid without any drift.
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

    /// Hold time of the peer: `t3 - t2`, on its clock.
    pub(super) fn held_ns(&self) -> u64 {
        self.peer_sent_ns.saturating_sub(self.peer_received_ns)
    }

    /// Time from sending to the answer: `t4 - t1`, on our clock.
    pub(super) fn took_ns(&self) -> u64 {
        self.received_ns.saturating_sub(self.sent_ns)
    }

    /// Peer's clock minus ours: `theta = ((t2 - t1) + (t3 - t4)) / 2`, rounded to zero.
    ///
    /// The error is half the difference of the delays, `(forward - backward) / 2`, so at most half the round trip,
    /// plus drift.
    ///
    /// Source: RFC 5905, section 8.
    fn offset_ns(&self) -> i64 {
        difference(self.peer_received_ns, self.sent_ns)
            .midpoint(difference(self.peer_sent_ns, self.received_ns))
    }
}

/// Behaviour that a monotonic clock, the peer's or ours, excludes.
///
/// No danger by itself, since no safety decision depends on an offset. It is reported because a machine whose clock
/// jumps was suspended or is broken.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ClockFault {
    /// A time that no monotonic clock shows in 292 years.
    #[error("time of {seen_ns} ns: must be below 2^63 ns")]
    OutOfRange {
        /// Time in ns.
        seen_ns: u64,
    },
    /// An arrival before the sending on the same clock.
    #[error("{side} clock went back by {by_ns} ns within an exchange")]
    Backwards {
        /// `own` or `peer`.
        side: &'static str,
        /// Difference in ns.
        by_ns: u64,
    },
    /// The peer's hold time exceeds the round trip by more than a drift explains.
    #[error("the peer says it held a packet for {by_ns} ns longer than the exchange took")]
    NegativeRoundTrip {
        /// Excess in ns.
        by_ns: u64,
    },
    /// No clock within the allowed drift fits this exchange and those before, for any delays: a clock stepped, or
    /// drifts by more. The estimate restarts.
    #[error(
        "the peer's clock stepped by about {by_ns} ns, at least {at_least_ns} ns, against ours, or drifts by more than \
         {allowed_ppb} ppb; the estimate begins anew"
    )]
    Step {
        /// Approximate jump in ns; positive if the peer's clock went ahead. Reversed if an exchange from before the
        /// step arrives after one from after it.
        by_ns: i64,
        /// Smallest jump in ns that explains it.
        at_least_ns: u64,
        /// Maximum drift of a healthy clock in parts per billion.
        allowed_ppb: u64,
    },
    /// A packet arrived before it was sent, on every clock within the allowed drift.
    #[error("a packet arrived at least {by_ns} ns before it was sent, whatever the ways took before")]
    NegativeDelay {
        /// Minimum lead in ns.
        by_ns: u64,
    },
}

/// Peer's clock minus ours.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PeerOffset {
    /// Offset in ns.
    pub offset_ns: i64,
    /// Maximum error in ns for any delays: half the width of the range.
    pub bound_ns: u64,
}

/// Units per ns of the lines: a rate of 1e-9 is a whole number.
const PARTS: i128 = BILLION as i128;
/// Readings are rounded down to whole ns: a bound of a difference may be off by 1 ns, the difference by another. In
/// parts.
const READING: i128 = 2 * PARTS;

/// Range of the peer's clock minus ours, `theta`, since no packet arrives before it was sent.
///
/// When our packet left at `t1`, the peer's clock showed at most `t2`: `theta(t1) <= t2 - t1`. When the peer's
/// arrived at `t4`, its clock showed at least `t3`: `theta(t4) >= t3 - t4`. Both hold for any delays. Healthy clocks
/// drift apart by at most `rho`, so each bound relaxes as a line of that slope. Lines of one side are parallel, so
/// the smallest upper and the greatest lower one remain so. They are the intersection of all ranges so far.
///
/// A clock of drift up to `rho` fits all bounds iff every upper one fits every lower one: `l - u <= rho |t4 - t1|`.
/// (A function of bounded slope can be drawn through points that fit in pairs.)
///
/// The estimate is the middle of the range. Its error is half the difference of the two smallest delays, and at most
/// half the width.
///
/// An exchange that empties the range proves a step: a machine was suspended or is broken. The range restarts with
/// exchanges sent after the proof arrived, so after the step. A step below the width of the range, at most a round
/// trip, looks like a changed path. Until the range has widened, the offset may be outside its bound by that step.
///
/// Source: K. Marzullo, S. Owicki (1983), Maintaining the time in a distributed system (intersection of intervals
/// that widen with the drift).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PeerClock {
    max_drift_ppb: u64,
    /// Upper and lower line at time 0, in parts; `None` before the first exchange.
    lines: Option<Lines>,
    /// The lines are valid from here on.
    newest_ns: u64,
    /// Exchanges sent before this are from before the last step.
    anew_from_ns: u64,
    steps: u64,
}

/// Upper and lower line at time 0, in parts.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Lines {
    upper: i128,
    lower: i128,
}

/// Contradiction of an exchange with those before it, in ns.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Contradiction {
    Ahead(u64),
    Behind(u64),
}

impl PeerClock {
    /// Create a clock without exchanges. Healthy clocks drift apart by at most `max_drift_ppb`.
    pub fn new(max_drift_ppb: u64) -> Self {
        // A clock that loses its whole rate stands still: larger drifts are meaningless.
        let max_drift_ppb = max_drift_ppb.min(BILLION);
        Self { max_drift_ppb, lines: None, newest_ns: 0, anew_from_ns: 0, steps: 0 }
    }

    /// Take an exchange, in order of `received_ns`. Returns false for one sent before the last step was detected.
    ///
    /// [`ClockFault::Step`] restarts the range; any other fault ignores the exchange.
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
            // The most frequent case: no line gets tighter. The kept lines fit each other, so the exchange
            // contradicts neither, except for the rounding of `check`, below 1 ns.
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

    /// Time in ns by which a packet preceded its sending on every fitting clock, if any.
    fn ahead_ns(&self, peer_sent_ns: u64, received_ns: u64) -> Option<u64> {
        let ahead = lower_parts(peer_sent_ns, received_ns) - (self.lines?.upper + self.drifted(received_ns));
        (ahead > 0).then(|| ceil_ns(ahead))
    }

    /// Check a packet without an echo, sent at `peer_sent_ns` on the peer's clock.
    ///
    /// Fails if it preceded its sending on every clock that fits. It may also be from before the last step; the next
    /// exchange shows which.
    pub fn check_arrival(&self, peer_sent_ns: u64, received_ns: u64) -> Result<(), ClockFault> {
        for seen_ns in [peer_sent_ns, received_ns] {
            if seen_ns > MAX_NS {
                return Err(ClockFault::OutOfRange { seen_ns });
            }
        }
        let now_ns = received_ns.max(self.newest_ns);
        self.ahead_ns(peer_sent_ns, now_ns).map_or(Ok(()), |by_ns| Err(ClockFault::NegativeDelay { by_ns }))
    }

    /// Offset at `now_ns`; `None` before the first exchange, and after a step until a new exchange.
    pub fn offset(&self, now_ns: u64) -> Option<PeerOffset> {
        let (least, greatest) = self.range(now_ns)?;
        let offset_ns = least.midpoint(greatest.max(least));
        let bound_ns = offset_ns.abs_diff(least).max(greatest.abs_diff(offset_ns));
        Some(PeerOffset { offset_ns, bound_ns })
    }

    /// Smallest and greatest possible offset in ns at `at_ns`; `None` before the first exchange.
    pub(super) fn range(&self, at_ns: u64) -> Option<(i64, i64)> {
        // The lines are not valid before the newest exchange; for earlier times they relax backwards.
        let from = self.newest_ns.max(at_ns);
        let widening = self.drifted(from) + self.drifted(from - at_ns);
        let Lines { upper, lower } = self.lines?;
        Some((floor_ns(lower - widening), floor_ns(upper + widening + PARTS - 1)))
    }

    /// Number of clock steps.
    pub fn steps(&self) -> u64 {
        self.steps
    }

    /// Clear all but the count of steps, for a new session.
    pub fn restart(&mut self) {
        *self = Self { steps: self.steps, newest_ns: self.newest_ns, ..Self::new(self.max_drift_ppb) };
    }

    /// Maximum drift over a duration, in parts.
    fn drifted(&self, duration_ns: u64) -> i128 {
        i128::from(duration_ns) * i128::from(self.max_drift_ppb)
    }
}

/// Contradiction of an exchange with the kept lines, widened by `drifted` in parts at its arrival, if no clock fits.
///
/// A contradiction is certain. One of up to `2 rho (t4 - t1)` is reported late: the upper bound, valid at `t1`, is
/// compared with the lower line at `t4`. Packets after `t1` may have set that line.
fn contradiction(kept: &Lines, new: &Lines, drifted: i128) -> Option<Contradiction> {
    let apart = 2 * drifted;
    let (upper, lower) = (kept.upper + apart, kept.lower - apart);
    if new.lower > upper {
        return Some(Contradiction::Ahead(ceil_ns(new.lower - upper)));
    }
    (lower > new.upper).then(|| Contradiction::Behind(ceil_ns(lower - new.upper)))
}

fn upper_parts(times: &TimestampExchange) -> i128 {
    // One multiplication of 64 bits by 64.
    i128::from(difference(times.peer_received_ns, times.sent_ns)) * PARTS + READING
}

fn lower_parts(peer_sent_ns: u64, received_ns: u64) -> i128 {
    i128::from(difference(peer_sent_ns, received_ns)) * PARTS - READING
}

/// Rounded down, saturated to 64 bits.
fn floor_ns(parts: i128) -> i64 {
    let floor = parts.div_euclid(PARTS);
    i64::try_from(floor).unwrap_or(if floor < 0 { i64::MIN } else { i64::MAX })
}

/// A positive number, rounded up.
fn ceil_ns(parts: i128) -> u64 {
    u64::try_from((parts + PARTS - 1) / PARTS).unwrap_or(u64::MAX)
}
