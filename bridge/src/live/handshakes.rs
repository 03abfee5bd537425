//! Handshakes on a thread of their own: they cost a millisecond and allocate, which no tick may.

use std::{
    io,
    net::SocketAddr,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    thread::JoinHandle,
    time::Duration,
};

use super::clock;
use crate::session::{
    EndError, Handshake, HandshakeDatagram, HandshakeError, HandshakeEvent, Outcome, PreSharedKey, Rejection,
    Rejections, SessionEvent, SessionSettings, Standing, StillHeard, SystemEntropy, Verdict,
};

/// What waits in either direction; more is dropped, as a network would.
const WAITING: usize = 64;
/// How often the thread looks.
const POLL: Duration = Duration::from_millis(2);

/// What the loop tells the thread.
#[derive(Debug)]
enum Ask {
    /// How the session stands, with so many keys of this thread in use.
    Standing(Standing, u64),
    /// A message of a handshake, and where it came from.
    Message(SocketAddr, HandshakeDatagram),
}

/// What the thread tells the loop.
#[derive(Debug)]
pub(super) struct Told {
    /// Where its datagram goes: whence it was asked, or to the peer.
    pub(super) to: Option<SocketAddr>,
    pub(super) outcome: Outcome,
}

/// The loop's end of the thread.
#[derive(Debug)]
pub(super) struct Handshakes {
    asks: rtrb::Producer<Ask>,
    told: rtrb::Consumer<Told>,
    is_over: Arc<AtomicBool>,
    thread: Option<JoinHandle<Rejections>>,
    /// Keys that the loop has had.
    keys: u64,
    /// Messages that found the thread busy.
    dropped: u64,
}

impl Handshakes {
    pub(super) fn start(settings: SessionSettings, key: PreSharedKey) -> Result<Self, StartError> {
        let mut entropy = SystemEntropy::new();
        let handshake = Handshake::new(settings, key, &mut entropy).map_err(EndError::from)?;
        let (asks, to_answer) = rtrb::RingBuffer::new(WAITING);
        let (answers, told) = rtrb::RingBuffer::new(WAITING);
        let is_over = Arc::new(AtomicBool::new(false));
        let over = Arc::clone(&is_over);
        let thread = std::thread::Builder::new()
            .name("haptether-keys".into())
            .spawn(move || answer(handshake, entropy, to_answer, answers, &over))?;
        Ok(Self { asks, told, is_over, thread: Some(thread), keys: 0, dropped: 0 })
    }

    /// Tells how the session stands, unless the thread has not come to what it was told before.
    pub(super) fn tell(&mut self, standing: Standing) {
        if self.asks.slots() == WAITING {
            let _ = self.asks.push(Ask::Standing(standing, self.keys));
        }
    }

    /// Hands over a message, behind how the session stands now.
    pub(super) fn hand_over(&mut self, standing: Standing, from: SocketAddr, message: HandshakeDatagram) {
        if self.asks.slots() < 2 {
            self.dropped += 1;
            return;
        }
        let _ = self.asks.push(Ask::Standing(standing, self.keys));
        let _ = self.asks.push(Ask::Message(from, message));
    }

    /// The next answer, if there is one.
    pub(super) fn next(&mut self) -> Option<Told> {
        let told = self.told.pop().ok()?;
        self.keys += u64::from(told.outcome.keys.is_some());
        Some(told)
    }

    /// Ends the thread; gives what it did not take, and what it was too busy for.
    pub(super) fn end(&mut self) -> Rejections {
        self.is_over.store(true, Ordering::Relaxed);
        let refused = self.thread.take().and_then(|thread| thread.join().ok()).unwrap_or_default();
        refused.with(Rejection::Busy, std::mem::take(&mut self.dropped))
    }
}

impl Drop for Handshakes {
    fn drop(&mut self) {
        self.end();
    }
}

/// Why a live run has no session.
#[derive(Debug, thiserror::Error)]
pub enum StartError {
    /// Settings that make none, or no randomness.
    #[error(transparent)]
    Session(#[from] EndError),
    /// No thread or socket.
    #[error(transparent)]
    System(#[from] io::Error),
}

fn answer(
    mut handshake: Handshake,
    mut entropy: SystemEntropy,
    mut asks: rtrb::Consumer<Ask>,
    mut answers: rtrb::Producer<Told>,
    is_over: &AtomicBool,
) -> Rejections {
    let mut standing = None;
    let mut given = 0;
    while !is_over.load(Ordering::Relaxed) {
        while let Ok(ask) = asks.pop() {
            match (ask, standing) {
                // What was said before the newest keys came into use would have this thread ask for them again.
                (Ask::Standing(newer, keys), _) => standing = (keys == given).then_some(newer),
                (Ask::Message(from, message), Some(known)) => {
                    let now_ns = clock::now_ns();
                    if let Ok(outcome) = handshake.receive(now_ns, &message, &known, &mut entropy) {
                        let has_keys = outcome.keys.is_some();
                        // A full ring means that the loop does not run: nobody waits for keys.
                        if answers.push(Told { to: Some(from), outcome }).is_ok() && has_keys {
                            given += 1;
                            standing = None;
                        }
                    }
                }
                (Ask::Message(..), None) => {}
            }
        }
        if let Some(standing) = &standing {
            match handshake.poll(clock::now_ns(), standing, &mut entropy) {
                Ok(Some(hello)) => {
                    let outcome = Outcome { reply: Some(hello), ..Outcome::default() };
                    let _ = answers.push(Told { to: None, outcome });
                }
                // Without randomness there are no keys; another try may find some.
                Ok(None) | Err(HandshakeError::Entropy(_) | HandshakeError::Noise) => {}
            }
        }
        std::thread::sleep(POLL);
    }
    handshake.rejections()
}

/// What happened to the session of a live run, for people.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SecurityEvent {
    /// Of the session.
    Session(SessionEvent),
    /// Of a handshake.
    Handshake(HandshakeEvent),
    /// A person at the slave may not let another master begin yet.
    StillHeard(StillHeard),
}

impl std::fmt::Display for SecurityEvent {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Session(SessionEvent::Began { .. }) => {
                formatter.write_str("secure session: frames are encrypted and authenticated")
            }
            Self::Session(SessionEvent::Rekeyed { epoch }) => write!(formatter, "new keys, the {epoch}. renewal"),
            Self::Session(SessionEvent::Released) => formatter.write_str("the peer has ended the session"),
            Self::Session(SessionEvent::Expired) => {
                formatter.write_str("the keys have grown too old, and no others came")
            }
            Self::Session(SessionEvent::Forgeries) => {
                formatter.write_str("more forgeries than the keys bear: the session is over")
            }
            Self::Session(SessionEvent::TakenOver) => formatter.write_str("another master may begin"),
            Self::Handshake(HandshakeEvent::SecondMaster { .. }) => formatter.write_str(
                "another master with the key was refused: one has the lease, until it ends or has been silent for 2 s \
                 and a person here allows another (SIGUSR1)",
            ),
            Self::Handshake(HandshakeEvent::Refused { verdict: Verdict::Leased, .. }) => {
                formatter.write_str("refused: another master has the lease of this slave")
            }
            Self::Handshake(HandshakeEvent::Refused { payload_length, .. }) => {
                write!(formatter, "refused: the peer's frames have {payload_length} bytes, so another number of axes")
            }
            Self::StillHeard(still) => {
                write!(formatter, "no other master yet: this one was heard {:.1} s ago, must be silent for {:.0} s",
                    still.ago_ns as f64 * 1e-9, still.silence_ns as f64 * 1e-9)
            }
        }
    }
}
