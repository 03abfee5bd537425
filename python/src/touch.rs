//! `haptether.master.touch`: callback for the OpenHaptics scheduler.
#![allow(unsafe_code)] // addresses of the vendor's functions

use std::time::Duration;

use haptether_master::{HdCallback, HdFunctions};
use pyo3::{exceptions::PyValueError, prelude::*};

pub(crate) fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<PyHdCallback>()
}

type Sample = (u64, [f64; 16], [f64; 3], u32, u32, u32, i32);

#[documented]
#[pyclass(name = "HdCallback", module = "haptether._core", frozen)]
struct PyHdCallback {
    callback: &'static HdCallback,
}

#[documented]
#[pymethods]
impl PyHdCallback {
    #[new]
    #[pyo3(signature = (functions, device, *, watchdog_s, max_force_n))]
    fn new(functions: [usize; 8], device: u32, watchdog_s: f64, max_force_n: f64) -> PyResult<Self> {
        if functions.contains(&0) {
            return Err(PyValueError::new_err("functions: must be eight addresses"));
        }
        if !(0.001..=0.1).contains(&watchdog_s) {
            return Err(PyValueError::new_err(format!("watchdog_s = {watchdog_s}: must be 0.001 to 0.1 s")));
        }
        if !(max_force_n > 0.0 && max_force_n.is_finite()) {
            return Err(PyValueError::new_err(format!("max_force_n = {max_force_n}: must be above 0 N")));
        }
        let watchdog = Duration::from_secs_f64(watchdog_s);
        // SAFETY: the caller has looked up the functions by name, in this order.
        let callback = unsafe {
            let functions = HdFunctions {
                make_current_device: std::mem::transmute::<usize, unsafe extern "C" fn(u32)>(functions[0]),
                begin_frame: std::mem::transmute::<usize, unsafe extern "C" fn(u32)>(functions[1]),
                end_frame: std::mem::transmute::<usize, unsafe extern "C" fn(u32)>(functions[2]),
                get_doubles: std::mem::transmute::<usize, unsafe extern "C" fn(u32, *mut f64)>(functions[3]),
                get_integers: std::mem::transmute::<usize, unsafe extern "C" fn(u32, *mut i32)>(functions[4]),
                set_doubles: std::mem::transmute::<usize, unsafe extern "C" fn(u32, *const f64)>(
                    functions[5],
                ),
                get_error: std::mem::transmute::<
                    usize,
                    unsafe extern "C" fn() -> haptether_master::HdErrorInfo,
                >(functions[6]),
                check_calibration: std::mem::transmute::<usize, unsafe extern "C" fn() -> u32>(functions[7]),
            };
            HdCallback::new(functions, device, watchdog, max_force_n)
        };
        Ok(Self { callback })
    }

    #[getter]
    #[allow(clippy::unused_self)] // the stub has it beside `context`
    fn address(&self) -> usize {
        HdCallback::address() as usize
    }

    #[getter]
    fn context(&self) -> usize {
        self.callback.context() as usize
    }

    #[getter]
    fn starved(&self) -> u64 {
        self.callback.starved()
    }

    // Holds the GIL, so that only one thread writes at a time.
    fn write(&self, force: [f64; 3]) {
        self.callback.write(force);
    }

    fn wait(&self, py: Python<'_>, after: u64, limit_s: f64) -> PyResult<Option<Sample>> {
        let limit = duration("limit_s", limit_s)?;
        Ok(py.detach(|| self.callback.wait(after, limit)).map(|of| {
            (of.tick, of.transform, of.velocity, of.buttons, of.calibration, of.error, of.internal_error)
        }))
    }

    fn acknowledge(&self) {
        self.callback.acknowledge();
    }

    fn end(&self, py: Python<'_>, limit_s: f64) -> PyResult<bool> {
        let limit = duration("limit_s", limit_s)?;
        Ok(py.detach(|| self.callback.end(limit)))
    }
}

fn duration(name: &str, seconds: f64) -> PyResult<Duration> {
    if (0.0..=10.0).contains(&seconds) {
        return Ok(Duration::from_secs_f64(seconds));
    }
    Err(PyValueError::new_err(format!("{name} = {seconds}: must be 0 to 10 s")))
}
