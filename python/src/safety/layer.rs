//! The whole pipeline of a master's tick.

use haptether_safety::{
    Axes, Fault, LayerSettings, LimiterSettings, SafetyLayer, SafetyTick, Signal, estimator::EstimatorKind,
};
use pyo3::prelude::*;

use super::{
    controller::PySafetySettings,
    device::{AnyDevice, PyDeviceModel},
    estimator::PyEstimatorKind,
    limiter::PyLimiterSettings,
    samples::PySampleBounds,
};
use crate::{
    arrays::{Sample, Samples, SignalArray, column, sample_out},
    axes::{build_like, per_axes, refuse, with_axes},
};

per_axes!(
    /// A safety layer of any number of axes.
    AnyLayer,
    SafetyLayer
);

#[documented]
#[pyclass(name = "SafetyLayer", module = "haptether.safety")]
pub(crate) struct PySafetyLayer {
    inner: AnyLayer,
    axes: usize,
}

#[documented]
#[pyclass(name = "SafetyTick", module = "haptether.safety", frozen, get_all)]
pub(crate) struct PySafetyTick {
    velocity: Py<PyAny>,
    acceleration: Py<PyAny>,
    rendered_force: Py<PyAny>,
    grasp_force: Py<PyAny>,
    safety_force: Py<PyAny>,
    device_force: Py<PyAny>,
    tripped: u8,
    acted: u8,
    fault: u8,
    owed_energy_j: f64,
}

#[documented]
#[pyclass(name = "SafetyTicks", module = "haptether.safety", frozen, get_all)]
pub(crate) struct PySafetyTicks {
    velocity: Py<PyAny>,
    acceleration: Py<PyAny>,
    rendered_force: Py<PyAny>,
    grasp_force: Py<PyAny>,
    safety_force: Py<PyAny>,
    device_force: Py<PyAny>,
    tripped: Py<PyAny>,
    acted: Py<PyAny>,
    fault: Py<PyAny>,
    owed_energy_j: Py<PyAny>,
}

/// One tick, not inlined: a call costs less than a copy per caller and number of axes.
#[inline(never)]
fn tick<const N: usize>(
    layer: &mut SafetyLayer<N>,
    position: &Axes<N>,
    velocity: Option<&Axes<N>>,
    rendered: &Axes<N>,
) -> SafetyTick<N> {
    layer.tick(position, velocity, rendered)
}

/// The vectors of a tick, in the order of the classes.
fn vectors<const N: usize>(tick: &SafetyTick<N>) -> [Axes<N>; 6] {
    let SafetyTick { motion, rendered_force, grasp_force, device_force, intervention, .. } = tick;
    let (velocity, acceleration) = (motion.velocity, motion.acceleration);
    [velocity, acceleration, *rendered_force, *grasp_force, intervention.safety_force, *device_force]
}

#[documented]
#[pymethods]
impl PySafetyLayer {
    #[new]
    #[pyo3(signature = (device, settings, *, estimator=None, limiter=None, samples=None, period_s=1e-3))]
    fn new(
        device: &PyDeviceModel,
        settings: &PySafetySettings,
        estimator: Option<&PyEstimatorKind>,
        limiter: Option<&PyLimiterSettings>,
        samples: Option<&PySampleBounds>,
        period_s: f64,
    ) -> PyResult<Self> {
        let inner = build_like!(&device.inner, AnyLayer, model => SafetyLayer::new(&LayerSettings {
            device: *model,
            period_s,
            estimator: estimator.map_or_else(EstimatorKind::default, |kind| kind.inner),
            safety: settings.inner,
            limiter: limiter.map_or_else(LimiterSettings::default, |limiter| limiter.inner),
        })
        .map(|layer| samples.map_or(layer.clone(), |samples| layer.with_samples(samples.inner)))
        .map_err(refuse)?);
        Ok(Self { axes: with_axes!(&device.inner, AnyDevice, _model => N), inner })
    }

    #[getter]
    fn axes(&self) -> usize {
        self.axes
    }

    #[getter]
    fn outliers(&self) -> u64 {
        with_axes!(&self.inner, AnyLayer, layer => layer.guard().outliers())
    }

    #[pyo3(signature = (position, rendered_force, velocity=None))]
    fn step(
        &mut self,
        py: Python<'_>,
        position: Sample,
        rendered_force: Sample,
        velocity: Option<Sample>,
    ) -> PyResult<PySafetyTick> {
        with_axes!(&mut self.inner, AnyLayer, layer => {
            let velocity = velocity.map(|velocity| velocity.axes::<N>("velocity")).transpose()?;
            let tick = tick(
                layer,
                &position.axes("position")?,
                velocity.as_ref(),
                &rendered_force.axes("rendered_force")?,
            );
            let [velocity, acceleration, rendered_force, grasp_force, safety_force, device_force] =
                vectors(&tick).map(|vector| sample_out(py, &vector));
            Ok(PySafetyTick {
                velocity,
                acceleration,
                rendered_force,
                grasp_force,
                safety_force,
                device_force,
                tripped: tick.intervention.tripped.bits(),
                acted: tick.acted.bits(),
                fault: tick.fault.map_or(0, Fault::code),
                owed_energy_j: tick.owed_energy_j,
            })
        })
    }

    #[pyo3(signature = (position, rendered_force, velocity=None))]
    fn run(
        &mut self,
        py: Python<'_>,
        position: SignalArray<'_>,
        rendered_force: SignalArray<'_>,
        velocity: Option<SignalArray<'_>>,
    ) -> PyResult<PySafetyTicks> {
        let position = Samples::new("position", &position, self.axes)?;
        let rendered = Samples::new("rendered_force", &rendered_force, self.axes)?;
        rendered.as_long_as("rendered_force", &position)?;
        let measured =
            velocity.as_ref().map(|array| Samples::new("velocity", array, self.axes)).transpose()?;
        if let Some(measured) = &measured {
            measured.as_long_as("velocity", &position)?;
        }
        let mut columns: [Vec<f64>; 6] =
            std::array::from_fn(|_| Vec::with_capacity(position.ticks * self.axes));
        let mut bits: [Vec<u8>; 3] = std::array::from_fn(|_| Vec::with_capacity(position.ticks));
        let mut owed = Vec::with_capacity(position.ticks);
        py.detach(|| {
            with_axes!(&mut self.inner, AnyLayer, layer => {
                for n in 0..position.ticks {
                    let moving = measured.as_ref().map(|measured| measured.at::<N>(n));
                    let tick = tick(layer, &position.at(n), moving.as_ref(), &rendered.at(n));
                    for (column, vector) in columns.iter_mut().zip(vectors(&tick)) {
                        column.extend_from_slice(vector.as_slice());
                    }
                    bits[0].push(tick.intervention.tripped.bits());
                    bits[1].push(tick.acted.bits());
                    bits[2].push(tick.fault.map_or(0, Fault::code));
                    owed.push(tick.owed_energy_j);
                }
            });
        });
        let [velocity, acceleration, rendered_force, grasp_force, safety_force, device_force] = columns;
        let [tripped, acted, fault] = bits.map(|bits| column(py, bits));
        Ok(PySafetyTicks {
            velocity: position.shaped(py, velocity)?,
            acceleration: position.shaped(py, acceleration)?,
            rendered_force: position.shaped(py, rendered_force)?,
            grasp_force: position.shaped(py, grasp_force)?,
            safety_force: position.shaped(py, safety_force)?,
            device_force: position.shaped(py, device_force)?,
            tripped,
            acted,
            fault,
            owed_energy_j: column(py, owed),
        })
    }

    fn reset(&mut self, position: Sample) -> PyResult<()> {
        with_axes!(&mut self.inner, AnyLayer, layer => {
            let position = position.axes::<N>("position")?;
            Signal::Position.check(&position).map_err(refuse)?;
            layer.reset(&position).map_err(refuse)
        })
    }
}
