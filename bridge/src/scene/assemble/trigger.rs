//! The trigger of a scene, the finger that holds it, and its safety settings.

use haptether_master::{DeviceParameters, Hand, Leg, LegShape, Path};
use haptether_safety::{Axes, DeviceModel, LimiterSettings, controller::SafetySettings};
use haptether_slave::ArmSettings;

use super::{
    super::spec::{FingerSpec, SceneSpec, TriggerSpec},
    SceneError, contradiction,
};
use crate::{HeldTrigger, Trigger, TriggerSettings};

/// Force in N for which the hand's thresholds hold if the scene bounds none: that of a PHANTOM Desktop.
const HAND_FORCE_N: f64 = 7.9;

/// Return the trigger with force feedback, after a check that it leads a gripper.
fn felt<const N: usize>(
    scene: &SceneSpec<N>,
    arm: &ArmSettings<N>,
) -> Result<Option<TriggerSpec>, SceneError> {
    let Some(trigger) = scene.master.gripper else { return Ok(None) };
    if arm.gripper.is_none() {
        return contradiction("master.gripper: leads no gripper, slave.gripper is missing");
    }
    if scene.master.buttons.is_some_and(|buttons| buttons.gripper.is_some()) {
        return contradiction("master.buttons.gripper: a trigger that the finger feels leads the gripper");
    }
    Ok(Some(trigger))
}

/// Return the force feedback of the scene's trigger, or none.
pub(crate) fn trigger_feedback<const N: usize>(
    scene: &SceneSpec<N>,
    arm: &ArmSettings<N>,
) -> Result<Option<TriggerSettings>, SceneError> {
    let Some(own) = felt(scene, arm)? else { return Ok(None) };
    let TriggerSpec { travel_m, mass_kg, viscous, coulomb, max_force_n, .. } = own;
    let Some(watched) = scene.safety.gripper else {
        return contradiction("safety.gripper: is missing, master.gripper needs it");
    };
    if !(watched.reach_m > 0.0 && watched.reach_m.is_finite()) {
        return contradiction(format!("safety.gripper.reach_m = {}: must be above 0", watched.reach_m));
    }
    let of_hand = scene.safety.limiter.map_or(HAND_FORCE_N, |limiter| limiter.max_force_n);
    let scaled = scene.safety.settings.at_scale(max_force_n / of_hand, travel_m / watched.reach_m);
    // Largest damping of a sampled device.
    let most = mass_kg / (5.0 * scene.run.period_s);
    let safety = SafetySettings {
        controllers: watched.controllers.unwrap_or(scaled.controllers),
        damping: watched.damping.unwrap_or(scaled.damping.min(most)),
        velocity_threshold: watched.velocity_threshold.unwrap_or(scaled.velocity_threshold),
        vfc_force_threshold_n: watched.vfc_force_threshold_n.unwrap_or(scaled.vfc_force_threshold_n),
        grasp_threshold: watched.grasp_threshold.unwrap_or(scaled.grasp_threshold),
        grasp_floor_n: watched.grasp_floor_n.unwrap_or(scaled.grasp_floor_n),
        hsc_force_threshold_n: watched.hsc_force_threshold_n.unwrap_or(scaled.hsc_force_threshold_n),
        energy_threshold_j: watched.energy_threshold_j.unwrap_or(scaled.energy_threshold_j),
        pc_max_damping: watched.pc_max_damping.unwrap_or(scaled.pc_max_damping.min(most)),
        // A released trigger does not fly like a stylus, so its force returns after a time, without a probe.
        probe_force_n: 0.0,
        release_tries: 0,
        ..scaled
    };
    let quantum = (own.encoder_quantum > 0.0).then_some(own.encoder_quantum);
    let estimator = scene.safety.estimator;
    let estimator = quantum.map_or(estimator, |quantum| estimator.with_quantum(quantum));
    Ok(Some(TriggerSettings {
        travel_m,
        device: DeviceModel::uniform(mass_kg, viscous, coulomb)?,
        estimator,
        safety,
        limiter: LimiterSettings {
            max_force_n,
            max_slew_n_per_s: own.max_slew_n_per_s,
            max_power_w: own.max_power_w,
            ramp_in_s: 0.0,
        },
        force_scale: own.force_scale,
    }))
}

/// Build the model of the gripper's trigger: a course over time, or a finger that follows it and feels the trigger.
pub(crate) fn simulated_trigger<const N: usize>(
    scene: &SceneSpec<N>,
    arm: &ArmSettings<N>,
) -> Result<Trigger, SceneError> {
    let course = scene.operator.as_ref().map_or(&[][..], |operator| &operator.trigger);
    let open = [[0.0, 0.0]];
    let course = if course.is_empty() { &open } else { course };
    // The ranges of the course are checked in both cases.
    let trigger = Trigger::simulated(course)?;
    let Some(own) = felt(scene, arm)? else { return Ok(trigger) };
    let device = DeviceParameters {
        encoder_quantum: own.encoder_quantum,
        measures_velocity: false,
        max_force_n: own.max_force_n,
        ..DeviceParameters::ideal(own.mass_kg, own.viscous, own.coulomb)
    };
    let held = HeldTrigger::new(device, own.travel_m, finger(scene, course, own.travel_m)?)?;
    Ok(Trigger::Held(Box::new(held)))
}

/// Build a finger whose target is the trigger's course.
fn finger<const N: usize>(
    scene: &SceneSpec<N>,
    course: &[[f64; 2]],
    travel_m: f64,
) -> Result<Hand<1>, SceneError> {
    let at = |position: f64| Axes::<1>::new(position * travel_m);
    let Some(FingerSpec { stiffness, damping, strength_n, release }) =
        scene.operator.as_ref().and_then(|operator| operator.finger)
    else {
        return Ok(Hand::absent(at(0.0))?);
    };
    let mut legs = Vec::with_capacity(course.len());
    let mut before_s = 0.0;
    for [at_s, position] in course {
        if *at_s > before_s {
            legs.push(Leg { duration_s: at_s - before_s, end: at(*position), shape: LegShape::Linear });
            before_s = *at_s;
        }
    }
    let path = Path::new(at(course[0][1]), legs)?;
    Ok(Hand::new(stiffness, damping, strength_n.unwrap_or(f64::INFINITY), path, release)?)
}
