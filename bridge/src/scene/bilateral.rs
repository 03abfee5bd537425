//! Runs of a scene with an arm: both endpoints, the network between them, and the environment of the arm.

use std::{
    io,
    ops::ControlFlow,
    path::{Path, PathBuf},
    sync::atomic::{AtomicBool, Ordering},
};

use super::{
    aims::master_commands,
    assemble::{
        SceneError, clutch, contradiction, exact_master, is_continuous, period_ns, ticks, trigger_feedback,
    },
    coupling::commands,
    pose,
    record::SceneRun,
    research::ResearchFactory,
    sides::{master_endpoint, simulated_arm, simulated_gripper, slave_endpoint, trigger, with_waiting_hand},
    spec::{SceneSpec, SignalsSpec},
    timed::Timed,
    watched::Watched,
};
use crate::{
    Event, Exchange, MasterPlant, MasterRecord, MasterSide, MasterTurn, ModelArm, Side as _, SlavePlant,
    SlaveRecord, SlaveSide, SlaveTurn, VirtualSettings,
    ladder::Diagnosis,
    record::WithFinger,
    recorder::{Recorded, RecorderSettings, SecurityMark, WaitingRecorder},
    run_virtual,
    virtual_time::run_virtual_batched,
};
use haptether_netsim::{ClockSettings, EndpointClock};
use haptether_safety::{Axes, SafetyTick};

/// Session numbers of the two sides: constants, because no third party receives their frames.
pub(super) const SESSIONS: (u64, u64) = (1, 2);

/// Options of a run: research controllers, and recording, encoding and reports, which do not change its outcome.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct RunOptions<'a> {
    /// Files to record to.
    pub(crate) files: Option<&'a RecordingFiles>,
    /// True to encode and decode every frame.
    pub(crate) encoded: bool,
    /// True if only the outcome is needed: reports then omit the peer's clock and the path.
    pub(crate) outcome_only: bool,
    /// Factory of research controllers.
    pub(crate) research: Option<&'a dyn ResearchFactory>,
}

pub(crate) fn simulate<const N: usize>(
    scene: &SceneSpec<N>,
    stop: &AtomicBool,
    options: &RunOptions<'_>,
) -> Result<SceneRun, SceneError> {
    check(scene)?;
    in_fastest_order(|order| simulate_in(scene, stop, options, order), scene, options)
}

fn simulate_in<const N: usize>(
    scene: &SceneSpec<N>,
    stop: &AtomicBool,
    options: &RunOptions<'_>,
    order: Order,
) -> Result<Option<SceneRun>, SceneError> {
    let slave = SlaveSide::new(simulated_arm(scene)?, slave_endpoint(scene, SESSIONS.1)?)
        .with_gripper(simulated_gripper(scene)?);
    run(scene, master(scene, with_waiting_hand(exact_master(scene)?), options)?, slave, stop, options, order)
}

/// Same as [`simulate`], for a hand and an arm that turn.
pub(crate) fn simulate_pose(
    scene: &SceneSpec<3>,
    stop: &AtomicBool,
    options: &RunOptions<'_>,
) -> Result<SceneRun, SceneError> {
    check(scene)?;
    if scene.slave.is_none() {
        return contradiction("slave: is missing, kind = \"pose\" needs an arm");
    }
    if scene.run.stop_early {
        return contradiction("run.stop_early: what turns is not watched for rest, leave it out");
    }
    in_fastest_order(|order| simulate_pose_in(scene, stop, options, order), scene, options)
}

fn simulate_pose_in(
    scene: &SceneSpec<3>,
    stop: &AtomicBool,
    options: &RunOptions<'_>,
    order: Order,
) -> Result<Option<SceneRun>, SceneError> {
    let slave = SlaveSide::new(pose::simulated_tool(scene)?, slave_endpoint(scene, SESSIONS.1)?)
        .with_gripper(simulated_gripper(scene)?)
        .with_reference_point(pose::reference_point(scene.coupled()?.1)?)
        .recording_rotation();
    let plant = pose::turning_master(scene, with_waiting_hand(exact_master(scene)?))?;
    run(scene, master(scene, plant, options)?.recording_rotation(), slave, stop, options, order)
}

/// Order of the ticks of the two sides.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Order {
    /// In order of time.
    ByTime,
    /// Several ticks of one side in a row: faster, but a side may be ahead of the observed tick.
    Batched,
}

/// Run in the fastest order that does not change the result.
///
/// Out of order, a side may be ahead of the observed tick, or ahead of the last tick of a run that ends early.
fn in_fastest_order<const N: usize>(
    simulate: impl Fn(Order) -> Result<Option<SceneRun>, SceneError>,
    scene: &SceneSpec<N>,
    options: &RunOptions<'_>,
) -> Result<SceneRun, SceneError> {
    // A research controller must not see extra ticks.
    let is_bound = options.files.is_some() || scene.safety.research.is_some();
    // Signals, and events of a trigger with force feedback, are read from a side at its tick. A run that ends early
    // out of order must be repeated.
    let is_read = scene.record.is_some() || scene.master.gripper.is_some() || scene.run.stop_early;
    if !is_bound
        && (options.outcome_only || !is_read)
        && let Some(run) = simulate(Order::Batched)?
    {
        return Ok(run);
    }
    // In turn, no side is ahead of the observed tick.
    simulate(Order::ByTime).map(|run| run.unwrap_or_else(|| unreachable!("a run in turn is whole")))
}

/// Refuse settings that a scene with an arm cannot have.
pub(super) fn check<const N: usize>(scene: &SceneSpec<N>) -> Result<(), SceneError> {
    if scene.safety.signals == SignalsSpec::True {
        return contradiction("safety.signals = \"true\": an endpoint knows only what is measured");
    }
    if is_continuous(scene) || scene.environment.as_ref().is_some_and(|one| one.delay_ticks > 0) {
        return contradiction("environment: rendering and delay_ticks are for scenes without a [slave]");
    }
    Ok(())
}

pub(super) fn master<P: MasterPlant<N>, const N: usize>(
    scene: &SceneSpec<N>,
    plant: P,
    options: &RunOptions<'_>,
) -> Result<MasterSide<P, N>, SceneError> {
    let endpoint = master_endpoint(scene, SESSIONS.0, options.research)?;
    let side = MasterSide::new(plant, endpoint, clutch(scene))?.with_trigger(trigger(scene, false)?);
    Ok(side.with_buttons(scene.master.buttons)?)
}

/// Return the clock of an endpoint. It is monotonic: it is never set back.
fn clock(name: &str, settings: Option<ClockSettings>) -> Result<Option<EndpointClock>, SceneError> {
    let Some(settings) = settings else { return Ok(None) };
    let refuse = |text: String| contradiction(format!("link.{name}.{text}"));
    if settings.step_s < 0.0 {
        let step_s = settings.step_s;
        return refuse(format!("step_s = {step_s}: must be 0 or more: a monotonic clock is never set back"));
    }
    EndpointClock::new(&settings).map(Some).or_else(|error| refuse(error.to_string()))
}

pub(super) fn settings<const N: usize>(scene: &SceneSpec<N>) -> Result<VirtualSettings, SceneError> {
    let (slave, _) = scene.coupled()?;
    let links = scene.link.as_ref();
    Ok(VirtualSettings {
        period_ns: period_ns("run.period_s", scene.run.period_s)?,
        slave_period_ns: period_ns("slave.period_s", slave.period_s)?,
        ticks: ticks(scene)?,
        forward: links.and_then(|links| links.forward.clone()).unwrap_or_default(),
        backward: links.and_then(|links| links.backward.clone()).unwrap_or_default(),
        seed: scene.run.seed,
        secure: scene.security.is_some_and(|security| security.secure),
        encoded: false,
        master_clock: clock("master_clock", links.and_then(|links| links.master_clock))?,
        slave_clock: clock("slave_clock", links.and_then(|links| links.slave_clock))?,
    })
}

/// Run once. Returns none if the run ended early, a side may be ahead, and the sides are read afterwards.
fn run<P, A, R, Q, const N: usize>(
    scene: &SceneSpec<N>,
    master: MasterSide<P, N, R>,
    slave: SlaveSide<A, N, Q>,
    stop: &AtomicBool,
    options: &RunOptions<'_>,
    order: Order,
) -> Result<Option<SceneRun>, SceneError>
where
    P: MasterPlant<N>,
    A: SlavePlant<N> + ModelArm,
    R: MasterTurn,
    Q: SlaveTurn,
{
    let settings = VirtualSettings { encoded: options.encoded, ..settings(scene)? };
    let files = options.files;
    let (mut master, mut slave, mut watched) = prepared(scene, &settings, master, slave, options)?;
    let security = if settings.secure { SecurityMark::Secure } else { SecurityMark::Insecure };
    let is_felt = trigger_feedback(scene, scene.coupled()?.0)?.is_some();
    let needs_sides = !options.outcome_only;
    // Set only in a row: in turn, no side is ahead of the observed tick.
    let mut ended_early = false;
    let mut recorders = files.map(|files| SideRecorders::begin(files, security, is_felt)).transpose()?;
    let counts = match order {
        // One closure per order: without a second caller of the closure, a remote tick in a row takes 2 % less.
        Order::Batched => run_virtual_batched(&settings, &mut master, &mut slave, |event, sides| {
            let flow = observe(&event, sides, stop, &mut recorders, &mut watched);
            ended_early |= flow.is_break();
            flow
        }),
        Order::ByTime => run_virtual(&settings, &mut master, &mut slave, |event, sides| {
            observe(&event, sides, stop, &mut recorders, &mut watched)
        }),
    }?;
    if stop.load(Ordering::Relaxed) {
        return Err(SceneError::Stopped);
    }
    if ended_early && needs_sides {
        return Ok(None);
    }
    if let Some(recorders) = recorders {
        recorders.finish(master.exchange(), slave.exchange())?;
    }
    watched.finish(scene, &settings, &master, &slave, &counts).map(Some)
}

/// Take the record of a tick of either side; break if the run has ended or `stop` is set.
#[inline(always)] // like the functions that it calls
fn observe<P, A, R, Q, const N: usize>(
    event: &Event<'_, MasterRecord<N, R>, SlaveRecord<N, Q>>,
    (master, slave): Sides<'_, '_, P, A, R, Q, N>,
    stop: &AtomicBool,
    recorders: &mut Option<SideRecorders<MasterRecord<N, R>, SlaveRecord<N, Q>>>,
    watched: &mut Watched<N>,
) -> ControlFlow<()>
where
    P: MasterPlant<N>,
    A: SlavePlant<N> + ModelArm,
    R: MasterTurn,
    Q: SlaveTurn,
{
    if stop.load(Ordering::Relaxed) {
        return ControlFlow::Break(());
    }
    if let Some(recorders) = recorders {
        recorders.take(event, master.side.felt(), master.exchange(), slave.exchange());
    }
    watched.take(event, &master.side, &slave.side.plant)
}

/// Return both sides with the commands of their operators, and the observer, before the first tick.
pub(super) fn prepared<P, A, R, Q, const N: usize>(
    scene: &SceneSpec<N>,
    settings: &VirtualSettings,
    master: MasterSide<P, N, R>,
    slave: SlaveSide<A, N, Q>,
    options: &RunOptions<'_>,
) -> Result<Prepared<P, A, R, Q, N>, SceneError>
where
    P: MasterPlant<N>,
    A: SlavePlant<N>,
    R: MasterTurn,
    Q: SlaveTurn,
{
    let commands = commands::<N>(scene.coupled()?.1)?;
    let start = master.plant.truth().map_or(Axes::zeros(), |truth| truth.position);
    let mut master = Timed::new(master, master_commands(scene)?);
    let mut slave = Timed::new(slave, commands.clone());
    let watched = Watched::new(scene, settings, commands, &start, slave.side.gripper.is_some())?;
    for exchange in [master.exchange_mut(), slave.exchange_mut()] {
        skip_unread_reports(exchange, options);
    }
    Ok((master, slave, watched))
}

type Prepared<P, A, R, Q, const N: usize> =
    (Timed<MasterSide<P, N, R>>, Timed<SlaveSide<A, N, Q>>, Watched<N>);

/// Both sides as the observer of a run receives them.
pub(super) type Sides<'m, 's, P, A, R, Q, const N: usize> =
    (&'m Timed<MasterSide<P, N, R>>, &'s Timed<SlaveSide<A, N, Q>>);

/// Skip flight records and path reports that are not read.
fn skip_unread_reports(exchange: &mut Exchange, options: &RunOptions<'_>) {
    if options.files.is_none() {
        exchange.leave_out_flight();
    }
    if options.outcome_only {
        exchange.leave_out_path_reports();
    }
}

/// Files to which a run in virtual time is recorded.
#[derive(Clone, Debug)]
pub struct RecordingFiles {
    /// File of the master.
    pub master: PathBuf,
    /// File of the slave.
    pub slave: PathBuf,
    /// Scene as JSON, stored in both files.
    pub scene: String,
}

/// Recorder of the master.
enum MasterRecorder<M> {
    Plain(WaitingRecorder<M>),
    /// With trigger force feedback.
    Felt(WaitingRecorder<WithFinger<M>>),
}

impl<M: Recorded + Copy> MasterRecorder<M> {
    fn begin(settings: &RecorderSettings, is_felt: bool) -> io::Result<Self> {
        Ok(if is_felt {
            Self::Felt(WaitingRecorder::begin(settings)?)
        } else {
            Self::Plain(WaitingRecorder::begin(settings)?)
        })
    }

    fn take(&mut self, record: &M, felt: Option<&SafetyTick<1>>, newest: Option<&Diagnosis>) {
        match self {
            Self::Plain(recorder) => recorder.take(record, newest),
            Self::Felt(recorder) => recorder.take(&WithFinger::new(*record, felt), newest),
        }
    }

    fn finish(self, time_ns: u64, newest: Option<&Diagnosis>) -> io::Result<()> {
        match self {
            Self::Plain(recorder) => recorder.finish(time_ns, newest),
            Self::Felt(recorder) => recorder.finish(time_ns, newest),
        }
    }
}

/// Recorders of both sides, each with the time in ns of its newest record.
struct SideRecorders<'a, M, S> {
    files: &'a RecordingFiles,
    master: (MasterRecorder<M>, u64),
    slave: (WaitingRecorder<S>, u64),
}

impl<'a, M: Recorded + Copy, S: Recorded> SideRecorders<'a, M, S> {
    fn begin(files: &'a RecordingFiles, security: SecurityMark, is_felt: bool) -> Result<Self, SceneError> {
        let settings = |path: &PathBuf| RecorderSettings {
            path: path.clone(),
            min_free_bytes: 0,
            security,
            scene: files.scene.clone(),
        };
        let [master, slave] = [&files.master, &files.slave].map(settings);
        Ok(Self {
            files,
            master: (
                MasterRecorder::begin(&master, is_felt).map_err(|error| refused(&files.master, &error))?,
                0,
            ),
            slave: (WaitingRecorder::begin(&slave).map_err(|error| refused(&files.slave, &error))?, 0),
        })
    }

    fn take(
        &mut self,
        event: &Event<'_, M, S>,
        felt: Option<&SafetyTick<1>>,
        master: &Exchange,
        slave: &Exchange,
    ) {
        match event {
            Event::Master(record) => {
                self.master.1 = record.time_ns();
                self.master.0.take(record, felt, master.flight().diagnosis());
            }
            Event::Slave(record) => {
                self.slave.1 = record.time_ns();
                self.slave.0.take(record, slave.flight().diagnosis());
            }
        }
    }

    fn finish(self, master: &Exchange, slave: &Exchange) -> Result<(), SceneError> {
        let Self { files, master: (of_master, master_ns), slave: (of_slave, slave_ns) } = self;
        of_master
            .finish(master_ns, master.flight().diagnosis())
            .map_err(|error| refused(&files.master, &error))?;
        of_slave.finish(slave_ns, slave.flight().diagnosis()).map_err(|error| refused(&files.slave, &error))
    }
}

fn refused(path: &Path, error: &io::Error) -> SceneError {
    SceneError::Contradiction(format!("{}: cannot be written: {error}", path.display()))
}
