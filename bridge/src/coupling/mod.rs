//! Couplings: the request of each side to its device, from the newest state of the other side.

mod alignment;
mod change;
mod command;
#[cfg(test)]
pub(crate) mod drawn;
mod error;
mod frame_map;
mod gripper;
mod mapping;
mod method;
mod orientation;
mod reference_point;
mod rotation;
mod rotational_spring;
mod wrench;

pub use alignment::{
    ALIGNED_RAD, Alignment, AlignmentError, AlignmentSettings, AlignmentStep, ROUND_TRIP_S, SETTLED_S,
};
pub use change::{CHANGE_FACTOR, OPEN_FACTOR, ScaleRange, ScaleRanges};
pub use command::{CommandBounds, Limited, RotationBounds};
pub(crate) use command::{bounded, decayed, turned_within};
pub use error::CouplingError;
pub use frame_map::FrameMap;
pub use gripper::{GripperFollower, GripperState};
pub use mapping::Mapping;
pub(crate) use method::{
    CoupledMaster, CoupledMasterTurn, CoupledSlave, CoupledSlaveTurn, HandMotion, OfHalf, OfMaster, Room,
    capped,
};
pub use method::{
    CouplingAbout, CouplingKind, CouplingMatrix, ForceArm, Gains, MethodSettings, Sends, VirtualToolSettings,
    coupling_matrix,
};
pub use orientation::{MAX_NORM_ERROR, RotationState, canonical, checked, is_canonical, measured, quat_wxyz};
pub use reference_point::{ReferencePoint, ReferencePointError};
pub use rotation::{ANCHOR_REACH_RAD, RotationCoupling, RotationLock};
pub use rotational_spring::{FULL_SPRING_RAD, RotationalSpring};
pub use wrench::{Twist, Wrench};
