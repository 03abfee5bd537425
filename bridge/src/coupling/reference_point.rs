//! Reference point of a coupled tool, if that is not the tool point.

use haptether_safety::Axes;
use nalgebra::{UnitQuaternion, Vector3};

use super::{Twist, Wrench};
use crate::endpoint::{SlaveReading, SlaveTick};

/// Largest distance in m from the tool point.
const MAX_M: f64 = 10.0;

/// Point of the tool, at r in m from the tool point in the tool's frame. Position, velocity and torque refer
/// to it, `p = x + R r`; the arm gets the command of the tool point, `x = p - R r`.
///
/// Source: Murray, Li and Sastry 1994, sections 2.4.2 and 2.5.1, adjoint of a translation, as [`Twist::shifted`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ReferencePoint(Vector3<f64>);

/// Reference point too far from the tool point, or not finite.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[error("reference_point = {0:?} m: must be within 10 m of the tool point")]
pub struct ReferencePointError(pub [f64; 3]);

fn vector<const N: usize>(of: &Axes<N>) -> Vector3<f64> {
    Vector3::from_fn(|axis, _| if axis < N { of[axis] } else { 0.0 })
}

fn axes<const N: usize>(of: &Vector3<f64>) -> Axes<N> {
    Axes::from_fn(|axis, _| if axis < 3 { of[axis] } else { 0.0 })
}

impl ReferencePoint {
    /// Build the point at `from_tool` in m, in the tool's frame.
    pub fn new(from_tool: [f64; 3]) -> Result<Self, ReferencePointError> {
        let by = Vector3::from(from_tool);
        if by.norm() <= MAX_M { Ok(Self(by)) } else { Err(ReferencePointError(from_tool)) }
    }

    /// Shift an arm's measurement to the point. A reading without a rotation stays as it is.
    #[must_use]
    pub fn measured<const N: usize>(&self, reading: &SlaveReading<N>) -> SlaveReading<N> {
        let Some(mut rotation) = reading.rotation else { return *reading };
        let by = rotation.orientation * self.0;
        if !by.iter().all(|number| number.is_finite()) {
            // The orientation is invalid, and the position must not become so.
            return *reading;
        }
        let angular_velocity = rotation.angular_velocity;
        let twist = Twist { velocity: vector(&reading.velocity), angular_velocity }.shifted(&by);
        let force = vector(&reading.environment_force);
        rotation.torque = Wrench { force, torque: rotation.torque }.shifted(&by).torque;
        SlaveReading {
            position: reading.position + axes(&by),
            velocity: axes(&twist.velocity),
            rotation: Some(rotation),
            ..*reading
        }
    }

    /// Position and velocity of the tool point for a command of this point; `None` without a command or an
    /// orientation.
    #[must_use]
    pub fn commanded<const N: usize>(&self, tick: &SlaveTick<N>) -> Option<[Axes<N>; 2]> {
        let by = tick.orientation? * self.0;
        let angular_velocity = tick.angular_velocity;
        let twist = Twist { velocity: vector(&tick.command_velocity), angular_velocity }.shifted(&-by);
        Some([tick.command? - axes(&by), axes(&twist.velocity)])
    }

    /// Force in N and torque in N m about the tool point, of a wrench about this point; unchanged without an orientation.
    #[must_use]
    pub fn exerted<const N: usize>(
        &self,
        (force, torque): (Axes<N>, Axes<3>),
        orientation: Option<&UnitQuaternion<f64>>,
    ) -> (Axes<N>, Axes<3>) {
        let Some(orientation) = orientation else { return (force, torque) };
        let wrench = Wrench { force: vector(&force), torque }.shifted(&-(orientation * self.0));
        (force, wrench.torque)
    }

    /// Position of the point in m, for a tool at `position`.
    #[must_use]
    pub fn of_tool<const N: usize>(&self, position: &Axes<N>, orientation: &UnitQuaternion<f64>) -> Axes<N> {
        position + axes(&(orientation * self.0))
    }

    /// Largest speed of the point in m/s, and angular speed in rad/s, for a tool with these speeds.
    pub(crate) fn speeds(&self, [speed, angular_speed]: [f64; 2]) -> [f64; 2] {
        [speed + self.0.norm() * angular_speed, angular_speed]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        coupling::{
            Limited, RotationState,
            drawn::{orientation, vector as drawn},
        },
        ladder::LadderState,
    };
    use proptest::prelude::*;

    /// Rounding bound: sums of up to 9 terms, each a product of factors up to 10, 10 and 2, one ulp per
    /// operation.
    const ROUNDING: f64 = 1800.0 * 18.0 * f64::EPSILON;

    proptest! {
        /// `f·v + tau·w` equals that of the tool point for every twist, and a command at the present position
        /// keeps the arm there.
        #[test]
        fn a_shift_keeps_the_power_and_a_command_brings_the_tool_back(
            (position, velocity, force) in (drawn(10.0), drawn(10.0), drawn(10.0)),
            (turned, angular_velocity, torque, by) in (orientation(), drawn(10.0), drawn(10.0), drawn(2.0)),
        ) {
            let point = ReferencePoint::new(by.into()).unwrap();
            let rotation = Some(RotationState { orientation: turned, angular_velocity, torque });
            let tool = SlaveReading::<3> { position, velocity, environment_force: force, rotation };
            let seen = point.measured(&tool);
            let power = |of: &SlaveReading<3>| {
                let rotation = of.rotation.unwrap();
                of.environment_force.dot(&of.velocity) + rotation.torque.dot(&rotation.angular_velocity)
            };
            prop_assert!((power(&seen) - power(&tool)).abs() < ROUNDING);
            prop_assert!((seen.position - position - turned * by).norm() < ROUNDING);
            prop_assert_eq!(seen.position, point.of_tool(&position, &turned));
            let tick = SlaveTick {
                command: Some(seen.position),
                command_velocity: seen.velocity,
                orientation: Some(turned),
                angular_velocity,
                exerted: None,
                is_led: true,
                state: LadderState::Engaged,
                age_ns: None,
                limited: Limited::default(),
                fault: None,
            };
            let (_, at_tool) = point.exerted((seen.environment_force, seen.rotation.unwrap().torque), Some(&turned));
            prop_assert!((at_tool - torque).norm() < ROUNDING);
            let [command, command_velocity] = point.commanded(&tick).unwrap();
            prop_assert!((command - position).norm() < ROUNDING && (command_velocity - velocity).norm() < ROUNDING);
        }
    }

    /// A force of 5 N along y at the tip of a tool of 0.2 m along x has no moment about the tip.
    #[test]
    fn a_force_at_the_point_has_no_moment_about_it() {
        let point = ReferencePoint::new([0.2, 0.0, 0.0]).unwrap();
        let rotation = RotationState {
            orientation: UnitQuaternion::identity(),
            angular_velocity: Vector3::new(0.0, 0.0, 3.0),
            torque: Vector3::new(0.0, 0.0, 1.0),
        };
        let mut tool =
            SlaveReading::<3>::point([Axes::zeros(), Axes::zeros(), Axes::<3>::new(0.0, 5.0, 0.0)]);
        assert_eq!(point.measured(&tool), tool, "a reading without a rotation is not shifted");
        tool.rotation = Some(rotation);
        let seen = point.measured(&tool);
        assert_eq!(seen.rotation.unwrap().torque, Vector3::zeros());
        assert_eq!(seen.velocity, Axes::<3>::new(0.0, 3.0 * 0.2, 0.0));
        assert_eq!(point.speeds([0.5, 3.0]), [0.5 + 0.2 * 3.0, 3.0]);
    }

    #[test]
    fn invalid_points_are_refused() {
        for bad in [[f64::NAN, 0.0, 0.0], [10.1, 0.0, 0.0], [0.0, f64::INFINITY, 0.0]] {
            let error = ReferencePoint::new(bad).unwrap_err().to_string();
            assert!(error.starts_with("reference_point = ") && error.contains("within 10 m"), "{error}");
        }
    }
}
