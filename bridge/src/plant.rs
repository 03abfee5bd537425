//! Plants of a runner: a device or an arm along N axes.

use haptether_master::{Aim, RotationSample, SimulatedMaster, SimulatedRotation};
use haptether_safety::{Axes, Real};
use haptether_slave::{GripperSample, Push, SimulatedSlave, SimulatedTool};
use nalgebra::UnitQuaternion;

use crate::{buttons::ButtonWord, coupling::RotationState};

/// A master device; time is an argument.
pub trait MasterPlant<const N: usize> {
    /// Start time at `now_ns`; called once, before the first read.
    fn begin(&mut self, _now_ns: u64) {}

    /// Position in m and, if measured, velocity in m/s.
    fn read(&mut self, now_ns: u64) -> (Axes<N>, Option<Axes<N>>);

    /// Exerts `force` in N from now on.
    fn write(&mut self, force: &Axes<N>);

    /// True if the clutch is pressed; `None` without a button.
    fn clutch(&self) -> Option<bool> {
        None
    }

    /// Buttons; `None` for a model, whose operator works the clutch.
    fn buttons(&self) -> Option<ButtonWord> {
        None
    }

    /// Called when the sides have engaged.
    fn engaged(&mut self) {}

    /// True motion and force of a model.
    fn truth(&self) -> Option<Truth<N>> {
        None
    }

    /// Orientation and, if measured, angular velocity at the last read; `None` for a point.
    fn rotation(&self) -> Option<RotationSample> {
        None
    }

    /// Exerts `torque` in N m from now on.
    fn write_torque(&mut self, _torque: &Axes<3>) {}

    /// True rotation and torque of a model that turns.
    fn rotation_truth(&self) -> Option<RotationTruth> {
        None
    }

    /// Samples and forces of a driver, if any.
    fn driven(&mut self) -> Option<&mut DrivenMaster<N>> {
        None
    }

    /// Let the hand of a model follow `aim` from the next read on. False if refused: only an aimed model has such a hand.
    fn aim(&mut self, _aim: &Aim<N>) -> bool {
        false
    }
}

/// True rotation of a modelled device, in the base frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RotationTruth {
    /// True orientation.
    pub orientation: UnitQuaternion<f64>,
    /// True angular velocity in rad/s.
    pub angular_velocity: Axes<3>,
    /// True torque of the hand in N m.
    pub hand_torque: Axes<3>,
}

/// True motion of a modelled device.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Truth<const N: usize, S: Real = f64> {
    /// True position in m.
    pub position: Axes<N, S>,
    /// True velocity in m/s.
    pub velocity: Axes<N, S>,
    /// True force of the hand in N.
    pub hand_force: Axes<N, S>,
}

/// A model of a device and its hand.
pub trait ModelPlant<const N: usize>: MasterPlant<N> {
    /// True motion and force.
    fn state(&self) -> Truth<N>;

    /// True force in N of walls on the device.
    fn wall_force(&self) -> Axes<N>;
}

/// Motion of a tool.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ToolMotion<const N: usize> {
    /// Position in m.
    pub position: Axes<N>,
    /// Velocity in m/s.
    pub velocity: Axes<N>,
    /// Orientation, and angular velocity in rad/s; `None` for a point.
    pub rotation: Option<(UnitQuaternion<f64>, Axes<3>)>,
}

/// A slave arm; time is an argument.
pub trait SlavePlant<const N: usize> {
    /// Start time at `now_ns`; called once, before the first read.
    fn begin(&mut self, _now_ns: u64) {}

    /// Position in m, velocity in m/s and `F_e` in N at `now_ns`.
    fn read(&mut self, now_ns: u64) -> [Axes<N>; 3];

    /// Take the tool to `position` in m, which moves with `velocity` in m/s.
    fn write(&mut self, position: &Axes<N>, velocity: &Axes<N>);

    /// Exert `force` in N on the tool, and `torque` in N m about the tool point if the arm turns, until the next command.
    /// Called only for an arm that takes forces. `motion` is the accepted motion of the arm.
    fn exert(&mut self, wrench: (&Axes<N>, &Axes<3>), motion: &ToolMotion<N>);

    /// Stop softly within the arm's bounds and stays there, whatever was written. Returns the rest position in m.
    /// Nothing is written until the stop is over. Never an emergency stop: nothing on the network can switch power
    /// and brakes.
    fn stop(&mut self) -> Axes<N>;

    /// Comes to rest softly when no longer led. Returns where, in m, which is written from now on.
    fn hold(&mut self) -> Axes<N> {
        self.stop()
    }

    /// Called when the sides have engaged.
    fn engaged(&mut self, _now_ns: u64) {}

    /// Orientation, angular velocity and torque at the last read; `None` for a point.
    fn rotation(&self) -> Option<RotationState> {
        None
    }

    /// Turn the tool to `orientation`, which turns with `angular_velocity` in rad/s. Precedes each
    /// [`write`](Self::write) of an arm that turns.
    fn write_rotation(&mut self, _orientation: &UnitQuaternion<f64>, _angular_velocity: &Axes<3>) {}

    /// Braking speeds in m/s and rad/s at the last tick, added to the command's.
    fn braking_speeds(&self) -> [f64; 2] {
        [0.0; 2]
    }

    /// Orientation at rest of [`stop`](Self::stop) or [`hold`](Self::hold).
    fn rest_orientation(&self) -> Option<UnitQuaternion<f64>> {
        None
    }

    /// Take the gripper's sample. Returns where the jaws meet an object, 0 open to 1 closed, if the arm knows.
    fn grip(&mut self, _jaws: &GripperSample) -> Option<Option<f64>> {
        None
    }

    /// True if the arm touched something at the last read; false if unknown.
    fn touches(&self) -> bool;

    /// Push the tool of a model from `now_ns` on. False if refused: only an aimed model can be pushed.
    fn push(&mut self, _now_ns: u64, _push: &Push<N>) -> bool {
        false
    }
}

impl<P: MasterPlant<N> + ?Sized, const N: usize> MasterPlant<N> for Box<P> {
    fn begin(&mut self, now_ns: u64) {
        (**self).begin(now_ns);
    }

    fn read(&mut self, now_ns: u64) -> (Axes<N>, Option<Axes<N>>) {
        (**self).read(now_ns)
    }

    fn write(&mut self, force: &Axes<N>) {
        (**self).write(force);
    }

    fn clutch(&self) -> Option<bool> {
        (**self).clutch()
    }

    fn buttons(&self) -> Option<ButtonWord> {
        (**self).buttons()
    }

    fn engaged(&mut self) {
        (**self).engaged();
    }

    fn truth(&self) -> Option<Truth<N>> {
        (**self).truth()
    }

    fn rotation(&self) -> Option<RotationSample> {
        (**self).rotation()
    }

    fn write_torque(&mut self, torque: &Axes<3>) {
        (**self).write_torque(torque);
    }

    fn rotation_truth(&self) -> Option<RotationTruth> {
        (**self).rotation_truth()
    }

    fn driven(&mut self) -> Option<&mut DrivenMaster<N>> {
        (**self).driven()
    }

    fn aim(&mut self, aim: &Aim<N>) -> bool {
        (**self).aim(aim)
    }
}

/// A haptic device whose driver is elsewhere.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DrivenMaster<const N: usize> {
    /// Measured position in m.
    pub position: Axes<N>,
    /// Velocity in m/s, if the device measures it.
    pub velocity: Option<Axes<N>>,
    /// Clutch state, if the device has a button; true if pressed.
    pub clutch: Option<bool>,
    /// Buttons of the device.
    pub buttons: ButtonWord,
    /// Force in N for the device to exert.
    pub force: Axes<N>,
    /// Measured orientation and angular velocity, if the device turns.
    pub rotation: Option<RotationSample>,
    /// Torque in N m for the device to exert.
    pub torque: Axes<3>,
}

impl<const N: usize> Default for DrivenMaster<N> {
    fn default() -> Self {
        let (position, force, torque) = (Axes::zeros(), Axes::zeros(), Axes::zeros());
        Self {
            position,
            velocity: None,
            clutch: None,
            buttons: ButtonWord::UNKNOWN,
            force,
            rotation: None,
            torque,
        }
    }
}

impl<const N: usize> MasterPlant<N> for DrivenMaster<N> {
    fn read(&mut self, _now_ns: u64) -> (Axes<N>, Option<Axes<N>>) {
        (self.position, self.velocity)
    }

    fn write(&mut self, force: &Axes<N>) {
        self.force = *force;
    }

    fn clutch(&self) -> Option<bool> {
        self.clutch
    }

    fn buttons(&self) -> Option<ButtonWord> {
        Some(self.buttons)
    }

    fn rotation(&self) -> Option<RotationSample> {
        self.rotation
    }

    fn write_torque(&mut self, torque: &Axes<3>) {
        self.torque = *torque;
    }

    fn driven(&mut self) -> Option<&mut Self> {
        Some(self)
    }
}

/// A device with separate models: a handle whose tool point is its centre of mass.
#[derive(Clone, Debug)]
pub struct TurningMaster<P> {
    /// Translation of the tool point.
    pub point: P,
    /// Rotation about it.
    pub body: SimulatedRotation,
}

impl<P: MasterPlant<N>, const N: usize> MasterPlant<N> for TurningMaster<P> {
    fn begin(&mut self, now_ns: u64) {
        self.point.begin(now_ns);
        self.body.begin(now_ns);
    }

    fn read(&mut self, now_ns: u64) -> (Axes<N>, Option<Axes<N>>) {
        self.body.read(now_ns);
        self.point.read(now_ns)
    }

    fn write(&mut self, force: &Axes<N>) {
        self.point.write(force);
    }

    fn engaged(&mut self) {
        self.point.engaged();
        self.body.set_waiting(false);
    }

    fn truth(&self) -> Option<Truth<N>> {
        self.point.truth()
    }

    fn rotation(&self) -> Option<RotationSample> {
        Some(self.body.measured())
    }

    fn write_torque(&mut self, torque: &Axes<3>) {
        self.body.write(torque);
    }

    fn rotation_truth(&self) -> Option<RotationTruth> {
        Some(RotationTruth {
            orientation: *self.body.orientation(),
            angular_velocity: self.body.angular_velocity(),
            hand_torque: self.body.hand_torque(),
        })
    }
}

impl<const N: usize> MasterPlant<N> for SimulatedMaster<N> {
    fn begin(&mut self, now_ns: u64) {
        SimulatedMaster::begin(self, now_ns);
    }

    fn read(&mut self, now_ns: u64) -> (Axes<N>, Option<Axes<N>>) {
        let sample = SimulatedMaster::read(self, now_ns);
        (sample.position, sample.velocity)
    }

    fn write(&mut self, force: &Axes<N>) {
        SimulatedMaster::write(self, force);
    }

    fn engaged(&mut self) {
        self.set_waiting(false);
    }

    fn truth(&self) -> Option<Truth<N>> {
        Some(self.state())
    }

    fn aim(&mut self, aim: &Aim<N>) -> bool {
        SimulatedMaster::aim(self, aim)
    }
}

impl<const N: usize> ModelPlant<N> for SimulatedMaster<N> {
    fn state(&self) -> Truth<N> {
        Truth { position: *self.position(), velocity: *self.velocity(), hand_force: self.hand_force() }
    }

    fn wall_force(&self) -> Axes<N> {
        SimulatedMaster::wall_force(self)
    }
}

/// Further state of a modelled arm.
pub trait ModelArm {
    /// Steps of the environment that were too stiff for full accuracy.
    fn coarse_steps(&self) -> u64 {
        0
    }

    /// Pass each signal of the environment: name and values.
    fn world(&self, _take: &mut dyn FnMut(&'static str, &[f64])) {}
}

impl<const N: usize> ModelArm for SimulatedSlave<N> {
    fn coarse_steps(&self) -> u64 {
        SimulatedSlave::coarse_steps(self)
    }
}

impl ModelArm for SimulatedTool {
    fn world(&self, take: &mut dyn FnMut(&'static str, &[f64])) {
        SimulatedTool::world(self, take);
    }
}

impl SlavePlant<3> for SimulatedTool {
    fn begin(&mut self, now_ns: u64) {
        SimulatedTool::begin(self, now_ns);
    }

    fn read(&mut self, now_ns: u64) -> [Axes<3>; 3] {
        let sample = SimulatedTool::read(self, now_ns);
        [sample.position, sample.velocity, sample.force]
    }

    fn write(&mut self, position: &Axes<3>, velocity: &Axes<3>) {
        SimulatedTool::write(self, position, velocity);
    }

    fn exert(&mut self, (force, torque): (&Axes<3>, &Axes<3>), _motion: &ToolMotion<3>) {
        SimulatedTool::exert(self, force, torque);
    }

    fn stop(&mut self) -> Axes<3> {
        SimulatedTool::stop(self).0
    }

    fn engaged(&mut self, now_ns: u64) {
        self.start(now_ns);
    }

    fn rotation(&self) -> Option<RotationState> {
        let sample = self.sample();
        Some(RotationState {
            orientation: sample.orientation,
            angular_velocity: sample.angular_velocity,
            torque: sample.torque,
        })
    }

    fn write_rotation(&mut self, orientation: &UnitQuaternion<f64>, angular_velocity: &Axes<3>) {
        SimulatedTool::write_rotation(self, orientation, angular_velocity);
    }

    fn rest_orientation(&self) -> Option<UnitQuaternion<f64>> {
        Some(self.set_orientation())
    }

    fn grip(&mut self, jaws: &GripperSample) -> Option<Option<f64>> {
        SimulatedTool::grip(self, jaws.position, jaws.force_n);
        // Without objects to hold, the gripper's settings define the object.
        self.has_things_to_hold().then(|| self.between_jaws())
    }

    fn touches(&self) -> bool {
        SimulatedTool::touches(self)
    }
}

impl<const N: usize> SlavePlant<N> for SimulatedSlave<N> {
    fn begin(&mut self, now_ns: u64) {
        SimulatedSlave::begin(self, now_ns);
    }

    fn read(&mut self, now_ns: u64) -> [Axes<N>; 3] {
        let sample = SimulatedSlave::read(self, now_ns);
        [sample.position, sample.velocity, sample.environment_force]
    }

    fn write(&mut self, position: &Axes<N>, velocity: &Axes<N>) {
        SimulatedSlave::write(self, position, velocity);
    }

    fn exert(&mut self, (force, _torque): (&Axes<N>, &Axes<3>), _motion: &ToolMotion<N>) {
        SimulatedSlave::exert(self, force);
    }

    fn stop(&mut self) -> Axes<N> {
        SimulatedSlave::stop(self)
    }

    fn engaged(&mut self, now_ns: u64) {
        self.start(now_ns);
    }

    fn touches(&self) -> bool {
        SimulatedSlave::touches(self)
    }

    fn push(&mut self, now_ns: u64, push: &Push<N>) -> bool {
        SimulatedSlave::push(self, now_ns, push)
    }
}
