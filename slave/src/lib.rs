//! The remote side: arm and environment models, advanced in time.
//!
//! [`SimulatedSlave`] is an arm in an [`Environment`]. An environment can also be used alone, where its force is
//! rendered on the device itself. Everything is a pure state machine: time is an argument, and nothing allocates after
//! construction.

mod arm;
mod contact;
mod gripper;
mod settings;
mod simulated;
mod solver;
mod tool;
mod ur;

pub use arm::force_sensor::ForceSensor;
pub use arm::model::{ArmControl, ArmModel};
pub use contact::environment::Environment;
pub use contact::law::{Contact, ContactLaw, FULL_SLIP};
pub use contact::object::{FreeBody, Object, ObjectMotion, Shape};
pub use contact::pusher::{Push, PushShape, Pusher, Series};
pub use contact::rendered::{RenderedPush, RenderedWall, RenderedWalls};
pub use contact::wall::Wall;
pub use gripper::{GripperCommand, GripperSample, GripperSettings, SimulatedGripper};
pub use haptether_numeric::{Axes, Real};
pub use settings::{
    ArmSettings, BodySettings, ContactLawKind, ContactSettings, ControlKind, ForceSensorSettings,
    ObjectMotionSettings, ObjectSettings, PushKind, PusherSettings, SeriesSettings, ShapeSettings,
};
pub use simulated::{SimulatedSlave, SlaveLanes, SlaveLanesSample, SlaveSample};
pub use tool::{
    HandleSettings, HoleSettings, RigidBodySettings, SimulatedTool, ToolSample, ToolSettings,
    ToolWorldSettings,
};
pub use ur::chain::{UrPose, UrRows};
pub use ur::inverse::{UrBranches, UrUnreached};
pub use ur::nearest::UrInverse;

/// An invalid parameter of a model.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{name} = {seen}: must be {allowed}")]
pub struct ModelError {
    /// Name of the field.
    pub name: &'static str,
    /// Rejected value.
    pub seen: f64,
    /// Allowed values.
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

/// Apply `require` to each axis.
pub(crate) fn require_axes<const N: usize>(
    name: &'static str,
    seen: &Axes<N>,
    holds: impl Fn(f64) -> bool,
    allowed: &'static str,
) -> Result<(), ModelError> {
    seen.iter().try_for_each(|&value| require(name, value, holds(value), allowed))
}

/// Largest absolute value, with one instruction per axis; NaN is ignored.
#[inline]
pub(crate) fn amax<const N: usize>(values: &Axes<N>) -> f64 {
    values.iter().fold(0.0, |largest, value| value.abs().larger(largest))
}

pub(crate) fn all_finite<const N: usize>(values: &Axes<N>) -> bool {
    values.iter().all(|value| value.is_finite())
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn the_largest_value_is_that_of_nalgebra(
            values in [-1e3..1e3_f64, -1e3..1e3_f64, -1e3..1e3_f64],
            exponent in -500..500_i32,
        ) {
            let values = Axes::<3>::from(values) * 2_f64.powi(exponent);
            prop_assert_eq!(amax(&values), values.amax());
        }
    }

    #[test]
    fn nan_is_ignored() {
        let found = [[f64::NAN, -2.0, 1.0], [1.0, f64::NAN, -2.0], [-2.0, 1.0, f64::NAN]]
            .map(|v| amax(&Axes::<3>::from(v)));
        assert_eq!(found, [2.0; 3]);
    }
}
