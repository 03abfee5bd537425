//! Closed-form solution of `y'' + c y' + k y = 0`, for one state or for several in lanes.

use haptether_numeric::all_lanes;

use crate::Real;

/// Map of a [`Transition`] over a given time.
#[derive(Clone, Copy, Debug)]
pub(crate) struct TransitionMap<S = f64> {
    k: S,
    from_y: S,
    from_v: S,
    sine: S,
}

impl<S: Real> Default for TransitionMap<S> {
    fn default() -> Self {
        Self { k: S::zero(), from_y: S::zero(), from_v: S::zero(), sine: S::zero() }
    }
}

impl<S: Real> TransitionMap<S> {
    #[inline(always)]
    pub(super) fn load(&mut self, lane: usize, of: &TransitionMap) {
        self.k.replace(lane, of.k);
        self.from_y.replace(lane, of.from_y);
        self.from_v.replace(lane, of.from_v);
        self.sine.replace(lane, of.sine);
    }

    /// (y, y') after that time.
    #[inline(always)]
    pub(crate) fn apply(&self, [y, v]: [S; 2]) -> [S; 2] {
        let Self { k, from_y, from_v, sine } = *self;
        [y * from_y + v * sine, v * from_v - k * y * sine]
    }
}

/// Closed-form solution of `y'' + c y' + k y = 0`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Transition<S = f64> {
    pub(super) k: S,
    /// 1 / k
    pub(super) per_k: S,
    /// c / 2
    half: S,
    /// (c / 2)² - k: positive if overdamped.
    discriminant: S,
}

impl<S: Real> Default for Transition<S> {
    fn default() -> Self {
        Self { k: S::one(), per_k: S::one(), half: S::zero(), discriminant: S::zero() }
    }
}

/// `1 / (2 n)!` and `1 / (2 n + 1)!`, of cosine and sine.
const EVEN_AND_ODD: [[f64; 2]; 6] = {
    let mut inverse = [[0.0; 2]; 6];
    let (mut n, mut factorial) = (0, 1.0);
    while n < 6 {
        let next = (2 * n + 1) as f64;
        inverse[n] = [1.0 / factorial, 1.0 / (factorial * next)];
        factorial *= next * (next + 1.0);
        n += 1;
    }
    inverse
};

impl Transition {
    /// k in 1/s² (> 0), c in 1/s (>= 0).
    pub(crate) fn new(k: f64, c: f64) -> Self {
        let half = 0.5 * c;
        Self { k, per_k: k.recip(), half, discriminant: half * half - k }
    }

    /// (y, y') after t in s.
    #[cfg(test)]
    pub(crate) fn apply(&self, t: f64, state: [f64; 2]) -> [f64; 2] {
        self.over(t).apply(state)
    }

    /// The map over t in s.
    pub(crate) fn over(&self, t: f64) -> TransitionMap {
        let Self { k, half, discriminant, .. } = *self;
        let z = discriminant * t * t;
        if z > NEARLY_CRITICAL {
            let root = discriminant.sqrt();
            // The slow pole from the product of both: no difference of nearly equal numbers.
            let (slow, fast) = (-k / (half + root), -(half + root));
            let (e_slow, e_fast) = ((slow * t).exp(), (fast * t).exp());
            let sine = (e_slow - e_fast) / (2.0 * root);
            let from_y = (slow * e_fast - fast * e_slow) / (2.0 * root);
            let from_v = (slow * e_slow - fast * e_fast) / (2.0 * root);
            return TransitionMap { k, from_y, from_v, sine };
        }
        if z >= -NEARLY_CRITICAL && half.abs() * t <= REACH {
            return self.over_nearly_critical(t);
        }
        let decay = (-half * t).exp();
        let (cosine, sine) = if z < -NEARLY_CRITICAL {
            let rate = (-discriminant).sqrt();
            let (sin, cos) = (rate * t).sin_cos();
            (cos, sin / rate)
        } else {
            let [cosine, sine] = nearly_critical(z);
            (cosine, sine * t)
        };
        self.damped(decay, cosine, sine)
    }
}

impl<S: Real> Transition<S> {
    /// That of one lane.
    #[inline(always)]
    pub(super) fn of_lane(&self, lane: usize) -> Transition {
        let [k, per_k, half, discriminant] =
            [self.k, self.per_k, self.half, self.discriminant].map(|of| of.extract(lane));
        Transition { k, per_k, half, discriminant }
    }

    pub(super) fn load(&mut self, lane: usize, of: &Transition) {
        self.k.replace(lane, of.k);
        self.per_k.replace(lane, of.per_k);
        self.half.replace(lane, of.half);
        self.discriminant.replace(lane, of.discriminant);
    }

    /// The map over t in s of each lane, and the mask of the lanes in which it is that of a single arm, to the bit.
    #[inline(always)]
    pub(super) fn over_each(&self, t: S) -> (TransitionMap<S>, S::SimdBool) {
        if S::LANES == 1 {
            let mut map = TransitionMap::default();
            map.load(0, &self.of_lane(0).over(t.extract(0)));
            return (map, all_lanes::<S>());
        }
        let z = self.discriminant * t * t;
        let is_near = z.magnitude().simd_le(S::splat(NEARLY_CRITICAL))
            & (self.half.magnitude() * t).simd_le(S::splat(REACH));
        (self.over_nearly_critical(t), is_near)
    }

    /// The map over t in s, where `|(c / 2)² - k| t² <=` [`NEARLY_CRITICAL`] and `|c| t / 2 <=` [`REACH`].
    #[inline(always)]
    fn over_nearly_critical(&self, t: S) -> TransitionMap<S> {
        let [cosine, sine] = nearly_critical(self.discriminant * t * t);
        self.damped(exponential(-self.half * t), cosine, sine * t)
    }

    #[inline(always)]
    fn damped(&self, decay: S, cosine: S, sine: S) -> TransitionMap<S> {
        let (cosine, sine) = (decay * cosine, decay * sine);
        TransitionMap {
            k: self.k,
            from_y: cosine + self.half * sine,
            from_v: cosine - self.half * sine,
            sine,
        }
    }
}

/// Bound on `|(c / 2)² - k| t²` below which cosine and sine are computed as power series.
const NEARLY_CRITICAL: f64 = 1e-2;

/// Cosine, and sine over time, near critical damping: both are power series of z; `z^6 / 12!` is below rounding.
#[inline(always)]
fn nearly_critical<S: Real>(z: S) -> [S; 2] {
    let (mut cosine, mut sine) = (S::zero(), S::zero());
    // No closure: its call would be compiled without the vector instructions.
    for n in (0..EVEN_AND_ODD.len()).rev() {
        let [even, odd] = EVEN_AND_ODD[n];
        (cosine, sine) = (S::splat(even) + cosine * z, S::splat(odd) + sine * z);
    }
    [cosine, sine]
}

/// Bound on `|x|` for [`exponential`].
const REACH: f64 = 0.5;

/// `e^x` for `|x| <=` [`REACH`], to two roundings: Taylor series up to `x^15`, since `0.5^16 / 16!` is 7e-19.
///
/// The terms are added by pairs of pairs, so that no term waits for all before it.
///
/// Source: G. Estrin, "Organization of computer systems", 1960 (the order of the terms).
#[inline(always)]
fn exponential<S: Real>(x: S) -> S {
    const TERMS: [f64; 16] = {
        let mut terms = [1.0; 16];
        let mut n = 1;
        while n < 16 {
            terms[n] = terms[n - 1] / n as f64;
            n += 1;
        }
        terms
    };
    let mut sums = [S::zero(); 8];
    for (pair, sum) in sums.iter_mut().enumerate() {
        *sum = S::splat(TERMS[2 * pair]) + S::splat(TERMS[2 * pair + 1]) * x;
    }
    let (mut count, mut power) = (8, x * x);
    while count > 1 {
        count /= 2;
        for pair in 0..count {
            sums[pair] = sums[2 * pair] + sums[2 * pair + 1] * power;
        }
        power = power * power;
    }
    sums[0]
}

#[cfg(test)]
mod tests {
    use super::*;

    use nalgebra::{Matrix2, Vector2};
    use proptest::prelude::*;

    /// The series near critical damping equals the functions on both sides, and the limit itself.
    #[test]
    fn near_critical_damping_the_series_are_cosine_and_sine() {
        for z in [0.0, 1e-12, -1e-12, 1e-5, -1e-5, 9.9e-3_f64, -9.9e-3] {
            let root = z.abs().sqrt();
            let (cosine, sine) = if z > 0.0 {
                (root.cosh(), root.sinh() / root)
            } else if z < 0.0 {
                (root.cos(), root.sin() / root)
            } else {
                (1.0, 1.0)
            };
            // With t = 1 and c = 2 half: k = half² - z.
            let half = 3.0_f64;
            let map = Transition { k: half * half - z, per_k: 1.0, half, discriminant: z }.over(1.0);
            let decay = (-half).exp();
            // A few roundings of numbers near 1 here and in the library; for the sum also those of half of the sine.
            assert!((map.sine / decay - sine).abs() < 4.0 * f64::EPSILON, "{z}");
            let seen = (map.from_y + map.from_v) / (2.0 * decay);
            assert!((seen - cosine).abs() < (4.0 + half) * f64::EPSILON, "{z}");
        }
    }

    proptest! {
        /// Two roundings of the sums near 1, plus those of the library.
        #[test]
        fn the_exponential_is_that_of_the_library(x in -REACH..=REACH) {
            let exact = x.exp();
            prop_assert!((exponential(x) - exact).abs() <= 2.5 * f64::EPSILON * exact, "{x}");
        }
    }

    #[test]
    fn it_is_the_matrix_exponential() {
        for (k, c) in
            [(9.0, 0.0), (9.0, 1.0), (9.0, 5.999), (9.0, 6.0), (9.0, 6.001), (9.0, 40.0), (1.0, 0.0)]
        {
            for t in [1e-4, 0.01, 0.3, 1.0] {
                let exact = (Matrix2::new(0.0, 1.0, -k, -c) * t).exp() * Vector2::new(0.7, -1.3);
                let [y, v] = Transition::new(k, c).apply(t, [0.7, -1.3]);
                // A few tens of roundings in the scaled and squared exponential.
                assert!(
                    (y - exact.x).abs() < 2e-14 && (v - exact.y).abs() < 1e-13,
                    "{k} {c} {t}: {y} {v} {exact}"
                );
            }
        }
    }
}
