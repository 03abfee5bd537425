//! Secure session between the two sides: bytes in, payloads and events out.
//!
//! It has two halves, so that no tick waits for a handshake:
//!
//! - [`Session`] seals and opens datagrams within a tick, without allocation.
//! - [`Handshake`] makes keys, off the tick; [`Handshake::poll`] and [`Handshake::receive`] drive it.
//!
//! [`SessionEnd`] runs both halves on one thread. None of the three owns a clock, a socket or a source of
//! randomness. `docs/protocol.md` describes the bytes on the wire and the reasons for them.
//!
//! [`Session::status`] returns the state of the session that the handshake needs.
//!
//! Calls:
//!
//! ```text
//! each datagram:  session.open(now, bytes)?
//!                   Payload    -> the frame inside
//!                   Handshake  -> handshake.receive(now, from, bytes, &session.status(now), entropy)?
//!                                   reply -> send it;  keys -> session.install(now, keys)
//!                   Release    -> the peer has ended the session
//! each tick:      session.advance(now); session.seal(now, frame, buffer)? -> send it
//! each 10 ms:     handshake.poll(now, &session.status(now), entropy)? -> send it
//! ```

mod budget;
mod end;
mod epochs;
mod handshake;
mod keys;
mod noise;
#[expect(clippy::module_inception, reason = "the room is named after what it holds")]
mod session;
mod settings;
mod wire;

pub(crate) use budget::{Bucket, Shares};
pub use end::{EndError, Received, SessionEnd};
pub use epochs::{Arrival, ReplayWindow};
pub use handshake::{Handshake, HandshakeDatagram, HandshakeEvent, Outcome};
pub(crate) use handshake::{message_is_answer, session_and_epoch};
pub use keys::{Epoch, KeyError, PreSharedKey};
pub use noise::{Entropy, HandshakeError, NoEntropy, SeededEntropy, SystemEntropy};
pub use session::{Incoming, SealError, Session, SessionEvent, SessionStatus, StillHeard};
pub use settings::{SessionSettings, SettingsError};
pub(crate) use wire::is_handshake;
pub use wire::{
    HANDSHAKE_LENGTH, HandshakeDecision, MAX_DATAGRAM, Rejection, Rejections, SESSION_HEADER, SESSION_MAGIC,
    SESSION_VERSION, sealed_length,
};
