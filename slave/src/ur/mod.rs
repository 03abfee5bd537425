//! Inverse kinematics of UR arms.

pub(crate) mod inverse;
pub(crate) mod nearest;
mod refine;
pub(crate) mod rows;
