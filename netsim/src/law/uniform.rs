//! Uniform law: `D = mean + w (2 p - 1)`, `w = sqrt(3) sigma`.

use super::{Tails, at_most};
use crate::settings::LinkError;

#[derive(Clone, Copy, Debug)]
pub(super) struct Uniform {
    mean_s: f64,
    half_width_s: f64,
}

impl Uniform {
    pub(super) fn new(mean_s: f64, sigma_s: f64) -> Result<Self, LinkError> {
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
