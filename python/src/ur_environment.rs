//! What the tool of an emulated arm touches: the environment of a scene, and a force sensor.

use haptether_bridge::scene::{SceneSpec, scene_environment};
use haptether_safety::Axes;
use haptether_slave::{Environment, ForceSensor};
use pyo3::{exceptions::PyValueError, prelude::*};

use crate::{
    axes::refuse,
    scene::{scene_axes, scene_spec},
};

pub(crate) fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<PySceneTouch>()?;
    module.add_class::<PyForceSensor>()
}

/// An environment along the first axes of the base.
#[derive(Clone)]
enum Along {
    One(Environment<1>),
    Two(Environment<2>),
    Three(Environment<3>),
}

#[pyclass(name = "SceneTouch", module = "haptether.slave")]
pub(crate) struct PySceneTouch {
    environment: Along,
    /// As it was at first.
    untouched: Along,
    #[pyo3(get)]
    start: [f64; 3],
}

fn first<const N: usize>(of: &[f64; 3]) -> Axes<N> {
    Axes::from_fn(|axis, _| of[axis])
}

fn padded<const N: usize>(of: &Axes<N>) -> [f64; 3] {
    std::array::from_fn(|axis| if axis < N { of[axis] } else { 0.0 })
}

/// The environment of a scene, and where its arm starts.
fn touched<const N: usize>(
    scene: &SceneSpec<N>,
    along: impl FnOnce(Environment<N>) -> Along,
) -> PyResult<(Along, [f64; 3])> {
    let start = scene.slave.as_ref().map_or(&scene.master.position, |slave| &slave.position);
    Ok((along(scene_environment(scene).map_err(refuse)?), padded(start)))
}

fn finite(name: &str, values: &[f64]) -> PyResult<()> {
    if values.iter().all(|value| value.is_finite()) {
        return Ok(());
    }
    Err(PyValueError::new_err(format!("{name} = {values:?}: must be finite")))
}

#[pymethods]
impl PySceneTouch {
    #[new]
    fn new(scene_json: &[u8]) -> PyResult<Self> {
        let (mut environment, start) = match scene_axes(scene_json)? {
            1 => touched(&scene_spec(scene_json)?, Along::One)?,
            2 => touched(&scene_spec(scene_json)?, Along::Two)?,
            3 => touched(&scene_spec(scene_json)?, Along::Three)?,
            axes => {
                return Err(refuse(format!("master.axes = {axes}: must be 1, 2 or 3 to lie around a tool")));
            }
        };
        match &mut environment {
            Along::One(environment) => environment.push_from(f64::INFINITY),
            Along::Two(environment) => environment.push_from(f64::INFINITY),
            Along::Three(environment) => environment.push_from(f64::INFINITY),
        }
        Ok(Self { untouched: environment.clone(), environment, start })
    }

    fn reset(&mut self) {
        self.environment = self.untouched.clone();
    }

    #[getter]
    fn axes(&self) -> usize {
        match self.environment {
            Along::One(_) => 1,
            Along::Two(_) => 2,
            Along::Three(_) => 3,
        }
    }

    #[getter]
    fn touches(&self) -> bool {
        match &self.environment {
            Along::One(environment) => environment.touches(),
            Along::Two(environment) => environment.touches(),
            Along::Three(environment) => environment.touches(),
        }
    }

    fn start_pushers(&mut self, time_s: f64) -> PyResult<()> {
        finite("time_s", &[time_s])?;
        match &mut self.environment {
            Along::One(environment) => environment.push_from(time_s),
            Along::Two(environment) => environment.push_from(time_s),
            Along::Three(environment) => environment.push_from(time_s),
        }
        Ok(())
    }

    fn force(&mut self, time_s: f64, position: [f64; 3], velocity: [f64; 3]) -> PyResult<(f64, f64, f64)> {
        fn on<const N: usize>(of: &mut Environment<N>, t: f64, x: &[f64; 3], v: &[f64; 3]) -> [f64; 3] {
            padded(&of.force(&first(x), &first(v), t))
        }
        finite("time_s", &[time_s])?;
        finite("position", &position)?;
        finite("velocity", &velocity)?;
        let [x, y, z] = match &mut self.environment {
            Along::One(environment) => on(environment, time_s, &position, &velocity),
            Along::Two(environment) => on(environment, time_s, &position, &velocity),
            Along::Three(environment) => on(environment, time_s, &position, &velocity),
        };
        Ok((x, y, z))
    }

    fn advance(&mut self, time_s: f64, step_s: f64, position: [f64; 3], velocity: [f64; 3]) -> PyResult<()> {
        finite("time_s, step_s", &[time_s, step_s])?;
        finite("position", &position)?;
        finite("velocity", &velocity)?;
        match &mut self.environment {
            Along::One(of) => of.advance(time_s, step_s, &first(&position), &first(&velocity)),
            Along::Two(of) => of.advance(time_s, step_s, &first(&position), &first(&velocity)),
            Along::Three(of) => of.advance(time_s, step_s, &first(&position), &first(&velocity)),
        }
        Ok(())
    }
}

#[pyclass(name = "ForceSensor", module = "haptether.slave", frozen)]
pub(crate) struct PyForceSensor {
    inner: ForceSensor<3>,
}

#[pymethods]
impl PyForceSensor {
    #[new]
    #[pyo3(signature = (*, noise_n=0.0, bias_n=[0.0; 3], quantum_n=0.0, seed=0))]
    fn new(noise_n: f64, bias_n: [f64; 3], quantum_n: f64, seed: u64) -> PyResult<Self> {
        let inner = ForceSensor::new(noise_n, first::<3>(&bias_n), quantum_n, None, seed).map_err(refuse)?;
        Ok(Self { inner })
    }

    fn sample(&self, force: [f64; 3], index: u64) -> PyResult<(f64, f64, f64)> {
        finite("force", &force)?;
        let [x, y, z] = padded(&self.inner.sample(&first::<3>(&force), index));
        Ok((x, y, z))
    }
}
