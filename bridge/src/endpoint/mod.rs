//! Endpoints: one side's work at a tick, without socket, thread or clock.

mod alternative;
mod arm;
mod exchange;
mod hand;
mod layer;
mod master;
mod rotation;
mod slave;
mod translation;
mod trigger;

pub(crate) use arm::{Arm, ArmInput, MasterState, TOOL_LEVER_M};
pub use exchange::{Exchange, SideCounts};
pub use hand::{CarriedState, HandInput};
pub(crate) use hand::{Hand, HandLanes};
pub use layer::{MasterReading, MasterRotationSettings};
pub use master::{MasterEndpoint, MasterSettings, MasterTick};
pub use rotation::SlaveRotationSettings;
pub use slave::{SlaveEndpoint, SlaveReading, SlaveSettings, SlaveTick};
pub(crate) use translation::{SlaveTranslation, TranslationInput};
pub use trigger::{TriggerError, TriggerSettings};

/// dT in s.
pub(crate) fn period_s(period_ns: u64) -> f64 {
    period_ns as f64 * 1e-9
}

/// Invalid settings of an endpoint.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum EndpointError {
    /// Parameter of the safety layer.
    #[error(transparent)]
    Safety(#[from] haptether_safety::ParameterError),
    /// Scale of the coupling.
    #[error(transparent)]
    Coupling(#[from] crate::coupling::CouplingError),
    /// Force feedback of a trigger.
    #[error(transparent)]
    Trigger(#[from] TriggerError),
    /// Invalid time setting of the ladder.
    #[error(transparent)]
    Ladder(#[from] crate::ladder::LadderError),
    /// Period outside 10 us to 20 ms.
    #[error("period = {0} ns: must be between 10000 and 20000000")]
    Period(u64),
}

pub(crate) fn check_period(period_ns: u64) -> Result<(), EndpointError> {
    if (10_000..=20_000_000).contains(&period_ns) { Ok(()) } else { Err(EndpointError::Period(period_ns)) }
}
