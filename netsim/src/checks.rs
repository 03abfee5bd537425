//! Checks of settings: ranges, and what a link refuses.

/// Longest delay a link accepts, in s; Mars is within it, a slip of units is not.
pub const MAX_DELAY_S: f64 = 3600.0;

/// Latest time and longest span that a setting names, in s: 30 years, far from the end of 64 bits of ns.
pub(crate) const MAX_TIME_S: f64 = 1e9;

/// Largest payload that a setting names, in bytes; no UDP datagram has more.
pub(crate) const MAX_PAYLOAD: usize = 65_535;

/// Settings that describe no link.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum LinkSettingsError {
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

impl LinkSettingsError {
    /// Settings that do not go together.
    pub(crate) fn contradiction(key: impl Into<String>, problem: impl Into<String>) -> Self {
        Self::Contradiction { key: key.into(), problem: problem.into() }
    }
}

/// Refuses a number that is not finite or not in its range.
pub(crate) fn within(key: &str, seen: f64, minimum: f64, maximum: f64) -> Result<(), LinkSettingsError> {
    // NaN lies in no range, so one test covers it, infinity and the sign.
    if (minimum..=maximum).contains(&seen) {
        return Ok(());
    }
    Err(LinkSettingsError::OutOfRange { key: key.into(), seen, minimum, maximum })
}

/// Refuses what is no probability.
pub(crate) fn probability(key: &str, seen: f64) -> Result<(), LinkSettingsError> {
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
