//! Bottleneck: packets wait in one queue for a line of limited rate, and take their transmission time.
//!
//! A packet that arrives at a with L bytes of payload and h bytes of headers leaves at
//!
//! ```text
//! start = max(a, free)        free: when the previous packet has left
//! leave = start + 8 (L + h) / rate
//! ```
//!
//! Wait and transmission add to the delay of the path behind the bottleneck. (In netem the wait absorbs the
//! delay.) A FIFO queue needs no events: at its arrival, all packets ahead are determined, and so is its own
//! departure. At equal times, departures precede arrivals.

mod codel;
mod cross;
mod server;
#[cfg(test)]
mod tests;

use std::collections::VecDeque;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use self::codel::Codel;
use self::cross::Cross;
pub use self::cross::CrossTraffic;
pub(crate) use self::server::MAX_OPPORTUNITIES;
pub use self::server::Opportunities;
use self::server::Server;
use crate::checks::{LinkSettingsError, nanoseconds, within};
use crate::impairments::Impairment;
use crate::impairments::LinkSettings;
use crate::impairments::Streams;
use crate::packet::Packet;
use crate::rule::Rule;
use crate::verdict::{DropCause, Verdict};

/// Default queue length in packets, as in many network interfaces.
pub(crate) const DEFAULT_QUEUE_PACKETS: usize = 1000;
/// Packets to reserve memory for; a longer queue grows.
const RESERVED_PACKETS: usize = 16_384;
/// Maximum bound in packets; also limits the length of queues with other bounds.
const MAX_QUEUE_PACKETS: usize = 10_000_000;
const MAX_QUEUE_BYTES: usize = 1 << 40;
const MAX_QUEUE_MS: f64 = 3.6e6;
const MAX_OVERHEAD: usize = 1000;

/// Queue discipline.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Discipline {
    /// Drops packets that arrive while the queue is full.
    #[default]
    TailDrop,
    /// Also drops if packets wait too long for some time: target 5 ms, interval 100 ms. The backlog is
    /// counted when a packet enters, not when it leaves.
    ///
    /// Source: RFC 8289.
    Codel,
}

/// Bounds of the queue; an absent one is the maximum.
#[derive(Clone, Copy, Debug)]
struct Bounds {
    packets: usize,
    bytes: u64,
    wait_ns: u64,
}

/// Packet that is not yet in transmission.
#[derive(Clone, Copy, Debug)]
struct Waiting {
    start_ns: u64,
    wire_bytes: u64,
}

#[derive(Clone, Debug)]
struct Bottleneck {
    server: Server,
    bounds: Bounds,
    waiting: VecDeque<Waiting>,
    waiting_bytes: u64,
    codel: Option<Codel>,
}

impl Bottleneck {
    /// Offers a packet; arrivals do not go back in time.
    fn offer(&mut self, arrival_ns: u64, wire_bytes: u64) -> Verdict {
        self.take_out(arrival_ns);
        let start_ns = self.server.start(arrival_ns);
        let backlog = self.waiting_bytes.saturating_add(wire_bytes);
        if start_ns > arrival_ns {
            let full = self.waiting.len() >= self.bounds.packets
                || backlog > self.bounds.bytes
                || start_ns - arrival_ns > self.bounds.wait_ns;
            if full {
                return Verdict::Drop { cause: DropCause::Queue };
            }
            self.waiting.push_back(Waiting { start_ns, wire_bytes });
            self.waiting_bytes = backlog;
        }
        if let Some(codel) = &mut self.codel
            && codel.drops(arrival_ns, start_ns, backlog)
        {
            return Verdict::Drop { cause: DropCause::Codel };
        }
        Verdict::Deliver { at_ns: self.server.send(arrival_ns, wire_bytes) }
    }

    /// Remove packets whose transmission, or drop by `CoDel`, is due.
    fn take_out(&mut self, now_ns: u64) {
        while let Some(first) = self.waiting.front()
            && first.start_ns <= now_ns
        {
            self.waiting_bytes -= first.wire_bytes;
            self.waiting.pop_front();
        }
    }
}

#[derive(Clone, Debug)]
pub(crate) struct Rate {
    bottleneck: Bottleneck,
    overhead_bytes: u64,
    cross: Option<Cross>,
}

pub(crate) fn build(
    settings: &LinkSettings,
    streams: &Streams,
) -> Result<Option<Box<dyn Rule>>, LinkSettingsError> {
    let server = match (settings.rate_bps, &settings.opportunities) {
        (None, None) => return refuse_strays(settings).map(|()| None),
        (Some(_), Some(_)) => {
            return Err(LinkSettingsError::contradiction(
                "opportunities",
                "given beside rate_bps; a bottleneck has one of the two",
            ));
        }
        (Some(rate_bps), None) => Server::rate(rate_bps)?,
        (None, Some(opportunities)) => Server::opportunities(opportunities)?,
    };
    check_size("overhead_bytes", settings.overhead_bytes, 0, MAX_OVERHEAD)?;
    let bounds = bounds(settings)?;
    let cross = match &settings.cross_traffic {
        None => None,
        Some(traffic) => {
            let drain_ns = drain_ns(bounds, &server, traffic.packet_bytes);
            Some(Cross::new(traffic, drain_ns, streams.of(Impairment::CrossTraffic))?)
        }
    };
    let codel = (settings.discipline == Discipline::Codel).then(Codel::default);
    // Reserved here: the thread of a live driver allocates nothing per packet.
    let waiting = VecDeque::with_capacity(bounds.packets.min(RESERVED_PACKETS));
    let bottleneck = Bottleneck { server, bounds, waiting, waiting_bytes: 0, codel };
    let overhead_bytes = settings.overhead_bytes as u64;
    Ok(Some(Box::new(Rate { bottleneck, overhead_bytes, cross })))
}

impl Rule for Rate {
    fn judge(&mut self, packet: &Packet, at_ns: u64) -> Verdict {
        if let Some(cross) = &mut self.cross {
            cross.skip_silence(at_ns);
            while let Some(arrival_ns) = cross.next_before(at_ns) {
                self.bottleneck.offer(arrival_ns, cross.packet_bytes());
            }
        }
        self.bottleneck.offer(at_ns, packet.size as u64 + self.overhead_bytes)
    }
}

/// Reject queue settings without a bottleneck.
fn refuse_strays(settings: &LinkSettings) -> Result<(), LinkSettingsError> {
    let given = [
        ("queue_packets", settings.queue_packets.is_some()),
        ("queue_bytes", settings.queue_bytes.is_some()),
        ("queue_ms", settings.queue_ms.is_some()),
        ("discipline", settings.discipline != Discipline::TailDrop),
        ("cross_traffic", settings.cross_traffic.is_some()),
    ];
    match given.into_iter().find(|(_, is_given)| *is_given) {
        None => Ok(()),
        Some((key, _)) => Err(LinkSettingsError::contradiction(
            key,
            "given without a bottleneck; set rate_bps or opportunities too, or leave it out",
        )),
    }
}

fn bounds(settings: &LinkSettings) -> Result<Bounds, LinkSettingsError> {
    let mut bounds = Bounds { packets: MAX_QUEUE_PACKETS, bytes: u64::MAX, wait_ns: u64::MAX };
    if let Some(packets) = settings.queue_packets {
        check_size("queue_packets", packets, 1, MAX_QUEUE_PACKETS)?;
        bounds.packets = packets;
    }
    if let Some(bytes) = settings.queue_bytes {
        check_size("queue_bytes", bytes, 1, MAX_QUEUE_BYTES)?;
        bounds.bytes = bytes as u64;
    }
    if let Some(queue_ms) = settings.queue_ms {
        within("queue_ms", queue_ms, 0.0, MAX_QUEUE_MS)?;
        bounds.wait_ns = nanoseconds(queue_ms / 1000.0);
    }
    let unbounded =
        settings.queue_packets.is_none() && settings.queue_bytes.is_none() && settings.queue_ms.is_none();
    if unbounded {
        bounds.packets = DEFAULT_QUEUE_PACKETS;
    }
    Ok(bounds)
}

fn check_size(key: &str, seen: usize, minimum: usize, maximum: usize) -> Result<(), LinkSettingsError> {
    within(key, seen as f64, minimum as f64, maximum as f64)
}

/// Approximate time in which a full queue drains: the length of its memory.
fn drain_ns(bounds: Bounds, server: &Server, packet_bytes: usize) -> f64 {
    let by_packets = bounds.packets as f64 * packet_bytes.max(1500) as f64 * server.mean_ns_per_byte();
    let by_bytes = bounds.bytes as f64 * server.mean_ns_per_byte();
    by_packets.min(by_bytes).min(bounds.wait_ns as f64)
}
