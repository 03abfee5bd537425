//! The virtual-time runner: both sides and the network between them, without socket, sleep or clock.

use std::ops::ControlFlow;

use haptether_netsim::{
    Damage, Direction, ExtraCause, InFlight, Judgement, Link, LinkError, LinkSettings, Packet, Verdict,
};

use crate::{
    side::{Side, TickTime},
    wire::MAX_FRAME,
};

/// How a run in virtual time goes.
#[derive(Clone, Debug, PartialEq)]
pub struct VirtualSettings {
    /// Period of the master's loop in ns.
    pub period_ns: u64,
    /// Period of the slave's loop in ns.
    pub slave_period_ns: u64,
    /// Number of the master's ticks.
    pub ticks: u64,
    /// Network from master to slave.
    pub forward: LinkSettings,
    /// Network from slave to master.
    pub backward: LinkSettings,
    /// Seed of both.
    pub seed: u64,
}

/// Most datagrams under way in one direction: more than an hour at 1 kHz. They take memory only as they come.
const MOST_IN_FLIGHT: usize = 1 << 22;

type Datagram = ([u8; MAX_FRAME], usize);

struct Way {
    link: Link,
    in_flight: InFlight<Datagram>,
    index: u64,
    direction: Direction,
}

impl Way {
    fn new(direction: Direction, seed: u64, settings: &LinkSettings) -> Result<Self, LinkError> {
        let link = Link::new(direction, seed, settings)?;
        Ok(Self { link, in_flight: InFlight::growing(MOST_IN_FLIGHT), index: 0, direction })
    }

    fn deliver(&mut self, now_ns: u64, to: &mut impl Side) {
        while let Some((_, (bytes, length))) = self.in_flight.pop_due(now_ns) {
            // A refusal is counted by the endpoint.
            let _ = to.receive(now_ns, &bytes[..length]);
        }
    }

    /// Takes what `from` sends; `back` is the way that leads to it.
    fn take(&mut self, now_ns: u64, from: &mut impl Side, back: &mut Self) {
        let mut buffer = [0; MAX_FRAME];
        let length = from.send(now_ns, &mut buffer).len();
        let packet = Packet { direction: self.direction, sent_ns: now_ns, size: length, index: self.index };
        self.index += 1;
        let Judgement { verdict, damage, extras } = self.link.judge(&packet);
        // A full queue drops, as the network would, and counts it.
        if let Verdict::Deliver { at_ns } = verdict {
            let arrived = if damage.is_none() { (buffer, length) } else { damaged(&buffer, length, &damage) };
            let _ = self.in_flight.push(at_ns, arrived);
        }
        for extra in extras {
            let to =
                if extra.cause == ExtraCause::Mirror { &mut back.in_flight } else { &mut self.in_flight };
            let _ = to.push(extra.at_ns, damaged(&buffer, length, &extra.damage));
        }
    }
}

fn damaged(sent: &[u8; MAX_FRAME], length: usize, damage: &Damage) -> Datagram {
    let mut buffer = *sent;
    let length = damage.apply(&mut buffer[..length]);
    (buffer, length)
}

/// What happened next.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Event<M, S> {
    /// The master ticked.
    Master(M),
    /// The slave ticked.
    Slave(S),
}

/// Runs both sides, each at its own rate, and gives each tick's record and the slave to `observe`, until that breaks
/// off or the master has done its ticks.
///
/// The next of the two loops to tick takes the frames that are due by then, ticks and sends; at the same instant the
/// master is first. A frame without delay therefore reaches the slave in the same tick and the master in the next.
/// Both loops begin at time 0. Gives how many datagrams were dropped because too many were under way.
pub fn run_virtual<M: Side, S: Side>(
    settings: &VirtualSettings,
    master: &mut M,
    slave: &mut S,
    mut observe: impl FnMut(Event<M::Record, S::Record>, &S) -> ControlFlow<()>,
) -> Result<u64, LinkError> {
    let end_ns = settings.ticks * settings.period_ns;
    let mut forward = Way::new(Direction::Forward, settings.seed, &settings.forward)?;
    let mut backward = Way::new(Direction::Backward, settings.seed, &settings.backward)?;
    master.begin(0);
    slave.begin(0);
    let (mut master_ns, mut slave_ns) = (0, 0);
    while master_ns < end_ns || slave_ns < end_ns {
        let event = if master_ns <= slave_ns {
            backward.deliver(master_ns, master);
            let record = master.tick(TickTime { now_ns: master_ns, ..TickTime::default() });
            forward.take(master_ns, master, &mut backward);
            master_ns += settings.period_ns;
            Event::Master(record)
        } else {
            forward.deliver(slave_ns, slave);
            let record = slave.tick(TickTime { now_ns: slave_ns, ..TickTime::default() });
            backward.take(slave_ns, slave, &mut forward);
            slave_ns += settings.slave_period_ns;
            Event::Slave(record)
        };
        if observe(event, slave).is_break() {
            break;
        }
    }
    Ok(forward.in_flight.overflowed() + backward.in_flight.overflowed())
}
