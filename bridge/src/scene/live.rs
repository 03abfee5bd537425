//! Live sides of a scene, for any number of axes: from JSON to a loop.

use std::path::{Path, PathBuf};

use haptether_master::RotationSample;
use haptether_numeric::of_axes;
use haptether_safety::{Axes, Stamped};
use haptether_slave::GripperSample;

use super::{
    assemble::{SceneError, bad_axes},
    outline::{scene_outline, scene_spec},
    pose::as_pose,
    sides::{
        LiveDevice, driven_master, driven_slave, simulated_master, simulated_pose_master,
        simulated_pose_slave, simulated_slave,
    },
    timed::Timed,
};
use crate::{
    ButtonWord, DrivenSlave, FaultText, GripperOrder, MasterPlant as _, MasterSide, MasterTurn, Side,
    SlaveOrder, SlaveSide, SlaveTurn, ToolMotion, Trace, Trigger,
    coupling::{RotationState, quat_wxyz},
    live::{
        DriverLoop, LiveRun, LiveSettings, LiveWatch, Newest, PacedLoop, PeerSocket, RecordOutputs,
        RecordReader, Security, StartError, paced_by_device, run_live,
    },
    recorder::{Recorded, Recorder, RecorderSettings},
    telemetry::{Telemetry, TelemetrySettings},
    wire::{Padded, Role, padded, unpadded},
};

/// Default size in bytes of the kept records: at 1 kHz 87 s along one axis, or 24 s of poses of a master.
const KEPT_BYTES: usize = 1 << 24;

/// Error at the start of a live side.
#[derive(Debug, thiserror::Error)]
pub enum LiveError {
    /// The scene is invalid.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// The session or the system refused.
    #[error(transparent)]
    Start(#[from] StartError),
    /// The memory for the records to keep is not available; the number is its size in MiB.
    #[error("keep_s: there is no memory for it: needs {0} MiB, keep less")]
    Memory(usize),
    /// A file or socket could not be opened.
    #[error("{name} = {}: {error}", path.display())]
    Output {
        /// Name of the setting.
        name: &'static str,
        /// Value of the setting.
        path: PathBuf,
        /// Error of the system.
        error: std::io::Error,
    },
}

/// Socket, settings and outputs of a live side.
#[derive(Debug)]
pub struct LiveParts {
    /// Socket to the peer.
    pub socket: PeerSocket,
    /// Settings of the loop.
    pub settings: LiveSettings,
    /// Security of the frames.
    pub security: Security,
    /// Duration in s of the records to keep; by default as many as fit into a fixed memory.
    pub keep_s: Option<f64>,
    /// Settings of the recording.
    pub record: Option<RecorderSettings>,
    /// Settings of the telemetry.
    pub telemetry: Option<TelemetrySettings>,
}

impl LiveParts {
    /// Open the outputs. The socket to the peer is already open, so that a run that cannot start replaces no file.
    fn outputs<R: Recorded>(&self) -> Result<RecordOutputs<R>, LiveError> {
        let newest = self.newest()?;
        let refused = |name: &'static str, path: &Path, error: std::io::Error| LiveError::Output {
            name,
            path: path.to_owned(),
            error,
        };
        // Telemetry first: its socket replaces nothing that is in use.
        let begin = |to: &TelemetrySettings| {
            Telemetry::begin(to).map_err(|error| refused("telemetry", &to.path, error))
        };
        let telemetry = self.telemetry.as_ref().map(begin).transpose()?;
        let begin =
            |to: &RecorderSettings| Recorder::begin(to).map_err(|error| refused("record", &to.path, error));
        Ok(RecordOutputs { newest, recorder: self.record.as_ref().map(begin).transpose()?, telemetry })
    }

    /// Reserve memory for the newest records, at most for those of the whole run.
    fn newest<R>(&self) -> Result<Newest<R>, LiveError> {
        let LiveSettings { period_ns, duration_ns, patience_ns, .. } = self.settings;
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // positive, and saturates
        let kept = match self.keep_s {
            Some(keep_s) => (keep_s * 1e9 / period_ns as f64).ceil() as usize,
            None => KEPT_BYTES / size_of::<R>(),
        };
        let longest_ns = match (duration_ns, patience_ns) {
            (Some(duration_ns), Some(patience_ns)) => duration_ns.saturating_add(patience_ns),
            _ => u64::MAX,
        };
        let longest = usize::try_from(longest_ns / period_ns).unwrap_or(usize::MAX).saturating_add(2);
        let kept = kept.min(longest);
        Newest::of(kept).ok_or(LiveError::Memory(kept.saturating_mul(size_of::<R>()) >> 20))
    }
}

/// Records that a loop keeps.
pub trait KeptRecords: Send {
    /// Return the number of records so far.
    fn kept(&self) -> usize;

    /// Return all records after the loop has ended; a second call returns none.
    fn take(&self) -> Trace;
}

impl<R: Recorded> KeptRecords for RecordReader<R> {
    fn kept(&self) -> usize {
        RecordReader::kept(self)
    }

    fn take(&self) -> Trace {
        Trace::of(&RecordReader::take(self))
    }
}

/// Loop, its watch, and its records.
pub type LiveSide<L> = (L, LiveWatch, Box<dyn KeptRecords>);

fn started<S: Side<Record: Recorded> + Send + 'static>(
    side: S,
    parts: LiveParts,
) -> Result<LiveSide<LiveRun>, LiveError> {
    // Outputs come before the loop, because the loop locks the present memory.
    let outputs = parts.outputs()?;
    let (run, watch, records) = run_live(side, parts.socket, parts.settings, parts.security, outputs)?;
    Ok((run, watch, Box::new(records)))
}

fn started_master<R: MasterTurn, const N: usize>(
    side: Timed<MasterSide<LiveDevice<N>, N, R>>,
    feels_trigger: bool,
    parts: LiveParts,
) -> Result<LiveSide<LiveRun>, LiveError> {
    if feels_trigger { started(side.recording_trigger(), parts) } else { started(side, parts) }
}

/// Start the simulated side of a scene as JSON on a separate thread, in the role that `parts` names.
///
/// # Errors
///
/// An invalid scene, outputs that cannot be opened, or [`StartError`].
pub fn run_scene_side(scene: &[u8], run_id: u64, parts: LiveParts) -> Result<LiveSide<LiveRun>, LiveError> {
    let outline = scene_outline(scene)?;
    let felt = outline.feels_trigger;
    of_axes!(
        outline.axes,
        N => {
            let scene = scene_spec::<N>(scene)?;
            match (parts.settings.role, as_pose(&scene)?) {
                (Role::Master, Some(scene)) => started_master(simulated_pose_master(scene, run_id)?, felt, parts),
                (Role::Master, None) => started_master(simulated_master(&scene, run_id)?, felt, parts),
                (Role::Slave, Some(scene)) => started(simulated_pose_slave(scene, run_id)?, parts),
                (Role::Slave, None) => started(simulated_slave(&scene, run_id)?, parts),
            }
        },
        axes => Err(bad_axes(axes).into())
    )
}

/// One sample of a haptic device; values beyond its axes are zero.
#[derive(Clone, Copy, Debug)]
pub struct MasterInput<'a> {
    /// Position in m.
    pub position: Padded,
    /// Velocity in m/s, if it is measured.
    pub velocity: Option<Padded>,
    /// True if the clutch button is pressed; None for a device without a button.
    pub clutch: Option<bool>,
    /// Text of a fault.
    pub fault: Option<&'a str>,
    /// Position of the trigger, 0 to 1.
    pub trigger: Option<f64>,
    /// Orientation and angular velocity, if the device turns.
    pub rotation: Option<RotationSample>,
    /// Buttons, one bit each.
    pub buttons: Option<u32>,
    /// Time of the sample in s on the device's own clock.
    pub time_s: Option<f64>,
}

/// Forces that a haptic device must exert.
#[derive(Clone, Copy, Debug)]
pub struct MasterOutput {
    /// Force in N.
    pub force: Padded,
    /// Torque in N m, if the device turns.
    pub torque: Option<Axes<3>>,
    /// Force in N of a trigger with force feedback.
    pub trigger_force: Option<f64>,
}

/// Loop of a master whose device a driver reads and writes.
pub trait MasterDriverLoop: DriverLoop + Send {
    /// Step one tick; returns none after the end of the run.
    fn step(&mut self, input: &MasterInput<'_>) -> Option<MasterOutput>;
}

/// One sample of an arm; values beyond its axes are zero.
#[derive(Clone, Copy, Debug)]
pub struct SlaveInput<'a> {
    /// Position in m.
    pub position: Padded,
    /// Velocity in m/s.
    pub velocity: Padded,
    /// Force of the environment on the tool in N.
    pub force: Padded,
    /// Text of a fault.
    pub fault: Option<&'a str>,
    /// State of the gripper, if the arm has one.
    pub gripper: Option<GripperSample>,
    /// Orientation, angular velocity and torque, if the arm turns.
    pub rotation: Option<RotationState>,
    /// Time of the sample in s on the arm's own clock.
    pub time_s: Option<f64>,
}

/// Orders to an arm.
#[derive(Clone, Copy, Debug)]
pub struct SlaveOutput {
    /// Order to the arm.
    pub order: SlaveOrder<{ crate::wire::MAX_AXES }>,
    /// Order to the gripper.
    pub gripper: GripperOrder,
    /// Buttons of the master, if the scene has buttons.
    pub buttons: Option<u32>,
}

/// Loop of a slave whose arm a driver reads and writes.
pub trait SlaveDriverLoop: DriverLoop + Send {
    /// Step one tick; returns none after the end of the run.
    fn step(&mut self, input: &SlaveInput<'_>) -> Option<SlaveOutput>;
}

/// Return the part of a sample that shows whether it is new; none if the device reports a fault.
fn stamped<'a, const N: usize>(
    position: &'a Padded,
    orientation: Option<&'a [f64; 4]>,
    time_s: Option<f64>,
    fault: Option<&str>,
) -> Option<Stamped<'a>> {
    fault.is_none().then(|| Stamped { position: &position.as_slice()[..N], orientation, time_s })
}

/// Pass a fault that the device reports with its sample to the side, with the device's text.
fn report_fault(side: &mut impl Side, fault: Option<&str>) {
    if let Some(text) = fault {
        side.exchange_mut().device_failed(Some(&FaultText::new(text)));
    }
}

impl<R: MasterTurn, const N: usize> MasterDriverLoop for PacedLoop<Timed<MasterSide<LiveDevice<N>, N, R>>> {
    fn step(&mut self, input: &MasterInput<'_>) -> Option<MasterOutput> {
        let turned = input.rotation.filter(|_| R::TURNS).map(|rotation| quat_wxyz(&rotation.orientation));
        PacedLoop::step(
            self,
            stamped::<N>(&input.position, turned.as_ref(), input.time_s, input.fault),
            |side| {
                report_fault(side, input.fault);
                let Some(plant) = side.side.plant.driven() else { return };
                (plant.position, plant.clutch) = (unpadded(&input.position), input.clutch);
                plant.velocity = input.velocity.as_ref().map(unpadded);
                // The buttons of a device that reports a fault are unknown.
                let buttons = ButtonWord(input.buttons.filter(|_| input.fault.is_none()));
                (plant.rotation, plant.buttons) = (input.rotation.filter(|_| R::TURNS), buttons);
                if let Some(trigger) = &mut side.side.trigger {
                    *trigger = Trigger::Driven(input.trigger);
                }
            },
            |side| {
                let trigger_force = side.side.felt().map(|tick| tick.device_force[0]);
                side.side.plant.driven().map(|plant| MasterOutput {
                    force: padded(&plant.force),
                    torque: R::TURNS.then_some(plant.torque),
                    trigger_force,
                })
            },
        )
        .flatten()
    }
}

impl<R: SlaveTurn, const N: usize> SlaveDriverLoop for PacedLoop<Timed<SlaveSide<DrivenSlave<N>, N, R>>> {
    fn step(&mut self, input: &SlaveInput<'_>) -> Option<SlaveOutput> {
        let turned = input.rotation.filter(|_| R::TURNS).map(|rotation| quat_wxyz(&rotation.orientation));
        PacedLoop::step(
            self,
            stamped::<N>(&input.position, turned.as_ref(), input.time_s, input.fault),
            |side| {
                report_fault(side, input.fault);
                let plant = &mut side.side.plant;
                plant.sample = [&input.position, &input.velocity, &input.force].map(unpadded);
                plant.rotation = input.rotation.filter(|_| R::TURNS);
                if let (Some(jaws), Some(read)) = (&mut side.side.gripper, input.gripper) {
                    jaws.take(read);
                }
            },
            |side| SlaveOutput {
                order: match *side.side.plant.order() {
                    SlaveOrder::Wait => SlaveOrder::Wait,
                    SlaveOrder::Stop => SlaveOrder::Stop,
                    SlaveOrder::Move { position, velocity, rotation } => SlaveOrder::Move {
                        position: padded(&position),
                        velocity: padded(&velocity),
                        rotation,
                    },
                    SlaveOrder::Exert { force, torque, motion } => {
                        let ToolMotion { position, velocity, rotation } = motion;
                        let (position, velocity) = (padded(&position), padded(&velocity));
                        let motion = ToolMotion { position, velocity, rotation };
                        SlaveOrder::Exert { force: padded(&force), torque, motion }
                    }
                },
                gripper: side.side.gripper.as_ref().map_or(GripperOrder::Hold, |jaws| *jaws.order()),
                buttons: side.exchange().peer_buttons(),
            },
        )
    }
}

fn paced<S: Side<Record: Recorded> + Send + 'static>(
    side: S,
    parts: LiveParts,
) -> Result<LiveSide<PacedLoop<S>>, LiveError> {
    let outputs = parts.outputs()?;
    let (paced, watch, records) =
        paced_by_device(side, parts.socket, parts.settings, parts.security, outputs)?;
    Ok((paced, watch, Box::new(records)))
}

fn paced_master<R: MasterTurn, const N: usize>(
    side: Timed<MasterSide<LiveDevice<N>, N, R>>,
    feels_trigger: bool,
    parts: LiveParts,
) -> Result<LiveSide<Box<dyn MasterDriverLoop>>, LiveError> {
    if feels_trigger {
        let (paced, watch, records) = paced(side.recording_trigger(), parts)?;
        return Ok((Box::new(paced), watch, records));
    }
    let (paced, watch, records) = paced(side, parts)?;
    Ok((Box::new(paced), watch, records))
}

/// Prepare the loop of the master of a scene as JSON, whose device has a driver; `simulated_clutch` as for
/// [`driven_master`].
///
/// # Errors
///
/// As [`run_scene_side`].
pub fn pace_scene_master(
    scene: &[u8],
    run_id: u64,
    simulated_clutch: bool,
    parts: LiveParts,
) -> Result<LiveSide<Box<dyn MasterDriverLoop>>, LiveError> {
    let outline = scene_outline(scene)?;
    let felt = outline.feels_trigger;
    of_axes!(
        outline.axes,
        N => {
            let scene = scene_spec::<N>(scene)?;
            match as_pose(&scene)? {
                Some(scene) => {
                    paced_master(driven_master(scene, run_id, simulated_clutch)?.recording_rotation(), felt, parts)
                }
                None => paced_master(driven_master(&scene, run_id, simulated_clutch)?, felt, parts),
            }
        },
        axes => Err(bad_axes(axes).into())
    )
}

/// Prepare the loop of the slave of a scene as JSON, whose arm has a driver.
///
/// # Errors
///
/// As [`run_scene_side`].
pub fn pace_scene_slave(
    scene: &[u8],
    run_id: u64,
    parts: LiveParts,
) -> Result<LiveSide<Box<dyn SlaveDriverLoop>>, LiveError> {
    of_axes!(
        scene_outline(scene)?.axes,
        N => {
            let scene = scene_spec::<N>(scene)?;
            if let Some(scene) = as_pose(&scene)? {
                let (paced, watch, records) = paced(driven_slave(scene, run_id)?.recording_rotation(), parts)?;
                return Ok((Box::new(paced), watch, records));
            }
            let (paced, watch, records) = paced(driven_slave(&scene, run_id)?, parts)?;
            Ok((Box::new(paced), watch, records))
        },
        axes => Err(bad_axes(axes).into())
    )
}
