//! Halves of a coupling for the rotation: those of the translation, on the difference of two orientations.
//!
//! A half only uses differences of positions. So it gets zero as its own position, and the vector `phi = log(R' R^-1)`
//! towards the other side as that of the peer, in the base frame of the slave.

mod master;
mod slave;

use nalgebra::UnitQuaternion;

use haptether_safety::Axes;

pub(crate) use master::CoupledMasterTurn;
pub(crate) use slave::CoupledSlaveTurn;

use super::super::rotational_spring::faded_phi;

/// Return the vector that a spring from one orientation to another stretches, with its fading near pi.
fn stretch(from: &UnitQuaternion<f64>, to: &UnitQuaternion<f64>) -> Axes<3> {
    faded_phi(&(to * from.inverse()).scaled_axis())
}

#[cfg(test)]
mod tests;
