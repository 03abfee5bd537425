//! Objects that the tool may touch, pushers, and the force of both.

pub(crate) mod environment;
pub(crate) mod law;
pub(crate) mod object;
pub(crate) mod pusher;
pub(crate) mod rendered;
pub(crate) mod wall;
mod window;
