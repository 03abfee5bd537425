//! The device of a scene and the hand that holds it.

use haptether_master::{Hand, Leg, LegShape, Path, SimulatedMaster};
use haptether_safety::DeviceModel;

use super::{
    super::spec::{ClutchSpec, MasterSpec, OperatorSpec, SceneSpec},
    SceneError, contradiction, ns,
    touched::walls_on_device,
};
use crate::Clutch;

/// Build the device in the hand.
pub(crate) fn exact_master<const N: usize>(scene: &SceneSpec<N>) -> Result<SimulatedMaster<N>, SceneError> {
    let MasterSpec { device, position, velocity, .. } = scene.master;
    device.check()?;
    let mut master = SimulatedMaster::new(device, hand(scene)?, 0)?.with_walls(walls_on_device(scene)?)?;
    master.place(position, velocity)?;
    let is_aimed = scene.operator.as_ref().is_some_and(|operator| operator.aims.is_some());
    if is_aimed { Ok(master.aimed()?) } else { Ok(master) }
}

/// Return the model of the device for the safety layer.
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

/// Shortest leg of a path in s; `bridge/scene/resolve.py` refuses recorded points that are closer.
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

/// Default reaction time of a simulated operator in ns.
const REACTION_NS: u64 = 500_000_000;

/// Return the clutch of a simulated operator who presses again after a hold, with the scene's reaction time.
fn automatic<const N: usize>(scene: &SceneSpec<N>) -> Clutch {
    let reaction_ns = scene.operator.as_ref().map_or(REACTION_NS, |operator| ns(operator.clutch_reaction_s));
    Clutch::Auto { reaction_ns }
}

/// Return the clutch of a simulated master in virtual time, where no person can be hurt.
pub(crate) fn clutch<const N: usize>(scene: &SceneSpec<N>) -> Clutch {
    if scene.operator.is_none() { automatic(scene) } else { live_clutch(scene) }
}

/// Return the clutch of a simulated master with the scene's operator. The arm may be real, so without an operator
/// nothing presses again.
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

/// Return the clutch of a real device without a button: pressed at the start, and again only by a person.
///
/// The simulated operator of the scene is ignored, but an empty list of times leaves the clutch open. With
/// `simulated`, a simulated operator presses the clutch.
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
