//! One read of the same addresses of several servos: all of their values, or none.

use crate::{
    error::StatusError,
    instruction::{Instruction, MAX_PACKET, Packet, RequestError},
    parser::{FrameError, Received, Status, StatusParser},
};

/// Max. number of servos of one read.
pub const MAX_SERVOS: usize = 32;
/// Bytes of a fast reply, or of a status packet, beside the data.
const OVERHEAD: usize = 12;

/// What one servo answered.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Reply<'a> {
    /// The servo.
    pub id: u8,
    /// Whether it reports a hardware error: its values are valid nevertheless.
    pub alert: bool,
    /// The bytes.
    pub data: &'a [u8],
}

/// How far a read is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Progress {
    /// Bytes are missing.
    Waiting,
    /// All have answered.
    Complete,
}

/// Why a read gives no values. It stays failed until [`SyncRead::begin`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum SyncReadError {
    /// A packet came that is none.
    #[error("{0}")]
    Frame(#[from] FrameError),
    /// Another servo answered.
    #[error("id {seen} answered: must be id {allowed} now")]
    Order {
        /// The id that answered.
        seen: u8,
        /// The one whose turn it is.
        allowed: u8,
    },
    /// The other kind of packet came.
    #[error("a {} answered: must be a {}", kind(*.fast), kind(!*.fast))]
    Kind {
        /// Whether a fast reply came.
        fast: bool,
    },
    /// Other than the number of bytes that was asked for.
    #[error("{seen} bytes of id {id}: must be {allowed}")]
    Length {
        /// The servo.
        id: u8,
        /// Bytes that came.
        seen: usize,
        /// Bytes that were asked for.
        allowed: usize,
    },
    /// The servo refused to be read.
    #[error("id {id}: {error}")]
    Refused {
        /// The servo.
        id: u8,
        /// What it said.
        error: StatusError,
    },
}

fn kind(fast: bool) -> &'static str {
    if fast { "packet of several servos" } else { "packet of one servo" }
}

/// A read of the same addresses of several servos.
///
/// [`Self::begin`] gives the bytes to send and forgets all values; [`Self::receive`] takes what arrives. Values are
/// there once all servos have answered, and only until the next [`Self::begin`]: one that is silent, or one byte that
/// is wrong, and there is no value of any. Whoever waits stops at a deadline and asks [`Self::unanswered`] who is missing.
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
    /// A read of `length` bytes from an address on, `fast` with one packet as the answer of all.
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

    /// Forgets what came, and gives the bytes to send.
    pub fn begin(&mut self) -> &[u8] {
        self.parser.reset();
        self.answered = 0;
        self.alerts = 0;
        self.failed = None;
        self.request.bytes()
    }

    /// Takes bytes that have arrived; what follows the last answer is left out of account.
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

    /// Bytes of all answers together, at most.
    pub(crate) fn answer_size(&self) -> usize {
        // Stuffing adds a byte to three.
        self.count * (2 * self.length + OVERHEAD)
    }

    /// What the servos answered, in their order, once all have.
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

    /// The servos whose answer is missing. After a fast read all are, for their packet has not come whole.
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
