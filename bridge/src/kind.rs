//! What the coordinates of a side are.

use schemars::JsonSchema;
use serde::Deserialize;

/// What the coordinates of a side are: both sides of a session have the same.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum SideKind {
    /// A point along 1 to 3 axes, in m.
    #[default]
    Linear = 1,
    /// 1 to 7 joints, in rad; velocity in rad/s, torque in N m where it says m/s and N.
    Joints,
    /// A point along 3 axes with an orientation: velocity is a twist and force a wrench, in the base frame about the
    /// tool point.
    Pose,
}

impl SideKind {
    /// As it is written in a scene.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Linear => "linear",
            Self::Joints => "joints",
            Self::Pose => "pose",
        }
    }

    /// Its number on the wire.
    pub(crate) const fn code(self) -> u8 {
        self as u8
    }

    /// Whether it can have that many axes.
    pub const fn has_axes(self, axes: usize) -> bool {
        match self {
            Self::Linear => matches!(axes, 1..=3),
            Self::Joints => matches!(axes, 1..=7),
            Self::Pose => axes == 3,
        }
    }
}
