//! The virtual-time runner: both sides and the network between them, without socket, sleep or clock.

use haptether_netsim::{Direction, InFlight, Link, LinkError, LinkSettings, Packet, Verdict};

use crate::{
    side::{Side, TickTime},
    wire::MAX_FRAME,
};

/// How a run in virtual time goes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct VirtualSettings {
    /// Period of both loops in ns.
    pub period_ns: u64,
    /// Number of ticks.
    pub ticks: u64,
    /// Network from master to slave.
    pub forward: LinkSettings,
    /// Network from slave to master.
    pub backward: LinkSettings,
    /// Seed of both.
    pub seed: u64,
}

type Datagram = ([u8; MAX_FRAME], usize);

struct Way {
    link: Link,
    in_flight: InFlight<Datagram>,
    index: u64,
    direction: Direction,
}

impl Way {
    fn new(direction: Direction, seed: u64, settings: &LinkSettings) -> Result<Self, LinkError> {
        Ok(Self {
            link: Link::new(direction, seed, settings)?,
            in_flight: InFlight::default(),
            index: 0,
            direction,
        })
    }

    fn deliver(&mut self, now_ns: u64, to: &mut impl Side) {
        while let Some((_, (bytes, length))) = self.in_flight.pop_due(now_ns) {
            // A refusal is counted by the endpoint.
            let _ = to.receive(now_ns, &bytes[..length]);
        }
    }

    fn take(&mut self, now_ns: u64, from: &mut impl Side) {
        let mut buffer = [0; MAX_FRAME];
        let length = from.send(now_ns, &mut buffer).len();
        let packet = Packet { direction: self.direction, sent_ns: now_ns, size: length, index: self.index };
        self.index += 1;
        if let Verdict::Deliver { at_ns } = self.link.judge(&packet) {
            // A full queue drops, as the network would; the link counts what it lost.
            let _ = self.in_flight.push(at_ns, (buffer, length));
        }
    }
}

/// Runs both sides for a number of ticks and gives each tick's records to `observe`.
///
/// At each tick: frames due are delivered, the master ticks and sends, the slave ticks and sends. A frame without
/// delay therefore reaches the slave in the same tick and the master in the next.
pub fn run_virtual<M: Side, S: Side>(
    settings: &VirtualSettings,
    master: &mut M,
    slave: &mut S,
    mut observe: impl FnMut(M::Record, S::Record),
) -> Result<(), LinkError> {
    let mut forward = Way::new(Direction::Forward, settings.seed, &settings.forward)?;
    let mut backward = Way::new(Direction::Backward, settings.seed, &settings.backward)?;
    master.begin(0);
    slave.begin(0);
    for tick in 0..settings.ticks {
        let now_ns = tick * settings.period_ns;
        backward.deliver(now_ns, master);
        let master_record = master.tick(TickTime { now_ns, ..TickTime::default() });
        forward.take(now_ns, master);
        forward.deliver(now_ns, slave);
        let slave_record = slave.tick(TickTime { now_ns, ..TickTime::default() });
        backward.take(now_ns, slave);
        observe(master_record, slave_record);
    }
    Ok(())
}
