//! The device of a scene and the hand that holds it.

use haptether_master::{Hand, Leg, LegShape, Path, SimulatedMaster};
use haptether_safety::DeviceModel;

use super::{
    super::spec::{ClutchSpec, MasterSpec, OperatorSpec, SceneSpec},
    SceneError, contradiction, ns,
    touched::walls_on_device,
};
use crate::Clutch;

/// The device in the hand.
pub(crate) fn exact_master<const N: usize>(scene: &SceneSpec<N>) -> Result<SimulatedMaster<N>, SceneError> {
    let MasterSpec { device, position, velocity, .. } = scene.master;
    device.check()?;
    let mut master = SimulatedMaster::new(device, hand(scene)?, 0)?.among(walls_on_device(scene)?)?;
    master.place(position, velocity)?;
    Ok(master)
}

/// What the safety layer takes the device for.
pub(crate) fn device_model<const N: usize>(scene: &SceneSpec<N>) -> Result<DeviceModel<N>, SceneError> {
    let device = &scene.master.device;
    Ok(DeviceModel::new(device.mass_kg, device.viscous, device.coulomb)?)
}

fn hand<const N: usize>(scene: &SceneSpec<N>) -> Result<Hand<N>, SceneError> {
    let Some(spec) = &scene.operator else { return Ok(Hand::absent(scene.master.position)?) };
    let strength = spec.grip_strength_n.unwrap_or(f64::INFINITY);
    let mut hand = Hand::new(spec.stiffness, spec.damping, strength, path(spec)?, spec.release)?;
    if let Some(regrasp) = spec.regrasp {
        hand = hand.with_regrasp(regrasp)?;
    }
    if let Some(tremor) = spec.tremor {
        hand = hand.with_tremor(tremor)?;
    }
    Ok(hand)
}

/// Shortest leg of a path in s; `bridge/scene/resolve.py` lets no two points of a recording be closer.
const MIN_LEG_S: f64 = 1e-9;

fn path<const N: usize>(spec: &OperatorSpec<N>) -> Result<Path<N>, SceneError> {
    let Some(recorded) = &spec.recorded else { return Ok(Path::new(spec.start, spec.legs.clone())?) };
    let (times, values) = (&recorded.time_s, &recorded.values);
    if times.is_empty() || times.len() != values.len() {
        return contradiction("operator.recorded: must have as many values as times, and at least one");
    }
    let mut legs = Vec::with_capacity(values.len());
    let mut before = 0.0;
    for (time, value) in times.iter().zip(values) {
        if *time - before >= MIN_LEG_S {
            legs.push(Leg { duration_s: time - before, end: *value, shape: LegShape::Linear });
            before = *time;
        }
    }
    Ok(Path::new(values[0], legs)?)
}

/// Reaction of a simulated operator in ns where the scene has none.
const REACTION_NS: u64 = 500_000_000;

/// A simulated operator who presses anew, as quick as that of the scene.
fn automatic<const N: usize>(scene: &SceneSpec<N>) -> Clutch {
    let reaction_ns = scene.operator.as_ref().map_or(REACTION_NS, |operator| ns(operator.clutch_reaction_s));
    Clutch::Auto { reaction_ns }
}

/// How the clutch of a simulated master is worked in virtual time, where nobody can be hurt.
pub(crate) fn clutch<const N: usize>(scene: &SceneSpec<N>) -> Clutch {
    if scene.operator.is_none() { automatic(scene) } else { live_clutch(scene) }
}

/// How the clutch of a simulated master is worked live, where the arm may be a real one: only an operator presses anew.
pub(crate) fn live_clutch<const N: usize>(scene: &SceneSpec<N>) -> Clutch {
    let Some(operator) = &scene.operator else { return Clutch::Once };
    match (&operator.clutch_times, operator.clutch) {
        (Some(times), _) => {
            Clutch::Schedule(times.iter().map(|(press, release)| (ns(*press), ns(*release))).collect())
        }
        (None, ClutchSpec::Once) => Clutch::Once,
        (None, ClutchSpec::Auto) => automatic(scene),
    }
}

/// How the clutch of a real device without a button is worked: by its start and by whoever presses it anew. The scene's
/// operator, who is simulated, has no say, but that times without a press leave it open; `simulated` has a simulated
/// operator press all the same.
pub(crate) fn driven_clutch<const N: usize>(
    scene: &SceneSpec<N>,
    simulated: bool,
) -> Result<Clutch, SceneError> {
    let times = scene.operator.as_ref().and_then(|operator| operator.clutch_times.as_deref());
    match times {
        Some([]) => Ok(Clutch::Schedule(Vec::new())),
        Some(_) => contradiction(
            "operator.clutch: times press the clutch of a real device without a person: must be \"once\", \"auto\" or []",
        ),
        None if simulated => Ok(automatic(scene)),
        None => Ok(Clutch::Once),
    }
}
