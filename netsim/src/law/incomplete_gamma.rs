//! Regularised incomplete gamma functions `P(k, x)` and `Q = 1 - P`, and where they take a value.
//!
//! Source: NIST Digital Library of Mathematical Functions, 8.11.4 (series) and 8.9.2 (continued fraction).

use super::Tails;

const PRECISION: f64 = 1e-15;
const NEWTON_PRECISION: f64 = 1e-7;
const MAX_TERMS: usize = 10_000;
/// From here on the normal law of the cube root is closer than the inversion is worth its time.
const LARGE_SHAPE: f64 = 2000.0;

/// The gamma law of shape k and scale 1.
#[derive(Clone, Copy, Debug)]
pub(super) struct StandardGamma {
    k: f64,
    log_factorial: f64,
}

/// `P(k, x)`, `Q(k, x)`, of which the smaller one has the digits, and dP/dx.
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
    pub(super) fn new(k: f64) -> Self {
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

    /// The x at which P is the lower tail of a point.
    pub(super) fn quantile(&self, point: Tails) -> f64 {
        let k = self.k;
        let cube_root = 1.0 - 1.0 / (9.0 * k) + point.z / (3.0 * k.sqrt());
        let wilson_hilferty = k * cube_root * cube_root * cube_root;
        if k > LARGE_SHAPE || !wilson_hilferty.is_finite() {
            // An end of the law: 0 or infinity.
            return wilson_hilferty.max(0.0);
        }
        // P is below x^k / Gamma(k + 1), so this is below the x sought, and close to it where x is small.
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
            // Newton on the logarithm of the smaller tail: nearly a line, of ln x below and of x above.
            let newton = if point.below < point.above {
                x * libm::exp(libm::log(point.below / p) * p / (slope * x))
            } else {
                x + libm::log(q / point.above) * q / slope
            };
            // Its error is squared with each step.
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
