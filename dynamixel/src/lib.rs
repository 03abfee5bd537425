//! Bus of Dynamixel servos: Protocol 2.0 as pure state machines.
//!
//! [`Packet`] encodes an [`Instruction`], and [`StatusParser`] turns bytes into checked answers. [`SyncRead`]
//! is one read of several servos, which returns the values of all or of none. They own no port and no clock,
//! and allocate nothing. [`Bus`] owns both and drives them; [`SharedBus`] serves several threads.
//!
//! Source: ROBOTIS e-Manual, DYNAMIXEL Protocol 2.0.

mod crc;
mod error;
mod instruction;
mod live;
mod parser;
mod sync_read;

pub use crc::{Crc16, crc16};
pub use error::{Refusal, StatusError};
pub use instruction::{BROADCAST, BulkItem, Instruction, MAX_ID, MAX_PACKET, Packet, RequestError};
pub use live::{Bus, BusError, SharedBus};
pub use parser::{FastReply, FrameError, Received, Status, StatusParser};
pub use sync_read::{MAX_SERVOS, Progress, Reply, SyncRead, SyncReadError};
