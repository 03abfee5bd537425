//! Inverse kinematics of UR arms.

pub(crate) mod chain;
pub(crate) mod inverse;
pub(crate) mod nearest;
