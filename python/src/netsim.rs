//! `haptether.netsim`.

use std::{
    net::{SocketAddr, ToSocketAddrs},
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    thread::JoinHandle,
};

use haptether_netsim::{
    Direction, DirectionStatistics, Link, LinkSettings, Packet, Proxy, ProxyMonitor, ProxySettings,
    ProxyStatistics, Verdict,
};
use numpy::{PyReadonlyArray1, PyUntypedArrayMethods};
use pyo3::{
    exceptions::{PyOSError, PyRuntimeError, PyValueError},
    prelude::*,
};

use crate::{
    arrays::{column, is_aligned},
    axes::refuse,
};

pub(crate) fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<PyLinkSettings>()?;
    module.add_class::<PyDirectionStatistics>()?;
    module.add_class::<PyProxyStatistics>()?;
    module.add_class::<PyProxy>()?;
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
    let direction = match direction {
        "forward" => Direction::Forward,
        "backward" => Direction::Backward,
        other => {
            let text = format!("direction = {other:?}: must be \"forward\" or \"backward\"");
            return Err(PyValueError::new_err(text));
        }
    };
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

#[pyclass(name = "DirectionStatistics", module = "haptether.netsim", frozen, get_all)]
#[derive(Clone, Copy)]
pub(crate) struct PyDirectionStatistics {
    received: u64,
    lost: u64,
    queue_full: u64,
    released: u64,
    unsent: u64,
    overtaking: u64,
    oversize: u64,
    refused: u64,
}

impl From<DirectionStatistics> for PyDirectionStatistics {
    fn from(of: DirectionStatistics) -> Self {
        Self {
            received: of.received,
            lost: of.lost,
            queue_full: of.queue_full,
            released: of.released,
            unsent: of.unsent,
            overtaking: of.overtaking,
            oversize: of.oversize,
            refused: of.refused,
        }
    }
}

#[pyclass(name = "ProxyStatistics", module = "haptether.netsim", frozen, get_all)]
pub(crate) struct PyProxyStatistics {
    forward: PyDirectionStatistics,
    backward: PyDirectionStatistics,
    peer_unreachable: u64,
    scheduling_error_p50_s: f64,
    scheduling_error_p99_s: f64,
    scheduling_error_max_s: f64,
}

impl From<ProxyStatistics> for PyProxyStatistics {
    fn from(of: ProxyStatistics) -> Self {
        let seconds = |ns: u64| ns as f64 * 1e-9;
        Self {
            forward: of.forward.into(),
            backward: of.backward.into(),
            peer_unreachable: of.peer_unreachable,
            scheduling_error_p50_s: seconds(of.scheduling_error.p50_ns),
            scheduling_error_p99_s: seconds(of.scheduling_error.p99_ns),
            scheduling_error_max_s: seconds(of.scheduling_error.max_ns),
        }
    }
}

#[pyclass(name = "Proxy", module = "haptether.netsim")]
pub(crate) struct PyProxy {
    thread: Option<JoinHandle<std::io::Result<ProxyStatistics>>>,
    monitor: ProxyMonitor,
    stop: Arc<AtomicBool>,
    #[pyo3(get)]
    address: String,
}

#[pymethods]
impl PyProxy {
    #[new]
    #[pyo3(signature = (*, listen, forward, forward_link, backward_link, seed=0))]
    fn new(
        listen: &str,
        forward: &str,
        forward_link: &PyLinkSettings,
        backward_link: &PyLinkSettings,
        seed: u64,
    ) -> PyResult<Self> {
        let mut proxy = Proxy::bind(&ProxySettings {
            listen: address("listen", listen)?,
            forward: address("forward", forward)?,
            forward_link: forward_link.inner.clone(),
            backward_link: backward_link.inner.clone(),
            seed,
        })
        .map_err(|error| PyOSError::new_err(error.to_string()))?;
        let (monitor, address) = (proxy.monitor(), proxy.listen_address().to_string());
        let stop = Arc::new(AtomicBool::new(false));
        let seen = Arc::clone(&stop);
        let thread = std::thread::Builder::new()
            .name("haptether-netsim".into())
            .spawn(move || proxy.run(&seen))
            .map_err(|error| PyRuntimeError::new_err(error.to_string()))?;
        Ok(Self { thread: Some(thread), monitor, stop, address })
    }

    fn statistics(&self) -> PyProxyStatistics {
        self.monitor.snapshot().into()
    }

    #[getter]
    fn finished(&self) -> bool {
        self.thread.as_ref().is_none_or(JoinHandle::is_finished)
    }

    fn stop(&mut self, py: Python<'_>) -> PyResult<PyProxyStatistics> {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let ended = py.detach(|| thread.join());
            ended
                .map_err(|_| PyRuntimeError::new_err("the proxy's thread panicked"))?
                .map_err(|error| PyOSError::new_err(error.to_string()))?;
        }
        Ok(self.monitor.snapshot().into())
    }
}

impl Drop for PyProxy {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}
