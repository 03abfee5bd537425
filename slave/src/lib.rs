//! The remote side: arm and environment models, advanced in time.
//!
//! [`SimulatedSlave`] is an arm in an [`Environment`]; an environment also stands alone, where its force is rendered on
//! the device itself. Everything is a pure state machine: time is an argument, and nothing is allocated after
//! construction.

mod arm;
mod axes;
mod contact;
mod one_axis;
mod settings;
mod simulated;
mod solver;
mod ur;
mod wall;

pub use arm::force_sensor::ForceSensor;
pub use arm::model::{ArmControl, ArmModel, ArmParameters};
pub use axes::Axes;
pub use contact::body::FreeBody;
pub use contact::environment::Environment;
pub use contact::law::{Contact, ContactLaw, FULL_SLIP};
pub use contact::motion::ObjectMotion;
pub use contact::object::Object;
pub use contact::pusher::{PushShape, Pusher, Series};
pub use contact::rendered::{Real, RenderedPush, RenderedWall, RenderedWalls};
pub use contact::shape::Shape;
pub use settings::{
    ArmSettings, BodySettings, ContactLawKind, ContactSettings, ControlKind, ForceSensorSettings,
    ObjectMotionSettings, ObjectSettings, PushKind, PusherSettings, SeriesSettings, ShapeSettings,
};
pub use simulated::{SimulatedSlave, SlaveSample};
pub use ur::inverse::{UrBranches, UrUnreached};
pub use ur::nearest::UrInverse;
pub use ur::rows::{UrPose, UrRows};
pub use wall::Wall;

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
