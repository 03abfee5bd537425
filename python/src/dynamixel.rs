//! `haptether.dynamixel`: servos on a serial port.

use std::{
    path::Path,
    sync::{Mutex, MutexGuard, PoisonError},
};

use haptether_dynamixel::{BROADCAST, Bus, BusError, SharedBus, SyncRead};
use pyo3::{
    exceptions::{PyOSError, PyRuntimeError, PyTimeoutError, PyValueError},
    prelude::*,
    sync::MutexExt,
    types::{PyBytes, PyTuple},
};

pub(crate) fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<PySyncRead>()?;
    module.add_class::<PyBus>()
}

const BAUD: std::ops::RangeInclusive<u32> = 1200..=10_000_000;
const TIMEOUT_S: std::ops::RangeInclusive<f64> = 1e-3..=10.0;

#[documented]
#[pyclass(name = "SyncRead", module = "haptether._core", frozen)]
struct PySyncRead {
    /// Locked by a read from its start until its values are taken.
    read: Mutex<SyncRead>,
}

impl PySyncRead {
    fn lock(&self, py: Python<'_>) -> MutexGuard<'_, SyncRead> {
        self.read.lock_py_attached(py).unwrap_or_else(PoisonError::into_inner)
    }
}

#[documented]
#[pymethods]
impl PySyncRead {
    #[new]
    #[pyo3(signature = (address, length, ids, *, fast=true))]
    fn new(address: u16, length: u16, ids: Vec<u8>, fast: bool) -> PyResult<Self> {
        let read = SyncRead::new(fast, address, length, &ids)
            .map_err(|error| PyValueError::new_err(error.to_string()))?;
        Ok(Self { read: Mutex::new(read) })
    }

    #[getter]
    fn alerts<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyTuple>> {
        let read = self.lock(py);
        let replies = read.replies().into_iter().flatten();
        let ids: Vec<u8> = replies.filter(|reply| reply.alert).map(|reply| reply.id).collect();
        drop(read);
        PyTuple::new(py, ids)
    }
}

#[documented(DynamixelBus)]
#[pyclass(name = "DynamixelBus", module = "haptether._core", frozen)]
struct PyBus {
    bus: SharedBus,
    port: String,
}

impl PyBus {
    /// Run a call on the bus without the GIL.
    fn with<T: Send>(
        &self,
        py: Python<'_>,
        run: impl FnOnce(&mut Bus) -> Result<T, BusError> + Send,
    ) -> PyResult<T> {
        py.detach(|| self.bus.call(run)).map_err(|error| raised(&self.port, error))
    }
}

fn raised(port: &str, error: BusError) -> PyErr {
    match error {
        BusError::Request(_) => PyValueError::new_err(error.to_string()),
        BusError::Closed => PyValueError::new_err(format!("{port}: {error}")),
        BusError::Port(errno) => {
            let code = errno.raw_os_error();
            let text = std::io::Error::from_raw_os_error(code).to_string();
            let text = text.split(" (os error").next().unwrap_or_default().to_owned();
            PyOSError::new_err((code, text, port.to_owned()))
        }
        BusError::Busy => PyOSError::new_err(format!("{port}: {error}")),
        BusError::Silent { .. } => PyTimeoutError::new_err(format!("{port}: {error}")),
        _ => PyRuntimeError::new_err(format!("{port}: {error}")),
    }
}

#[documented(DynamixelBus)]
#[pymethods]
impl PyBus {
    #[classattr]
    #[pyo3(name = "BROADCAST")]
    const EVERY_SERVO: u8 = BROADCAST;

    #[new]
    #[pyo3(signature = (port, *, baud, timeout_s=0.02))]
    fn new(py: Python<'_>, port: String, baud: u32, timeout_s: f64) -> PyResult<Self> {
        if !BAUD.contains(&baud) {
            let (low, high) = (BAUD.start(), BAUD.end());
            return Err(PyValueError::new_err(format!("baud = {baud}: must be {low} to {high} bit/s")));
        }
        if !TIMEOUT_S.contains(&timeout_s) {
            let (low, high) = (TIMEOUT_S.start(), TIMEOUT_S.end());
            return Err(PyValueError::new_err(format!("timeout_s = {timeout_s}: must be {low} to {high} s")));
        }
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // checked above
        let timeout_ns = (timeout_s * 1e9) as u64;
        let opened = py.detach(|| Bus::open(Path::new(&port), baud, timeout_ns));
        Ok(Self { bus: SharedBus::new(opened.map_err(|error| raised(&port, error))?), port })
    }

    fn ping(&self, py: Python<'_>, servo_id: u8) -> PyResult<(u16, u8)> {
        self.with(py, |bus| bus.ping(servo_id))
    }

    fn read<'py>(
        &self,
        py: Python<'py>,
        servo_id: u8,
        address: u16,
        length: u16,
    ) -> PyResult<Bound<'py, PyBytes>> {
        let mut bytes = vec![0; usize::from(length)];
        self.with(py, |bus| bus.read(servo_id, address, &mut bytes))?;
        Ok(PyBytes::new(py, &bytes))
    }

    fn write(&self, py: Python<'_>, servo_id: u8, address: u16, written: &[u8]) -> PyResult<bool> {
        self.with(py, |bus| bus.write(servo_id, address, written))
    }

    fn reboot(&self, py: Python<'_>, servo_id: u8) -> PyResult<()> {
        self.with(py, |bus| bus.reboot(servo_id))?;
        Ok(())
    }

    fn sync_read<'py>(&self, py: Python<'py>, read: &PySyncRead) -> PyResult<Bound<'py, PyBytes>> {
        let mut read = read.lock(py);
        let asked = &mut *read;
        self.with(py, |bus| bus.sync_read(asked))?;
        // The call has failed already if an answer is missing.
        let length = read.replies().into_iter().flatten().map(|reply| reply.data.len()).sum();
        PyBytes::new_with(py, length, |mut bytes| {
            for reply in read.replies().into_iter().flatten() {
                let (own, rest) = bytes.split_at_mut(reply.data.len());
                own.copy_from_slice(reply.data);
                bytes = rest;
            }
            Ok(())
        })
    }

    fn sync_write(
        &self,
        py: Python<'_>,
        address: u16,
        length: u16,
        ids: &[u8],
        written: &[u8],
    ) -> PyResult<()> {
        self.with(py, |bus| bus.sync_write(address, length, ids, written))
    }

    fn stop(&self, py: Python<'_>, address: u16, length: u16, ids: &[u8], written: &[u8]) -> PyResult<()> {
        py.detach(|| self.bus.stop(address, length, ids, written)).map_err(|error| raised(&self.port, error))
    }

    fn close(&self, py: Python<'_>) {
        py.detach(|| self.bus.close());
    }
}
