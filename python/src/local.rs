//! Models of `haptether.master` and `haptether.slave`, and the loop without a network.

use haptether_bridge::{LocalLoop, LocalRecord, RenderedForce};
use haptether_master::{DeviceParameters, Hand, Leg, LegShape, Path, Release, SimulatedMaster};
use haptether_safety::{DeviceModel, LayerSettings, LimiterSettings, estimator::EstimatorKind};
use haptether_slave::{ArmParameters, Pusher, SimulatedSlave, Wall};
use pyo3::{exceptions::PyValueError, prelude::*};

use crate::{
    arrays::column,
    axes::refuse,
    safety::{PyEstimatorKind, PyLimiterSettings, PySafetySettings},
};

pub(crate) fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<PyHapticDevice>()?;
    module.add_class::<PyHand>()?;
    module.add_class::<PyWall>()?;
    module.add_class::<PyPusher>()?;
    module.add_class::<PyArm>()?;
    module.add_class::<PySinusoid>()?;
    module.add_class::<LocalTrace>()?;
    module.add_function(wrap_pyfunction!(run_local, module)?)
}

#[pyclass(name = "HapticDevice", module = "haptether.master", frozen, eq)]
#[derive(Clone, Copy, PartialEq)]
pub(crate) struct PyHapticDevice {
    pub(crate) inner: DeviceParameters,
}

#[pymethods]
impl PyHapticDevice {
    #[new]
    #[pyo3(signature = (*, mass_kg, viscous=0.0, coulomb=0.0, encoder_quantum=0.0,
        stops=(f64::NEG_INFINITY, f64::INFINITY)))]
    fn new(
        mass_kg: f64,
        viscous: f64,
        coulomb: f64,
        encoder_quantum: f64,
        stops: (f64, f64),
    ) -> PyResult<Self> {
        let inner = DeviceParameters { mass_kg, viscous, coulomb, encoder_quantum, stops };
        // A device that no hand holds checks the parameters.
        let hand = Hand::absent(0.0).map_err(refuse)?;
        SimulatedMaster::new(inner, hand, 0).map_err(refuse)?;
        Ok(Self { inner })
    }

    #[staticmethod]
    #[pyo3(signature = (*, encoder_quantum=2.3e-5, stops=(f64::NEG_INFINITY, f64::INFINITY)))]
    fn phantom_desktop(encoder_quantum: f64, stops: (f64, f64)) -> PyResult<Self> {
        let DeviceParameters { mass_kg, viscous, coulomb, .. } = DeviceParameters::PHANTOM_DESKTOP;
        Self::new(mass_kg, viscous, coulomb, encoder_quantum, stops)
    }

    #[getter]
    fn mass_kg(&self) -> f64 {
        self.inner.mass_kg
    }

    #[getter]
    fn viscous(&self) -> f64 {
        self.inner.viscous
    }

    #[getter]
    fn coulomb(&self) -> f64 {
        self.inner.coulomb
    }

    #[getter]
    fn stops(&self) -> (f64, f64) {
        self.inner.stops
    }

    #[getter]
    fn encoder_quantum(&self) -> f64 {
        self.inner.encoder_quantum
    }

    fn __repr__(&self) -> String {
        format!("{:?}", self.inner)
    }
}

impl PyHapticDevice {
    /// The estimator that is taken when none is asked for: the default, for this encoder.
    pub(crate) fn estimator(&self) -> EstimatorKind {
        match EstimatorKind::default() {
            EstimatorKind::Kalman { jerk_density, .. } if self.inner.encoder_quantum > 0.0 => {
                EstimatorKind::Kalman { jerk_density, quantum_m: self.inner.encoder_quantum }
            }
            kind => kind,
        }
    }

    pub(crate) fn model(&self) -> PyResult<DeviceModel<1>> {
        DeviceModel::uniform(self.inner.mass_kg, self.inner.viscous, self.inner.coulomb).map_err(refuse)
    }
}

#[pyclass(name = "Hand", module = "haptether.master", frozen, eq)]
#[derive(Clone, PartialEq)]
pub(crate) struct PyHand {
    pub(crate) inner: Hand,
}

#[pymethods]
impl PyHand {
    #[new]
    #[pyo3(signature = (*, stiffness, damping, strength_n, start, legs=Vec::new(), release=None))]
    fn new(
        stiffness: f64,
        damping: f64,
        strength_n: f64,
        start: f64,
        legs: Vec<(f64, f64, String)>,
        release: Option<(f64, f64)>,
    ) -> PyResult<Self> {
        let legs = legs
            .into_iter()
            .map(|(duration_s, end, shape)| {
                let shape = match shape.as_str() {
                    "linear" => LegShape::Linear,
                    "minimum-jerk" => LegShape::MinimumJerk,
                    other => {
                        let text = format!("leg shape {other:?}: must be \"linear\" or \"minimum-jerk\"");
                        return Err(PyValueError::new_err(text));
                    }
                };
                Ok(Leg { duration_s, end, shape })
            })
            .collect::<PyResult<Vec<_>>>()?;
        let path = Path::new(start, legs).map_err(refuse)?;
        let release = release.map(|(at_s, duration_s)| Release { at_s, duration_s });
        Ok(Self { inner: Hand::new(stiffness, damping, strength_n, path, release).map_err(refuse)? })
    }

    #[staticmethod]
    #[pyo3(signature = (*, position=0.0))]
    fn absent(position: f64) -> PyResult<Self> {
        Ok(Self { inner: Hand::absent(position).map_err(refuse)? })
    }

    fn target(&self, time_s: f64) -> f64 {
        self.inner.path().at(time_s)
    }

    fn strength(&self, time_s: f64) -> f64 {
        self.inner.strength_at(time_s)
    }

    fn __repr__(&self) -> String {
        format!("{:?}", self.inner)
    }
}

#[pyclass(name = "Wall", module = "haptether.slave", frozen, eq)]
#[derive(Clone, Copy, PartialEq)]
pub(crate) struct PyWall {
    pub(crate) inner: Wall,
}

#[pymethods]
impl PyWall {
    #[new]
    #[pyo3(signature = (*, stiffness, position=0.0))]
    fn new(stiffness: f64, position: f64) -> PyResult<Self> {
        Ok(Self { inner: Wall::new(position, stiffness).map_err(refuse)? })
    }

    fn force(&self, position: f64) -> f64 {
        self.inner.force(position)
    }

    fn __repr__(&self) -> String {
        format!("{:?}", self.inner)
    }
}

#[pyclass(name = "Pusher", module = "haptether.slave", frozen, eq)]
#[derive(Clone, Copy, PartialEq)]
pub(crate) struct PyPusher {
    pub(crate) inner: Pusher,
}

#[pymethods]
impl PyPusher {
    #[new]
    #[pyo3(signature = (*, at_s, force_n, duration_s, rise_s=0.0))]
    fn new(at_s: f64, force_n: f64, duration_s: f64, rise_s: f64) -> PyResult<Self> {
        Ok(Self { inner: Pusher::new(at_s, rise_s, duration_s, force_n).map_err(refuse)? })
    }

    fn force(&self, time_s: f64) -> f64 {
        self.inner.force(time_s)
    }

    fn __repr__(&self) -> String {
        format!("{:?}", self.inner)
    }
}

#[pyclass(name = "Arm", module = "haptether.slave", frozen, eq)]
#[derive(Clone, Copy, PartialEq)]
pub(crate) struct PyArm {
    pub(crate) inner: ArmParameters,
}

#[pymethods]
impl PyArm {
    #[new]
    #[pyo3(signature = (*, mass_kg=4.0, bandwidth_hz=15.0, max_speed=1.0))]
    fn new(mass_kg: f64, bandwidth_hz: f64, max_speed: f64) -> PyResult<Self> {
        let inner = ArmParameters { mass_kg, bandwidth_hz, max_speed };
        let wall = Wall::new(0.0, 0.0).map_err(refuse)?;
        SimulatedSlave::new(inner, wall, None, 0.0, 0).map_err(refuse)?;
        Ok(Self { inner })
    }

    #[getter]
    fn stiffness(&self) -> f64 {
        self.inner.stiffness()
    }

    fn __repr__(&self) -> String {
        format!("{:?}", self.inner)
    }
}

#[pyclass(name = "Sinusoid", module = "haptether.bridge", frozen)]
#[derive(Clone, Copy)]
pub(crate) struct PySinusoid {
    amplitude_n: f64,
    rate: f64,
}

#[pymethods]
impl PySinusoid {
    #[new]
    #[pyo3(signature = (*, amplitude_n, rate))]
    fn new(amplitude_n: f64, rate: f64) -> PyResult<Self> {
        if amplitude_n.is_finite() && rate.is_finite() {
            return Ok(Self { amplitude_n, rate });
        }
        Err(PyValueError::new_err(format!("amplitude_n = {amplitude_n}, rate = {rate}: must be finite")))
    }
}

/// Ticks of a local loop, one array per signal.
#[pyclass(module = "haptether.bridge", frozen)]
pub(crate) struct LocalTrace {
    records: Vec<LocalRecord>,
    period_s: f64,
}

macro_rules! local_columns {
    ($($name:ident),*) => {
        #[pymethods]
        impl LocalTrace {
            $(#[getter]
            fn $name(&self, py: Python<'_>) -> Py<PyAny> {
                column(py, self.records.iter().map(|record| record.$name).collect())
            })*

            #[getter]
            fn time_s(&self, py: Python<'_>) -> Py<PyAny> {
                column(py, (0..self.records.len()).map(|tick| tick as f64 * self.period_s).collect())
            }

            fn __len__(&self) -> usize {
                self.records.len()
            }
        }
    };
}

local_columns!(
    position,
    velocity,
    hand_force,
    rendered_force,
    grasp_force,
    device_force,
    velocity_force,
    grasp,
    windowed_energy_j,
    energy_j,
    tripped
);

/// Most ticks of one run: 1e8 would be 10 GB of records.
pub(crate) const MOST_TICKS: usize = 20_000_000;

#[pyfunction]
#[pyo3(signature = (device, hand, rendered, *, ticks, settings=None, estimator=None, limiter=None,
    period_s=1e-3, start=None))]
fn run_local(
    py: Python<'_>,
    device: &PyHapticDevice,
    hand: &PyHand,
    rendered: &Bound<'_, PyAny>,
    ticks: usize,
    settings: Option<&PySafetySettings>,
    estimator: Option<&PyEstimatorKind>,
    limiter: Option<&PyLimiterSettings>,
    period_s: f64,
    start: Option<(f64, f64)>,
) -> PyResult<LocalTrace> {
    let rendered = if let Ok(wall) = rendered.cast::<PyWall>() {
        RenderedForce::Wall(wall.get().inner)
    } else if let Ok(sinusoid) = rendered.cast::<PySinusoid>() {
        let PySinusoid { amplitude_n, rate } = *sinusoid.get();
        RenderedForce::Sinusoid { amplitude_n, rate }
    } else {
        let text = format!("rendered: {}, must be a Wall or a Sinusoid", rendered.get_type().name()?);
        return Err(PyValueError::new_err(text));
    };
    if ticks > MOST_TICKS {
        return Err(PyValueError::new_err(format!("ticks = {ticks}: must be at most {MOST_TICKS}")));
    }
    let mut master = SimulatedMaster::new(device.inner, hand.inner.clone(), 0).map_err(refuse)?;
    if let Some((position, velocity)) = start {
        master.place(position, velocity).map_err(refuse)?;
    }
    let layer = LayerSettings {
        device: device.model()?,
        period_s,
        estimator: estimator.map_or_else(|| device.estimator(), |kind| kind.inner),
        safety: settings.map(|settings| settings.inner).unwrap_or_default(),
        limiter: limiter.map_or_else(
            || LimiterSettings { ramp_in_s: 0.0, ..LimiterSettings::default() },
            |limiter| limiter.inner,
        ),
    };
    let mut looped = LocalLoop::new(master, &layer, rendered).map_err(refuse)?;
    let records = py.detach(|| (0..ticks).map(|_| looped.step()).collect());
    Ok(LocalTrace { records, period_s })
}
