//! Datagrams that are not from the peer. They couple nobody; the operator sees the first and every tenfold count.

use std::net::SocketAddr;

use crate::{
    session::{Rejection, SESSION_MAGIC, SESSION_VERSION, is_handshake},
    wire::{MAGIC, VERSION},
};

/// Evidence that a datagram is not from the peer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stranger {
    /// From another address than a known peer's.
    Elsewhere,
    /// A handshake of another key.
    Key,
    /// Another version of the protocol.
    Version,
    /// Unencrypted, and this side has a key.
    Clear,
    /// Encrypted, and this side has no key.
    Encrypted,
}

impl Stranger {
    const COUNT: usize = 5;
}

pub(super) struct Header {
    magic: [u8; 2],
    version: u8,
    is_handshake: bool,
}

/// Header of a datagram; `None` if too short.
pub(super) fn header_of(datagram: &[u8]) -> Option<Header> {
    let &[first, second, version, ..] = datagram else { return None };
    Some(Header { magic: [first, second], version, is_handshake: is_handshake(datagram) })
}

/// Evidence in a refused datagram that it is not from the peer.
pub(super) fn stranger(
    header: Option<&Header>,
    is_secure: bool,
    rejection: Option<Rejection>,
) -> Option<Stranger> {
    let header = header?;
    match (header.magic, is_secure) {
        (SESSION_MAGIC, true) if header.version != SESSION_VERSION => Some(Stranger::Version),
        (SESSION_MAGIC, true) => {
            let is_key = rejection == Some(Rejection::Forged) && header.is_handshake;
            is_key.then_some(Stranger::Key)
        }
        (SESSION_MAGIC, false) => Some(Stranger::Encrypted),
        (MAGIC, true) => Some(Stranger::Clear),
        (MAGIC, false) => (header.version != VERSION).then_some(Stranger::Version),
        _ => None,
    }
}

/// Report to the operator on datagrams of one kind.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct StrangerReport {
    /// Evidence.
    pub kind: Stranger,
    /// Number of datagrams.
    pub count: u64,
    /// Sender of the last.
    pub from: SocketAddr,
}

impl std::fmt::Display for StrangerReport {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { kind, count, from } = self;
        let (are, what) = match kind {
            Stranger::Elsewhere => (
                "from another address than the peer's",
                "if it is the peer, name that address as --peer, or have it listen at the one named",
            ),
            Stranger::Key => ("of another key", "both sides must have the same key file, --key"),
            Stranger::Version => {
                ("of another version of the protocol", "install the same Haptether on both sides")
            }
            Stranger::Clear => {
                ("in the clear", "this side has a key: give --key there, too, or --insecure on both sides")
            }
            Stranger::Encrypted => {
                ("encrypted", "this side has no key: give --key here, too, or --insecure on both sides")
            }
        };
        let plural = if *count == 1 { "" } else { "s" };
        write!(formatter, "ignored: {count} datagram{plural} {are}, the last from {from}; {what}")
    }
}

/// Counts of each kind, and reports not read yet.
#[derive(Debug, Default)]
pub(super) struct Strangers {
    counts: [u64; Stranger::COUNT],
    waiting: [Option<StrangerReport>; Stranger::COUNT],
}

impl Strangers {
    pub(super) fn count(&mut self, kind: Stranger, from: SocketAddr) {
        let count = &mut self.counts[kind as usize];
        *count += 1;
        // The first, the tenth, the hundredth: a flood does not fill the screen.
        if 10_u64.checked_pow(count.ilog10()) == Some(*count) {
            self.waiting[kind as usize] = Some(StrangerReport { kind, count: *count, from });
        }
    }

    pub(super) fn poll(&mut self) -> Option<StrangerReport> {
        self.waiting.iter_mut().find_map(Option::take)
    }

    pub(super) fn count_of(&self, kind: Stranger) -> u64 {
        self.counts[kind as usize]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::session::HANDSHAKE_LENGTH;

    #[test]
    fn a_header_tells_key_and_version() {
        let session = [&SESSION_MAGIC[..], &[SESSION_VERSION, 1]].concat();
        let frame = [&MAGIC[..], &[VERSION, 1]].concat();
        let of = |bytes: &[u8], length: usize| {
            let mut datagram = bytes.to_vec();
            datagram.resize(length, 0);
            header_of(&datagram)
        };
        let newer = |bytes: &[u8]| [bytes[0], bytes[1], bytes[2] + 1, bytes[3]];
        let forged = Some(Rejection::Forged);
        for (header, is_secure, rejection, expected) in [
            (of(&session, HANDSHAKE_LENGTH), true, forged, Some(Stranger::Key)),
            (of(&session, HANDSHAKE_LENGTH), true, Some(Rejection::Replayed), None),
            // Damaged datagrams of the current session.
            (of(&session, 200), true, forged, None),
            (of(&[&SESSION_MAGIC[..], &[SESSION_VERSION, 3]].concat(), HANDSHAKE_LENGTH), true, forged, None),
            (of(&newer(&session), 77), true, Some(Rejection::Length), Some(Stranger::Version)),
            (of(&session, 200), false, Some(Rejection::Length), Some(Stranger::Encrypted)),
            (of(&frame, 160), true, Some(Rejection::Length), Some(Stranger::Clear)),
            (of(&newer(&frame), 160), false, None, Some(Stranger::Version)),
            (of(&newer(&frame), 99), false, Some(Rejection::Length), Some(Stranger::Version)),
            (of(&frame, 160), false, None, None),
            (of(b"GET / HTTP", 10), true, Some(Rejection::Length), None),
            (of(b"", 2), true, Some(Rejection::Length), None),
        ] {
            assert_eq!(stranger(header.as_ref(), is_secure, rejection), expected);
        }
    }

    #[test]
    fn every_tenfold_is_reported() {
        let (mut strangers, from) = (Strangers::default(), SocketAddr::from(([192, 0, 2, 1], 7)));
        let mut told = Vec::new();
        for _ in 0..5000 {
            strangers.count(Stranger::Key, from);
            told.extend(strangers.poll().map(|report| report.count));
        }
        assert_eq!(told, [1, 10, 100, 1000]);
        assert_eq!((strangers.count_of(Stranger::Key), strangers.count_of(Stranger::Elsewhere)), (5000, 0));
    }
}
