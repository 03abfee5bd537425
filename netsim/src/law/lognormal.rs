//! Lognormal law, from zero: `D = exp(mu + s z)`, `s^2 = ln(1 + sigma^2 / mean^2)`, `mu = ln(mean) - s^2 / 2`.
//!
//! Source: N. L. Johnson, S. Kotz, N. Balakrishnan, "Continuous univariate distributions" vol. 1, 1994, chapter 14.

use super::{Tails, at_most};
use crate::settings::LinkError;

/// Beyond it most of the variance lies in delays too rare to be ever met.
const LARGEST_RATIO: f64 = 5.0;

#[derive(Clone, Copy, Debug)]
pub(super) struct Lognormal {
    mu: f64,
    s: f64,
}

impl Lognormal {
    pub(super) fn new(mean_s: f64, sigma_s: f64) -> Result<Self, LinkError> {
        at_most(sigma_s, LARGEST_RATIO * mean_s, "lognormal", mean_s, "use a larger delay_s")?;
        let ratio = sigma_s / mean_s;
        let variance = libm::log1p(ratio * ratio);
        Ok(Self { mu: libm::log(mean_s) - 0.5 * variance, s: variance.sqrt() })
    }

    pub(super) fn at(&self, point: Tails) -> f64 {
        libm::exp(self.mu + self.s * point.z)
    }
}
