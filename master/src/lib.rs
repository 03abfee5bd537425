//! The master side: models of haptic device and hand, advanced exactly in time.

mod aim;
mod device;
mod direction;
mod hand;
mod live;
mod path;
mod polynomial;
mod propagator;
mod rotation;
mod simulated;
mod stretch;
mod wall;

pub use aim::Aim;
pub use device::{DeviceParameters, Friction};
pub use hand::{Hand, Regrasp, Release, ReleaseKind, Tremor};
pub use haptether_numeric::{Axes, Real};
pub use live::{HdCallback, HdErrorInfo, HdFunctions, HdSample};
pub use path::{Leg, LegShape, Path};
pub use rotation::{
    RotationHand, RotationHandParameters, RotationLeg, RotationParameters, RotationSample, SimulatedRotation,
    TorsionSpring,
};
pub use simulated::{MasterLanes, MasterLanesSample, MasterSample, SimulatedMaster, Touch};
pub use wall::ContinuousWall;

/// Invalid parameter of a model.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{name} = {seen}: must be {allowed}")]
pub struct ModelError {
    /// Name of the parameter.
    pub name: &'static str,
    /// The rejected value.
    pub seen: f64,
    /// Valid values, in words.
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
