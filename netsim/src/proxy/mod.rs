//! The live driver: a UDP proxy that delays and drops real datagrams by the verdicts of two links.
//!
//! One thread serves both directions. It sleeps in `ppoll` until a datagram comes or the next one in flight
//! is nearly due, and spends the last [`SPIN_NS`] awake: the kernel wakes a sleeper some tens of us late (50
//! us timer slack for a normal thread), never a spinner. Deadlines are absolute times of the monotonic clock,
//! so errors do not add up. While it spins it goes on receiving, so that arrivals are stamped when they
//! happen.

mod buffers;
mod client;
mod histogram;
mod lane;
mod statistics;

use std::io;
use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, poll};

use crate::link::{LinkError, LinkSettings};
use crate::verdict::{Direction, Packet, Verdict};
use client::Client;
use lane::Lane;
use statistics::{Recorder, count};

pub use buffers::MAX_DATAGRAM;
pub use histogram::SchedulingError;
pub use statistics::{DirectionStatistics, ProxyMonitor, ProxyStatistics};

/// Awake for at most this long before a datagram is due.
const SPIN_NS: u64 = 100_000;
/// Asleep for at most this long, so that a stop is noticed.
const SLEEP_NS: u64 = 20_000_000;
/// Datagrams received from each socket before what is due is looked at again.
const BATCH: usize = 64;

/// Where a proxy stands and what it does to the datagrams that pass.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ProxySettings {
    /// Address the client (the master) sends to; port 0 lets the system choose one.
    pub listen: SocketAddr,
    /// Address of the peer (the slave): the only destination, and the only source of answers.
    pub forward: SocketAddr,
    /// Network from client to peer.
    pub forward_link: LinkSettings,
    /// Network from peer to client.
    pub backward_link: LinkSettings,
    /// Key of all random draws.
    pub seed: u64,
}

/// A proxy that cannot be set up.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ProxyError {
    /// A direction's settings describe no link.
    #[error("link.{direction}: {source}")]
    Link {
        /// Which direction.
        direction: Direction,
        /// What is wrong with it.
        source: LinkError,
    },
    /// The peer's address names no port.
    #[error("forward = {forward}: must name a port from 1 to 65535")]
    NoPort {
        /// The address.
        forward: SocketAddr,
    },
    /// The proxy would forward to itself.
    #[error(
        "forward = {forward}: must not be the proxy's own listen address, or datagrams would go round for ever"
    )]
    Loop {
        /// The address.
        forward: SocketAddr,
    },
    /// An address cannot be used.
    #[error("{key} = {address}: {source}")]
    Socket {
        /// Name of the setting.
        key: &'static str,
        /// Its value.
        address: SocketAddr,
        /// What the operating system says.
        source: io::Error,
    },
}

/// A UDP proxy between one client and one peer.
#[derive(Debug)]
pub struct Proxy {
    listen: UdpSocket,
    listen_address: SocketAddr,
    /// Connected to the peer, so that the kernel refuses other sources and reports an absent peer.
    upstream: UdpSocket,
    peer: SocketAddr,
    client: Client,
    forward: Lane,
    backward: Lane,
    /// One byte more than is carried, which tells a datagram that is too large.
    arrival: [u8; MAX_DATAGRAM + 1],
    record: Arc<Recorder>,
    /// Time 0 of the proxy's clock.
    origin: Instant,
}

impl Proxy {
    /// Takes the sockets and all memory the proxy will use.
    pub fn bind(settings: &ProxySettings) -> Result<Self, ProxyError> {
        let ProxySettings { listen, forward, seed, .. } = *settings;
        let lane = |direction, link: &LinkSettings| {
            Lane::new(direction, seed, link).map_err(|source| ProxyError::Link { direction, source })
        };
        let forward_lane = lane(Direction::Forward, &settings.forward_link)?;
        let backward_lane = lane(Direction::Backward, &settings.backward_link)?;
        if forward.port() == 0 {
            return Err(ProxyError::NoPort { forward });
        }
        let refuse = |key, address| move |source| ProxyError::Socket { key, address, source };
        let (listen, listen_address) = open_listening(listen).map_err(refuse("listen", listen))?;
        let (upstream, peer) = open_upstream(forward).map_err(refuse("forward", forward))?;
        if is_own(listen_address, peer) {
            return Err(ProxyError::Loop { forward });
        }
        Ok(Self {
            listen,
            listen_address,
            upstream,
            peer,
            client: Client::default(),
            forward: forward_lane,
            backward: backward_lane,
            arrival: [0; MAX_DATAGRAM + 1],
            record: Arc::default(),
            origin: Instant::now(),
        })
    }

    /// Address the client sends to, with the port that was chosen.
    pub fn listen_address(&self) -> SocketAddr {
        self.listen_address
    }

    /// A handle that reads the statistics while the proxy runs.
    pub fn monitor(&self) -> ProxyMonitor {
        ProxyMonitor(Arc::clone(&self.record))
    }

    /// Serves until `stop` is set, which is noticed within 20 ms. What is still in flight then is not sent.
    pub fn run(&mut self, stop: &AtomicBool) -> io::Result<ProxyStatistics> {
        self.run_observed(stop, |_, _| {})
    }

    /// As [`run`](Proxy::run), showing every packet with its verdict to `observe` on the proxy's own thread.
    ///
    /// The index of a packet is its order of arrival in its direction. What `observe` spends, datagrams wait.
    pub fn run_observed(
        &mut self,
        stop: &AtomicBool,
        mut observe: impl FnMut(&Packet, Verdict),
    ) -> io::Result<ProxyStatistics> {
        while !stop.load(Relaxed) {
            self.release_due();
            self.sleep()?;
            self.receive(&mut observe)?;
        }
        Ok(self.monitor().snapshot())
    }

    fn next_due(&self) -> Option<u64> {
        let dues = [self.forward.next_due(), self.backward.next_due()];
        dues.into_iter().flatten().min()
    }

    /// Sends what is due by now; what falls due meanwhile waits for the next round, so that receiving is not
    /// starved.
    fn release_due(&mut self) {
        let Self { record, upstream, listen, .. } = self;
        let now_ns = elapsed_ns(self.origin);
        let origin = self.origin;
        let send_upstream = |datagram: &[u8], _, due_ns| {
            record.scheduling_error.record(elapsed_ns(origin) - due_ns);
            let mut sent = upstream.send(datagram);
            if is_unreachable(&sent) {
                // The socket reports what became of an earlier datagram and keeps this one back: send it
                // again.
                count(&record.peer_unreachable);
                sent = upstream.send(datagram);
            }
            sent.is_ok()
        };
        let send_to_client = |datagram: &[u8], client, due_ns| {
            record.scheduling_error.record(elapsed_ns(origin) - due_ns);
            listen.send_to(datagram, client).is_ok()
        };
        while self.forward.release(now_ns, &record.forward, send_upstream) {}
        while self.backward.release(now_ns, &record.backward, send_to_client) {}
    }

    /// Sleeps until a datagram comes, the next one in flight is nearly due, or a stop must be looked for.
    fn sleep(&self) -> io::Result<()> {
        let until_due =
            self.next_due().map_or(u64::MAX, |due_ns| due_ns.saturating_sub(elapsed_ns(self.origin)));
        let Some(sleep_ns) = until_due.checked_sub(SPIN_NS) else {
            return Ok(());
        };
        let timeout = Duration::from_nanos(sleep_ns.min(SLEEP_NS));
        let timeout = Timespec::try_from(timeout).map_err(io::Error::other)?;
        let mut sockets =
            [PollFd::new(&self.listen, PollFlags::IN), PollFd::new(&self.upstream, PollFlags::IN)];
        match poll(&mut sockets, Some(&timeout)) {
            // A signal is as good a reason to wake as any.
            Ok(_) | Err(rustix::io::Errno::INTR) => Ok(()),
            Err(error) => Err(error.into()),
        }
    }

    /// Takes what has come, until a datagram in flight is due.
    fn receive(&mut self, observe: &mut impl FnMut(&Packet, Verdict)) -> io::Result<()> {
        for _ in 0..BATCH {
            let forward = self.receive_forward(observe)?;
            let backward = self.receive_backward(observe)?;
            let is_due = || self.next_due().is_some_and(|due_ns| due_ns <= elapsed_ns(self.origin));
            if !(forward || backward) || is_due() {
                break;
            }
        }
        Ok(())
    }

    fn receive_forward(&mut self, observe: &mut impl FnMut(&Packet, Verdict)) -> io::Result<bool> {
        let record = &self.record;
        let unreachable = &record.peer_unreachable;
        let Some((length, source)) = receive_from(&self.listen, &mut self.arrival, unreachable)? else {
            return Ok(false);
        };
        let now_ns = elapsed_ns(self.origin);
        if self.client.admit(source, now_ns) {
            let datagram = &self.arrival[..length];
            self.forward.accept(now_ns, datagram, self.peer, &record.forward, observe);
        } else {
            count(&record.forward.refused);
        }
        Ok(true)
    }

    fn receive_backward(&mut self, observe: &mut impl FnMut(&Packet, Verdict)) -> io::Result<bool> {
        let record = &self.record;
        let unreachable = &record.peer_unreachable;
        let Some((length, source)) = receive_from(&self.upstream, &mut self.arrival, unreachable)? else {
            return Ok(false);
        };
        let now_ns = elapsed_ns(self.origin);
        match self.client.address() {
            // The kernel refuses other sources, except for what came between binding and connecting.
            Some(client) if source == self.peer => {
                let datagram = &self.arrival[..length];
                self.backward.accept(now_ns, datagram, client, &record.backward, observe);
            }
            _ => count(&record.backward.refused),
        }
        Ok(true)
    }
}

fn open_listening(listen: SocketAddr) -> io::Result<(UdpSocket, SocketAddr)> {
    let socket = UdpSocket::bind(listen)?;
    socket.set_nonblocking(true)?;
    let address = socket.local_addr()?;
    Ok((socket, address))
}

/// A socket connected to the peer, and the address the kernel took it for.
fn open_upstream(forward: SocketAddr) -> io::Result<(UdpSocket, SocketAddr)> {
    let any: SocketAddr = match forward {
        SocketAddr::V4(_) => (Ipv4Addr::UNSPECIFIED, 0).into(),
        SocketAddr::V6(_) => (Ipv6Addr::UNSPECIFIED, 0).into(),
    };
    let socket = UdpSocket::bind(any)?;
    socket.set_nonblocking(true)?;
    socket.connect(forward)?;
    let peer = socket.peer_addr()?;
    Ok((socket, peer))
}

/// Whether the proxy would be its own peer.
fn is_own(listen: SocketAddr, peer: SocketAddr) -> bool {
    let is_same_host = listen.ip() == peer.ip() || (listen.ip().is_unspecified() && peer.ip().is_loopback());
    is_same_host && listen.port() == peer.port()
}

/// The next datagram of a socket; `None` if there is none. An absent peer is counted and passed over.
fn receive_from(
    socket: &UdpSocket,
    buffer: &mut [u8],
    unreachable: &AtomicU64,
) -> io::Result<Option<(usize, SocketAddr)>> {
    loop {
        let received = socket.recv_from(buffer);
        if is_unreachable(&received) {
            count(unreachable);
            continue;
        }
        match received {
            Ok(datagram) => return Ok(Some(datagram)),
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => return Ok(None),
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Err(error) => return Err(error),
        }
    }
}

/// Whether the socket reports, by ICMP, that an earlier datagram found no peer: no reason to stop, it may
/// come up yet.
fn is_unreachable<T>(result: &io::Result<T>) -> bool {
    use io::ErrorKind::{ConnectionRefused, HostUnreachable, NetworkDown, NetworkUnreachable};
    result.as_ref().is_err_and(|error| {
        matches!(error.kind(), ConnectionRefused | HostUnreachable | NetworkUnreachable | NetworkDown)
    })
}

/// The proxy's clock: monotonic ns since it was bound. It wraps after 584 years.
#[expect(clippy::cast_possible_truncation, reason = "584 years")]
fn elapsed_ns(origin: Instant) -> u64 {
    origin.elapsed().as_nanos() as u64
}
