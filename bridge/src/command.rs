//! Commands of an operator to a running side.

use haptether_master::Aim;
use haptether_slave::Push;

use crate::{
    coupling::{CouplingError, CouplingKind, FrameMap, Mapping, RotationCoupling, ScaleRanges},
    port::MAX_AXES,
    wire::Role,
};

/// A command of the operator at one side, never from the network. Commands for the other side are ignored.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum OperatorCommand {
    /// Start of the run; a press of the clutch unless more than 5 s old.
    Start,
    /// Releases the clutch briefly and presses it again; no effect with a device button.
    Press,
    /// Releases the clutch. A closed button counts as open until it was seen open.
    Release,
    /// Lets another master begin after 2 s of silence, at the slave.
    Takeover,
    /// Acknowledges this side's fault. Couples nothing: release and press the clutch then.
    Acknowledge,
    /// Changes `lambda_p` with a fade, at the slave; the arm does not jump.
    PositionScale(f64),
    /// Changes `lambda_f` with a fade, at the master.
    ForceScale(f64),
    /// Changes `lambda_r` with a fade, at the slave; the arm does not jump.
    RotationScale(f64),
    /// Changes `lambda_tau` with a fade, at the master.
    TorqueScale(f64),
    /// Changes rotation and locks with a fade, at both sides alike; the arm does not jump.
    Frame {
        /// Unit quaternion of the rotation from the master's frame to the slave's.
        quat_wxyz: [f64; 4],
        /// True per locked axis of the slave; entries beyond its axes are ignored.
        locked: [bool; MAX_AXES],
    },
    /// Switches both sides to another coupling of the scene, at the master: releases the clutch, and the next press engages
    /// with it.
    Coupling(CouplingKind),
    /// Aims the hand of an aimed model, at the master. It couples nothing.
    Aim(Aim<MAX_AXES>),
    /// Pushes the tool of an aimed model, at the slave.
    Push(Push<MAX_AXES>),
}

impl OperatorCommand {
    /// Reject numbers that are invalid for an endpoint of N axes.
    pub fn check<const N: usize>(&self) -> Result<(), CouplingError> {
        match self {
            Self::Start
            | Self::Press
            | Self::Release
            | Self::Takeover
            | Self::Acknowledge
            | Self::Coupling(_)
            | Self::Aim(_)
            | Self::Push(_) => Ok(()),
            Self::PositionScale(scale) => Mapping::<N>::new(*scale, 1.0).map(|_| ()),
            Self::ForceScale(scale) => Mapping::<N>::new(1.0, *scale).map(|_| ()),
            Self::RotationScale(scale) => RotationCoupling::new(*scale, 1.0).map(|_| ()),
            Self::TorqueScale(scale) => RotationCoupling::new(1.0, *scale).map(|_| ()),
            Self::Frame { quat_wxyz, locked } => FrameMap::<N>::rotated(*quat_wxyz, locked).map(|_| ()),
        }
    }

    /// Check a scale against the ranges of the side `role`. Scales of the other side pass.
    ///
    /// `is_open` is true if the clutch is open and no force is left.
    ///
    /// # Errors
    ///
    /// [`CouplingError::Change`] and [`CouplingError::NoScale`].
    pub fn check_scale(&self, role: Role, ranges: &ScaleRanges, is_open: bool) -> Result<(), CouplingError> {
        let (range, name, scale) = match (role, *self) {
            (Role::Master, Self::ForceScale(scale)) => (&ranges.translation, "force_scale", scale),
            (Role::Slave, Self::PositionScale(scale)) => (&ranges.translation, "position_scale", scale),
            (Role::Master, Self::TorqueScale(scale)) => (&ranges.rotation, "torque_scale", scale),
            (Role::Slave, Self::RotationScale(scale)) => (&ranges.rotation, "rotation_scale", scale),
            _ => return Ok(()),
        };
        range.as_ref().ok_or(CouplingError::NoScale(name))?.check(scale, is_open).map(|_| ())
    }
}
