//! What a clock can be seen to do wrong.

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
    /// The peer held a packet for longer than its whole way there and back took, and by more than a drift explains.
    #[error("the peer says it held a packet for {by_ns} ns longer than the exchange took")]
    NegativeRoundTrip {
        /// How much longer.
        by_ns: u64,
    },
    /// No clock within the allowed drift fits this exchange and those before it, whatever the ways took: a clock
    /// stepped, or runs faster or slower than allowed. The estimate begins anew.
    #[error(
        "the peer's clock stepped by about {by_ns} ns, at least {at_least_ns} ns, against ours, or drifts by more than \
         {allowed_ppb} ppb; the estimate begins anew"
    )]
    Step {
        /// About the jump; positive if the peer's clock went ahead. An exchange from before it that arrives after one
        /// from after it shows it the other way round.
        by_ns: i64,
        /// The least jump that explains it.
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
