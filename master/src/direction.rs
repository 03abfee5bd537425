//! The series of a vector divided by its length.
//!
//! Source: recursion for powers of series, A. Jorba, M. Zou, "A software package for the numerical integration of ODEs by
//! means of high-order Taylor methods", Experimental Mathematics 14, 2005, section 2.

use crate::{
    Axes,
    polynomial::{INVERSE, Series, TERMS},
};

/// Fraction h / rho of the radius of convergence at which the omitted terms fall below rounding:
/// `(h / rho)^TERMS = 1e-16`.
const SHARE_OF_RADIUS: f64 = 0.1;

/// A vector series divided by its length.
pub(crate) struct Direction {
    square: Series,
    inverse: Series,
    /// 1 over the first term of `square`.
    per_square: f64,
}

impl Direction {
    pub(crate) fn new() -> Self {
        Self { square: [0.0; TERMS], inverse: [0.0; TERMS], per_square: 0.0 }
    }

    /// Coefficient n of `w / |w|`, from the earlier coefficients of w and the `newest`, its nth. Call in
    /// order of n.
    ///
    /// Terms without the newest w are summed separately, oldest first, so that few operations remain once it
    /// is known. It is passed by value, and the caller stores it as `w[n]` afterwards: reading back a fresh
    /// store would stall.
    #[inline]
    pub(crate) fn coefficient<const N: usize>(
        &mut self,
        w: &[Axes<N>; TERMS],
        newest: &Axes<N>,
        n: usize,
    ) -> Axes<N> {
        let Self { square, inverse, per_square } = self;
        if n == 0 {
            square[0] = newest.norm_squared();
            *per_square = square[0].recip();
            inverse[0] = square[0].sqrt().recip();
            return newest * inverse[0];
        }
        let half = half_squared_inside(w, n);
        // y = s^p with p = -1/2: n s_0 y_n = sum_i (p i - (n - i)) s_i y_{n-i}. The second sum is sum_i w_i
        // y_{n-i}.
        let (mut sum, mut direction) = (0.0, Axes::zeros());
        if n > 1 {
            let inner = 2..(n - 1).max(2);
            let mut weight = 1.0 - n as f64;
            for (square, before) in square[inner.clone()].iter().zip(inverse[inner.clone()].iter().rev()) {
                sum += weight * square * before;
                weight += 0.5;
            }
            for (w, before) in w[inner.clone()].iter().zip(inverse[inner].iter().rev()) {
                direction += w * *before;
            }
            if n > 2 {
                sum += -0.5 * (n + 1) as f64 * square[n - 1] * inverse[1];
                direction += w[n - 1] * inverse[1];
            }
            sum += (0.5 - n as f64) * square[1] * inverse[n - 1];
            direction += w[1] * inverse[n - 1];
        }
        // The share of s_n is -n / 2 s_n y_0.
        let slope = inverse[0] * *per_square;
        let known = sum * (*per_square * INVERSE[n]) - half * slope;
        let along = w[0].dot(newest);
        square[n] = 2.0 * (half + along);
        inverse[n] = known - along * slope;
        direction + newest * inverse[0] + w[0] * inverse[n]
    }

    /// Time in s within which the omitted terms are below rounding, to 0.6 %; infinity if it is at least
    /// `wanted`.
    pub(crate) fn reach(&self, wanted: f64) -> f64 {
        let last = TERMS - 5..TERMS - 2;
        // Avoid roots if the reach suffices.
        let (rate, most) = (wanted / SHARE_OF_RADIUS, self.inverse[0].abs());
        let mut power = (1..last.start).map(|_| rate).product::<f64>();
        let reaches = |n: usize| {
            power *= rate;
            self.inverse[n].abs() * power <= most
        };
        if most > 0.0 && last.clone().all(reaches) {
            return f64::INFINITY;
        }
        // |y_n| ~ y_0 / rho^n. Only the largest root is computed; a piecewise linear logarithm selects it.
        let rough_log = |value: f64| (value.to_bits() as f64 * 2_f64.powi(-52) - 1023.0).max(-1023.0);
        let growth = |n: usize| (n, (self.inverse[n] / self.inverse[0]).abs());
        let largest = last
            .map(growth)
            .max_by(|(n, a), (m, b)| (rough_log(*a) / *n as f64).total_cmp(&(rough_log(*b) / *m as f64)));
        let rate = largest.map_or(0.0, |(n, growth)| growth.powf(1.0 / n as f64));
        // An overflowed length has reach 0.
        if rate > 0.0 {
            SHARE_OF_RADIUS / rate
        } else if rate == 0.0 {
            f64::INFINITY
        } else {
            0.0
        }
    }
}

/// Term n of the series of `|w|²`; each product of two different terms counts twice.
#[inline]
pub(crate) fn squared<const N: usize>(w: &[Axes<N>; TERMS], n: usize) -> f64 {
    if n == 0 { w[0].norm_squared() } else { 2.0 * (half_squared_inside(w, n) + w[0].dot(&w[n])) }
}

/// Half of term n > 0 of `|w|²`, without the product of the first and the last; the oldest first.
#[inline]
fn half_squared_inside<const N: usize>(w: &[Axes<N>; TERMS], n: usize) -> f64 {
    // One sum per axis, so that the sums are independent.
    let mut half = if n.is_multiple_of(2) { w[n / 2].component_mul(&w[n / 2]) * 0.5 } else { Axes::zeros() };
    for (early, late) in w[1..n.div_ceil(2)].iter().rev().zip(&w[n / 2 + 1..n]) {
        half += early.component_mul(late);
    }
    half.sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `|w|²` equals the sum of all products, and `w / |w|` equals the quotient within the reach.
    #[test]
    fn a_direction_is_the_quotient_of_its_series() {
        let mut w = [Axes::<3>::zeros(); TERMS];
        for (n, term) in w.iter_mut().enumerate().take(6) {
            *term = Axes::<3>::from_fn(|axis, _| (1.0 + n as f64 * 0.7 + axis as f64 * 1.3).sin());
        }
        let at = |t: f64| w.iter().rev().fold(Axes::<3>::zeros(), |sum, term| sum * t + term);
        let mut direction = Direction::new();
        let series: Vec<_> = (0..TERMS).map(|n| direction.coefficient(&w, &w[n], n)).collect();
        for n in 0..TERMS {
            let products: f64 = (0..=n).map(|i| w[i].dot(&w[n - i])).sum();
            assert!((squared(&w, n) - products).abs() < 1e-14, "{n}");
        }
        // `reach` returns infinity for less than the reach, and the reach for more.
        let reach = direction.reach(f64::INFINITY);
        let largest = (TERMS - 5..TERMS - 2)
            .map(|n| (direction.inverse[n] / direction.inverse[0]).abs().powf(1.0 / n as f64))
            .fold(0.0, f64::max);
        // The root with the largest rough logarithm may be smaller than the largest root, by less than
        // 2^(0.09 / 11).
        assert!((1.0 - 1e-12..1.006).contains(&(reach * largest / SHARE_OF_RADIUS)), "{}", reach * largest);
        assert_eq!(direction.reach(0.9 * reach), f64::INFINITY);
        assert_eq!(direction.reach(1.1 * reach), reach);
        // An overflowed length has reach 0 for any request.
        let mut beyond = Direction::new();
        let huge = w.map(|term| term * 1e160);
        for n in 0..TERMS {
            let _ = beyond.coefficient(&huge, &huge[n], n);
        }
        assert_eq!([1e-6, f64::INFINITY].map(|wanted| beyond.reach(wanted)), [0.0; 2]);
        let t = reach.min(0.05);
        assert!(t > 1e-3, "{t}");
        let found = series.iter().rev().fold(Axes::<3>::zeros(), |sum, term| sum * t + term);
        assert!((found - at(t).normalize()).norm() < 1e-15, "{found} {}", at(t).normalize());
    }
}
