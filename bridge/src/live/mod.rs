//! The live runner: the same sides as in virtual time, with sockets and sleep added and nothing else.

mod channel;
mod clock;
mod handshakes;
mod memory;
mod outlets;
mod paced;
mod realtime;
mod route;
mod run;
mod socket;
mod turning;
mod watch;

pub use channel::Security;
pub use clock::now_ns;
pub use handshakes::{SecurityEvent, StartError};
pub use memory::{end_for_lack_of_memory, is_exhausted, memory_is_back};
pub use paced::{PacedLoop, paced_by_device};
pub use realtime::{Granted, RealtimeDemand, RealtimeReport, RealtimeSettings};
pub use run::{Ineffective, LiveRun, LiveSettings, LoopReport, run_live};
pub use socket::{PeerAddress, PeerSocket};
pub use watch::{LiveHandle, LiveWatch};
