//! Network impairment for teleoperation: what a bad network does to each packet, decided once for two
//! drivers.
//!
//! A [`Link`] is one direction of the network: rules applied in a fixed order, each of which maps a [`Packet`] to a
//! [`Verdict`]: deliver at a time, or drop with a cause. It reads no clock and owns no socket; a verdict depends on
//! settings, seed and the packets up to it alone, and is the same on every platform, as no function of the platform's
//! mathematical library is used. Randomness is counter-based, keyed by (seed, direction and impairment, packet index or
//! time): switching one impairment on shifts no other. Delivered packets wait in an [`InFlight`] queue,
//! which the virtual-time runner empties at simulated times and the [`Proxy`] at real ones, between two
//! processes that know nothing of it.

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
pub use reply::{Asker, ReplySocket};
pub use verdict::{DropCause, Extra, ExtraCause, Judgement, Verdict};
