//! `haptether.bridge`: texts for codes of the ladder, and conversion of times.

use haptether_bridge::{LadderState, Reason, coupling::CouplingKind};
use pyo3::{exceptions::PyValueError, prelude::*, types::PyTuple};

pub(crate) fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add("LADDER_STATES", PyTuple::new(module.py(), LadderState::ALL.map(LadderState::name))?)?;
    let couplings = CouplingKind::ALL.iter().map(|kind| kind.about());
    let rows = couplings.map(|about| (about.name, about.title, about.source)).collect::<Vec<_>>();
    module.add("COUPLINGS", PyTuple::new(module.py(), rows)?)?;
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
