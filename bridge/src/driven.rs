//! Plants of drivers outside of this crate: their samples and orders.
//!
//! The loop of such a driver is `read -> tick -> write -> wait`. It stores its sample here before the tick, and takes
//! force or order afterwards.

use haptether_safety::Axes;
use nalgebra::{Unit, UnitQuaternion};

use crate::{
    coupling::RotationState,
    plant::{SlavePlant, ToolMotion},
};

/// Order to an arm's driver.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum SlaveOrder<const N: usize> {
    /// Do nothing yet: no master has engaged.
    Wait,
    /// Take the tool to `position` in m, which moves with `velocity` in m/s.
    Move {
        /// Position in m.
        position: Axes<N>,
        /// Velocity in m/s.
        velocity: Axes<N>,
        /// Orientation of the tool, and its angular velocity in rad/s; `None` if the tool is led as a point.
        rotation: Option<(UnitQuaternion<f64>, Axes<3>)>,
    },
    /// Exert a force on the tool.
    Exert {
        /// Force in N.
        force: Axes<N>,
        /// Torque in N m about the tool point; `None` if the tool is led as a point.
        torque: Option<Axes<3>>,
        /// Accepted motion of the tool, from which it brakes once it is no longer led.
        motion: ToolMotion<N>,
    },
    /// Stop softly and stay.
    Stop,
}

/// Deceleration of the rotation of an arm no longer led, in rad/s^2.
const ANGULAR_DECELERATION: f64 = 25.0;

/// Invalid deceleration.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[error("deceleration = {0}: must be above 0 and at most 100 m/s^2")]
pub struct DrivenSlaveError(pub f64);

/// Path to rest of an arm no longer led: straight, with constant deceleration.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Braking<const N: usize> {
    from: Axes<N>,
    velocity: Axes<N>,
    begun_ns: u64,
    rest: Axes<N>,
    rotation: Option<TurnBraking>,
}

/// The same for its rotation, about one axis.
#[derive(Clone, Copy, Debug, PartialEq)]
struct TurnBraking {
    from: UnitQuaternion<f64>,
    velocity: Axes<3>,
    rest: UnitQuaternion<f64>,
}

/// State t in s after a constant deceleration from `speed` began: distance as a time at the initial velocity, and
/// remaining share of the speed. `None` at rest.
fn braked(speed: f64, deceleration: f64, t: f64) -> Option<(f64, f64)> {
    let left = speed - deceleration * t;
    // x = v t - a t^2 / 2 along v.
    (left > 0.0).then(|| (t - 0.5 * deceleration * t * t / speed, left / speed))
}

/// Rotates `from` by a rotation vector in the base frame.
fn turned(by: Axes<3>, from: &UnitQuaternion<f64>) -> UnitQuaternion<f64> {
    Unit::new_normalize((UnitQuaternion::from_scaled_axis(by) * from).into_inner())
}

/// An arm whose driver is elsewhere.
///
/// When no longer led it brakes at `deceleration`. Commands are added to the braking motion, so that position and
/// velocity do not jump. A stop is left to the driver.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DrivenSlave<const N: usize> {
    /// Measured position in m, velocity in m/s and `F_e` in N.
    pub sample: [Axes<N>; 3],
    order: SlaveOrder<N>,
    /// Measured orientation, angular velocity and torque, if the arm is led as a pose.
    pub rotation: Option<RotationState>,
    /// In m/s^2.
    deceleration: f64,
    turn: Option<(UnitQuaternion<f64>, Axes<3>)>,
    braking: Option<Braking<N>>,
    now_ns: u64,
}

impl<const N: usize> DrivenSlave<N> {
    /// Create an arm that brakes at `deceleration` in m/s^2.
    pub fn new(deceleration: f64) -> Result<Self, DrivenSlaveError> {
        if !(deceleration > 0.0 && deceleration <= 100.0) {
            return Err(DrivenSlaveError(deceleration));
        }
        Ok(Self {
            sample: [Axes::zeros(); 3],
            order: SlaveOrder::Wait,
            rotation: None,
            deceleration,
            turn: None,
            braking: None,
            now_ns: 0,
        })
    }

    /// Order to the driver after this tick.
    pub fn order(&self) -> &SlaveOrder<N> {
        &self.order
    }
}

impl<const N: usize> SlavePlant<N> for DrivenSlave<N> {
    fn read(&mut self, now_ns: u64) -> [Axes<N>; 3] {
        self.now_ns = now_ns;
        self.sample
    }

    fn write(&mut self, position: &Axes<N>, velocity: &Axes<N>) {
        let (mut position, mut velocity) = (*position, *velocity);
        let mut rotation = self.turn;
        if let Some(Braking { from, velocity: before, begun_ns, rest, rotation: of_turn }) = self.braking {
            let t = (self.now_ns - begun_ns) as f64 * 1e-9;
            let along = braked(before.norm(), self.deceleration, t);
            if let Some((way_s, share)) = along {
                position += from + before * way_s - rest;
                velocity += before * share;
            }
            let turning = of_turn.zip(rotation.as_mut()).and_then(
                |(TurnBraking { from, velocity, rest }, (orientation, w))| {
                    let (way_s, share) = braked(velocity.norm(), ANGULAR_DECELERATION, t)?;
                    let ahead = turned(velocity * way_s, &from) * rest.inverse();
                    *orientation = Unit::new_normalize((ahead * *orientation).into_inner());
                    *w += velocity * share;
                    Some(())
                },
            );
            if along.is_none() && turning.is_none() {
                self.braking = None;
            }
        }
        self.order = SlaveOrder::Move { position, velocity, rotation };
    }

    fn exert(&mut self, (force, torque): (&Axes<N>, &Axes<3>), motion: &ToolMotion<N>) {
        let torque = motion.rotation.map(|_| *torque);
        (self.order, self.braking) = (SlaveOrder::Exert { force: *force, torque, motion: *motion }, None);
    }

    /// Left to the driver: the rest position is unknown here.
    fn stop(&mut self) -> Axes<N> {
        (self.order, self.braking) = (SlaveOrder::Stop, None);
        Axes::repeat(f64::NAN)
    }

    fn hold(&mut self) -> Axes<N> {
        let (from, velocity, rotation) = match self.order {
            SlaveOrder::Move { position, velocity, rotation } => (position, velocity, rotation),
            SlaveOrder::Exert { motion: ToolMotion { position, velocity, rotation }, .. } => {
                (position, velocity, rotation)
            }
            SlaveOrder::Wait | SlaveOrder::Stop => return Axes::repeat(f64::NAN),
        };
        // v^2 / 2 a along v.
        let rest = from + velocity * (0.5 * velocity.norm() / self.deceleration);
        let turning = rotation.map(|(from, velocity)| TurnBraking {
            from,
            velocity,
            rest: turned(velocity * (0.5 * velocity.norm() / ANGULAR_DECELERATION), &from),
        });
        self.braking = Some(Braking { from, velocity, begun_ns: self.now_ns, rest, rotation: turning });
        rest
    }

    fn rotation(&self) -> Option<RotationState> {
        self.rotation
    }

    fn write_rotation(&mut self, orientation: &UnitQuaternion<f64>, angular_velocity: &Axes<3>) {
        self.turn = Some((*orientation, *angular_velocity));
    }

    fn braking_speeds(&self) -> [f64; 2] {
        let Some(Braking { velocity, begun_ns, rotation, .. }) = self.braking else { return [0.0; 2] };
        let t = (self.now_ns - begun_ns) as f64 * 1e-9;
        let left = |speed: f64, deceleration: f64| (speed - deceleration * t).max(0.0);
        let turning = rotation.map_or(0.0, |turning| left(turning.velocity.norm(), ANGULAR_DECELERATION));
        [left(velocity.norm(), self.deceleration), turning]
    }

    fn rest_orientation(&self) -> Option<UnitQuaternion<f64>> {
        self.braking.and_then(|braking| braking.rotation).map(|turning| turning.rest)
    }

    fn touches(&self) -> bool {
        false
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: u64 = 1_000_000;

    fn commanded(arm: &DrivenSlave<3>) -> (Axes<3>, Axes<3>) {
        match *arm.order() {
            SlaveOrder::Move { position, velocity, .. } => (position, velocity),
            ref other => panic!("{other:?}"),
        }
    }

    #[test]
    fn unled_arm_brakes_evenly_to_announced_rest() {
        for (speed, deceleration) in [(0.25, 2.5), (1.0, 5.0), (3.0, 100.0), (0.0, 5.0)] {
            let mut arm = DrivenSlave::<3>::new(deceleration).unwrap();
            let velocity = Axes::<3>::new(0.6, -0.8, 0.0) * speed;
            let from = Axes::<3>::new(0.1, 0.2, 0.3);
            arm.read(10 * MS);
            arm.write(&from, &velocity);
            let rest = arm.hold();
            assert!(((rest - from).norm() - speed * speed / (2.0 * deceleration)).abs() < 1e-12);
            let mut before = (from, velocity);
            for n in 1..=2000 {
                arm.read((10 + n) * MS);
                arm.write(&rest, &Axes::zeros());
                let now = commanded(&arm);
                // Trapezoid of velocities: exact for constant deceleration, except in the step that reaches rest.
                let step = now.0 - before.0 - (now.1 + before.1) * 0.5e-3;
                assert!(step.norm() < 1e-12 || (now.1.norm() == 0.0 && step.norm() < deceleration * 1e-6));
                assert!((now.1 - before.1).norm() <= deceleration * 1e-3 + 1e-12);
                before = now;
            }
            assert!((before.0 - rest).norm() < 1e-12 && before.1.norm() == 0.0);
        }
    }

    #[test]
    fn arm_led_again_while_braking_is_commanded_no_jump() {
        let mut arm = DrivenSlave::<3>::new(2.0).unwrap();
        let velocity = Axes::<3>::new(1.0, 0.0, 0.0);
        arm.read(0);
        arm.write(&Axes::zeros(), &velocity);
        let rest = arm.hold();
        let mut before = Axes::zeros();
        for n in 1..=1000 {
            arm.read(n * MS);
            // From 100 ms on the master leads it slowly the other way.
            let led = n.saturating_sub(100) as f64 * 1e-3;
            arm.write(&(rest - velocity * (0.1 * led)), &(velocity * -0.1));
            let (position, _) = commanded(&arm);
            assert!((position - before).norm() <= 1.0e-3 + 1e-12, "{n}");
            before = position;
        }
        assert!((before - (rest - velocity * 0.09)).norm() < 1e-12);
    }

    #[test]
    fn unled_pose_brakes_rotation_evenly_to_announced_rest() {
        let (deceleration, w) = (ANGULAR_DECELERATION, Axes::<3>::new(0.0, 1.2, -0.9));
        let mut arm = DrivenSlave::<3>::new(2.0).unwrap();
        let turned = |by: Axes<3>| UnitQuaternion::from_scaled_axis(by);
        let from = turned(Axes::<3>::new(0.4, 0.1, 0.2));
        let rotation = |arm: &DrivenSlave<3>| match *arm.order() {
            SlaveOrder::Move { rotation: Some(rotation), .. } => rotation,
            ref other => panic!("{other:?}"),
        };
        assert_eq!(arm.rest_orientation(), None);
        arm.read(0);
        arm.write_rotation(&from, &w);
        arm.write(&Axes::zeros(), &Axes::<3>::new(0.1, 0.0, 0.0));
        let rest = arm.hold();
        let rest_orientation = arm.rest_orientation().unwrap();
        // w² / 2 a about w.
        let expected = turned(w * (0.5 * w.norm() / deceleration)) * from;
        assert!(rest_orientation.angle_to(&expected) < 1e-7);
        let mut before = (from, w);
        assert_eq!(arm.braking_speeds(), [0.1, w.norm()]);
        for n in 1..=600 {
            arm.read(n * MS);
            let t = n as f64 * 1e-3;
            let left = [0.1 - 2.0 * t, w.norm() - deceleration * t].map(|speed| speed.max(0.0));
            assert!(
                arm.braking_speeds().iter().zip(left).all(|(seen, left)| (seen - left).abs() < 1e-12),
                "{n}"
            );
            arm.write_rotation(&rest_orientation, &Axes::zeros());
            arm.write(&rest, &Axes::zeros());
            let now = rotation(&arm);
            // Trapezoid of velocities about one axis: exact, except in the step that reaches rest.
            let step = (now.0 * before.0.inverse()).scaled_axis() - (now.1 + before.1) * 0.5e-3;
            assert!(step.norm() < 1e-9 || (now.1.norm() == 0.0 && step.norm() < deceleration * 1e-6), "{n}");
            assert!((now.1 - before.1).norm() <= deceleration * 1e-3 + 1e-12);
            before = now;
        }
        assert!(before.0.angle_to(&rest_orientation) < 1e-7 && before.1.norm() == 0.0);
    }

    #[test]
    fn never_led_arm_waits_and_stop_is_left_to_driver() {
        let mut arm = DrivenSlave::<3>::new(2.0).unwrap();
        assert!(arm.hold().iter().all(|x| x.is_nan()));
        assert_eq!(*arm.order(), SlaveOrder::Wait);
        assert!(arm.stop().iter().all(|x| x.is_nan()));
        assert_eq!(*arm.order(), SlaveOrder::Stop);
        arm.write(&Axes::zeros(), &Axes::zeros());
        assert_eq!(commanded(&arm).0, Axes::<3>::zeros());
    }

    /// The driver's newest sample is wrong at the tick that ends the engagement; the endpoint has held it back.
    #[test]
    fn an_arm_under_a_force_brakes_from_its_accepted_motion() {
        let mut arm = DrivenSlave::<3>::new(2.0).unwrap();
        let turned = UnitQuaternion::from_scaled_axis(Axes::<3>::new(0.0, 0.0, 0.3));
        let (position, velocity) = (Axes::<3>::new(0.05, 0.0, 0.0), Axes::<3>::new(0.1, 0.0, 0.0));
        let motion = ToolMotion { position, velocity, rotation: Some((turned, Axes::zeros())) };
        arm.sample = [Axes::repeat(3.0); 3];
        arm.read(0);
        arm.exert((&Axes::repeat(1.0), &Axes::zeros()), &motion);
        let SlaveOrder::Exert { force, torque, .. } = *arm.order() else { panic!("{:?}", arm.order()) };
        assert_eq!((force, torque), (Axes::repeat(1.0), Some(Axes::zeros())));
        let rest = arm.hold();
        assert!((rest - position - Axes::<3>::new(0.1 * 0.1 / 4.0, 0.0, 0.0)).norm() < 1e-12);
        assert!(arm.rest_orientation().unwrap().angle_to(&turned) < 1e-12);
        arm.write_rotation(&turned, &Axes::zeros());
        arm.write(&rest, &Axes::zeros());
        assert!((commanded(&arm).0 - position).norm() < 1e-12);
    }

    #[test]
    fn invalid_deceleration_is_rejected() {
        for deceleration in [0.0, -1.0, 100.1, f64::NAN, f64::INFINITY] {
            assert!(DrivenSlave::<1>::new(deceleration).is_err(), "{deceleration}");
        }
    }
}
