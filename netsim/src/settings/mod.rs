//! What the network does to the packets of one direction, as files, flags and callers write it.

mod adversary;
mod clock;
mod delay;
mod loss;
mod rate;

use serde::{Deserialize, Serialize};

pub use adversary::{Action, Attack, ByteRange, Checksum, Edit, Operation, Target};
pub use clock::ClockSettings;
pub use delay::{DelayChange, DelayTrace, Distribution, Slots};
pub use loss::{FourState, GilbertElliott, Outage, OutageEffect, OutageTimes};
pub use rate::{CrossTraffic, Discipline, Opportunities};

/// Longest delay a link accepts, in s; Mars is within it, a slip of units is not.
pub const MAX_DELAY_S: f64 = 3600.0;

/// Latest time and longest span that a setting names, in s: 30 years, far from the end of 64 bits of ns.
pub(crate) const MAX_TIME_S: f64 = 1e9;

/// Largest payload that a setting names, in bytes; no UDP datagram has more.
pub(crate) const MAX_PAYLOAD: usize = 65_535;

/// What the network does to the packets of one direction. The default is a perfect network.
///
/// What is absent or zero is a rule that is not built. The rules of a link run in the order in which their keys
/// stand here: what a packet meets first comes first.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(default, deny_unknown_fields)]
pub struct LinkSettings {
    /// Largest payload in bytes that passes; a larger one is dropped with the cause `mtu`.
    pub mtu: Option<usize>,

    /// Probability that a packet is lost, 0 to 1. Without a mean burst, packets are lost independently.
    pub loss: f64,
    /// Mean number of packets lost together, at least 1 (Gilbert).
    pub mean_burst: Option<f64>,
    /// The same as a time in s: the chain runs in time, not by packets.
    pub mean_burst_s: Option<f64>,
    /// Gilbert-Elliott, instead of `loss`.
    pub gilbert_elliott: Option<GilbertElliott>,
    /// Four-state Markov loss, instead of `loss`.
    pub four_state: Option<FourState>,
    /// Times at which nothing passes.
    pub outages: Vec<Outage>,

    /// Rate of the bottleneck in bit/s; packets wait in its queue and take their time on the wire.
    pub rate_bps: Option<f64>,
    /// Bytes of headers that each packet takes on the wire beside its payload: 28 of IPv4 and UDP.
    pub overhead_bytes: usize,
    /// Times at which the bottleneck may send, instead of `rate_bps` (mahimahi).
    pub opportunities: Option<Opportunities>,
    /// Most packets that wait; 1000 if none of the three bounds is given. What is on the line does not wait.
    pub queue_packets: Option<usize>,
    /// Most bytes that wait, headers included.
    pub queue_bytes: Option<usize>,
    /// Longest wait in ms.
    pub queue_ms: Option<f64>,
    /// What a queue that fills does.
    pub discipline: Discipline,
    /// Other traffic through the same bottleneck.
    pub cross_traffic: Option<CrossTraffic>,

    /// Mean one-way delay in s, from 0 to [`MAX_DELAY_S`], beside what the bottleneck takes.
    pub delay_s: f64,
    /// Standard deviation of the delay in s.
    pub jitter_s: f64,
    /// Law of the delay around its mean.
    pub distribution: Distribution,
    /// Shape of the law where it has one to choose: that of Pareto and of gamma.
    pub distribution_shape: Option<f64>,
    /// Time in s over which the delay forgets itself, by default 0.1: its autocorrelation is `exp(-t / tau)`. With
    /// `keep_order` it is at least four times `jitter_s`, as short as the order permits; 0 without it is independent
    /// from packet to packet.
    pub jitter_correlation_s: Option<f64>,
    /// Changes of the mean delay at given times.
    pub timeline: Vec<DelayChange>,
    /// Scheduling slots with spikes at their ends, as of satellites.
    pub slots: Option<Slots>,
    /// Recorded delays and losses, which take the place of `delay_s`.
    pub trace: Option<DelayTrace>,
    /// Whether packets arrive in the order in which they were sent, apart from `reorder`.
    pub keep_order: bool,

    /// Probability that a packet is reordered.
    pub reorder: f64,
    /// How many packets a reordered packet overtakes, from 1 to 1024: those that would arrive last of the packets
    /// under way when it is sent.
    pub reorder_depth: usize,
    /// Instead: how long in s a reordered packet is held while later ones pass.
    pub reorder_hold_s: Option<f64>,

    /// Probability that a packet arrives twice.
    pub duplicate: f64,
    /// How long in s after the first the second arrives.
    pub duplicate_gap_s: f64,
    /// Probability that bits of a packet are flipped.
    pub corrupt: f64,
    /// How many bits.
    pub corrupt_bits: u32,
    /// Probability that a packet is cut short.
    pub truncate: f64,
    /// To how many bytes.
    pub truncate_bytes: usize,

    /// What somebody on the path does.
    pub attacks: Vec<Attack>,
    /// Arguments of `tc netem`, reproduced with its quirks; nothing else may be given beside it.
    pub netem: Option<String>,
}

impl Default for LinkSettings {
    fn default() -> Self {
        Self {
            mtu: None,
            loss: 0.0,
            mean_burst: None,
            mean_burst_s: None,
            gilbert_elliott: None,
            four_state: None,
            outages: Vec::new(),
            rate_bps: None,
            overhead_bytes: 28,
            opportunities: None,
            queue_packets: None,
            queue_bytes: None,
            queue_ms: None,
            discipline: Discipline::TailDrop,
            cross_traffic: None,
            delay_s: 0.0,
            jitter_s: 0.0,
            distribution: Distribution::Normal,
            distribution_shape: None,
            jitter_correlation_s: None,
            timeline: Vec::new(),
            slots: None,
            trace: None,
            keep_order: true,
            reorder: 0.0,
            reorder_depth: 1,
            reorder_hold_s: None,
            duplicate: 0.0,
            duplicate_gap_s: 0.0,
            corrupt: 0.0,
            corrupt_bits: 1,
            truncate: 0.0,
            truncate_bytes: 0,
            attacks: Vec::new(),
            netem: None,
        }
    }
}

/// Settings that describe no link.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum LinkError {
    /// A number is not finite or not in its range.
    #[error("{key} = {seen}: must be a finite number from {minimum} to {maximum}")]
    OutOfRange {
        /// Name of the setting, with its place in a list or table, as in `outages.0.times.period_s`.
        key: String,
        /// Its value.
        seen: f64,
        /// The smallest value allowed.
        minimum: f64,
        /// The largest value allowed.
        maximum: f64,
    },
    /// Settings that do not go together, or text that cannot be read.
    #[error("{key}: {problem}")]
    Contradiction {
        /// Name of the setting.
        key: String,
        /// What is wrong, and what would be right.
        problem: String,
    },
}

impl LinkError {
    /// Settings that do not go together.
    pub(crate) fn contradiction(key: impl Into<String>, problem: impl Into<String>) -> Self {
        Self::Contradiction { key: key.into(), problem: problem.into() }
    }
}

/// Refuses a number that is not finite or not in its range.
pub(crate) fn within(key: &str, seen: f64, minimum: f64, maximum: f64) -> Result<(), LinkError> {
    // NaN lies in no range, so one test covers it, infinity and the sign.
    if (minimum..=maximum).contains(&seen) {
        return Ok(());
    }
    Err(LinkError::OutOfRange { key: key.into(), seen, minimum, maximum })
}

/// Refuses what is no probability.
pub(crate) fn probability(key: &str, seen: f64) -> Result<(), LinkError> {
    within(key, seen, 0.0, 1.0)
}

/// Rounds a validated duration to ns. Multiplication and rounding are exact in IEEE 754, hence alike
/// everywhere.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "a duration that was checked is not negative and far below 2^64 ns"
)]
pub(crate) fn nanoseconds(seconds: f64) -> u64 {
    (seconds * 1e9).round() as u64
}
