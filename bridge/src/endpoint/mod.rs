//! Endpoints: all that one side does at a tick, without socket, thread or clock.

mod master;
mod slave;

pub use master::{MasterEndpoint, MasterSettings, MasterTick};
pub use slave::{SlaveEndpoint, SlaveSettings, SlaveTick};

use crate::{ladder::LadderState, wire::Frame};

/// dT in s.
pub(crate) fn period_s(period_ns: u64) -> f64 {
    period_ns as f64 * 1e-9
}

/// Whether the sender of this frame can be coupled with: it hears us and has not stopped.
pub(crate) fn is_ready<const N: usize>(frame: &Frame<N>) -> bool {
    let state = LadderState::from_code(frame.state);
    frame.hears_peer && state.is_some_and(|state| !matches!(state, LadderState::Stop | LadderState::Fault))
}

/// Settings that an endpoint cannot have.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum EndpointError {
    /// A parameter of the safety layer.
    #[error(transparent)]
    Safety(#[from] haptether_safety::ParameterError),
    /// A scale of the coupling.
    #[error(transparent)]
    Coupling(#[from] crate::coupling::CouplingError),
    /// A period outside 50 us to 20 ms.
    #[error("period = {0} ns: must be between 50000 and 20000000")]
    Period(u64),
}

pub(crate) fn check_period(period_ns: u64) -> Result<(), EndpointError> {
    if (50_000..=20_000_000).contains(&period_ns) { Ok(()) } else { Err(EndpointError::Period(period_ns)) }
}
