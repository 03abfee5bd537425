//! Handshakes on a thread of their own: they take a millisecond and allocate, which no tick may.

use std::{
    io,
    net::SocketAddr,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::Duration,
};

use haptether_netsim::ReplyAddress;

use super::{own_thread::OwnThread, slow_device::SlowDevice, strangers::StrangerReport, system};
use crate::{
    coupling::CouplingError,
    ring::ring,
    session::{
        Bucket, EndError, Handshake, HandshakeDatagram, HandshakeDecision, HandshakeError, HandshakeEvent,
        Outcome, PreSharedKey, Rejection, Rejections, Session, SessionEvent, SessionSettings, SessionStatus,
        Shares, StillHeard, SystemEntropy, message_is_answer, session_and_epoch,
    },
};

/// Maximum number of queued messages per direction; more are dropped.
const WAITING: usize = 64;
/// Share for new sessions; the living one has the rest.
const FOR_NEW: usize = WAITING / 2;
const POLL: Duration = Duration::from_millis(2);
/// Time in ns per message, for all new sessions together and for the living one. A message costs about 50 us, so a
/// flood costs 1 % of a core.
const MESSAGE_NS: u64 = 5_000_000;
/// Bursts of the living session: for a new epoch, and for the newest known.
const NEW_KEYS: u64 = 16;
const REPEATS: u64 = 8;

#[derive(Debug)]
enum Request {
    /// Standing of the session, and the number of this thread's keys in use.
    Status(SessionStatus, u64),
    /// Handshake message and its sender.
    Message(ReplyAddress, HandshakeDatagram),
}

#[derive(Debug)]
pub(super) struct Answer {
    /// Sender of the request, or `None` for the peer.
    pub(super) to: Option<ReplyAddress>,
    pub(super) outcome: Outcome,
}

/// Rate limits of messages. Recorded ones, however many, keep out neither a new master nor the partner of the living
/// session.
#[derive(Debug)]
struct Admission {
    sessions: Shares,
    renewals: Bucket,
    repeats: Bucket,
    /// Session and epoch: at the slave of the newest keys made, at the master of its newest message.
    newest: Option<(u64, u32)>,
}

impl Admission {
    fn new() -> Self {
        Self {
            sessions: Shares::new(MESSAGE_NS),
            renewals: Bucket::default(),
            repeats: Bucket::default(),
            newest: None,
        }
    }

    /// Return whether a message with a valid MAC goes on to the thread.
    fn admits(
        &mut self,
        now_ns: u64,
        from: SocketAddr,
        message: &HandshakeDatagram,
        is_renewal: bool,
    ) -> bool {
        let (session, epoch) = session_and_epoch(message);
        if message_is_answer(message) {
            return self.newest == Some((session, epoch)) && self.renewals.take(now_ns, MESSAGE_NS, NEW_KEYS);
        }
        if !is_renewal {
            return self.sessions.take(now_ns, from);
        }
        // Repeats of a proved epoch of the partner have their own limit. Lower epochs were given up.
        match self.newest.filter(|newest| newest.0 == session).map(|newest| epoch.cmp(&newest.1)) {
            Some(std::cmp::Ordering::Less) => false,
            Some(std::cmp::Ordering::Equal) => self.repeats.take(now_ns, MESSAGE_NS, REPEATS),
            _ => self.renewals.take(now_ns, MESSAGE_NS, NEW_KEYS),
        }
    }
}

/// The loop's end of the thread.
#[derive(Debug)]
pub(super) struct Handshakes {
    requests: rtrb::Producer<Request>,
    answers: rtrb::Consumer<Answer>,
    is_over: Arc<AtomicBool>,
    thread: OwnThread<Rejections>,
    admission: Admission,
    /// Number of keys that the loop has received.
    keys: u64,
    /// Messages beyond their limit.
    dropped: u64,
    was_reported: bool,
}

impl Handshakes {
    pub(super) fn start(settings: SessionSettings, key: PreSharedKey) -> Result<Self, StartError> {
        let mut entropy = SystemEntropy::new();
        let handshake = Handshake::new(settings, key, &mut entropy).map_err(EndError::from)?;
        let (requests, to_answer) = ring(WAITING);
        let (to_loop, answers) = rtrb::RingBuffer::new(WAITING);
        let is_over = Arc::new(AtomicBool::new(false));
        let over = Arc::clone(&is_over);
        let thread = std::thread::Builder::new()
            .name("haptether-keys".into())
            .spawn(move || answer(handshake, entropy, to_answer, to_loop, &over))?;
        let admission = Admission::new();
        Ok(Self {
            requests,
            answers,
            is_over,
            thread: OwnThread::new(thread),
            admission,
            keys: 0,
            dropped: 0,
            was_reported: false,
        })
    }

    /// Report the session's status, unless requests are unread.
    pub(super) fn set_status(&mut self, status: SessionStatus) {
        if self.requests.slots() == WAITING {
            let _ = self.requests.push(Request::Status(status, self.keys));
        }
    }

    /// Passes on a message within its limit, after the session's status.
    pub(super) fn hand_over(
        &mut self,
        now_ns: u64,
        session: &Session,
        reply_address: ReplyAddress,
        message: HandshakeDatagram,
        is_renewal: bool,
    ) {
        let is_new = !is_renewal && !message_is_answer(&message);
        let room = if is_new { FOR_NEW } else { 0 };
        if self.requests.slots() < room + 2
            || !self.admission.admits(now_ns, reply_address.from, &message, is_renewal)
        {
            self.dropped += 1;
            return;
        }
        let _ = self.requests.push(Request::Status(session.status(now_ns), self.keys));
        let _ = self.requests.push(Request::Message(reply_address, message));
    }

    pub(super) fn next(&mut self) -> Option<Answer> {
        let answer = self.answers.pop().ok()?;
        self.keys += u64::from(answer.outcome.keys.is_some());
        if let Some(made) = answer.outcome.reply.as_ref().filter(|made| {
            !message_is_answer(made) || (answer.outcome.keys.is_some() && session_and_epoch(made).1 > 0)
        }) {
            self.admission.newest = Some(session_and_epoch(made));
        }
        Some(answer)
    }

    /// True once if the thread has ended by itself.
    pub(super) fn has_died(&mut self) -> bool {
        let died = !self.was_reported && self.thread.has_returned();
        self.was_reported |= died;
        died
    }

    /// End the thread. Returns its rejections, including messages beyond the limit.
    pub(super) fn end(&mut self) -> Rejections {
        self.is_over.store(true, Ordering::Relaxed);
        let rejections = self.thread.join().unwrap_or_default();
        rejections.with(Rejection::Busy, std::mem::take(&mut self.dropped))
    }
}

impl Drop for Handshakes {
    fn drop(&mut self) {
        self.end();
    }
}

/// Reason why a live run has no session.
#[derive(Debug, thiserror::Error)]
pub enum StartError {
    /// Invalid settings, or no randomness.
    #[error(transparent)]
    Session(#[from] EndError),
    /// No thread or socket.
    #[error(transparent)]
    System(#[from] io::Error),
}

fn answer(
    mut handshake: Handshake,
    mut entropy: SystemEntropy,
    mut requests: rtrb::Consumer<Request>,
    mut answers: rtrb::Producer<Answer>,
    is_over: &AtomicBool,
) -> Rejections {
    let mut status = None;
    let mut given = 0;
    while !is_over.load(Ordering::Relaxed) {
        while let Ok(request) = requests.pop() {
            match (request, &status) {
                // A status older than the newest keys would make this thread request them again.
                (Request::Status(newer, keys), _) => status = (keys == given).then_some(newer),
                (Request::Message(reply_address, message), Some(known)) => {
                    let now_ns = system::now_ns();
                    if let Ok(outcome) =
                        handshake.receive(now_ns, reply_address.from, &message, known, &mut entropy)
                    {
                        let has_keys = outcome.keys.is_some();
                        let to = (!outcome.to_peer).then_some(reply_address);
                        // A full ring means that the loop does not run and needs no keys.
                        if answers.push(Answer { to, outcome }).is_ok() && has_keys {
                            given += 1;
                            status = None;
                        }
                    }
                }
                (Request::Message(..), None) => {}
            }
        }
        if let Some(status) = &status {
            match handshake.poll(system::now_ns(), status, &mut entropy) {
                Ok(Some(hello)) => {
                    let outcome = Outcome { reply: Some(hello), ..Outcome::default() };
                    let _ = answers.push(Answer { to: None, outcome });
                }
                // No keys without randomness; a later try may succeed.
                Ok(None) | Err(HandshakeError::Entropy(_) | HandshakeError::Noise) => {}
            }
        }
        std::thread::sleep(POLL);
    }
    handshake.rejections()
}

/// Security event of a live run, for the operator, and refusals of the loop.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum SecurityEvent {
    /// Event of the session.
    Session(SessionEvent),
    /// Event of a handshake.
    Handshake(HandshakeEvent),
    /// The operator at the slave may not let another master begin yet.
    StillHeard(StillHeard),
    /// The loop refused a change of the coupling.
    Refused(CouplingError),
    /// The thread that makes keys has ended by itself.
    KeysEnd,
    /// Address at which a peer with several addresses answered.
    Found(SocketAddr),
    /// Datagrams that are not from the peer.
    Strangers(StrangerReport),
    /// The device is slower than its loop.
    SlowDevice(SlowDevice),
}

impl std::fmt::Display for SecurityEvent {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Session(SessionEvent::Began { .. }) => {
                formatter.write_str("secure session: frames are encrypted and authenticated")
            }
            Self::Session(SessionEvent::Rekeyed { epoch }) => write!(formatter, "new keys, the {epoch}. renewal"),
            Self::Session(SessionEvent::Released) => formatter.write_str("the peer has ended the session"),
            Self::Session(SessionEvent::Aging { left_ns }) => write!(
                formatter,
                "the keys should have been renewed and were not: nothing more is sent under them in {:.0} s; new ones \
                 are asked for until then",
                *left_ns as f64 * 1e-9
            ),
            Self::Session(SessionEvent::Expired) => formatter.write_str(
                "the keys have grown too old, and no others came: this master and this slave alone go on when a renewal \
                 comes through; SIGUSR1 of the slave lets another master begin",
            ),
            Self::Session(SessionEvent::Forgeries) => {
                formatter.write_str("more forgeries than the keys bear: the session is over")
            }
            Self::Session(SessionEvent::TakenOver) => formatter.write_str("another master may begin"),
            Self::Handshake(HandshakeEvent::SecondMaster { .. }) => formatter.write_str(
                "another master with the key was refused: one has the lease, until it ends or has been silent for 2 s \
                 and a person here allows another (SIGUSR1)",
            ),
            Self::Handshake(HandshakeEvent::Refused { decision: HandshakeDecision::Leased, .. }) => {
                formatter.write_str(
                "refused: another master has the lease of this slave, or this one from before it lost its keys: \
                 SIGUSR1 of the slave frees it after 2 s of silence",
            )
            }
            Self::Handshake(HandshakeEvent::Refused { form, .. }) => {
                write!(formatter, "refused: the peer's frames are {form}: must be as on this side; take the same scene on both")
            }
            Self::KeysEnd => formatter.write_str(
                "the thread that makes keys has died: this session ends when its keys grow old, within 180 s",
            ),
            Self::Found(address) => write!(formatter, "the peer answers at {address}"),
            Self::Strangers(report) => report.fmt(formatter),
            Self::SlowDevice(report) => report.fmt(formatter),
            Self::Refused(error) => write!(formatter, "not changed: {error}"),
            Self::StillHeard(still) => {
                write!(formatter, "no other master yet: this one was heard {:.1} s ago, must be silent for {:.0} s",
                    still.ago_ns as f64 * 1e-9, still.silence_ns as f64 * 1e-9)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: u64 = 1_000_000;

    fn message(kind: u8, session: u64, epoch: u32) -> HandshakeDatagram {
        let mut message = [0; crate::session::HANDSHAKE_LENGTH];
        message[3] = kind;
        message[4..8].copy_from_slice(&epoch.to_le_bytes());
        message[8..16].copy_from_slice(&session.to_le_bytes());
        message
    }

    fn at(host: u8) -> SocketAddr {
        SocketAddr::from(([10, 0, 0, host], 9))
    }

    /// 1e5 recorded first messages a second from one address: another address is admitted at once.
    #[test]
    fn flood_of_recorded_messages_keeps_no_master_out() {
        let mut admission = Admission::new();
        let taken =
            (0..100_000).filter(|n| admission.admits(n * 10_000, at(1), &message(1, *n, 0), false)).count();
        assert!((50..60).contains(&taken), "{taken}");
        assert!(admission.admits(1000 * MS, at(2), &message(1, 5, 0), false));
    }

    /// Endless repeats of the partner's messages do not delay its next message.
    #[test]
    fn repeats_of_partner_do_not_block_its_next_message() {
        let mut admission = Admission::new();
        admission.newest = Some((7, 6));
        for (n, epoch) in (0..100_000).zip([4, 5, 6].into_iter().cycle()) {
            assert!(!admission.admits(n * 10_000, at(1), &message(1, 7, epoch), true) || epoch == 6);
        }
        for n in 0..16 {
            assert!(admission.admits(1000 * MS, at(2), &message(1, 7, 7), true), "{n}");
        }
        assert!(!admission.admits(1000 * MS, at(2), &message(1, 7, 7), true), "new epochs have a limit, too");
    }

    /// A master accepts the answer to its last request, and no recorded one.
    #[test]
    fn answers_to_other_messages_are_refused() {
        let mut admission = Admission::new();
        assert!(!admission.admits(0, at(1), &message(2, 7, 0), false), "nothing was requested");
        admission.newest = Some((7, 0));
        for n in 0..100_000_u64 {
            assert!(!admission.admits(n * 10_000, at(1), &message(2, n + 8, 0), false));
        }
        assert!(admission.admits(1000 * MS, at(1), &message(2, 7, 0), false));
    }
}
