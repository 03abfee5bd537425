//! The live runner: the same sides as in virtual time, with sockets and sleep added and nothing else.

mod channel;
mod clock;
mod handshakes;
mod outlets;
mod realtime;
mod run;
mod socket;

pub use channel::Security;
pub use handshakes::{SecurityEvent, StartError};
pub use realtime::{Granted, RealtimeDemand, RealtimeReport, RealtimeSettings};
pub use run::{LiveRun, LiveSettings, LoopReport, run_live};
pub use socket::{PeerAddress, PeerSocket};
