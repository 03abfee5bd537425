//! The secure session between the two sides: bytes in, payloads and events out.
//!
//! Two halves, so that no tick waits for a handshake:
//!
//! - [`Session`] seals and opens datagrams within a tick, and allocates nothing in doing so;
//! - [`Handshake`] makes keys, off the tick, and is asked by [`Handshake::poll`] and [`Handshake::receive`].
//!
//! [`SessionEnd`] is both on one thread. None of them owns a clock, a socket or randomness. What goes over the wire, byte by byte, and why it is so, is in
//! `docs/protocol.md`.
//!
//! In the words of a caller:
//!
//! ```text
//! each datagram:  session.open(now, bytes)?
//!                   Payload    -> the frame inside
//!                   Handshake  -> handshake.receive(now, from, bytes, &session.standing(now), entropy)?
//!                                   reply -> send it;  keys -> session.install(now, keys)
//!                   Release    -> the peer has gone
//! each tick:      session.advance(now); session.seal(now, frame, buffer)? -> send it
//! each 10 ms:     handshake.poll(now, &session.standing(now), entropy)? -> send it
//! ```

mod aead;
mod budget;
mod end;
mod entropy;
mod epochs;
mod handshake;
mod header;
mod initiator;
mod keys;
mod noise;
mod rejection;
mod report;
mod responder;
mod secure;
mod settings;
mod told;
mod window;

pub(crate) use budget::{Bucket, Shares};
pub use end::{EndError, Received, SessionEnd};
pub use entropy::{Entropy, NoEntropy, SeededEntropy, SystemEntropy};
pub use handshake::{Handshake, HandshakeDatagram, HandshakeEvent, Outcome};
pub(crate) use handshake::{message_is_answer, session_and_epoch};
pub use header::{
    HANDSHAKE_LENGTH, MAX_DATAGRAM, SESSION_HEADER, SESSION_MAGIC, SESSION_VERSION, sealed_length,
};
pub use keys::{Epoch, KeyError, PreSharedKey};
pub use noise::HandshakeError;
pub use rejection::{Rejection, Rejections};
pub use report::{Incoming, SealError, SessionEvent, Standing, StillHeard};
pub use secure::Session;
pub use settings::{SessionSettings, SettingsError};
pub use told::Verdict;
pub use window::{Arrival, ReplayWindow};
