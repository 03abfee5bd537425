//! Channel between a live side and its socket: a session, with keys from another thread.

use haptether_netsim::ReplyAddress;
#[cfg(target_os = "linux")]
use rustix::process::{DumpableBehavior, set_dumpable_behavior};
use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};

use super::{
    handshakes::{Handshakes, SecurityEvent, StartError},
    socket::Received,
    strangers::{header_of, stranger},
};
use crate::{
    link::{LinkTime, RejectReason},
    session::{EndError, Incoming, PreSharedKey, Rejection, Rejections, Session, SessionSettings},
    side::Side,
    wire::{FrameLayout, Role, hears_peer},
};

/// Protection of the frames of a live run.
#[derive(Debug)]
pub enum Security {
    /// Encrypted and authenticated with the shared key.
    Secure(PreSharedKey),
    /// Unprotected: anybody who can send can steer.
    Insecure,
}

/// Shortest peer period in ns for which the replay window holds 2 s.
const PEER_PERIOD_NS: u64 = 100_000;
/// Ticks between reports of the session's status.
const STATUS_EVERY: u64 = 4;
/// Answers of the handshakes taken per tick.
const MAX_ANSWERS: usize = 4;
/// Releases sent at the end, since datagrams get lost.
pub(super) const RELEASES: usize = 5;

/// Forbids core files and other users' debuggers: keys are in memory.
fn forbid_dumps() {
    let no_core = Rlimit { current: Some(0), ..getrlimit(Resource::Core) };
    // Optional on systems without it.
    let _ = setrlimit(Resource::Core, no_core);
    #[cfg(target_os = "linux")]
    let _ = set_dumpable_behavior(DumpableBehavior::NotDumpable);
}

/// Session of a live side.
#[derive(Debug)]
pub(super) struct LiveChannel {
    pub(super) session: Session,
    handshakes: Option<Handshakes>,
    ticks: u64,
}

impl LiveChannel {
    /// Create a session for a layout; a secure one has no keys yet.
    pub(super) fn start(
        role: Role,
        layout: FrameLayout,
        period_ns: u64,
        security: Security,
    ) -> Result<Self, StartError> {
        let settings = SessionSettings::of_frames(role, layout, period_ns.min(PEER_PERIOD_NS));
        let cannot = EndError::from;
        Ok(match security {
            Security::Secure(key) => {
                forbid_dumps();
                Self {
                    session: Session::secure(settings, &key).map_err(cannot)?,
                    handshakes: Some(Handshakes::start(settings, key)?),
                    ticks: 0,
                }
            }
            Security::Insecure => {
                Self { session: Session::insecure(settings).map_err(cannot)?, handshakes: None, ticks: 0 }
            }
        })
    }

    /// Open a datagram in place for the side.
    pub(super) fn receive(
        &mut self,
        time: LinkTime,
        reply_address: ReplyAddress,
        datagram: &mut [u8],
        side: &mut (impl Side + ?Sized),
    ) -> Received {
        let now_ns = time.tick_ns;
        // Read first: opening modifies encrypted bytes.
        let (header, is_secure) = (header_of(datagram), self.session.is_secure());
        let unknown = |rejection| {
            stranger(header.as_ref(), is_secure, rejection).map_or(Received::Nothing, Received::Stranger)
        };
        match self.session.open(now_ns, datagram) {
            Ok(Incoming::Payload { payload, .. }) => match side.receive(time, payload) {
                Ok(()) => return Received::Fresh { is_answered: hears_peer(payload) },
                Err(RejectReason::Late(_) | RejectReason::Duplicate(_)) => return Received::Repeat,
                Err(_) => return unknown(None),
            },
            Ok(Incoming::Handshake { datagram, is_renewal }) => {
                if let (Some(handshakes), Ok(message)) = (&mut self.handshakes, datagram.try_into()) {
                    handshakes.hand_over(now_ns, &self.session, reply_address, message, is_renewal);
                }
            }
            Err(Rejection::Repeated) => return Received::Repeat,
            Ok(Incoming::Release) => side.exchange_mut().peer_ended(),
            // The session counts a rejection.
            Err(rejection) => return unknown(Some(rejection)),
        }
        Received::Nothing
    }

    /// Advance time and take new keys. Passes handshakes with destination to `send`, events to `report`.
    pub(super) fn advance(
        &mut self,
        now_ns: u64,
        mut send: impl FnMut(Option<ReplyAddress>, &[u8]),
        mut report: impl FnMut(SecurityEvent),
    ) {
        self.session.advance(now_ns);
        if let Some(handshakes) = &mut self.handshakes {
            for _ in 0..MAX_ANSWERS {
                let Some(answer) = handshakes.next() else { break };
                if let Some(datagram) = answer.outcome.reply {
                    send(answer.to, &datagram);
                }
                if let Some(keys) = answer.outcome.keys {
                    self.session.install(now_ns, keys);
                }
                if let Some(event) = answer.outcome.event {
                    report(SecurityEvent::Handshake(event));
                }
            }
            if self.ticks.is_multiple_of(STATUS_EVERY) {
                handshakes.set_status(self.session.status(now_ns));
            }
            self.ticks += 1;
            if handshakes.has_died() {
                report(SecurityEvent::KeysEnd);
            }
        }
        while let Some(event) = self.session.poll_event() {
            report(SecurityEvent::Session(event));
        }
    }

    /// End the handshakes. Returns the rejections, by cause.
    pub(super) fn end(&mut self) -> Rejections {
        let more = self.handshakes.as_mut().map(Handshakes::end).unwrap_or_default();
        self.session.rejections() + more
    }
}
