//! Both halves of one end on one thread: for virtual time, tests, and slow loops.

use std::net::SocketAddr;

use super::{
    epochs::Arrival,
    handshake::{Handshake, HandshakeDatagram, HandshakeEvent},
    keys::{KeyError, PreSharedKey},
    noise::{Entropy, HandshakeError},
    session::{Incoming, Session},
    settings::{SessionSettings, SettingsError},
    wire::{Rejection, Rejections},
};

/// Result of a datagram.
#[derive(Debug, PartialEq, Eq)]
pub enum Received<'a> {
    /// A payload sealed by the peer.
    Payload {
        /// Bytes of the payload.
        payload: &'a [u8],
        /// Position of its counter relative to earlier datagrams.
        arrival: Arrival,
    },
    /// Next datagram of the handshake, to be sent.
    Reply(HandshakeDatagram),
    /// Nothing to do; the events may have news.
    Nothing,
}

/// Failure to build an end.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum EndError {
    /// Invalid settings.
    #[error(transparent)]
    Settings(#[from] SettingsError),
    /// No randomness.
    #[error(transparent)]
    Handshake(#[from] HandshakeError),
    /// Invalid shared key.
    #[error(transparent)]
    Key(#[from] KeyError),
}

/// [`Session`] with its [`Handshake`].
#[derive(Debug)]
pub struct SessionEnd {
    /// Session, which seals and opens.
    pub session: Session,
    handshake: Option<Handshake>,
    event: Option<HandshakeEvent>,
}

impl SessionEnd {
    /// Build an end that shares `key` with its peer.
    pub fn secure(
        settings: SessionSettings,
        key: PreSharedKey,
        entropy: &mut dyn Entropy,
    ) -> Result<Self, EndError> {
        let session = Session::secure(settings, &key)?;
        Ok(Self { session, handshake: Some(Handshake::new(settings, key, entropy)?), event: None })
    }

    /// Build an end without security: see [`Session::insecure`].
    pub fn insecure(settings: SessionSettings) -> Result<Self, EndError> {
        Ok(Self { session: Session::insecure(settings)?, handshake: None, event: None })
    }

    /// Take a datagram that arrived at `now_ns`; it is opened in place.
    pub fn receive<'a>(
        &mut self,
        now_ns: u64,
        datagram: &'a mut [u8],
        entropy: &mut dyn Entropy,
    ) -> Result<Received<'a>, Rejection> {
        self.receive_from(now_ns, SocketAddr::from(([0; 4], 0)), datagram, entropy)
    }

    /// Take a datagram from the address `from`. Each address has its share of the answers to handshakes.
    pub fn receive_from<'a>(
        &mut self,
        now_ns: u64,
        from: SocketAddr,
        datagram: &'a mut [u8],
        entropy: &mut dyn Entropy,
    ) -> Result<Received<'a>, Rejection> {
        match self.session.open(now_ns, datagram)? {
            Incoming::Payload { payload, arrival } => Ok(Received::Payload { payload, arrival }),
            Incoming::Release => Ok(Received::Nothing),
            Incoming::Handshake { datagram, .. } => {
                let status = self.session.status(now_ns);
                let handshake = self.handshake.as_mut().ok_or(Rejection::Kind)?;
                let outcome = handshake.receive(now_ns, from, datagram, &status, entropy)?;
                if let Some(keys) = outcome.keys {
                    self.session.install(now_ns, keys);
                }
                self.event = outcome.event.or(self.event);
                Ok(outcome.reply.map_or(Received::Nothing, Received::Reply))
            }
        }
    }

    /// Advance the time; return a handshake datagram to send, if one is due.
    pub fn poll(
        &mut self,
        now_ns: u64,
        entropy: &mut dyn Entropy,
    ) -> Result<Option<HandshakeDatagram>, HandshakeError> {
        self.session.advance(now_ns);
        let status = self.session.status(now_ns);
        match &mut self.handshake {
            Some(handshake) => handshake.poll(now_ns, &status, entropy),
            None => Ok(None),
        }
    }

    /// Take the newest event of the handshake.
    pub fn poll_event(&mut self) -> Option<HandshakeEvent> {
        self.event.take()
    }

    /// Rejected datagrams, by cause.
    pub fn rejections(&self) -> Rejections {
        let more = self.handshake.as_ref().map(Handshake::rejections).unwrap_or_default();
        self.session.rejections() + more
    }
}
