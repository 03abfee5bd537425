//! Controllers.

use haptether_safety::{
    Axes, Fault,
    controller::{ControllerKind, SafetyController, SafetySettings},
};
use pyo3::{exceptions::PyValueError, prelude::*};

use super::{
    device::{AnyDevice, PyDeviceModel},
    observer::{Observations, observation, velocity_force_form},
};
use crate::{
    arrays::{Sample, SignalArray, column, sample_out},
    axes::{build_like, per_axes, refuse, with_axes},
};

#[pyclass(name = "SafetySettings", module = "haptether.safety", frozen, eq)]
#[derive(Clone, Copy, PartialEq)]
pub(crate) struct PySafetySettings {
    pub(crate) inner: SafetySettings,
}

#[pymethods]
impl PySafetySettings {
    #[new]
    #[pyo3(signature = (controllers=Vec::new(), *, damping=5.0, velocity_threshold=0.6,
        vfc_force_threshold_n=1.0, vfc_form="product", grasp_threshold=1.5, grasp_floor_n=1e-3,
        hsc_force_threshold_n=0.1, energy_threshold_j=-0.03, energy_ratio=0.5, window=100,
        pc_max_damping=10.0, hold_off_s=0.0, release_ramp_s=0.0))]
    fn new(
        controllers: Vec<String>,
        damping: f64,
        velocity_threshold: f64,
        vfc_force_threshold_n: f64,
        vfc_form: &str,
        grasp_threshold: f64,
        grasp_floor_n: f64,
        hsc_force_threshold_n: f64,
        energy_threshold_j: f64,
        energy_ratio: f64,
        window: usize,
        pc_max_damping: f64,
        hold_off_s: f64,
        release_ramp_s: f64,
    ) -> PyResult<Self> {
        let mut settings = SafetySettings {
            damping,
            velocity_threshold,
            vfc_force_threshold_n,
            vfc_form: velocity_force_form(vfc_form)?,
            grasp_threshold,
            grasp_floor_n,
            hsc_force_threshold_n,
            energy_threshold_j,
            energy_ratio,
            window,
            pc_max_damping,
            hold_off_s,
            release_ramp_s,
            ..SafetySettings::default()
        };
        for name in &controllers {
            let kind = match name.as_str() {
                "vfc" => ControllerKind::Vfc,
                "hsc" => ControllerKind::Hsc,
                "wsc" => ControllerKind::Wsc,
                "pc" => ControllerKind::Pc,
                other => {
                    let text = format!("controllers: {other:?} is none of \"vfc\", \"hsc\", \"wsc\", \"pc\"");
                    return Err(PyValueError::new_err(text));
                }
            };
            settings.controllers = settings.controllers.with(kind, true);
        }
        Ok(Self { inner: settings })
    }

    fn __repr__(&self) -> String {
        format!("{:?}", self.inner)
    }
}

per_axes!(
    /// Controllers of any number of axes.
    AnyController,
    SafetyController
);

#[pyclass(name = "SafetyController", module = "haptether.safety")]
pub(crate) struct PySafetyController {
    inner: AnyController,
    axes: usize,
}

/// The message of a fault's code, none for 0.
#[pyfunction]
pub(super) fn fault_message(code: u8) -> Option<String> {
    Fault::from_code(code).map(|fault| fault.to_string())
}

#[pyclass(name = "Intervention", module = "haptether.safety", frozen, get_all)]
pub(crate) struct PyIntervention {
    safety_force: Py<PyAny>,
    device_force: Py<PyAny>,
    tripped: u8,
    fault: u8,
    velocity_force: f64,
    grasp: f64,
    windowed_energy_j: f64,
    energy_j: f64,
}

#[pyclass(name = "Interventions", module = "haptether.safety", frozen, get_all)]
pub(crate) struct PyInterventions {
    safety_force: Py<PyAny>,
    device_force: Py<PyAny>,
    tripped: Py<PyAny>,
    fault: Py<PyAny>,
    velocity_force: Option<Py<PyAny>>,
    grasp: Option<Py<PyAny>>,
    windowed_energy_j: Option<Py<PyAny>>,
    energy_j: Option<Py<PyAny>>,
}

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
            Ok(match controller.step(&seen) {
                Ok(step) => PyIntervention {
                    safety_force: sample_out(py, &step.safety_force),
                    device_force: sample_out(py, &(seen.rendered_force + step.safety_force)),
                    tripped: step.tripped.bits(),
                    fault: 0,
                    velocity_force: step.velocity_force,
                    grasp: step.grasp,
                    windowed_energy_j: step.windowed_energy_j,
                    energy_j: step.energy_j,
                },
                Err(fault) => PyIntervention {
                    safety_force: sample_out(py, &Axes::<N>::zeros()),
                    device_force: sample_out(py, &Axes::<N>::zeros()),
                    tripped: 0,
                    fault: fault.code(),
                    velocity_force: f64::NAN,
                    grasp: f64::NAN,
                    windowed_energy_j: f64::NAN,
                    energy_j: f64::NAN,
                },
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
        // A column that no observer fills is not kept.
        let mut values: [Vec<f64>; 4] = Default::default();
        let kept = with_axes!(&self.inner, AnyController, controller => controller.observed());
        for (column, kept) in values.iter_mut().zip(kept) {
            column.reserve_exact(if kept { ticks } else { 0 });
        }
        py.detach(|| {
            with_axes!(&mut self.inner, AnyController, controller => {
                for tick in 0..ticks {
                    let observed = seen.at::<N>(tick);
                    let numbers = match controller.step(&observed) {
                        Ok(step) => {
                            safety.extend_from_slice(step.safety_force.as_slice());
                            device.extend_from_slice((observed.rendered_force + step.safety_force).as_slice());
                            tripped.push(step.tripped.bits());
                            faults.push(0);
                            [step.velocity_force, step.grasp, step.windowed_energy_j, step.energy_j]
                        }
                        Err(fault) => {
                            safety.extend_from_slice(&[0.0; N]);
                            device.extend_from_slice(&[0.0; N]);
                            tripped.push(0);
                            faults.push(fault.code());
                            [f64::NAN; 4]
                        }
                    };
                    for ((column, kept), number) in values.iter_mut().zip(kept).zip(numbers) {
                        if kept {
                            column.push(number);
                        }
                    }
                }
            });
        });
        let [vfo, hgo, wso, so] = values;
        let observed = |kept: bool, values: Vec<f64>| kept.then(|| column(py, values));
        Ok(PyInterventions {
            safety_force: seen.velocity.shaped(py, safety)?,
            device_force: seen.velocity.shaped(py, device)?,
            tripped: column(py, tripped),
            fault: column(py, faults),
            velocity_force: observed(kept[0], vfo),
            grasp: observed(kept[1], hgo),
            windowed_energy_j: observed(kept[2], wso),
            energy_j: observed(kept[3], so),
        })
    }

    fn reset(&mut self) {
        with_axes!(&mut self.inner, AnyController, controller => controller.reset());
    }
}
