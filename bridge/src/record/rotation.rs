//! Additional fields of the records of a side that turns.

use haptether_master::RotationSample;
use haptether_safety::{Axes, SafetyTick, controller::PerController};

use crate::{
    coupling::{RotationState, canonical},
    endpoint::SlaveTick,
    plant::RotationTruth,
    recorder::{Field, Value},
};

/// Rotation part of a master record; empty, and free, for a point.
pub trait MasterTurn: Copy + std::fmt::Debug + PartialEq + Send + 'static {
    /// True if there is a rotation.
    const TURNS: bool;

    /// An empty part.
    fn empty() -> Self;

    /// Rotation, if any.
    fn rotation(&self) -> Option<&MasterRotation>;

    /// Build the part of a tick; `torques` are the received and the requested one.
    fn of(
        measured: Option<&RotationSample>,
        truth: Option<RotationTruth>,
        tick: Option<&SafetyTick<3>>,
        torques: [Axes<3>; 2],
    ) -> Self;

    /// Add the force feedback at the trigger, if the record has it.
    #[must_use]
    fn felt(self, _tick: Option<&SafetyTick<1>>) -> Self {
        self
    }

    /// Pass each field to `take`.
    fn fields<'a>(&'a self, take: &mut dyn FnMut(Field<'a>));
}

/// Rotation part of a slave record.
pub trait SlaveTurn: Copy + std::fmt::Debug + PartialEq + Send + 'static {
    /// True if there is a rotation.
    const TURNS: bool;

    /// An empty part.
    fn empty() -> Self;

    /// Rotation, if any.
    fn rotation(&self) -> Option<&SlaveRotation>;

    /// Build the part from measured rotation and command.
    fn of<const N: usize>(measured: Option<&RotationState>, tick: &SlaveTick<N>) -> Self;

    /// Pass each field to `take`.
    fn fields<'a>(&'a self, take: &mut dyn FnMut(Field<'a>));
}

impl MasterTurn for () {
    const TURNS: bool = false;

    fn empty() -> Self {}

    fn rotation(&self) -> Option<&MasterRotation> {
        None
    }

    fn of(
        _: Option<&RotationSample>,
        _: Option<RotationTruth>,
        _: Option<&SafetyTick<3>>,
        _: [Axes<3>; 2],
    ) -> Self {
    }

    fn fields<'a>(&'a self, _: &mut dyn FnMut(Field<'a>)) {}
}

impl SlaveTurn for () {
    const TURNS: bool = false;

    fn empty() -> Self {}

    fn rotation(&self) -> Option<&SlaveRotation> {
        None
    }

    fn of<const N: usize>(_: Option<&RotationState>, _: &SlaveTick<N>) -> Self {}

    fn fields<'a>(&'a self, _: &mut dyn FnMut(Field<'a>)) {}
}

/// One tick of a master's rotation, in the base frame about the tool point. Orientations are unit quaternions w, x,
/// y, z.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MasterRotation {
    /// Measured orientation.
    pub orientation: [f64; 4],
    /// Measured, in rad/s; NaN if the device does not measure it.
    pub measured_angular_velocity: Axes<3>,
    /// Torque of the peer's newest frame in N m; zero before the first.
    pub received_torque: Axes<3>,
    /// Torque in N m that the coupling requests for it.
    pub requested_torque: Axes<3>,
    /// True orientation of a model, else measured.
    pub true_orientation: [f64; 4],
    /// True angular velocity in rad/s of a model, else estimated.
    pub angular_velocity: Axes<3>,
    /// True torque of the hand in N m of a model, else zero.
    pub hand_torque: Axes<3>,
    /// Requested torque in N m within the limits of the device.
    pub rendered_torque: Axes<3>,
    /// Estimated torque of the hand in N m.
    pub grasp_torque: Axes<3>,
    /// Torque of the controllers in N m.
    pub safety_torque: Axes<3>,
    /// Torque of the device in N m.
    pub device_torque: Axes<3>,
    /// `S_vf`, `S_h`, `E_wso` and `E_so` in J of the rotation; NaN if not observed.
    pub observers: PerController<f64>,
    /// Controllers of the rotation that tripped, [`haptether_safety::controller::Tripped::bits`].
    pub tripped: u8,
    /// Bounds that acted on the torque, [`haptether_safety::ActiveLimits::bits`].
    pub acted: u8,
}

impl MasterRotation {
    /// Pass each signal of a run in virtual time, which has true values.
    pub(crate) fn signals(&self, take: &mut dyn FnMut(&'static str, &[f64])) {
        take("orientation", &self.true_orientation);
        take("measured_orientation", &self.orientation);
        for (name, vector) in [
            ("angular_velocity", &self.angular_velocity),
            ("hand_torque", &self.hand_torque),
            ("rendered_torque", &self.rendered_torque),
            ("grasp_torque", &self.grasp_torque),
            ("safety_torque", &self.safety_torque),
            ("device_torque", &self.device_torque),
        ] {
            take(name, vector.as_slice());
        }
        take("rotation_tripped", &[f64::from(self.tripped)]);
    }
}

impl MasterTurn for MasterRotation {
    const TURNS: bool = true;

    fn rotation(&self) -> Option<&Self> {
        Some(self)
    }

    fn empty() -> Self {
        let zeros = Axes::zeros();
        Self {
            orientation: [1.0, 0.0, 0.0, 0.0],
            measured_angular_velocity: Axes::repeat(f64::NAN),
            received_torque: zeros,
            requested_torque: zeros,
            true_orientation: [1.0, 0.0, 0.0, 0.0],
            angular_velocity: zeros,
            hand_torque: zeros,
            rendered_torque: zeros,
            grasp_torque: zeros,
            safety_torque: zeros,
            device_torque: zeros,
            observers: PerController::repeat(f64::NAN),
            tripped: 0,
            acted: 0,
        }
    }

    fn of(
        measured: Option<&RotationSample>,
        truth: Option<RotationTruth>,
        tick: Option<&SafetyTick<3>>,
        [received_torque, requested_torque]: [Axes<3>; 2],
    ) -> Self {
        let (Some(measured), Some(tick)) = (measured, tick) else { return Self::empty() };
        let RotationTruth { orientation, angular_velocity, hand_torque } = truth.unwrap_or(RotationTruth {
            orientation: measured.orientation,
            angular_velocity: tick.motion.velocity,
            hand_torque: Axes::zeros(),
        });
        Self {
            orientation: canonical(&measured.orientation),
            measured_angular_velocity: measured.angular_velocity.unwrap_or(Axes::repeat(f64::NAN)),
            received_torque,
            requested_torque,
            true_orientation: canonical(&orientation),
            angular_velocity,
            hand_torque,
            rendered_torque: tick.rendered_force,
            grasp_torque: tick.grasp_force,
            safety_torque: tick.intervention.safety_force,
            device_torque: tick.device_force,
            observers: tick.intervention.observed,
            tripped: tick.intervention.tripped.bits(),
            acted: tick.acted.bits(),
        }
    }

    fn fields<'a>(&'a self, take: &mut dyn FnMut(Field<'a>)) {
        for field in [
            ("orientation", "unit quaternion w, x, y, z, as measured", Value::Axes(&self.orientation)),
            (
                "true_orientation",
                "unit quaternion w, x, y, z of a modelled device",
                Value::Axes(&self.true_orientation),
            ),
            (
                "measured_angular_velocity",
                "in rad/s as measured; null of a device that measures none",
                Value::Axes(self.measured_angular_velocity.as_slice()),
            ),
            (
                "received_torque",
                "of the newest frame in N m; zero before the first",
                Value::Axes(self.received_torque.as_slice()),
            ),
            (
                "requested_torque",
                "in N m that the coupling requests of it",
                Value::Axes(self.requested_torque.as_slice()),
            ),
            ("angular_velocity", "in rad/s", Value::Axes(self.angular_velocity.as_slice())),
            ("hand_torque", "torque of a modelled hand in N m", Value::Axes(self.hand_torque.as_slice())),
            ("rendered_torque", "requested torque in N m", Value::Axes(self.rendered_torque.as_slice())),
            (
                "grasp_torque",
                "torque of the hand in N m, as estimated",
                Value::Axes(self.grasp_torque.as_slice()),
            ),
            ("safety_torque", "of the controllers in N m", Value::Axes(self.safety_torque.as_slice())),
            ("device_torque", "of the device in N m", Value::Axes(self.device_torque.as_slice())),
            (
                "rotation_tripped",
                "bits of the controllers that tripped by the rotation",
                Value::Bits(self.tripped.into()),
            ),
            ("rotation_acted", "bits of the bounds that acted on the torque", Value::Bits(self.acted.into())),
        ] {
            take(field);
        }
    }
}

/// One tick of a slave's rotation, in the base frame about the tool point. Orientations are unit quaternions w, x, y,
/// z.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SlaveRotation {
    /// Orientation of the tool.
    pub orientation: [f64; 4],
    /// Commanded orientation; the tool's own before the first command.
    pub command_orientation: [f64; 4],
    /// Torque of the environment on the tool in N m.
    pub environment_torque: Axes<3>,
}

impl SlaveRotation {
    /// Pass each signal of a run in virtual time.
    pub(crate) fn signals(&self, take: &mut dyn FnMut(&'static str, &[f64])) {
        take("slave_orientation", &self.orientation);
        take("slave_command_orientation", &self.command_orientation);
        take("environment_torque", self.environment_torque.as_slice());
    }
}

impl SlaveTurn for SlaveRotation {
    const TURNS: bool = true;

    fn rotation(&self) -> Option<&Self> {
        Some(self)
    }

    fn empty() -> Self {
        let none = [1.0, 0.0, 0.0, 0.0];
        Self { orientation: none, command_orientation: none, environment_torque: Axes::zeros() }
    }

    fn of<const N: usize>(measured: Option<&RotationState>, tick: &SlaveTick<N>) -> Self {
        let Some(measured) = measured else { return Self::empty() };
        Self {
            orientation: canonical(&measured.orientation),
            command_orientation: canonical(&tick.orientation.unwrap_or(measured.orientation)),
            environment_torque: measured.torque,
        }
    }

    fn fields<'a>(&'a self, take: &mut dyn FnMut(Field<'a>)) {
        for field in [
            ("orientation", "of the tool, unit quaternion w, x, y, z", Value::Axes(&self.orientation)),
            (
                "command_orientation",
                "commanded orientation, unit quaternion w, x, y, z",
                Value::Axes(&self.command_orientation),
            ),
            (
                "environment_torque",
                "torque of the environment on the tool in N m",
                Value::Axes(self.environment_torque.as_slice()),
            ),
        ] {
            take(field);
        }
    }
}
