//! Delay distributions in closed form and by table: `D = Q(p)`.

use super::{Tails, at_most, gaussian};
use crate::checks::{LinkSettingsError, within};

/// Uniform distribution: `D = mean + w (2 p - 1)`, `w = sqrt(3) sigma`.
#[derive(Clone, Copy, Debug)]
pub(super) struct Uniform {
    mean_s: f64,
    half_width_s: f64,
}

impl Uniform {
    pub(super) fn new(mean_s: f64, sigma_s: f64) -> Result<Self, LinkSettingsError> {
        let root = 3_f64.sqrt();
        at_most(
            sigma_s,
            mean_s / root,
            "uniform",
            mean_s,
            "for more take the distribution gamma or lognormal",
        )?;
        Ok(Self { mean_s, half_width_s: root * sigma_s })
    }

    pub(super) fn at(&self, point: Tails) -> f64 {
        (self.mean_s + self.half_width_s * (point.below - point.above)).max(0.0)
    }
}

/// Minimum delay plus an exponential excess: `D = (mean - sigma) - sigma ln(1 - p)`.
///
/// Source: A. M. Sukhov, N. Kuznetsova, A. Pervitsky, A. Galtsev, "Generating function for network delay",
/// 2010.
#[derive(Clone, Copy, Debug)]
pub(super) struct Exponential {
    min_s: f64,
    scale_s: f64,
}

impl Exponential {
    pub(super) fn new(mean_s: f64, sigma_s: f64) -> Result<Self, LinkSettingsError> {
        let remedy = "for more take the distribution gamma or lognormal";
        at_most(sigma_s, mean_s, "a least one and an exponential excess", mean_s, remedy)?;
        Ok(Self { min_s: (mean_s - sigma_s).max(0.0), scale_s: sigma_s })
    }

    pub(super) fn at(&self, point: Tails) -> f64 {
        self.min_s - self.scale_s * log_above(point)
    }
}

/// `ln(1 - p)`, from the more precise tail.
fn log_above(point: Tails) -> f64 {
    if point.below < 0.5 { libm::log1p(-point.below) } else { libm::log(point.above) }
}

const DEFAULT_INDEX: f64 = 5.0;
/// At 2 the variance is infinite; slightly above 2 it stems from delays too rare to occur.
const MIN_INDEX: f64 = 2.5;
const MAX_INDEX: f64 = 100.0;

/// Minimum delay plus a heavy tail: Pareto of the first kind, index alpha, scaled and shifted.
///
/// `X = x_m (1 - p)^(-1/alpha)`, `E[X] = alpha x_m / (alpha - 1)`,
/// `Var[X] = x_m^2 alpha / ((alpha - 1)^2 (alpha - 2))`; `D = X + mean - E[X]`.
///
/// Source: N. L. Johnson, S. Kotz, N. Balakrishnan, "Continuous univariate distributions" vol. 1, 1994,
/// chapter 20.
#[derive(Clone, Copy, Debug)]
pub(super) struct Pareto {
    min_s: f64,
    scale_s: f64,
    index: f64,
}

impl Pareto {
    pub(super) fn new(mean_s: f64, sigma_s: f64, index: Option<f64>) -> Result<Self, LinkSettingsError> {
        let index = index.unwrap_or(DEFAULT_INDEX);
        within("distribution_shape", index, MIN_INDEX, MAX_INDEX)?;
        // (E[X] - x_m) / standard deviation.
        let rise = ((index - 2.0) / index).sqrt();
        let remedy = "for more take a smaller distribution_shape or the distribution lognormal";
        at_most(sigma_s, mean_s / rise, "a least one and a Pareto excess", mean_s, remedy)?;
        let scale_s = sigma_s * (index - 1.0) * rise;
        Ok(Self { min_s: (mean_s - rise * sigma_s).max(0.0), scale_s, index })
    }

    pub(super) fn at(&self, point: Tails) -> f64 {
        self.min_s + self.scale_s * libm::expm1(-log_above(point) / self.index)
    }
}

/// Above it most of the variance stems from delays too rare to occur.
const MAX_LOGNORMAL_RATIO: f64 = 5.0;

/// Lognormal distribution from zero: `D = exp(mu + s z)`, `s^2 = ln(1 + sigma^2 / mean^2)`,
/// `mu = ln(mean) - s^2 / 2`.
///
/// Source: N. L. Johnson, S. Kotz, N. Balakrishnan, "Continuous univariate distributions" vol. 1, 1994,
/// chapter 14.
#[derive(Clone, Copy, Debug)]
pub(super) struct Lognormal {
    mu: f64,
    s: f64,
}

impl Lognormal {
    pub(super) fn new(mean_s: f64, sigma_s: f64) -> Result<Self, LinkSettingsError> {
        at_most(sigma_s, MAX_LOGNORMAL_RATIO * mean_s, "lognormal", mean_s, "use a larger delay_s")?;
        let ratio = sigma_s / mean_s;
        let variance = libm::log1p(ratio * ratio);
        Ok(Self { mu: libm::log(mean_s) - 0.5 * variance, s: variance.sqrt() })
    }

    pub(super) fn at(&self, point: Tails) -> f64 {
        libm::exp(self.mu + self.s * point.z)
    }
}

/// Mean in standard deviations from which the mass below zero is less than a rounding error of 1.
const FAR: f64 = 8.3;
/// With more truncation the distribution is nearly exponential.
const MAX_NORMAL_RATIO: f64 = 0.99;

/// Normal distribution, truncated at zero delay.
///
/// `D = mu + s X`, X standard normal given `X > -a`, `a = mu / s`. mu and s are chosen so that the truncated
/// distribution has the requested mean and standard deviation. With `lambda = phi(a) / Phi(a)`:
///
/// `E[D] = s (a + lambda)`, `Var[D] = s^2 (1 - a lambda - lambda^2)`.
///
/// The ratio of standard deviation to mean falls from 1 (exponential) to 0 as a grows.
///
/// Source: N. L. Johnson, S. Kotz, N. Balakrishnan, "Continuous univariate distributions" vol. 1, 1994,
/// section 13.10.1.
#[derive(Clone, Copy, Debug)]
pub(super) struct Normal {
    mu: f64,
    s: f64,
    /// `Phi(a)`; `None` without truncation.
    kept: Option<f64>,
}

impl Normal {
    pub(super) fn new(mean_s: f64, sigma_s: f64) -> Result<Self, LinkSettingsError> {
        let remedy = "for more take the distribution gamma or lognormal";
        at_most(sigma_s, MAX_NORMAL_RATIO * mean_s, "normal", mean_s, remedy)?;
        if mean_s >= FAR * sigma_s {
            return Ok(Self { mu: mean_s, s: sigma_s, kept: None });
        }
        let a = cut_for(sigma_s / mean_s);
        let (mean, _) = moments(a);
        let s = mean_s / mean;
        Ok(Self { mu: a * s, s, kept: Some(gaussian::cdf(a)) })
    }

    pub(super) fn at(&self, point: Tails) -> f64 {
        match self.kept {
            None => (self.mu + self.s * point.z).max(0.0),
            Some(kept) => (self.mu - self.s * gaussian::quantile(kept * point.above)).max(0.0),
        }
    }
}

/// Mean and variance in units of s and s^2.
fn moments(a: f64) -> (f64, f64) {
    let lambda = gaussian::pdf(a) / gaussian::cdf(a);
    (a + lambda, 1.0 - lambda * (a + lambda))
}

/// Truncation a for a ratio of standard deviation to mean, by bisection.
fn cut_for(ratio: f64) -> f64 {
    // The ratio is 0.995 at -20, and 1/9 at 9.
    let (mut low, mut high) = (-20.0, 9.0);
    for _ in 0..60 {
        let middle = 0.5 * (low + high);
        let (mean, variance) = moments(middle);
        if variance > ratio * ratio * mean * mean {
            low = middle;
        } else {
            high = middle;
        }
    }
    0.5 * (low + high)
}

/// Maximum of netem.
const MAX_VALUES: usize = 16384;

/// Inverse distribution function at evenly spaced probabilities, as in a `.dist` file of iproute2.
///
/// The i-th of n sorted values belongs to the probability `(i + 1/2) / n`; values are interpolated linearly,
/// and constant outside. The tables of iproute2 have neither mean 0 nor standard deviation 1 (Pareto has
/// 0.82). A table is therefore standardised first, so that the result has the requested moments.
///
/// Source: iproute2, `netem/maketable.c`; Linux, `net/sched/sch_netem.c`, `tabledist`.
#[derive(Clone, Debug)]
pub(super) struct Table {
    values_s: Box<[f64]>,
}

impl Table {
    pub(super) fn new(mean_s: f64, sigma_s: f64, values: &[i16]) -> Result<Self, LinkSettingsError> {
        let refuse = |problem: String| Err(LinkSettingsError::contradiction("distribution", problem));
        let count = values.len();
        if !(2..=MAX_VALUES).contains(&count) {
            return refuse(format!("a table of {count} values: must have from 2 to {MAX_VALUES}"));
        }
        let mut sorted: Vec<f64> = values.iter().copied().map(f64::from).collect();
        sorted.sort_by(f64::total_cmp);
        let (first, last) = (sorted[0], sorted[count - 1]);
        if first == last {
            return refuse(format!("all values of the table are {first}: must differ"));
        }
        let mean = sorted.iter().sum::<f64>() / count as f64;
        let (low, high) = (first - mean, last - mean);
        let ends = 0.5 * (low * low + high * high);
        let inner: f64 = sorted
            .windows(2)
            .map(|pair| {
                let (a, b) = (pair[0] - mean, pair[1] - mean);
                (a * a + a * b + b * b) / 3.0
            })
            .sum();
        let deviation = ((ends + inner) / count as f64).sqrt();
        let least = (first - mean) / deviation;
        at_most(sigma_s, mean_s / -least, "of this table", mean_s, "use a larger delay_s")?;
        let scaled = |value: f64| (mean_s + sigma_s * (value - mean) / deviation).max(0.0);
        Ok(Self { values_s: sorted.into_iter().map(scaled).collect() })
    }

    pub(super) fn at(&self, point: Tails) -> f64 {
        let last = self.values_s.len() - 1;
        let place = point.below * self.values_s.len() as f64 - 0.5;
        if place.is_nan() {
            return place;
        }
        let place = place.clamp(0.0, last as f64);
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped to the indices")]
        let left = (place as usize).min(last - 1);
        let [a, b] = [self.values_s[left], self.values_s[left + 1]];
        a + (b - a) * (place - left as f64)
    }
}
