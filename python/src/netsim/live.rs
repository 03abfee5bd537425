//! `haptether.netsim`: the live proxy.

use std::{
    collections::BTreeMap,
    path::PathBuf,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    thread::JoinHandle,
};

use haptether_netsim::{
    DirectionStatistics, DropCause, Proxy, ProxyControl, ProxyMonitor, ProxySettings, ProxyStatistics, Source,
};
use pyo3::{
    exceptions::{PyOSError, PyRuntimeError, PyValueError},
    prelude::*,
};

use super::{addresses, direction_named, first_of, link_settings, peer_addresses};
use crate::axes::refuse;

pub(super) fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<PyDirectionStatistics>()?;
    module.add_class::<PyProxyStatistics>()?;
    module.add_class::<PyProxy>()
}

#[documented]
#[pyclass(name = "DirectionStatistics", module = "haptether.netsim", frozen, get_all)]
#[derive(Clone)]
pub(crate) struct PyDirectionStatistics {
    received: u64,
    lost: u64,
    queue_full: u64,
    released: u64,
    unsent: u64,
    damaged: u64,
    extras: u64,
    extras_released: u64,
    extras_lost: u64,
    overtaking: u64,
    oversize: u64,
    refused: u64,
    dropped: BTreeMap<&'static str, u64>,
}

impl From<DirectionStatistics> for PyDirectionStatistics {
    fn from(of: DirectionStatistics) -> Self {
        Self {
            received: of.received,
            lost: of.lost,
            queue_full: of.queue_full,
            released: of.released,
            unsent: of.unsent,
            damaged: of.damaged,
            extras: of.extras,
            extras_released: of.extras_released,
            extras_lost: of.extras_lost,
            overtaking: of.overtaking,
            oversize: of.oversize,
            refused: of.refused,
            dropped: DropCause::ALL.map(|cause| (cause.name(), of.dropped(cause))).into(),
        }
    }
}

#[documented]
#[pyclass(name = "ProxyStatistics", module = "haptether.netsim", frozen, get_all)]
pub(crate) struct PyProxyStatistics {
    forward: PyDirectionStatistics,
    backward: PyDirectionStatistics,
    flows: u64,
    peer_unreachable: u64,
    scheduling_error_p50_s: f64,
    scheduling_error_p99_s: f64,
    scheduling_error_p999_s: f64,
    scheduling_error_max_s: f64,
    early: u64,
    log_lost: u64,
    log_failed: bool,
    scheduling: String,
    receive_buffer_bytes: u64,
    send_buffer_bytes: u64,
    valid: bool,
}

impl From<ProxyStatistics> for PyProxyStatistics {
    fn from(of: ProxyStatistics) -> Self {
        let seconds = |ns: u64| ns as f64 * 1e-9;
        Self {
            forward: of.forward.into(),
            backward: of.backward.into(),
            flows: of.flows,
            peer_unreachable: of.peer_unreachable,
            scheduling_error_p50_s: seconds(of.scheduling_error.p50_ns),
            scheduling_error_p99_s: seconds(of.scheduling_error.p99_ns),
            scheduling_error_p999_s: seconds(of.scheduling_error.p999_ns),
            scheduling_error_max_s: seconds(of.scheduling_error.max_ns),
            early: of.early,
            log_lost: of.log_lost,
            log_failed: of.log_failed,
            scheduling: of.scheduling.to_string(),
            receive_buffer_bytes: of.receive_buffer_bytes,
            send_buffer_bytes: of.send_buffer_bytes,
            valid: of.valid,
        }
    }
}

#[documented]
#[pyclass(name = "Proxy", module = "haptether.netsim")]
pub(crate) struct PyProxy {
    thread: Option<JoinHandle<std::io::Result<ProxyStatistics>>>,
    monitor: ProxyMonitor,
    control: ProxyControl,
    stop: Arc<AtomicBool>,
    #[pyo3(get)]
    address: String,
    #[pyo3(get)]
    forward: String,
}

#[documented]
#[pymethods]
impl PyProxy {
    #[new]
    #[pyo3(signature = (
        *, listen, forward, forward_link, backward_link, seed=0, allow=Vec::new(), realtime=true, max_error_s=1e-3,
        log=None,
    ), text_signature = "(*, listen, forward, forward_link, backward_link, seed=0, allow=(), realtime=True, \
        max_error_s=1e-3, log=None)")]
    fn new(
        listen: &str,
        forward: &str,
        forward_link: &str,
        backward_link: &str,
        seed: u64,
        allow: Vec<String>,
        realtime: bool,
        max_error_s: f64,
        log: Option<PathBuf>,
    ) -> PyResult<Self> {
        let (listens, forwards) = (addresses("listen", listen)?, peer_addresses("forward", forward)?);
        let settings = ProxySettings {
            forward_link: link_settings(forward_link)?,
            backward_link: link_settings(backward_link)?,
            seed,
            allow: allow.iter().map(|text| source(text)).collect::<PyResult<_>>()?,
            realtime,
            max_error_s,
            log,
            ..ProxySettings::new(listens[0], forwards[0])
        };
        let (mut proxy, forward) = first_of(&listens, |listen| {
            first_of(&forwards, |forward| {
                Proxy::bind(&ProxySettings { listen, forward, ..settings.clone() })
                    .map(|proxy| (proxy, forward.to_string()))
                    .map_err(|error| PyOSError::new_err(error.to_string()))
            })
        })?;
        let (monitor, control) = (proxy.monitor(), proxy.control());
        let address = proxy.listen_address().to_string();
        let stop = Arc::new(AtomicBool::new(false));
        let seen = Arc::clone(&stop);
        let thread = std::thread::Builder::new()
            .name("haptether-netsim".into())
            .spawn(move || proxy.run(&seen))
            .map_err(|error| PyRuntimeError::new_err(error.to_string()))?;
        Ok(Self { thread: Some(thread), monitor, control, stop, address, forward })
    }

    fn statistics(&self) -> PyProxyStatistics {
        self.monitor.snapshot().into()
    }

    fn change(&self, direction: &str, settings: &str) -> PyResult<()> {
        self.control
            .change(direction_named("direction", direction)?, &link_settings(settings)?)
            .map_err(refuse)
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

fn source(text: &str) -> PyResult<Source> {
    text.parse().map_err(|why| {
        let form = "must be an IP address or IP:PORT, such as 192.0.2.7 or 192.0.2.7:9100";
        PyValueError::new_err(format!("allow = {text:?}: {form}; {why}"))
    })
}
