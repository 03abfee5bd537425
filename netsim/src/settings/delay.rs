//! Settings of the delay.

use serde::{Deserialize, Serialize};

/// Law of the delay. Each has the mean `delay_s` and the standard deviation `jitter_s`.
#[derive(Clone, Debug, Default, PartialEq, Deserialize, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Distribution {
    /// Normal; cut off at zero, mean and deviation kept, where it would reach below.
    #[default]
    Normal,
    /// Uniform.
    Uniform,
    /// A least delay and an exponential excess.
    Exponential,
    /// Gamma, from zero; with `distribution_shape` from a least delay.
    Gamma,
    /// Lognormal, from zero.
    Lognormal,
    /// A least delay and a Pareto excess of index `distribution_shape`, at least 2.5, by default 5.
    Pareto,
    /// An inverse distribution function at evenly spaced probabilities, as in the `.dist` files of iproute2, in
    /// units of 1/8192 standard deviation around the mean.
    Table(Vec<i16>),
}

/// A change of the mean delay.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct DelayChange {
    /// When it begins, in s since the link began.
    pub at_s: f64,
    /// The new mean delay in s.
    pub delay_s: f64,
    /// How long in s it takes to get there, linearly; 0 is a step.
    #[serde(default)]
    pub ramp_s: f64,
}

/// Scheduling slots: a level of delay that is drawn anew for each, and spikes at both ends.
///
/// Source: arXiv 2601.08439 (Starlink: 15 s; about 140 ms at the start, 75 ms at the end).
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct Slots {
    /// Length of a slot in s.
    pub period_s: f64,
    /// How long in s delays are raised at the start of a slot.
    #[serde(default)]
    pub start_spike_s: f64,
    /// How long in s delays are raised at the end of a slot.
    #[serde(default)]
    pub end_spike_s: f64,
    /// By how much in s, on average; exponentially distributed from spike to spike.
    #[serde(default)]
    pub spike_delay_s: f64,
    /// Standard deviation in s of the level from slot to slot, beside `delay_s`; never below zero delay.
    #[serde(default)]
    pub level_s: f64,
    /// Probability that a packet is lost during a spike.
    #[serde(default)]
    pub spike_loss: f64,
}

/// Recorded delays and losses.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct DelayTrace {
    /// Times in s since the link began, increasing, the first 0 or more.
    pub time_s: Vec<f64>,
    /// Delay in s of a packet sent then; `None` was lost.
    pub delay_s: Vec<Option<f64>>,
    /// Whether delays between two records are interpolated; else the last one holds.
    #[serde(default = "yes")]
    pub interpolate: bool,
    /// Whether it begins anew after its end; else its last record holds.
    #[serde(default = "yes")]
    pub repeat: bool,
}

fn yes() -> bool {
    true
}
