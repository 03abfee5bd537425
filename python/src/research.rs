//! Controllers in Python, for simulated runs.

use std::{
    sync::{
        Arc, Mutex, PoisonError,
        atomic::{AtomicU64, Ordering},
    },
    time::Instant,
};

use haptether_bridge::scene::{Progress, ResearchFactory, ResearchSpec};
use haptether_safety::controller::{ResearchController, ResearchObservation};
use pyo3::{
    exceptions::{PyRuntimeError, PyValueError},
    prelude::*,
};

use crate::arrays::{Sample, column};

/// First exception of any controller; it ends the run or sweep and is raised instead of the result.
#[derive(Clone, Debug)]
struct Failure {
    error: Arc<Mutex<Option<PyErr>>>,
    progress: Arc<Progress>,
}

/// Ticks and time spent in the controllers of a run or sweep.
#[derive(Debug, Default)]
struct Spent {
    ticks: AtomicU64,
    nanoseconds: AtomicU64,
}

/// Factory of the controllers: calls `make(name, options as JSON, axes, period_s)`, and at the end
/// `spent(ticks, seconds)`.
#[derive(Debug)]
pub(crate) struct PyResearch {
    factory: Py<PyAny>,
    spent: Arc<Spent>,
    failure: Failure,
}

impl PyResearch {
    /// A factory whose failures stop the work of `progress`.
    pub(crate) fn new(factory: Py<PyAny>, progress: &Arc<Progress>) -> Self {
        let failure = Failure { error: Arc::default(), progress: Arc::clone(progress) };
        Self { factory, spent: Arc::default(), failure }
    }

    /// Raise the first exception of any controller; otherwise reports the time spent to the factory.
    pub(crate) fn finish(&self, py: Python<'_>) -> PyResult<()> {
        if let Some(error) = self.failure.error.lock().unwrap_or_else(PoisonError::into_inner).take() {
            return Err(error);
        }
        let of = |count: &AtomicU64| count.load(Ordering::Relaxed);
        let (ticks, seconds) = (of(&self.spent.ticks), of(&self.spent.nanoseconds) as f64 * 1e-9);
        self.factory.call_method1(py, "spent", (ticks, seconds)).map(drop)
    }

    fn made(&self, spec: &ResearchSpec, axes: usize, period_s: f64) -> PyResult<PyResearchController> {
        let options = serde_json::to_string(&spec.options).map_err(crate::axes::refuse)?;
        Python::attach(|py| {
            let made = self.factory.call_method1(py, "make", (&spec.controller, options, axes, period_s))?;
            let made = made.bind(py);
            Ok(PyResearchController {
                name: spec.controller.clone(),
                step: made.getattr("step")?.unbind(),
                reset: made.getattr_opt("reset")?.map(Bound::unbind),
                period_s,
                tick: 0,
                failed: false,
                spent: Arc::clone(&self.spent),
                failure: self.failure.clone(),
            })
        })
    }
}

impl ResearchFactory for PyResearch {
    fn controller(
        &self,
        spec: &ResearchSpec,
        axes: usize,
        period_s: f64,
    ) -> Result<Box<dyn ResearchController>, String> {
        let failed = |error: PyErr| Python::attach(|py| error.value(py).to_string());
        match self.made(spec, axes, period_s) {
            Ok(controller) => Ok(Box::new(controller)),
            // Invalid options, in the controller's own words; may concern one row of a sweep.
            Err(error) if Python::attach(|py| error.is_instance_of::<PyValueError>(py)) => {
                Err(format!("controller = {:?}: {}", spec.controller, failed(error)))
            }
            Err(error) => {
                let why = format!("controller = {:?} cannot be made", spec.controller);
                self.failure.keep(&why, error);
                Err(why)
            }
        }
    }
}

struct PyResearchController {
    name: String,
    step: Py<PyAny>,
    reset: Option<Py<PyAny>>,
    period_s: f64,
    tick: u64,
    failed: bool,
    spent: Arc<Spent>,
    failure: Failure,
}

impl PyResearchController {
    fn stepped(&self, seen: &ResearchObservation<'_>, safety_force: &mut [f64]) -> PyResult<()> {
        Python::attach(|py| {
            let array = |values: &[f64]| column(py, values.to_vec());
            let observation = PyObservation {
                time_s: self.tick as f64 * self.period_s,
                velocity: array(seen.velocity),
                rendered_force: array(seen.rendered_force),
                grasp_force: array(seen.grasp_force),
                aligned_rendered_force: array(seen.aligned_rendered_force),
            };
            let given = self.step.call1(py, (observation,))?;
            if given.is_none(py) {
                return Ok(());
            }
            let axes = safety_force.len();
            let refused = |seen: String| {
                let values = if axes == 1 { "a number".to_owned() } else { format!("{axes} numbers") };
                let bound = format!("finite and at most {MAX_FORCE_N} N");
                PyValueError::new_err(format!("step returned {seen}: must be {values} ({bound}), or None"))
            };
            match given.extract::<Sample>(py) {
                Ok(Sample::One(value)) if axes == 1 => safety_force[0] = value,
                Ok(Sample::Many(values)) if values.len() == axes => safety_force.copy_from_slice(&values),
                _ => return Err(refused(given.bind(py).repr()?.to_string())),
            }
            if let Some(value) = safety_force.iter().find(|value| value.abs() > MAX_FORCE_N || value.is_nan())
            {
                return Err(refused(format!("{value} N")));
            }
            Ok(())
        })
    }
}

/// Largest valid magnitude of a force in N.
const MAX_FORCE_N: f64 = haptether_safety::Signal::RenderedForce.bound();

impl ResearchController for PyResearchController {
    fn step(&mut self, seen: &ResearchObservation<'_>, safety_force: &mut [f64]) -> bool {
        let begun = Instant::now();
        if !self.failed
            && let Err(error) = self.stepped(seen, safety_force)
        {
            self.failed = true;
            let time_s = self.tick as f64 * self.period_s;
            self.failure.keep(&format!("safety.research: {} failed at {time_s:.6} s", self.name), error);
        }
        self.tick += 1;
        self.spent.ticks.fetch_add(1, Ordering::Relaxed);
        let took = u64::try_from(begun.elapsed().as_nanos()).unwrap_or(u64::MAX);
        self.spent.nanoseconds.fetch_add(took, Ordering::Relaxed);
        !self.failed
    }

    fn boxed_clone(&self) -> Box<dyn ResearchController> {
        // The clone shares the Python object.
        Python::attach(|py| {
            Box::new(Self {
                name: self.name.clone(),
                step: self.step.clone_ref(py),
                reset: self.reset.as_ref().map(|reset| reset.clone_ref(py)),
                period_s: self.period_s,
                tick: self.tick,
                failed: self.failed,
                spent: Arc::clone(&self.spent),
                failure: self.failure.clone(),
            })
        })
    }

    fn reset(&mut self) {
        let Some(reset) = self.reset.as_ref().filter(|_| !self.failed) else { return };
        if let Err(error) = Python::attach(|py| reset.call0(py)) {
            self.failed = true;
            self.failure.keep(&format!("safety.research: {}: its reset failed", self.name), error);
        }
    }
}

impl Failure {
    /// Keep the first failure with its cause.
    fn keep(&self, what: &str, cause: PyErr) {
        let mut kept = self.error.lock().unwrap_or_else(PoisonError::into_inner);
        if kept.is_none() {
            *kept = Some(Python::attach(|py| {
                let name = cause.get_type(py).name().map_or_else(|_| String::new(), |name| name.to_string());
                let raised = PyRuntimeError::new_err(format!("{what}: {name}: {}", cause.value(py)));
                raised.set_cause(py, Some(cause));
                raised
            }));
        }
        self.progress.stop.store(true, Ordering::Relaxed);
    }
}

#[documented(ResearchObservation)]
#[pyclass(name = "ResearchObservation", module = "haptether.safety", frozen, get_all)]
pub(crate) struct PyObservation {
    time_s: f64,
    velocity: Py<PyAny>,
    rendered_force: Py<PyAny>,
    grasp_force: Py<PyAny>,
    aligned_rendered_force: Py<PyAny>,
}
