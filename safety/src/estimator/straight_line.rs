//! The longest straight line through the newest sample that past samples allow.

use super::MAX_WINDOW;

/// Values of one axis, newest first.
pub(super) type Series = [f64; MAX_WINDOW + 1];

/// The line whose slope is the estimate; it passes through the newest sample.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(
    feature = "serde",
    derive(serde::Deserialize, schemars::JsonSchema),
    serde(rename_all = "kebab-case")
)]
pub enum Fit {
    /// Slope of the chord from the oldest to the newest sample of the window.
    #[default]
    End,
    /// Least-squares slope over the window.
    Best,
}

/// The longest window, in ticks, whose line stays within `bound(lag)` of each of its samples, and its slope.
///
/// A sample allows the slopes of one interval; all samples of a window together allow the intersection, which is
/// carried along as the window grows. `series` holds at least two samples, newest first.
///
/// Samples of an encoder meet their bound exactly, and often: each is a whole number of quanta, and so is the bound.
/// There rounding must not decide, which goes by how far from zero a device stands. So the bound is widened by what
/// rounding may add: a sample is wrong by eps/2 of `size(lag)`, and line and difference add a few times that.
/// What is truly beyond the bound is so by at least a quantum / window, far above it.
pub(super) fn widest_line(
    fit: Fit,
    series: &[f64],
    bound: impl Fn(usize) -> f64,
    size: impl Fn(usize) -> f64,
) -> (usize, f64) {
    let newest = series[0];
    let newest_size = size(0);
    let mut sums = Sums::default();
    let (mut lowest, mut highest) = (f64::NEG_INFINITY, f64::INFINITY);
    let mut widest = (1, newest - series[1]);
    for (lag, sample) in series.iter().enumerate().skip(1) {
        let ticks = lag as f64;
        // One division a lag: they are what this loop costs.
        let per_tick = 1.0 / ticks;
        let rise = newest - sample;
        let slope = match fit {
            Fit::End => rise * per_tick,
            Fit::Best => sums.add(ticks, rise).least_squares_slope(ticks),
        };
        let roundings = match fit {
            // Both samples, their difference, the interval and the slope: less than 4 each.
            Fit::End => 8.0,
            // Sums of so many terms add 12 eps to the slope (Higham 2002, section 4.2), per tick of lag.
            Fit::Best => 8.0 + 12.0 * ticks,
        };
        let bound = bound(lag);
        let room = bound + roundings * f64::EPSILON * (newest_size + size(lag) + bound);
        lowest = lowest.max((rise - room) * per_tick);
        highest = highest.min((rise + room) * per_tick);
        if !(lowest..=highest).contains(&slope) {
            break;
        }
        widest = (lag, slope);
    }
    widest
}

/// The slope per tick over a given window.
pub(super) fn slope(fit: Fit, series: &Series, window: usize) -> f64 {
    let newest = series[0];
    match fit {
        Fit::End => (newest - series[window]) / window as f64,
        Fit::Best => {
            let mut sums = Sums::default();
            for (lag, sample) in series[..=window].iter().enumerate() {
                sums.add(lag as f64, newest - sample);
            }
            sums.least_squares_slope(window as f64)
        }
    }
}

/// What least squares needs of the rises since each lag.
#[derive(Default)]
struct Sums {
    rise: f64,
    moment: f64,
}

impl Sums {
    fn add(&mut self, ticks: f64, rise: f64) -> &Self {
        self.rise += rise;
        self.moment += ticks * rise;
        self
    }

    /// 6 sum (2 l - i) rise\[l\] / (i (i+1) (i+2)) over l = 0 ... i.
    fn least_squares_slope(&self, window: f64) -> f64 {
        let scale = window * (window + 1.0) * (window + 2.0);
        6.0 * (2.0 * self.moment - window * self.rise) / scale
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_interval_test_finds_the_window_that_testing_each_sample_finds() {
        let mut series = [0.0; MAX_WINDOW + 1];
        for (lag, sample) in series.iter_mut().enumerate() {
            let t = lag as f64;
            *sample = 40.0 * (t / 17.0).sin() + (t * t * 0.37).sin();
        }
        for fit in [Fit::End, Fit::Best] {
            for bound in [0.5, 1.1, 2.0, 4.0, 8.0, 16.0] {
                let direct = (1..=MAX_WINDOW).take_while(|window| {
                    let slope = slope(fit, &series, *window);
                    (1..=*window).all(|lag| (series[0] - series[lag] - lag as f64 * slope).abs() <= bound)
                });
                let (found, rate) = widest_line(fit, &series, |_| bound, |lag| series[lag].abs());
                assert_eq!(direct.last(), Some(found), "{fit:?} {bound}");
                assert!((rate - slope(fit, &series, found)).abs() < 1e-12);
            }
        }
    }
}
