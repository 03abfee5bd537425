//! Isotropic spring between two orientations.

use nalgebra::{UnitQuaternion, Vector3};
use std::f64::consts::PI;

use super::{CouplingError, mapping::check};

/// Angle in rad up to which the spring is linear; beyond it the torque decreases, to zero at pi.
pub const FULL_SPRING_RAD: f64 = 5.0 * PI / 6.0;

/// Spring with the torque `tau = k phi`, `phi = log(R_s R_m')`, on the master towards the slave, in the base
/// frame; `-tau` on the slave.
///
/// It equals `R_m k log(R_m' R_s)`: the vector `log(R_m' R_s)` of the tool frame, expressed in the base
/// frame. That vector has the same components in the master's and in the slave's tool frame. The torque is
/// minus the gradient of the potential `U = k |phi|² / 2`: `dU/dt = tau·(w_s - w_m)`, so the power of both
/// torques is `-dU/dt`.
///
/// At `|phi| = pi` the shortest rotation changes direction, so k phi would reverse from one tick to the next
/// at its full magnitude `k pi`. A torque of uncertain direction must be zero. So beyond [`FULL_SPRING_RAD`]
/// (a, 150 degrees) `|tau| = k a (pi - |phi|) / (pi - a)`, which is zero at pi. Its potential is
/// `U = k (a² + a (|phi| - a) (1 + (pi - |phi|) / (pi - a))) / 2`.
///
/// Torque and potential are continuous everywhere; `|tau| <= k a`, `U <= k a pi / 2`. No spring on SO(3) can
/// avoid such a point: a smooth potential on SO(3) has at least 4 points without torque.
///
/// Source: Caccavale, Natale, Siciliano and Villani, *Six-DOF impedance control based on angle/axis representations*,
/// IEEE Transactions on Robotics and Automation 15 (2), 1999; Bullo and Murray, *Tracking for fully actuated mechanical
/// systems: a geometric framework*, Automatica 35 (1), 1999 (gradient of the logarithm's norm).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RotationalSpring {
    stiffness: f64,
}

/// Return `tau / k` for phi: phi up to [`FULL_SPRING_RAD`], and shorter beyond, down to 0 at pi.
pub(super) fn faded_phi(phi: &Vector3<f64>) -> Vector3<f64> {
    let angle = phi.norm();
    if angle <= FULL_SPRING_RAD {
        return *phi;
    }
    let left = (PI - angle).max(0.0) / (PI - FULL_SPRING_RAD);
    phi * (FULL_SPRING_RAD * left / angle)
}

impl RotationalSpring {
    /// Build a spring of stiffness k in N m/rad (> 0).
    pub fn new(stiffness: f64) -> Result<Self, CouplingError> {
        Ok(Self { stiffness: check("rotational_stiffness", "k", stiffness)? })
    }

    /// Torque on the master, in N m in the base frame.
    pub fn torque(&self, master: &UnitQuaternion<f64>, slave: &UnitQuaternion<f64>) -> Vector3<f64> {
        faded_phi(&(slave * master.inverse()).scaled_axis()) * self.stiffness
    }

    /// Potential U in J.
    pub fn potential_j(&self, master: &UnitQuaternion<f64>, slave: &UnitQuaternion<f64>) -> f64 {
        let angle = master.rotation_to(slave).angle();
        let full = angle.min(FULL_SPRING_RAD);
        let left = (PI - angle).max(0.0) / (PI - FULL_SPRING_RAD);
        0.5 * self.stiffness * (full * full + FULL_SPRING_RAD * (angle - full) * (1.0 + left))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::coupling::drawn::{direction, orientation, vector};
    use proptest::prelude::*;

    const STIFFNESS: f64 = 2.0;

    fn spring() -> RotationalSpring {
        RotationalSpring::new(STIFFNESS).unwrap()
    }

    fn turned(by: Vector3<f64>, from: &UnitQuaternion<f64>) -> UnitQuaternion<f64> {
        UnitQuaternion::from_scaled_axis(by) * from
    }

    proptest! {
        /// Numerical gradient on SO(3): turn both orientations about each axis of the base.
        #[test]
        fn the_torque_is_the_gradient_of_the_potential(
            (master, axis) in (orientation(), direction()),
            angle in prop_oneof![0.0..2.6f64, 2.63..3.13f64],
        ) {
            let slave = turned(axis.into_inner() * angle, &master);
            let torque = spring().torque(&master, &slave);
            let step = 1e-5;
            for base in 0..3 {
                let by = Vector3::ith(base, step);
                let slope = |plus: f64, minus: f64| (plus - minus) / (2.0 * step);
                let of_master = slope(
                    spring().potential_j(&turned(by, &master), &slave),
                    spring().potential_j(&turned(-by, &master), &slave),
                );
                let of_slave = slope(
                    spring().potential_j(&master, &turned(by, &slave)),
                    spring().potential_j(&master, &turned(-by, &slave)),
                );
                // Rounding: U up to 8 J, with 2 ulp over 2 h, 2e-10. Truncation: h^2 / 6 times the third
                // derivative. Near pi that derivative is k a / ((pi - a) (pi - |phi|)) < 1e3 for |phi| <
                // 3.13, so 2e-8.
                prop_assert!((of_master + torque[base]).abs() < 3e-8, "{of_master} {}", torque[base]);
                prop_assert!((of_slave - torque[base]).abs() < 3e-8);
            }
        }

        #[test]
        fn turning_both_turns_the_torque(
            (master, slave, base, tool) in (orientation(), orientation(), orientation(), orientation()),
        ) {
            let torque = spring().torque(&master, &slave);
            let seen = spring().torque(&(base * master), &(base * slave));
            prop_assume!(master.angle_to(&slave) < 3.1);
            prop_assert!((seen - base * torque).norm() < 1e-13 * STIFFNESS);
            let seen = spring().torque(&(master * tool), &(slave * tool));
            prop_assert!((seen - torque).norm() < 1e-13 * STIFFNESS);
            // The frame in the equation, and action equal to reaction.
            let in_tool = (master.inverse() * slave).scaled_axis();
            if in_tool.norm() < FULL_SPRING_RAD {
                prop_assert!((master * in_tool * STIFFNESS - torque).norm() < 1e-13);
            }
            prop_assert!((spring().torque(&slave, &master) + torque).norm() < 1e-13);
        }

        #[test]
        fn nothing_jumps_at_pi((master, axis, off) in (orientation(), direction(), vector(1e-7))) {
            let [before, after] = [PI - 1e-7, PI + 1e-7]
                .map(|angle| turned(off + axis.into_inner() * angle, &master));
            let [torque, beyond] = [before, after].map(|slave| spring().torque(&master, &slave));
            // Slope of the decreasing part: k a / (pi - a) = 5 k, from at most 3e-7 rad off pi.
            let largest = 5.0 * STIFFNESS * 3e-7;
            prop_assert!(torque.norm() < largest && beyond.norm() < largest);
            let potential = [before, after].map(|slave| spring().potential_j(&master, &slave));
            let at_pi = 0.5 * STIFFNESS * FULL_SPRING_RAD * PI;
            prop_assert!(potential.iter().all(|seen| (seen - at_pi).abs() < largest * 3e-7 + 1e-14));
        }
    }

    #[test]
    fn torque_and_potential_are_continuous_and_bounded_from_0_to_pi() {
        let master = UnitQuaternion::from_scaled_axis(Vector3::new(0.3, -1.0, 0.2));
        let axis = Vector3::new(0.0, 0.6, -0.8);
        let (mut last, mut energy, steps) = (0.0, 0.0, 31_416_u32);
        for step in 0..=steps {
            let angle = PI * f64::from(step) / f64::from(steps);
            let slave = turned(axis * angle, &master);
            let torque = spring().torque(&master, &slave);
            let along = torque.dot(&axis);
            assert!(torque.cross(&axis).norm() < 1e-13 && along > -1e-14);
            assert!(along < STIFFNESS * FULL_SPRING_RAD * (1.0 + 1e-14));
            // 1e-4 rad at the steepest slope, 5 k.
            assert!((along - last).abs() < 5.0 * STIFFNESS * 1.01e-4);
            if step > 0 {
                energy += 0.5 * (along + last) * PI / f64::from(steps);
            }
            last = along;
            // Trapezoids are exact except for the one with the corner: slope change 6 k, at most (1e-4)^2 /
            // 8 of it.
            assert!((spring().potential_j(&master, &slave) - energy).abs() < 6.0 * STIFFNESS * 1e-8 / 8.0);
        }
        assert!(last < 1e-14, "the torque is zero at pi");
    }

    /// Closed form of a body of inertia I on the spring: `phi(t) = phi_0 cos(sqrt(k / I) t)` about a fixed
    /// axis.
    #[test]
    fn a_body_on_the_spring_swings_as_its_closed_form() {
        let (inertia, step, ticks) = (0.02, 1e-4, 10_000_u32);
        let axis = Vector3::new(0.48, 0.6, -0.64);
        let (mut body, mut velocity) = (UnitQuaternion::from_scaled_axis(axis * 2.0), Vector3::zeros());
        let base = UnitQuaternion::identity();
        // Leapfrog: half a kick, drift, half a kick.
        for _ in 0..ticks {
            velocity += spring().torque(&body, &base) * (0.5 * step / inertia);
            body = turned(velocity * step, &body);
            velocity += spring().torque(&body, &base) * (0.5 * step / inertia);
        }
        let rate = (STIFFNESS / inertia).sqrt();
        let expected = 2.0 * (rate * step * f64::from(ticks)).cos();
        // The leapfrog's period is short by (w h)^2 / 24: 4e-8 of 10 rad of phase, times 2 rad of amplitude.
        let seen = body.scaled_axis();
        assert!((seen - axis * expected).norm() < 1e-6, "{seen} must be {expected} along {axis}");
    }

    #[test]
    fn a_spring_without_stiffness_is_refused() {
        for stiffness in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            let error = RotationalSpring::new(stiffness).unwrap_err().to_string();
            assert!(error.starts_with("rotational_stiffness (k) = "), "{error}");
        }
    }
}
