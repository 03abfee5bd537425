//! Couplings: what each side asks of its device, given the newest of the other side.

mod position_force;

pub use position_force::{CouplingError, PositionForce};
