//! Savitzky-Golay: a polynomial fitted to the last samples, differentiated at the newest.

use super::{Estimator, MAX_WINDOW, Motion};
use crate::parameter::{ParameterError, in_range, positive};
use crate::{About, Axes, Real};
use haptether_numeric::{pack, part, shared};

/// Weights of the samples of the window, newest first.
type Weights = [f64; MAX_WINDOW];

/// Least-squares polynomial of degree p over the last w samples; V and A are its derivatives at the newest sample.
///
/// Both are sums over the lag i = 0 ... w-1: V = sum `h_i` x\[n-i\] / dT and A = sum `c_i` x\[n-i\] / dT².
/// The estimate of a polynomial of degree p is exact, so sum `c_i` = sum `c_i` i = 0 and sum `c_i` i² = 2.
///
/// **Alignment.** Let a\[l\] be the acceleration held over the l-th last tick (l = 1 is the tick that ended at n).
/// Backwards from n, x\[n-i\] = x\[n\] - i dT v\[n\] + dT² sum over l = 1 ... i of (i - l + 1/2) a\[l\]. In A the
/// terms of x\[n\] and v\[n\] vanish because of the two zero sums. The rest is A = sum `g_l` a\[l\] with
///
/// `g_l` = sum over i >= l of `c_i` (i - l + 1/2) = `S2_l` + `S1_l` / 2,
///
/// with `S1_l` = `S1_(l+1)` + `c_l` and `S2_l` = `S2_(l+1)` + `S1_(l+1)`, the double cumulative sums of c. The third
/// sum gives sum `g_l` = 1. `align` applies this finite impulse response to the force; it is exact for every force
/// held over ticks.
///
/// Source: Savitzky & Golay 1964, Analytical Chemistry 36(8); for weights off the centre Gorry 1990, Analytical
/// Chemistry 62(6) (orthogonal polynomials).
#[derive(Clone, Debug)]
pub struct SavitzkyGolay<const N: usize, S = f64> {
    period_s: f64,
    velocity_weights: Weights,
    acceleration_weights: Weights,
    /// `g_(l+1)` at index l.
    force_weights: Weights,
    positions: Ring<N, S>,
    forces: Ring<N, S>,
    started: bool,
}

impl<const N: usize> SavitzkyGolay<N> {
    /// Name, title and source.
    pub const ABOUT: About = About {
        name: "savitzky-golay",
        title: "polynomial through the last samples",
        source: "Savitzky and Golay 1964, Gorry 1990",
    };

    /// Create an estimator for positions sampled every `period_s`, of `degree` 2 or 3 over `window` samples.
    ///
    /// The window is above `degree` and at most [`MAX_WINDOW`].
    pub fn new(period_s: f64, degree: usize, window: usize) -> Result<Self, ParameterError> {
        positive("period_s", "dT", period_s)?;
        in_range("degree", "p", degree as f64, 2.0, 3.0, "2 or 3")?;
        let (min, max) = (degree as f64 + 1.0, MAX_WINDOW as f64);
        in_range("window", "w", window as f64, min, max, "above the degree and at most 128")?;
        let [velocity_weights, acceleration_weights] = end_point_weights(degree, window);
        Ok(Self {
            period_s,
            velocity_weights,
            acceleration_weights,
            force_weights: force_weights(&acceleration_weights),
            positions: Ring::new(window),
            forces: Ring::new(window - 1),
            started: false,
        })
    }
}

impl<const N: usize, S: Real> Estimator<N, S> for SavitzkyGolay<N, S> {
    type One = SavitzkyGolay<N>;

    /// Gather estimators of one period, degree, window and ring position.
    fn gather(of: &[&SavitzkyGolay<N>]) -> Option<Self> {
        let rings = |ring: fn(&SavitzkyGolay<N>) -> &Ring<N>| part(of, ring, Ring::gather);
        Some(Self {
            period_s: shared(of, |one| one.period_s)?,
            velocity_weights: shared(of, |one| one.velocity_weights)?,
            acceleration_weights: shared(of, |one| one.acceleration_weights)?,
            force_weights: shared(of, |one| one.force_weights)?,
            positions: rings(|one| &one.positions)?,
            forces: rings(|one| &one.forces)?,
            started: shared(of, |one| one.started)?,
        })
    }

    #[inline]
    fn step(&mut self, position: &Axes<N, S>) -> Motion<N, S> {
        if !self.started {
            self.reset(position);
        }
        self.positions.push(position);
        let mut velocity = Axes::zeros();
        let mut acceleration = Axes::zeros();
        let weights = self.velocity_weights.iter().zip(&self.acceleration_weights);
        for (sample, (h, c)) in self.positions.newest_first().zip(weights) {
            // The weights sum to zero only up to rounding. Relative to the newest sample, a device at rest gives
            // exactly zero at any position.
            let behind = sample - position;
            velocity += behind * S::splat(*h);
            acceleration += behind * S::splat(*c);
        }
        Motion {
            velocity: velocity / S::splat(self.period_s),
            acceleration: acceleration / S::splat(self.period_s * self.period_s),
        }
    }

    #[inline]
    fn align(&mut self, device_force: &Axes<N, S>) -> Axes<N, S> {
        self.forces.push(device_force);
        let weighted = self.forces.newest_first().zip(&self.force_weights);
        weighted.fold(Axes::zeros(), |sum, (force, g)| sum + force * S::splat(*g))
    }

    fn shift(&mut self, by: &Axes<N, S>) {
        self.positions.shift(by);
    }

    fn has_late_velocity(&self) -> bool {
        false
    }

    fn reset(&mut self, position: &Axes<N, S>) {
        self.positions.fill(position);
        self.forces.fill(&Axes::zeros());
        self.started = true;
    }
}

/// Return the weights h and c of the first and second derivative at the newest sample, per tick and per tick².
///
/// The samples lie at u = 1 (newest) down to -1. Over such points the polynomials `P_0` = 1,
/// `P_(k+1)` = u `P_k` - `r_k` `P_(k-1)` with `r_k` = |`P_k`|² / |`P_(k-1)`|² are orthogonal. The least-squares fit
/// therefore needs no matrix, and the weights are accurate to rounding for every window.
fn end_point_weights(degree: usize, window: usize) -> [Weights; 2] {
    let half = (window - 1) as f64 / 2.0;
    let mut first = [0.0; MAX_WINDOW];
    let mut second = [0.0; MAX_WINDOW];
    let mut previous = [0.0; MAX_WINDOW];
    let mut current = [0.0; MAX_WINDOW];
    current[..window].fill(1.0);
    // Value, slope and curvature of the polynomials at u = 1.
    let mut previous_end = [0.0; 3];
    let mut current_end = [1.0, 0.0, 0.0];
    let mut previous_norm = f64::INFINITY;
    for _ in 0..=degree {
        let norm: f64 = current.iter().map(|value| value * value).sum();
        let ratio = norm / previous_norm;
        for lag in 0..window {
            let u = 1.0 - lag as f64 / half;
            let value = current[lag];
            first[lag] += current_end[1] * value / (norm * half);
            second[lag] += current_end[2] * value / (norm * half * half);
            current[lag] = u * value - ratio * previous[lag];
            previous[lag] = value;
        }
        let [value, slope, curvature] = current_end;
        current_end = [
            value - ratio * previous_end[0],
            slope + value - ratio * previous_end[1],
            curvature + 2.0 * slope - ratio * previous_end[2],
        ];
        previous_end = [value, slope, curvature];
        previous_norm = norm;
    }
    [first, second]
}

/// Return `g_l` for l = 1, 2, ... from the weights c of the second derivative.
fn force_weights(acceleration_weights: &Weights) -> Weights {
    let mut weights = [0.0; MAX_WINDOW];
    let (mut sum, mut double_sum) = (0.0, 0.0);
    for lag in (1..MAX_WINDOW).rev() {
        double_sum += sum;
        sum += acceleration_weights[lag];
        weights[lag - 1] = double_sum + sum / 2.0;
    }
    weights
}

/// Ring of the last `length` samples of a vector; never allocates.
#[derive(Clone, Debug)]
struct Ring<const N: usize, S = f64> {
    samples: [Axes<N, S>; MAX_WINDOW],
    newest: usize,
    length: usize,
}

impl<const N: usize, S: Real> Ring<N, S> {
    /// Create a ring of `length` zeros, from 1 to [`MAX_WINDOW`].
    fn new(length: usize) -> Self {
        Self { samples: [Axes::zeros(); MAX_WINDOW], newest: 0, length: length.clamp(1, MAX_WINDOW) }
    }

    /// Gather one ring per lane, all of one length and position; else return None.
    fn gather(of: &[&Ring<N>]) -> Option<Self> {
        let mut ring = Self::new(shared(of, |one| one.length)?);
        ring.newest = shared(of, |one| one.newest)?;
        for (tick, sample) in ring.samples.iter_mut().enumerate() {
            *sample = pack(of, |one| one.samples[tick])?;
        }
        Some(ring)
    }

    /// Set every sample to `sample`.
    fn fill(&mut self, sample: &Axes<N, S>) {
        self.samples.fill(*sample);
    }

    fn shift(&mut self, by: &Axes<N, S>) {
        self.samples.iter_mut().for_each(|sample| *sample += by);
    }

    /// Replace the oldest sample by `sample`.
    #[inline]
    fn push(&mut self, sample: &Axes<N, S>) {
        self.newest = (self.newest + 1) % self.length;
        self.samples[self.newest] = *sample;
    }

    /// Iterate over the samples from the newest to the oldest.
    #[inline]
    fn newest_first(&self) -> impl Iterator<Item = &Axes<N, S>> {
        let (recent, old) = self.samples[..self.length].split_at(self.newest + 1);
        recent.iter().rev().chain(old.iter().rev())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SHAPES: [(usize, usize); 7] = [(2, 3), (2, 4), (2, 15), (3, 4), (3, 31), (2, 128), (3, 128)];

    #[test]
    fn derivatives_of_polynomials_up_to_the_degree_are_exact() {
        for (degree, window) in SHAPES {
            let [first, second] = end_point_weights(degree, window);
            for power in 0..=i32::try_from(degree).unwrap() {
                let moment = |weights: &Weights| -> (f64, f64) {
                    let terms = (0..window).map(|lag| weights[lag] * (-(lag as f64)).powi(power));
                    terms.fold((0.0, 0.0), |(sum, size), term| (sum + term, size + term.abs()))
                };
                for (weights, expected) in [
                    (first, if power == 1 { 1.0 } else { 0.0 }),
                    (second, if power == 2 { 2.0 } else { 0.0 }),
                ] {
                    let (sum, size) = moment(&weights);
                    // Each weight carries some ten roundings; the recurrence has at most four steps.
                    let tolerance = 32.0 * f64::EPSILON * size;
                    assert!((sum - expected).abs() <= tolerance, "{degree} {window} {power}: {sum}");
                }
            }
        }
    }

    #[test]
    fn a_parabola_through_three_samples_is_the_second_difference() {
        let [first, second] = end_point_weights(2, 3);
        for (lag, (h, c)) in [(1.5, 1.0), (-2.0, -2.0), (0.5, 1.0)].into_iter().enumerate() {
            assert!((first[lag] - h).abs() < 1e-15 && (second[lag] - c).abs() < 1e-15);
        }
        // The kernel of the second difference: two ticks with weight 1/2 each.
        let force = force_weights(&second);
        assert!((force[0] - 0.5).abs() < 1e-15 && (force[1] - 0.5).abs() < 1e-15);
        assert!(force[2..].iter().all(|g| *g == 0.0));
    }

    #[test]
    fn the_force_kernel_has_unit_sum() {
        for (degree, window) in SHAPES {
            let [_, second] = end_point_weights(degree, window);
            let total: f64 = force_weights(&second).iter().sum();
            // sum g = sum c i²/2; for a cubic its terms, up to w each, are far larger than their sum.
            let size: f64 = (0..window).map(|lag| second[lag].abs() * (lag * lag) as f64).sum();
            assert!((total - 1.0).abs() <= 32.0 * f64::EPSILON * size, "{degree} {window}: {total}");
        }
    }

    #[test]
    fn velocity_and_acceleration_of_a_parabola_are_exact_once_the_window_is_full() {
        let (period_s, window) = (1e-3, 15);
        let mut estimator = SavitzkyGolay::<1>::new(period_s, 2, window).unwrap();
        let size: f64 = estimator.acceleration_weights.iter().map(|c| c.abs()).sum();
        for n in 0..60 {
            let t = n as f64 * period_s;
            let motion = estimator.step(&Axes::from([0.1 + 0.3 * t - 2.0 * t * t]));
            if n + 1 >= window {
                // Positions below 0.2 m carry three roundings, and each summation one more.
                let rounding_m = 4.0 * f64::EPSILON * 0.2;
                let tolerance = rounding_m * size / (period_s * period_s);
                assert!((motion.acceleration[0] + 4.0).abs() < tolerance);
                assert!((motion.velocity[0] - (0.3 - 4.0 * t)).abs() < rounding_m * 2.0 / period_s);
            }
        }
    }

    #[test]
    fn invalid_shapes_are_refused() {
        for (degree, window) in [(1, 10), (4, 10), (2, 2), (3, 3), (2, 129)] {
            assert!(SavitzkyGolay::<1>::new(1e-3, degree, window).is_err());
        }
    }

    #[test]
    fn ring_iterates_newest_first_and_drops_the_oldest() {
        let mut ring = Ring::<1>::new(3);
        for sample in [1.0, 2.0, 3.0, 4.0, 5.0] {
            ring.push(&Axes::from([sample]));
        }
        let seen: Vec<f64> = ring.newest_first().map(|sample| sample[0]).collect();
        assert_eq!(seen, [5.0, 4.0, 3.0]);
    }
}
