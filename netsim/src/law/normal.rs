//! Normal law, cut off at zero delay.
//!
//! `D = mu + s X`, X standard normal given `X > -a`, `a = mu / s`, with mu and s such that the law that is left has
//! the mean and standard deviation asked for. With `lambda = phi(a) / Phi(a)`:
//!
//! `E[D] = s (a + lambda)`, `Var[D] = s^2 (1 - a lambda - lambda^2)`.
//!
//! Their ratio falls from 1, the exponential law, to 0 as a grows.
//!
//! Source: N. L. Johnson, S. Kotz, N. Balakrishnan, "Continuous univariate distributions" vol. 1, 1994, section
//! 13.10.1.

use super::{Tails, at_most, gaussian};
use crate::settings::LinkError;

/// From this many standard deviations on, the mass below zero is less than a rounding error of 1.
const FAR: f64 = 8.3;
/// A law that is cut off further is all but exponential.
const LARGEST_RATIO: f64 = 0.99;

#[derive(Clone, Copy, Debug)]
pub(super) struct Normal {
    mu: f64,
    s: f64,
    /// `Phi(a)`, unless nothing is cut off.
    kept: Option<f64>,
}

impl Normal {
    pub(super) fn new(mean_s: f64, sigma_s: f64) -> Result<Self, LinkError> {
        let remedy = "for more take the distribution gamma or lognormal";
        at_most(sigma_s, LARGEST_RATIO * mean_s, "normal", mean_s, remedy)?;
        if mean_s >= FAR * sigma_s {
            return Ok(Self { mu: mean_s, s: sigma_s, kept: None });
        }
        let a = cut_for(sigma_s / mean_s);
        let (mean, _) = moments(a);
        let s = mean_s / mean;
        Ok(Self { mu: a * s, s, kept: Some(gaussian::below(a)) })
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
    let lambda = gaussian::density(a) / gaussian::below(a);
    (a + lambda, 1.0 - lambda * (a + lambda))
}

/// Where to cut for a ratio of standard deviation to mean, by bisection.
fn cut_for(ratio: f64) -> f64 {
    // At -20 the ratio is 0.995, at 9 it is 1/9.
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
