//! What the two sides tell each other, encrypted, inside the handshake.

use super::header::TOLD;

/// The slave's word on a handshake.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// The keys hold.
    Accepted,
    /// Another master holds the lease.
    Leased,
    /// The payloads of the two sides differ in length: other axes, or another version of the frame.
    PayloadLength,
}

/// The encrypted part of a handshake message.
///
/// | offset | type | field |
/// |---|---|---|
/// | 0 | `u64` | run: drawn by the sender when it started |
/// | 8 | `u16` | bytes of its payloads |
/// | 10 | `u8` | verdict: 0 accepted, 1 leased, 2 payload length; 0 in a first message |
/// | 11 | `[u8; 5]` | ticket: in a refusal drawn by the slave; in a first message that of the last refusal, or zero |
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Told {
    pub(super) run: u64,
    pub(super) payload_length: u16,
    pub(super) verdict: Verdict,
    pub(super) ticket: Ticket,
}

/// What only a living master sends back: a recorded message carries that of another refusal.
pub(super) type Ticket = [u8; 5];
/// No refusal came before.
pub(super) const NO_TICKET: Ticket = [0; 5];

impl Told {
    pub(super) fn new(run: u64, payload_length: usize, verdict: Verdict) -> Self {
        // At most the length of a frame, as the settings were checked for.
        Self {
            run,
            payload_length: u16::try_from(payload_length).unwrap_or(u16::MAX),
            verdict,
            ticket: NO_TICKET,
        }
    }

    pub(super) fn with(self, ticket: Ticket) -> Self {
        Self { ticket, ..self }
    }

    pub(super) fn to_bytes(self) -> [u8; TOLD] {
        let mut bytes = [0; TOLD];
        bytes[..8].copy_from_slice(&self.run.to_le_bytes());
        bytes[8..10].copy_from_slice(&self.payload_length.to_le_bytes());
        bytes[10] = match self.verdict {
            Verdict::Accepted => 0,
            Verdict::Leased => 1,
            Verdict::PayloadLength => 2,
        };
        bytes[11..].copy_from_slice(&self.ticket);
        bytes
    }

    pub(super) fn from_bytes(bytes: [u8; TOLD]) -> Option<Self> {
        let [r0, r1, r2, r3, r4, r5, r6, r7, l0, l1, verdict, ticket @ ..] = bytes;
        let verdict = match verdict {
            0 => Verdict::Accepted,
            1 => Verdict::Leased,
            2 => Verdict::PayloadLength,
            _ => return None,
        };
        Some(Self {
            run: u64::from_le_bytes([r0, r1, r2, r3, r4, r5, r6, r7]),
            payload_length: u16::from_le_bytes([l0, l1]),
            verdict,
            ticket,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_are_those_of_the_table() {
        for (byte, verdict) in [(0, Verdict::Accepted), (1, Verdict::Leased), (2, Verdict::PayloadLength)] {
            let told = Told::new(0x0807_0605_0403_0201, 92, verdict).with([9, 10, 11, 12, 13]);
            let bytes = [1, 2, 3, 4, 5, 6, 7, 8, 92, 0, byte, 9, 10, 11, 12, 13];
            assert_eq!(told.to_bytes(), bytes);
            assert_eq!(Told::from_bytes(bytes), Some(told));
        }
        assert_eq!(Told::from_bytes([0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 3, 0, 0, 0, 0, 0]), None);
    }
}
