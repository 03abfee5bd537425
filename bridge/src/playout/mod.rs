//! When a packet of the peer is used, and what the way did to the packets.
//!
//! [`Playout`] holds packets until their time: at once, after a constant delay, or after one that follows the jitter.
//! [`PathMeter`] counts what the way did: loss and its bursts, reordering, jitter, rate, gaps.

mod bursts;
mod delay;
mod jitter;
mod playing;
mod reorder;
mod settings;
mod statistics;
mod timeline;

#[cfg(test)]
mod tests;

pub use bursts::Bursts;
pub use jitter::Jitter;
pub use playing::{Arrival, Played, Playout, PlayoutCounts};
pub use reorder::Reordering;
pub use settings::{PlayoutError, PlayoutPolicy, PlayoutSettings};
pub use statistics::{PathMeter, PathStatistics};
