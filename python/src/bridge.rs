//! `haptether.bridge`: texts for codes of the ladder, and conversion of times.

use haptether_bridge::{
    LadderState, Reason,
    coupling::{CouplingKind, Gains, coupling_matrix},
};
use pyo3::{exceptions::PyValueError, prelude::*, types::PyTuple};

pub(crate) fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add("LADDER_STATES", PyTuple::new(module.py(), LadderState::ALL.map(LadderState::name))?)?;
    let couplings = CouplingKind::ALL.iter().map(|kind| kind.about());
    let rows = couplings.map(|about| (about.name, about.title, about.source)).collect::<Vec<_>>();
    module.add("COUPLINGS", PyTuple::new(module.py(), rows)?)?;
    module.add_function(wrap_pyfunction!(coupling_facts, module)?)?;
    module.add_function(wrap_pyfunction!(ladder_state_name, module)?)?;
    module.add_function(wrap_pyfunction!(ladder_reason, module)?)
}

/// Convert a non-negative time in s to ns.
pub(crate) fn nanoseconds(key: &str, seconds: f64) -> PyResult<u64> {
    if seconds.is_finite() && (0.0..=1e9).contains(&seconds) {
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // checked above
        return Ok((seconds * 1e9).round() as u64);
    }
    Err(PyValueError::new_err(format!("{key} = {seconds}: must be between 0 and 1e9 s")))
}

type Coefficients = (Vec<f64>, Vec<f64>);
type Facts = (Option<(f64, f64)>, Option<Coefficients>, Option<f64>, bool);

#[documented]
#[pyfunction]
#[pyo3(signature = (name, *, stiffness=None, damping=None, round_trip_s=0.0, period_s=1e-3))]
fn coupling_facts(
    name: &str,
    stiffness: Option<f64>,
    damping: Option<f64>,
    round_trip_s: f64,
    period_s: f64,
) -> PyResult<Facts> {
    let kind = CouplingKind::ALL.iter().copied().find(|kind| kind.name() == name);
    let names = || CouplingKind::ALL.iter().map(|kind| kind.name()).collect::<Vec<_>>().join(", ");
    let kind =
        kind.ok_or_else(|| PyValueError::new_err(format!("coupling {name:?}: must be one of {}", names())))?;
    let Some(default) = kind.default_gains() else {
        return Ok((None, None, None, kind.push_may_grow()));
    };
    let gains = Gains::new(stiffness.unwrap_or(default.stiffness), damping.unwrap_or(default.damping))
        .map_err(|error| PyValueError::new_err(error.to_string()))?;
    let matrix = coupling_matrix(kind, gains).map(|matrix| (matrix.master.to_vec(), matrix.slave.to_vec()));
    let least = kind.least_damping(gains.stiffness, round_trip_s, period_s);
    Ok((Some((gains.stiffness, gains.damping)), matrix, least, kind.push_may_grow()))
}

#[documented]
#[pyfunction]
fn ladder_reason(code: u8) -> PyResult<&'static str> {
    Reason::from_code(code)
        .map(Reason::text)
        .ok_or_else(|| PyValueError::new_err(format!("reason {code}: must be 1 to {}", Reason::ALL.len())))
}

#[documented]
#[pyfunction]
fn ladder_state_name(code: u8) -> PyResult<&'static str> {
    LadderState::from_code(code)
        .map(LadderState::name)
        .ok_or_else(|| PyValueError::new_err(format!("state {code}: must be 0 to 6")))
}
