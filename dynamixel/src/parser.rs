//! Parser for answers of servos, from bytes in pieces of any size.

use core::mem::take;

use crate::{
    crc::{Crc16, crc16},
    error::StatusError,
    instruction::{BROADCAST, HEADER, INSTRUCTION, MAX_ID, MAX_PACKET, without_stuffing},
};

/// Instruction code of a status packet.
const STATUS: u8 = 0x55;
/// Minimum of the length field: code, error, checksum.
const MIN_LENGTH: usize = 4;
/// Bytes up to and including the length field.
const PREFIX: usize = 7;

/// Answer of one servo.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Status<'a> {
    /// Servo.
    pub id: u8,
    /// Error byte.
    pub error: StatusError,
    /// Requested bytes, without stuffing.
    pub parameters: &'a [u8],
}

/// Packet of several servos that answers a fast read; it has no stuffing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FastReply<'a> {
    /// From the header to the last checksum.
    frame: &'a [u8],
}

impl<'a> FastReply<'a> {
    /// Parts of the servos, if this is the answer to a read of `length` bytes of `ids`.
    ///
    /// The checksum after each part covers everything before it, from the header on; each is checked.
    ///
    /// Source: ROBOTIS e-Manual, Protocol 2.0, "Fast Sync Read (0x8A)".
    pub fn parts<'i>(
        &self,
        ids: &'i [u8],
        length: usize,
    ) -> Result<impl Iterator<Item = Status<'a>> + use<'a, 'i>, FrameError> {
        let frame = self.frame;
        let body = &frame[INSTRUCTION + 1..];
        let part = length + 4;
        if length == 0 || body.len() != part * ids.len() {
            return Err(FrameError::FastLength { seen: body.len(), allowed: part * ids.len() });
        }
        let mut crc = Crc16::default();
        crc.update(&frame[..=INSTRUCTION]);
        for (&id, bytes) in ids.iter().zip(body.chunks_exact(part)) {
            let (covered, stated) = bytes.split_at(part - 2);
            crc.update(covered);
            let stated_crc = u16::from_le_bytes([stated[0], stated[1]]);
            if stated_crc != crc.value() {
                return Err(FrameError::FastCrc { id, seen: stated_crc, computed: crc.value() });
            }
            if covered[1] != id {
                return Err(FrameError::FastId { seen: covered[1], allowed: id });
            }
            crc.update(stated);
        }
        Ok(ids.iter().zip(body.chunks_exact(part)).map(move |(&id, bytes)| Status {
            id,
            error: StatusError::new(bytes[0]),
            parameters: &bytes[2..2 + length],
        }))
    }
}

/// Checked packet.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Received<'a> {
    /// From one servo.
    Status(Status<'a>),
    /// From several servos.
    Fast(FastReply<'a>),
}

/// Invalid packet, or not the one requested.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum FrameError {
    /// Wrong checksum: bytes were lost or changed.
    #[error("CRC 0x{seen:04X} of a packet of id {id}: must be 0x{computed:04X}")]
    Crc {
        /// Id in the packet.
        id: u8,
        /// Checksum in the packet.
        seen: u16,
        /// Checksum of its bytes.
        computed: u16,
    },
    /// Missing stuffing in spite of a correct checksum.
    #[error("a header inside the packet of id {id}: must be stuffed, FF FF FD FD")]
    Stuffing {
        /// Id in the packet.
        id: u8,
    },
    /// Fast reply of another length than requested.
    #[error("{seen} bytes of a fast reply: must be {allowed}")]
    FastLength {
        /// Bytes after the status code.
        seen: usize,
        /// Number of servos times (data + 4).
        allowed: usize,
    },
    /// Wrong checksum after the part of one servo.
    #[error("CRC 0x{seen:04X} after the part of id {id} of a fast reply: must be 0x{computed:04X}")]
    FastCrc {
        /// Servo.
        id: u8,
        /// Checksum in the packet.
        seen: u16,
        /// Checksum of its bytes.
        computed: u16,
    },
    /// Part of another servo in a fast reply.
    #[error("id {seen} in a fast reply: must be id {allowed} here")]
    FastId {
        /// Id in the packet.
        seen: u8,
        /// Id expected at this position.
        allowed: u8,
    },
}

/// Parser from bytes to answers.
///
/// If bytes cannot begin a packet, it drops one byte and retries, so that it finds a packet after garbage. It
/// waits for as many bytes as a length field claims. The caller must therefore use a deadline, and call
/// [`Self::reset`] before the next instruction.
#[derive(Debug, Clone)]
pub struct StatusParser {
    bytes: [u8; MAX_PACKET],
    filled: usize,
    /// Size of the packet returned last, which the next call drops.
    handed_out: usize,
    dropped: u64,
}

impl Default for StatusParser {
    fn default() -> Self {
        Self { bytes: [0; MAX_PACKET], filled: 0, handed_out: 0, dropped: 0 }
    }
}

impl StatusParser {
    /// Discard all bytes so far.
    pub fn reset(&mut self) {
        self.filled = 0;
        self.handed_out = 0;
    }

    /// Number of bytes so far that belonged to no packet.
    pub fn dropped(&self) -> u64 {
        self.dropped
    }

    /// Next packet, or its error, from kept bytes and `input`; consumes the front of `input`. `None` once
    /// `input` is empty.
    pub fn next(&mut self, input: &mut &[u8]) -> Option<Result<Received<'_>, FrameError>> {
        let packet = take(&mut self.handed_out);
        self.shift(packet);
        let end = loop {
            self.align();
            let wanted = self.wanted();
            if self.filled >= wanted && self.filled > PREFIX {
                break wanted;
            }
            if input.is_empty() {
                return None;
            }
            let count = input.len().min(wanted - self.filled);
            self.bytes[self.filled..self.filled + count].copy_from_slice(&input[..count]);
            self.filled += count;
            *input = &input[count..];
        };
        let id = self.bytes[4];
        let seen = u16::from_le_bytes([self.bytes[end - 2], self.bytes[end - 1]]);
        let computed = crc16(&self.bytes[..end - 2]);
        if seen != computed {
            self.drop_first();
            return Some(Err(FrameError::Crc { id, seen, computed }));
        }
        self.handed_out = end;
        if id == BROADCAST {
            return Some(Ok(Received::Fast(FastReply { frame: &self.bytes[..end] })));
        }
        Some(match without_stuffing(&mut self.bytes[INSTRUCTION..end - 2]) {
            // Code and error byte always remain: the code cannot be part of a mark.
            Some(length) if length >= 2 => Ok(Received::Status(Status {
                id,
                error: StatusError::new(self.bytes[INSTRUCTION + 1]),
                parameters: &self.bytes[INSTRUCTION + 2..INSTRUCTION + length],
            })),
            _ => Err(FrameError::Stuffing { id }),
        })
    }

    /// Expected size of the current packet, as far as known.
    fn wanted(&self) -> usize {
        if self.filled < PREFIX { PREFIX + 1 } else { PREFIX + self.length_field() }
    }

    fn length_field(&self) -> usize {
        usize::from(u16::from_le_bytes([self.bytes[5], self.bytes[6]]))
    }

    /// Drop bytes until the rest can begin a packet.
    fn align(&mut self) {
        while self.filled > 0 && !self.may_begin() {
            self.drop_first();
        }
    }

    fn may_begin(&self) -> bool {
        let begun = &self.bytes[..self.filled];
        let header = begun.len().min(HEADER.len());
        begun[..header] == HEADER[..header]
            && begun.get(4).is_none_or(|&id| id <= MAX_ID || id == BROADCAST)
            && (begun.len() < PREFIX || (MIN_LENGTH..=MAX_PACKET - PREFIX).contains(&self.length_field()))
            && begun.get(INSTRUCTION).is_none_or(|&code| code == STATUS)
    }

    /// Drop the first byte, and all up to the next possible header start.
    fn drop_first(&mut self) {
        let next = self.bytes[1..self.filled].iter().position(|&byte| byte == HEADER[0]);
        let count = next.map_or(self.filled, |index| index + 1);
        self.dropped += count as u64;
        self.shift(count);
    }

    fn shift(&mut self, count: usize) {
        self.bytes.copy_within(count..self.filled, 0);
        self.filled -= count;
    }
}
