//! Read of the same addresses of several servos: all values, or none.

use crate::{
    error::StatusError,
    instruction::{Instruction, MAX_PACKET, Packet, RequestError},
    parser::{FrameError, Received, Status, StatusParser},
};

/// Maximum number of servos in one read.
pub const MAX_SERVOS: usize = 32;
/// Size of a fast reply or a status packet beyond its data, in bytes.
const OVERHEAD: usize = 12;

/// Answer of one servo.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Reply<'a> {
    /// Servo.
    pub id: u8,
    /// Hardware error reported; the values are valid nevertheless.
    pub alert: bool,
    /// Bytes read.
    pub data: &'a [u8],
}

/// Progress of a read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Progress {
    /// Bytes are missing.
    Waiting,
    /// All servos have answered.
    Complete,
}

/// Why a read has no values. It stays failed until [`SyncRead::begin`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum SyncReadError {
    /// An invalid packet arrived.
    #[error("{0}")]
    Frame(#[from] FrameError),
    /// Another servo answered.
    #[error("id {seen} answered: must be id {allowed} now")]
    Order {
        /// Id that answered.
        seen: u8,
        /// Id expected at this position.
        allowed: u8,
    },
    /// The other kind of packet arrived.
    #[error("a {} answered: must be a {}", kind(*.fast), kind(!*.fast))]
    Kind {
        /// True if a fast reply arrived.
        fast: bool,
    },
    /// The number of bytes differs from the request.
    #[error("{seen} bytes of id {id}: must be {allowed}")]
    Length {
        /// Servo.
        id: u8,
        /// Bytes received.
        seen: usize,
        /// Bytes requested.
        allowed: usize,
    },
    /// The servo refused the read.
    #[error("id {id}: {error}")]
    Refused {
        /// Servo.
        id: u8,
        /// Error byte.
        error: StatusError,
    },
}

fn kind(fast: bool) -> &'static str {
    if fast { "packet of several servos" } else { "packet of one servo" }
}

/// Read of the same addresses of several servos.
///
/// [`Self::begin`] returns the bytes to send and discards all values; [`Self::receive`] takes arriving bytes.
/// Values are available once all servos have answered, until the next [`Self::begin`]. One silent servo or
/// one wrong byte leaves no value of any servo. The caller must use a deadline; [`Self::unanswered`] lists
/// the missing servos.
#[derive(Debug, Clone)]
pub struct SyncRead {
    request: Packet,
    fast: bool,
    ids: [u8; MAX_SERVOS],
    count: usize,
    length: usize,
    parser: StatusParser,
    alerts: u32,
    values: [u8; MAX_PACKET],
    answered: usize,
    failed: Option<SyncReadError>,
}

impl SyncRead {
    /// Read of `length` bytes from an address on; with `fast`, all servos answer in one packet.
    pub fn new(fast: bool, address: u16, length: u16, ids: &[u8]) -> Result<Self, RequestError> {
        let mut request = Packet::default();
        request.encode(&if fast {
            Instruction::FastSyncRead { address, length, ids }
        } else {
            Instruction::SyncRead { address, length, ids }
        })?;
        let bytes = (usize::from(length) + 4) * ids.len() + OVERHEAD;
        if ids.len() > MAX_SERVOS {
            return Err(RequestError::TooMany { seen: ids.len() });
        }
        if bytes > MAX_PACKET {
            return Err(RequestError::TooLong { seen: bytes });
        }
        let mut kept = [0; MAX_SERVOS];
        kept[..ids.len()].copy_from_slice(ids);
        Ok(Self {
            request,
            fast,
            ids: kept,
            count: ids.len(),
            length: usize::from(length),
            parser: StatusParser::default(),
            alerts: 0,
            values: [0; MAX_PACKET],
            answered: 0,
            failed: None,
        })
    }

    /// Discard previous answers, and return the bytes to send.
    pub fn begin(&mut self) -> &[u8] {
        self.parser.reset();
        self.answered = 0;
        self.alerts = 0;
        self.failed = None;
        self.request.bytes()
    }

    /// Take received bytes; bytes after the last answer are ignored.
    pub fn receive(&mut self, mut bytes: &[u8]) -> Result<Progress, SyncReadError> {
        if let Some(error) = self.failed {
            return Err(error);
        }
        let result = self.take(&mut bytes);
        if let Err(error) = result {
            self.failed = Some(error);
            self.answered = 0;
        }
        result
    }

    fn take(&mut self, bytes: &mut &[u8]) -> Result<Progress, SyncReadError> {
        while self.answered < self.count {
            let Self { parser, ids, values, alerts, answered, .. } = self;
            let ids = &ids[..self.count];
            let Some(received) = parser.next(bytes) else {
                return Ok(Progress::Waiting);
            };
            match received? {
                Received::Fast(reply) if self.fast => {
                    for status in reply.parts(ids, self.length)? {
                        keep(status, self.length, *answered, values, alerts)?;
                        *answered += 1;
                    }
                }
                Received::Status(status) if !self.fast => {
                    if status.id != ids[*answered] {
                        return Err(SyncReadError::Order { seen: status.id, allowed: ids[*answered] });
                    }
                    keep(status, self.length, *answered, values, alerts)?;
                    *answered += 1;
                }
                Received::Fast(_) | Received::Status(_) => {
                    return Err(SyncReadError::Kind { fast: !self.fast });
                }
            }
        }
        Ok(Progress::Complete)
    }

    /// Maximum size of all answers together, in bytes.
    pub(crate) fn answer_size(&self) -> usize {
        // Stuffing adds at most one byte per three.
        self.count * (2 * self.length + OVERHEAD)
    }

    /// Answers in the order of the servos; `None` until all have answered.
    pub fn replies(&self) -> Option<impl Iterator<Item = Reply<'_>>> {
        if self.answered < self.count {
            return None;
        }
        Some(self.ids[..self.count].iter().enumerate().map(|(index, &id)| Reply {
            id,
            alert: self.alerts & (1 << index) != 0,
            data: &self.values[index * self.length..(index + 1) * self.length],
        }))
    }

    /// Servos without an answer. After an incomplete fast read these are all servos.
    pub fn unanswered(&self) -> &[u8] {
        &self.ids[self.answered..self.count]
    }
}

fn keep(
    status: Status<'_>,
    length: usize,
    index: usize,
    values: &mut [u8; MAX_PACKET],
    alerts: &mut u32,
) -> Result<(), SyncReadError> {
    if status.error.refusal().is_some() {
        return Err(SyncReadError::Refused { id: status.id, error: status.error });
    }
    if status.parameters.len() != length {
        return Err(SyncReadError::Length { id: status.id, seen: status.parameters.len(), allowed: length });
    }
    values[index * length..(index + 1) * length].copy_from_slice(status.parameters);
    if status.error.alert() {
        *alerts |= 1 << index;
    }
    Ok(())
}
