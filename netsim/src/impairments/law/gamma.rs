//! Gamma distribution of shape k and scale theta: from zero, `k = (mean / sigma)^2`,
//! `theta = sigma^2 / mean`. With a given shape, `theta = sigma / sqrt(k)` above a minimum delay
//! `mean - sigma sqrt(k)`.
//!
//! Source: N. L. Johnson, S. Kotz, N. Balakrishnan, "Continuous univariate distributions" vol. 1, 1994,
//! chapter 17.

use super::{Tails, at_most};
use crate::checks::{LinkSettingsError, within};

const MIN_SHAPE: f64 = 0.05;
const MAX_SHAPE: f64 = 1e4;

#[derive(Clone, Copy, Debug)]
pub(super) struct Gamma {
    min_s: f64,
    scale_s: f64,
    excess: StandardGamma,
}

impl Gamma {
    pub(super) fn new(mean_s: f64, sigma_s: f64) -> Result<Self, LinkSettingsError> {
        let max_s = mean_s / MIN_SHAPE.sqrt();
        at_most(sigma_s, max_s, "gamma", mean_s, "for more take the distribution lognormal")?;
        let ratio = mean_s / sigma_s;
        Ok(Self { min_s: 0.0, scale_s: sigma_s / ratio, excess: StandardGamma::new(ratio * ratio) })
    }

    pub(super) fn shifted(mean_s: f64, sigma_s: f64, shape: f64) -> Result<Self, LinkSettingsError> {
        within("distribution_shape", shape, MIN_SHAPE, MAX_SHAPE)?;
        let root = shape.sqrt();
        let remedy = "for more take a smaller distribution_shape";
        at_most(sigma_s, mean_s / root, "a least one and a gamma excess of this shape", mean_s, remedy)?;
        Ok(Self {
            min_s: (mean_s - root * sigma_s).max(0.0),
            scale_s: sigma_s / root,
            excess: StandardGamma::new(shape),
        })
    }

    pub(super) fn at(&self, point: Tails) -> f64 {
        self.min_s + self.scale_s * self.excess.quantile(point)
    }
}

const PRECISION: f64 = 1e-15;
const NEWTON_PRECISION: f64 = 1e-7;
const MAX_TERMS: usize = 10_000;
/// From here on the normal approximation of the cube root is accurate enough.
const LARGE_SHAPE: f64 = 2000.0;

/// Gamma distribution of shape k and scale 1: regularised incomplete gamma functions `P(k, x)` and
/// `Q = 1 - P`, and their inverse.
///
/// Source: NIST Digital Library of Mathematical Functions, 8.11.4 (series) and 8.9.2 (continued fraction).
#[derive(Clone, Copy, Debug)]
struct StandardGamma {
    k: f64,
    log_factorial: f64,
}

/// `P(k, x)`, `Q(k, x)` and dP/dx; the smaller of P and Q has full precision.
#[derive(Clone, Copy, Debug)]
struct Values {
    p: f64,
    q: f64,
    slope: f64,
}

/// `1 + x / (k + 1) + x^2 / ((k + 1) (k + 2)) + ...`
fn series(k: f64, x: f64) -> f64 {
    let (mut term, mut sum) = (1.0, 1.0);
    for n in 1..MAX_TERMS {
        term *= x / (k + n as f64);
        sum += term;
        if term < sum * PRECISION {
            break;
        }
    }
    sum
}

/// `1 / (x + 1 - k - 1 (1 - k) / (x + 3 - k - 2 (2 - k) / (x + 5 - k - ...)))`, by Lentz's method.
fn fraction(k: f64, x: f64) -> f64 {
    let mut b = x + 1.0 - k;
    let mut d = 1.0 / b;
    let mut c = f64::INFINITY;
    let mut product = d;
    for n in 1..MAX_TERMS {
        let n = n as f64;
        let a = -n * (n - k);
        b += 2.0;
        d = 1.0 / (b + a * d);
        c = b + a / c;
        product *= c * d;
        if (c * d - 1.0).abs() < PRECISION {
            break;
        }
    }
    product
}

impl StandardGamma {
    fn new(k: f64) -> Self {
        Self { k, log_factorial: libm::lgamma(k + 1.0) }
    }

    fn values(&self, x: f64) -> Values {
        let k = self.k;
        // x^k e^-x / Gamma(k + 1)
        let front = libm::exp(k * libm::log(x) - x - self.log_factorial);
        let slope = front * k / x;
        if x < k + 1.0 {
            let p = front * series(k, x);
            Values { p, q: 1.0 - p, slope }
        } else {
            let q = front * k * fraction(k, x);
            Values { p: 1.0 - q, q, slope }
        }
    }

    /// The x at which P equals the lower tail.
    fn quantile(&self, point: Tails) -> f64 {
        let k = self.k;
        let cube_root = 1.0 - 1.0 / (9.0 * k) + point.z / (3.0 * k.sqrt());
        let wilson_hilferty = k * cube_root * cube_root * cube_root;
        if k > LARGE_SHAPE || !wilson_hilferty.is_finite() {
            // End of the distribution: 0 or infinity.
            return wilson_hilferty.max(0.0);
        }
        // P is below x^k / Gamma(k + 1), so this is a lower bound of x, and tight for small x.
        let log_least = (libm::log(point.below) + self.log_factorial) / k;
        if log_least < -700.0 {
            return 0.0;
        }
        let mut low = libm::exp(log_least);
        let mut high = f64::INFINITY;
        let mut x = if cube_root > 0.3 { wilson_hilferty.max(low) } else { low };
        for _ in 0..60 {
            let Values { p, q, slope } = self.values(x);
            if p < point.below || q > point.above {
                low = low.max(x);
            } else {
                high = high.min(x);
            }
            // Newton on the logarithm of the smaller tail: nearly linear in ln x below and in x above.
            let newton = if point.below < point.above {
                x * libm::exp(libm::log(point.below / p) * p / (slope * x))
            } else {
                x + libm::log(q / point.above) * q / slope
            };
            // Each step squares its error.
            if (newton - x).abs() <= NEWTON_PRECISION * x {
                return newton;
            }
            x = match (newton > low && newton < high, high.is_finite()) {
                (true, _) => newton,
                (false, true) => 0.5 * (low + high),
                (false, false) => 2.0 * x,
            };
        }
        x
    }
}
