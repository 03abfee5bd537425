//! The device model.

use haptether_safety::{DeviceModel, estimator::Motion};
use pyo3::prelude::*;

use crate::{
    arrays::{Sample, Samples, SignalArray},
    axes::{build_axes, per_axes, refuse, with_axes},
};

per_axes!(
    /// A device of any number of axes.
    AnyDevice,
    DeviceModel
);

#[documented]
#[pyclass(name = "DeviceModel", module = "haptether.safety", frozen)]
pub(crate) struct PyDeviceModel {
    pub(crate) inner: AnyDevice,
    axes: usize,
}

#[documented]
#[pymethods]
impl PyDeviceModel {
    #[new]
    #[pyo3(signature = (*, mass_kg, viscous=Sample::One(0.0), coulomb=Sample::One(0.0), axes=1),
        text_signature = "(*, mass_kg, viscous=0.0, coulomb=0.0, axes=1)")]
    fn new(mass_kg: Sample, viscous: Sample, coulomb: Sample, axes: usize) -> PyResult<Self> {
        let inner = build_axes!(
            axes,
            AnyDevice,
            DeviceModel::<N>::new(
                mass_kg.broadcast("mass_kg")?,
                viscous.broadcast("viscous")?,
                coulomb.broadcast("coulomb")?,
            )
            .map_err(refuse)?
        );
        Ok(Self { inner, axes })
    }

    #[staticmethod]
    #[pyo3(signature = (axes=1))]
    fn phantom_desktop(axes: usize) -> PyResult<Self> {
        Ok(Self { inner: build_axes!(axes, AnyDevice, DeviceModel::<N>::phantom_desktop()), axes })
    }

    #[getter]
    fn axes(&self) -> usize {
        self.axes
    }

    #[getter]
    fn mass_kg(&self) -> Vec<f64> {
        with_axes!(&self.inner, AnyDevice, device => device.mass_kg().as_slice().to_vec())
    }

    fn grasp_force(
        &self,
        py: Python<'_>,
        velocity: SignalArray<'_>,
        acceleration: SignalArray<'_>,
        aligned_device_force: SignalArray<'_>,
    ) -> PyResult<Py<PyAny>> {
        let velocity = Samples::new("velocity", &velocity, self.axes)?;
        let acceleration = Samples::new("acceleration", &acceleration, self.axes)?;
        let force = Samples::new("aligned_device_force", &aligned_device_force, self.axes)?;
        acceleration.as_long_as("acceleration", &velocity)?;
        force.as_long_as("aligned_device_force", &velocity)?;
        let grasp = with_axes!(&self.inner, AnyDevice, device => {
            let mut grasp = Vec::with_capacity(velocity.ticks * N);
            for tick in 0..velocity.ticks {
                let motion = Motion { velocity: velocity.at::<N>(tick), acceleration: acceleration.at(tick) };
                grasp.extend_from_slice(device.grasp_force(&motion, &force.at(tick)).as_slice());
            }
            grasp
        });
        velocity.shaped(py, grasp)
    }

    fn __repr__(&self) -> String {
        with_axes!(&self.inner, AnyDevice, device => format!("{device:?}"))
    }
}
