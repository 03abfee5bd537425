//! `haptether.netsim`: measuring a real network.

use std::{
    fs::File,
    io::{self, BufWriter, Write},
    net::SocketAddr,
    path::PathBuf,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    thread::{self, JoinHandle},
    time::Duration,
};

use haptether_netsim::{Echo, EchoStatistics, RecordSettings, Recording, answering, record};
use pyo3::{
    exceptions::{PyOSError, PyRuntimeError, PyValueError},
    prelude::*,
};

use super::{addresses, first_of, peer_addresses};
use crate::arrays::column;

/// Period at which Python may handle a signal during the measurement.
const SIGNALS: Duration = Duration::from_millis(50);

pub(super) fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<PyEcho>()?;
    module.add_class::<PyRecording>()?;
    module.add_function(wrap_pyfunction!(record_network, module)?)
}

fn failed(error: io::Error) -> PyErr {
    PyOSError::new_err(error.to_string())
}

fn panicked<T>(_: T) -> PyErr {
    PyRuntimeError::new_err("the measuring thread panicked")
}

#[documented]
#[pyclass(name = "Echo", module = "haptether.netsim")]
pub(crate) struct PyEcho {
    thread: Option<JoinHandle<io::Result<EchoStatistics>>>,
    stop: Arc<AtomicBool>,
    #[pyo3(get)]
    address: String,
}

#[documented]
#[pymethods]
impl PyEcho {
    #[new]
    #[pyo3(signature = (*, listen))]
    fn new(listen: &str) -> PyResult<Self> {
        let (mut echo, address) = first_of(&addresses("listen", listen)?, |requested| {
            let refused = |error| PyOSError::new_err(format!("listen = {requested}: {error}"));
            let echo = Echo::bind(requested).map_err(refused)?;
            let address = echo.address().map_err(refused)?.to_string();
            Ok((echo, address))
        })?;
        let stop = Arc::new(AtomicBool::new(false));
        let seen = Arc::clone(&stop);
        let thread = thread::Builder::new()
            .name("haptether-echo".into())
            .spawn(move || echo.run(&seen))
            .map_err(failed)?;
        Ok(Self { thread: Some(thread), stop, address })
    }

    #[getter]
    fn finished(&self) -> bool {
        self.thread.as_ref().is_none_or(JoinHandle::is_finished)
    }

    fn stop(&mut self, py: Python<'_>) -> PyResult<(u64, u64)> {
        self.stop.store(true, Ordering::Relaxed);
        let Some(thread) = self.thread.take() else {
            return Err(PyRuntimeError::new_err("the echo was stopped before"));
        };
        let statistics = py.detach(|| thread.join()).map_err(panicked)?.map_err(failed)?;
        Ok((statistics.answered, statistics.ignored))
    }
}

impl Drop for PyEcho {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

#[documented]
#[pyclass(name = "Recording", module = "haptether.netsim", frozen)]
pub(crate) struct PyRecording {
    inner: Recording,
    peer: SocketAddr,
}

#[documented]
#[pymethods]
impl PyRecording {
    fn __len__(&self) -> usize {
        self.inner.probes.len()
    }

    #[getter]
    fn peer(&self) -> String {
        self.peer.to_string()
    }

    #[getter]
    fn time_s(&self, py: Python<'_>) -> Py<PyAny> {
        column(py, self.inner.probes.iter().map(|probe| probe.sent_s).collect())
    }

    #[getter]
    fn forward_delay_s(&self, py: Python<'_>) -> Py<PyAny> {
        column(py, self.inner.probes.iter().map(|probe| probe.forward_s.unwrap_or(f64::NAN)).collect())
    }

    #[getter]
    fn backward_delay_s(&self, py: Python<'_>) -> Py<PyAny> {
        column(py, self.inner.probes.iter().map(|probe| probe.backward_s.unwrap_or(f64::NAN)).collect())
    }

    #[getter]
    fn lost_forward(&self) -> u64 {
        self.inner.lost_forward
    }

    #[getter]
    fn lost_backward(&self) -> u64 {
        self.inner.lost_backward
    }

    #[getter]
    fn shortest_s(&self) -> f64 {
        self.inner.shortest_s
    }

    #[getter]
    fn offset_s(&self) -> f64 {
        self.inner.offset_s
    }

    #[getter]
    fn drift(&self) -> f64 {
        self.inner.drift
    }

    #[getter]
    fn latest_s(&self) -> f64 {
        self.inner.latest_s
    }

    fn write_csv(&self, py: Python<'_>, path: PathBuf) -> PyResult<()> {
        let write = || {
            let mut out = BufWriter::new(File::create(&path)?);
            self.inner.write_csv(&mut out)?;
            out.flush()
        };
        py.detach(write).map_err(|error| PyOSError::new_err(format!("{}: {error}", path.display())))
    }
}

#[documented(record)]
#[pyfunction]
#[pyo3(name = "record", signature = (peer, *, rate_hz=1000.0, duration_s=10.0, realtime=true))]
fn record_network(
    py: Python<'_>,
    peer: &str,
    rate_hz: f64,
    duration_s: f64,
    realtime: bool,
) -> PyResult<PyRecording> {
    let peers = peer_addresses("peer", peer)?;
    let stop = Arc::new(AtomicBool::new(false));
    let seen = Arc::clone(&stop);
    let measuring = thread::Builder::new()
        .name("haptether-probe".into())
        .spawn(move || {
            let peer = answering(&peers, &seen)?;
            let settings = RecordSettings { peer, rate_hz, duration_s, realtime };
            record(&settings, &seen).map(|inner| PyRecording { inner, peer })
        })
        .map_err(failed)?;
    while !measuring.is_finished() {
        py.detach(|| thread::sleep(SIGNALS));
        if let Err(interrupted) = py.check_signals() {
            stop.store(true, Ordering::Relaxed);
            let _ = py.detach(|| measuring.join());
            return Err(interrupted);
        }
    }
    let recording = measuring.join().map_err(panicked)?;
    recording.map_err(|error| match error {
        haptether_netsim::ProbeError::OutOfRange { .. } => PyValueError::new_err(error.to_string()),
        _ => PyOSError::new_err(error.to_string()),
    })
}
