//! The virtual-time runner: both sides and the network between them, without socket, sleep or clock.

use std::ops::ControlFlow;

use haptether_netsim::{Direction, InFlight, Link, LinkError, LinkSettings, Packet, Verdict};

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

type Datagram = ([u8; MAX_FRAME], usize);

struct Way {
    link: Link,
    in_flight: InFlight<Datagram>,
    index: u64,
    direction: Direction,
}

impl Way {
    /// For a sender that sends `ticks` packets, one each `period_ns`.
    fn new(
        direction: Direction,
        seed: u64,
        settings: &LinkSettings,
        ticks: u64,
        period_ns: u64,
    ) -> Result<Self, LinkError> {
        let link = Link::new(direction, seed, settings)?;
        // All that can be under way at once: a long delay at a high rate is no full queue.
        let longest = (settings.delay_s + settings.jitter_s) * 1e9 / period_ns as f64;
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // not below 0, and saturates
        let most = (longest.ceil() as u64).min(ticks).saturating_add(2);
        Ok(Self {
            link,
            in_flight: InFlight::growing(usize::try_from(most).unwrap_or(usize::MAX)),
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
        if let Verdict::Deliver { at_ns } = self.link.judge(&packet).verdict {
            // A full queue drops, as the network would; the link counts what it lost.
            let _ = self.in_flight.push(at_ns, (buffer, length));
        }
    }
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
/// Both loops begin at time 0.
pub fn run_virtual<M: Side, S: Side>(
    settings: &VirtualSettings,
    master: &mut M,
    slave: &mut S,
    mut observe: impl FnMut(Event<M::Record, S::Record>, &S) -> ControlFlow<()>,
) -> Result<(), LinkError> {
    let end_ns = settings.ticks * settings.period_ns;
    let way = |direction, link, period_ns: u64| {
        Way::new(direction, settings.seed, link, end_ns.div_ceil(period_ns), period_ns)
    };
    let mut forward = way(Direction::Forward, &settings.forward, settings.period_ns)?;
    let mut backward = way(Direction::Backward, &settings.backward, settings.slave_period_ns)?;
    master.begin(0);
    slave.begin(0);
    let (mut master_ns, mut slave_ns) = (0, 0);
    while master_ns < end_ns || slave_ns < end_ns {
        let event = if master_ns <= slave_ns {
            backward.deliver(master_ns, master);
            let record = master.tick(TickTime { now_ns: master_ns, ..TickTime::default() });
            forward.take(master_ns, master);
            master_ns += settings.period_ns;
            Event::Master(record)
        } else {
            forward.deliver(slave_ns, slave);
            let record = slave.tick(TickTime { now_ns: slave_ns, ..TickTime::default() });
            backward.take(slave_ns, slave);
            slave_ns += settings.slave_period_ns;
            Event::Slave(record)
        };
        if observe(event, slave).is_break() {
            break;
        }
    }
    Ok(())
}
