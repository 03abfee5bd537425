//! `haptether.safety`.

mod controller;
mod device;
mod estimator;
mod layer;
mod limiter;
mod observer;
mod renewal;
mod samples;

use haptether_safety::{
    About,
    controller::{ControllerKind, Tripped},
    estimator::ESTIMATORS,
    observer::OBSERVERS,
};
use pyo3::{prelude::*, types::PyTuple};

use controller::PySafetyController;
pub(crate) use controller::PySafetySettings;
use device::PyDeviceModel;
pub(crate) use estimator::PyEstimatorKind;
pub(crate) use limiter::PyLimiterSettings;

pub(crate) fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<PyDeviceModel>()?;
    module.add_class::<PyEstimatorKind>()?;
    module.add_class::<estimator::PyEstimator>()?;
    module.add_class::<observer::PyVelocityForceObserver>()?;
    module.add_class::<observer::PyHandGraspObserver>()?;
    module.add_class::<observer::PySafetyObserver>()?;
    module.add_class::<observer::PyWindowedSafetyObserver>()?;
    module.add_class::<observer::PyPassivityObserver>()?;
    module.add_class::<PySafetySettings>()?;
    module.add_class::<PySafetyController>()?;
    module.add_class::<controller::PyIntervention>()?;
    module.add_class::<controller::PyInterventions>()?;
    controller::add_observed(module)?;
    module.add_class::<PyLimiterSettings>()?;
    module.add_class::<limiter::PyLimiter>()?;
    module.add_class::<samples::PySampleBounds>()?;
    module.add_class::<renewal::PyRenewal>()?;
    module.add_class::<layer::PySafetyLayer>()?;
    module.add_class::<layer::PySafetyTick>()?;
    module.add_class::<layer::PySafetyTicks>()?;
    module.add_function(wrap_pyfunction!(controller::fault_message, module)?)?;
    let lists = [
        ("CONTROLLERS", &ControllerKind::ALL.map(|kind| *kind.about()) as &[About]),
        ("OBSERVERS", &OBSERVERS),
        ("ESTIMATORS", &ESTIMATORS),
    ];
    for (name, list) in lists {
        let rows = list.iter().map(|about| (about.name, about.title, about.source));
        module.add(name, PyTuple::new(module.py(), rows.collect::<Vec<_>>())?)?;
    }
    let named = ControllerKind::ALL.map(|kind| (kind.about().name, Tripped::of(kind).bits()));
    let bits = named
        .into_iter()
        .chain([("held", Tripped::HELD.bits()), ("research", Tripped::RESEARCH.bits())])
        .collect::<Vec<_>>();
    module.add("TRIP_BITS", PyTuple::new(module.py(), bits)?)?;
    let cancelling = ControllerKind::cancelling().map(|kind| kind.about().name);
    module.add("CANCELLING", PyTuple::new(module.py(), cancelling.collect::<Vec<_>>())?)?;
    let observed = ControllerKind::ALL.map(|kind| (kind.about().name, kind.observed()));
    let observed = observed.map(|(name, observed)| (name, observed.column, observed.symbol));
    module.add("OBSERVED", PyTuple::new(module.py(), observed)?)
}
