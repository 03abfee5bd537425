//! NumPy arrays as arguments and results.

use std::borrow::Cow;

use haptether_safety::Axes;
use numpy::{IntoPyArray, PyArrayMethods, PyReadonlyArrayDyn, PyUntypedArrayMethods};
use pyo3::{exceptions::PyValueError, prelude::*};

/// A `float64` array as an argument.
///
/// A field of a structured array may be unaligned, and reading it as `f64` is then undefined behaviour. The
/// constructor copies such an array once.
pub(crate) struct SignalArray<'py>(PyReadonlyArrayDyn<'py, f64>);

impl<'py> SignalArray<'py> {
    pub(crate) fn array(&self) -> &PyReadonlyArrayDyn<'py, f64> {
        &self.0
    }
}

impl<'py> FromPyObject<'_, 'py> for SignalArray<'py> {
    type Error = PyErr;

    fn extract(given: Borrowed<'_, 'py, PyAny>) -> PyResult<Self> {
        let array = given.extract::<PyReadonlyArrayDyn<'py, f64>>()?;
        if is_aligned(&array)? {
            return Ok(Self(array));
        }
        Ok(Self(array.call_method0("copy")?.extract()?))
    }
}

/// True if the array's data are aligned.
pub(crate) fn is_aligned(array: &Bound<'_, PyAny>) -> PyResult<bool> {
    array.getattr("flags")?.getattr("aligned")?.extract()
}

/// Samples over ticks as given: shape `(n_ticks, axes)`, or `(n_ticks,)` for one axis.
pub(crate) struct Samples<'a> {
    values: Cow<'a, [f64]>,
    pub(crate) ticks: usize,
    axes: usize,
    flat: bool,
}

impl<'a> Samples<'a> {
    /// Take `array`; return an error that names it `name` if the shape is invalid.
    pub(crate) fn new(name: &str, array: &'a SignalArray<'_>, axes: usize) -> PyResult<Self> {
        let array = &array.0;
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
        // A column-major array is contiguous too, but not tick by tick.
        let values = match array.as_slice() {
            Ok(slice) if array.is_c_contiguous() => Cow::Borrowed(slice),
            _ => Cow::Owned(array.as_array().iter().copied().collect()),
        };
        Ok(Self { values, ticks, axes, flat })
    }

    pub(crate) fn at<const N: usize>(&self, tick: usize) -> Axes<N> {
        Axes::from_column_slice(&self.values[tick * N..tick * N + N])
    }

    /// Return an error if `other` has another number of ticks.
    pub(crate) fn as_long_as(&self, name: &str, other: &Samples<'_>) -> PyResult<()> {
        if self.ticks == other.ticks {
            return Ok(());
        }
        Err(PyValueError::new_err(format!("{name}: {} ticks, must have {}", self.ticks, other.ticks)))
    }

    /// `values` as an array with the shape of these samples.
    pub(crate) fn shaped(&self, py: Python<'_>, values: Vec<f64>) -> PyResult<Py<PyAny>> {
        if self.flat {
            return Ok(column(py, values));
        }
        Ok(values.into_pyarray(py).reshape([self.ticks, self.axes])?.into_any().unbind())
    }
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

    /// The sample as a parameter of `N` axes; one value serves all.
    pub(crate) fn broadcast<const N: usize>(&self, name: &str) -> PyResult<Axes<N>> {
        match self {
            Self::One(value) => Ok(Axes::repeat(*value)),
            Self::Many(_) => self.axes(name),
        }
    }
}

/// Convert a sample to an array of shape `(axes,)`.
pub(crate) fn sample_out<const N: usize>(py: Python<'_>, value: &Axes<N>) -> Py<PyAny> {
    column(py, value.as_slice().to_vec())
}
