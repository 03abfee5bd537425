//! Estimator for devices that measure velocity; it estimates only the acceleration.

use super::Motion;
use crate::parameter::{ParameterError, positive};
use crate::{Axes, Real};
use haptether_numeric::{option, pack, shared};

/// V\[n\] as measured, A\[n\] = (V\[n\] - V\[n-1\]) / dT.
///
/// A is exactly the mean acceleration over the last tick. It belongs to the force commanded at n-1, so that force
/// needs no alignment. This is not an [`Estimator`](super::Estimator), since it takes velocities instead of
/// positions.
#[derive(Clone, Debug)]
pub struct MeasuredVelocity<const N: usize, S = f64> {
    period_s: f64,
    previous_velocity: Option<Axes<N, S>>,
}

impl<const N: usize> MeasuredVelocity<N> {
    /// Create an estimator for velocities sampled every `period_s`.
    pub fn new(period_s: f64) -> Result<Self, ParameterError> {
        Ok(Self { period_s: positive("period_s", "dT", period_s)?, previous_velocity: None })
    }
}

impl<const N: usize, S: Real> MeasuredVelocity<N, S> {
    /// Gather one estimator per lane.
    ///
    /// Returns None if their periods differ, or if only some of them have had a velocity.
    pub fn gather(of: &[&MeasuredVelocity<N>]) -> Option<Self> {
        Some(Self {
            period_s: shared(of, |one| one.period_s)?,
            previous_velocity: option(of, |one| one.previous_velocity.as_ref(), |them| pack(them, |v| **v))?,
        })
    }

    /// Take the measured velocity V\[n\] in m/s and add A\[n\]; A is 0 at the first velocity.
    #[inline(always)]
    pub fn step(&mut self, velocity: &Axes<N, S>) -> Motion<N, S> {
        let previous_velocity = self.previous_velocity.replace(*velocity).unwrap_or(*velocity);
        let acceleration = (velocity - previous_velocity) / S::splat(self.period_s);
        Motion { velocity: *velocity, acceleration }
    }

    /// Return `F_device`\[n-1\] unchanged: A is the mean over the tick in which this force was held.
    #[inline(always)]
    pub fn align(&mut self, device_force: &Axes<N, S>) -> Axes<N, S> {
        *device_force
    }

    /// Clear the past: A is 0 at the next velocity.
    pub fn reset(&mut self) {
        self.previous_velocity = None;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn acceleration_of_the_last_tick_needs_no_alignment() {
        let period_s = 1.0 / 1024.0;
        let mut estimator = MeasuredVelocity::<1>::new(period_s).unwrap();
        let mut velocity = Axes::from([3.0]);
        assert_eq!(estimator.step(&velocity).acceleration, Axes::<1>::zeros());
        for acceleration in [2.0, -7.5, 0.0, 16.0] {
            velocity[0] += acceleration * period_s;
            let motion = estimator.step(&velocity);
            assert_eq!(motion.velocity, velocity);
            assert_eq!(Axes::from([acceleration]), motion.acceleration);
            assert_eq!(estimator.align(&Axes::from([acceleration])), motion.acceleration);
        }
    }

    #[test]
    fn reset_clears_the_velocity() {
        let mut estimator = MeasuredVelocity::<1>::new(1e-3).unwrap();
        estimator.step(&Axes::from([3.0]));
        estimator.reset();
        assert_eq!(estimator.step(&Axes::from([5.0])).acceleration, Axes::<1>::zeros());
    }
}
