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
    module.add_class::<PyCouplingFacts>()?;
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

#[documented(CouplingFacts)]
#[pyclass(name = "CouplingFacts", module = "haptether.bridge", frozen, get_all)]
struct PyCouplingFacts {
    stiffness: Option<f64>,
    damping: Option<f64>,
    master: Option<[f64; 5]>,
    slave: Option<[f64; 4]>,
    impedance: Option<f64>,
    start_energy_j: Option<f64>,
    least_damping: Option<f64>,
    compliance: Option<f64>,
    keeps_ledger: bool,
    push_may_grow: bool,
}

/// Return the kind of a name.
pub(crate) fn coupling_kind(name: &str) -> PyResult<CouplingKind> {
    let kind = CouplingKind::ALL.iter().copied().find(|kind| kind.name() == name);
    let names = || CouplingKind::ALL.iter().map(|kind| kind.name()).collect::<Vec<_>>().join(", ");
    kind.ok_or_else(|| PyValueError::new_err(format!("coupling {name:?}: must be one of {}", names())))
}

#[documented]
#[pyfunction]
#[pyo3(signature = (
    name, *, stiffness=None, damping=None, impedance=None, spread_s=None, round_trip_s=0.0, period_s=1e-3
))]
fn coupling_facts(
    name: &str,
    stiffness: Option<f64>,
    damping: Option<f64>,
    impedance: Option<f64>,
    spread_s: Option<f64>,
    round_trip_s: f64,
    period_s: f64,
) -> PyResult<PyCouplingFacts> {
    let kind = coupling_kind(name)?;
    let gains = kind.default_gains().map(|default| {
        Gains {
            stiffness: stiffness.unwrap_or(default.stiffness),
            damping: damping.unwrap_or(default.damping),
            impedance: impedance.unwrap_or(default.impedance),
            spread_s: spread_s.unwrap_or(default.spread_s),
            ..default
        }
        .checked()
    });
    let gains = gains.transpose().map_err(|error| PyValueError::new_err(error.to_string()))?;
    let matrix = gains.and_then(|gains| coupling_matrix(kind, gains));
    Ok(PyCouplingFacts {
        stiffness: gains.map(|gains| gains.stiffness),
        damping: gains.map(|gains| gains.damping),
        master: matrix.map(|matrix| matrix.master),
        slave: matrix.map(|matrix| matrix.slave),
        impedance: gains.map(|gains| gains.impedance).filter(|impedance| *impedance > 0.0),
        start_energy_j: gains.map(|gains| gains.start_j).filter(|_| kind.sends_energy()),
        compliance: gains.and_then(|gains| kind.compliance(&gains, round_trip_s, period_s)),
        keeps_ledger: kind.sends_energy(),
        least_damping: gains.and_then(|gains| kind.least_damping(gains.stiffness, round_trip_s, period_s)),
        push_may_grow: kind.push_may_grow(),
    })
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
