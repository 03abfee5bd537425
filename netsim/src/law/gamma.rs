//! Gamma law of shape k and scale theta: from zero, `k = (mean / sigma)^2`, `theta = sigma^2 / mean`; with a shape that
//! is given, `theta = sigma / sqrt(k)` beyond a least delay `mean - sigma sqrt(k)`.
//!
//! Source: N. L. Johnson, S. Kotz, N. Balakrishnan, "Continuous univariate distributions" vol. 1, 1994, chapter 17.

use super::incomplete_gamma::StandardGamma;
use super::{Tails, at_most};
use crate::settings::{LinkError, within};

const MIN_SHAPE: f64 = 0.05;
const LARGEST_SHAPE: f64 = 1e4;

#[derive(Clone, Copy, Debug)]
pub(super) struct Gamma {
    least_s: f64,
    scale_s: f64,
    excess: StandardGamma,
}

impl Gamma {
    pub(super) fn new(mean_s: f64, sigma_s: f64) -> Result<Self, LinkError> {
        let most_s = mean_s / MIN_SHAPE.sqrt();
        at_most(sigma_s, most_s, "gamma", mean_s, "for more take the distribution lognormal")?;
        let ratio = mean_s / sigma_s;
        Ok(Self { least_s: 0.0, scale_s: sigma_s / ratio, excess: StandardGamma::new(ratio * ratio) })
    }

    pub(super) fn shifted(mean_s: f64, sigma_s: f64, shape: f64) -> Result<Self, LinkError> {
        within("distribution_shape", shape, MIN_SHAPE, LARGEST_SHAPE)?;
        let root = shape.sqrt();
        let remedy = "for more take a smaller distribution_shape";
        at_most(sigma_s, mean_s / root, "a least one and a gamma excess of this shape", mean_s, remedy)?;
        Ok(Self {
            least_s: (mean_s - root * sigma_s).max(0.0),
            scale_s: sigma_s / root,
            excess: StandardGamma::new(shape),
        })
    }

    pub(super) fn at(&self, point: Tails) -> f64 {
        self.least_s + self.scale_s * self.excess.quantile(point)
    }
}
