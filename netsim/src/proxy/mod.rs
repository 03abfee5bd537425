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
mod settings;
mod socket;
mod statistics;

use std::io;
use std::net::{SocketAddr, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, poll};

use crate::settings::LinkSettings;
use crate::verdict::{Direction, Packet, Verdict};
use client::Client;
use lane::Lane;
use socket::{is_own, is_unreachable, open_listening, open_upstream, receive_from};
use statistics::{Recorder, count};

pub use buffers::MAX_DATAGRAM;
pub use histogram::SchedulingError;
pub use settings::{ProxyError, ProxySettings};
pub use statistics::{DirectionStatistics, ProxyMonitor, ProxyStatistics};

/// Awake for at most this long before a datagram is due.
const SPIN_NS: u64 = 100_000;
/// Asleep for at most this long, so that a stop is noticed.
const SLEEP_NS: u64 = 20_000_000;
/// Datagrams received from each socket before what is due is looked at again.
const BATCH: usize = 64;

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

/// The proxy's clock: monotonic ns since it was bound. It wraps after 584 years.
#[expect(clippy::cast_possible_truncation, reason = "584 years")]
fn elapsed_ns(origin: Instant) -> u64 {
    origin.elapsed().as_nanos() as u64
}
