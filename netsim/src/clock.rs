//! Clock of an endpoint with offset, drift and a step against true time.

use schemars::JsonSchema;
use serde::Deserialize;

use crate::checks::{LinkSettingsError, within};

/// Maximum offset and step in s: 127 years, as between a set and an unset clock.
const MAX_OFFSET_S: f64 = 4e9;
const MAX_STEP_TIME_S: f64 = 1e9;
/// Maximum drift in parts per million; quartz has 100 at worst.
const MAX_DRIFT_PPM: f64 = 10_000.0;
/// Integer units of drift per 1: 1e-6 ppm, which is 0.3 ms in ten years.
const PARTS: i128 = 1_000_000_000_000;
const PARTS_PER_PPM: f64 = 1e6;

/// Error of an endpoint's clock. The default clock is exact.
#[derive(Clone, Copy, Debug, Default, PartialEq, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct ClockSettings {
    /// Reading at true time 0, in s.
    pub offset_s: f64,
    /// Drift in parts per million; positive is fast.
    pub drift_ppm: f64,
    /// Step in s; positive is forward.
    pub step_s: f64,
    /// Time of the step, in s of true time.
    pub step_at_s: f64,
}

/// Clock of an endpoint as a function of true time, in integers:
/// `reading(t) = offset + floor(t (1 + drift)) + (step, if t >= step_at)`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(try_from = "ClockSettings")]
pub struct EndpointClock {
    offset_ns: i64,
    drift_parts: i64,
    step_ns: i64,
    step_at_ns: u64,
}

impl EndpointClock {
    /// Check the settings.
    pub fn new(settings: &ClockSettings) -> Result<Self, LinkSettingsError> {
        let &ClockSettings { offset_s, drift_ppm, step_s, step_at_s } = settings;
        within("offset_s", offset_s, -MAX_OFFSET_S, MAX_OFFSET_S)?;
        within("drift_ppm", drift_ppm, -MAX_DRIFT_PPM, MAX_DRIFT_PPM)?;
        within("step_s", step_s, -MAX_OFFSET_S, MAX_OFFSET_S)?;
        within("step_at_s", step_at_s, 0.0, MAX_STEP_TIME_S)?;
        Ok(Self {
            offset_ns: rounded(offset_s * 1e9),
            drift_parts: rounded(drift_ppm * PARTS_PER_PPM),
            step_ns: rounded(step_s * 1e9),
            step_at_ns: rounded(step_at_s * 1e9).unsigned_abs(),
        })
    }

    /// Reading at a true time; saturates at 64 bits.
    pub fn reading_ns(&self, true_ns: u64) -> i64 {
        let true_ns = i128::from(true_ns);
        let drifted = (true_ns * self.rate()).div_euclid(PARTS);
        let step = if true_ns >= i128::from(self.step_at_ns) { self.step_ns } else { 0 };
        let reading = i128::from(self.offset_ns) + drifted + i128::from(step);
        i64::try_from(reading).unwrap_or(if reading < 0 { i64::MIN } else { i64::MAX })
    }

    /// First true time at which the clock reads at least `reading_ns`.
    ///
    /// For the reading at t, the result is t, or t - 1 ns if a slow clock reads the same at both. A clock
    /// that is set back reads some times twice; the result is the first.
    pub fn true_ns(&self, reading_ns: i64) -> u64 {
        let unstepped = i128::from(reading_ns) - i128::from(self.offset_ns);
        let before = self.first_to_reach(unstepped);
        if before < self.step_at_ns {
            return before;
        }
        self.first_to_reach(unstepped - i128::from(self.step_ns)).max(self.step_at_ns)
    }

    /// First time whose drifted value is at least `drifted_ns`.
    fn first_to_reach(&self, drifted_ns: i128) -> u64 {
        let rate = self.rate();
        // Ceiling division of a non-negative sum by a positive rate.
        let first = (drifted_ns.max(0) * PARTS + rate - 1) / rate;
        u64::try_from(first).unwrap_or(u64::MAX)
    }

    fn rate(&self) -> i128 {
        PARTS + i128::from(self.drift_parts)
    }
}

impl TryFrom<ClockSettings> for EndpointClock {
    type Error = LinkSettingsError;

    fn try_from(settings: ClockSettings) -> Result<Self, LinkSettingsError> {
        Self::new(&settings)
    }
}

/// Require a number checked to be far below 2^63.
#[expect(clippy::cast_possible_truncation, reason = "checked, and rounded first")]
fn rounded(number: f64) -> i64 {
    number.round() as i64
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn clock(offset_s: f64, drift_ppm: f64, step_s: f64, step_at_s: f64) -> EndpointClock {
        EndpointClock::new(&ClockSettings { offset_s, drift_ppm, step_s, step_at_s }).unwrap()
    }

    #[test]
    fn reads_offset_drift_and_step() {
        let second = 1_000_000_000;
        let cases = [
            (EndpointClock::default(), 5 * second, 5_000_000_000),
            (clock(-2.5, 0.0, 0.0, 0.0), second, -1_500_000_000),
            (clock(0.0, 20.0, 0.0, 0.0), 10 * second, 10_000_200_000),
            (clock(0.0, -20.0, 0.0, 0.0), 10 * second, 9_999_800_000),
            // floor(1 - 1e-12) ns = 0.
            (clock(0.0, -1e-6, 0.0, 0.0), 1, 0),
            (clock(0.0, 0.0, -1.0, 3.0), 3 * second - 1, 2_999_999_999),
            (clock(0.0, 0.0, -1.0, 3.0), 3 * second, 2_000_000_000),
            (clock(4e9, 10_000.0, 4e9, 0.0), u64::MAX, i64::MAX),
            (clock(-4e9, 0.0, -4e9, 0.0), 0, -8_000_000_000_000_000_000),
        ];
        for (clock, true_ns, reading_ns) in cases {
            assert_eq!(clock.reading_ns(true_ns), reading_ns, "{clock:?}");
        }
    }

    #[test]
    fn a_step_is_skipped_forward_and_read_twice_backward() {
        let forward = clock(0.0, 0.0, 1.0, 3.0);
        assert_eq!(forward.true_ns(3_500_000_000), 3_000_000_000);
        assert_eq!(forward.true_ns(4_500_000_000), 3_500_000_000);
        let backward = clock(0.0, 0.0, -1.0, 3.0);
        assert_eq!(backward.true_ns(2_500_000_000), 2_500_000_000);
        assert_eq!(backward.true_ns(3_500_000_000), 4_500_000_000);
        assert_eq!(backward.true_ns(-7), 0);
    }

    #[test]
    fn settings_are_checked_and_zero_by_default() {
        let read = serde_json::from_str::<EndpointClock>;
        assert_eq!(read("{}").unwrap(), EndpointClock::default());
        assert_eq!(read(r#"{"offset_s": 1.5}"#).unwrap(), clock(1.5, 0.0, 0.0, 0.0));
        let cases = [
            (r#"{"drift_ppm": 1e5}"#, "drift_ppm = 100000: must be a finite number from -10000 to 10000"),
            (r#"{"step_at_s": -1}"#, "step_at_s = -1: must be a finite number from 0 to 1000000000"),
            (r#"{"skew": 1}"#, "unknown field `skew`"),
        ];
        for (text, message) in cases {
            let error = read(text).unwrap_err().to_string();
            assert!(error.contains(message), "{error}");
        }
        let settings = ClockSettings { offset_s: f64::NAN, ..ClockSettings::default() };
        assert!(EndpointClock::new(&settings).is_err());
    }

    proptest! {
        #[test]
        fn without_a_step_it_never_goes_back_and_can_be_read_backwards(
            offset_s in -1e6..1e6,
            drift_ppm in -10_000.0..10_000.0,
            true_ns in 0..1_000_000_000_000_000_000_u64,
            later_ns in 0..1_000_u64,
        ) {
            let clock = clock(offset_s, drift_ppm, 0.0, 0.0);
            let reading = clock.reading_ns(true_ns);
            prop_assert!(clock.reading_ns(true_ns + later_ns) >= reading);
            let first = clock.true_ns(reading);
            prop_assert!(first <= true_ns && true_ns - first <= 1, "{first}");
            prop_assert_eq!(clock.reading_ns(first), reading);
            prop_assert!(first == 0 || clock.reading_ns(first - 1) < reading);
        }

        #[test]
        fn the_first_time_to_reach_a_reading_is_found_across_a_step(
            drift_ppm in -10_000.0..10_000.0,
            step_ns in -50..50_i32,
            step_at_ns in 0..100_u32,
            reading_ns in -20..200_i64,
        ) {
            let clock = clock(0.0, drift_ppm, f64::from(step_ns) * 1e-9, f64::from(step_at_ns) * 1e-9);
            let searched = (0..1000).find(|&true_ns| clock.reading_ns(true_ns) >= reading_ns);
            prop_assert_eq!(Some(clock.true_ns(reading_ns)), searched);
        }
    }
}
