//! Models of `haptether.master` and `haptether.slave`, and the loop without a network.

use haptether_bridge::{DelayLine, LocalLoop, LocalTick, MasterPlant, ModelPlant, Truth, Watch};
use haptether_master::{DeviceParameters, Hand, Leg, LegShape, Path, Release, ReleaseKind, SimulatedMaster};
use haptether_safety::{
    Axes, DeviceModel, LayerSettings, LimiterSettings, SafetyLayer, controller::ControllerKind,
    estimator::EstimatorKind,
};
use haptether_slave::{PushShape, RenderedPush, RenderedWall, RenderedWalls, Wall};
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
    module.add_class::<PySinusoid>()?;
    module.add_class::<LocalTrace>()?;
    module.add_function(wrap_pyfunction!(run_local, module)?)
}

#[documented]
#[pyclass(name = "HapticDevice", module = "haptether.master", frozen, eq)]
#[derive(Clone, Copy, PartialEq)]
pub(crate) struct PyHapticDevice {
    pub(crate) inner: DeviceParameters<1>,
}

#[documented]
#[pymethods]
impl PyHapticDevice {
    #[new]
    #[pyo3(signature = (*, mass_kg, viscous=0.0, coulomb=0.0, encoder_quantum=0.0,
        stops=(f64::NEG_INFINITY, f64::INFINITY)),
        text_signature = "(*, mass_kg, viscous=0.0, coulomb=0.0, encoder_quantum=0.0, stops=(-1e999, 1e999))")]
    fn new(
        mass_kg: f64,
        viscous: f64,
        coulomb: f64,
        encoder_quantum: f64,
        stops: (f64, f64),
    ) -> PyResult<Self> {
        let inner = DeviceParameters {
            encoder_quantum,
            measures_velocity: encoder_quantum == 0.0,
            stops: (Axes::<1>::new(stops.0), Axes::<1>::new(stops.1)),
            ..DeviceParameters::ideal(mass_kg, viscous, coulomb)
        };
        inner.check().map_err(refuse)?;
        Ok(Self { inner })
    }

    #[staticmethod]
    #[pyo3(signature = (*, encoder_quantum=2.3e-5, stops=(f64::NEG_INFINITY, f64::INFINITY)),
        text_signature = "(*, encoder_quantum=2.3e-5, stops=(-1e999, 1e999))")]
    fn phantom_desktop(encoder_quantum: f64, stops: (f64, f64)) -> PyResult<Self> {
        let desktop = DeviceParameters::<1>::phantom_desktop();
        Self::new(desktop.mass_kg[0], desktop.viscous[0], desktop.coulomb[0], encoder_quantum, stops)
    }

    #[getter]
    fn mass_kg(&self) -> f64 {
        self.inner.mass_kg[0]
    }

    #[getter]
    fn viscous(&self) -> f64 {
        self.inner.viscous[0]
    }

    #[getter]
    fn coulomb(&self) -> f64 {
        self.inner.coulomb[0]
    }

    #[getter]
    fn stops(&self) -> (f64, f64) {
        (self.inner.stops.0[0], self.inner.stops.1[0])
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
    /// Default estimator, adapted to this encoder.
    pub(crate) fn estimator(&self) -> EstimatorKind {
        match EstimatorKind::default() {
            EstimatorKind::Kalman { jerk_density, .. } if self.inner.encoder_quantum > 0.0 => {
                EstimatorKind::Kalman { jerk_density, quantum_m: self.inner.encoder_quantum }
            }
            kind => kind,
        }
    }

    pub(crate) fn model(&self) -> PyResult<DeviceModel<1>> {
        DeviceModel::new(self.inner.mass_kg, self.inner.viscous, self.inner.coulomb).map_err(refuse)
    }
}

#[documented]
#[pyclass(name = "Hand", module = "haptether.master", frozen, eq)]
#[derive(Clone, PartialEq)]
pub(crate) struct PyHand {
    pub(crate) inner: Hand<1>,
}

#[documented]
#[pymethods]
impl PyHand {
    #[new]
    #[pyo3(signature = (*, stiffness, damping, strength_n, start, legs=Vec::new(), release=None,
        release_kind="strength"), text_signature = "(*, stiffness, damping, strength_n, start, legs=(), \
        release=None, release_kind='strength')")]
    fn new(
        stiffness: f64,
        damping: f64,
        strength_n: f64,
        start: f64,
        legs: Vec<(f64, f64, String)>,
        release: Option<(f64, f64)>,
        release_kind: &str,
    ) -> PyResult<Self> {
        let kind = match release_kind {
            "strength" => ReleaseKind::Strength,
            "gain" => ReleaseKind::Gain,
            other => {
                let text = format!("release_kind {other:?}: must be \"strength\" or \"gain\"");
                return Err(PyValueError::new_err(text));
            }
        };
        let legs = legs
            .into_iter()
            .map(|(duration_s, end, shape)| {
                let shape = match shape.as_str() {
                    "linear" => LegShape::Linear,
                    "smooth" => LegShape::Smooth,
                    "minimum-jerk" => LegShape::MinimumJerk,
                    other => {
                        let text = format!(
                            "leg shape {other:?}: must be \"linear\", \"smooth\" or \"minimum-jerk\""
                        );
                        return Err(PyValueError::new_err(text));
                    }
                };
                Ok(Leg { duration_s, end: Axes::<1>::new(end), shape })
            })
            .collect::<PyResult<Vec<_>>>()?;
        let path = Path::new(Axes::<1>::new(start), legs).map_err(refuse)?;
        let release = release.map(|(at_s, decay_s)| Release { at_s, decay_s, kind });
        Ok(Self { inner: Hand::new(stiffness, damping, strength_n, path, release).map_err(refuse)? })
    }

    #[staticmethod]
    #[pyo3(signature = (*, position=0.0))]
    fn absent(position: f64) -> PyResult<Self> {
        Ok(Self { inner: Hand::absent(Axes::<1>::new(position)).map_err(refuse)? })
    }

    fn target(&self, time_s: f64) -> f64 {
        self.inner.path().at(time_s)[0]
    }

    fn strength(&self, time_s: f64) -> f64 {
        self.inner.strength_at(time_s)
    }

    fn __repr__(&self) -> String {
        format!("{:?}", self.inner)
    }
}

#[documented]
#[pyclass(name = "Wall", module = "haptether.slave", frozen, eq)]
#[derive(Clone, Copy, PartialEq)]
pub(crate) struct PyWall {
    pub(crate) inner: Wall,
}

#[documented]
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

#[documented]
#[pyclass(name = "Sinusoid", module = "haptether.bridge", frozen)]
#[derive(Clone, Copy)]
pub(crate) struct PySinusoid {
    amplitude_n: f64,
    rate: f64,
}

#[documented]
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

struct LocalRecord {
    position: f64,
    velocity: f64,
    hand_force: f64,
    rendered_force: f64,
    grasp_force: f64,
    device_force: f64,
    velocity_force: f64,
    grasp: f64,
    windowed_energy_j: f64,
    energy_j: f64,
    tripped: u8,
}

impl LocalRecord {
    fn new(tick: &LocalTick<1>) -> Self {
        let intervention = tick.response.lane(0);
        Self {
            position: tick.position[0],
            velocity: tick.velocity[0],
            hand_force: tick.hand_force[0],
            rendered_force: tick.requested_force[0],
            grasp_force: tick.grasp_force[0],
            device_force: tick.device_force[0],
            velocity_force: intervention.observed[ControllerKind::Vfc],
            grasp: intervention.observed[ControllerKind::Hsc],
            windowed_energy_j: intervention.observed[ControllerKind::Wsc],
            energy_j: intervention.observed[ControllerKind::Pc],
            tripped: intervention.tripped.bits(),
        }
    }
}

#[documented]
#[pyclass(module = "haptether.bridge", frozen)]
pub(crate) struct LocalTrace {
    records: Vec<LocalRecord>,
    period_s: f64,
}

macro_rules! local_columns {
    ($($name:ident),*) => {
        #[documented]
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

/// A device whose force acts late, unknown to the controllers.
struct LateDevice {
    device: SimulatedMaster<1>,
    under_way: DelayLine<1>,
}

impl MasterPlant<1> for LateDevice {
    fn read(&mut self, now_ns: u64) -> (Axes<1>, Option<Axes<1>>) {
        MasterPlant::read(&mut self.device, now_ns)
    }

    fn write(&mut self, force: &Axes<1>) {
        let force = self.under_way.pass(*force);
        MasterPlant::write(&mut self.device, &force);
    }
}

impl ModelPlant<1> for LateDevice {
    fn state(&self) -> Truth<1> {
        ModelPlant::state(&self.device)
    }

    fn wall_force(&self) -> Axes<1> {
        ModelPlant::wall_force(&self.device)
    }
}

/// Longest delay of a force, in ticks.
const MAX_DELAY: usize = 1000;

/// Most ticks of one run; 1e8 would be 10 GB of records.
const MAX_TICKS: usize = 20_000_000;

#[documented]
#[pyfunction]
#[pyo3(signature = (device, hand, rendered, *, ticks, settings=None, estimator=None, limiter=None,
    period_s=1e-3, start=None, device_delay=0))]
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
    device_delay: usize,
) -> PyResult<LocalTrace> {
    let rendered = if let Ok(wall) = rendered.cast::<PyWall>() {
        let wall = wall.get().inner;
        let wall = RenderedWall {
            normal: Axes::<1>::new(1.0),
            point: Axes::<1>::new(wall.surface()),
            stiffness: wall.stiffness(),
            damping: 0.0,
            is_two_sided: false,
        };
        RenderedWalls::new(&[wall], &[])
    } else if let Ok(sinusoid) = rendered.cast::<PySinusoid>() {
        let PySinusoid { amplitude_n, rate } = *sinusoid.get();
        let force_n = Axes::<1>::new(amplitude_n * rate.signum());
        let shape = PushShape::Sine { frequency_hz: rate.abs() / std::f64::consts::TAU };
        RenderedWalls::new(&[], &[RenderedPush { shape, at_s: 0.0, duration_s: 1e9, force_n }])
    } else {
        let text = format!("rendered: {}, must be a Wall or a Sinusoid", rendered.get_type().name()?);
        return Err(PyValueError::new_err(text));
    }
    .map_err(refuse)?;
    if ticks > MAX_TICKS {
        return Err(PyValueError::new_err(format!("ticks = {ticks}: must be at most {MAX_TICKS}")));
    }
    if device_delay > MAX_DELAY {
        return Err(PyValueError::new_err(format!(
            "device_delay = {device_delay}: must be at most {MAX_DELAY} ticks"
        )));
    }
    let mut master = SimulatedMaster::new(device.inner, hand.inner.clone(), 0).map_err(refuse)?;
    if let Some((position, velocity)) = start {
        master.place(Axes::<1>::new(position), Axes::<1>::new(velocity)).map_err(refuse)?;
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
    let period_ns = period_s * 1e9;
    if !(1e3..=1e9).contains(&period_ns) || (period_ns - period_ns.round()).abs() > 1e-3 {
        return Err(PyValueError::new_err(format!(
            "period_s (dT) = {period_s}: must be a whole number of nanoseconds between 1e-6 and 1"
        )));
    }
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // checked above
    let period_ns = period_ns.round() as u64;
    let watch = Watch::Estimated(Box::new(SafetyLayer::new(&layer).map_err(refuse)?));
    let master = LateDevice { device: master, under_way: DelayLine::new(device_delay) };
    let mut looped = LocalLoop::new(master, rendered, DelayLine::new(0), watch, period_ns);
    let records = py.detach(|| (0..ticks).map(|_| LocalRecord::new(&looped.step())).collect());
    Ok(LocalTrace { records, period_s })
}
