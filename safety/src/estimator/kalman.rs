//! Steady-state Kalman filter for a device with white-noise jerk.

use std::cell::Cell;

use nalgebra::{Matrix3, Vector3};

use super::{Estimator, Motion};
use crate::parameter::{ParameterError, in_range, positive};
use crate::{About, Axes, Real};
use haptether_numeric::{option, pack, shared, without_residue};

/// Kalman filter of the state (x, v, a) with white jerk of spectral density q in m²/s⁵.
///
/// The position is rounded to a quantum, which counts as noise of variance R = quantum² / 12:
///
/// x⁻ = x + v dT + a dT²/2, v⁻ = v + a dT, a⁻ = a, then each + K (measured - x⁻).
///
/// K is the **steady-state** gain. `new` iterates the Riccati recursion for it, so the filter is linear and
/// time-invariant from the first tick. K depends only on `omega` dT with `omega`⁶ = q / (R dT). For slow filters the
/// error poles form a Butterworth pattern of radius `omega` in rad/s, the bandwidth of the estimate, and K dT^(0, 1,
/// 2) = (2 `omega` dT, 2 (`omega` dT)², (`omega` dT)³).
///
/// **Alignment.** Run the filter on a unit mass under the force f\[n\], held over the tick that ends at n. Let `e_x`
/// be x minus its estimate, `e_v` v minus its estimate, and a the estimate of the acceleration:
///
/// `e_x`⁻ = `e_x` + `e_v` dT + (f - a) dT²/2, `e_v`⁻ = `e_v` + (f - a) dT,
/// `e_x` = (1 - `K_x`) `e_x`⁻, `e_v` = `e_v`⁻ - `K_v` `e_x`⁻, a = a + `K_a` `e_x`⁻.
///
/// Neither position nor velocity of that mass appears, so a lasting force makes no term grow without bound. a is the
/// force filtered by exactly the kernel of A.
///
/// Source: Bar-Shalom, Li & Kirubarajan 2001, "Estimation with Applications to Tracking and Navigation", section
/// 6.2.3 (continuous Wiener-process acceleration model, discretised); alignment derived above.
#[derive(Clone, Debug)]
pub struct Kalman<const N: usize, S = f64> {
    period_s: f64,
    /// K in ticks: position per position, per tick, per tick².
    gain: Vector3<S>,
    /// None before the first position.
    position: Option<Axes<N, S>>,
    /// m per tick.
    velocity: Axes<N, S>,
    /// m per tick².
    acceleration: Axes<N, S>,
    force_position_error: Axes<N, S>,
    force_velocity_error: Axes<N, S>,
    aligned_force: Axes<N, S>,
}

impl<const N: usize> Kalman<N> {
    /// Name, title and source.
    pub const ABOUT: About = About {
        name: "kalman",
        title: "Kalman filter under white jerk",
        source: "Bar-Shalom, Li and Kirubarajan 2001, section 6.2.3",
    };

    /// Create an estimator for positions rounded to `quantum_m` and sampled every `period_s`; `jerk_density` is q in
    /// m²/s⁵.
    ///
    /// `omega` dT must lie within 0.001 and 10. Below, the filter would need thousands of ticks to respond; above, it
    /// is a second difference.
    pub fn new(period_s: f64, jerk_density: f64, quantum_m: f64) -> Result<Self, ParameterError> {
        positive("period_s", "dT", period_s)?;
        positive("jerk_density", "q", jerk_density)?;
        positive("quantum_m", "quantum", quantum_m)?;
        let bandwidth = (12.0 * jerk_density * period_s.powi(5)).powf(1.0 / 6.0) / quantum_m.cbrt();
        let allowed = "0.001 to 10, where omega^6 = 12 jerk_density / (quantum_m^2 period_s)";
        in_range("bandwidth", "omega dT", bandwidth, 1e-3, 10.0, allowed)?;
        Ok(Self {
            period_s,
            gain: steady_gain(bandwidth),
            position: None,
            velocity: Axes::zeros(),
            acceleration: Axes::zeros(),
            force_position_error: Axes::zeros(),
            force_velocity_error: Axes::zeros(),
            aligned_force: Axes::zeros(),
        })
    }
}

impl<const N: usize, S: Real> Estimator<N, S> for Kalman<N, S> {
    type One = Kalman<N>;

    /// Gather estimators of one period, all before their first position or all after it.
    fn gather(of: &[&Kalman<N>]) -> Option<Self> {
        Some(Self {
            period_s: shared(of, |one| one.period_s)?,
            gain: pack(of, |one| one.gain)?,
            position: option(of, |one| one.position.as_ref(), |them| pack(them, |at| **at))?,
            velocity: pack(of, |one| one.velocity)?,
            acceleration: pack(of, |one| one.acceleration)?,
            force_position_error: pack(of, |one| one.force_position_error)?,
            force_velocity_error: pack(of, |one| one.force_velocity_error)?,
            aligned_force: pack(of, |one| one.aligned_force)?,
        })
    }

    #[inline(always)]
    fn step(&mut self, position: &Axes<N, S>) -> Motion<N, S> {
        let [k_x, k_v, k_a] = self.gain.into();
        let last = self.position.unwrap_or(*position);
        let predicted = last + self.velocity + self.acceleration / S::splat(2.0);
        let innovation = without_residue(position - predicted);
        self.position = Some(predicted + innovation * k_x);
        self.velocity += self.acceleration + innovation * k_v;
        self.acceleration += innovation * k_a;
        Motion {
            velocity: self.velocity / S::splat(self.period_s),
            acceleration: self.acceleration / S::splat(self.period_s * self.period_s),
        }
    }

    #[inline(always)]
    fn align(&mut self, device_force: &Axes<N, S>) -> Axes<N, S> {
        let [k_x, k_v, k_a] = self.gain.into();
        let unseen = device_force - self.aligned_force;
        let innovation =
            without_residue(self.force_position_error + self.force_velocity_error + unseen / S::splat(2.0));
        self.force_position_error = innovation * (S::splat(1.0) - k_x);
        self.force_velocity_error += unseen - innovation * k_v;
        self.aligned_force += innovation * k_a;
        self.aligned_force
    }

    fn shift(&mut self, by: &Axes<N, S>) {
        if let Some(position) = &mut self.position {
            *position += by;
        }
    }

    fn has_late_velocity(&self) -> bool {
        false
    }

    fn reset(&mut self, position: &Axes<N, S>) {
        self.position = Some(*position);
        self.velocity = Axes::zeros();
        self.acceleration = Axes::zeros();
        self.force_position_error = Axes::zeros();
        self.force_velocity_error = Axes::zeros();
        self.aligned_force = Axes::zeros();
    }
}

/// Bandwidths and their gains, newest first; enough for two filters each of translation and rotation.
type Gains = [Option<(f64, Vector3<f64>)>; 4];

thread_local! {
    /// Cache of this thread, since the scenarios of a sweep need the same gains.
    static LAST_GAINS: Cell<Gains> = const { Cell::new([None; 4]) };
}

/// Return K for dT = 1 and R = 1, which depends only on q = (`omega` dT)⁶.
fn steady_gain(bandwidth: f64) -> Vector3<f64> {
    let mut last = LAST_GAINS.get();
    if let Some((_, gain)) = last.iter().flatten().find(|(of, _)| of.to_bits() == bandwidth.to_bits()) {
        return *gain;
    }
    let gain = converged_gain(bandwidth);
    last.rotate_right(1);
    last[0] = Some((bandwidth, gain));
    LAST_GAINS.set(last);
    gain
}

/// Compute K by iteration.
fn converged_gain(bandwidth: f64) -> Vector3<f64> {
    let mut covariance = Matrix3::identity();
    let mut gain = Vector3::zeros();
    // The slowest error pole is exp(-bandwidth / 2), and the covariance converges with its square. This number of
    // steps brings any start down to rounding.
    let mut left = 100.0 + 40.0 / bandwidth;
    while left > 0.0 {
        (covariance, gain) = riccati_step(&covariance, bandwidth);
        left -= 1.0;
    }
    gain
}

/// Predict and correct the covariance once; return it with the gain of the correction.
fn riccati_step(covariance: &Matrix3<f64>, bandwidth: f64) -> (Matrix3<f64>, Vector3<f64>) {
    let transition = Matrix3::new(1.0, 1.0, 0.5, 0.0, 1.0, 1.0, 0.0, 0.0, 1.0);
    let process_noise = white_jerk_noise() * bandwidth.powi(6);
    let predicted = transition * covariance * transition.transpose() + process_noise;
    let gain = predicted.column(0) / (predicted[(0, 0)] + 1.0);
    let mut keep = Matrix3::identity();
    keep.column_mut(0).axpy(-1.0, &gain, 1.0);
    // Joseph's form stays symmetric and positive over tens of thousands of steps.
    let corrected = keep * predicted * keep.transpose() + gain * gain.transpose();
    (corrected, gain)
}

/// Return the covariance that white jerk of unit density adds to (x, v, a) in one tick.
#[rustfmt::skip]
fn white_jerk_noise() -> Matrix3<f64> {
    Matrix3::new(
        1.0 / 20.0, 1.0 / 8.0, 1.0 / 6.0,
        1.0 / 8.0,  1.0 / 3.0, 1.0 / 2.0,
        1.0 / 6.0,  1.0 / 2.0, 1.0,
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn process_noise_is_the_integral_over_the_impulse_responses_of_jerk() {
        let parts = 1000;
        let mut sum = Matrix3::zeros();
        for part in 0..parts {
            let age = (f64::from(part) + 0.5) / f64::from(parts);
            let response = Vector3::new(age * age / 2.0, age, 1.0);
            sum += response * response.transpose() / f64::from(parts);
        }
        // The midpoint rule errs by at most max|f''| / 24 parts², and |f''| is at most 3.
        assert!((sum - white_jerk_noise()).amax() < 3.0 / 24.0 / 1e6);
    }

    #[test]
    fn the_gain_is_a_fixed_point_of_the_riccati_recursion() {
        for bandwidth in [1e-3, 0.03, 0.3, 1.0, 10.0] {
            let mut covariance = Matrix3::identity() * 0.5;
            let mut gain = Vector3::zeros();
            for _ in 0..200_000 {
                (covariance, gain) = riccati_step(&covariance, bandwidth);
            }
            let found = converged_gain(bandwidth);
            for axis in 0..3 {
                // The rounding of a step, 1e-16, persists for 1/bandwidth steps.
                let tolerance = 1e-14 + 1e-15 / bandwidth;
                assert!((found[axis] / gain[axis] - 1.0).abs() < tolerance, "{bandwidth} {axis}");
            }
        }
    }

    #[test]
    fn cached_gains_match_their_bandwidths() {
        let known = |bandwidth: f64| LAST_GAINS.get().iter().flatten().any(|(of, _)| *of == bandwidth);
        for bandwidth in [0.3, 0.1, 0.3, 0.3, 0.1, 0.2, 0.5, 0.7, 0.3, 0.1, 0.9] {
            assert_eq!(steady_gain(bandwidth), converged_gain(bandwidth), "{bandwidth}");
            assert!(known(bandwidth), "{bandwidth}");
        }
        // The cache keeps four: 0.9, 0.1, 0.3 and 0.7.
        assert_eq!([0.9, 0.1, 0.3, 0.7, 0.5, 0.2].map(known), [true, true, true, true, false, false]);
    }

    #[test]
    fn a_slow_filter_has_butterworth_poles() {
        let bandwidth: f64 = 1e-3;
        let gain = steady_gain(bandwidth);
        for (found, expected) in
            gain.iter().zip([2.0 * bandwidth, 2.0 * bandwidth.powi(2), bandwidth.powi(3)])
        {
            // Sampling adds relative terms of the order of the bandwidth.
            assert!((found / expected - 1.0).abs() < 3.0 * bandwidth, "{found} {expected}");
        }
    }

    #[test]
    fn a_parabola_is_followed_without_error() {
        let period_s = 1e-3;
        let mut estimator = Kalman::<1>::new(period_s, 10.0, 2.3e-5).unwrap();
        let bandwidth = (12.0 * 10.0 / (2.3e-5_f64.powi(2) * period_s)).powf(1.0 / 6.0);
        // The start looks like a jump of v by 0.3 m/s; its remainder after t is exp(-omega t / 2).
        let settled = (2.0 * 40.0 / (bandwidth * period_s)).ceil();
        let mut n = 0.0;
        while n < settled + 100.0 {
            let t = n * period_s;
            let motion = estimator.step(&Axes::from([0.1 + 0.3 * t - 2.0 * t * t]));
            if n > settled {
                // Within 1 m, a position rounds to 1e-16 m; the gain passes less than 1/dT² of it to A.
                assert!((motion.acceleration[0] + 4.0).abs() < 1e-9);
                assert!((motion.velocity[0] - (0.3 - 4.0 * t)).abs() < 1e-12);
            }
            n += 1.0;
        }
    }

    #[test]
    fn parameters_without_a_valid_filter_are_refused() {
        assert!(Kalman::<1>::new(1e-3, -1.0, 2.3e-5).is_err());
        assert!(Kalman::<1>::new(1e-3, 1.0, 0.0).is_err());
        assert_eq!(Kalman::<1>::new(1e-3, 1e-30, 1.0).unwrap_err().name, "bandwidth");
        assert_eq!(Kalman::<1>::new(1e-3, 1e30, 1e-9).unwrap_err().name, "bandwidth");
    }
}
