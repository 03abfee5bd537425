//! What a person does at one side while it runs.

use crate::{
    coupling::{CouplingError, FrameMap, PositionForce},
    wire::MAX_AXES,
};

/// Something done at one side while it runs. Nothing of it comes from the network.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum OperatorCommand {
    /// Says that this side's fault is mended. Nothing couples by it: the clutch must then be released and pressed.
    Acknowledge,
    /// Changes `lambda_p`, at the slave; the arm goes on from where it is.
    PositionScale(f64),
    /// Changes `lambda_f`, at the master; how fast the force follows is the limiter's.
    ForceScale(f64),
    /// Changes rotation and locks, at both sides alike; the arm goes on from where it is.
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
            Self::Acknowledge => Ok(()),
            Self::PositionScale(scale) => PositionForce::<N>::new(*scale, 1.0).map(|_| ()),
            Self::ForceScale(scale) => PositionForce::<N>::new(1.0, *scale).map(|_| ()),
            Self::Frame { quat_wxyz, locked } => FrameMap::<N>::turned(*quat_wxyz, locked).map(|_| ()),
        }
    }
}
