//! Times of the ladder.

use schemars::JsonSchema;
use serde::{Deserialize, Deserializer};

/// Times of the ladder. Ages count from what is expected of the link, so that a long way is no silence.
///
/// In a scene they are in s.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct LadderSettings {
    /// Time in ns over the expected age that leads to STALE.
    #[serde(rename = "stale_after_s", deserialize_with = "whole_ns")]
    #[schemars(with = "f64")]
    pub stale_after_ns: u64,
    /// Time in ns over the expected age that leads to HOLD; above `stale_after_ns` and at most 100 ms, so that with
    /// `fade_out_ns` the force is gone 200 ms after the last frame.
    #[serde(rename = "hold_after_s", deserialize_with = "whole_ns")]
    #[schemars(with = "f64")]
    pub hold_after_ns: u64,
    /// Time in ns over the expected age that leads to STOP; above `hold_after_ns`.
    #[serde(rename = "stop_after_s", deserialize_with = "whole_ns")]
    #[schemars(with = "f64")]
    pub stop_after_ns: u64,
    /// Time in ns in STALE within which the velocity of the slave decays to zero: at most 20 ms, and over before HOLD.
    #[serde(rename = "extrapolate_s", deserialize_with = "whole_ns")]
    #[schemars(with = "f64")]
    pub extrapolate_ns: u64,
    /// Time in ns in which the force fades from full to zero, 50 to 100 ms.
    #[serde(rename = "fade_out_s", deserialize_with = "whole_ns")]
    #[schemars(with = "f64")]
    pub fade_out_ns: u64,
    /// Time in ns in which the force rises from zero to full, at least 200 ms.
    #[serde(rename = "fade_in_s", deserialize_with = "whole_ns")]
    #[schemars(with = "f64")]
    pub fade_in_ns: u64,
    /// Time in ns for which a press waits in ALIGNING, and oldest news by which a slave aligns; 0.5 to 5 s.
    #[serde(skip, default = "default_align_ns")]
    pub align_ns: u64,
}

const MS: u64 = 1_000_000;

/// A time in s as whole ns.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // saturates, and `check` holds it against its range
fn whole_ns<'de, D: Deserializer<'de>>(deserializer: D) -> Result<u64, D::Error> {
    f64::deserialize(deserializer).map(|seconds| (seconds * 1e9).round() as u64)
}

/// Handshake, first frames and one repeat of each over a link of 500 ms each way.
const fn default_align_ns() -> u64 {
    5_000 * MS
}

impl Default for LadderSettings {
    /// 20 ms is the command-loss time of libfranka and UR, 200 ms their ceiling and the least fade-in; a force that
    /// falls within 75 ms is gone 100 ms after the last frame.
    fn default() -> Self {
        Self {
            stale_after_ns: 5 * MS,
            hold_after_ns: 20 * MS,
            stop_after_ns: 200 * MS,
            extrapolate_ns: 15 * MS,
            fade_out_ns: 75 * MS,
            fade_in_ns: 200 * MS,
            align_ns: default_align_ns(),
        }
    }
}

/// A time that a ladder cannot have.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("ladder {name} = {seen} ns: must be between {least} and {most}")]
pub struct LadderError {
    name: &'static str,
    seen: u64,
    least: u64,
    most: u64,
}

impl LadderSettings {
    /// Refuses times that are out of order or range.
    pub fn check(&self) -> Result<(), LadderError> {
        for (name, seen, least, most) in [
            ("stale_after", self.stale_after_ns, 1, 1_000 * MS),
            ("hold_after", self.hold_after_ns, self.stale_after_ns.saturating_add(1), 100 * MS),
            ("stop_after", self.stop_after_ns, self.hold_after_ns.saturating_add(1), 10_000 * MS),
            (
                "extrapolate",
                self.extrapolate_ns,
                0,
                (20 * MS).min(self.hold_after_ns.saturating_sub(self.stale_after_ns)),
            ),
            ("fade_out", self.fade_out_ns, 50 * MS, 100 * MS),
            ("fade_in", self.fade_in_ns, 200 * MS, 60_000 * MS),
            ("align", self.align_ns, 500 * MS, 5_000 * MS),
        ] {
            if !(least..=most).contains(&seen) {
                return Err(LadderError { name, seen, least, most });
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_are_ordered() {
        let good = LadderSettings::default();
        assert_eq!(good.check(), Ok(()));
        for (bad, told) in [
            (LadderSettings { stale_after_ns: 0, ..good }, "stale_after"),
            (LadderSettings { stale_after_ns: 20 * MS, ..good }, "hold_after"),
            (LadderSettings { stop_after_ns: 20 * MS, ..good }, "stop_after"),
            (LadderSettings { extrapolate_ns: 16 * MS, ..good }, "extrapolate"),
            (LadderSettings { hold_after_ns: 100 * MS, extrapolate_ns: 21 * MS, ..good }, "extrapolate"),
            (LadderSettings { fade_out_ns: 49 * MS, ..good }, "fade_out"),
            (LadderSettings { fade_out_ns: 101 * MS, ..good }, "fade_out"),
            (LadderSettings { fade_in_ns: 199 * MS, ..good }, "fade_in"),
            (LadderSettings { hold_after_ns: 100 * MS + 1, ..good }, "hold_after"),
            (LadderSettings { hold_after_ns: u64::MAX, ..good }, "hold_after"),
            (LadderSettings { align_ns: 499 * MS, ..good }, "align"),
            (LadderSettings { align_ns: 5_001 * MS, ..good }, "align"),
        ] {
            assert_eq!(bad.check().unwrap_err().name, told);
        }
        assert_eq!(
            LadderSettings { fade_in_ns: 1, ..good }.check().unwrap_err().to_string(),
            "ladder fade_in = 1 ns: must be between 200000000 and 60000000000"
        );
    }
}
