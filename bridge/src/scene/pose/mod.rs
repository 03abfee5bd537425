//! Scenes of kind `pose`: builders of a hand, an arm and a world that turn.

mod measures;

use std::any::Any;

use haptether_master::{RotationHand, RotationParameters, SimulatedRotation};
use haptether_safety::{
    LimiterSettings, RotationModel,
    controller::{ControllerKind, FRICTION_ROOM, SafetySettings},
};
use haptether_slave::{PushKind, PusherSettings, SeriesSettings, SimulatedTool, ToolWorldSettings};

pub(super) use measures::RotationMeasures;

use super::{
    assemble::{SceneError, contradiction, limiter},
    sides::{arm_response, stiffest_wall},
    spec::{CouplingSpec, EnvironmentSpec, RotationSafetySpec, SceneSpec, TorqueKind, TorqueSpec},
};
use crate::{
    EndpointError, MasterRotationSettings, SideKind, SlaveRotationSettings, TurningMaster,
    coupling::{CouplingError, Gains, ReferencePoint, RotationLock, VirtualToolSettings},
};

/// Return the scene as one of kind `pose`, or none if it is of another kind.
///
/// # Errors
///
/// The scene is of kind `pose` and does not have three axes.
pub fn as_pose<const N: usize>(scene: &SceneSpec<N>) -> Result<Option<&SceneSpec<3>>, SceneError> {
    let SideKind::Pose = scene.master.kind else { return Ok(None) };
    match (scene as &dyn Any).downcast_ref() {
        Some(scene) => Ok(Some(scene)),
        None => contradiction(format!("master.axes = {N}: kind = \"pose\" must have 3")),
    }
}

/// Return an error if the kind of the scene cannot have N axes.
pub(super) fn check_kind<const N: usize>(scene: &SceneSpec<N>) -> Result<(), SceneError> {
    let kind = scene.master.kind;
    if kind.has_axes(N) {
        return Ok(());
    }
    let allowed = match kind {
        SideKind::Linear => "1 to 3",
        SideKind::Joints => "1 to 7",
        SideKind::Pose => "3",
    };
    contradiction(format!("master.axes = {N}: kind = \"{}\" must have {allowed}", kind.name()))
}

/// Unit quaternion without rotation.
const STRAIGHT: [f64; 4] = [1.0, 0.0, 0.0, 0.0];

/// Build the scene's device with rotation in the scene's hand, which waits for the engagement.
pub(super) fn turning_master<P, const N: usize>(
    scene: &SceneSpec<N>,
    point: P,
) -> Result<TurningMaster<P>, SceneError> {
    let hand = match scene.operator.as_ref().and_then(|operator| operator.rotation.as_ref()) {
        Some(hand) => RotationHand::new(hand)?,
        None => RotationHand::absent(STRAIGHT)?,
    };
    let mut body = SimulatedRotation::new(rotation_of(scene)?, hand, 0)?;
    body.set_waiting(true);
    Ok(TurningMaster { point, body })
}

fn rotation_of<const N: usize>(scene: &SceneSpec<N>) -> Result<RotationParameters, SceneError> {
    match scene.master.rotation {
        Some(rotation) => Ok(rotation),
        None => contradiction("master.rotation: is missing, kind = \"pose\" needs it"),
    }
}

/// Return the settings of the torque's safety layer: those of the scene, by default those of the force at a lever.
pub(super) fn master_rotation<const N: usize>(
    scene: &SceneSpec<N>,
    coupling: &CouplingSpec,
) -> Result<MasterRotationSettings, SceneError> {
    let parameters = rotation_of(scene)?;
    parameters.check()?;
    let device = RotationModel::new(parameters.inertia_kg_m2, parameters.viscous, parameters.coulomb)?;
    let Some(own) = &scene.safety.rotation else {
        return contradiction("safety.rotation: is missing, kind = \"pose\" needs it");
    };
    if !(own.lever_m > 0.0 && own.lever_m.is_finite()) {
        return contradiction(format!("safety.rotation.lever_m = {}: must be above 0", own.lever_m));
    }
    let at_lever = scene.safety.settings.at_lever(own.lever_m);
    // Largest damping of a sampled device, for its lightest axis.
    let most = parameters.inertia_kg_m2.min() / (5.0 * scene.run.period_s);
    let damping = own.damping.unwrap_or(at_lever.damping.min(most));
    // The torque probe is scaled like the damping against it, so that it moves the handle at the lever as the force
    // probe does.
    let weaker = if at_lever.damping > 0.0 { damping / at_lever.damping } else { 1.0 };
    let safety = SafetySettings {
        controllers: own.controllers.unwrap_or(at_lever.controllers),
        damping,
        velocity_threshold: own.velocity_threshold.unwrap_or(at_lever.velocity_threshold),
        vfc_force_threshold_n: own.vfc_torque_threshold_n_m.unwrap_or(at_lever.vfc_force_threshold_n),
        grasp_threshold: own.grasp_threshold.unwrap_or(at_lever.grasp_threshold),
        grasp_floor_n: own.grasp_floor_n_m.unwrap_or(at_lever.grasp_floor_n),
        hsc_force_threshold_n: own.hsc_torque_threshold_n_m.unwrap_or(at_lever.hsc_force_threshold_n),
        energy_threshold_j: own.energy_threshold_j.unwrap_or(at_lever.energy_threshold_j),
        pc_max_damping: own.pc_max_damping.unwrap_or(at_lever.pc_max_damping.min(most)),
        probe_force_n: at_lever.probe_force_n * weaker,
        ..at_lever
    };
    // A probe that friction of the handle hides is not used. If trips are shared and the force has a probe, that probe
    // decides for both. Otherwise the layer detects a hand that turns the handle; without a number of tries, the probe
    // is refused.
    let of_force = &scene.safety.settings;
    let force_asks = of_force.probe_force_n > 0.0
        && ControllerKind::cancelling().any(|kind| of_force.controllers.contains(kind));
    let decides = safety.probe_force_n > 0.0
        && safety.probe_force_n * safety.probe_threshold >= FRICTION_ROOM * parameters.coulomb;
    let safety = if decides {
        safety
    } else if own.shares_trips && force_asks {
        SafetySettings { probe_force_n: 0.0, release_tries: 0, ..safety }
    } else if safety.release_tries > 0 {
        SafetySettings { probe_force_n: 0.0, ..safety }
    } else {
        safety
    };
    let bounds = limiter(&scene.safety).at_lever(own.lever_m);
    let max_torque_n_m = own.max_torque_n_m.or(parameters.max_torque_n_m).unwrap_or(bounds.max_force_n);
    let limiter = LimiterSettings {
        max_force_n: max_torque_n_m,
        max_slew_n_per_s: own.max_slew_n_m_per_s.unwrap_or(bounds.max_slew_n_per_s),
        max_power_w: own.max_power_w.unwrap_or(bounds.max_power_w),
        ..bounds
    };
    let estimator = scene.safety.estimator.at_lever(own.lever_m);
    let estimator = own.quantum_rad.map_or(estimator, |quantum| estimator.with_quantum(quantum));
    Ok(MasterRotationSettings {
        device,
        estimator,
        safety,
        limiter,
        torque_scale: coupling.torque_scale,
        shares_trips: own.shares_trips,
    })
}

/// Return gains and virtual tool of the rotation: by default the `gains` of the force at the lever, and an inertia that
/// the tool's servo can follow, as that of the force.
pub(super) fn coupled_rotation<const N: usize>(
    scene: &SceneSpec<N>,
    gains: &Gains,
) -> Result<(Gains, VirtualToolSettings), SceneError> {
    let (arm, coupling) = scene.coupled()?;
    let name = coupling.numbers.kind.name();
    if coupling.rotation_scale != 1.0 || rotation_lock(coupling) != Ok(RotationLock::Free) {
        return contradiction(format!(
            "coupling.kind = \"{name}\": needs rotation_scale = 1 and no lock of the rotation; only \"position-force\" \
             has them"
        ));
    }
    let Some(RotationSafetySpec { lever_m, .. }) = &scene.safety.rotation else {
        return contradiction("safety.rotation: is missing, kind = \"pose\" needs it");
    };
    let lever = lever_m * lever_m;
    let scaled = Gains {
        stiffness: coupling.numbers.rotational_stiffness.unwrap_or(gains.stiffness * lever),
        damping: coupling.numbers.rotational_damping.unwrap_or(gains.damping * lever),
        impedance: gains.impedance * lever,
        most_damping: gains.most_damping * lever,
        start_j: 0.5 * gains.start_j,
        ..*gains
    };
    let (w, lag_s) = match &arm.tool {
        Some(tool) => ((tool.rotational_stiffness / tool.inertia_kg_m2.max()).sqrt(), 0.0),
        None => arm_response(arm),
    };
    let inertia = stiffest_wall(scene) * lever / (0.4 * w).powi(2);
    let lead_s = coupling.numbers.tool_lead_s.unwrap_or(lag_s);
    let gains = scaled.checked();
    let tool = VirtualToolSettings::new(inertia, None, lead_s);
    Ok(gains.and_then(|gains| Ok((gains, tool?))).map_err(EndpointError::from)?)
}

/// Return the lock of the slave's rotation.
pub(super) fn rotation_lock(coupling: &CouplingSpec) -> Result<RotationLock, CouplingError> {
    match (coupling.locks_rotation, coupling.rotation_axis) {
        (true, _) => Ok(RotationLock::Locked),
        (false, Some(axis)) => RotationLock::only_about(axis),
        (false, None) => Ok(RotationLock::Free),
    }
}

/// Return the settings of the slave's rotation.
pub(super) fn slave_rotation(coupling: &CouplingSpec) -> Result<SlaveRotationSettings, CouplingError> {
    Ok(SlaveRotationSettings {
        rotation_scale: coupling.rotation_scale,
        lock: rotation_lock(coupling)?,
        bounds: coupling.rotation_bounds,
        alignment: coupling.alignment,
    })
}

/// Return the coupled point of the tool; none if it is the tool point.
pub(super) fn reference_point(coupling: &CouplingSpec) -> Result<Option<ReferencePoint>, SceneError> {
    let wrong = |error| SceneError::Contradiction(format!("coupling.{error}"));
    coupling.reference_point.map(ReferencePoint::new).transpose().map_err(wrong)
}

/// Build the scene's tool in its world.
pub(super) fn simulated_tool(scene: &SceneSpec<3>) -> Result<SimulatedTool, SceneError> {
    let (slave, _) = scene.coupled()?;
    let Some(tool) = &slave.tool else {
        return contradiction("slave.tool: is missing, kind = \"pose\" needs it");
    };
    let world = scene.environment.as_ref().map(world).unwrap_or_default();
    Ok(SimulatedTool::new(slave, tool, &world, 0)?)
}

fn world(environment: &EnvironmentSpec<3>) -> ToolWorldSettings {
    let EnvironmentSpec { objects, pushers, torques, holes, handles, bodies, .. } = environment;
    let torques = torques.iter().map(|torque| {
        let TorqueSpec { shape, at_s, duration_s, rise_s, frequency_hz, torque_n_m } = *torque;
        let shape = match shape {
            TorqueKind::Step => PushKind::Step,
            TorqueKind::Ramp => PushKind::Ramp,
            TorqueKind::HalfSine => PushKind::HalfSine,
            TorqueKind::Sine => PushKind::Sine,
        };
        let recorded: Option<SeriesSettings<3>> = None;
        PusherSettings { shape, at_s, duration_s, rise_s, frequency_hz, force_n: torque_n_m, recorded }
    });
    ToolWorldSettings {
        objects: objects.clone(),
        pushers: pushers.clone(),
        torques: torques.collect(),
        holes: holes.clone(),
        handles: handles.clone(),
        bodies: bodies.clone(),
    }
}
