//! Load for a UDP proxy, and the sink behind it. One thread sends and receives in both directions and never
//! sleeps, so that it measures the proxy.
//!
//! `load LISTEN PEER RATE SECONDS DELAY`: sends RATE datagrams per second to the proxy at LISTEN, and as many
//! back from PEER, to which the proxy forwards. Prints one line of JSON per run: datagrams sent and received,
//! travel times, and the number that took less than DELAY seconds.

use std::array;
use std::error::Error;
use std::io::{IoSlice, IoSliceMut};
use std::net::{SocketAddr, UdpSocket};
use std::os::fd::AsRawFd;
use std::time::{Duration, Instant};

use nix::errno::Errno;
use nix::sys::socket::{MsgFlags, MultiHeaders, SockaddrStorage, recvmmsg, sendmmsg};
use rustix::net::sockopt;

/// Common payload of a haptic packet in bytes.
const SIZE: usize = 64;
const BATCH: usize = 64;
const BUFFER_BYTES: usize = 8 << 20;
/// Rate per second above which datagrams leave in small groups.
const MAX_SINGLE: f64 = 5000.0;
const GROUP_PERIOD: Duration = Duration::from_micros(100);
/// Time that the last datagrams may take.
const DRAIN: Duration = Duration::from_millis(1500);

struct Side {
    socket: UdpSocket,
    /// Destination, the same for all datagrams.
    to: SocketAddr,
    send: MultiHeaders<SockaddrStorage>,
    receive: MultiHeaders<SockaddrStorage>,
    incoming: Vec<u8>,
    sent: u64,
    refused: u64,
    travelled_ns: Vec<u64>,
}

impl Side {
    fn new(socket: UdpSocket, to: SocketAddr) -> std::io::Result<Self> {
        socket.set_nonblocking(true)?;
        let _ = sockopt::set_socket_recv_buffer_size_force(&socket, BUFFER_BYTES)
            .or_else(|_| sockopt::set_socket_recv_buffer_size(&socket, BUFFER_BYTES));
        Ok(Self {
            socket,
            to,
            send: MultiHeaders::preallocate(BATCH, None),
            receive: MultiHeaders::preallocate(BATCH, None),
            incoming: vec![0; BATCH * SIZE],
            sent: 0,
            refused: 0,
            travelled_ns: Vec::new(),
        })
    }

    /// Send up to `wanted` datagrams that contain the time.
    fn send(&mut self, wanted: u64, origin: Instant) {
        let count = usize::try_from(wanted).unwrap_or(BATCH).min(BATCH);
        if count == 0 {
            return;
        }
        let mut payload = [0; SIZE];
        payload[..8].copy_from_slice(&now_ns(origin).to_le_bytes());
        let slices = [[IoSlice::new(&payload)]; BATCH];
        let addresses = [Some(SockaddrStorage::from(self.to)); BATCH];
        let fd = self.socket.as_raw_fd();
        let flags = MsgFlags::MSG_DONTWAIT;
        self.sent += count as u64;
        let taken = sendmmsg(fd, &mut self.send, &slices[..count], &addresses[..count], [], flags);
        self.refused += (count - taken.map_or(0, Iterator::count)) as u64;
    }

    fn receive(&mut self, origin: Instant) -> Result<(), Errno> {
        let mut cells = self.incoming.chunks_exact_mut(SIZE);
        let mut slices: [_; BATCH] = array::from_fn(|_| [IoSliceMut::new(cells.next().unwrap_or_default())]);
        let fd = self.socket.as_raw_fd();
        let count = match recvmmsg(fd, &mut self.receive, &mut slices, MsgFlags::MSG_DONTWAIT, None) {
            Ok(messages) => messages.count(),
            Err(Errno::EAGAIN | Errno::ECONNREFUSED) => 0,
            Err(error) => return Err(error),
        };
        let now = now_ns(origin);
        for cell in self.incoming.chunks_exact(SIZE).take(count) {
            let sent_ns = cell.first_chunk().map_or(0, |bytes| u64::from_le_bytes(*bytes));
            self.travelled_ns.push(now.saturating_sub(sent_ns));
        }
        Ok(())
    }
}

#[expect(clippy::cast_possible_truncation, reason = "584 years")]
fn nanoseconds(time: Duration) -> u64 {
    time.as_nanos() as u64
}

fn now_ns(origin: Instant) -> u64 {
    nanoseconds(origin.elapsed())
}

/// Sends until one datagram arrives, so that the peer learns the address for answers.
fn meet(client: &UdpSocket, peer: &UdpSocket, proxy: SocketAddr) -> Result<SocketAddr, Box<dyn Error>> {
    peer.set_read_timeout(Some(Duration::from_millis(500)))?;
    for _ in 0..20 {
        client.send_to(&[0; SIZE], proxy)?;
        if let Ok((_, answers_to)) = peer.recv_from(&mut [0; SIZE]) {
            // Surplus datagrams of the attempts must not be counted.
            std::thread::sleep(Duration::from_millis(100));
            peer.set_nonblocking(true)?;
            while peer.recv_from(&mut [0; SIZE]).is_ok() {}
            return Ok(answers_to);
        }
    }
    Err("nothing comes through the proxy".into())
}

fn report(name: &str, from: &Side, to: &mut Side, delay_ns: u64) -> String {
    let travelled = &mut to.travelled_ns;
    travelled.sort_unstable();
    let at = |per_mille: usize| {
        let last = travelled.len().saturating_sub(1);
        travelled.get(last * per_mille / 1000).copied().unwrap_or(0)
    };
    let early = travelled.partition_point(|&travelled_ns| travelled_ns < delay_ns);
    format!(
        "\"{name}\": {{\"sent\": {}, \"refused\": {}, \"received\": {}, \"early\": {early}, \"min_ns\": {}, \"p50_ns\": {}, \
         \"p99_ns\": {}, \"p999_ns\": {}, \"max_ns\": {}}}",
        from.sent,
        from.refused,
        travelled.len(),
        at(0),
        at(500),
        at(990),
        at(999),
        at(1000)
    )
}

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [proxy, peer, rate_hz, seconds, delay_s] = &arguments[..] else {
        return Err("usage: load LISTEN PEER RATE SECONDS DELAY".into());
    };
    let (proxy, peer): (SocketAddr, SocketAddr) = (proxy.parse()?, peer.parse()?);
    let (rate_hz, seconds): (f64, f64) = (rate_hz.parse()?, seconds.parse()?);
    if !(rate_hz > 0.0 && seconds > 0.0 && seconds < 3600.0) {
        return Err("RATE and SECONDS must be above 0".into());
    }
    let delay_ns = nanoseconds(Duration::try_from_secs_f64(delay_s.parse()?)?);
    let (client, peer) = (UdpSocket::bind((proxy.ip(), 0))?, UdpSocket::bind(peer)?);
    let answers_to = meet(&client, &peer, proxy)?;
    let (mut client, mut peer) = (Side::new(client, proxy)?, Side::new(peer, answers_to)?);

    let period = if rate_hz > MAX_SINGLE { GROUP_PERIOD } else { Duration::from_secs_f64(1.0 / rate_hz) };
    let duration = Duration::from_secs_f64(seconds);
    let origin = Instant::now();
    let mut next = Duration::ZERO;
    while origin.elapsed() < duration + DRAIN {
        let elapsed = origin.elapsed();
        if elapsed >= next && elapsed < duration {
            // Half a period apart, so that the two directions do not wait for each other.
            for (side, lag) in [(&mut client, 0.0), (&mut peer, 0.5)] {
                #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a count")]
                let due = (elapsed.as_secs_f64() * rate_hz - lag).max(0.0) as u64;
                side.send(due.saturating_sub(side.sent), origin);
            }
            next = elapsed + period / 8;
            if rate_hz > MAX_SINGLE {
                next = elapsed + period;
            }
        }
        client.receive(origin)?;
        peer.receive(origin)?;
    }
    let forward = report("forward", &client, &mut peer, delay_ns);
    let backward = report("backward", &peer, &mut client, delay_ns);
    println!("{{{forward}, {backward}}}");
    Ok(())
}
