//! Bus on a serial port: the only code here with a descriptor or a clock.

mod bus;
mod port;
mod shared;
mod stops;

pub use bus::{Bus, BusError};
pub use shared::SharedBus;
