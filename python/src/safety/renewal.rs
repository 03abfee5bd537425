//! Renewal of a device's samples.

use haptether_safety::{MIN_RENEWAL, Renewal, Stamped};
use pyo3::prelude::*;

#[documented]
#[pyclass(name = "Renewal", module = "haptether.safety")]
pub(crate) struct PyRenewal {
    inner: Renewal,
}

#[documented]
#[pymethods]
impl PyRenewal {
    #[classattr]
    const MIN_SHARE: f64 = MIN_RENEWAL;

    #[new]
    fn new() -> Self {
        Self { inner: Renewal::default() }
    }

    #[pyo3(signature = (position, *, orientation=None, time_s=None, is_late=false))]
    #[allow(clippy::needless_pass_by_value)] // as the interpreter hands it over
    fn step(
        &mut self,
        position: Vec<f64>,
        orientation: Option<[f64; 4]>,
        time_s: Option<f64>,
        is_late: bool,
    ) {
        let sample = Stamped { position: &position, orientation: orientation.as_ref(), time_s };
        self.inner.step(Some(sample), is_late);
    }

    fn interrupt(&mut self) {
        self.inner.step(None, false);
    }

    #[getter]
    fn share(&self) -> Option<f64> {
        self.inner.share()
    }

    #[getter]
    fn total_share(&self) -> Option<f64> {
        self.inner.total_share()
    }

    #[getter]
    fn unclear(&self) -> u64 {
        self.inner.unclear()
    }
}
