//! What can be known of the peer's clock and of the age of its packets.
//!
//! Two sides have two monotonic clocks with different beginnings and rates. [`PeerClock`] estimates how they differ,
//! for logs and diagnosis only. Of an offset only a range is certain, since no packet arrives before it was sent; where
//! in it the offset lies rests on the belief that both ways take alike, which no measurement can show. [`PacketAge`]
//! needs no such belief, so the ladder holds by that. No function here takes a wall time, therefore a step of the wall
//! clock changes nothing.

mod age;
mod causal;
mod drift;
mod fault;
mod four_times;
mod peer_clock;
mod usual;
mod window;

#[cfg(test)]
mod any_path;
#[cfg(test)]
mod tests;

pub use age::{Age, AgeSettings, PacketAge};
pub use fault::ClockFault;
pub use four_times::FourTimes;
pub use peer_clock::{ClockSettings, OneWay, PeerClock, PeerOffset, Reading};
pub use usual::UsualAge;
pub(crate) use window::WindowMinimum;

/// Parts per billion in one.
pub(crate) const BILLION: u64 = 1_000_000_000;

/// What a rate of `ppb` makes of a duration, rounded up: for bounds.
pub(crate) fn share_up(duration_ns: u64, ppb: u64) -> u64 {
    let product = u128::from(duration_ns) * u128::from(ppb);
    u64::try_from(product.div_ceil(u128::from(BILLION))).unwrap_or(u64::MAX)
}

/// `later - earlier` in ns. Both are below 2^63, which the door checks, so that the difference always fits.
pub(crate) fn difference(later: u64, earlier: u64) -> i64 {
    later.cast_signed().wrapping_sub(earlier.cast_signed())
}
