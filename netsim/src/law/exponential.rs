//! A least delay and an exponential excess: `D = (mean - sigma) - sigma ln(1 - p)`.
//!
//! Source: A. M. Sukhov, N. Kuznetsova, A. Pervitsky, A. Galtsev, "Generating function for network delay", 2010.

use super::{Tails, at_most};
use crate::settings::LinkError;

#[derive(Clone, Copy, Debug)]
pub(super) struct Exponential {
    least_s: f64,
    scale_s: f64,
}

impl Exponential {
    pub(super) fn new(mean_s: f64, sigma_s: f64) -> Result<Self, LinkError> {
        let remedy = "for more take the distribution gamma or lognormal";
        at_most(sigma_s, mean_s, "a least one and an exponential excess", mean_s, remedy)?;
        Ok(Self { least_s: (mean_s - sigma_s).max(0.0), scale_s: sigma_s })
    }

    pub(super) fn at(&self, point: Tails) -> f64 {
        self.least_s - self.scale_s * log_above(point)
    }
}

/// `ln(1 - p)`, of the tail that has the digits.
pub(super) fn log_above(point: Tails) -> f64 {
    if point.below < 0.5 { libm::log1p(-point.below) } else { libm::log(point.above) }
}
