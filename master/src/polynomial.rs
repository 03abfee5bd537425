//! First zero crossing of a polynomial: events are located, not stepped over.

use crate::path::shifted;

/// Terms of every Taylor series in this crate: at `rate h <= 1/2` the first omitted one is below 1e-18 of the
/// position and 3e-17 of the velocity.
pub(crate) const TERMS: usize = 16;

/// `1 / n`: a division takes longer than the rest of a term.
pub(crate) const INVERSE: [f64; TERMS + 1] = {
    let mut inverse = [0.0; TERMS + 1];
    let mut n = 1;
    while n <= TERMS {
        inverse[n] = 1.0 / n as f64;
        n += 1;
    }
    inverse
};

/// Coefficients in rising powers of the time.
pub(crate) type Series = [f64; TERMS];

pub(crate) fn value(p: &Series, t: f64) -> f64 {
    p.iter().rev().fold(0.0, |sum, term| sum * t + term)
}

/// Product, truncated to [`TERMS`].
pub(crate) fn product(a: &Series, b: &Series) -> Series {
    std::array::from_fn(|n| (0..=n).map(|i| a[i] * b[n - i]).sum())
}

/// Rounding of a polynomial's value, as a fraction of the sum of the magnitudes of its terms.
const ROUNDING: f64 = 4.0 * f64::EPSILON;

/// Halvings of the interval; the last is 1e-9 of it.
const DEPTH: u32 = 30;

/// First time in \[0, end\] at which `p` becomes negative, located to rounding.
///
/// `p` starts at zero or above. A start at zero (within rounding) is a crossing, `Some(0)`, only if `p`
/// leaves zero downwards. No crossing is missed, however short. The search drops an interval only if bounds
/// prove that the polynomial stays positive or is monotone there.
pub(crate) fn first_negative(p: &Series, end: f64) -> Option<f64> {
    // By far the most common case: the first term outweighs all others together.
    let mut power = 1.0;
    let mut scaled = [0.0; TERMS];
    for (term, p) in scaled.iter_mut().zip(p) {
        *term = p * power;
        power *= end;
    }
    let total: f64 = scaled.iter().map(|term| term.abs()).sum();
    // NaN and infinity cross nothing: bounds on them would never drop an interval.
    if scaled[0] >= total - scaled[0].abs() || !total.is_finite() {
        return None;
    }
    // Divide out the zeros at the start.
    let mut tolerance = ROUNDING * total;
    while scaled[0].abs() <= tolerance {
        scaled.rotate_left(1);
        scaled[TERMS - 1] = 0.0;
        tolerance = ROUNDING * scaled.iter().map(|term| term.abs()).sum::<f64>();
        if tolerance == 0.0 {
            return None;
        }
    }
    if scaled[0] < 0.0 {
        return Some(0.0);
    }
    search(&scaled, 0.0, 1.0, tolerance, DEPTH).map(|share| share * end)
}

/// First crossing in \[a, b\], where `p(a)` is not negative.
fn search(p: &Series, a: f64, b: f64, tolerance: f64, depth: u32) -> Option<f64> {
    let (middle, half) = (0.5 * (a + b), 0.5 * (b - a));
    let mut local = shifted(*p, middle);
    let mut power = 1.0;
    for term in &mut local {
        *term *= power;
        power *= half;
    }
    let (mut rest, mut slopes) = (0.0, 0.0);
    for (n, term) in local.iter().enumerate().skip(2) {
        rest += term.abs();
        slopes += n as f64 * term.abs();
    }
    if local[0] - local[1].abs() - rest >= -tolerance {
        return None;
    }
    if local[1].abs() > slopes || depth == 0 {
        // A monotone polynomial crosses only if it falls.
        return (local[1] < 0.0 && value(p, b) < -tolerance).then(|| fall(p, a, b));
    }
    search(p, a, middle, tolerance, depth - 1).or_else(|| search(p, middle, b, tolerance, depth - 1))
}

/// Zero of a falling `p` between a and b, by Newton's method inside a shrinking bracket.
fn fall(p: &Series, mut a: f64, mut b: f64) -> f64 {
    let mut t = 0.5 * (a + b);
    for _ in 0..100 {
        let (mut at, mut slope) = (0.0, 0.0);
        for term in p.iter().rev() {
            slope = slope * t + at;
            at = at * t + term;
        }
        if at > 0.0 {
            a = t;
        } else {
            b = t;
        }
        let newton = t - at / slope;
        let next = if newton > a && newton < b { newton } else { 0.5 * (a + b) };
        if next == t || at == 0.0 || b - a <= f64::EPSILON * b {
            break;
        }
        t = next;
    }
    t
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn series(terms: &[f64]) -> Series {
        let mut p = [0.0; TERMS];
        p[..terms.len()].copy_from_slice(terms);
        p
    }

    #[test]
    fn finds_the_first_crossing() {
        for (terms, end, expected) in [
            (vec![0.3, -1.0], 1.0, Some(0.3)),
            (vec![0.0, 1.0], 1.0, None),
            (vec![0.0, -1.0], 1.0, Some(0.0)),
            (vec![0.0, 1.0, -1.0], 2.0, Some(1.0)),
            (vec![0.3, -1.0], 0.2, None),
            // (t - 0.1)(t - 0.100001): negative for a millionth of the interval.
            (vec![0.010_000_1, -0.200_001, 1.0], 1.0, Some(0.1)),
            // (t - 0.5)²: touches zero without crossing.
            (vec![0.25, -1.0, 1.0], 1.0, None),
            (vec![0.0; 3], 1.0, None),
            (vec![0.0, f64::NAN], 1.0, None),
            (vec![0.1, f64::NEG_INFINITY, f64::INFINITY], 1.0, None),
            (vec![1.0, f64::NAN], 1.0, None),
        ] {
            let found = first_negative(&series(&terms), end);
            match (found, expected) {
                (Some(t), Some(e)) => assert!((t - e).abs() < 1e-10, "{terms:?}: {t} {e}"),
                other => assert_eq!(other.0, other.1, "{terms:?}"),
            }
        }
    }

    proptest! {
        /// Find the first simple root of polynomials built from roots, to the accuracy of their
        /// coefficients.
        #[test]
        fn finds_the_least_root(mut roots in prop::collection::vec(0.01..3.0f64, 1..6)) {
            roots.sort_by(f64::total_cmp);
            prop_assume!(roots.windows(2).all(|pair| pair[1] - pair[0] > 1e-3));
            let mut p = series(&[1.0]);
            for root in &roots {
                p = product(&p, &series(&[*root, -1.0]));
            }
            // Rounding of the coefficients, divided by the slope, shifts the root. The terms are those of t
            // plus each root.
            let magnitude: f64 = roots.iter().map(|root| 2.0 + root).product();
            let slope: f64 = roots[1..].iter().map(|root| root - roots[0]).product();
            let uncertain = 4.0 * ROUNDING * magnitude / slope;
            prop_assume!(uncertain < 1e-4);
            let found = first_negative(&p, 2.0);
            if roots[0] < 1.99 {
                let off = (found.unwrap() - roots[0]).abs();
                prop_assert!(off < 1e-12 + uncertain, "{} of {}", off, uncertain);
            } else if roots[0] > 2.01 {
                prop_assert_eq!(found, None);
            }
        }
    }
}
