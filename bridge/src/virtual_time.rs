//! The virtual-time runner: both sides and the network between them, without socket, sleep or clock.

use std::ops::ControlFlow;

use haptether_netsim::{
    Damage, Direction, EndpointClock, ExtraCause, InFlight, Judgement, Link, LinkError, LinkSettings, Packet,
    Verdict,
};

use crate::{
    pace::Pace,
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
    /// Number of the master's ticks: of its periods in the true time of the run, if its clock is not right.
    pub ticks: u64,
    /// Network from master to slave.
    pub forward: LinkSettings,
    /// Network from slave to master.
    pub backward: LinkSettings,
    /// Seed of both.
    pub seed: u64,
    /// What the master's clock shows; without one, true time.
    pub master_clock: Option<EndpointClock>,
    /// What the slave's clock shows.
    pub slave_clock: Option<EndpointClock>,
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

    /// Hands over what is due by `now_ns`, when the receiver's clock shows `clock_ns`.
    fn deliver(&mut self, now_ns: u64, clock_ns: u64, to: &mut impl Side) {
        while let Some((_, (bytes, length))) = self.in_flight.pop_due(now_ns) {
            // A refusal is counted by the endpoint.
            let _ = to.receive(clock_ns, &bytes[..length]);
        }
    }

    /// Takes what `from` sends, whose clock shows `clock_ns`; `back` is the way that leads to it.
    fn take(&mut self, now_ns: u64, clock_ns: u64, from: &mut impl Side, back: &mut Self) {
        let mut buffer = [0; MAX_FRAME];
        let length = from.send(clock_ns, &mut buffer).len();
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

/// The tick of a side that is due: it takes what `inward` delivers and sends `outward`.
fn turn<S: Side>(pace: &mut Pace, side: &mut S, inward: &mut Way, outward: &mut Way) -> S::Record {
    let (now_ns, wake) = (pace.true_ns, pace.wake());
    let clock_ns = wake.deadline_ns;
    if wake.is_stalled() {
        while inward.in_flight.pop_due(now_ns).is_some() {}
        side.stalled(clock_ns);
    }
    inward.deliver(now_ns, clock_ns, side);
    let record = side.tick(TickTime {
        now_ns,
        clock_ns,
        overshoot_ns: wake.overshoot_ns,
        missed: wake.missed,
        ..TickTime::default()
    });
    outward.take(now_ns, clock_ns, side, inward);
    pace.wait_after(&wake);
    record
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
/// Both loops begin at time 0. Plants and network live in true time, each endpoint by its own clock: its loop waits
/// on that, so that a drift stretches the true period, and where it is set forward the loop finds itself late, as a
/// live one does that was suspended. Gives how many datagrams were dropped because too many were under way.
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
    let mut near = Pace::new(settings.master_clock, settings.period_ns);
    let mut far = Pace::new(settings.slave_clock, settings.slave_period_ns);
    while near.true_ns < end_ns || far.true_ns < end_ns {
        let event = if near.true_ns <= far.true_ns {
            Event::Master(turn(&mut near, master, &mut backward, &mut forward))
        } else {
            Event::Slave(turn(&mut far, slave, &mut forward, &mut backward))
        };
        if observe(event, slave).is_break() {
            break;
        }
    }
    Ok(forward.in_flight.overflowed() + backward.in_flight.overflowed())
}
