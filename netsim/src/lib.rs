//! Network impairment for teleoperation: one model of delay, loss and damage for two drivers.
//!
//! A [`Link`] is one direction of the network. It applies rules in a fixed order; each maps a [`Packet`] to a
//! [`Verdict`]: deliver at a time, or drop with a cause. A link reads no clock and owns no socket.
//!
//! A verdict depends only on settings, seed and the packets so far. It is the same on every platform, because
//! no function of the platform's mathematical library is used. Randomness is counter-based, keyed by (seed,
//! direction and impairment, packet index or time): enabling one impairment shifts no draw of another.
//!
//! Delivered packets wait in an [`InFlight`] queue. The virtual-time runner empties it at simulated times.
//! The [`Proxy`] empties it at real times, between two processes that are unaware of it.

mod address;
mod checks;
mod clock;
mod damage;
mod impairments;
mod in_flight;
mod link;
mod on_off;
mod packet;
mod probe;
mod proxy;
mod random;
mod reply;
mod rule;
mod verdict;

#[cfg(test)]
mod tests;

pub use address::{addresses, unsuited_peer};
pub use checks::{LinkSettingsError, MAX_DELAY_S};
pub use clock::{ClockSettings, EndpointClock};
pub use damage::{Checksum, Damage, Edit, Operation};
pub use impairments::*;
pub use in_flight::{DEFAULT_CAPACITY, InFlight};
pub use link::{Link, LinkCounters, Rules};
pub use packet::{Direction, Packet};
pub use probe::{
    Echo, EchoStatistics, MAX_PROBES, MAX_RATE_HZ, Probe, ProbeError, RecordSettings, Recording, answering,
    record,
};
pub use proxy::{
    DirectionStatistics, MAX_DATAGRAM, MAX_FLOWS, Proxy, ProxyControl, ProxyError, ProxyMonitor,
    ProxySettings, ProxyStatistics, ScheduleBefore, Scheduling, SchedulingError, Source, schedule_fifo,
};
pub use reply::{ReplyAddress, ReplySocket};
pub use verdict::{DropCause, Extra, ExtraCause, Judgement, Verdict};
