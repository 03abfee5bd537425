//! The limiter.

use haptether_safety::{Limiter, LimiterSettings, Signal};
use pyo3::{exceptions::PyValueError, prelude::*};

use crate::{
    arrays::{Sample, Samples, SignalArray, column, sample_out},
    axes::{build_axes, per_axes, refuse, with_axes},
};

#[documented]
#[pyclass(name = "LimiterSettings", module = "haptether.safety", frozen, eq)]
#[derive(Clone, Copy, PartialEq)]
pub(crate) struct PyLimiterSettings {
    pub(crate) inner: LimiterSettings,
}

#[documented]
#[pymethods]
impl PyLimiterSettings {
    #[new]
    #[pyo3(signature = (*, max_force_n=7.9, max_slew_n_per_s=1000.0, max_power_w=20.0, ramp_in_s=0.2))]
    fn new(max_force_n: f64, max_slew_n_per_s: f64, max_power_w: f64, ramp_in_s: f64) -> Self {
        Self { inner: LimiterSettings { max_force_n, max_slew_n_per_s, max_power_w, ramp_in_s } }
    }

    fn __repr__(&self) -> String {
        format!("{:?}", self.inner)
    }
}

per_axes!(
    /// A limiter of any number of axes.
    AnyLimiter,
    Limiter
);

#[documented]
#[pyclass(name = "Limiter", module = "haptether.safety")]
pub(crate) struct PyLimiter {
    inner: AnyLimiter,
    axes: usize,
}

#[documented]
#[pymethods]
impl PyLimiter {
    #[new]
    #[pyo3(signature = (settings=None, *, period_s=1e-3, axes=1))]
    fn new(settings: Option<&PyLimiterSettings>, period_s: f64, axes: usize) -> PyResult<Self> {
        let settings = settings.map_or_else(LimiterSettings::default, |settings| settings.inner);
        let inner = build_axes!(axes, AnyLimiter, Limiter::<N>::new(period_s, settings).map_err(refuse)?);
        Ok(Self { inner, axes })
    }

    fn step(&mut self, py: Python<'_>, force: Sample, velocity: Sample) -> PyResult<(Py<PyAny>, u8)> {
        with_axes!(&mut self.inner, AnyLimiter, limiter => {
            let (force, velocity) = (force.axes::<N>("force")?, velocity.axes("velocity")?);
            Signal::RenderedForce.check(&force).map_err(refuse)?;
            Signal::Velocity.check(&velocity).map_err(refuse)?;
            let limited = limiter.step(&force, &velocity);
            Ok((sample_out(py, &limited.force), limited.acted.bits()))
        })
    }

    fn run(
        &mut self,
        py: Python<'_>,
        force: SignalArray<'_>,
        velocity: SignalArray<'_>,
    ) -> PyResult<(Py<PyAny>, Py<PyAny>)> {
        let force = Samples::new("force", &force, self.axes)?;
        let velocity = Samples::new("velocity", &velocity, self.axes)?;
        velocity.as_long_as("velocity", &force)?;
        let (mut limited, mut acted) =
            (Vec::with_capacity(force.ticks * self.axes), Vec::with_capacity(force.ticks));
        py.detach(|| {
            with_axes!(&mut self.inner, AnyLimiter, limiter => {
                for tick in 0..force.ticks {
                    let (requested, moving) = (force.at::<N>(tick), velocity.at(tick));
                    Signal::RenderedForce
                        .check(&requested)
                        .and_then(|()| Signal::Velocity.check(&moving))
                        .map_err(|fault| PyValueError::new_err(format!("tick {tick}: {fault}")))?;
                    let step = limiter.step(&requested, &moving);
                    limited.extend_from_slice(step.force.as_slice());
                    acted.push(step.acted.bits());
                }
            });
            PyResult::Ok(())
        })?;
        Ok((force.shaped(py, limited)?, column(py, acted)))
    }

    fn reset(&mut self) {
        with_axes!(&mut self.inner, AnyLimiter, limiter => limiter.reset());
    }
}
