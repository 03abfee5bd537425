//! Both ends of a measurement. The client sends probes at absolute times and collects the answers; the echo
//! reports when a probe arrived and when its answer left.

use std::collections::hash_map::RandomState;
use std::hash::{BuildHasher, Hasher};
use std::io;
use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr, UdpSocket};
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, poll};

use super::estimate::{Offset, RoundTrip};
use super::wire::{Answer, Request, SIZE, Seen};
use super::{Probe, Recording};
use crate::{ScheduleBefore, proxy::prepare_thread, reply::ReplySocket};

/// Maximum probe rate in Hz.
pub const MAX_RATE_HZ: f64 = 1000.0;
const MIN_RATE_HZ: f64 = 1e-3;
/// Maximum number of probes: more than two hours at 1 kHz.
pub const MAX_PROBES: f64 = 1e7;
/// Timeout of the last answers.
const LAST_WAIT: Duration = Duration::from_secs(2);
/// Maximum sleep, so that a stop is noticed.
const MAX_SLEEP: Duration = Duration::from_millis(20);

/// Settings of a measurement.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RecordSettings {
    /// Address of the echo.
    pub peer: SocketAddr,
    /// Probes per second, at most [`MAX_RATE_HZ`].
    pub rate_hz: f64,
    /// Duration in s.
    pub duration_s: f64,
    /// Requests real-time scheduling.
    pub realtime: bool,
}

/// Failed measurement.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ProbeError {
    /// A number is not finite or out of range.
    #[error("{key} = {seen}: must be a finite number from {least} to {most}")]
    OutOfRange {
        /// Name of the setting.
        key: &'static str,
        /// Value given.
        seen: f64,
        /// Minimum allowed.
        least: f64,
        /// Maximum allowed.
        most: f64,
    },
    /// No answer arrived.
    #[error("{peer}: none of {sent} probes was answered; is an echo running there?")]
    NoAnswer {
        /// Destination of the probes.
        peer: SocketAddr,
        /// Number of probes sent.
        sent: usize,
    },
    /// No address of a name answered.
    #[error("no echo answers at any of {}", .peers.iter().map(ToString::to_string).collect::<Vec<_>>().join(", "))]
    NoneAnswers {
        /// All addresses tried.
        peers: Vec<SocketAddr>,
    },
    /// The network is unusable.
    #[error("{peer}: {source}")]
    Socket {
        /// Destination of the probes.
        peer: SocketAddr,
        /// Error of the operating system.
        source: io::Error,
    },
}

#[derive(Clone, Copy, Debug)]
struct Sent {
    at_ns: u64,
    /// Set if the echo is known to have received it.
    arrived: bool,
    trip: Option<RoundTrip>,
}

/// Interval of requests to each address of a name.
const ASK_EVERY: Duration = Duration::from_millis(100);

/// Find the address of a name at which an echo answers; a single address is returned unasked.
///
/// # Errors
///
/// [`ProbeError::NoneAnswers`] after 2 s, or once `stop` is set.
pub fn answering(peers: &[SocketAddr], stop: &AtomicBool) -> Result<SocketAddr, ProbeError> {
    if let [only] = peers {
        return Ok(*only);
    }
    // An address without a route is skipped.
    let mut asked: Vec<_> = peers
        .iter()
        .filter_map(|&peer| Some((peer, Run::new(connect(peer).ok()?, MAX_RATE_HZ, 1.0))))
        .collect();
    let begun = Instant::now();
    while begun.elapsed() < LAST_WAIT && !stop.load(Relaxed) {
        for (peer, run) in &mut asked {
            let refuse = |source| ProbeError::Socket { peer: *peer, source };
            run.send().map_err(refuse)?;
            run.wait(run.origin.elapsed() + ASK_EVERY / 4).map_err(refuse)?;
            run.receive().map_err(refuse)?;
            if run.sent.len() > run.unanswered {
                return Ok(*peer);
            }
        }
        std::thread::sleep(ASK_EVERY / 2);
    }
    Err(ProbeError::NoneAnswers { peers: peers.to_vec() })
}

/// Measure a network for the duration or until `stop` is set, on the calling thread.
pub fn record(settings: &RecordSettings, stop: &AtomicBool) -> Result<Recording, ProbeError> {
    let RecordSettings { peer, rate_hz, duration_s, realtime } = *settings;
    let within = |key, seen: f64, least: f64, most: f64| {
        let is_good = seen >= least && seen <= most;
        if is_good { Ok(()) } else { Err(ProbeError::OutOfRange { key, seen, least, most }) }
    };
    within("rate_hz", rate_hz, MIN_RATE_HZ, MAX_RATE_HZ)?;
    within("duration_s", duration_s, 1e-3, MAX_PROBES / rate_hz)?;
    let refuse = |source| ProbeError::Socket { peer, source };
    let socket = connect(peer).map_err(refuse)?;
    let _given_back = ScheduleBefore::of_this_thread();
    prepare_thread(realtime);
    let run = Run::new(socket, rate_hz, duration_s);
    let (sent, latest_s) = run.carry_out(stop).map_err(refuse)?;
    evaluate(&sent, latest_s).ok_or(ProbeError::NoAnswer { peer, sent: sent.len() })
}

fn connect(peer: SocketAddr) -> io::Result<UdpSocket> {
    let any: SocketAddr = match peer {
        SocketAddr::V4(_) => (Ipv4Addr::UNSPECIFIED, 0).into(),
        SocketAddr::V6(_) => (Ipv6Addr::UNSPECIFIED, 0).into(),
    };
    let socket = UdpSocket::bind(any)?;
    socket.connect(peer)?;
    socket.set_nonblocking(true)?;
    Ok(socket)
}

struct Run {
    socket: UdpSocket,
    /// Random from the standard library's keys, so that only a host that sees the probes can answer.
    token: u64,
    period: Duration,
    count: usize,
    origin: Instant,
    sent: Vec<Sent>,
    unanswered: usize,
    latest: Duration,
}

impl Run {
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "within MAX_PROBES")]
    fn new(socket: UdpSocket, rate_hz: f64, duration_s: f64) -> Self {
        let count = (rate_hz * duration_s).ceil() as usize;
        Self {
            socket,
            token: RandomState::new().build_hasher().finish(),
            period: Duration::from_secs_f64(1.0 / rate_hz),
            count,
            origin: Instant::now(),
            sent: Vec::with_capacity(count),
            unanswered: 0,
            latest: Duration::ZERO,
        }
    }

    fn carry_out(mut self, stop: &AtomicBool) -> io::Result<(Vec<Sent>, f64)> {
        while self.sent.len() < self.count && !stop.load(Relaxed) {
            let due = self.period.mul_f64(self.sent.len() as f64);
            if let Some(late) = self.origin.elapsed().checked_sub(due) {
                self.latest = self.latest.max(late);
                self.send()?;
            }
            let next = self.period.mul_f64(self.sent.len() as f64);
            self.wait(next)?;
            self.receive()?;
        }
        let end = self.origin.elapsed() + LAST_WAIT;
        while self.unanswered > 0 && self.origin.elapsed() < end && !stop.load(Relaxed) {
            self.wait(end)?;
            self.receive()?;
        }
        Ok((self.sent, self.latest.as_secs_f64()))
    }

    fn send(&mut self) -> io::Result<()> {
        let sequence = self.sent.len() as u64;
        let at_ns = nanoseconds(self.origin.elapsed());
        let request = Request { token: self.token, sequence, sent_ns: at_ns };
        match self.socket.send(&request.encode()) {
            Ok(_) => {}
            // A probe refused by the network counts as lost.
            Err(error) if is_passing(error.kind()) => {}
            Err(error) => return Err(error),
        }
        self.sent.push(Sent { at_ns, arrived: false, trip: None });
        self.unanswered += 1;
        Ok(())
    }

    /// Sleeps until an answer arrives or a time is reached.
    fn wait(&self, until: Duration) -> io::Result<()> {
        let timeout = until.saturating_sub(self.origin.elapsed()).min(MAX_SLEEP);
        let timeout = Timespec::try_from(timeout).map_err(io::Error::other)?;
        match poll(&mut [PollFd::new(&self.socket, PollFlags::IN)], Some(&timeout)) {
            Ok(_) | Err(rustix::io::Errno::INTR) => Ok(()),
            Err(error) => Err(error.into()),
        }
    }

    fn receive(&mut self) -> io::Result<()> {
        // One extra byte reveals a datagram that is too long.
        let mut buffer = [0; SIZE + 1];
        loop {
            match self.socket.recv(&mut buffer) {
                Ok(length) => {
                    let now_ns = nanoseconds(self.origin.elapsed());
                    if let Some(answer) = Answer::decode(&buffer[..length]) {
                        self.take(&answer, now_ns);
                    }
                }
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => return Ok(()),
                Err(error) if is_passing(error.kind()) => {}
                Err(error) => return Err(error),
            }
        }
    }

    fn take(&mut self, answer: &Answer, now_ns: u64) {
        let Request { token, sequence, sent_ns } = answer.request;
        let place = |sequence| usize::try_from(sequence).unwrap_or(usize::MAX);
        let probe = self.sent.get_mut(place(sequence));
        // A second answer to a probe, as from a network that duplicates, adds nothing.
        let Some(probe) = probe.filter(|probe| {
            token == self.token && sent_ns == probe.at_ns && now_ns >= sent_ns && probe.trip.is_none()
        }) else {
            return;
        };
        probe.trip = Some(RoundTrip {
            sent_s: seconds(sent_ns, 0),
            there_s: seconds(answer.received_ns, sent_ns),
            back_s: seconds(now_ns, answer.answered_ns),
        });
        self.unanswered -= 1;
        for arrived in answer.seen.sequences() {
            if let Some(probe) = self.sent.get_mut(place(arrived)) {
                probe.arrived = true;
            }
        }
    }
}

/// Time from `from_ns` to `to_ns`, which may be readings of different clocks.
fn seconds(to_ns: u64, from_ns: u64) -> f64 {
    let magnitude_s = to_ns.abs_diff(from_ns) as f64 * 1e-9;
    if to_ns < from_ns { -magnitude_s } else { magnitude_s }
}

fn evaluate(sent: &[Sent], latest_s: f64) -> Option<Recording> {
    let trips: Vec<RoundTrip> = sent.iter().filter_map(|probe| probe.trip).collect();
    let shortest_s = trips.iter().map(RoundTrip::total_s).min_by(f64::total_cmp)?;
    let offset = Offset::estimate(&trips);
    let delays = |trip: &RoundTrip| {
        let ahead_s = offset.at(trip.sent_s);
        ((trip.there_s - ahead_s).max(0.0), (trip.back_s + ahead_s).max(0.0))
    };
    let mut last = trips.first().map(delays)?;
    let begun_s = seconds(sent.first()?.at_ns, 0);
    let (mut lost_forward, mut lost_backward) = (0, 0);
    let probe = |probe: &Sent| {
        let (forward_s, backward_s) = match &probe.trip {
            Some(trip) => {
                last = delays(trip);
                (Some(last.0), Some(last.1))
            }
            None if probe.arrived => {
                lost_backward += 1;
                (Some(last.0), None)
            }
            None => {
                lost_forward += 1;
                (None, Some(last.1))
            }
        };
        Probe { sent_s: seconds(probe.at_ns, 0) - begun_s, forward_s, backward_s }
    };
    let probes = sent.iter().map(probe).collect();
    let (offset_s, drift) = (offset.ahead_s, offset.drift);
    Some(Recording { probes, lost_forward, lost_backward, shortest_s, offset_s, drift, latest_s })
}

/// Maximum number of remembered measurements; a new one replaces the least recently heard.
const MAX_SESSIONS: usize = 64;
/// Time within which a stop is noticed.
const PATIENCE: Duration = Duration::from_millis(20);

/// Statistics of an echo.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct EchoStatistics {
    /// Probes answered.
    pub answered: u64,
    /// Datagrams that were not probes, and got no answer.
    pub ignored: u64,
}

/// Answers probes one to one and in the same size, so that it cannot amplify a flood.
#[derive(Debug)]
pub struct Echo {
    socket: ReplySocket,
    sessions: Vec<Session>,
}

#[derive(Debug)]
struct Session {
    source: SocketAddr,
    token: u64,
    seen: Seen,
    heard: Instant,
}

impl Echo {
    /// Bind an echo to an address; port 0 lets the system choose.
    pub fn bind(address: SocketAddr) -> io::Result<Self> {
        let socket = ReplySocket::bind(address)?;
        socket.socket().set_read_timeout(Some(PATIENCE))?;
        Ok(Self { socket, sessions: Vec::with_capacity(MAX_SESSIONS) })
    }

    /// Address of the echo.
    pub fn address(&self) -> io::Result<SocketAddr> {
        self.socket.socket().local_addr()
    }

    /// Answers until `stop` is set, which is noticed within 20 ms.
    pub fn run(&mut self, stop: &AtomicBool) -> io::Result<EchoStatistics> {
        let mut statistics = EchoStatistics::default();
        let origin = Instant::now();
        // One extra byte reveals a datagram that is too long.
        let mut buffer = [0; SIZE + 1];
        while !stop.load(Relaxed) {
            let (length, reply_address) = match self.socket.receive(&mut buffer) {
                Ok(received) => received,
                Err(error) if is_passing(error.kind()) => continue,
                Err(error) => return Err(error),
            };
            let received = Instant::now();
            let Some(request) = Request::decode(&buffer[..length]) else {
                statistics.ignored += 1;
                continue;
            };
            let seen = self.take(reply_address.from, &request, received);
            let received_ns = nanoseconds(received - origin);
            let answered_ns = nanoseconds(origin.elapsed());
            let answer = Answer { request, received_ns, answered_ns, seen };
            // An answer refused by the network counts as lost.
            if self.socket.send(&answer.encode(), reply_address).is_ok() {
                statistics.answered += 1;
            }
        }
        Ok(statistics)
    }

    fn take(&mut self, source: SocketAddr, request: &Request, now: Instant) -> Seen {
        let is_of = |session: &Session| session.source == source && session.token == request.token;
        let known = self.sessions.iter().position(is_of);
        let place = known.unwrap_or_else(|| {
            let session = Session { source, token: request.token, seen: Seen::default(), heard: now };
            if self.sessions.len() < MAX_SESSIONS {
                self.sessions.push(session);
                return self.sessions.len() - 1;
            }
            let heard = self.sessions.iter().enumerate().min_by_key(|(_, session)| session.heard);
            let oldest = heard.map_or(0, |(place, _)| place);
            self.sessions[oldest] = session;
            oldest
        });
        let session = &mut self.sessions[place];
        session.heard = now;
        session.seen.take(request.sequence);
        session.seen
    }
}

/// Test if the call may be retried: a timeout, or a network report about an earlier datagram, which anybody
/// can cause. Only an invalid call, or lack of memory, is permanent.
fn is_passing(kind: io::ErrorKind) -> bool {
    !matches!(kind, io::ErrorKind::InvalidInput | io::ErrorKind::OutOfMemory)
}

fn nanoseconds(time: Duration) -> u64 {
    u64::try_from(time.as_nanos()).unwrap_or(u64::MAX)
}
