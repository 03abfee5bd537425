//! What an operator commands at one side while it runs.

use crate::{
    coupling::{CouplingError, FrameMap, PositionForce, RotationCoupling},
    wire::MAX_AXES,
};

/// A command of the operator at one side. None is taken from the network, and what the other side has is passed over.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum OperatorCommand {
    /// The start of the run, which is a press of the clutch unless it is more than 5 s ago.
    Start,
    /// Releases the clutch for a moment and presses it again; nothing where the device has a button.
    Press,
    /// Releases the clutch, and a closed button counts as open until it was seen open.
    Release,
    /// Lets another master begin, if the one before has been silent for 2 s: at the slave's session.
    Takeover,
    /// This side's fault is mended. Nothing couples by it: the clutch must then be released and pressed.
    Acknowledge,
    /// Changes `lambda_p`, at the slave: it fades, and the arm goes on from where it is.
    PositionScale(f64),
    /// Changes `lambda_f`, at the master: it fades.
    ForceScale(f64),
    /// Changes `lambda_r`, at the slave: it fades, and the arm goes on from where it is.
    RotationScale(f64),
    /// Changes `lambda_tau`, at the master: it fades.
    TorqueScale(f64),
    /// Changes rotation and locks, at both sides alike: it fades, and the arm goes on from where it is.
    Frame {
        /// Unit quaternion of the rotation from the master's frame to the slave's.
        quat_wxyz: [f64; 4],
        /// Whether the slave's axis does not follow; those beyond its number of axes count for nothing.
        locked: [bool; MAX_AXES],
    },
}

impl OperatorCommand {
    /// Refuses numbers that an endpoint of N axes cannot have.
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
