//! Twist and wrench of a rigid body, and the shift of their reference point.

use nalgebra::Vector3;

/// Twist of a rigid body: velocity of the reference point in m/s and angular velocity in rad/s, both in one
/// frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Twist {
    /// Velocity v of the reference point.
    pub velocity: Vector3<f64>,
    /// Angular velocity w of the body.
    pub angular_velocity: Vector3<f64>,
}

/// Wrench: force in N and moment in N m about the reference point, both in one frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Wrench {
    /// Force f.
    pub force: Vector3<f64>,
    /// Moment tau about the reference point.
    pub torque: Vector3<f64>,
}

impl Twist {
    /// Twist of the point of the same body at `by` (m) from the reference point: `v' = v + w x r`, `w' = w`.
    ///
    /// Source: Murray, Li and Sastry, *A mathematical introduction to robotic manipulation*, 1994, section 2.4.2,
    /// adjoint of a translation.
    #[must_use]
    pub fn shifted(&self, by: &Vector3<f64>) -> Self {
        Self { velocity: self.velocity + self.angular_velocity.cross(by), ..*self }
    }
}

impl Wrench {
    /// Same wrench about the point at `by` (m) from the reference point: `tau' = tau - r x f`, `f' = f`.
    ///
    /// The sign follows from the power: `f·(v + w x r) + tau'·w = f·v + tau·w` for every twist.
    ///
    /// Source: Murray, Li and Sastry 1994, section 2.5.1, transpose of the adjoint.
    #[must_use]
    pub fn shifted(&self, by: &Vector3<f64>) -> Self {
        Self { torque: self.torque - by.cross(&self.force), ..*self }
    }

    /// Power `P = f·v + tau·w` in W, with a twist about the same point and in the same frame.
    pub fn power(&self, twist: &Twist) -> f64 {
        self.force.dot(&twist.velocity) + self.torque.dot(&twist.angular_velocity)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::coupling::drawn::{direction, orientation, vector};
    use nalgebra::UnitQuaternion;
    use proptest::prelude::*;

    /// Products of numbers up to 10 with 10 and 2, summed over 6 terms: at most 1200, with one ulp each.
    const ROUNDING: f64 = 1200.0 * 12.0 * f64::EPSILON;

    proptest! {
        #[test]
        fn shift_keeps_the_power_and_is_reversible(
            (velocity, angular_velocity) in (vector(10.0), vector(10.0)),
            (force, torque, by) in (vector(10.0), vector(10.0), vector(2.0)),
        ) {
            let (twist, wrench) = (Twist { velocity, angular_velocity }, Wrench { force, torque });
            let there = wrench.shifted(&by).power(&twist.shifted(&by));
            prop_assert!((there - wrench.power(&twist)).abs() < ROUNDING);
            let back = wrench.shifted(&by).shifted(&-by);
            prop_assert!((back.torque - torque).norm() < ROUNDING && back.force == force);
            let back = twist.shifted(&by).shifted(&-by);
            prop_assert!((back.velocity - velocity).norm() < ROUNDING);
            prop_assert!(back.angular_velocity == angular_velocity);
        }

        /// Numerical derivative of a point on a screw: `x(t) = q + exp(w t) (x - q) + h w t`, of pitch h
        /// about a line through q (Murray, Li and Sastry 1994, section 2.3.3). Its twist about q is (h w, w).
        #[test]
        fn point_of_a_screw_moves_with_its_shifted_twist(
            (axis, through, by) in (direction(), vector(1.0), vector(1.0)),
            (pitch, speed) in (-0.5..0.5f64, -3.0..3.0f64),
        ) {
            let angular_velocity = axis.into_inner() * speed;
            let at = |time: f64| {
                through + UnitQuaternion::from_scaled_axis(angular_velocity * time) * by
                    + angular_velocity * (pitch * time)
            };
            let twist = Twist { velocity: angular_velocity * pitch, angular_velocity }.shifted(&by);
            let step = 1e-5;
            let seen = (at(step) - at(-step)) / (2.0 * step);
            // Truncation: h^2 / 6 |w|^3 |r|, at most 8e-10; rounding: 4 eps / h, 9e-11.
            prop_assert!((seen - twist.velocity).norm() < 1e-9);
        }

        /// A pure force at a point has a moment about any other point: `tau = (q - p) x f`.
        #[test]
        fn a_force_at_the_end_of_a_long_tool_has_its_moment(
            (force, by, turn) in (vector(10.0), vector(2.0), orientation()),
        ) {
            let at_end = Wrench { force, torque: Vector3::zeros() };
            let at_handle = at_end.shifted(&-by);
            prop_assert!((at_handle.torque - by.cross(&force)).norm() < ROUNDING);
            // In a turned frame the moment is the turned one.
            let turned = Wrench { force: turn * force, torque: Vector3::zeros() }.shifted(&-(turn * by));
            prop_assert!((turned.torque - turn * at_handle.torque).norm() < ROUNDING);
        }
    }

    #[test]
    fn a_force_along_y_at_a_tool_along_x_turns_about_z() {
        let at_tip = Wrench { force: Vector3::new(0.0, 5.0, 0.0), torque: Vector3::zeros() };
        let tip = Vector3::new(0.2, 0.0, 0.0);
        assert_eq!(at_tip.shifted(&-tip).torque, Vector3::new(0.0, 0.0, 1.0));
        let turning = Twist { velocity: Vector3::zeros(), angular_velocity: Vector3::new(0.0, 0.0, 3.0) };
        assert_eq!(turning.shifted(&tip).velocity, Vector3::new(0.0, 3.0 * 0.2, 0.0));
    }
}
