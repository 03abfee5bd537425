//! Commands of an operator to a running side.

use crate::{
    coupling::{CouplingError, FrameMap, PositionForce, RotationCoupling},
    wire::MAX_AXES,
};

/// A command of the operator at one side. None is taken from the network. A side ignores commands for the other side.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum OperatorCommand {
    /// Start of the run; a press of the clutch unless more than 5 s old.
    Start,
    /// Releases the clutch briefly and presses it again. No effect if the device has a button.
    Press,
    /// Releases the clutch. A closed button counts as open until it was seen open.
    Release,
    /// Lets another master begin after 2 s of silence, at the slave.
    Takeover,
    /// Acknowledges the fault of this side. It couples nothing: the clutch must then be released and pressed.
    Acknowledge,
    /// Changes `lambda_p`, at the slave, with a fade; the arm goes on from where it is.
    PositionScale(f64),
    /// Changes `lambda_f`, at the master, with a fade.
    ForceScale(f64),
    /// Changes `lambda_r`, at the slave, with a fade; the arm goes on from where it is.
    RotationScale(f64),
    /// Changes `lambda_tau`, at the master, with a fade.
    TorqueScale(f64),
    /// Changes rotation and locks, at both sides alike, with a fade; the arm goes on from where it is.
    Frame {
        /// Unit quaternion of the rotation from the master's frame to the slave's.
        quat_wxyz: [f64; 4],
        /// True for each axis of the slave that does not follow; entries beyond its axes are ignored.
        locked: [bool; MAX_AXES],
    },
}

impl OperatorCommand {
    /// Rejects numbers that are invalid for an endpoint of N axes.
    pub fn check<const N: usize>(&self) -> Result<(), CouplingError> {
        match self {
            Self::Start | Self::Press | Self::Release | Self::Takeover | Self::Acknowledge => Ok(()),
            Self::PositionScale(scale) => PositionForce::<N>::new(*scale, 1.0).map(|_| ()),
            Self::ForceScale(scale) => PositionForce::<N>::new(1.0, *scale).map(|_| ()),
            Self::RotationScale(scale) => RotationCoupling::new(*scale, 1.0).map(|_| ()),
            Self::TorqueScale(scale) => RotationCoupling::new(1.0, *scale).map(|_| ()),
            Self::Frame { quat_wxyz, locked } => FrameMap::<N>::rotated(*quat_wxyz, locked).map(|_| ()),
        }
    }
}
