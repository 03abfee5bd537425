//! Arm and bodies advanced in time: exactly between contacts if their motion is linear, else by an adaptive method.

pub(crate) mod adaptive;
mod coarse;
pub(crate) mod linear;
mod located;
mod sliding;
pub(crate) mod state;
