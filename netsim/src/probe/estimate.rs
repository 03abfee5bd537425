//! Offset between two clocks, estimated from round trips of probes.
//!
//! With the echo's clock ahead by `theta(t)`, a probe shows `a = forward + theta` and `b = backward - theta`.
//! Only the round trip `a + b` is certain. The probe with the shortest round trip in a window waited least;
//! there both directions are assumed equal: `theta = (a - b) / 2`. The line through these points, for the
//! quieter half of the windows, is `theta(t)`; its slope is the drift.
//!
//! If the unloaded directions differ by `2 e`, every estimate is off by `e`: added to one direction and taken
//! from the other. No measurement from the two ends can detect this.
//!
//! Source: D. L. Mills, "Internet time synchronization: the Network Time Protocol", IEEE Trans. Comm. 39(10),
//! 1991 (minimum filter); V. Paxson, "On calibrating measurements of packet transit times", SIGMETRICS 1998
//! (drift by a line through minima).

/// Answered probe: time of sending, and differences of clock readings, in s.
#[derive(Clone, Copy, Debug)]
#[expect(clippy::struct_field_names, reason = "the unit")]
pub(super) struct RoundTrip {
    pub(super) sent_s: f64,
    /// Reception by the echo minus sending by the client.
    pub(super) there_s: f64,
    /// Reception by the client minus sending by the echo.
    pub(super) back_s: f64,
}

impl RoundTrip {
    pub(super) fn total_s(&self) -> f64 {
        self.there_s + self.back_s
    }
}

/// Lead of the echo's clock: `ahead_s + drift (t - at_s)`.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Offset {
    pub(super) at_s: f64,
    pub(super) ahead_s: f64,
    pub(super) drift: f64,
}

/// Number of windows; each should contain a probe that did not wait.
const WINDOWS: usize = 20;
/// Minimum window length in s.
const MIN_WINDOW_S: f64 = 0.5;

impl Offset {
    /// Require probes in sending order.
    pub(super) fn estimate(trips: &[RoundTrip]) -> Self {
        let (Some(first), Some(last)) = (trips.first(), trips.last()) else {
            return Self::default();
        };
        let window_s = ((last.sent_s - first.sent_s) / WINDOWS as f64).max(MIN_WINDOW_S);
        let windows = trips.chunk_by(|a, b| {
            let window = |trip: &RoundTrip| ((trip.sent_s - first.sent_s) / window_s).floor();
            window(a) == window(b)
        });
        let shortest =
            |trips: &[RoundTrip]| trips.iter().copied().min_by(|a, b| a.total_s().total_cmp(&b.total_s()));
        let mut minima: Vec<RoundTrip> = windows.filter_map(shortest).collect();
        minima.sort_by(|a, b| a.total_s().total_cmp(&b.total_s()));
        minima.truncate(minima.len().div_ceil(2));
        Self::line(&minima)
    }

    fn line(minima: &[RoundTrip]) -> Self {
        let count = minima.len() as f64;
        let offset_s = |trip: &RoundTrip| 0.5 * (trip.there_s - trip.back_s);
        let at_s = minima.iter().map(|trip| trip.sent_s).sum::<f64>() / count;
        let mean_s = minima.iter().map(offset_s).sum::<f64>() / count;
        let spread: f64 = minima.iter().map(|trip| (trip.sent_s - at_s).powi(2)).sum();
        let common: f64 = minima.iter().map(|trip| (trip.sent_s - at_s) * (offset_s(trip) - mean_s)).sum();
        // Two points do not determine a reliable slope.
        let drift = if minima.len() > 2 && spread > 0.0 { common / spread } else { 0.0 };
        Self { at_s, ahead_s: mean_s, drift }
    }

    pub(super) fn at(&self, time_s: f64) -> f64 {
        self.ahead_s + self.drift * (time_s - self.at_s)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Both directions take 10 ms plus occasional waits; the clocks differ by an offset and a drift.
    #[test]
    fn offset_and_drift_of_equal_directions_are_found() {
        for (offset_s, drift) in [(0.0, 0.0), (12.5, 50e-6), (-3.0, -200e-6)] {
            let trip = |n: u32| {
                let sent_s = f64::from(n) * 0.001;
                let theta = offset_s + drift * sent_s;
                let wait_s = |phase: u32| 0.005 * f64::from((n * 7 + phase) % 11);
                RoundTrip {
                    sent_s,
                    there_s: 0.01 + theta + wait_s(0),
                    back_s: 0.01 - theta + wait_s((n * 3) % 5),
                }
            };
            let trips: Vec<_> = (0..20_000).map(trip).collect();
            let found = Offset::estimate(&trips);
            assert!((found.drift - drift).abs() < 1e-9, "{found:?}");
            for time_s in [0.0, 10.0, 20.0] {
                assert!((found.at(time_s) - offset_s - drift * time_s).abs() < 1e-7, "{found:?}");
            }
        }
    }

    #[test]
    fn difference_between_directions_is_split() {
        let trips: Vec<_> =
            (0..3_u32).map(|n| RoundTrip { sent_s: f64::from(n), there_s: 0.010, back_s: 0.030 }).collect();
        let found = Offset::estimate(&trips);
        assert!((found.at(1.0) + 0.010).abs() < 1e-12);
        assert_eq!(Offset::estimate(&[]), Offset::default());
        assert_eq!(Offset::estimate(&trips[..1]).drift, 0.0);
    }
}
