//! Round trips over loopback, in turns: bare datagrams, frames in the clear, and frames in a secure session.
//!
//! Each exchange is a tick of both endpoints, with a thread and a socket for each side:
//! `tick, send, seal -> UDP -> open, receive, tick, send, seal -> UDP -> open, receive`. The bare exchange sends as
//! many bytes as the sealed one. Both sides wait in the kernel for datagrams. The pinging side runs on CPU `NEAR`, the
//! answering one on CPU `FAR`.
//!
//! `ping_pong TURNS PINGS NEAR FAR` prints, for each kind, the round trips of each turn in ns as one line of JSON.
#![allow(clippy::unwrap_used)] // a bench: any failure ends it

use std::{
    net::UdpSocket,
    thread,
    time::{Duration, Instant},
};

use haptether_bridge::{
    LadderSettings, LinkTime, MasterEndpoint, MasterReading, MasterSettings, SlaveEndpoint, SlaveReading,
    SlaveSettings,
    coupling::CommandBounds,
    session::{
        Incoming, MAX_DATAGRAM, PreSharedKey, Received, SeededEntropy, Session, SessionEnd, SessionSettings,
    },
    wire::{FrameLayout, MAX_FRAME, Role},
};
use haptether_safety::{
    Axes, DeviceModel, LimiterSettings,
    controller::{ControllerKind, SafetySettings},
    estimator::EstimatorKind,
};
use rustix::thread::{CpuSet, sched_setaffinity};

const PERIOD_NS: u64 = 1_000_000;
/// Pings at the start of a turn that do not count.
const WARM_UP: usize = 500;
const PATIENCE: Duration = Duration::from_secs(5);

/// Answer of one side to the bytes of the other.
trait Side: Send {
    /// Take the received datagram, if any, and return the datagram to send.
    fn exchange<'a>(
        &mut self,
        arrived: Option<&mut [u8]>,
        buffer: &'a mut [u8; MAX_DATAGRAM],
    ) -> Option<&'a [u8]>;
}

/// Side that sends as many bytes as a sealed frame, without any computation.
struct Bare;

impl Side for Bare {
    fn exchange<'a>(&mut self, _: Option<&mut [u8]>, buffer: &'a mut [u8; MAX_DATAGRAM]) -> Option<&'a [u8]> {
        Some(&buffer[..haptether_bridge::session::sealed_length(FrameLayout::of(1).length())])
    }
}

enum Endpoint {
    Master(Box<MasterEndpoint<1>>),
    Slave(Box<SlaveEndpoint<1>>),
}

impl Endpoint {
    fn receive(&mut self, now_ns: u64, payload: &[u8]) {
        match self {
            Self::Master(master) => master.exchange.receive(LinkTime::at(now_ns), payload).unwrap(),
            Self::Slave(slave) => slave.exchange.receive(LinkTime::at(now_ns), payload).unwrap(),
        }
    }

    fn tick(&mut self, now_ns: u64) {
        let still = Axes::<1>::zeros();
        match self {
            Self::Master(master) => {
                std::hint::black_box(master.tick(now_ns, 0, &MasterReading::point(still, None), true));
            }
            Self::Slave(slave) => {
                std::hint::black_box(slave.tick(now_ns, &SlaveReading::point([still; 3])));
            }
        }
    }

    fn send<'a>(&mut self, now_ns: u64, buffer: &'a mut [u8; MAX_FRAME]) -> &'a [u8] {
        match self {
            Self::Master(master) => master.exchange.send(LinkTime::at(now_ns), buffer),
            Self::Slave(slave) => slave.exchange.send(LinkTime::at(now_ns), buffer),
        }
    }
}

/// Endpoint behind its session. Its time counts periods, so that only work is measured, not waiting.
struct Bridged {
    session: Session,
    endpoint: Endpoint,
    now_ns: u64,
}

impl Side for Bridged {
    fn exchange<'a>(
        &mut self,
        arrived: Option<&mut [u8]>,
        buffer: &'a mut [u8; MAX_DATAGRAM],
    ) -> Option<&'a [u8]> {
        self.now_ns += PERIOD_NS;
        if let Some(datagram) = arrived {
            let Incoming::Payload { payload, .. } = self.session.open(self.now_ns, datagram).unwrap() else {
                return None;
            };
            self.endpoint.receive(self.now_ns, payload);
        }
        self.session.advance(self.now_ns);
        self.endpoint.tick(self.now_ns);
        let mut frame = [0; MAX_FRAME];
        let frame = self.endpoint.send(self.now_ns, &mut frame);
        Some(self.session.seal(self.now_ns, frame, buffer).unwrap())
    }
}

fn endpoints() -> [Endpoint; 2] {
    let ladder = LadderSettings::default();
    let master = MasterEndpoint::new(&MasterSettings {
        period_ns: PERIOD_NS,
        run_id: 1,
        device: DeviceModel::phantom_desktop(),
        estimator: EstimatorKind::default(),
        safety: SafetySettings { controllers: [ControllerKind::Wsc].into(), ..SafetySettings::default() },
        limiter: LimiterSettings::default(),
        force_scale: 1.0,
        ladder,
    });
    let slave = SlaveEndpoint::new(&SlaveSettings {
        period_ns: PERIOD_NS,
        run_id: 2,
        position_scale: 1.0,
        bounds: CommandBounds::default(),
        ladder,
    });
    [Endpoint::Master(Box::new(master.unwrap())), Endpoint::Slave(Box::new(slave.unwrap()))]
}

fn sessions(secure: bool) -> [Session; 2] {
    let settings = |role| SessionSettings::new(role, FrameLayout::of(1).length(), PERIOD_NS);
    let [mut master, mut slave] = [Role::Master, Role::Slave].map(|role| {
        let mut entropy = SeededEntropy::new(1, role);
        if secure {
            SessionEnd::secure(
                settings(role),
                PreSharedKey::new(b"the key that both ends share: 32").unwrap(),
                &mut entropy,
            )
            .unwrap()
        } else {
            SessionEnd::insecure(settings(role)).unwrap()
        }
    });
    if secure {
        let mut entropy = SeededEntropy::new(2, Role::Master);
        let mut hello = master.poll(0, &mut entropy).unwrap().unwrap();
        let Ok(Received::Reply(mut answer)) = slave.receive(0, &mut hello, &mut entropy) else {
            unreachable!("a slave without a master answers the first")
        };
        master.receive(0, &mut answer, &mut entropy).unwrap();
    }
    [master.session, slave.session]
}

fn bridged(secure: bool) -> [Box<dyn Side>; 2] {
    let ([near, far], [master, slave]) = (sessions(secure), endpoints());
    [(near, master), (far, slave)]
        .map(|(session, endpoint)| Box::new(Bridged { session, endpoint, now_ns: 0 }) as Box<dyn Side>)
}

/// Pin this thread to one CPU.
fn pin(cpu: usize) {
    let mut cpus = CpuSet::new();
    cpus.set(cpu);
    sched_setaffinity(None, &cpus).unwrap();
}

/// Return the round trips of one turn in ns.
fn turn([mut near, mut far]: [Box<dyn Side>; 2], pings: usize, answers_on: usize) -> Vec<u64> {
    let [here, there] = [(); 2].map(|()| UdpSocket::bind("127.0.0.1:0").unwrap());
    here.connect(there.local_addr().unwrap()).unwrap();
    there.connect(here.local_addr().unwrap()).unwrap();
    for socket in [&here, &there] {
        socket.set_read_timeout(Some(PATIENCE)).unwrap();
    }
    let answering = thread::spawn(move || {
        pin(answers_on);
        let (mut arrived, mut buffer) = ([0; MAX_DATAGRAM + 1], [0; MAX_DATAGRAM]);
        for _ in 0..pings + WARM_UP {
            let length = there.recv(&mut arrived).unwrap();
            there.send(far.exchange(Some(&mut arrived[..length]), &mut buffer).unwrap()).unwrap();
        }
    });
    let (mut arrived, mut buffer) = ([0; MAX_DATAGRAM + 1], [0; MAX_DATAGRAM]);
    let mut length = 0;
    let mut taken_ns = Vec::with_capacity(pings + WARM_UP);
    for ping in 0..pings + WARM_UP {
        // From the newest frame of the peer to the next one, as a person experiences it.
        let begun = Instant::now();
        let answer = (ping > 0).then_some(&mut arrived[..length]);
        here.send(near.exchange(answer, &mut buffer).unwrap()).unwrap();
        length = here.recv(&mut arrived).unwrap();
        taken_ns.push(u64::try_from(begun.elapsed().as_nanos()).unwrap());
    }
    answering.join().unwrap();
    taken_ns.split_off(WARM_UP)
}

fn main() {
    let mut arguments = std::env::args().skip(1).map(|text| text.parse::<usize>().unwrap());
    let (turns, pings) = (arguments.next().unwrap_or(4), arguments.next().unwrap_or(5000));
    let (near, far) = (arguments.next().unwrap_or(0), arguments.next().unwrap_or(1));
    pin(near);
    let mut all: [Vec<Vec<u64>>; 3] = Default::default();
    for number in 0..turns {
        // The order changes in each turn, so that a rising or falling load favours no kind.
        for place in 0..3 {
            let kind = (place + number) % 3;
            let sides: [Box<dyn Side>; 2] = match kind {
                0 => [Box::new(Bare), Box::new(Bare)],
                1 => bridged(false),
                _ => bridged(true),
            };
            all[kind].push(turn(sides, pings, far));
        }
    }
    let text = |turns: &[Vec<u64>]| {
        let turns: Vec<_> = turns.iter().map(|taken| format!("{taken:?}")).collect();
        turns.join(", ")
    };
    let [bare, insecure, secure] = all.map(|turns| text(&turns));
    println!("{{\"bare\": [{bare}], \"insecure\": [{insecure}], \"secure\": [{secure}]}}");
}
