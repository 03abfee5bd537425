//! Live runner: the same sides as in virtual time, plus sockets and sleep.

mod channel;
mod control;
mod driver_watch;
mod handle;
mod handshakes;
mod live_loop;
mod newest;
mod own_thread;
mod run;
mod slow_device;
mod socket;
mod strangers;
mod system;

pub use channel::Security;
pub use control::{Control, ControlSocket};
pub use driver_watch::{DriverCall, DriverCalls, watch_driver};
pub use handle::{
    CommandError, ControlPort, Ineffective, LiveHandle, LiveWatch, RecordOutputs, RecordReader,
};
pub use handshakes::{SecurityEvent, StartError};
pub use live_loop::{LiveSettings, LoopReport};
pub use newest::Newest;
pub use run::{DriverLoop, Ended, LiveRun, Paced, PacedLoop, paced_by_device, run_live};
pub use socket::{PeerAddress, PeerSocket, local_address};
pub use system::{
    Granted, RealtimeDemand, RealtimeReport, RealtimeSettings, end_for_lack_of_memory, is_exhausted,
    memory_is_back, now_ns,
};
