//! A recording as arrays.

use std::{fs::File, path::PathBuf};

use haptether_bridge::recorder::{Column, ReadError, ReadRecording, Values, read_recording};
use numpy::{IntoPyArray, PyArrayMethods};
use pyo3::{
    exceptions::{PyOSError, PyValueError},
    prelude::*,
    types::{PyBytes, PyDict, PyList},
};

use crate::arrays::column;

pub(crate) fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<RecordingColumns>()?;
    module.add_function(wrap_pyfunction!(read_recording_columns, module)?)
}

#[documented]
#[pyclass(module = "haptether._core", frozen, get_all)]
pub(crate) struct RecordingColumns {
    about: Py<PyDict>,
    meanings: Py<PyDict>,
    columns: Py<PyDict>,
    causes: Py<PyList>,
    begun_ns: i64,
    whole: bool,
    invalid: usize,
    damaged: bool,
}

#[documented]
#[pyfunction]
fn read_recording_columns(py: Python<'_>, path: PathBuf) -> PyResult<RecordingColumns> {
    let read = py.detach(|| File::open(&path).map_err(ReadError::from).and_then(read_recording));
    let ReadRecording { about, columns, begun_ns, causes, whole, invalid, damaged, .. } =
        read.map_err(|error| match error {
            ReadError::Refused(error) => match error.raw_os_error() {
                // With these arguments Python raises the same error as `open`.
                Some(number) => {
                    let text = system_text(py, number).unwrap_or_else(|_| error.to_string());
                    PyOSError::new_err((number, text, path.clone()))
                }
                None => error.into(),
            },
            compressed @ ReadError::Compressed(_) => {
                PyValueError::new_err(format!("{}: {compressed}", path.display()))
            }
        })?;
    let (meanings, signals) = (PyDict::new(py), PyDict::new(py));
    for Column { name, meaning, values, .. } in columns {
        meanings.set_item(&name, meaning)?;
        signals.set_item(name, array(py, values)?)?;
    }
    let causes = PyList::new(py, causes.iter().map(|cause| PyBytes::new(py, cause)))?;
    Ok(RecordingColumns {
        about: about.into_pyobject(py)?.unbind(),
        meanings: meanings.unbind(),
        columns: signals.unbind(),
        causes: causes.unbind(),
        begun_ns,
        whole,
        invalid,
        damaged,
    })
}

/// Return the system's text for an error number.
fn system_text(py: Python<'_>, number: i32) -> PyResult<String> {
    py.import("os")?.call_method1("strerror", (number,))?.extract()
}

/// Convert a column to an array; a column of names to a pair of distinct names and index per tick.
fn array(py: Python<'_>, values: Values) -> PyResult<Py<PyAny>> {
    Ok(match values {
        Values::Unknown(ticks) => column(py, vec![f64::NAN; ticks]),
        Values::Axes { rows, width } => {
            let ticks = rows.len().checked_div(width).unwrap_or(0);
            rows.into_pyarray(py).reshape([ticks, width])?.into_any().unbind()
        }
        Values::Numbers(numbers) => column(py, numbers),
        Values::Counts(counts) => column(py, counts),
        Values::Flags(flags) => column(py, flags),
        Values::Names { codes, names } => {
            let codes = codes.into_pyarray(py);
            (names, codes).into_pyobject(py)?.into_any().unbind()
        }
    })
}
