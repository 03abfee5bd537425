//! The records of a run: one flat record per tick and side.

use haptether_master::RotationSample;
use haptether_safety::{Axes, Fault, SafetyTick, controller::PerController};

use crate::{
    coupling::{RotationState, canonical},
    endpoint::{Exchange, MasterTick, SlaveReading, SlaveTick},
    gripper::LedGripper,
    ladder::LadderState,
    pace::TickTime,
    plant::{RotationTruth, Truth},
    recorder::{Field, Value},
};

/// What the records of both sides say of the ladder.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct LadderSnapshot {
    reason: u8,
    peer: [u8; 3],
    clutch: bool,
    round_trip_ns: u64,
}

/// What stands for the codes of a peer that has not been heard.
const NO_PEER: [u8; 3] = [u8::MAX, 0, 0];

impl LadderSnapshot {
    pub(crate) fn of<const N: usize>(exchange: &Exchange<N>) -> Self {
        let reason = exchange.ladder().history().last().map_or(0, |last| last.reason.code());
        // 0 is what the link says before the first.
        let round_trip_ns = match exchange.link().statistics().round_trip_ns {
            0 => u64::MAX,
            round_trip_ns => round_trip_ns,
        };
        let peer = exchange.peer_codes().unwrap_or(NO_PEER);
        Self { reason, peer, clutch: exchange.clutch(), round_trip_ns }
    }
}

/// One tick of the master.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MasterRecord<const N: usize, R = ()> {
    /// Time since the run began, in ns.
    pub time_ns: u64,
    /// x in m, as measured.
    pub position: Axes<N>,
    /// True position in m where the device is a model, else x as measured.
    pub true_position: Axes<N>,
    /// True velocity in m/s where the device is a model, else V as estimated.
    pub velocity: Axes<N>,
    /// True force of the hand in N where the device is a model, else zero.
    pub hand_force: Axes<N>,
    /// `F_v` in N.
    pub rendered_force: Axes<N>,
    /// `F_h` in N, as estimated.
    pub grasp_force: Axes<N>,
    /// `F_c` in N.
    pub safety_force: Axes<N>,
    /// `F_device` in N.
    pub device_force: Axes<N>,
    /// The trigger that leads the gripper, 0 open to 1 closed; NaN where it is not known, or without a gripper.
    pub trigger: f64,
    /// `S_vf`, `S_h`, `E_wso` and `E_so` in J; NaN where not observed.
    pub observers: PerController<f64>,
    /// Who tripped, [`haptether_safety::controller::Tripped::bits`].
    pub tripped: u8,
    /// Which bounds acted, [`haptether_safety::Acted::bits`].
    pub acted: u8,
    /// State of the ladder.
    pub state: LadderState,
    /// Why it stands there, [`crate::Reason::code`]; 0 where it began.
    pub reason: u8,
    /// What the peer's newest frame says: state, reason and fault by their codes; 255, 0 and 0 before the first.
    pub peer: [u8; 3],
    /// Whether the clutch is closed, as far as this side knows.
    pub clutch: bool,
    /// Silence of the peer in ns, `u64::MAX` before its first frame.
    pub age_ns: u64,
    /// Round trip in ns of the newest echo, both loops' waits for their ticks included; `u64::MAX` before the first.
    pub round_trip_ns: u64,
    /// How late the loop woke, in ns; in virtual time only where the clock of this side is set.
    pub overshoot_ns: u64,
    /// The fault's code, 0 without.
    pub fault: u8,
    /// What it has of a rotation; nothing of a point.
    pub rotation: R,
}

impl<const N: usize, R: MasterTurn> MasterRecord<N, R> {
    /// A record of nothing.
    pub(crate) fn empty() -> Self {
        let zeros = Axes::zeros();
        Self {
            time_ns: 0,
            position: zeros,
            true_position: zeros,
            velocity: zeros,
            hand_force: zeros,
            rendered_force: zeros,
            grasp_force: zeros,
            safety_force: zeros,
            device_force: zeros,
            trigger: f64::NAN,
            observers: PerController::repeat(f64::NAN),
            tripped: 0,
            acted: 0,
            state: LadderState::Disengaged,
            reason: 0,
            peer: NO_PEER,
            clutch: false,
            age_ns: u64::MAX,
            round_trip_ns: u64::MAX,
            overshoot_ns: 0,
            fault: 0,
            rotation: R::empty(),
        }
    }

    pub(crate) fn new(
        time: TickTime,
        position: &Axes<N>,
        truth: Option<Truth<N>>,
        trigger: Option<f64>,
        tick: &MasterTick<N>,
        rotation: R,
        snapshot: LadderSnapshot,
    ) -> Self {
        let Truth { position: true_position, velocity, hand_force } = truth.unwrap_or(Truth {
            position: *position,
            velocity: tick.safety.motion.velocity,
            hand_force: Axes::zeros(),
        });
        let intervention = &tick.safety.intervention;
        Self {
            time_ns: time.now_ns - time.start_ns,
            position: *position,
            true_position,
            velocity,
            hand_force,
            rendered_force: tick.safety.rendered_force,
            grasp_force: tick.safety.grasp_force,
            safety_force: intervention.safety_force,
            device_force: tick.safety.device_force,
            trigger: trigger.unwrap_or(f64::NAN),
            observers: intervention.observed,
            tripped: intervention.tripped.bits(),
            acted: tick.safety.acted.bits(),
            state: tick.state,
            reason: snapshot.reason,
            peer: snapshot.peer,
            clutch: snapshot.clutch,
            age_ns: tick.age_ns.unwrap_or(u64::MAX),
            round_trip_ns: snapshot.round_trip_ns,
            overshoot_ns: time.overshoot_ns,
            fault: tick.safety.fault.map_or(0, Fault::code),
            rotation,
        }
    }
}

/// One tick of the slave.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SlaveRecord<const N: usize, R = ()> {
    /// Time since the run began, in ns.
    pub time_ns: u64,
    /// Tool position in m.
    pub position: Axes<N>,
    /// Commanded position in m; the tool's own before the first command.
    pub command: Axes<N>,
    /// `F_e` in N.
    pub environment_force: Axes<N>,
    /// The gripper, 0 open to 1 closed; NaN without one, as all of it.
    pub gripper: f64,
    /// Its last command, 0 open to 1 closed.
    pub gripper_command: f64,
    /// Between its jaws in N.
    pub gripper_force: f64,
    /// Whether something stops its jaws.
    pub holds_object: bool,
    /// State of the ladder.
    pub state: LadderState,
    /// Why it stands there, [`crate::Reason::code`]; 0 where it began.
    pub reason: u8,
    /// What the peer's newest frame says: state, reason and fault by their codes; 255, 0 and 0 before the first.
    pub peer: [u8; 3],
    /// Whether the clutch is closed, as far as this side knows.
    pub clutch: bool,
    /// Which bounds acted on the command, [`crate::coupling::Limited::bits`].
    pub limited: u8,
    /// Silence of the peer in ns, `u64::MAX` before its first frame.
    pub age_ns: u64,
    /// Round trip in ns of the newest echo, both loops' waits for their ticks included; `u64::MAX` before the first.
    pub round_trip_ns: u64,
    /// How late the loop woke, in ns; in virtual time only where the clock of this side is set.
    pub overshoot_ns: u64,
    /// The fault's code, 0 without.
    pub fault: u8,
    /// What it has of a rotation; nothing of a point.
    pub rotation: R,
}

impl<const N: usize, R: SlaveTurn> SlaveRecord<N, R> {
    /// A record of nothing.
    pub(crate) fn empty() -> Self {
        let zeros = Axes::zeros();
        Self {
            time_ns: 0,
            position: zeros,
            command: zeros,
            environment_force: zeros,
            gripper: f64::NAN,
            gripper_command: f64::NAN,
            gripper_force: f64::NAN,
            holds_object: false,
            state: LadderState::Disengaged,
            reason: 0,
            peer: NO_PEER,
            clutch: false,
            limited: 0,
            age_ns: u64::MAX,
            round_trip_ns: u64::MAX,
            overshoot_ns: 0,
            fault: 0,
            rotation: R::empty(),
        }
    }

    pub(crate) fn new(
        time: TickTime,
        reading: &SlaveReading<N>,
        gripper: Option<&LedGripper>,
        tick: &SlaveTick<N>,
        snapshot: LadderSnapshot,
    ) -> Self {
        let SlaveReading { position, environment_force, .. } = reading;
        let state = gripper.map(LedGripper::state);
        let (jaws, gripper_command) = (state.map(|(jaws, _)| jaws), state.and_then(|(_, command)| command));
        Self {
            time_ns: time.now_ns - time.start_ns,
            position: *position,
            command: tick.command.unwrap_or(*position),
            environment_force: *environment_force,
            gripper: jaws.map_or(f64::NAN, |jaws| jaws.position),
            gripper_command: gripper_command.unwrap_or(f64::NAN),
            gripper_force: jaws.map_or(f64::NAN, |jaws| jaws.force_n),
            holds_object: jaws.is_some_and(|jaws| jaws.holds_object),
            state: tick.state,
            reason: snapshot.reason,
            peer: snapshot.peer,
            clutch: snapshot.clutch,
            limited: tick.limited.bits(),
            age_ns: tick.age_ns.unwrap_or(u64::MAX),
            round_trip_ns: snapshot.round_trip_ns,
            overshoot_ns: time.overshoot_ns,
            fault: tick.fault.map_or(0, Fault::code),
            rotation: R::of(reading.rotation.as_ref(), tick),
        }
    }
}

impl<const N: usize, R> MasterRecord<N, R> {
    /// The record of the point, and that of the rotation.
    pub fn parted(self) -> (MasterRecord<N>, R) {
        let Self {
            time_ns,
            position,
            true_position,
            velocity,
            hand_force,
            rendered_force,
            grasp_force,
            safety_force,
            device_force,
            trigger,
            observers,
            tripped,
            acted,
            state,
            reason,
            peer,
            clutch,
            age_ns,
            round_trip_ns,
            overshoot_ns,
            fault,
            rotation,
        } = self;
        (
            MasterRecord {
                time_ns,
                position,
                true_position,
                velocity,
                hand_force,
                rendered_force,
                grasp_force,
                safety_force,
                device_force,
                trigger,
                observers,
                tripped,
                acted,
                state,
                reason,
                peer,
                clutch,
                age_ns,
                round_trip_ns,
                overshoot_ns,
                fault,
                rotation: (),
            },
            rotation,
        )
    }
}

/// What the record of a master has of a rotation: nothing of a point, so that it costs nothing there.
pub trait MasterTurn: Copy + std::fmt::Debug + PartialEq + Send + 'static {
    /// Whether there is one.
    const TURNS: bool;

    /// Of nothing.
    fn empty() -> Self;

    /// It, if there is one.
    fn rotation(&self) -> Option<&MasterRotation>;

    /// Of a tick: what the device measured, what no sensor measures, what the safety layer decided.
    fn of(
        measured: Option<&RotationSample>,
        truth: Option<RotationTruth>,
        tick: Option<&SafetyTick<3>>,
    ) -> Self;

    /// Hands each field to `take`.
    fn fields<'a>(&'a self, take: &mut dyn FnMut(Field<'a>));
}

impl<const N: usize, R> SlaveRecord<N, R> {
    /// The record of the point, and that of the rotation.
    pub fn parted(self) -> (SlaveRecord<N>, R) {
        let Self {
            time_ns,
            position,
            command,
            environment_force,
            gripper,
            gripper_command,
            gripper_force,
            holds_object,
            state,
            reason,
            peer,
            clutch,
            limited,
            age_ns,
            round_trip_ns,
            overshoot_ns,
            fault,
            rotation,
        } = self;
        (
            SlaveRecord {
                time_ns,
                position,
                command,
                environment_force,
                gripper,
                gripper_command,
                gripper_force,
                holds_object,
                state,
                reason,
                peer,
                clutch,
                limited,
                age_ns,
                round_trip_ns,
                overshoot_ns,
                fault,
                rotation: (),
            },
            rotation,
        )
    }
}

/// What the record of a slave has of a rotation.
pub trait SlaveTurn: Copy + std::fmt::Debug + PartialEq + Send + 'static {
    /// Whether there is one.
    const TURNS: bool;

    /// Of nothing.
    fn empty() -> Self;

    /// It, if there is one.
    fn rotation(&self) -> Option<&SlaveRotation>;

    /// Of a tick: what the arm measured, and what it was commanded.
    fn of<const N: usize>(measured: Option<&RotationState>, tick: &SlaveTick<N>) -> Self;

    /// Hands each field to `take`.
    fn fields<'a>(&'a self, take: &mut dyn FnMut(Field<'a>));
}

impl MasterTurn for () {
    const TURNS: bool = false;

    fn empty() -> Self {}

    fn rotation(&self) -> Option<&MasterRotation> {
        None
    }

    fn of(_: Option<&RotationSample>, _: Option<RotationTruth>, _: Option<&SafetyTick<3>>) -> Self {}

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

/// One tick of a master's rotation, in its base frame about the tool point; orientations are unit quaternions w, x, y, z.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MasterRotation {
    /// As measured.
    pub orientation: [f64; 4],
    /// True orientation where the device is a model, else as measured.
    pub true_orientation: [f64; 4],
    /// True angular velocity in rad/s where the device is a model, else as estimated.
    pub angular_velocity: Axes<3>,
    /// True torque of the hand in N m where the device is a model, else zero.
    pub hand_torque: Axes<3>,
    /// Torque in N m that the remote side requests, as far as the device can render it.
    pub rendered_torque: Axes<3>,
    /// Of the hand in N m, as estimated.
    pub grasp_torque: Axes<3>,
    /// Of the controllers in N m.
    pub safety_torque: Axes<3>,
    /// Of the device in N m.
    pub device_torque: Axes<3>,
    /// `S_vf`, `S_h`, `E_wso` and `E_so` in J of the rotation; NaN where not observed.
    pub observers: PerController<f64>,
    /// Who tripped of the rotation, [`haptether_safety::controller::Tripped::bits`].
    pub tripped: u8,
    /// Which bounds of the torque acted, [`haptether_safety::Acted::bits`].
    pub acted: u8,
}

impl MasterRotation {
    /// Hands over each signal of a run in virtual time, which has the truth: name, and its numbers.
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
    ) -> Self {
        let (Some(measured), Some(tick)) = (measured, tick) else { return Self::empty() };
        let RotationTruth { orientation, angular_velocity, hand_torque } = truth.unwrap_or(RotationTruth {
            orientation: measured.orientation,
            angular_velocity: tick.motion.velocity,
            hand_torque: Axes::zeros(),
        });
        Self {
            orientation: canonical(&measured.orientation),
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
                Value::Count(self.tripped.into()),
            ),
            (
                "rotation_acted",
                "bits of the bounds that acted on the torque",
                Value::Count(self.acted.into()),
            ),
        ] {
            take(field);
        }
    }
}

/// One tick of a slave's rotation, in its base frame about the tool point; orientations are unit quaternions w, x, y, z.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SlaveRotation {
    /// Of the tool.
    pub orientation: [f64; 4],
    /// Commanded orientation; the tool's own before the first command.
    pub command_orientation: [f64; 4],
    /// Of the environment on the tool in N m.
    pub environment_torque: Axes<3>,
}

impl SlaveRotation {
    /// Hands over each signal of a run in virtual time: name, and its numbers.
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
