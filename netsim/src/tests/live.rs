//! Live driver on the loopback interface, with real threads.

use std::collections::HashSet;
use std::net::{IpAddr, Ipv4Addr, SocketAddr, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use super::{delay, rough};
use crate::{
    Direction, DropCause, LinkSettings, MAX_DATAGRAM, MAX_FLOWS, Packet, Proxy, ProxyControl, ProxyError,
    ProxyMonitor, ProxySettings, ProxyStatistics, Source, Verdict,
};

pub(super) const PATIENCE: Duration = Duration::from_secs(5);
pub(super) const LOOPBACK: SocketAddr = SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 0);

pub(super) fn socket() -> UdpSocket {
    let socket = UdpSocket::bind(LOOPBACK).unwrap();
    socket.set_read_timeout(Some(PATIENCE)).unwrap();
    socket
}

pub(super) fn settings(forward: SocketAddr, link: LinkSettings) -> ProxySettings {
    let seed = 11;
    ProxySettings {
        forward_link: link.clone(),
        backward_link: link,
        seed,
        ..ProxySettings::new(LOOPBACK, forward)
    }
}

/// Proxy on its own thread; stopping it returns its statistics and all verdicts.
pub(super) struct Running {
    pub(super) address: SocketAddr,
    pub(super) monitor: ProxyMonitor,
    pub(super) control: ProxyControl,
    stop: Arc<AtomicBool>,
    thread: JoinHandle<(ProxyStatistics, Vec<(Packet, Verdict)>)>,
}

impl Running {
    pub(super) fn start(settings: &ProxySettings) -> Self {
        let mut proxy = Proxy::bind(settings).unwrap();
        let stop = Arc::new(AtomicBool::new(false));
        let (address, monitor, control) = (proxy.listen_address(), proxy.monitor(), proxy.control());
        let stop_seen = Arc::clone(&stop);
        let thread = thread::spawn(move || {
            let mut log = Vec::new();
            let statistics =
                proxy.run_observed(&stop_seen, |packet, judged| log.push((*packet, judged.verdict))).unwrap();
            (statistics, log)
        });
        Self { address, monitor, control, stop, thread }
    }

    pub(super) fn stop(self) -> (ProxyStatistics, Vec<(Packet, Verdict)>) {
        self.stop.store(true, Ordering::Relaxed);
        self.thread.join().unwrap()
    }
}

/// Peer that returns `count` datagrams to their sources.
fn echo(count: usize) -> (SocketAddr, JoinHandle<()>) {
    let peer = socket();
    let address = peer.local_addr().unwrap();
    let thread = thread::spawn(move || {
        let mut buffer = [0; MAX_DATAGRAM];
        for _ in 0..count {
            let (length, source) = peer.recv_from(&mut buffer).unwrap();
            peer.send_to(&buffer[..length], source).unwrap();
        }
    });
    (address, thread)
}

fn receive_number(socket: &UdpSocket) -> u64 {
    let mut number = [0; 8];
    assert_eq!(socket.recv(&mut number).unwrap(), 8);
    u64::from_be_bytes(number)
}

/// Send `count` numbered datagrams, one per `period`; return the sorted round-trip times.
fn round_trips(proxy: SocketAddr, count: usize, period: Duration) -> Vec<Duration> {
    let client = socket();
    client.connect(proxy).unwrap();
    let sender = client.try_clone().unwrap();
    let sending = thread::spawn(move || {
        (0..count)
            .map(|number| {
                let sent = Instant::now();
                sender.send(&(number as u64).to_be_bytes()).unwrap();
                thread::sleep(period);
                sent
            })
            .collect::<Vec<_>>()
    });
    let arrivals: Vec<(u64, Instant)> =
        (0..count).map(|_| (receive_number(&client), Instant::now())).collect();
    let sent = sending.join().unwrap();
    let mut times: Vec<_> = arrivals
        .into_iter()
        .map(|(number, arrived)| arrived - sent[usize::try_from(number).unwrap()])
        .collect();
    times.sort();
    times
}

#[test]
fn a_round_trip_takes_both_delays_and_never_less() {
    let (peer, echoing) = echo(200);
    let link = LinkSettings { delay_s: 0.02, ..LinkSettings::default() };
    let proxy = Running::start(&settings(peer, link));
    let times = round_trips(proxy.address, 200, Duration::from_millis(1));
    echoing.join().unwrap();
    let (statistics, _) = proxy.stop();

    // No datagram is early, and loopback takes microseconds: the delay stems from the rule.
    assert!(times[0] >= Duration::from_millis(40), "{:?}", times[0]);
    assert!(times[100] < Duration::from_millis(90), "{:?}", times[100]);
    for direction in [statistics.forward, statistics.backward] {
        assert_eq!(direction.received, 200);
        assert_eq!(direction.released, 200);
        assert_eq!(direction.in_flight(), 0);
        assert_eq!(direction.overtaking, 0);
    }
    assert_eq!(statistics.scheduling_error.count, 400);
}

#[test]
fn each_client_gets_its_own_answers() {
    let peer = socket();
    let proxy = Running::start(&settings(peer.local_addr().unwrap(), LinkSettings::default()));
    let clients = [socket(), socket(), socket()];
    let mut buffer = [0; 16];
    let mut upstreams = Vec::new();
    for (client, name) in clients.iter().zip([b"a", b"b", b"c"]) {
        client.send_to(name, proxy.address).unwrap();
        let (length, upstream) = peer.recv_from(&mut buffer).unwrap();
        assert_eq!(&buffer[..length], name);
        upstreams.push(upstream);
    }
    for (upstream, answer) in upstreams.iter().zip([b"A", b"B", b"C"]).rev() {
        peer.send_to(answer, upstream).unwrap();
    }
    for (client, answer) in clients.iter().zip([b"A", b"B", b"C"]) {
        let (length, source) = client.recv_from(&mut buffer).unwrap();
        assert_eq!((&buffer[..length], source), (&answer[..], proxy.address));
    }
    // Only the peer reaches a client.
    let upstream = SocketAddr::new(LOOPBACK.ip(), upstreams[0].port());
    clients[1].send_to(b"forged", upstream).unwrap();
    peer.send_to(b"answer", upstream).unwrap();
    let length = clients[0].recv(&mut buffer).unwrap();
    assert_eq!(&buffer[..length], b"answer");
    let (statistics, log) = proxy.stop();
    assert_eq!((statistics.flows, statistics.forward.refused), (3, 0));
    assert_eq!((statistics.forward.received, statistics.backward.received), (3, 4));
    // The clients share the link and its index.
    let indices = log.iter().filter(|(packet, _)| packet.direction == Direction::Forward);
    assert!(indices.map(|(packet, _)| packet.index).eq(0..3));
}

#[test]
fn no_more_clients_are_served_than_there_is_room_for() {
    let peer = socket();
    let proxy = Running::start(&settings(peer.local_addr().unwrap(), LinkSettings::default()));
    let clients: Vec<_> = (0..=MAX_FLOWS).map(|_| socket()).collect();
    for client in &clients {
        client.send_to(b"hello", proxy.address).unwrap();
    }
    let mut buffer = [0; 16];
    let sources: HashSet<_> = (0..MAX_FLOWS).map(|_| peer.recv_from(&mut buffer).unwrap().1).collect();
    assert_eq!(sources.len(), MAX_FLOWS);
    let (statistics, _) = proxy.stop();
    assert_eq!((statistics.flows, statistics.forward.refused), (MAX_FLOWS as u64, 1));
}

#[test]
fn a_source_from_elsewhere_is_served_only_if_allowed() {
    // A non-loopback address of this machine, if it has one.
    let probe = UdpSocket::bind("0.0.0.0:0").unwrap();
    if probe.connect("192.0.2.1:9").is_err() {
        return;
    }
    let outside = probe.local_addr().unwrap().ip();
    if outside.is_loopback() {
        return;
    }
    let peer = socket();
    let client = UdpSocket::bind((outside, 0)).unwrap();
    let base = settings(peer.local_addr().unwrap(), LinkSettings::default());
    let listen = SocketAddr::new(outside, 0);
    let exact: Source = client.local_addr().unwrap().to_string().parse().unwrap();
    let machine: Source = outside.to_string().parse().unwrap();
    for (allow, served) in [(vec![], 0), (vec![machine], 1), (vec![exact], 1)] {
        let proxy = Running::start(&ProxySettings { listen, allow, ..base.clone() });
        client.send_to(b"hello", proxy.address).unwrap();
        let patience = Instant::now();
        let seen = || proxy.monitor.snapshot().forward;
        while seen().received + seen().refused == 0 && patience.elapsed() < PATIENCE {
            thread::yield_now();
        }
        let (statistics, _) = proxy.stop();
        assert_eq!((statistics.forward.received, statistics.forward.refused), (served, 1 - served));
    }
}

#[test]
fn a_change_holds_for_datagrams_from_then_on_and_keeps_the_order() {
    let peer = socket();
    let slow = LinkSettings { delay_s: 0.1, ..LinkSettings::default() };
    let proxy = Running::start(&settings(peer.local_addr().unwrap(), slow));
    let client = socket();
    client.connect(proxy.address).unwrap();
    let change = |settings: LinkSettings| proxy.control.change(Direction::Forward, &settings);
    client.send(&0_u64.to_be_bytes()).unwrap();
    // Adopted before the packet sent 40 ms later.
    thread::sleep(Duration::from_millis(20));
    assert!(change(LinkSettings { delay_s: f64::NAN, ..LinkSettings::default() }).is_err());
    change(LinkSettings { delay_s: 0.01, ..LinkSettings::default() }).unwrap();
    thread::sleep(Duration::from_millis(40));
    client.send(&1_u64.to_be_bytes()).unwrap();
    assert_eq!([receive_number(&peer), receive_number(&peer)], [0, 1]);
    change(LinkSettings { loss: 1.0, ..LinkSettings::default() }).unwrap();
    thread::sleep(Duration::from_millis(40));
    client.send(&2_u64.to_be_bytes()).unwrap();
    let patience = Instant::now();
    while proxy.monitor.snapshot().forward.lost == 0 && patience.elapsed() < PATIENCE {
        thread::yield_now();
    }
    let (statistics, log) = proxy.stop();
    assert_eq!(statistics.forward.dropped(DropCause::Loss), 1);
    let due =
        |number: usize| delay(&log[number].0, log[number].1).map(|delay_ns| log[number].0.sent_ns + delay_ns);
    assert_eq!(due(0), due(1), "the second waits for the first");
    assert_eq!((delay(&log[0].0, log[0].1), due(2)), (Some(100_000_000), None));
}

#[test]
fn a_peer_that_is_not_up_is_waited_for() {
    let address = socket().local_addr().unwrap();
    let proxy = Running::start(&settings(address, LinkSettings::default()));
    let client = socket();
    for _ in 0..20 {
        client.send_to(b"early", proxy.address).unwrap();
        thread::sleep(Duration::from_millis(1));
    }
    let peer = UdpSocket::bind(address).unwrap();
    peer.set_read_timeout(Some(PATIENCE)).unwrap();
    let mut buffer = [0; 16];
    for _ in 0..20 {
        client.send_to(b"late", proxy.address).unwrap();
        let length = peer.recv(&mut buffer).unwrap();
        assert_eq!(&buffer[..length], b"late");
    }
    let (statistics, _) = proxy.stop();
    assert!(statistics.peer_unreachable > 0);
    assert_eq!(statistics.forward.received, 40);
}

#[test]
fn the_largest_datagram_passes_and_a_larger_one_is_counted() {
    let peer = socket();
    let proxy = Running::start(&settings(peer.local_addr().unwrap(), LinkSettings::default()));
    let client = socket();
    client.send_to(&[1; MAX_DATAGRAM + 1], proxy.address).unwrap();
    client.send_to(&[2; 9000], proxy.address).unwrap();
    client.send_to(&[3; MAX_DATAGRAM], proxy.address).unwrap();
    let mut buffer = [0; 2 * MAX_DATAGRAM];
    let length = peer.recv(&mut buffer).unwrap();
    assert_eq!(buffer[..length], [3; MAX_DATAGRAM]);
    let (statistics, _) = proxy.stop();
    assert_eq!(statistics.forward.oversize, 2);
    assert_eq!(statistics.forward.received, 1);
}

#[test]
fn an_idle_proxy_stops_soon() {
    let peer = socket();
    let proxy = Running::start(&settings(peer.local_addr().unwrap(), rough()));
    thread::sleep(Duration::from_millis(5));
    let asked = Instant::now();
    proxy.stop();
    assert!(asked.elapsed() < Duration::from_millis(500), "{:?}", asked.elapsed());
}

#[test]
fn statistics_are_read_while_the_proxy_runs() {
    let peer = socket();
    let mut proxy = Proxy::bind(&settings(peer.local_addr().unwrap(), LinkSettings::default())).unwrap();
    let (monitor, address) = (proxy.monitor(), proxy.listen_address());
    let stop = AtomicBool::new(false);
    thread::scope(|scope| {
        let running = scope.spawn(|| proxy.run(&stop).unwrap());
        socket().send_to(b"one", address).unwrap();
        let asked = Instant::now();
        while monitor.snapshot().forward.released == 0 && asked.elapsed() < PATIENCE {
            thread::yield_now();
        }
        let seen = monitor.snapshot();
        stop.store(true, Ordering::Relaxed);
        assert_eq!(seen.forward.released, 1);
        assert_eq!(running.join().unwrap().forward, seen.forward);
    });
}

#[test]
fn invalid_proxy_settings_are_explained() {
    let peer = socket();
    let forward = peer.local_addr().unwrap();
    let bad_link = LinkSettings { loss: 2.0, ..LinkSettings::default() };
    let perfect = settings(forward, LinkSettings::default());
    let message = |settings| Proxy::bind(&settings).unwrap_err().to_string();
    assert_eq!(
        message(ProxySettings { backward_link: bad_link, ..perfect.clone() }),
        "link.backward: loss = 2: must be a finite number from 0 to 1"
    );
    assert_eq!(
        message(ProxySettings { max_error_s: f64::NAN, ..perfect.clone() }),
        "max_error_s = NaN: must be a finite number above 0, at most 1"
    );
    let nowhere = message(ProxySettings { log: Some("/nowhere/log.csv".into()), ..perfect.clone() });
    assert!(nowhere.starts_with("log = /nowhere/log.csv: "), "{nowhere}");
    assert_eq!(
        message(ProxySettings { forward: LOOPBACK, ..perfect.clone() }),
        "forward = 127.0.0.1:0: must name a port from 1 to 65535"
    );
    let taken = message(ProxySettings { listen: forward, ..perfect.clone() });
    assert!(taken.starts_with(&format!("listen = {forward}: ")), "{taken}");
    drop(peer);
    let any = SocketAddr::new(Ipv4Addr::UNSPECIFIED.into(), forward.port());
    for listen in [forward, any] {
        let own = Proxy::bind(&ProxySettings { listen, ..perfect.clone() }).unwrap_err();
        assert!(matches!(own, ProxyError::Loop { .. }), "{own}");
    }
}

/// Run by hand: `cargo test --release -p haptether-netsim scheduling_error_at -- --ignored --nocapture`.
#[test]
#[ignore = "a measurement of this machine, not an assertion"]
fn scheduling_error_at_one_kilohertz() {
    const COUNT: usize = 10_000;
    let (peer, echoing) = echo(COUNT);
    let link = LinkSettings { loss: 0.0, ..rough() };
    let proxy = Running::start(&settings(peer, link));
    let times = round_trips(proxy.address, COUNT, Duration::from_millis(1));
    echoing.join().unwrap();
    let (statistics, _) = proxy.stop();
    println!("{:?}", statistics.scheduling_error);
    println!("round trip {:?} to {:?}", times[0], times[COUNT - 1]);
}
