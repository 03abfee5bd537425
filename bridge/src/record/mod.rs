//! Records of a run: one flat record per tick and side.

mod finger;
mod rotation;
mod trace;

pub(crate) use finger::WithFinger;
pub use finger::{FingerTick, WithTriggerFeedback};
pub use rotation::{MasterRotation, MasterTurn, SlaveRotation, SlaveTurn};
pub use trace::{Column, Trace};

use haptether_safety::{Axes, Fault, controller::PerController};

use crate::{
    endpoint::{CarriedState, Exchange, MasterReading, MasterTick, SlaveReading, SlaveTick},
    gripper::SlaveGripper,
    ladder::LadderState,
    pace::TickTime,
    plant::Truth,
    port::PortEnergy,
};

/// Ladder fields of both sides' records.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct LadderSnapshot {
    reason: u8,
    peer: [u8; 3],
    clutch: bool,
    round_trip_ns: u64,
    outliers: u64,
    renewal: f32,
    port: PortEnergy,
    left_j: f32,
}

/// Codes of a peer that has not been heard.
const NO_PEER: [u8; 3] = [u8::MAX, 0, 0];

impl LadderSnapshot {
    pub(crate) fn of(exchange: &Exchange) -> Self {
        let reason = exchange.ladder().history().last().map_or(0, |last| last.reason.code());
        // The link reports 0 before the first.
        let round_trip_ns = match exchange.link().statistics().round_trip_ns {
            0 => u64::MAX,
            round_trip_ns => round_trip_ns,
        };
        let peer = exchange.peer_codes().unwrap_or(NO_PEER);
        let outliers = exchange.outliers;
        #[allow(clippy::cast_possible_truncation)] // it is shown, and nothing is computed from it
        let renewal = exchange.renewal.map_or(f32::NAN, |share| share as f32);
        #[allow(clippy::cast_possible_truncation)] // as renewal
        let (port, left_j) = (exchange.energy(), exchange.left_j() as f32);
        Self { reason, peer, clutch: exchange.clutch(), round_trip_ns, outliers, renewal, port, left_j }
    }
}

/// One tick of the master.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MasterRecord<const N: usize, R = ()> {
    /// Time since the start of the run in ns.
    pub time_ns: u64,
    /// Measured x in m.
    pub position: Axes<N>,
    /// Measured V in m/s; NaN if the device does not measure it.
    pub measured_velocity: Axes<N>,
    /// `F_e` in N of the peer's newest frame; zero before the first.
    pub received_force: Axes<N>,
    /// `F_v` in N that the coupling requests for it.
    pub requested_force: Axes<N>,
    /// Fading gain of the ladder on the request.
    pub gain: f64,
    /// Ticks skipped since the last.
    pub missed: u64,
    /// State taken over from the last tick.
    pub past: CarriedState,
    /// Fault code reported by device or trigger, 0 without.
    pub given_fault: u8,
    /// True position in m of a model, else measured x.
    pub true_position: Axes<N>,
    /// True velocity in m/s of a model, else estimated V.
    pub velocity: Axes<N>,
    /// True force of the hand in N of a model, else zero.
    pub hand_force: Axes<N>,
    /// `F_v` in N.
    pub rendered_force: Axes<N>,
    /// Estimated `F_h` in N.
    pub grasp_force: Axes<N>,
    /// `F_c` in N.
    pub safety_force: Axes<N>,
    /// `F_device` in N.
    pub device_force: Axes<N>,
    /// Trigger of the gripper, 0 open to 1 closed; NaN if unknown or without.
    pub trigger: f64,
    /// `S_vf`, `S_h`, `E_wso` and `E_so` in J; NaN if not observed.
    pub observers: PerController<f64>,
    /// Controllers that tripped, [`haptether_safety::controller::Tripped::bits`].
    pub tripped: u8,
    /// Bounds that acted, [`haptether_safety::ActiveLimits::bits`].
    pub acted: u8,
    /// State of the ladder.
    pub state: LadderState,
    /// Its reason, [`crate::Reason::code`]; 0 initially.
    pub reason: u8,
    /// Codes of state, reason and fault of the peer; 255, 0 and 0 before its first frame.
    pub peer: [u8; 3],
    /// True if the clutch is closed, as known to this side.
    pub clutch: bool,
    /// Silence of the peer in ns, `u64::MAX` before its first frame.
    pub age_ns: u64,
    /// Newest round trip in ns, including both loops' waits; `u64::MAX` before the first.
    pub round_trip_ns: u64,
    /// Lateness in ns; in virtual time only if this side's clock is set.
    pub overshoot_ns: u64,
    /// Outliers replaced so far.
    pub outliers: u64,
    /// Share of the ticks with a new sample of the device; NaN before it is measured, and of a simulated device.
    pub renewal: f32,
    /// Energies through the port since the engagement.
    pub port: PortEnergy,
    /// Energy in J that the coupling may still give; NaN for a coupling that counts none.
    pub left_j: f32,
    /// Fault code, 0 without.
    pub fault: u8,
    /// Rotation; empty for a point.
    pub rotation: R,
}

/// An empty record: NaN and the largest integers if unknown.
impl<const N: usize, R: MasterTurn> Default for MasterRecord<N, R> {
    fn default() -> Self {
        let zeros = Axes::zeros();
        Self {
            time_ns: 0,
            position: zeros,
            measured_velocity: Axes::repeat(f64::NAN),
            received_force: zeros,
            requested_force: zeros,
            gain: 0.0,
            missed: 0,
            past: CarriedState::All,
            given_fault: 0,
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
            outliers: 0,
            renewal: f32::NAN,
            port: PortEnergy::default(),
            left_j: f32::NAN,
            fault: 0,
            rotation: R::empty(),
        }
    }
}

impl<const N: usize, R: MasterTurn> MasterRecord<N, R> {
    #[inline(always)] // its parts need not be in memory
    pub(crate) fn new(
        time: TickTime,
        reading: &MasterReading<N>,
        truth: Option<Truth<N>>,
        trigger: Option<f64>,
        tick: &MasterTick<N>,
        rotation: R,
        snapshot: LadderSnapshot,
    ) -> Self {
        let Truth { position: true_position, velocity, hand_force } = truth.unwrap_or(Truth {
            position: reading.position,
            velocity: tick.safety.motion.velocity,
            hand_force: Axes::zeros(),
        });
        let intervention = &tick.safety.intervention;
        Self {
            time_ns: time.now_ns - time.start_ns,
            position: reading.position,
            measured_velocity: reading.velocity.unwrap_or(Axes::repeat(f64::NAN)),
            received_force: tick.input.received_force,
            requested_force: tick.input.requested_force,
            gain: tick.input.gain,
            missed: tick.input.missed,
            past: tick.input.past,
            given_fault: tick.input.fault.map_or(0, Fault::code),
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
            outliers: snapshot.outliers,
            renewal: snapshot.renewal,
            port: snapshot.port,
            left_j: snapshot.left_j,
            fault: tick.safety.fault.map_or(0, Fault::code),
            rotation,
        }
    }
}

/// One tick of the slave.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SlaveRecord<const N: usize, R = ()> {
    /// Time since the start of the run in ns.
    pub time_ns: u64,
    /// Tool position in m.
    pub position: Axes<N>,
    /// Commanded position in m; the tool's own before the first command.
    pub command: Axes<N>,
    /// `F_e` in N.
    pub environment_force: Axes<N>,
    /// `F_c` in N on an arm that takes forces; NaN while it follows a position.
    pub exerted_force: Axes<N>,
    /// Gripper, 0 open to 1 closed; NaN without one, as the next two.
    pub gripper: f64,
    /// Its last command, 0 open to 1 closed.
    pub gripper_command: f64,
    /// Force between its jaws in N.
    pub gripper_force: f64,
    /// True if an object stops its jaws.
    pub holds_object: bool,
    /// True if a simulated tool touches something; false for an arm. Not recorded.
    pub touches: bool,
    /// State of the ladder.
    pub state: LadderState,
    /// Its reason, [`crate::Reason::code`]; 0 initially.
    pub reason: u8,
    /// Codes of state, reason and fault of the peer; 255, 0 and 0 before its first frame.
    pub peer: [u8; 3],
    /// True if the clutch is closed, as known to this side.
    pub clutch: bool,
    /// Bounds that acted on the command, [`crate::coupling::Limited::bits`].
    pub limited: u8,
    /// Silence of the peer in ns, `u64::MAX` before its first frame.
    pub age_ns: u64,
    /// Newest round trip in ns, including both loops' waits; `u64::MAX` before the first.
    pub round_trip_ns: u64,
    /// Lateness in ns; in virtual time only if this side's clock is set.
    pub overshoot_ns: u64,
    /// Outliers replaced so far.
    pub outliers: u64,
    /// Share of the ticks with a new sample of the device; NaN before it is measured, and of a simulated device.
    pub renewal: f32,
    /// Energies through the port since the engagement.
    pub port: PortEnergy,
    /// Energy in J that the coupling may still give; NaN for a coupling that counts none.
    pub left_j: f32,
    /// Fault code, 0 without.
    pub fault: u8,
    /// Rotation; empty for a point.
    pub rotation: R,
}

/// An empty record: NaN and the largest integers if unknown.
impl<const N: usize, R: SlaveTurn> Default for SlaveRecord<N, R> {
    fn default() -> Self {
        let zeros = Axes::zeros();
        Self {
            time_ns: 0,
            position: zeros,
            command: zeros,
            environment_force: zeros,
            exerted_force: Axes::repeat(f64::NAN),
            gripper: f64::NAN,
            gripper_command: f64::NAN,
            gripper_force: f64::NAN,
            holds_object: false,
            touches: false,
            state: LadderState::Disengaged,
            reason: 0,
            peer: NO_PEER,
            clutch: false,
            limited: 0,
            age_ns: u64::MAX,
            round_trip_ns: u64::MAX,
            overshoot_ns: 0,
            outliers: 0,
            renewal: f32::NAN,
            port: PortEnergy::default(),
            left_j: f32::NAN,
            fault: 0,
            rotation: R::empty(),
        }
    }
}

impl<const N: usize, R: SlaveTurn> SlaveRecord<N, R> {
    #[inline(always)] // as for the master
    pub(crate) fn new(
        time: TickTime,
        reading: &SlaveReading<N>,
        gripper: Option<&SlaveGripper>,
        touches: bool,
        tick: &SlaveTick<N>,
        snapshot: LadderSnapshot,
    ) -> Self {
        let SlaveReading { position, environment_force, .. } = reading;
        let state = gripper.map(SlaveGripper::state);
        let (jaws, gripper_command) = (state.map(|(jaws, _)| jaws), state.and_then(|(_, command)| command));
        Self {
            time_ns: time.now_ns - time.start_ns,
            position: *position,
            command: tick.command.unwrap_or(*position),
            environment_force: *environment_force,
            exerted_force: tick.exerted.map_or_else(|| Axes::repeat(f64::NAN), |(force, _)| force),
            gripper: jaws.map_or(f64::NAN, |jaws| jaws.position),
            gripper_command: gripper_command.unwrap_or(f64::NAN),
            gripper_force: jaws.map_or(f64::NAN, |jaws| jaws.force_n),
            holds_object: jaws.is_some_and(|jaws| jaws.holds_object),
            touches,
            state: tick.state,
            reason: snapshot.reason,
            peer: snapshot.peer,
            clutch: snapshot.clutch,
            limited: tick.limited.bits(),
            age_ns: tick.age_ns.unwrap_or(u64::MAX),
            round_trip_ns: snapshot.round_trip_ns,
            overshoot_ns: time.overshoot_ns,
            outliers: snapshot.outliers,
            renewal: snapshot.renewal,
            port: snapshot.port,
            left_j: snapshot.left_j,
            fault: tick.fault.map_or(0, Fault::code),
            rotation: R::of(reading.rotation.as_ref(), tick),
        }
    }
}
