//! Live driver: a UDP proxy that applies the verdicts of two links to real datagrams.
//!
//! One thread serves both directions and all clients. It sleeps in `ppoll` until a datagram arrives or the
//! next departure is near, and spins for the rest (see [`spin`]). Deadlines are absolute times of the
//! monotonic clock, so errors do not accumulate. The thread receives while it spins, so that arrivals are
//! stamped when they happen. Calls are batched; nothing is allocated per datagram.

mod batch;
mod log;
mod pipeline;
mod ports;
mod realtime;
#[cfg(test)]
mod ring_model;
mod settings;
mod spin;
mod statistics;

use std::fs::File;
use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::time::{Duration, Instant};

use rustix::event::Timespec;

use crate::checks::nanoseconds;
use crate::impairments::LinkSettings;
use crate::packet::{Direction, Packet};
use crate::verdict::Judgement;
use batch::{Receiver, Sender};
use log::Log;
use pipeline::{DirectionPipeline, Metrics};
use ports::{Egress, Ingress, Ports, Ready, Routes};
pub(crate) use realtime::prepare_thread;
use spin::SpinBudget;
use statistics::{Recorder, count};

pub use batch::MAX_DATAGRAM;
pub use pipeline::ProxyControl;
pub use ports::MAX_FLOWS;
pub use realtime::{ScheduleBefore, Scheduling, schedule_fifo};
pub use settings::{ProxyError, ProxySettings, Source};
pub use statistics::{DirectionStatistics, ProxyMonitor, ProxyStatistics, SchedulingError};

/// Clock of the proxy: monotonic ns since it was bound. It wraps after 584 years.
#[derive(Clone, Copy, Debug)]
struct Clock(Instant);

impl Clock {
    #[expect(clippy::cast_possible_truncation, reason = "584 years")]
    fn now_ns(self) -> u64 {
        self.0.elapsed().as_nanos() as u64
    }
}

/// Interval at which silent flows are expired, in ns.
const EXPIRY_PERIOD_NS: u64 = 1_000_000_000;

/// UDP proxy between clients and one peer.
///
/// It is not an open relay. It forwards only to the named peer, and only datagrams from this machine or from
/// a source that the settings allow. Each client has its own socket towards the peer; all clients share one
/// link per direction.
#[derive(Debug)]
pub struct Proxy {
    ports: Ports,
    forward: DirectionPipeline,
    backward: DirectionPipeline,
    seed: u64,
    is_realtime: bool,
    record: Arc<Recorder>,
    log: Option<Log>,
    clock: Clock,
    next_expiry_ns: u64,
}

/// Buffers that contain kernel addresses, and so stay on the running thread.
struct Batches {
    /// For the listening socket, whose address family may differ from that of the peer.
    from_clients: Receiver,
    from_peer: Receiver,
    sender: Sender,
    ready: Ready,
    spin: SpinBudget,
}

impl Proxy {
    /// Open the sockets, and reserve all memory the proxy will use.
    pub fn bind(settings: &ProxySettings) -> Result<Self, ProxyError> {
        let pipeline = |direction, link: &LinkSettings| {
            DirectionPipeline::new(direction, settings.seed, link)
                .map_err(|source| ProxyError::Link { direction, source })
        };
        let forward = pipeline(Direction::Forward, &settings.forward_link)?;
        let backward = pipeline(Direction::Backward, &settings.backward_link)?;
        let max_error_s = settings.max_error_s;
        if !(max_error_s > 0.0 && max_error_s <= 1.0) {
            return Err(ProxyError::MaxError { seen: max_error_s });
        }
        let ports = Ports::open(settings)?;
        let begin = |path| File::create(path).and_then(Log::begin);
        let log = settings.log.as_ref().map(|path| {
            begin(path).map_err(|source| ProxyError::Log { path: path.display().to_string(), source })
        });
        let (receive_buffer_bytes, send_buffer_bytes) = ports.granted();
        let record = Recorder {
            receive_buffer_bytes,
            send_buffer_bytes,
            max_error_ns: nanoseconds(max_error_s),
            ..Recorder::default()
        };
        Ok(Self {
            ports,
            forward,
            backward,
            seed: settings.seed,
            is_realtime: settings.realtime,
            record: Arc::new(record),
            log: log.transpose()?,
            clock: Clock(Instant::now()),
            next_expiry_ns: EXPIRY_PERIOD_NS,
        })
    }

    /// Address that clients send to, with the actual port.
    pub fn listen_address(&self) -> SocketAddr {
        self.ports.listen_address
    }

    /// Handle that reads the statistics while the proxy runs.
    pub fn monitor(&self) -> ProxyMonitor {
        ProxyMonitor(Arc::clone(&self.record))
    }

    /// Handle that changes the rules while the proxy runs.
    pub fn control(&self) -> ProxyControl {
        ProxyControl {
            seed: self.seed,
            forward: Arc::clone(&self.forward.change),
            backward: Arc::clone(&self.backward.change),
        }
    }

    /// Serves until `stop` is set, which is noticed within 20 ms. Datagrams in flight at the stop are not
    /// sent.
    ///
    /// The calling thread gets real-time scheduling, if requested and permitted, and keeps it. The log ends
    /// with the run.
    pub fn run(&mut self, stop: &AtomicBool) -> io::Result<ProxyStatistics> {
        self.run_observed(stop, |_, _| {})
    }

    /// Same as [`run`](Proxy::run), but passes every packet and its judgement to `observe` on the proxy's
    /// thread.
    ///
    /// The index of a packet is its order of arrival in its direction. Time spent in `observe` delays
    /// datagrams.
    pub fn run_observed(
        &mut self,
        stop: &AtomicBool,
        mut observe: impl FnMut(&Packet, &Judgement<'_>),
    ) -> io::Result<ProxyStatistics> {
        let scheduling = prepare_thread(self.is_realtime);
        self.record.is_fifo.store(scheduling == Scheduling::Fifo, Relaxed);
        let mut batches = Batches {
            from_clients: Receiver::new(self.ports.report_room()),
            from_peer: Receiver::new(None),
            sender: Sender::new(),
            ready: Ready::new(),
            spin: SpinBudget::default(),
        };
        while !stop.load(Relaxed) {
            self.forward.take_up_change();
            self.backward.take_up_change();
            self.release_due(&mut batches.sender);
            self.expire();
            self.sleep(&mut batches.spin)?;
            self.receive(&mut batches, &mut observe)?;
        }
        let mut metrics = Metrics { record: &self.record, log: &mut self.log };
        self.forward.give_up(&mut metrics);
        self.backward.give_up(&mut metrics);
        if let Some(Err(_)) = self.log.take().map(Log::end) {
            // The measurements are useful without the log.
            self.record.log_failed.store(true, Relaxed);
        }
        Ok(self.monitor().snapshot())
    }

    fn next_due(&self) -> Option<u64> {
        let dues = [self.forward.next_due(), self.backward.next_due()];
        dues.into_iter().flatten().min()
    }

    /// Send what is due now. Datagrams that become due meanwhile wait for the next round, so that receiving
    /// does not starve.
    fn release_due(&mut self, sender: &mut Sender) {
        let Self { ports, forward, backward, record, log, clock, .. } = self;
        let mut metrics = Metrics { record, log };
        let now_ns = clock.now_ns();
        for pipeline in [forward, backward] {
            pipeline.release(now_ns, *clock, ports, sender, &mut metrics);
        }
    }

    fn expire(&mut self) {
        let now_ns = self.clock.now_ns();
        if now_ns >= self.next_expiry_ns {
            self.next_expiry_ns = now_ns + EXPIRY_PERIOD_NS;
            self.ports.flows.expire(now_ns);
            self.record.flows.store(self.ports.flows.len() as u64, Relaxed);
        }
    }

    /// Sleeps until a datagram arrives, the next departure is near, or the stop flag must be checked.
    fn sleep(&self, spin: &mut SpinBudget) -> io::Result<()> {
        let Some(sleep_ns) = spin.sleep_ns(self.clock.now_ns(), self.next_due()) else {
            return Ok(());
        };
        let timeout = Timespec::try_from(Duration::from_nanos(sleep_ns)).map_err(io::Error::other)?;
        self.ports.wait(&timeout)
    }

    /// Receives from all ready sockets, and sends due datagrams in between.
    fn receive(
        &mut self,
        batches: &mut Batches,
        observe: &mut impl FnMut(&Packet, &Judgement<'_>),
    ) -> io::Result<()> {
        let Batches { ready, from_clients, from_peer, sender, .. } = batches;
        for ingress in self.ports.look(ready)? {
            match ingress {
                Ingress::Listen => self.receive_forward(from_clients, observe)?,
                Ingress::Upstream(place) => self.receive_backward(place, from_peer, observe)?,
            }
            self.release_due(sender);
        }
        Ok(())
    }

    fn receive_forward(
        &mut self,
        receiver: &mut Receiver,
        observe: &mut impl FnMut(&Packet, &Judgement<'_>),
    ) -> io::Result<()> {
        let Self { ports, forward, record, log, clock, .. } = self;
        let mut metrics = Metrics { record, log };
        let Some(socket) = ports.ingress_socket(Ingress::Listen) else {
            return Ok(());
        };
        receiver.receive(socket, &record.peer_unreachable)?;
        let now_ns = clock.now_ns();
        for (datagram, sender) in receiver.datagrams() {
            let admitted = sender.and_then(|client| Some((client, ports.admit(client, now_ns)?)));
            if let Some((client, flow)) = admitted {
                let routes = Routes {
                    on: Egress::Peer(flow),
                    back: Egress::Client(client),
                    beside: Egress::PeerBeside,
                };
                forward.accept(now_ns, datagram, &routes, &mut metrics, &mut *observe);
            } else {
                count(&record.forward.refused);
            }
        }
        record.flows.store(ports.flows.len() as u64, Relaxed);
        Ok(())
    }

    fn receive_backward(
        &mut self,
        place: usize,
        receiver: &mut Receiver,
        observe: &mut impl FnMut(&Packet, &Judgement<'_>),
    ) -> io::Result<()> {
        let Self { ports, backward, record, log, clock, .. } = self;
        let mut metrics = Metrics { record, log };
        let Some(socket) = ports.ingress_socket(Ingress::Upstream(place)) else {
            return Ok(());
        };
        receiver.receive(socket, &record.peer_unreachable)?;
        let now_ns = clock.now_ns();
        for (datagram, sender) in receiver.datagrams() {
            let answered = sender.and_then(|sender| ports.client_of(place, sender.from, now_ns));
            if let Some((flow, client)) = answered {
                let routes = Routes {
                    on: Egress::Client(client),
                    back: Egress::Peer(flow),
                    beside: Egress::ClientBeside(client),
                };
                backward.accept(now_ns, datagram, &routes, &mut metrics, &mut *observe);
            } else {
                count(&record.backward.refused);
            }
        }
        Ok(())
    }
}
