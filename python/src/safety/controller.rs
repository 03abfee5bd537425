//! Controllers.

use haptether_safety::{
    Axes, Fault,
    controller::{
        ControllerKind, FRICTION_ROOM, Intervention, PROBED_DAMPING, PerController, SafetyController,
        SafetySettings,
    },
};
use pyo3::{
    exceptions::PyValueError,
    prelude::*,
    types::{IntoPyDict, PyCFunction, PyDict, PyTuple},
};

use super::{
    device::{AnyDevice, PyDeviceModel},
    observer::{Observations, observation, velocity_force_form},
};
use crate::{
    arrays::{Sample, SignalArray, column, sample_out},
    axes::{build_like, per_axes, refuse, with_axes},
};

#[documented]
#[pyclass(name = "SafetySettings", module = "haptether.safety", frozen, eq)]
#[derive(Clone, Copy, PartialEq)]
pub(crate) struct PySafetySettings {
    pub(crate) inner: SafetySettings,
}

#[documented]
#[pymethods]
impl PySafetySettings {
    #[classattr]
    const FRICTION_ROOM: f64 = FRICTION_ROOM;
    #[classattr]
    const PROBED_DAMPING: f64 = PROBED_DAMPING;

    #[new]
    #[pyo3(signature = (controllers=Vec::new(), *, damping=5.0, velocity_threshold=0.6,
        vfc_force_threshold_n=1.0, vfc_form="product", grasp_threshold=1.5, grasp_floor_n=1e-3,
        hsc_force_threshold_n=0.1, hsc_velocity_threshold=0.0, energy_threshold_j=-0.03, wsc_force_threshold_n=0.0,
        energy_ratio=0.5, window=100, pc_max_damping=10.0, hold_off_s=0.0, release_ramp_s=0.0, probe_force_n=0.0,
        probe_threshold=0.2, release_tries=0), text_signature = "(controllers=(), *, damping=5.0, \
        velocity_threshold=0.6, vfc_force_threshold_n=1.0, vfc_form='product', grasp_threshold=1.5, \
        grasp_floor_n=1e-3, hsc_force_threshold_n=0.1, hsc_velocity_threshold=0.0, energy_threshold_j=-0.03, \
        wsc_force_threshold_n=0.0, energy_ratio=0.5, window=100, pc_max_damping=10.0, hold_off_s=0.0, \
        release_ramp_s=0.0, probe_force_n=0.0, probe_threshold=0.2, release_tries=0)")]
    fn new(
        controllers: Vec<String>,
        damping: f64,
        velocity_threshold: f64,
        vfc_force_threshold_n: f64,
        vfc_form: &str,
        grasp_threshold: f64,
        grasp_floor_n: f64,
        hsc_force_threshold_n: f64,
        hsc_velocity_threshold: f64,
        energy_threshold_j: f64,
        wsc_force_threshold_n: f64,
        energy_ratio: f64,
        window: usize,
        pc_max_damping: f64,
        hold_off_s: f64,
        release_ramp_s: f64,
        probe_force_n: f64,
        probe_threshold: f64,
        release_tries: u32,
    ) -> PyResult<Self> {
        let settings = SafetySettings {
            controllers: controllers.iter().map(|name| named(name)).collect::<PyResult<_>>()?,
            damping,
            velocity_threshold,
            vfc_force_threshold_n,
            vfc_form: velocity_force_form(vfc_form)?,
            grasp_threshold,
            grasp_floor_n,
            hsc_force_threshold_n,
            hsc_velocity_threshold,
            energy_threshold_j,
            wsc_force_threshold_n,
            energy_ratio,
            window,
            pc_max_damping,
            hold_off_s,
            release_ramp_s,
            probe_force_n,
            probe_threshold,
            release_tries,
        };
        Ok(Self { inner: settings })
    }

    #[getter]
    fn thresholds<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        ControllerKind::ALL.map(|kind| (kind.about().name, kind.threshold(&self.inner))).into_py_dict(py)
    }

    fn __repr__(&self) -> String {
        format!("{:?}", self.inner)
    }
}

fn named(name: &str) -> PyResult<ControllerKind> {
    ControllerKind::ALL.into_iter().find(|kind| kind.about().name == name).ok_or_else(|| {
        let names = ControllerKind::ALL.map(|kind| format!("{:?}", kind.about().name)).join(", ");
        PyValueError::new_err(format!("controllers: {name:?} is none of {names}"))
    })
}

per_axes!(
    /// Controllers of any number of axes.
    AnyController,
    SafetyController
);

#[documented]
#[pyclass(name = "SafetyController", module = "haptether.safety")]
pub(crate) struct PySafetyController {
    inner: AnyController,
    axes: usize,
}

#[documented]
#[pyfunction]
pub(super) fn fault_message(code: u8) -> Option<String> {
    Fault::from_code(code).map(|fault| fault.to_string())
}

#[documented]
#[pyclass(name = "Intervention", module = "haptether.safety", frozen)]
pub(crate) struct PyIntervention {
    #[pyo3(get)]
    safety_force: Py<PyAny>,
    #[pyo3(get)]
    device_force: Py<PyAny>,
    #[pyo3(get)]
    tripped: u8,
    #[pyo3(get)]
    fault: u8,
    observed: PerController<f64>,
}

#[documented]
#[pyclass(name = "Interventions", module = "haptether.safety", frozen)]
pub(crate) struct PyInterventions {
    #[pyo3(get)]
    safety_force: Py<PyAny>,
    #[pyo3(get)]
    device_force: Py<PyAny>,
    #[pyo3(get)]
    tripped: Py<PyAny>,
    #[pyo3(get)]
    fault: Py<PyAny>,
    observed: PerController<Option<Py<PyAny>>>,
}

/// Add a property for each observer of the registry to `Intervention` and `Interventions`.
pub(super) fn add_observed(module: &Bound<'_, PyModule>) -> PyResult<()> {
    let py = module.py();
    let property = py.import("builtins")?.getattr("property")?;
    for kind in ControllerKind::ALL {
        let of_tick = move |of: &Bound<'_, PyTuple>, _: Option<&Bound<'_, PyDict>>| -> PyResult<f64> {
            Ok(of.get_item(0)?.cast::<PyIntervention>()?.get().observed[kind])
        };
        let of_run =
            move |of: &Bound<'_, PyTuple>, _: Option<&Bound<'_, PyDict>>| -> PyResult<Option<Py<PyAny>>> {
                let given = of.get_item(0)?;
                let values = &given.cast::<PyInterventions>()?.get().observed[kind];
                Ok(values.as_ref().map(|values| values.clone_ref(of.py())))
            };
        let (symbol, name) = (kind.observed().symbol, kind.about().name.to_uppercase());
        for (class, getter, doc) in [
            (
                py.get_type::<PyIntervention>(),
                PyCFunction::new_closure(py, None, None, of_tick)?,
                format!("{symbol}; NaN without {name} or at a fault."),
            ),
            (
                py.get_type::<PyInterventions>(),
                PyCFunction::new_closure(py, None, None, of_run)?,
                format!("{symbol}, shape `(n_ticks,)`; NaN at a fault, None without {name}."),
            ),
        ] {
            let none = py.None();
            class.setattr(kind.observed().column, property.call1((getter, &none, &none, doc))?)?;
        }
    }
    Ok(())
}

#[documented]
#[pymethods]
impl PySafetyController {
    #[new]
    #[pyo3(signature = (device, settings, *, period_s=1e-3))]
    fn new(device: &PyDeviceModel, settings: &PySafetySettings, period_s: f64) -> PyResult<Self> {
        let inner = build_like!(&device.inner, AnyController, model =>
            SafetyController::new(model, period_s, &settings.inner).map_err(refuse)?);
        Ok(Self { axes: with_axes!(&device.inner, AnyDevice, _model => N), inner })
    }

    #[getter]
    fn axes(&self) -> usize {
        self.axes
    }

    #[pyo3(signature = (velocity, rendered_force, grasp_force, aligned_rendered_force=None))]
    fn step(
        &mut self,
        py: Python<'_>,
        velocity: Sample,
        rendered_force: Sample,
        grasp_force: Sample,
        aligned_rendered_force: Option<Sample>,
    ) -> PyResult<PyIntervention> {
        with_axes!(&mut self.inner, AnyController, controller => {
            let mut seen = observation::<N>(&velocity, &rendered_force, &grasp_force)?;
            if let Some(aligned) = &aligned_rendered_force {
                seen.aligned_rendered_force = aligned.axes("aligned_rendered_force")?;
            }
            let (step, fault) = match controller.step(&seen) {
                Ok(step) => (step, 0),
                Err(fault) => (Intervention::none(), fault.code()),
            };
            let rendered = if fault == 0 { seen.rendered_force } else { Axes::zeros() };
            Ok(PyIntervention {
                safety_force: sample_out(py, &step.safety_force),
                device_force: sample_out(py, &(rendered + step.safety_force)),
                tripped: step.tripped.bits(),
                fault,
                observed: step.observed,
            })
        })
    }

    #[pyo3(signature = (velocity, rendered_force, grasp_force, aligned_rendered_force=None))]
    fn run(
        &mut self,
        py: Python<'_>,
        velocity: SignalArray<'_>,
        rendered_force: SignalArray<'_>,
        grasp_force: SignalArray<'_>,
        aligned_rendered_force: Option<SignalArray<'_>>,
    ) -> PyResult<PyInterventions> {
        let aligned = aligned_rendered_force.as_ref();
        let seen = Observations::new(&velocity, &rendered_force, &grasp_force, aligned, self.axes)?;
        let ticks = seen.velocity.ticks;
        let size = ticks * self.axes;
        let (mut safety, mut device) = (Vec::with_capacity(size), Vec::with_capacity(size));
        let (mut tripped, mut faults) = (Vec::with_capacity(ticks), Vec::with_capacity(ticks));
        // Columns without an observer are not kept.
        let kinds = with_axes!(&self.inner, AnyController, controller => controller.kinds());
        let mut observed = PerController::of(|kind| kinds.contains(kind).then(|| Vec::with_capacity(ticks)));
        py.detach(|| {
            with_axes!(&mut self.inner, AnyController, controller => {
                let mut keep = |step: &Intervention<N>, rendered: &Axes<N>, fault| {
                    safety.extend_from_slice(step.safety_force.as_slice());
                    device.extend_from_slice((rendered + step.safety_force).as_slice());
                    tripped.push(step.tripped.bits());
                    faults.push(fault);
                    for (values, value) in observed.0.iter_mut().zip(step.observed.0) {
                        if let Some(values) = values {
                            values.push(value);
                        }
                    }
                };
                for tick in 0..ticks {
                    let seen = seen.at::<N>(tick);
                    match controller.step(&seen) {
                        Ok(step) => keep(&step, &seen.rendered_force, 0),
                        Err(fault) => keep(&Intervention::none(), &Axes::zeros(), fault.code()),
                    }
                }
            });
        });
        Ok(PyInterventions {
            safety_force: seen.velocity.shaped(py, safety)?,
            device_force: seen.velocity.shaped(py, device)?,
            tripped: column(py, tripped),
            fault: column(py, faults),
            observed: PerController(observed.0.map(|values| values.map(|values| column(py, values)))),
        })
    }

    fn reset(&mut self) {
        with_axes!(&mut self.inner, AnyController, controller => controller.reset());
    }
}
