//! The device of a scene, and how it is advanced.

use haptether_master::{DeviceParameters, Friction, SimulatedMaster, SteppedMaster, Stepping};
use haptether_safety::{Axes, DeviceModel};

use super::{
    super::spec::{FrictionSpec, IntegratorSpec, MasterSpec, SceneSpec},
    axes::axes,
    error::{SceneError, contradiction},
    operator::hand,
    walls::walls_on_device,
};

fn device<const N: usize>(spec: &MasterSpec) -> Result<DeviceParameters<N>, SceneError> {
    let stops = match &spec.stops {
        Some(stops) if stops.len() == N => {
            (Axes::from_fn(|axis, _| stops[axis].0), Axes::from_fn(|axis, _| stops[axis].1))
        }
        Some(stops) => {
            return contradiction(format!(
                "master.stops: {} pairs, must have {N}, one per axis",
                stops.len()
            ));
        }
        None => (Axes::repeat(f64::NEG_INFINITY), Axes::repeat(f64::INFINITY)),
    };
    let device = DeviceParameters {
        mass_kg: axes("master.mass_kg", &spec.mass_kg)?,
        viscous: axes("master.viscous", &spec.viscous)?,
        coulomb: axes("master.coulomb", &spec.coulomb)?,
        friction: match spec.friction {
            FrictionSpec::Vector => Friction::Vector,
            FrictionSpec::Axis => Friction::Axis,
        },
        encoder_quantum: spec.encoder_quantum,
        measures_velocity: spec.measures_velocity,
        stops,
        max_force_n: spec.max_force_n.unwrap_or(f64::INFINITY),
        force_quantum_n: spec.force_quantum_n,
    };
    device.check()?;
    Ok(device)
}

pub(crate) fn device_model<const N: usize>(spec: &MasterSpec) -> Result<DeviceModel<N>, SceneError> {
    Ok(DeviceModel::new(
        axes("master.mass_kg", &spec.mass_kg)?,
        axes("master.viscous", &spec.viscous)?,
        axes("master.coulomb", &spec.coulomb)?,
    )?)
}

/// Most steps of an integrator in one run: minutes.
const MAX_STEPS: f64 = 1e9;

/// The device advanced by its exact solution.
pub(crate) fn exact_master<const N: usize>(scene: &SceneSpec) -> Result<SimulatedMaster<N>, SceneError> {
    let mut master =
        SimulatedMaster::new(device(&scene.master)?, hand(scene)?, 0)?.among(walls_on_device(scene)?)?;
    let position = axes("master.position", &scene.master.position)?;
    master.place(position, axes("master.velocity", &scene.master.velocity)?)?;
    Ok(master)
}

/// The device advanced in steps.
pub(crate) fn stepped_master<const N: usize>(
    scene: &SceneSpec,
    stepping: Stepping,
) -> Result<SteppedMaster<N>, SceneError> {
    let step_s = scene.run.step_s.unwrap_or(scene.run.period_s);
    let steps = scene.run.period_s / step_s;
    if !(step_s > 0.0 && steps >= 1.0 - 1e-9 && (steps - steps.round()).abs() < 1e-6 * steps) {
        return contradiction(format!(
            "run.step_s = {step_s}: must go a whole number of times into period_s = {}",
            scene.run.period_s
        ));
    }
    let total = steps * scene.run.duration_s / scene.run.period_s;
    if total > MAX_STEPS {
        return contradiction(format!(
            "run.step_s = {step_s}: makes {total:.3e} steps of the run, must be at most {MAX_STEPS:e}"
        ));
    }
    let (device, hand, walls) = (device(&scene.master)?, hand(scene)?, walls_on_device(scene)?);
    let mut master =
        SteppedMaster::new(&device, &hand, &walls, stepping, step_s, scene.master.friction_speed)?;
    let position = axes("master.position", &scene.master.position)?;
    master.place(position, axes("master.velocity", &scene.master.velocity)?)?;
    Ok(master)
}

/// The method of an integrator that has steps.
pub(crate) fn stepping(integrator: IntegratorSpec) -> Option<Stepping> {
    match integrator {
        IntegratorSpec::Exact => None,
        IntegratorSpec::SemiImplicitEuler => Some(Stepping::SemiImplicitEuler),
        IntegratorSpec::VelocityVerlet => Some(Stepping::VelocityVerlet),
        IntegratorSpec::Rk4 => Some(Stepping::RungeKutta4),
    }
}
