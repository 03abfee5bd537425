//! Kind of the coordinates of a side.

use schemars::JsonSchema;
use serde::Deserialize;

/// Kind of the coordinates of a side; the same at both sides of a session.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum SideKind {
    /// A point along 1 to 3 axes, in m.
    #[default]
    Linear = 1,
    /// 1 to 7 joints, in rad. Read m/s as rad/s and N as N m.
    Joints,
    /// A point along 3 axes with an orientation: velocity is a twist, force a wrench, in the base frame about the
    /// tool point.
    Pose,
}

impl SideKind {
    /// Name in a scene.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Linear => "linear",
            Self::Joints => "joints",
            Self::Pose => "pose",
        }
    }

    /// Code on the wire.
    pub(crate) const fn code(self) -> u8 {
        self as u8
    }

    /// Return whether `axes` is a valid number of axes.
    pub const fn has_axes(self, axes: usize) -> bool {
        match self {
            Self::Linear => matches!(axes, 1..=3),
            Self::Joints => matches!(axes, 1..=7),
            Self::Pose => axes == 3,
        }
    }
}
