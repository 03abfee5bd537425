//! Backward differences: the estimator with the smallest lag, which passes all quantisation noise.

use super::{Estimator, Motion};
use crate::parameter::{ParameterError, positive};
use crate::{About, Axes, Real};
use haptether_numeric::{option, pack, shared};

/// V\[n\] = (x\[n\] - x\[n-1\]) / dT and A\[n\] = (V\[n\] - V\[n-1\]) / dT.
///
/// Under a force held over each tick, V is the true mean velocity of the last tick. A is the mean of the true
/// accelerations of the last **two** ticks; with a\[n\] the acceleration of the tick that ends at n,
///
/// x\[n\] - 2 x\[n-1\] + x\[n-2\] = dT² (a\[n\] + a\[n-1\]) / 2.
///
/// A lags by 1 dT. A position quantum q appears in A as q / dT², which is 23 m/s² for 23 µm at 1 kHz.
///
/// Source: paper Eq. 4 (A from sampled positions); the mean over two ticks is derived above.
#[derive(Clone, Debug)]
pub struct BackwardDifference<const N: usize, S = f64> {
    period_s: f64,
    previous_position: Option<Axes<N, S>>,
    previous_velocity: Axes<N, S>,
    previous_force: Axes<N, S>,
}

impl<const N: usize> BackwardDifference<N> {
    /// Name, title and source.
    pub const ABOUT: About =
        About { name: "backward-difference", title: "differences of the position", source: "paper Eq. 4" };

    /// Create an estimator for positions sampled every `period_s`.
    pub fn new(period_s: f64) -> Result<Self, ParameterError> {
        Ok(Self {
            period_s: positive("period_s", "dT", period_s)?,
            previous_position: None,
            previous_velocity: Axes::zeros(),
            previous_force: Axes::zeros(),
        })
    }
}

impl<const N: usize, S: Real> Estimator<N, S> for BackwardDifference<N, S> {
    type One = BackwardDifference<N>;

    /// Gather estimators of one period.
    fn gather(of: &[&BackwardDifference<N>]) -> Option<Self> {
        Some(Self {
            period_s: shared(of, |one| one.period_s)?,
            previous_position: option(
                of,
                |one| one.previous_position.as_ref(),
                |them| pack(them, |at| **at),
            )?,
            previous_velocity: pack(of, |one| one.previous_velocity)?,
            previous_force: pack(of, |one| one.previous_force)?,
        })
    }

    #[inline(always)]
    fn step(&mut self, position: &Axes<N, S>) -> Motion<N, S> {
        let period_s = S::splat(self.period_s);
        let previous_position = self.previous_position.replace(*position).unwrap_or(*position);
        let velocity = (position - previous_position) / period_s;
        let acceleration = (velocity - self.previous_velocity) / period_s;
        self.previous_velocity = velocity;
        Motion { velocity, acceleration }
    }

    #[inline(always)]
    fn align(&mut self, device_force: &Axes<N, S>) -> Axes<N, S> {
        let aligned = (device_force + self.previous_force) / S::splat(2.0);
        self.previous_force = *device_force;
        aligned
    }

    fn shift(&mut self, by: &Axes<N, S>) {
        if let Some(position) = &mut self.previous_position {
            *position += by;
        }
    }

    fn has_late_velocity(&self) -> bool {
        true
    }

    fn reset(&mut self, position: &Axes<N, S>) {
        self.previous_position = Some(*position);
        self.previous_velocity = Axes::zeros();
        self.previous_force = Axes::zeros();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ramp_is_exact() {
        // With a period and a slope that are powers of two, the result is exact.
        let period_s = 1.0 / 1024.0;
        let mut estimator = BackwardDifference::<1>::new(period_s).unwrap();
        estimator.step(&Axes::from([0.0]));
        for n in 1..50 {
            let motion = estimator.step(&Axes::from([0.25 * f64::from(n) * period_s]));
            assert_eq!(motion.velocity, Axes::from([0.25]));
            assert_eq!(motion.acceleration, Axes::from([if n == 1 { 256.0 } else { 0.0 }]));
        }
    }

    #[test]
    fn a_force_step_is_spread_over_two_ticks() {
        let mut estimator = BackwardDifference::<1>::new(1e-3).unwrap();
        for (force, expected) in [(4.0, 2.0), (4.0, 4.0), (0.0, 2.0), (0.0, 0.0)] {
            assert_eq!(estimator.align(&Axes::from([force])), Axes::from([expected]));
        }
    }

    #[test]
    fn invalid_periods_are_refused() {
        for period_s in [0.0, -1e-3, f64::NAN, f64::INFINITY] {
            assert!(BackwardDifference::<1>::new(period_s).is_err());
        }
    }
}
