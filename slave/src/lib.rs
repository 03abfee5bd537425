//! The remote side: arm and environment models, advanced in time.
//!
//! [`SimulatedSlave`] is an arm in an [`Environment`]; an environment also stands alone, where its force is rendered on
//! the device itself. Everything is a pure state machine: time is an argument, and nothing is allocated after
//! construction.

mod arm;
mod arm_drive;
mod axes;
mod body;
mod coarse;
mod contact;
mod dormand_prince;
mod environment;
mod force_sensor;
mod held;
mod linear;
mod located;
mod motion;
mod object;
mod pusher;
mod random;
mod reach;
mod rendered;
mod set_point;
mod settings;
mod shape;
mod simulated;
mod solve;
mod solver;
mod transition;
mod ur_inverse;
mod ur_nearest;
mod ur_refine;
mod ur_rows;
mod wall;
mod window;

pub use arm::{ArmControl, ArmModel, ArmParameters};
pub use axes::Axes;
pub use body::FreeBody;
pub use contact::{Contact, ContactLaw, FULL_SLIP};
pub use environment::Environment;
pub use force_sensor::ForceSensor;
pub use motion::ObjectMotion;
pub use object::Object;
pub use pusher::{PushShape, Pusher, Series};
pub use rendered::{Real, RenderedPush, RenderedWall, RenderedWalls};
pub use settings::{
    ArmSettings, BodySettings, ContactLawKind, ContactSettings, ControlKind, ForceSensorSettings,
    ObjectMotionSettings, ObjectSettings, PushKind, PusherSettings, SeriesSettings, ShapeSettings,
};
pub use shape::Shape;
pub use simulated::{SimulatedSlave, SlaveSample};
pub use ur_inverse::{UrBranches, UrUnreached};
pub use ur_nearest::UrInverse;
pub use ur_rows::{UrPose, UrRows};
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
