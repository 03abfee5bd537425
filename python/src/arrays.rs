//! NumPy arrays in and out.

use std::borrow::Cow;

use haptether_safety::Axes;
use numpy::{IntoPyArray, PyArrayMethods, PyReadonlyArrayDyn, PyUntypedArrayMethods};
use pyo3::{exceptions::PyValueError, prelude::*};

/// Samples over ticks, as handed over: shape `(n_ticks, axes)`, or `(n_ticks,)` for one axis.
pub(crate) struct Samples<'a> {
    values: Cow<'a, [f64]>,
    pub(crate) ticks: usize,
    flat: bool,
}

impl<'a> Samples<'a> {
    /// Takes `array` named `name`; refuses another shape.
    pub(crate) fn new(name: &str, array: &'a PyReadonlyArrayDyn<'_, f64>, axes: usize) -> PyResult<Self> {
        let shape = array.shape();
        let (ticks, flat) = match *shape {
            [ticks] if axes == 1 => (ticks, true),
            [ticks, columns] if columns == axes => (ticks, false),
            _ => {
                let allowed = if axes == 1 {
                    "(n_ticks, 1) or (n_ticks,)".into()
                } else {
                    format!("(n_ticks, {axes})")
                };
                return Err(PyValueError::new_err(format!("{name}: shape {shape:?}, must be {allowed}")));
            }
        };
        let values = match array.as_slice() {
            Ok(slice) => Cow::Borrowed(slice),
            Err(_) => Cow::Owned(array.as_array().iter().copied().collect()),
        };
        Ok(Self { values, ticks, flat })
    }

    /// The sample of one tick.
    pub(crate) fn at<const N: usize>(&self, tick: usize) -> Axes<N> {
        Axes::from_column_slice(&self.values[tick * N..tick * N + N])
    }

    /// Refuses samples of another length.
    pub(crate) fn as_long_as(&self, name: &str, other: &Samples<'_>) -> PyResult<()> {
        if self.ticks == other.ticks {
            return Ok(());
        }
        Err(PyValueError::new_err(format!("{name}: {} ticks, must have {}", self.ticks, other.ticks)))
    }

    /// An array of the shape of these samples.
    pub(crate) fn shaped(&self, py: Python<'_>, values: Vec<f64>) -> PyResult<Py<PyAny>> {
        matrix(py, values, self.ticks, self.flat)
    }
}

/// `values` as an array of shape `(ticks, values / ticks)`, or `(ticks,)` if flat.
pub(crate) fn matrix(py: Python<'_>, values: Vec<f64>, ticks: usize, flat: bool) -> PyResult<Py<PyAny>> {
    if flat {
        return Ok(column(py, values));
    }
    let columns = values.len().checked_div(ticks).unwrap_or(1);
    Ok(values.into_pyarray(py).reshape([ticks, columns])?.into_any().unbind())
}

/// `values` as an array of shape `(len,)`.
pub(crate) fn column<T: numpy::Element>(py: Python<'_>, values: Vec<T>) -> Py<PyAny> {
    values.into_pyarray(py).into_any().unbind()
}

/// One sample: a float for one axis, or a sequence of `N` floats.
#[derive(FromPyObject)]
pub(crate) enum Sample {
    One(f64),
    Many(Vec<f64>),
}

impl Sample {
    /// As a vector of `N` axes.
    pub(crate) fn axes<const N: usize>(&self, name: &str) -> PyResult<Axes<N>> {
        match self {
            Self::One(value) if N == 1 => Ok(Axes::repeat(*value)),
            Self::Many(values) if values.len() == N => Ok(Axes::from_column_slice(values)),
            Self::One(_) => Err(PyValueError::new_err(format!("{name}: 1 value, must have {N}"))),
            Self::Many(values) => {
                Err(PyValueError::new_err(format!("{name}: {} values, must have {N}", values.len())))
            }
        }
    }

    /// As a parameter of `N` axes: one value serves all.
    pub(crate) fn spread<const N: usize>(&self, name: &str) -> PyResult<Axes<N>> {
        match self {
            Self::One(value) => Ok(Axes::repeat(*value)),
            Self::Many(_) => self.axes(name),
        }
    }
}

/// A sample back to Python, as an array of shape `(axes,)`.
pub(crate) fn sample_out<const N: usize>(py: Python<'_>, value: &Axes<N>) -> Py<PyAny> {
    column(py, value.as_slice().to_vec())
}
