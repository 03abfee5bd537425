//! What stands between a live side and its socket: a session that seals and opens, and keys from another thread.

use std::net::SocketAddr;

#[cfg(target_os = "linux")]
use rustix::process::{DumpableBehavior, set_dumpable_behavior};
use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};

use super::{
    handshakes::{Handshakes, SecurityEvent, StartError},
    route::Heard,
};
use crate::{
    channel::sealed_frame,
    link::RejectReason,
    session::{
        Incoming, MAX_DATAGRAM, PreSharedKey, Rejection, Rejections, SealError, Session, SessionSettings,
    },
    side::Side,
    wire::{Role, hears_peer},
};

/// How the frames of a live run travel.
#[derive(Debug)]
pub enum Security {
    /// Encrypted and authenticated with the key that both sides share.
    Secure(PreSharedKey),
    /// In the clear: anybody who can send can steer.
    Insecure,
}

/// Shortest period of a peer in ns that the window against replay holds 2 s of.
const PEER_PERIOD_NS: u64 = 100_000;
/// How often the handshakes are told how the session stands, in ticks.
const TELL_EVERY: u64 = 4;
/// Answers of the handshakes that one tick takes.
const MAX_ANSWERS: usize = 4;
/// How often a release is sent after the last frames: datagrams get lost.
pub(super) const RELEASES: usize = 5;

/// No core file of this process, and no debugger of another user's: keys lie in its memory from here on.
fn forbid_dumps() {
    let no_core = Rlimit { current: Some(0), ..getrlimit(Resource::Core) };
    // Where the system has neither, nothing is lost but this.
    let _ = setrlimit(Resource::Core, no_core);
    #[cfg(target_os = "linux")]
    let _ = set_dumpable_behavior(DumpableBehavior::NotDumpable);
}

/// The session of a live side.
#[derive(Debug)]
pub(super) struct LiveChannel {
    session: Session,
    handshakes: Option<Handshakes>,
    ticks: u64,
}

impl LiveChannel {
    pub(super) fn start<S: Side>(role: Role, period_ns: u64, security: Security) -> Result<Self, StartError> {
        let settings = SessionSettings::new(role, S::FRAME_LENGTH, period_ns.min(PEER_PERIOD_NS));
        let cannot = crate::session::EndError::from;
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

    pub(super) fn is_secure(&self) -> bool {
        self.session.is_secure()
    }

    /// Opens a datagram in place and hands what it holds to the side.
    pub(super) fn receive(
        &mut self,
        now_ns: u64,
        from: SocketAddr,
        datagram: &mut [u8],
        side: &mut impl Side,
    ) -> Heard {
        match self.session.open(now_ns, datagram) {
            Ok(Incoming::Payload { payload, .. }) => match side.receive(now_ns, payload) {
                Ok(()) => return Heard::News { is_answered: hears_peer(payload) },
                Err(RejectReason::Late(_) | RejectReason::Duplicate(_)) => return Heard::Again,
                Err(_) => {}
            },
            Ok(Incoming::Handshake { datagram, is_renewal }) => {
                if let (Some(handshakes), Ok(message)) = (&mut self.handshakes, datagram.try_into()) {
                    handshakes.hand_over(now_ns, &self.session, from, message, is_renewal);
                }
            }
            Err(Rejection::Repeated) => return Heard::Again,
            Ok(Incoming::Release) => side.peer_ended(),
            // A rejection is counted by the session.
            Err(_) => {}
        }
        Heard::Nothing
    }

    /// Lets time pass, and takes new keys; gives each handshake to send, and where to, to `send`.
    pub(super) fn advance(
        &mut self,
        now_ns: u64,
        mut send: impl FnMut(Option<SocketAddr>, &[u8]),
        mut tell: impl FnMut(SecurityEvent),
    ) {
        self.session.advance(now_ns);
        if let Some(handshakes) = &mut self.handshakes {
            for _ in 0..MAX_ANSWERS {
                let Some(told) = handshakes.next() else { break };
                if let Some(datagram) = told.outcome.reply {
                    send(told.to, &datagram);
                }
                if let Some(keys) = told.outcome.keys {
                    self.session.install(now_ns, keys);
                }
                if let Some(event) = told.outcome.event {
                    tell(SecurityEvent::Handshake(event));
                }
            }
            if self.ticks.is_multiple_of(TELL_EVERY) {
                handshakes.tell(self.session.standing(now_ns));
            }
            self.ticks += 1;
            if handshakes.has_died() {
                tell(SecurityEvent::KeysEnd);
            }
        }
        while let Some(event) = self.session.poll_event() {
            tell(SecurityEvent::Session(event));
        }
    }

    /// The side's next frame as it goes over the network; none while there are no keys.
    pub(super) fn send<'a>(
        &mut self,
        now_ns: u64,
        side: &mut impl Side,
        buffer: &'a mut [u8; MAX_DATAGRAM],
    ) -> Option<&'a [u8]> {
        sealed_frame(&mut self.session, now_ns, side, buffer)
    }

    /// A datagram that ends the session at the peer.
    pub(super) fn release<'a>(
        &mut self,
        now_ns: u64,
        buffer: &'a mut [u8; MAX_DATAGRAM],
    ) -> Result<&'a [u8], SealError> {
        self.session.release(now_ns, buffer)
    }

    /// A person at this side lets another master begin.
    pub(super) fn allow_takeover(&mut self, now_ns: u64, mut tell: impl FnMut(SecurityEvent)) {
        if let Err(still) = self.session.allow_takeover(now_ns) {
            tell(SecurityEvent::StillHeard(still));
        }
    }

    /// Ends the handshakes; gives what was not taken, by cause.
    pub(super) fn end(&mut self) -> Rejections {
        let more = self.handshakes.as_mut().map(Handshakes::end).unwrap_or_default();
        self.session.rejections() + more
    }
}
