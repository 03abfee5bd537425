//! A least delay and a heavy tail: Pareto of the first kind, index alpha, scaled and shifted.
//!
//! `X = x_m (1 - p)^(-1/alpha)`, `E[X] = alpha x_m / (alpha - 1)`,
//! `Var[X] = x_m^2 alpha / ((alpha - 1)^2 (alpha - 2))`; `D = X + mean - E[X]`.
//!
//! Source: N. L. Johnson, S. Kotz, N. Balakrishnan, "Continuous univariate distributions" vol. 1, 1994, chapter 20.

use super::exponential::log_above;
use super::{Tails, at_most};
use crate::settings::{LinkError, within};

const DEFAULT_INDEX: f64 = 5.0;
/// At 2 the variance is infinite; shortly above it lies in delays too rare to be ever met.
const MIN_INDEX: f64 = 2.5;
const LARGEST_INDEX: f64 = 100.0;

#[derive(Clone, Copy, Debug)]
pub(super) struct Pareto {
    least_s: f64,
    scale_s: f64,
    index: f64,
}

impl Pareto {
    pub(super) fn new(mean_s: f64, sigma_s: f64, index: Option<f64>) -> Result<Self, LinkError> {
        let index = index.unwrap_or(DEFAULT_INDEX);
        within("distribution_shape", index, MIN_INDEX, LARGEST_INDEX)?;
        // E[X] - x_m is this many standard deviations.
        let rise = ((index - 2.0) / index).sqrt();
        let remedy = "for more take a smaller distribution_shape or the distribution lognormal";
        at_most(sigma_s, mean_s / rise, "a least one and a Pareto excess", mean_s, remedy)?;
        let scale_s = sigma_s * (index - 1.0) * rise;
        Ok(Self { least_s: (mean_s - rise * sigma_s).max(0.0), scale_s, index })
    }

    pub(super) fn at(&self, point: Tails) -> f64 {
        self.least_s + self.scale_s * libm::expm1(-log_above(point) / self.index)
    }
}
