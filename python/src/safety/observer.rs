//! Observers.

use haptether_safety::{
    Observation,
    observer::{
        HandGraspObserver, PassivityObserver, SafetyObserver, VelocityForceForm, VelocityForceObserver,
        WindowedSafetyObserver,
    },
};
use pyo3::{exceptions::PyValueError, prelude::*};

use super::device::{AnyDevice, PyDeviceModel};
use crate::{
    arrays::{Sample, Samples, SignalArray, column},
    axes::{build_axes, build_like, per_axes, refuse, with_axes},
};

/// Form of Eq. 1 with this name.
pub(super) fn velocity_force_form(name: &str) -> PyResult<VelocityForceForm> {
    match name {
        "product" => Ok(VelocityForceForm::Product),
        "both" => Ok(VelocityForceForm::Both),
        other => Err(PyValueError::new_err(format!("vfc_form = {other:?}: must be \"product\" or \"both\""))),
    }
}

/// Signals of a run of observations.
pub(super) struct Observations<'a> {
    pub(super) velocity: Samples<'a>,
    pub(super) rendered_force: Samples<'a>,
    pub(super) grasp_force: Samples<'a>,
    aligned: Option<Samples<'a>>,
}

impl<'a> Observations<'a> {
    pub(super) fn new(
        velocity: &'a SignalArray<'_>,
        rendered_force: &'a SignalArray<'_>,
        grasp_force: &'a SignalArray<'_>,
        aligned: Option<&'a SignalArray<'_>>,
        axes: usize,
    ) -> PyResult<Self> {
        let velocity = Samples::new("velocity", velocity, axes)?;
        let rendered_force = Samples::new("rendered_force", rendered_force, axes)?;
        let grasp_force = Samples::new("grasp_force", grasp_force, axes)?;
        rendered_force.as_long_as("rendered_force", &velocity)?;
        grasp_force.as_long_as("grasp_force", &velocity)?;
        let aligned = aligned
            .map(|aligned| {
                let aligned = Samples::new("aligned_rendered_force", aligned, axes)?;
                aligned.as_long_as("aligned_rendered_force", &velocity)?;
                PyResult::Ok(aligned)
            })
            .transpose()?;
        Ok(Self { velocity, rendered_force, grasp_force, aligned })
    }

    pub(super) fn at<const N: usize>(&self, tick: usize) -> Observation<N> {
        let (velocity, rendered_force) = (self.velocity.at(tick), self.rendered_force.at(tick));
        let seen = Observation::exact(velocity, rendered_force, self.grasp_force.at(tick));
        match &self.aligned {
            Some(aligned) => Observation { aligned_rendered_force: aligned.at(tick), ..seen },
            None => seen,
        }
    }
}

pub(super) fn observation<const N: usize>(
    velocity: &Sample,
    rendered_force: &Sample,
    grasp_force: &Sample,
) -> PyResult<Observation<N>> {
    Ok(Observation::exact(
        velocity.axes("velocity")?,
        rendered_force.axes("rendered_force")?,
        grasp_force.axes("grasp_force")?,
    ))
}

/// Runs an observer over arrays; an error names the tick of an invalid value.
macro_rules! observe_arrays {
    ($py:expr, $self:expr, $seen:expr, $any:ident, $observer:ident, $n:ident => $step:expr) => {{
        let mut values = Vec::with_capacity($seen.velocity.ticks);
        $py.detach(|| {
            with_axes!(&mut $self.inner, $any, $observer => {
                for tick in 0..$seen.velocity.ticks {
                    let $n = $seen.at::<N>(tick);
                    $n.check().map_err(|fault| PyValueError::new_err(format!("tick {tick}: {fault}")))?;
                    values.push($step);
                }
            });
            PyResult::Ok(())
        })?;
        Ok(column($py, values))
    }};
}

/// A stateless observer: one number per observation, for any number of axes.
#[derive(Clone)]
pub(crate) struct Memoryless<T, const N: usize>(T);

type VfoOn<const N: usize> = Memoryless<VelocityForceObserver, N>;
type HgoOn<const N: usize> = Memoryless<HandGraspObserver, N>;

per_axes!(
    /// VFO of any number of axes.
    AnyVfo,
    VfoOn
);
per_axes!(
    /// HGO of any number of axes.
    AnyHgo,
    HgoOn
);
per_axes!(
    /// SO of any number of axes.
    AnySo,
    SafetyObserver
);
per_axes!(
    /// WSO of any number of axes.
    AnyWso,
    WindowedSafetyObserver
);
per_axes!(
    /// PO of any number of axes.
    AnyPo,
    PassivityObserver
);

/// Methods shared by all observers of an [`Observation`].
macro_rules! observation_methods {
    ($class:ident, $any:ident, $observer:ident, $seen:ident => $step:expr) => {
        #[documented]
        #[pymethods]
        impl $class {
            fn step(&mut self, velocity: Sample, rendered_force: Sample, grasp_force: Sample) -> PyResult<f64> {
                with_axes!(&mut self.inner, $any, $observer => {
                    let $seen = observation::<N>(&velocity, &rendered_force, &grasp_force)?;
                    $seen.check().map_err(refuse)?;
                    Ok($step)
                })
            }

            fn run(
                &mut self,
                py: Python<'_>,
                velocity: SignalArray<'_>,
                rendered_force: SignalArray<'_>,
                grasp_force: SignalArray<'_>,
            ) -> PyResult<Py<PyAny>> {
                let seen = Observations::new(&velocity, &rendered_force, &grasp_force, None, self.axes)?;
                observe_arrays!(py, self, seen, $any, $observer, $seen => $step)
            }
        }
    };
}

#[documented]
#[pyclass(name = "VelocityForceObserver", module = "haptether.safety")]
pub(crate) struct PyVelocityForceObserver {
    inner: AnyVfo,
    axes: usize,
}

#[documented]
#[pymethods]
impl PyVelocityForceObserver {
    #[new]
    #[pyo3(signature = (*, velocity_threshold=0.6, force_threshold_n=1.0, form="product", axes=1))]
    fn new(velocity_threshold: f64, force_threshold_n: f64, form: &str, axes: usize) -> PyResult<Self> {
        let form = velocity_force_form(form)?;
        let observer =
            VelocityForceObserver::new(velocity_threshold, force_threshold_n, form).map_err(refuse)?;
        Ok(Self { inner: build_axes!(axes, AnyVfo, Memoryless::<_, N>(observer)), axes })
    }
}

observation_methods!(PyVelocityForceObserver, AnyVfo, observer, seen => observer.0.observe(&seen));

#[documented]
#[pyclass(name = "HandGraspObserver", module = "haptether.safety")]
pub(crate) struct PyHandGraspObserver {
    inner: AnyHgo,
    axes: usize,
}

#[documented]
#[pymethods]
impl PyHandGraspObserver {
    #[new]
    #[pyo3(signature = (*, grasp_floor_n=1e-3, axes=1))]
    fn new(grasp_floor_n: f64, axes: usize) -> PyResult<Self> {
        let observer = HandGraspObserver::new(grasp_floor_n).map_err(refuse)?;
        Ok(Self { inner: build_axes!(axes, AnyHgo, Memoryless::<_, N>(observer)), axes })
    }
}

observation_methods!(PyHandGraspObserver, AnyHgo, observer, seen => observer.0.observe(&seen));

#[documented]
#[pyclass(name = "SafetyObserver", module = "haptether.safety")]
pub(crate) struct PySafetyObserver {
    inner: AnySo,
    axes: usize,
}

#[documented]
#[pymethods]
impl PySafetyObserver {
    #[new]
    #[pyo3(signature = (device, *, period_s=1e-3, energy_ratio=0.5))]
    fn new(device: &PyDeviceModel, period_s: f64, energy_ratio: f64) -> PyResult<Self> {
        let inner = build_like!(&device.inner, AnySo, model =>
            SafetyObserver::new(*model, period_s, energy_ratio).map_err(refuse)?);
        Ok(Self { axes: with_axes!(&device.inner, AnyDevice, _model => N), inner })
    }

    fn reset(&mut self) {
        with_axes!(&mut self.inner, AnySo, observer => observer.reset());
    }
}

observation_methods!(PySafetyObserver, AnySo, observer, seen => observer.step(&seen));

#[documented]
#[pyclass(name = "WindowedSafetyObserver", module = "haptether.safety")]
pub(crate) struct PyWindowedSafetyObserver {
    inner: AnyWso,
    axes: usize,
}

#[documented]
#[pymethods]
impl PyWindowedSafetyObserver {
    #[new]
    #[pyo3(signature = (device, *, period_s=1e-3, energy_ratio=0.5, window=100))]
    fn new(device: &PyDeviceModel, period_s: f64, energy_ratio: f64, window: usize) -> PyResult<Self> {
        let inner = build_like!(&device.inner, AnyWso, model =>
            WindowedSafetyObserver::new(*model, period_s, energy_ratio, window).map_err(refuse)?);
        Ok(Self { axes: with_axes!(&device.inner, AnyDevice, _model => N), inner })
    }

    fn reset(&mut self) {
        with_axes!(&mut self.inner, AnyWso, observer => observer.reset());
    }
}

observation_methods!(PyWindowedSafetyObserver, AnyWso, observer, seen => observer.step(&seen));

#[documented]
#[pyclass(name = "PassivityObserver", module = "haptether.safety")]
pub(crate) struct PyPassivityObserver {
    inner: AnyPo,
    axes: usize,
}

#[documented]
#[pymethods]
impl PyPassivityObserver {
    #[new]
    #[pyo3(signature = (*, axes=1))]
    fn new(axes: usize) -> PyResult<Self> {
        Ok(Self { inner: build_axes!(axes, AnyPo, PassivityObserver::<N>::new()), axes })
    }

    fn step(&mut self, position: Sample, held_force: Sample) -> PyResult<f64> {
        with_axes!(&mut self.inner, AnyPo, observer => {
            let (position, force) = (position.axes::<N>("position")?, held_force.axes("held_force")?);
            haptether_safety::Signal::Position.check(&position).map_err(refuse)?;
            haptether_safety::Signal::RenderedForce.check(&force).map_err(refuse)?;
            Ok(observer.step(&position, &force))
        })
    }

    fn run(
        &mut self,
        py: Python<'_>,
        position: SignalArray<'_>,
        held_force: SignalArray<'_>,
    ) -> PyResult<Py<PyAny>> {
        let position = Samples::new("position", &position, self.axes)?;
        let force = Samples::new("held_force", &held_force, self.axes)?;
        force.as_long_as("held_force", &position)?;
        let mut values = Vec::with_capacity(position.ticks);
        with_axes!(&mut self.inner, AnyPo, observer => {
            for tick in 0..position.ticks {
                let (at, held) = (position.at::<N>(tick), force.at(tick));
                haptether_safety::Signal::Position
                    .check(&at)
                    .and_then(|()| haptether_safety::Signal::RenderedForce.check(&held))
                    .map_err(|fault| PyValueError::new_err(format!("tick {tick}: {fault}")))?;
                values.push(observer.step(&at, &held));
            }
        });
        Ok(column(py, values))
    }

    fn reset(&mut self) {
        with_axes!(&mut self.inner, AnyPo, observer => observer.reset());
    }
}
