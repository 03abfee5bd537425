//! The master side: haptic device and human-hand models, advanced exactly in time.

mod device;
mod hand;
mod path;
mod simulated;
mod stretch;

pub use device::DeviceParameters;
pub use hand::{Hand, Release};
pub use path::{Leg, LegShape, Path};
pub use simulated::{MasterSample, SimulatedMaster};

/// A parameter that a model cannot have.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{name} = {seen}: must be {allowed}")]
pub struct ModelError {
    /// The field.
    pub name: &'static str,
    /// The value that was refused.
    pub seen: f64,
    /// What would have been accepted.
    pub allowed: &'static str,
}

pub(crate) fn require(
    name: &'static str,
    seen: f64,
    holds: bool,
    allowed: &'static str,
) -> Result<(), ModelError> {
    if seen.is_finite() && holds { Ok(()) } else { Err(ModelError { name, seen, allowed }) }
}
