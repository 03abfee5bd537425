//! Bounds on samples.

use haptether_safety::SampleBounds;
use pyo3::prelude::*;

#[documented]
#[pyclass(name = "SampleBounds", module = "haptether.safety", frozen, eq)]
#[derive(Clone, Copy, PartialEq)]
pub(crate) struct PySampleBounds {
    pub(crate) inner: SampleBounds,
}

#[documented]
#[pymethods]
impl PySampleBounds {
    #[new]
    #[pyo3(signature = (*, joints=false, speed=None, velocity_change=None, quantum=0.0))]
    fn new(joints: bool, speed: Option<f64>, velocity_change: Option<f64>, quantum: f64) -> PyResult<Self> {
        let of_kind = if joints { SampleBounds::JOINTS } else { SampleBounds::LINEAR };
        let inner = SampleBounds {
            speed: speed.unwrap_or(of_kind.speed),
            velocity_change: velocity_change.unwrap_or(of_kind.velocity_change),
            quantum,
            ..of_kind
        };
        Ok(Self { inner: inner.checked().map_err(crate::axes::refuse)? })
    }

    #[getter]
    fn speed(&self) -> f64 {
        self.inner.speed
    }

    #[getter]
    fn velocity_change(&self) -> f64 {
        self.inner.velocity_change
    }

    #[getter]
    fn quantum(&self) -> f64 {
        self.inner.quantum
    }

    fn __repr__(&self) -> String {
        format!("{:?}", self.inner)
    }
}
