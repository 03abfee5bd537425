//! What is wrong with the clock of an endpoint, as files and callers write it.

use serde::Deserialize;

/// What is wrong with the clock of an endpoint. The default is a clock that is right.
#[derive(Clone, Copy, Debug, Default, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ClockSettings {
    /// What it reads at true time 0, in s.
    pub offset_s: f64,
    /// By how much it runs fast, in parts per million; below 0 slow.
    pub drift_ppm: f64,
    /// By how much it is set forward, in s; below 0 back.
    pub step_s: f64,
    /// When it is set, in s of true time.
    pub step_at_s: f64,
}
