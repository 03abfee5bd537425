//! Contact of an emulated arm's tool: the environment of a scene, and a force sensor.

use haptether_bridge::scene::{ToolEnvironment, tool_environment};
use haptether_safety::Axes;
use haptether_slave::ForceSensor;
use pyo3::{exceptions::PyValueError, prelude::*};

use crate::axes::refuse;

pub(crate) fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<PySceneTouch>()?;
    module.add_class::<PyForceSensor>()
}

#[documented]
#[pyclass(name = "SceneTouch", module = "haptether.slave")]
pub(crate) struct PySceneTouch {
    environment: Box<dyn ToolEnvironment>,
    /// Environment before the first push and force.
    untouched: Box<dyn ToolEnvironment>,
    #[pyo3(get)]
    start: [f64; 3],
}

fn finite(name: &str, values: &[f64]) -> PyResult<()> {
    if values.iter().all(|value| value.is_finite()) {
        return Ok(());
    }
    Err(PyValueError::new_err(format!("{name} = {values:?}: must be finite")))
}

#[documented]
#[pymethods]
impl PySceneTouch {
    #[new]
    fn new(scene_json: &[u8]) -> PyResult<Self> {
        let (environment, start) = tool_environment(scene_json).map_err(refuse)?;
        Ok(Self { untouched: environment.clone(), environment, start })
    }

    fn reset(&mut self) {
        self.environment = self.untouched.clone();
    }

    #[getter]
    fn axes(&self) -> usize {
        self.environment.axes()
    }

    #[getter]
    fn touches(&self) -> bool {
        self.environment.touches()
    }

    fn start_pushers(&mut self, time_s: f64) -> PyResult<()> {
        finite("time_s", &[time_s])?;
        self.environment.push_from(time_s);
        Ok(())
    }

    fn force(&mut self, time_s: f64, position: [f64; 3], velocity: [f64; 3]) -> PyResult<(f64, f64, f64)> {
        finite("time_s", &[time_s])?;
        finite("position", &position)?;
        finite("velocity", &velocity)?;
        let [x, y, z] = self.environment.force(time_s, &position, &velocity);
        Ok((x, y, z))
    }

    fn advance(&mut self, time_s: f64, step_s: f64, position: [f64; 3], velocity: [f64; 3]) -> PyResult<()> {
        finite("time_s, step_s", &[time_s, step_s])?;
        finite("position", &position)?;
        finite("velocity", &velocity)?;
        self.environment.advance(time_s, step_s, &position, &velocity);
        Ok(())
    }
}

#[documented]
#[pyclass(name = "ForceSensor", module = "haptether.slave", frozen)]
pub(crate) struct PyForceSensor {
    inner: ForceSensor<3>,
}

#[documented]
#[pymethods]
impl PyForceSensor {
    #[new]
    #[pyo3(signature = (*, noise_n=0.0, bias_n=[0.0; 3], quantum_n=0.0, seed=0),
        text_signature = "(*, noise_n=0.0, bias_n=(0.0, 0.0, 0.0), quantum_n=0.0, seed=0)")]
    fn new(noise_n: f64, bias_n: [f64; 3], quantum_n: f64, seed: u64) -> PyResult<Self> {
        let inner = ForceSensor::new(noise_n, Axes::from(bias_n), quantum_n, None, seed).map_err(refuse)?;
        Ok(Self { inner })
    }

    fn sample(&self, force: [f64; 3], index: u64) -> PyResult<(f64, f64, f64)> {
        finite("force", &force)?;
        let [x, y, z] = self.inner.sample(&Axes::from(force), index).into();
        Ok((x, y, z))
    }
}
