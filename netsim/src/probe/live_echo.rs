//! The far side of a measurement: says when a probe came and when its answer left.

use std::io;
use std::net::{SocketAddr, UdpSocket};
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::time::{Duration, Instant};

use super::wire::{Answer, Request, SIZE, Seen};

/// Measurements remembered at a time; another one takes the place of the one that was heard of longest ago.
const MAX_SESSIONS: usize = 64;
/// How soon a stop is noticed.
const PATIENCE: Duration = Duration::from_millis(20);

/// What an echo has done.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct EchoStatistics {
    /// Probes answered.
    pub answered: u64,
    /// Datagrams that were no probes, which get no answer.
    pub ignored: u64,
}

/// Answers probes, one for one and of the same size, so that it is of no use to flood somebody with.
#[derive(Debug)]
pub struct Echo {
    socket: UdpSocket,
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
    /// An echo at an address; port 0 lets the system choose.
    pub fn bind(address: SocketAddr) -> io::Result<Self> {
        let socket = UdpSocket::bind(address)?;
        socket.set_read_timeout(Some(PATIENCE))?;
        Ok(Self { socket, sessions: Vec::with_capacity(MAX_SESSIONS) })
    }

    /// Where it is.
    pub fn address(&self) -> io::Result<SocketAddr> {
        self.socket.local_addr()
    }

    /// Answers until `stop` is set, which is noticed within 20 ms.
    pub fn run(&mut self, stop: &AtomicBool) -> io::Result<EchoStatistics> {
        let mut statistics = EchoStatistics::default();
        let origin = Instant::now();
        // One byte more, which tells a datagram that is too long.
        let mut buffer = [0; SIZE + 1];
        while !stop.load(Relaxed) {
            let (length, source) = match self.socket.recv_from(&mut buffer) {
                Ok(received) => received,
                Err(error) if is_passing(error.kind()) => continue,
                Err(error) => return Err(error),
            };
            let received = Instant::now();
            let Some(request) = Request::decode(&buffer[..length]) else {
                statistics.ignored += 1;
                continue;
            };
            let seen = self.take(source, &request, received);
            let received_ns = nanoseconds(received - origin);
            let answered_ns = nanoseconds(origin.elapsed());
            let answer = Answer { request, received_ns, answered_ns, seen };
            // An answer that the network refuses is a lost one.
            if self.socket.send_to(&answer.encode(), source).is_ok() {
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

/// Whether to go on: nothing came in time, or the network reports something of an earlier datagram, which anybody can
/// make it do. Only a call that is wrong in itself would be wrong for ever.
pub(super) fn is_passing(kind: io::ErrorKind) -> bool {
    !matches!(kind, io::ErrorKind::InvalidInput | io::ErrorKind::OutOfMemory)
}

pub(super) fn nanoseconds(time: Duration) -> u64 {
    u64::try_from(time.as_nanos()).unwrap_or(u64::MAX)
}
