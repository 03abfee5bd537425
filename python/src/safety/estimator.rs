//! Estimators of velocity and acceleration.

use haptether_safety::{
    Axes, Signal,
    estimator::{AnyEstimator, Estimator, EstimatorKind, Fit},
};
use pyo3::{exceptions::PyValueError, prelude::*};

use crate::{
    arrays::{Sample, Samples, SignalArray, sample_out},
    axes::{build_axes, per_axes, refuse, with_axes},
};

#[documented]
#[pyclass(name = "EstimatorKind", module = "haptether.safety", frozen, eq)]
#[derive(Clone, Copy, PartialEq)]
pub(crate) struct PyEstimatorKind {
    pub(crate) inner: EstimatorKind,
}

#[documented]
#[pymethods]
impl PyEstimatorKind {
    #[new]
    fn new() -> Self {
        Self { inner: EstimatorKind::default() }
    }

    #[staticmethod]
    fn backward_difference() -> Self {
        Self { inner: EstimatorKind::BackwardDifference {} }
    }

    #[staticmethod]
    #[pyo3(signature = (*, cutoff_hz))]
    fn low_pass(cutoff_hz: f64) -> Self {
        Self { inner: EstimatorKind::LowPass { cutoff_hz } }
    }

    #[staticmethod]
    #[pyo3(signature = (*, noise_bound_m, max_window=32, fit="end"))]
    fn adaptive_window(noise_bound_m: f64, max_window: usize, fit: &str) -> PyResult<Self> {
        let fit = match fit {
            "end" => Fit::End,
            "best" => Fit::Best,
            other => {
                return Err(PyValueError::new_err(format!("fit = {other:?}: must be \"end\" or \"best\"")));
            }
        };
        Ok(Self { inner: EstimatorKind::AdaptiveWindow { noise_bound_m, max_window, fit } })
    }

    #[staticmethod]
    #[pyo3(signature = (*, degree=2, window=15))]
    fn savitzky_golay(degree: usize, window: usize) -> Self {
        Self { inner: EstimatorKind::SavitzkyGolay { degree, window } }
    }

    #[staticmethod]
    #[pyo3(signature = (*, jerk_density, quantum_m))]
    fn kalman(jerk_density: f64, quantum_m: f64) -> Self {
        Self { inner: EstimatorKind::Kalman { jerk_density, quantum_m } }
    }

    #[staticmethod]
    #[pyo3(signature = (*, velocity_jerk_density, jerk_density, quantum_m))]
    fn dual_kalman(velocity_jerk_density: f64, jerk_density: f64, quantum_m: f64) -> Self {
        Self { inner: EstimatorKind::DualKalman { velocity_jerk_density, jerk_density, quantum_m } }
    }

    fn __repr__(&self) -> String {
        format!("{:?}", self.inner)
    }
}

per_axes!(
    /// An estimator of any number of axes.
    AnyAxes,
    AnyEstimator
);

/// V, A and, if forces are given, the aligned forces.
type EstimatedRun = (Py<PyAny>, Py<PyAny>, Option<Py<PyAny>>);

#[documented]
#[pyclass(name = "Estimator", module = "haptether.safety")]
pub(crate) struct PyEstimator {
    inner: AnyAxes,
    axes: usize,
}

#[documented]
#[pymethods]
impl PyEstimator {
    #[new]
    #[pyo3(signature = (kind=None, *, period_s=1e-3, axes=1))]
    fn new(kind: Option<&PyEstimatorKind>, period_s: f64, axes: usize) -> PyResult<Self> {
        let kind = kind.map_or_else(EstimatorKind::default, |kind| kind.inner);
        let inner = build_axes!(axes, AnyAxes, kind.build::<N>(period_s).map_err(refuse)?);
        Ok(Self { inner, axes })
    }

    #[getter]
    fn axes(&self) -> usize {
        self.axes
    }

    fn step(&mut self, py: Python<'_>, position: Sample) -> PyResult<(Py<PyAny>, Py<PyAny>)> {
        with_axes!(&mut self.inner, AnyAxes, estimator => {
            let motion = estimator.step(&checked(Signal::Position, position.axes::<N>("position")?)?);
            Ok((sample_out(py, &motion.velocity), sample_out(py, &motion.acceleration)))
        })
    }

    fn align(&mut self, py: Python<'_>, device_force: Sample) -> PyResult<Py<PyAny>> {
        with_axes!(&mut self.inner, AnyAxes, estimator => {
            let force = checked(Signal::RenderedForce, device_force.axes::<N>("device_force")?)?;
            Ok(sample_out(py, &estimator.align(&force)))
        })
    }

    #[pyo3(signature = (position, device_force=None))]
    fn run(
        &mut self,
        py: Python<'_>,
        position: SignalArray<'_>,
        device_force: Option<SignalArray<'_>>,
    ) -> PyResult<EstimatedRun> {
        let position = Samples::new("position", &position, self.axes)?;
        let force = match &device_force {
            Some(force) => {
                let force = Samples::new("device_force", force, self.axes)?;
                force.as_long_as("device_force", &position)?;
                Some(force)
            }
            None => None,
        };
        let size = position.ticks * self.axes;
        let (mut velocity, mut acceleration) = (Vec::with_capacity(size), Vec::with_capacity(size));
        let mut aligned = Vec::with_capacity(if force.is_some() { size } else { 0 });
        py.detach(|| {
            with_axes!(&mut self.inner, AnyAxes, estimator => {
                for tick in 0..position.ticks {
                    // Check both before using either: a rejected tick must not change the state.
                    let at = checked(Signal::Position, position.at::<N>(tick)).map_err(at_tick(tick))?;
                    let held = match &force {
                        Some(force) => {
                            Some(checked(Signal::RenderedForce, force.at::<N>(tick)).map_err(at_tick(tick))?)
                        }
                        None => None,
                    };
                    let motion = estimator.step(&at);
                    velocity.extend_from_slice(motion.velocity.as_slice());
                    acceleration.extend_from_slice(motion.acceleration.as_slice());
                    if let Some(held) = held {
                        aligned.extend_from_slice(estimator.align(&held).as_slice());
                    }
                }
            });
            PyResult::Ok(())
        })?;
        Ok((
            position.shaped(py, velocity)?,
            position.shaped(py, acceleration)?,
            force.map(|_| position.shaped(py, aligned)).transpose()?,
        ))
    }
}

/// Require finite, bounded values: an estimator has memory, and an invalid value would persist.
fn checked<const N: usize>(signal: Signal, value: Axes<N>) -> PyResult<Axes<N>> {
    signal.check(&value).map_err(refuse)?;
    Ok(value)
}

/// Prefixes the error of a rejected sample with its tick.
fn at_tick(tick: usize) -> impl Fn(PyErr) -> PyErr {
    move |error| {
        PyValueError::new_err(format!("tick {tick}: {}", Python::attach(|py| error.value(py).to_string())))
    }
}
