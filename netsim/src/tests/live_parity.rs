//! Parity: the proxy applies to real datagrams the verdicts of the model in virtual time.

use std::collections::HashMap;
use std::net::{SocketAddr, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use super::live::{PATIENCE, Running, settings, socket};
use crate::damage::{Damage, Flips};
use crate::impairments::Impairment;
use crate::link::Rules;
use crate::random::Stream;
use crate::rule::{ArrivalRule, Extras};
use crate::{
    Action, Attack, Checksum, Direction, Edit, Extra, ExtraCause, Link, LinkSettings, MAX_DATAGRAM,
    Operation, Packet, ProxySettings, Target, Verdict,
};

type Bytes = Vec<u8>;

/// Receives everything until stopped, and optionally sends it back.
struct Sink {
    stop: Arc<AtomicBool>,
    thread: JoinHandle<Vec<(Bytes, SocketAddr)>>,
}

impl Sink {
    fn start(socket: UdpSocket, sends_back: bool) -> Self {
        socket.set_read_timeout(Some(Duration::from_millis(20))).unwrap();
        let stop = Arc::new(AtomicBool::new(false));
        let stopped = Arc::clone(&stop);
        let thread = thread::spawn(move || {
            let mut seen = Vec::new();
            let mut buffer = [0; MAX_DATAGRAM];
            while !stopped.load(Ordering::Relaxed) {
                if let Ok((length, source)) = socket.recv_from(&mut buffer) {
                    seen.push((buffer[..length].to_vec(), source));
                    if sends_back {
                        socket.send_to(&buffer[..length], source).unwrap();
                    }
                }
            }
            seen
        });
        Self { stop, thread }
    }

    fn stop(self) -> Vec<(Bytes, SocketAddr)> {
        self.stop.store(true, Ordering::Relaxed);
        self.thread.join().unwrap()
    }
}

/// Waits until the proxy is idle for a while.
fn wait_until_quiet(proxy: &Running) {
    let begun = Instant::now();
    let mut last = (proxy.monitor.snapshot(), Instant::now());
    while last.1.elapsed() < Duration::from_millis(200) && begun.elapsed() < PATIENCE {
        thread::sleep(Duration::from_millis(10));
        let now = proxy.monitor.snapshot();
        if now != last.0 {
            last = (now, Instant::now());
        }
    }
}

/// All rules that apply to packets of these sizes together.
fn rich() -> LinkSettings {
    LinkSettings {
        loss: 0.05,
        mean_burst: Some(3.0),
        rate_bps: Some(4e6),
        queue_packets: Some(50),
        delay_s: 0.02,
        jitter_s: 0.003,
        jitter_correlation_s: Some(0.02),
        reorder: 0.03,
        duplicate: 0.05,
        duplicate_gap_s: 0.002,
        corrupt: 0.05,
        corrupt_bits: 3,
        truncate: 0.05,
        truncate_bytes: 5,
        attacks: vec![altering(5, false), altering(7, true), attack(11, Action::HoldBack { by_s: 0.004 })],
        ..LinkSettings::default()
    }
}

fn attack(every: u64, action: Action) -> Attack {
    Attack { action, target: Target { every, ..Target::default() } }
}

/// Attack that changes the number at byte 2 and repairs the checksum.
fn altering(every: u64, inject: bool) -> Attack {
    let edits = vec![Edit::U64 { offset: 2, operation: Operation::Multiply, value: 3 }];
    attack(every, Action::Alter { edits, checksum: Some(Checksum::Crc32), inject })
}

fn payload(number: usize) -> Bytes {
    let mut bytes = number.to_be_bytes().to_vec();
    bytes.resize(8 + number * 7 % 200, 0x5A);
    bytes
}

/// Log lines of one direction: (index, kind) to the remaining cells.
fn log_of<'a>(log: &'a str, direction: &str) -> HashMap<(u64, &'a str), Vec<&'a str>> {
    let cells = log.lines().skip(1).map(|line| line.split(',').collect::<Vec<_>>());
    let own = cells.filter(|cells| cells[0] == direction);
    own.map(|cells| ((cells[1].parse().unwrap(), cells[2]), cells[3..].to_vec())).collect()
}

/// Judge the packets again, check the log, and return the expected arrivals in order.
fn expected(
    direction: Direction,
    seed: u64,
    packets: &[(Packet, Verdict)],
    sent: &[Bytes],
    log: &str,
) -> Vec<Bytes> {
    let mut link = Link::new(direction, seed, &rich()).unwrap();
    let mut log = log_of(log, &direction.to_string());
    let mut arriving: Vec<(u64, Bytes)> = Vec::new();
    for (packet, verdict) in packets.iter().filter(|(packet, _)| packet.direction == direction) {
        let bytes = &sent[usize::try_from(packet.index).unwrap()];
        assert_eq!(packet.size, bytes.len());
        let judgement = link.judge(packet);
        assert_eq!(judgement.verdict, *verdict);
        let mut arrive = |at_ns, damage: &Damage, kind| {
            let mut bytes = bytes.clone();
            let length = damage.apply(&mut bytes);
            bytes.truncate(length);
            arriving.push((at_ns, bytes));
            let line = log.remove(&(packet.index, kind)).unwrap();
            let number = |cell: usize| line[cell].parse::<u64>().unwrap();
            assert_eq!((number(0), number(1), number(5)), (packet.sent_ns, at_ns, packet.size as u64));
            assert_eq!((number(2) - at_ns, line[3]), (number(4), ""), "out, never early");
        };
        if let Verdict::Deliver { at_ns } = judgement.verdict {
            arrive(at_ns, judgement.damage, "");
        }
        for extra in judgement.extras {
            arrive(extra.at_ns, &extra.damage, extra.cause.name());
        }
        if let Verdict::Drop { cause } = judgement.verdict {
            let line = log.remove(&(packet.index, "")).unwrap();
            let (sent_ns, size) = (packet.sent_ns.to_string(), packet.size.to_string());
            assert_eq!(line, [&sent_ns, "", "", cause.name(), "", &size]);
        }
    }
    assert!(log.is_empty(), "{log:?}");
    arriving.sort_by_key(|(at_ns, _)| *at_ns);
    arriving.into_iter().map(|(_, bytes)| bytes).collect()
}

#[test]
fn live_driver_matches_the_virtual_driver() {
    const COUNT: usize = 1500;
    let path = std::env::temp_dir().join(format!("haptether-parity-{}.csv", std::process::id()));
    let (peer, client) = (socket(), socket());
    let settings = ProxySettings { log: Some(path.clone()), ..settings(peer.local_addr().unwrap(), rich()) };
    let proxy = Running::start(&settings);
    client.connect(proxy.address).unwrap();
    let there = Sink::start(peer, true);
    let back = Sink::start(client.try_clone().unwrap(), false);
    let sent: Vec<Bytes> = (0..COUNT).map(payload).collect();
    for bytes in &sent {
        client.send(bytes).unwrap();
        thread::sleep(Duration::from_micros(200));
    }
    wait_until_quiet(&proxy);
    let bytes_of = |seen: Vec<(Bytes, SocketAddr)>| seen.into_iter().map(|(bytes, _)| bytes).collect();
    let [there, back]: [Vec<Bytes>; 2] = [there, back].map(|sink| bytes_of(sink.stop()));
    let (statistics, judged) = proxy.stop();
    let log = std::fs::read_to_string(&path).unwrap();
    std::fs::remove_file(&path).unwrap();

    assert_eq!((statistics.early, statistics.log_lost), (0, 0));
    assert_eq!(expected(Direction::Forward, settings.seed, &judged, &sent, &log), there);
    assert_eq!(expected(Direction::Backward, settings.seed, &judged, &there, &log), back);
    let counted = statistics.forward;
    assert_eq!(counted.received, COUNT as u64);
    assert!(counted.lost > 0 && counted.lost + counted.released == counted.received);
    assert_eq!(counted.extras, counted.extras_released);
}

/// For every packet: a damaged copy, a mirrored one, one from another source, and one 30 ms later.
#[derive(Clone, Debug)]
struct Copies;

impl ArrivalRule for Copies {
    fn end(&mut self, packet: &Packet, at_ns: u64, damage: &mut Damage, extras: &mut Extras) -> Verdict {
        let stream = Stream::new(1, packet.direction, Impairment::Attack as u16);
        let corrupted = Flips { bits: 1, stream, ..Flips::NONE };
        let flipped = Damage { corrupted, index: packet.index, ..Damage::NONE };
        *damage = Damage { keep: 3, ..Damage::NONE };
        for (later_ns, cause, damage) in [
            (0, ExtraCause::Duplicate, flipped),
            (0, ExtraCause::Mirror, Damage::NONE),
            (0, ExtraCause::SecondSource, Damage::NONE),
            (30_000_000, ExtraCause::Replay, Damage::NONE),
        ] {
            extras.push(Extra { at_ns: at_ns + later_ns, cause, damage });
        }
        Verdict::Deliver { at_ns }
    }
}

#[test]
fn additional_packets_take_their_routes() {
    let (peer, client) = (socket(), socket());
    let perfect = LinkSettings::default();
    let proxy = Running::start(&settings(peer.local_addr().unwrap(), perfect.clone()));
    for direction in [Direction::Forward, Direction::Backward] {
        let rules = Rules::build(direction, 0, &perfect).unwrap().with_arrival_rule(Copies);
        proxy.control.change_rules(direction, rules);
    }
    thread::sleep(Duration::from_millis(30));
    // In either direction, the receiver gets four datagrams and the sender one.
    let exchange = |from: &UdpSocket, to: &UdpSocket, address: SocketAddr, text: &[u8]| {
        from.send_to(text, address).unwrap();
        let mut buffer = [0; 16];
        let mut get = |socket: &UdpSocket| {
            let (length, source) = socket.recv_from(&mut buffer).unwrap();
            (buffer[..length].to_vec(), source)
        };
        let [cut, flipped, beside, later] = [get(to), get(to), get(to), get(to)];
        assert_eq!(cut.0, &text[..3]);
        let bits: u32 = flipped.0.iter().zip(text).map(|(a, b)| (a ^ b).count_ones()).sum();
        assert_eq!((flipped.0.len(), bits), (text.len(), 1));
        assert_eq!((&beside.0[..], &later.0[..]), (text, text));
        assert_eq!((cut.1, cut.1), (flipped.1, later.1));
        assert_ne!(cut.1, beside.1);
        assert_eq!(get(from), (text.to_vec(), address), "the mirror");
        cut.1
    };
    let upstream = exchange(&client, &peer, proxy.address, b"forward");
    let listen = exchange(&peer, &client, upstream, b"backward");
    assert_eq!(listen, proxy.address);
    let (statistics, _) = proxy.stop();
    for direction in [statistics.forward, statistics.backward] {
        assert_eq!((direction.received, direction.released, direction.damaged), (1, 1, 1));
        assert_eq!((direction.extras, direction.extras_released, direction.extras_lost), (4, 4, 0));
    }
}
