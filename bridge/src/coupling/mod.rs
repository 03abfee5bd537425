//! Couplings: what each side asks of its device, given the newest of the other side.

mod bounds;
mod decay;
mod energy;
mod frame;
mod position_force;

pub(crate) use bounds::bounded;
pub use bounds::{CommandBounds, Limited};
pub(crate) use decay::decayed;
pub use energy::{MAX_ENERGY_J, PortEnergy};
pub use frame::FrameMap;
pub use position_force::{CouplingError, PositionForce};
