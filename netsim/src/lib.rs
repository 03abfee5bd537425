//! Network impairment for teleoperation: what a bad network does to each packet, decided once for two
//! drivers.
//!
//! A [`Link`] is one direction of the network: rules applied in a fixed order, each of which turns a [`Packet`] into a
//! [`Verdict`]: deliver at a time, or drop with a cause. It reads no clock and owns no socket; a verdict depends on
//! settings, seed and the packets up to it alone, and is the same on every platform, as no function of the platform's
//! mathematical library is used. Randomness is counter-based, keyed by (seed, direction and impairment, packet index or
//! time): switching one impairment on shifts no other. Delivered packets wait in an [`InFlight`] queue,
//! which the virtual-time runner empties at simulated times and the [`Proxy`] at real ones, between two
//! processes that know nothing of it.

mod adversary;
mod alteration;
mod bound;
mod clock;
mod corrupt;
mod damage;
mod delay;
mod duplicate;
mod in_flight;
mod jitter;
mod law;
mod link;
mod loss;
mod mtu;
pub mod netem;
mod on_off;
mod outage;
mod probe;
mod proxy;
mod random;
mod rate;
mod reorder;
mod rule;
mod settings;
mod slots;
mod timeline;
mod trace;
mod truncate;
mod verdict;

#[cfg(test)]
mod tests;

pub use clock::EndpointClock;
pub use damage::Damage;
pub use in_flight::{DEFAULT_CAPACITY, InFlight};
pub use law::DelayLaw;
pub use link::{Link, LinkCounters, Rules};
pub use probe::{
    Echo, EchoStatistics, MAX_PROBES, MAX_RATE_HZ, Probe, ProbeError, RecordSettings, Recording, record,
};
pub use proxy::{
    DirectionStatistics, MAX_DATAGRAM, MAX_FLOWS, Proxy, ProxyControl, ProxyError, ProxyMonitor,
    ProxySettings, ProxyStatistics, ScheduleBefore, Scheduling, SchedulingError, Source, schedule_fifo,
};
pub use settings::{
    Action, Attack, ByteRange, Checksum, ClockSettings, CrossTraffic, DelayChange, DelayTrace, Discipline,
    Distribution, Edit, FourState, GilbertElliott, LinkError, LinkSettings, MAX_DELAY_S, Operation,
    Opportunities, Outage, OutageEffect, OutageTimes, Slots, Target,
};
pub use trace::{
    IrttDelay, IrttRecording, ParseError, parse_delay_csv, parse_dist, parse_irtt, parse_mahimahi,
};
pub use verdict::{Direction, DropCause, Extra, ExtraCause, Judgement, Packet, Verdict};
