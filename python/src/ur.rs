//! `haptether.slave`: inverse kinematics of UR arms.

use haptether_slave::{UrInverse, UrPose, UrRows};
use numpy::{IntoPyArray, PyArrayMethods, PyUntypedArrayMethods};
use pyo3::{exceptions::PyValueError, prelude::*};

use crate::{
    arrays::{SignalArray, column},
    axes::refuse,
};

pub(crate) fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<PyUrInverse>()
}

/// Rows as Python gives them: theta, a, d, alpha.
type Rows = ([f64; 6], [f64; 6], [f64; 6], [f64; 6]);

fn rows((theta, a, d, alpha): Rows) -> UrRows {
    UrRows { theta, a, d, alpha }
}

fn pose(name: &str, array: &SignalArray<'_>) -> PyResult<UrPose> {
    let array = array.array();
    if array.shape() != [4, 4] {
        let shape = array.shape();
        return Err(PyValueError::new_err(format!("{name}: shape {shape:?}, must be (4, 4)")));
    }
    let view = array.as_array();
    for (column, expected) in [0.0, 0.0, 0.0, 1.0].into_iter().enumerate() {
        let seen = view[[3, column]];
        if seen != expected {
            let message = format!("{name}: {seen} in the last row, which must be (0, 0, 0, 1)");
            return Err(PyValueError::new_err(message));
        }
    }
    let rows = std::array::from_fn(|row| std::array::from_fn(|column| view[[row, column]]));
    UrPose::from_rows(&rows).map_err(|error| PyValueError::new_err(format!("{name}: {error}")))
}

fn six(name: &str, array: &SignalArray<'_>) -> PyResult<[f64; 6]> {
    let array = array.array();
    if array.shape() != [6] {
        let shape = array.shape();
        return Err(PyValueError::new_err(format!("{name}: shape {shape:?}, must be (6,)")));
    }
    let view = array.as_array();
    let numbers: [f64; 6] = std::array::from_fn(|index| view[[index]]);
    if let Some(seen) = numbers.iter().find(|number| !number.is_finite()) {
        return Err(PyValueError::new_err(format!("{name}: {seen}, must be finite")));
    }
    Ok(numbers)
}

#[documented(UrInverseSolver)]
#[pyclass(name = "UrInverseSolver", module = "haptether._core", frozen)]
pub(crate) struct PyUrInverse {
    inverse: UrInverse,
    tool_from_flange: UrPose,
}

#[documented(UrInverseSolver)]
#[pymethods]
impl PyUrInverse {
    #[new]
    #[pyo3(signature = (model, unit, position_min, position_max, flange_from_tool))]
    fn new(
        model: Rows,
        unit: Option<Rows>,
        position_min: [f64; 6],
        position_max: [f64; 6],
        flange_from_tool: SignalArray<'_>,
    ) -> PyResult<Self> {
        let unit = unit.map(rows);
        let inverse =
            UrInverse::new(&rows(model), unit.as_ref(), position_min, position_max).map_err(refuse)?;
        let flange_from_tool = pose("flange_from_tool", &flange_from_tool)?;
        Ok(Self { inverse, tool_from_flange: flange_from_tool.inverse() })
    }

    fn all(&self, py: Python<'_>, base_from_tool: SignalArray<'_>) -> PyResult<Py<PyAny>> {
        let flange = pose("base_from_tool", &base_from_tool)?.then(&self.tool_from_flange);
        let found = self.inverse.all(&flange);
        let postures = found.postures();
        let array = postures.as_flattened().to_vec().into_pyarray(py).reshape([postures.len(), 6])?;
        Ok(array.into_any().unbind())
    }

    fn nearest(
        &self,
        py: Python<'_>,
        base_from_tool: SignalArray<'_>,
        near: SignalArray<'_>,
    ) -> PyResult<Py<PyAny>> {
        let flange = pose("base_from_tool", &base_from_tool)?.then(&self.tool_from_flange);
        match self.inverse.nearest(&flange, &six("q_near", &near)?) {
            Ok(posture) => Ok(column(py, posture.to_vec())),
            Err(reason) => Ok(reason.to_string().into_pyobject(py)?.into_any().unbind()),
        }
    }
}
