//! Handshakes, off the tick: they cost a millisecond and allocate.
//!
//! [`Handshake`] holds the shared key and makes keys; [`super::Session`] holds the keys and seals. Between them go
//! only values: a [`Standing`] and a datagram one way, an [`Outcome`] the other. So they may live on two threads.

use std::net::SocketAddr;

use super::{
    entropy::Entropy,
    header::{EPHEMERAL, HANDSHAKE_LENGTH, Header, Kind, SESSION_HEADER, write_mac},
    initiator::Initiator,
    keys::{Epoch, EpochId, MacKey, PreSharedKey},
    noise::{HandshakeError, MESSAGE},
    rejection::{Rejection, Rejections},
    report::Standing,
    responder::Responder,
    settings::SessionSettings,
    told::Verdict,
};
use crate::wire::Role;

/// A handshake message with its header.
pub type HandshakeDatagram = [u8; HANDSHAKE_LENGTH];

/// What came of a handshake message.
#[derive(Debug, Default)]
pub struct Outcome {
    /// To send: back, or to the peer.
    pub reply: Option<HandshakeDatagram>,
    /// Whether it goes to where the peer's frames come from, not whence it was asked: who repeats the peer's message
    /// from elsewhere does not draw the answer away.
    pub to_peer: bool,
    /// For [`super::Session::install`].
    pub keys: Option<Epoch>,
    /// To tell people.
    pub event: Option<HandshakeEvent>,
}

/// What people should know of a handshake.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum HandshakeEvent {
    /// There will be no session. Told at both sides when the payloads differ, at the master for any reason.
    Refused {
        /// Why.
        verdict: Verdict,
        /// Bytes of the peer's payloads.
        payload_length: u16,
    },
    /// Told at the slave: another master with the key was refused, because one holds the lease. It lives: it has sent back
    /// what the first refusal gave it, which no recorded message does.
    SecondMaster {
        /// What that master drew when it started.
        run: u64,
    },
}

/// Puts a header before a handshake message and its MAC behind it.
pub(super) fn message(kind: Kind, id: EpochId, said: &[u8; MESSAGE], mac: &MacKey) -> HandshakeDatagram {
    let mut datagram = [0; HANDSHAKE_LENGTH];
    let header = Header { kind, epoch: id.epoch, session: id.session, counter: 0 };
    datagram[..SESSION_HEADER].copy_from_slice(&header.to_bytes());
    datagram[SESSION_HEADER..SESSION_HEADER + MESSAGE].copy_from_slice(said);
    write_mac(&mut datagram, mac);
    datagram
}

/// Session and epoch in the header of a handshake datagram.
pub(crate) fn session_and_epoch(datagram: &HandshakeDatagram) -> (u64, u32) {
    let [_, _, _, _, e0, e1, e2, e3, s0, s1, s2, s3, s4, s5, s6, s7, ..] = *datagram;
    (u64::from_le_bytes([s0, s1, s2, s3, s4, s5, s6, s7]), u32::from_le_bytes([e0, e1, e2, e3]))
}

/// Whether a handshake datagram is the slave's.
pub(crate) fn message_is_answer(datagram: &HandshakeDatagram) -> bool {
    datagram[3] == Kind::Answer.byte()
}

/// The ephemeral key of a handshake datagram, and all of the message between header and MAC.
pub(super) fn parts(datagram: &[u8]) -> (&[u8], &[u8]) {
    (
        &datagram[SESSION_HEADER..SESSION_HEADER + EPHEMERAL],
        &datagram[SESSION_HEADER..SESSION_HEADER + MESSAGE],
    )
}

#[allow(clippy::large_enum_variant)] // one for a whole run
#[derive(Debug)]
enum Side {
    Master(Initiator),
    Slave(Responder),
}

/// The handshakes of one side.
#[derive(Debug)]
pub struct Handshake {
    role: Role,
    side: Side,
    rejections: Rejections,
}

impl Handshake {
    /// The handshakes of the side of `settings`, with the shared key; `entropy` marks this run of it.
    pub fn new(
        settings: SessionSettings,
        key: PreSharedKey,
        entropy: &mut dyn Entropy,
    ) -> Result<Self, HandshakeError> {
        let run = entropy.number()?;
        let side = match settings.role {
            Role::Master => Side::Master(Initiator::new(settings, key, run)),
            Role::Slave => Side::Slave(Responder::new(settings, key, run)),
        };
        Ok(Self { role: settings.role, side, rejections: Rejections::default() })
    }

    /// Takes a datagram that [`super::Session::open`] handed on, and that came from `from`. One that is refused changes
    /// nothing but a count.
    pub fn receive(
        &mut self,
        now_ns: u64,
        from: SocketAddr,
        datagram: &[u8],
        standing: &Standing,
        entropy: &mut dyn Entropy,
    ) -> Result<Outcome, Rejection> {
        let outcome = Header::read(datagram, self.role, HANDSHAKE_LENGTH).and_then(|header| {
            let datagram: &HandshakeDatagram = datagram.try_into().map_err(|_| Rejection::Length)?;
            match &mut self.side {
                Side::Master(initiator) => initiator.receive(now_ns, &header, datagram, standing),
                Side::Slave(responder) => {
                    responder.receive(now_ns, from, &header, datagram, standing, entropy)
                }
            }
        });
        outcome.inspect_err(|rejection| self.rejections.count(*rejection))
    }

    /// The message to send at `now_ns`, if any: the first of a handshake, or the same again. Never at the slave.
    ///
    /// To be asked each 10 ms or so.
    pub fn poll(
        &mut self,
        now_ns: u64,
        standing: &Standing,
        entropy: &mut dyn Entropy,
    ) -> Result<Option<HandshakeDatagram>, HandshakeError> {
        match &mut self.side {
            Side::Master(initiator) => initiator.poll(now_ns, standing, entropy),
            Side::Slave(_) => Ok(None),
        }
    }

    /// Handshake messages not taken, by cause.
    pub fn rejections(&self) -> Rejections {
        self.rejections
    }
}
