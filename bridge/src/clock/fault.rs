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
    /// The peer held a packet for longer than its whole way there and back took.
    #[error("the peer says it held a packet for {by_ns} ns longer than the exchange took")]
    NegativeRoundTrip {
        /// How much longer.
        by_ns: u64,
    },
    /// The offset jumped by more than the bounds of both measurements allow; the estimate begins anew.
    #[error("the peer's clock stepped by {by_ns} ns against ours; the estimate begins anew")]
    Step {
        /// The jump; positive if the peer's clock went ahead.
        by_ns: i64,
    },
    /// A packet that arrived before it was sent, by more than the offset may be wrong.
    #[error(
        "a packet arrived {by_ns} ns before it was sent, though the offset is known within {bound_ns} ns"
    )]
    NegativeDelay {
        /// How long before.
        by_ns: u64,
        /// How wrong the offset may be.
        bound_ns: u64,
    },
    /// The clocks run apart faster than healthy oscillators do.
    #[error("the peer's clock drifts by {ppb} ppb against ours: healthy is at most {allowed_ppb} ppb")]
    Drift {
        /// The drift in parts per billion.
        ppb: i64,
        /// The greatest that is believed.
        allowed_ppb: u64,
    },
}
