//! Range checks of settings, and their errors.

/// Maximum delay of a link in s; Mars is within it, a unit mistake is not.
pub const MAX_DELAY_S: f64 = 3600.0;

/// Maximum time and duration in a setting, in s: 30 years, far below 64 bits of ns.
pub(crate) const MAX_TIME_S: f64 = 1e9;

/// Maximum payload in a setting, in bytes: that of a UDP datagram.
pub(crate) const MAX_PAYLOAD: usize = 65_535;

/// Invalid link settings.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum LinkSettingsError {
    /// A number is not finite or out of range.
    #[error("{key} = {seen}: must be a finite number from {minimum} to {maximum}")]
    OutOfRange {
        /// Name of the setting, with its position in a list or table, as in `outages.0.times.period_s`.
        key: String,
        /// Value given.
        seen: f64,
        /// Minimum allowed.
        minimum: f64,
        /// Maximum allowed.
        maximum: f64,
    },
    /// Contradictory settings, or unparsable text.
    #[error("{key}: {problem}")]
    Contradiction {
        /// Name of the setting.
        key: String,
        /// Problem and remedy.
        problem: String,
    },
}

impl LinkSettingsError {
    pub(crate) fn contradiction(key: impl Into<String>, problem: impl Into<String>) -> Self {
        Self::Contradiction { key: key.into(), problem: problem.into() }
    }
}

pub(crate) fn within(key: &str, seen: f64, minimum: f64, maximum: f64) -> Result<(), LinkSettingsError> {
    // NaN lies in no range, so this test also covers NaN and infinity.
    if (minimum..=maximum).contains(&seen) {
        return Ok(());
    }
    Err(LinkSettingsError::OutOfRange { key: key.into(), seen, minimum, maximum })
}

pub(crate) fn probability(key: &str, seen: f64) -> Result<(), LinkSettingsError> {
    within(key, seen, 0.0, 1.0)
}

/// Rounds a validated duration to ns. IEEE 754 multiplication and rounding give the same result on every
/// platform.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "a duration that was checked is not negative and far below 2^64 ns"
)]
pub(crate) fn nanoseconds(seconds: f64) -> u64 {
    (seconds * 1e9).round() as u64
}
