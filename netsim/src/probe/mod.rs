//! Measuring a real network: an echo, and a client that records what it does to a stream of probes.

mod estimate;
mod live_echo;
mod live_record;
mod recording;
mod wire;

pub use live_echo::{Echo, EchoStatistics};
pub use live_record::{MAX_PROBES, MAX_RATE_HZ, ProbeError, RecordSettings, record};
pub use recording::{Probe, Recording};
