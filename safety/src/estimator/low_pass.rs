//! Backward difference with a first-order low-pass, the usual choice in haptic loops.

use std::f64::consts::TAU;

use super::{BackwardDifference, Estimator, Motion};
use crate::parameter::{ParameterError, in_range, positive};
use crate::{About, Axes, Real};
use haptether_numeric::{pack, part, shared, without_residue};

/// First-order low-pass of cut-off `f_c` on the backward difference D\[n\] = (x\[n\] - x\[n-1\]) / dT:
///
/// V\[n\] = V\[n-1\] + beta (D\[n\] - V\[n-1\]), beta = 1 - exp(-2 pi `f_c` dT), A\[n\] = (V\[n\] - V\[n-1\]) / dT.
///
/// This beta maps the continuous pole s = -2 pi `f_c` to its value over one period. At the samples, the step response
/// then equals that of the continuous filter. A is not filtered again: it already is the same low-pass of the second
/// difference, and A sums up to V. Its kernel on the true acceleration is the two-tick mean of [`BackwardDifference`]
/// followed by the low-pass; `align` applies this kernel. A lags by (1/beta) dT.
///
/// Source: pole matching, Franklin, Powell & Workman 1998, "Digital Control of Dynamic Systems", section 6.2.
#[derive(Clone, Debug)]
pub struct LowPass<const N: usize, S = f64> {
    period_s: f64,
    /// beta.
    share: S,
    difference: BackwardDifference<N, S>,
    velocity: Axes<N, S>,
    aligned_force: Axes<N, S>,
}

impl<const N: usize> LowPass<N> {
    /// Name, title and source.
    pub const ABOUT: About = About {
        name: "low-pass",
        title: "first-order low-pass on the difference",
        source: "Franklin, Powell and Workman 1998, section 6.2",
    };

    /// Create an estimator for positions sampled every `period_s`, with a cut-off of at most half the sample rate.
    pub fn new(period_s: f64, cutoff_hz: f64) -> Result<Self, ParameterError> {
        let difference = BackwardDifference::new(period_s)?;
        positive("cutoff_hz", "f_c", cutoff_hz)?;
        let nyquist_hz = 0.5 / period_s;
        let allowed = "at most half the sample rate";
        in_range("cutoff_hz", "f_c", cutoff_hz, 0.0, nyquist_hz, allowed)?;
        Ok(Self {
            period_s,
            // exp_m1 keeps the precision of a cut-off far below the sample rate.
            share: -(-TAU * cutoff_hz * period_s).exp_m1(),
            difference,
            velocity: Axes::zeros(),
            aligned_force: Axes::zeros(),
        })
    }
}

impl<const N: usize, S: Real> Estimator<N, S> for LowPass<N, S> {
    type One = LowPass<N>;

    /// Gather estimators of one period.
    fn gather(of: &[&LowPass<N>]) -> Option<Self> {
        Some(Self {
            period_s: shared(of, |one| one.period_s)?,
            share: pack(of, |one| one.share)?,
            difference: part(of, |one| &one.difference, BackwardDifference::gather)?,
            velocity: pack(of, |one| one.velocity)?,
            aligned_force: pack(of, |one| one.aligned_force)?,
        })
    }

    #[inline(always)]
    fn step(&mut self, position: &Axes<N, S>) -> Motion<N, S> {
        let difference = self.difference.step(position).velocity;
        let change = without_residue(difference - self.velocity) * self.share;
        self.velocity += change;
        Motion { velocity: self.velocity, acceleration: change / S::splat(self.period_s) }
    }

    #[inline(always)]
    fn align(&mut self, device_force: &Axes<N, S>) -> Axes<N, S> {
        let mean = self.difference.align(device_force);
        self.aligned_force += without_residue(mean - self.aligned_force) * self.share;
        self.aligned_force
    }

    fn shift(&mut self, by: &Axes<N, S>) {
        self.difference.shift(by);
    }

    fn has_late_velocity(&self) -> bool {
        true
    }

    fn reset(&mut self, position: &Axes<N, S>) {
        self.difference.reset(position);
        self.velocity = Axes::zeros();
        self.aligned_force = Axes::zeros();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_step_response_is_that_of_the_continuous_filter() {
        let (period_s, cutoff_hz, speed) = (1e-3, 20.0, 0.25);
        let mut estimator = LowPass::<1>::new(period_s, cutoff_hz).unwrap();
        estimator.step(&Axes::from([0.0]));
        for n in 1..=200 {
            let time_s = f64::from(n) * period_s;
            let motion = estimator.step(&Axes::from([speed * time_s]));
            let expected = speed * (1.0 - (-TAU * cutoff_hz * time_s).exp());
            // A position of at most 0.05 m rounds to 1e-17 m, which is 1e-14 m/s after the difference.
            assert!((motion.velocity[0] - expected).abs() < 1e-13, "tick {n}");
        }
    }

    #[test]
    fn the_cutoff_is_between_zero_and_half_the_sample_rate() {
        assert!(LowPass::<1>::new(1e-3, 500.0).is_ok());
        for cutoff_hz in [0.0, -1.0, 501.0, f64::NAN, f64::INFINITY] {
            let refused = LowPass::<1>::new(1e-3, cutoff_hz).unwrap_err();
            assert_eq!(refused.name, "cutoff_hz");
        }
    }
}
