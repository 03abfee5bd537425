//! Two Kalman filters of one position: a fast one for V, a slow one for A.

use super::{Estimator, Kalman, Motion};
use crate::parameter::ParameterError;
use crate::{About, Axes, Real};
use haptether_numeric::part;

/// V from a [`Kalman`] filter of jerk density `q_v`, A from one of density q.
///
/// A single filter has one bandwidth: a low noise of A, and thus of the grasp force `m A`, costs lag of V. The noise
/// of V has little effect on an energy `m V² / 2`. For a small delta, only the lag of V limits the bound on the
/// ejection speed. Alignment is that of A.
///
/// Source: [`Kalman`]; `docs/ejection_bound.md`, Eq. 5.
#[derive(Clone, Debug)]
pub struct DualKalman<const N: usize, S = f64> {
    quick: Kalman<N, S>,
    calm: Kalman<N, S>,
}

impl<const N: usize> DualKalman<N> {
    /// Name, title and source.
    pub const ABOUT: About = About {
        name: "dual-kalman",
        title: "quick Kalman filter for V, calm one for A",
        source: "Bar-Shalom, Li and Kirubarajan 2001, section 6.2.3, twice",
    };

    /// Create an estimator for positions rounded to `quantum_m` and sampled every `period_s`.
    ///
    /// The jerk densities are in m²/s⁵, within the bounds of [`Kalman::new`].
    pub fn new(
        period_s: f64,
        velocity_jerk_density: f64,
        jerk_density: f64,
        quantum_m: f64,
    ) -> Result<Self, ParameterError> {
        Ok(Self {
            quick: Kalman::new(period_s, velocity_jerk_density, quantum_m)
                .map_err(|error| error.of_field("jerk_density", "velocity_jerk_density"))?,
            calm: Kalman::new(period_s, jerk_density, quantum_m)?,
        })
    }
}

impl<const N: usize, S: Real> Estimator<N, S> for DualKalman<N, S> {
    type One = DualKalman<N>;

    /// Gather estimators whose filters can be gathered.
    fn gather(of: &[&DualKalman<N>]) -> Option<Self> {
        Some(Self {
            quick: part(of, |one| &one.quick, Kalman::gather)?,
            calm: part(of, |one| &one.calm, Kalman::gather)?,
        })
    }

    #[inline(always)]
    fn step(&mut self, position: &Axes<N, S>) -> Motion<N, S> {
        let velocity = self.quick.step(position).velocity;
        Motion { velocity, ..self.calm.step(position) }
    }

    #[inline(always)]
    fn align(&mut self, device_force: &Axes<N, S>) -> Axes<N, S> {
        self.calm.align(device_force)
    }

    fn shift(&mut self, by: &Axes<N, S>) {
        self.quick.shift(by);
        self.calm.shift(by);
    }

    fn has_late_velocity(&self) -> bool {
        false
    }

    fn reset(&mut self, position: &Axes<N, S>) {
        self.quick.reset(position);
        self.calm.reset(position);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_signal_comes_from_its_filter() {
        let mut both = DualKalman::<1>::new(1e-3, 1000.0, 10.0, 2.3e-5).unwrap();
        let mut quick = Kalman::<1>::new(1e-3, 1000.0, 2.3e-5).unwrap();
        let mut calm = Kalman::<1>::new(1e-3, 10.0, 2.3e-5).unwrap();
        for n in 0..200 {
            let t = f64::from(n) * 1e-3;
            let position = Axes::from([0.01 * (40.0 * t).sin()]);
            let force = Axes::from([(70.0 * t).cos()]);
            let seen = both.step(&position);
            assert_eq!(seen.velocity, quick.step(&position).velocity);
            assert_eq!(seen.acceleration, calm.step(&position).acceleration);
            assert_eq!(both.align(&force), calm.align(&force));
        }
    }

    #[test]
    fn an_invalid_density_is_named_as_given() {
        for (velocity_jerk_density, jerk_density, name) in
            [(-1.0, 10.0, "velocity_jerk_density"), (10.0, -1.0, "jerk_density"), (1e30, 10.0, "bandwidth")]
        {
            let error = DualKalman::<1>::new(1e-3, velocity_jerk_density, jerk_density, 2.3e-5).unwrap_err();
            assert_eq!(error.name, name);
        }
    }
}
