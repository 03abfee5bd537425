//! What the tool may touch, what pushes it, and the force of both.

pub(crate) mod body;
pub(crate) mod environment;
pub(crate) mod law;
pub(crate) mod motion;
pub(crate) mod object;
pub(crate) mod pusher;
mod reach;
pub(crate) mod rendered;
pub(crate) mod shape;
mod window;
