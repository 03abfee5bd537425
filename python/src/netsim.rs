//! `haptether.netsim`.

use std::net::{SocketAddr, ToSocketAddrs};

use haptether_netsim::{Direction, Link, LinkSettings, Packet, Verdict};
use numpy::{PyReadonlyArray1, PyUntypedArrayMethods};
use pyo3::{exceptions::PyValueError, prelude::*};

use crate::{
    arrays::{column, is_aligned},
    axes::refuse,
};

pub(crate) fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<PyLinkSettings>()?;
    module.add_function(wrap_pyfunction!(judge, module)?)
}

/// An address written `HOST:PORT`.
pub(crate) fn address(key: &str, text: &str) -> PyResult<SocketAddr> {
    let refused = |why: String| {
        PyValueError::new_err(format!("{key} = {text:?}: {why}; must be HOST:PORT, such as 127.0.0.1:9100"))
    };
    let mut found = text.to_socket_addrs().map_err(|error| refused(error.to_string()))?;
    found.next().ok_or_else(|| refused("no such address".into()))
}

/// A direction by its name.
pub(crate) fn way(key: &str, name: &str) -> PyResult<Direction> {
    match name {
        "forward" => Ok(Direction::Forward),
        "backward" => Ok(Direction::Backward),
        other => {
            let text = format!("{key} = {other:?}: must be \"forward\" or \"backward\"");
            Err(PyValueError::new_err(text))
        }
    }
}

#[pyclass(name = "LinkSettings", module = "haptether.netsim", frozen, eq)]
#[derive(Clone, PartialEq)]
pub(crate) struct PyLinkSettings {
    pub(crate) inner: LinkSettings,
}

#[pymethods]
impl PyLinkSettings {
    #[new]
    #[pyo3(signature = (*, delay_s=0.0, jitter_s=0.0, loss=0.0))]
    fn new(delay_s: f64, jitter_s: f64, loss: f64) -> PyResult<Self> {
        let inner = LinkSettings { delay_s, jitter_s, loss, ..LinkSettings::default() };
        inner.validate().map_err(refuse)?;
        Ok(Self { inner })
    }

    #[getter]
    fn delay_s(&self) -> f64 {
        self.inner.delay_s
    }

    #[getter]
    fn jitter_s(&self) -> f64 {
        self.inner.jitter_s
    }

    #[getter]
    fn loss(&self) -> f64 {
        self.inner.loss
    }

    fn __repr__(&self) -> String {
        format!("{:?}", self.inner)
    }
}

#[pyfunction]
#[pyo3(signature = (settings, sent_ns, *, direction="forward", seed=0))]
fn judge(
    py: Python<'_>,
    settings: &PyLinkSettings,
    sent_ns: PyReadonlyArray1<'_, i64>,
    direction: &str,
    seed: u64,
) -> PyResult<Py<PyAny>> {
    let direction = way("direction", direction)?;
    let sent_ns = if is_aligned(&sent_ns)? { sent_ns } else { sent_ns.call_method0("copy")?.extract()? };
    let mut link = Link::new(direction, seed, &settings.inner).map_err(refuse)?;
    let mut due = Vec::with_capacity(sent_ns.len());
    for (index, sent) in sent_ns.as_array().iter().enumerate() {
        let sent_ns = u64::try_from(*sent)
            .map_err(|_| PyValueError::new_err(format!("sent_ns[{index}] = {sent}: must be 0 or more")))?;
        let packet = Packet { direction, sent_ns, size: 0, index: index as u64 };
        due.push(match link.judge(&packet).verdict {
            Verdict::Deliver { at_ns } => i64::try_from(at_ns).unwrap_or(i64::MAX),
            Verdict::Drop { .. } => -1,
        });
    }
    Ok(column(py, due))
}
