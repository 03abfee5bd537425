//! The two sides of a scene, built separately: coupled in virtual time, or run live.

use std::f64::consts::TAU;

use haptether_master::SimulatedMaster;
use haptether_safety::SampleBounds;
use haptether_slave::{ArmSettings, ContactLawKind, ControlKind, SimulatedSlave, SimulatedTool};

use super::{
    aims::{is_aimed_by_person, master_commands},
    assemble::{
        SceneError, contradiction, device_model, driven_clutch, environment, exact_master, limiter,
        live_clutch, ns, period_ns, simulated_trigger, trigger_feedback,
    },
    coupling::commands,
    pose,
    research::{ResearchFactory, research_controller},
    spec::{ChangeSpec, CouplingNumbers, CouplingSpec, SceneSpec},
    timed::Timed,
};
use crate::{
    DrivenMaster, DrivenSlave, EndpointError, MasterEndpoint, MasterPlant, MasterRotation, MasterSettings,
    MasterSide, SideKind, SlaveEndpoint, SlaveGripper, SlaveRotation, SlaveSettings, SlaveSide, Trigger,
    coupling::{
        CouplingError, ForceArm, Gains, Mapping, MethodSettings, ScaleRange, ScaleRanges, VirtualToolSettings,
    },
    endpoint::{Arm, Exchange, Hand, TOOL_LEVER_M, period_s},
    playout::PlayOut,
};

/// Deceleration in m/s² of a driven arm that no longer follows, unless the scene bounds its acceleration.
const DECELERATION: f64 = 5.0;

fn master_settings<const N: usize>(
    scene: &SceneSpec<N>,
    run_id: u64,
) -> Result<MasterSettings<N>, SceneError> {
    let (_, coupling) = scene.coupled()?;
    pose::check_kind(scene)?;
    Ok(MasterSettings {
        period_ns: period_ns("run.period_s", scene.run.period_s)?,
        run_id,
        device: device_model(scene)?,
        estimator: scene.safety.estimator,
        safety: scene.safety.settings,
        limiter: limiter(&scene.safety),
        force_scale: coupling.force_scale,
        ladder: scene.safety.ladder.unwrap_or_default(),
    })
}

/// Stiffness in N/m of the stiffest wall, for a scene that has no wall.
const STIFFEST_WALL: f64 = 2000.0;

/// Return the largest stiffness in N/m of a wall of the scene.
pub(super) fn stiffest_wall<const N: usize>(scene: &SceneSpec<N>) -> f64 {
    let walls = scene.environment.iter().flat_map(|environment| &environment.objects);
    let linear = walls.filter(|wall| wall.contact.law == ContactLawKind::KelvinVoigt);
    let stiffest = linear.map(|wall| wall.contact.stiffness).fold(0.0, f64::max);
    if stiffest > 0.0 { stiffest } else { STIFFEST_WALL }
}

/// Return w in rad/s of the arm's control, and the time in s by which the arm lags behind its command.
pub(super) fn arm_response<const N: usize>(arm: &ArmSettings<N>) -> (f64, f64) {
    let w = TAU * arm.bandwidth_hz;
    match arm.control {
        // A tool is under an impedance servo.
        _ if arm.tool.is_some() => ((arm.stiffness / arm.mass_kg).sqrt(), 0.0),
        ControlKind::Position => (w, 2.0 / w),
        ControlKind::Velocity => (w, 1.0 / w),
        ControlKind::Pd => ((arm.stiffness / arm.mass_kg).sqrt(), 0.0),
    }
}

/// Return the virtual tool that an arm can follow. By default `M_v = K_max / (0.4 w)²`, with the stiffest wall of the
/// scene and w of the arm: the tool then swings on that wall at 0.4 w at most.
fn virtual_tool<const N: usize>(
    scene: &SceneSpec<N>,
    arm: &ArmSettings<N>,
    coupling: &CouplingSpec,
) -> Result<VirtualToolSettings, CouplingError> {
    let (w, lag_s) = arm_response(arm);
    let stiffest = stiffest_wall(scene);
    let CouplingNumbers { tool_mass_kg, tool_damping, tool_lead_s, .. } = coupling.numbers;
    let mass = tool_mass_kg.unwrap_or(stiffest / (0.4 * w).powi(2));
    VirtualToolSettings::new(mass, tool_damping, tool_lead_s.unwrap_or(lag_s))
}

/// Return an arm that takes forces, for translation and rotation: the arm of the scene, with its smallest inertia.
fn force_arm<const N: usize>(arm: &ArmSettings<N>) -> Result<[ForceArm; 2], CouplingError> {
    let inertia = arm.tool.as_ref().map_or(arm.mass_kg, |tool| tool.inertia_kg_m2.min());
    Ok([ForceArm::new(arm.mass_kg, arm.max_force_n)?, ForceArm::new(inertia, arm.max_torque_nm)?])
}

/// Return the settings of a coupling with two halves; None for position-force.
fn method<const N: usize>(scene: &SceneSpec<N>) -> Result<Option<MethodSettings>, SceneError> {
    let (arm, coupling) = scene.coupled()?;
    let CouplingSpec { numbers, position_scale, .. } = *coupling;
    let CouplingNumbers { kind, stiffness, damping, .. } = numbers;
    let Some(default) = kind.default_gains() else {
        return refuse_springs(&numbers).map(|()| None);
    };
    let stated = Gains {
        stiffness: stiffness.unwrap_or(default.stiffness),
        damping: damping.unwrap_or(default.damping),
        ..limited_gains(scene, coupling, default)?
    };
    let (gains, tool) = stated
        .checked()
        .and_then(|gains| Ok((gains, virtual_tool(scene, arm, coupling)?)))
        .map_err(EndpointError::from)?;
    let is_pose = scene.master.kind == SideKind::Pose;
    let turning = numbers.rotational_stiffness.or(numbers.rotational_damping);
    if let (Some(seen), false) = (turning, is_pose) {
        return contradiction(format!(
            "coupling.rotational_stiffness or coupling.rotational_damping = {seen}: only kind = \"pose\" turns; leave it \
             out"
        ));
    }
    let rotation = if is_pose { Some(pose::coupled_rotation(scene, &gains)?) } else { None };
    let forces = if arm.takes_force { Some(force_arm(arm).map_err(EndpointError::from)?) } else { None };
    let settings = MethodSettings { kind, gains, tool, forces, position_scale, rotation };
    for (at_ns, command) in commands::<N>(coupling)? {
        if let Err(CouplingError::Fixed { name, kind, .. }) = settings.check_change(&command, at_ns == 0) {
            return Err(SceneError::Contradiction(format!(
                "coupling.changes: {name} at {} s: {kind} keeps that of the scene",
                at_ns as f64 * 1e-9
            )));
        }
    }
    Ok(Some(settings))
}

/// Largest b and largest damping that the master adds, in units of M/T: more, held for a tick, turns a motion around.
const MOST_IMPEDANCE: f64 = 0.3;
const MOST_ADDED: f64 = 0.2;
/// Longest time in s over which a wave is spread.
const MOST_SPREAD_S: f64 = 0.1;
/// Range of C2: above 1 the estimate of `F_h` feeds back with a positive sign, and near 0 its error is all that the hand
/// feels. Largest C3.
const ENVIRONMENT_GAINS: [f64; 2] = [0.05, 1.5];
const MOST_GRASP_GAIN: f64 = 4.0;
/// Speed in m/s of a device with the energies that both sides have at the engagement.
const START_SPEED: f64 = 0.3;

/// Return the numbers of a coupling beside its spring, within what the device bears.
fn limited_gains<const N: usize>(
    scene: &SceneSpec<N>,
    coupling: &CouplingSpec,
    default: Gains,
) -> Result<Gains, SceneError> {
    let position_scale = coupling.position_scale;
    let CouplingNumbers { kind, impedance, start_energy_j, spread_s, play_out_s, .. } = coupling.numbers;
    let CouplingNumbers { environment_gain, grasp_gain, .. } = coupling.numbers;
    let name = kind.name();
    let holds_none = |locked: &[usize]| locked.is_empty();
    let mut changed = coupling.changes.iter().filter_map(|change| change.locked_axes.as_deref());
    if default.spread_s > 0.0 && !(holds_none(&coupling.locked_axes) && changed.all(holds_none)) {
        return contradiction(format!(
            "coupling.locked_axes: {name} holds no axis; lock none, or use another coupling"
        ));
    }
    if let Some(seen) = impedance.filter(|seen| !(*seen > 0.0 && seen.is_finite())) {
        return contradiction(format!("coupling.impedance = {seen}: must be finite and above 0"));
    }
    for (key, stated, used) in [
        ("impedance", impedance, default.impedance > 0.0),
        ("start_energy_j", start_energy_j, kind.sends_energy()),
        ("spread_s", spread_s, default.spread_s > 0.0),
        ("play_out_s", play_out_s, kind.plays_out()),
        ("environment_gain", environment_gain, default.environment_gain > 0.0),
        ("grasp_gain", grasp_gain, default.grasp_gain > 0.0),
    ] {
        if let (Some(seen), false) = (stated, used) {
            return contradiction(format!("coupling.{key} = {seen}: {name} does not use it; leave it out"));
        }
    }
    // As the slave's frame sees the device.
    let mass = scene.master.device.mass_kg.min() / (coupling.force_scale * position_scale);
    let per_period = mass / scene.run.period_s.max(f64::MIN_POSITIVE);
    let most_j = 0.25 * mass * (position_scale * START_SPEED).powi(2);
    for (key, stated, most, why) in [
        ("impedance", impedance, MOST_IMPEDANCE * per_period, "0.3 M/T of the device"),
        ("start_energy_j", start_energy_j, most_j, "a quarter of M (0.3 m/s)² of the device"),
        ("spread_s", spread_s, MOST_SPREAD_S, "because it adds to the delay"),
        ("environment_gain", environment_gain, ENVIRONMENT_GAINS[1], "because F_h then feeds back"),
        ("grasp_gain", grasp_gain, MOST_GRASP_GAIN, "because its loop of force has no delay"),
    ] {
        if let Some(seen) = stated.filter(|seen| *seen > most) {
            return contradiction(format!("coupling.{key} = {seen}: must be at most {most:.3e}, {why}"));
        }
    }
    if let Some(seen) = environment_gain.filter(|seen| *seen < ENVIRONMENT_GAINS[0]) {
        let least = ENVIRONMENT_GAINS[0];
        return contradiction(format!(
            "coupling.environment_gain = {seen}: must be at least {least}, or errors of F_h are all that the hand feels"
        ));
    }
    Ok(Gains {
        impedance: impedance.unwrap_or(default.impedance.min(MOST_IMPEDANCE * per_period)),
        start_j: start_energy_j.unwrap_or(default.start_j.min(most_j)),
        spread_s: spread_s.unwrap_or(default.spread_s),
        most_damping: default.most_damping.min(MOST_ADDED * per_period),
        environment_gain: environment_gain.unwrap_or(default.environment_gain),
        grasp_gain: grasp_gain.unwrap_or(default.grasp_gain),
        ..default
    })
}

/// Longest wait in s in the play-out of a scene that states none.
const PLAY_OUT_S: f64 = 0.06;

/// Return the play-out of a coupling that needs one.
fn play_out(coupling: &CouplingNumbers, exchange: &Exchange) -> Result<PlayOut, SceneError> {
    let most_s = coupling.play_out_s.unwrap_or(PLAY_OUT_S);
    if !(0.0..=1.0).contains(&most_s) {
        return contradiction(format!("coupling.play_out_s = {most_s}: must be between 0 and 1 s"));
    }
    if !(coupling.kind.plays_out() && most_s > 0.0) {
        return Ok(PlayOut::default());
    }
    exchange.play_out(ns(most_s)).map_err(|error| SceneError::Contradiction(error.to_string()))
}

/// Settings and play-out of each coupling to which the operator may switch.
type Alternatives = Vec<(Option<MethodSettings>, PlayOut)>;

fn alternatives<const N: usize>(
    scene: &SceneSpec<N>,
    exchange: &Exchange,
) -> Result<Alternatives, SceneError> {
    let (_, coupling) = scene.coupled()?;
    let mut kinds = vec![coupling.numbers.kind];
    let build = |(index, numbers): (usize, &CouplingNumbers)| {
        let kind = numbers.kind;
        if kinds.contains(&kind) {
            return contradiction(format!("coupling.alternatives.{index}: {} is there twice", kind.name()));
        }
        kinds.push(kind);
        let of_index = |error| SceneError::Contradiction(format!("coupling.alternatives.{index}: {error}"));
        let play_out = play_out(numbers, exchange).map_err(of_index)?;
        let other = SceneSpec { coupling: Some(coupling.with(*numbers)), ..scene.clone() };
        Ok((method(&other).map_err(of_index)?, play_out))
    };
    coupling.alternatives.iter().enumerate().map(build).collect()
}

/// Return an error for numbers of springs in the table of position-force, which has none.
fn refuse_springs(coupling: &CouplingNumbers) -> Result<(), SceneError> {
    let numbers = [
        ("impedance", coupling.impedance),
        ("start_energy_j", coupling.start_energy_j),
        ("spread_s", coupling.spread_s),
        ("play_out_s", coupling.play_out_s),
        ("environment_gain", coupling.environment_gain),
        ("grasp_gain", coupling.grasp_gain),
        ("stiffness", coupling.stiffness),
        ("damping", coupling.damping),
        ("rotational_stiffness", coupling.rotational_stiffness),
        ("rotational_damping", coupling.rotational_damping),
        ("tool_mass_kg", coupling.tool_mass_kg),
        ("tool_damping", coupling.tool_damping),
        ("tool_lead_s", coupling.tool_lead_s),
    ];
    match numbers.into_iter().find_map(|(key, seen)| seen.map(|seen| (key, seen))) {
        None => Ok(()),
        Some((key, seen)) => Err(SceneError::Contradiction(format!(
            "coupling.{key} = {seen}: {} has no spring; set coupling.kind, or leave it out",
            coupling.kind.name()
        ))),
    }
}

/// Return the sample bounds of a side of this kind, with the speed bound of its device and a quantum in m (rad).
fn point_samples(kind: SideKind, speed_bound: Option<f64>, quantum: f64) -> SampleBounds {
    let of_kind = match kind {
        SideKind::Joints => SampleBounds::JOINTS,
        SideKind::Linear | SideKind::Pose => SampleBounds::LINEAR,
    };
    SampleBounds { speed: speed_bound.unwrap_or(of_kind.speed), quantum, ..of_kind }
}

/// Return the sample bounds of the device, for position and rotation.
fn master_samples<const N: usize>(scene: &SceneSpec<N>) -> [SampleBounds; 2] {
    let master = &scene.master;
    let point = point_samples(master.kind, master.speed_bound, master.device.encoder_quantum);
    let rotation = match &scene.safety.rotation {
        Some(own) => {
            let at_lever = point.at_lever(own.lever_m);
            SampleBounds { quantum: own.quantum_rad.unwrap_or(at_lever.quantum), ..at_lever }
        }
        None => SampleBounds::UNBOUNDED,
    };
    [point, rotation]
}

/// Return the sample bounds of the arm, for position and rotation.
fn slave_samples<const N: usize>(scene: &SceneSpec<N>) -> [SampleBounds; 2] {
    let speed_bound = scene.slave.as_ref().and_then(|slave| slave.speed_bound);
    [point_samples(scene.master.kind, speed_bound, 0.0), SampleBounds::LINEAR.at_lever(TOOL_LEVER_M)]
}

/// Build only the hand of [`master_endpoint`] and the coupling that requests its force. The hand must neither turn nor
/// lead a gripper.
pub(super) fn hand_and_coupling<const N: usize>(
    scene: &SceneSpec<N>,
) -> Result<(Hand<N>, Mapping<N>), SceneError> {
    let settings = master_settings(scene, 0)?;
    let coupling = Mapping::new(1.0, settings.force_scale).map_err(EndpointError::from)?;
    Ok((MasterEndpoint::hand_of(&settings)?.with_samples(master_samples(scene)), coupling))
}

/// Build the endpoint of the master; `research` builds a research controller and is None for live sides.
pub(super) fn master_endpoint<const N: usize>(
    scene: &SceneSpec<N>,
    run_id: u64,
    research: Option<&dyn ResearchFactory>,
) -> Result<MasterEndpoint<N>, SceneError> {
    let (arm, coupling) = scene.coupled()?;
    let settings = master_settings(scene, run_id)?;
    let endpoint = match scene.master.kind {
        SideKind::Pose => {
            let rotation = pose::master_rotation(scene, coupling)?;
            let lock = pose::rotation_lock(coupling).map_err(EndpointError::from)?;
            MasterEndpoint::of_pose(&settings, &rotation, lock)?
        }
        SideKind::Linear | SideKind::Joints => MasterEndpoint::new(&settings)?,
    };
    let CouplingSpec { change_factor: factor, ref changes, .. } = *coupling;
    let stated = |of: fn(&ChangeSpec) -> Option<f64>| changes.iter().filter_map(of);
    let ranges = ScaleRanges {
        translation: Some(ScaleRange::force(
            coupling.force_scale,
            factor,
            stated(|change| change.force_scale),
        )),
        rotation: endpoint.ranges().rotation.and(Some(ScaleRange::torque(
            coupling.torque_scale,
            factor,
            stated(|change| change.torque_scale),
        ))),
    };
    let mut endpoint = endpoint.with_ranges(ranges).with_samples(master_samples(scene));
    if let Some(method) = method(scene)? {
        endpoint = endpoint.with_coupling(&method);
        let play_out = play_out(&coupling.numbers, &endpoint.exchange)?;
        endpoint.set_play_out(play_out);
    }
    for (method, play_out) in alternatives(scene, &endpoint.exchange)? {
        endpoint = endpoint.with_alternative(method, play_out);
    }
    endpoint.exchange.set_kind(scene.master.kind);
    if let Some(trigger) = trigger_feedback(scene, arm)? {
        endpoint = endpoint.with_trigger(&trigger)?;
    }
    if let Some(controller) = research_controller(scene, research)? {
        let turns = || "safety.research: watches what moves, not what also turns".to_owned();
        endpoint = endpoint.with_research(controller).ok_or_else(|| SceneError::Contradiction(turns()))?;
    }
    Ok(endpoint)
}

fn slave_settings<const N: usize>(scene: &SceneSpec<N>, run_id: u64) -> Result<SlaveSettings, SceneError> {
    let (slave, coupling) = scene.coupled()?;
    pose::check_kind(scene)?;
    Ok(SlaveSettings {
        period_ns: period_ns("slave.period_s", slave.period_s)?,
        run_id,
        position_scale: coupling.position_scale,
        bounds: coupling.bounds,
        ladder: scene.safety.ladder.unwrap_or_default(),
    })
}

/// Build only the arm of [`slave_endpoint`]; it must not turn.
pub(super) fn point_arm<const N: usize>(scene: &SceneSpec<N>) -> Result<Arm<N>, SceneError> {
    let settings = slave_settings(scene, 0)?;
    Ok(Arm::new(&settings)?.with_samples(slave_samples(scene), period_s(settings.period_ns)))
}

/// Build the endpoint of the slave.
pub(super) fn slave_endpoint<const N: usize>(
    scene: &SceneSpec<N>,
    run_id: u64,
) -> Result<SlaveEndpoint<N>, SceneError> {
    let (_, coupling) = scene.coupled()?;
    let settings = slave_settings(scene, run_id)?;
    let endpoint = match scene.master.kind {
        SideKind::Pose => {
            let rotation = pose::slave_rotation(coupling).map_err(EndpointError::from)?;
            SlaveEndpoint::of_pose(&settings, &rotation)?
        }
        SideKind::Linear | SideKind::Joints => SlaveEndpoint::new(&settings)?,
    };
    let CouplingSpec { change_factor: factor, ref changes, .. } = *coupling;
    let stated = |of: fn(&ChangeSpec) -> Option<f64>| changes.iter().filter_map(of);
    let ranges = ScaleRanges {
        translation: Some(ScaleRange::position(
            coupling.position_scale,
            factor,
            stated(|change| change.position_scale),
        )),
        rotation: endpoint.ranges().rotation.and(Some(ScaleRange::rotation(
            coupling.rotation_scale,
            factor,
            stated(|change| change.rotation_scale),
        ))),
    };
    let mut endpoint = endpoint.with_ranges(ranges).with_samples(slave_samples(scene));
    if let Some(method) = method(scene)? {
        endpoint = endpoint.with_coupling(&method);
        let play_out = play_out(&coupling.numbers, &endpoint.exchange)?;
        endpoint.set_play_out(play_out);
    }
    for (method, play_out) in alternatives(scene, &endpoint.exchange)? {
        endpoint = endpoint.with_alternative(method, play_out);
    }
    endpoint.exchange.set_kind(scene.master.kind);
    if scene.master.buttons.is_some() {
        endpoint.exchange.carry_buttons();
    }
    Ok(endpoint)
}

/// Return the trigger that leads the gripper of the scene's arm: the operator's or a driver's; none without a gripper.
pub(super) fn trigger<const N: usize>(
    scene: &SceneSpec<N>,
    is_driven: bool,
) -> Result<Option<Trigger>, SceneError> {
    let (arm, _) = scene.coupled()?;
    if arm.gripper.is_none() {
        return Ok(None);
    }
    if is_driven {
        return Ok(Some(Trigger::Driven(None)));
    }
    simulated_trigger(scene, arm).map(Some)
}

/// Build the model of the gripper of the scene's arm.
pub(super) fn simulated_gripper<const N: usize>(
    scene: &SceneSpec<N>,
) -> Result<Option<SlaveGripper>, SceneError> {
    Ok(scene.coupled()?.0.gripper.map(SlaveGripper::simulated).transpose()?)
}

/// Build the scene's arm in its environment.
pub(super) fn simulated_arm<const N: usize>(scene: &SceneSpec<N>) -> Result<SimulatedSlave<N>, SceneError> {
    let (slave, _) = scene.coupled()?;
    let surroundings = environment(scene.environment.as_ref())?;
    let surroundings = if is_aimed_by_person(scene) { surroundings.to_be_pushed() } else { surroundings };
    Ok(SimulatedSlave::in_environment(
        slave.model()?,
        surroundings,
        slave.force_sensor.as_ref().map(|sensor| sensor.sensor(scene.run.seed)).transpose()?,
        slave.position,
        0,
    )?)
}

/// Let the hand of the plant wait at the start of its path until the sides engage, unless it follows aims.
pub(super) fn with_waiting_hand<const N: usize>(mut plant: SimulatedMaster<N>) -> SimulatedMaster<N> {
    plant.set_waiting(!plant.is_aimed());
    plant
}

/// Device of a live master.
pub type LiveDevice<const N: usize> = Box<dyn MasterPlant<N> + Send>;

/// Build the scene's device in the scene's hand, which waits for the engagement.
fn simulated_device<const N: usize>(scene: &SceneSpec<N>) -> Result<LiveDevice<N>, SceneError> {
    Ok(Box::new(with_waiting_hand(exact_master(scene)?)))
}

/// Build the master with the scene's device in the scene's hand; `run_id` is drawn at random at every start.
///
/// # Errors
///
/// A number or combination of settings is invalid. All builders of a side return such errors.
pub fn simulated_master<const N: usize>(
    scene: &SceneSpec<N>,
    run_id: u64,
) -> Result<Timed<MasterSide<LiveDevice<N>, N>>, SceneError> {
    let plant = simulated_device(scene)?;
    let is_aimed = is_aimed_by_person(scene);
    // A person who aims presses the clutch as well.
    let clutch = if is_aimed { driven_clutch(scene, false)? } else { live_clutch(scene) };
    let side = MasterSide::new(plant, master_endpoint(scene, run_id, None)?, clutch)?
        .with_trigger(trigger(scene, false)?)
        .with_buttons(scene.master.buttons)?;
    Ok(Timed::new(side, master_commands(scene)?).aimed(is_aimed))
}

/// Same as [`simulated_master`], with a device that turns.
///
/// # Errors
///
/// As [`simulated_master`].
pub fn simulated_pose_master(
    scene: &SceneSpec<3>,
    run_id: u64,
) -> Result<Timed<MasterSide<LiveDevice<3>, 3, MasterRotation>>, SceneError> {
    let plant: LiveDevice<3> = Box::new(pose::turning_master(scene, simulated_device(scene)?)?);
    let side = MasterSide::new(plant, master_endpoint(scene, run_id, None)?, live_clutch(scene))?
        .with_trigger(trigger(scene, false)?)
        .with_buttons(scene.master.buttons)?
        .recording_rotation();
    Ok(Timed::new(side, commands::<3>(scene.coupled()?.1)?))
}

/// Build the slave with the scene's arm in the scene's environment.
///
/// # Errors
///
/// As [`simulated_master`].
pub fn simulated_slave<const N: usize>(
    scene: &SceneSpec<N>,
    run_id: u64,
) -> Result<Timed<SlaveSide<SimulatedSlave<N>, N>>, SceneError> {
    research_controller(scene, None)?; // refused as at its master
    let side = SlaveSide::new(simulated_arm(scene)?, slave_endpoint(scene, run_id)?)
        .with_gripper(simulated_gripper(scene)?);
    Ok(Timed::new(side, commands::<N>(scene.coupled()?.1)?).aimed(is_aimed_by_person(scene)))
}

/// Same as [`simulated_slave`], with an arm that turns.
///
/// # Errors
///
/// As [`simulated_master`].
pub fn simulated_pose_slave(
    scene: &SceneSpec<3>,
    run_id: u64,
) -> Result<Timed<SlaveSide<SimulatedTool, 3, SlaveRotation>>, SceneError> {
    let (_, coupling) = scene.coupled()?;
    let side = SlaveSide::new(pose::simulated_tool(scene)?, slave_endpoint(scene, run_id)?)
        .with_gripper(simulated_gripper(scene)?)
        .with_reference_point(pose::reference_point(coupling)?)
        .recording_rotation();
    Ok(Timed::new(side, commands::<3>(coupling)?))
}

/// Build the master with a device that a driver reads and writes. With `simulated_clutch`, a simulated operator
/// presses the clutch of a device without a button again after a hold.
///
/// # Errors
///
/// As [`simulated_master`], and if the scene has press times of the clutch.
pub fn driven_master<const N: usize>(
    scene: &SceneSpec<N>,
    run_id: u64,
    simulated_clutch: bool,
) -> Result<Timed<MasterSide<LiveDevice<N>, N>>, SceneError> {
    let device: LiveDevice<N> = Box::<DrivenMaster<N>>::default();
    let side = MasterSide::new(
        device,
        master_endpoint(scene, run_id, None)?,
        driven_clutch(scene, simulated_clutch)?,
    )?
    .with_trigger(trigger(scene, true)?)
    .with_buttons(scene.master.buttons)?;
    Ok(Timed::new(side, commands::<N>(scene.coupled()?.1)?))
}

/// Build the slave with an arm that a driver reads and writes.
///
/// # Errors
///
/// As [`simulated_master`].
pub fn driven_slave<const N: usize>(
    scene: &SceneSpec<N>,
    run_id: u64,
) -> Result<Timed<SlaveSide<DrivenSlave<N>, N>>, SceneError> {
    let (slave, coupling) = scene.coupled()?;
    research_controller(scene, None)?; // refused as at its master
    let plant = DrivenSlave::new(slave.max_acceleration.unwrap_or(DECELERATION))
        .map_err(|error| SceneError::Contradiction(format!("slave.max_acceleration: {error}")))?;
    let gripper = slave.gripper.map(SlaveGripper::driven).transpose()?;
    let side = SlaveSide::new(plant, slave_endpoint(scene, run_id)?)
        .with_gripper(gripper)
        .with_reference_point(pose::reference_point(coupling)?);
    Ok(Timed::new(side, commands::<N>(coupling)?))
}
