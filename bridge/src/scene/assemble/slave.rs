//! The arm of a scene and its force sensor.

use haptether_slave::{ArmControl, ArmModel, ForceSensor};

use super::{
    super::spec::{ControlSpec, SlaveSpec},
    axes::axes,
    error::SceneError,
};

pub(crate) fn arm(spec: &SlaveSpec) -> Result<ArmModel, SceneError> {
    let control = match spec.control {
        ControlSpec::Position => ArmControl::Position { bandwidth_hz: spec.bandwidth_hz },
        ControlSpec::Velocity => ArmControl::Velocity { bandwidth_hz: spec.bandwidth_hz },
        ControlSpec::Pd => ArmControl::Pd { stiffness: spec.stiffness, damping: spec.damping },
    };
    Ok(ArmModel::new(control, spec.mass_kg, spec.max_speed, spec.max_acceleration)?)
}

pub(crate) fn force_sensor<const N: usize>(
    spec: &SlaveSpec,
    seed: u64,
) -> Result<Option<ForceSensor<N>>, SceneError> {
    let Some(sensor) = &spec.force_sensor else { return Ok(None) };
    let bias = axes("slave.force_sensor.bias_n", &sensor.bias_n)?;
    Ok(Some(ForceSensor::new(sensor.noise_n, bias, sensor.quantum_n, sensor.rate_hz, seed)?))
}
