//! Bytes of a secure session: header, handshake payload, and causes of rejection.
//!
//! `docs/protocol.md` has the byte tables.

use zerocopy::{
    FromBytes, Immutable, IntoBytes, KnownLayout, Unaligned,
    little_endian::{U32, U64},
};

use super::keys::{MAC, MacKey, TAG};
use crate::wire::{FrameForm, MAX_FRAME, Role};

/// Magic bytes at the start of a datagram of a secure session.
pub const SESSION_MAGIC: [u8; 2] = *b"HS";
/// Version of header and handshake.
pub const SESSION_VERSION: u8 = 2;
/// Bytes of the header.
pub const SESSION_HEADER: usize = 24;
/// Bytes of the encrypted part of a handshake message.
pub(super) const HANDSHAKE_PAYLOAD: usize = 16;
/// Bytes of an ephemeral public key of X25519.
pub(super) const EPHEMERAL: usize = 32;
/// Bytes of either message of a handshake; the answer is never longer than the request.
pub const HANDSHAKE_LENGTH: usize = AUTHENTICATED + MAC;
/// Bytes of a handshake message that its MAC covers: all before the MAC.
const AUTHENTICATED: usize = SESSION_HEADER + EPHEMERAL + HANDSHAKE_PAYLOAD + TAG;
/// Bytes of the longest sealed datagram.
pub const MAX_DATAGRAM: usize = sealed_length(MAX_FRAME);

/// Bytes of a sealed datagram with a payload of `payload` bytes.
pub const fn sealed_length(payload: usize) -> usize {
    SESSION_HEADER + payload + TAG
}

pub(super) fn write_mac(datagram: &mut [u8; HANDSHAKE_LENGTH], key: &MacKey) {
    let (message, mac) = datagram.split_at_mut(AUTHENTICATED);
    mac.copy_from_slice(&key.sign(message));
}

/// Return whether a handshake datagram has a MAC of a holder of the shared key.
pub(super) fn mac_fits(datagram: &[u8], key: &MacKey) -> bool {
    datagram.len() == HANDSHAKE_LENGTH && key.fits(&datagram[..AUTHENTICATED], &datagram[AUTHENTICATED..])
}

/// Return whether a datagram has the length and kind of a handshake message.
pub(crate) fn is_handshake(datagram: &[u8]) -> bool {
    let kind = datagram.get(3).copied().and_then(Kind::from_byte);
    datagram.len() == HANDSHAKE_LENGTH && kind.is_some_and(Kind::is_handshake)
}

/// Kind of a datagram.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    /// First message of a handshake, from the master.
    Hello,
    /// Second message of a handshake, from the slave.
    Answer,
    /// Sealed payload.
    Sealed,
    /// Sealed payload whose sender requests new keys.
    SealedAndDue,
    /// End of the session; sealed, with a payload of zeros.
    Release,
}

impl Kind {
    const fn from_byte(byte: u8) -> Option<Self> {
        match byte {
            1 => Some(Self::Hello),
            2 => Some(Self::Answer),
            3 => Some(Self::Sealed),
            4 => Some(Self::SealedAndDue),
            5 => Some(Self::Release),
            _ => None,
        }
    }

    pub(super) const fn byte(self) -> u8 {
        match self {
            Self::Hello => 1,
            Self::Answer => 2,
            Self::Sealed => 3,
            Self::SealedAndDue => 4,
            Self::Release => 5,
        }
    }

    /// Return whether a side of role `to` can receive this kind.
    const fn goes_to(self, to: Role) -> bool {
        match self {
            Self::Hello => matches!(to, Role::Slave),
            Self::Answer => matches!(to, Role::Master),
            Self::Sealed | Self::SealedAndDue | Self::Release => true,
        }
    }

    pub(super) const fn is_handshake(self) -> bool {
        matches!(self, Self::Hello | Self::Answer)
    }
}

#[derive(Clone, Copy, FromBytes, IntoBytes, KnownLayout, Immutable, Unaligned)]
#[repr(C)]
struct Bytes {
    magic: [u8; 2],
    version: u8,
    kind: u8,
    epoch: U32,
    session: U64,
    counter: U64,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Header {
    pub(super) kind: Kind,
    pub(super) epoch: u32,
    pub(super) session: u64,
    pub(super) counter: u64,
}

impl Header {
    pub(super) fn to_bytes(self) -> [u8; SESSION_HEADER] {
        let mut bytes = [0; SESSION_HEADER];
        bytes.copy_from_slice(
            Bytes {
                magic: SESSION_MAGIC,
                version: SESSION_VERSION,
                kind: self.kind.byte(),
                epoch: U32::new(self.epoch),
                session: U64::new(self.session),
                counter: U64::new(self.counter),
            }
            .as_bytes(),
        );
        bytes
    }

    /// Read the header of a datagram that arrived at a side of role `to`: length first, then version and
    /// kind.
    pub(super) fn read(datagram: &[u8], to: Role, sealed: usize) -> Result<Self, Rejection> {
        if datagram.len() != sealed && datagram.len() != HANDSHAKE_LENGTH {
            return Err(Rejection::Length);
        }
        let Ok((bytes, _)) = Bytes::read_from_prefix(datagram) else { return Err(Rejection::Length) };
        if bytes.magic != SESSION_MAGIC || bytes.version != SESSION_VERSION {
            return Err(Rejection::Version);
        }
        let kind = Kind::from_byte(bytes.kind).filter(|kind| kind.goes_to(to)).ok_or(Rejection::Kind)?;
        if kind.is_handshake() != (datagram.len() == HANDSHAKE_LENGTH) {
            return Err(Rejection::Length);
        }
        let header = Self {
            kind,
            epoch: bytes.epoch.get(),
            session: bytes.session.get(),
            counter: bytes.counter.get(),
        };
        // A handshake has no counter: the field is reserved.
        if kind.is_handshake() && header.counter != 0 {
            return Err(Rejection::Counter);
        }
        Ok(header)
    }
}

/// Decision of the slave on a handshake.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum HandshakeDecision {
    /// The keys are valid.
    Accepted,
    /// Another master holds the lease.
    Leased,
    /// The frames of the two sides differ: in kind, axes, parts or version.
    PayloadForm,
}

/// Encrypted part of a handshake message.
///
/// | offset | type | field |
/// |---|---|---|
/// | 0 | `u64` | run: drawn by the sender at its start |
/// | 8 | `u16` | form of its payloads, [`FrameForm`] |
/// | 10 | `u8` | decision: 0 accepted, 1 leased, 2 payload form; 0 in a first message |
/// | 11 | `[u8; 5]` | ticket: drawn by the slave when it refuses another master; echoed by later first messages; else 0 |
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct HandshakePayload {
    pub(super) run: u64,
    pub(super) form: FrameForm,
    pub(super) decision: HandshakeDecision,
    pub(super) ticket: Ticket,
}

/// Random ticket of a refusal. A first message that returns an unused ticket is live: a replay has a used or
/// unknown one.
pub(super) type Ticket = [u8; 5];
/// Ticket before any refusal.
pub(super) const NO_TICKET: Ticket = [0; 5];

impl HandshakePayload {
    pub(super) fn new(run: u64, form: FrameForm, decision: HandshakeDecision) -> Self {
        Self { run, form, decision, ticket: NO_TICKET }
    }

    pub(super) fn with(self, ticket: Ticket) -> Self {
        Self { ticket, ..self }
    }

    pub(super) fn to_bytes(self) -> [u8; HANDSHAKE_PAYLOAD] {
        let mut bytes = [0; HANDSHAKE_PAYLOAD];
        bytes[..8].copy_from_slice(&self.run.to_le_bytes());
        bytes[8..10].copy_from_slice(&self.form.0.to_le_bytes());
        bytes[10] = match self.decision {
            HandshakeDecision::Accepted => 0,
            HandshakeDecision::Leased => 1,
            HandshakeDecision::PayloadForm => 2,
        };
        bytes[11..].copy_from_slice(&self.ticket);
        bytes
    }

    pub(super) fn from_bytes(bytes: [u8; HANDSHAKE_PAYLOAD]) -> Option<Self> {
        let [r0, r1, r2, r3, r4, r5, r6, r7, l0, l1, decision, ticket @ ..] = bytes;
        let decision = match decision {
            0 => HandshakeDecision::Accepted,
            1 => HandshakeDecision::Leased,
            2 => HandshakeDecision::PayloadForm,
            _ => return None,
        };
        Some(Self {
            run: u64::from_le_bytes([r0, r1, r2, r3, r4, r5, r6, r7]),
            form: FrameForm(u16::from_le_bytes([l0, l1])),
            decision,
            ticket,
        })
    }
}

/// Cause of a rejected datagram, roughly in the order of the checks; see [`super::Session::open`].
///
/// A rejected datagram changes only the count of its cause, except an authentic handshake message that fails
/// later: see [`super::Handshake::receive`]. [`Rejection::Forged`] also counts towards the limit on
/// forgeries, and [`Rejection::Repeated`] shows that the sender's address is alive.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Rejection {
    /// Length that no datagram of this session has.
    #[error("datagram of a length that no datagram of this session has")]
    Length,
    /// Other protocol or version.
    #[error("datagram of another protocol or version")]
    Version,
    /// Kind that this side never receives.
    #[error("datagram of a kind that this side is never sent")]
    Kind,
    /// Unknown session.
    #[error("datagram of an unknown session")]
    Session,
    /// Epoch whose keys this side does not have: past, or future.
    #[error("datagram of an epoch whose keys this side does not have")]
    Epoch,
    /// Counter beyond the limit of one key.
    #[error("the counter exceeds the limit of one key")]
    Counter,
    /// Counter too old for the replay window.
    #[error("counter too far behind the newest")]
    TooOld,
    /// Counter seen before.
    #[error("counter seen before")]
    Repeated,
    /// Tag that does not match: forged, damaged, or sealed with another key.
    #[error("tag that does not match: forged, damaged, or sealed with another key")]
    Forged,
    /// Answer without a waiting handshake.
    #[error("answer without a waiting handshake")]
    Unexpected,
    /// First message of a handshake that was seen before.
    #[error("first message of a handshake seen before")]
    Replayed,
    /// Handshake beyond the rate limit.
    #[error("handshake beyond the rate limit")]
    Busy,
    /// Keys of another master while one holds the lease.
    #[error("another master holds the lease")]
    Leased,
    /// Handshake that this side could not continue: no randomness.
    #[error("handshake that this side could not continue: no randomness")]
    Unable,
}

impl Rejection {
    /// All causes.
    pub const ALL: [Self; 14] = [
        Self::Length,
        Self::Version,
        Self::Kind,
        Self::Session,
        Self::Epoch,
        Self::Counter,
        Self::TooOld,
        Self::Repeated,
        Self::Forged,
        Self::Unexpected,
        Self::Replayed,
        Self::Busy,
        Self::Leased,
        Self::Unable,
    ];
}

/// Number of rejected datagrams, by cause.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Rejections([u64; Rejection::ALL.len()]);

impl Rejections {
    pub(super) fn count(&mut self, cause: Rejection) {
        self.0[cause as usize] += 1;
    }

    /// Add `more` to the count of a cause.
    #[must_use]
    pub fn with(mut self, cause: Rejection, more: u64) -> Self {
        self.0[cause as usize] += more;
        self
    }

    /// Datagrams rejected for this cause.
    pub fn of(&self, cause: Rejection) -> u64 {
        self.0[cause as usize]
    }

    /// Datagrams rejected for any cause.
    pub fn total(&self) -> u64 {
        self.0.iter().sum()
    }

    /// Iterate over the causes with their counts.
    pub fn iter(&self) -> impl Iterator<Item = (Rejection, u64)> + '_ {
        Rejection::ALL.into_iter().zip(self.0)
    }
}

impl std::ops::Add for Rejections {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        let mut sum = self;
        for (count, more) in sum.0.iter_mut().zip(other.0) {
            *count += more;
        }
        sum
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{SideKind, wire::FrameLayout};

    /// Known answer, written by hand from the table in `docs/protocol.md`.
    #[test]
    fn bytes_are_those_of_the_table() {
        let header =
            Header { kind: Kind::Sealed, epoch: 0x0102_0304, session: 0x1122_3344_5566_7788, counter: 5 };
        let bytes = header.to_bytes();
        assert_eq!(
            bytes,
            [
                b'H', b'S', 2, 3, 4, 3, 2, 1, 0x88, 0x77, 0x66, 0x55, 0x44, 0x33, 0x22, 0x11, 5, 0, 0, 0, 0,
                0, 0, 0
            ]
        );
        let mut datagram = [0; 100];
        datagram[..24].copy_from_slice(&bytes);
        assert_eq!(Header::read(&datagram, Role::Slave, 100), Ok(header));
    }

    #[test]
    fn no_frame_is_as_long_as_a_handshake() {
        assert_eq!(HANDSHAKE_LENGTH, 120);
        for axes in 1..=7 {
            for (kind, parts) in
                [SideKind::Joints, SideKind::Pose].into_iter().flat_map(|k| (0..4).map(move |p| (k, p)))
            {
                let (has_gripper, has_buttons) = (parts & 1 != 0, parts & 2 != 0);
                let layout = FrameLayout { kind, has_gripper, has_buttons, ..FrameLayout::of(axes) };
                assert_ne!(sealed_length(layout.length()), HANDSHAKE_LENGTH);
            }
        }
    }

    #[test]
    fn cheap_checks_come_in_order() {
        let good = |kind: Kind, length: usize| {
            let mut bytes = vec![0; length];
            bytes[..24].copy_from_slice(&Header { kind, epoch: 0, session: 1, counter: 0 }.to_bytes());
            bytes
        };
        let read = |bytes: &[u8]| Header::read(bytes, Role::Slave, 132).map(|_| ());
        assert_eq!(read(&good(Kind::Sealed, 132)), Ok(()));
        assert_eq!(read(&good(Kind::Hello, HANDSHAKE_LENGTH)), Ok(()));
        for length in [0, 23, 24, 119, 121, 131, 133, 2000] {
            assert_eq!(read(&vec![0; length]), Err(Rejection::Length));
        }
        for (at, byte, refusal) in [
            (0, b'X', Rejection::Version),
            (1, b'T', Rejection::Version),
            (2, 1, Rejection::Version),
            (2, 3, Rejection::Version),
            (3, 0, Rejection::Kind),
            (3, 2, Rejection::Kind),
            (3, 6, Rejection::Kind),
            (3, 1, Rejection::Length),
        ] {
            let mut bytes = good(Kind::Sealed, 132);
            bytes[at] = byte;
            assert_eq!(read(&bytes), Err(refusal), "byte {at} = {byte}");
        }
        let mut hello = good(Kind::Hello, HANDSHAKE_LENGTH);
        hello[16] = 1;
        assert_eq!(read(&hello), Err(Rejection::Counter));
        assert_eq!(read(&good(Kind::Sealed, HANDSHAKE_LENGTH)), Err(Rejection::Length));
    }

    #[test]
    fn payload_bytes_are_those_of_the_table() {
        for (byte, decision) in [
            (0, HandshakeDecision::Accepted),
            (1, HandshakeDecision::Leased),
            (2, HandshakeDecision::PayloadForm),
        ] {
            let payload = HandshakePayload::new(0x0807_0605_0403_0201, FrameForm(92), decision)
                .with([9, 10, 11, 12, 13]);
            let bytes = [1, 2, 3, 4, 5, 6, 7, 8, 92, 0, byte, 9, 10, 11, 12, 13];
            assert_eq!(payload.to_bytes(), bytes);
            assert_eq!(HandshakePayload::from_bytes(bytes), Some(payload));
        }
        assert_eq!(HandshakePayload::from_bytes([0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 3, 0, 0, 0, 0, 0]), None);
    }

    #[test]
    fn each_cause_has_its_own_count() {
        let mut counts = Rejections::default();
        for (n, cause) in Rejection::ALL.into_iter().enumerate() {
            assert_eq!(cause as usize, n);
            counts.count(cause);
            assert_eq!((counts.of(cause), counts.total()), (1, n as u64 + 1));
        }
        let twice = counts + counts;
        assert!(twice.iter().all(|(_, count)| count == 2));
    }
}
