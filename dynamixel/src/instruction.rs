//! What is asked of servos, as bytes.
//!
//! `FF FF FD 00 | id | length u16 | instruction | parameters | CRC u16`, little-endian. The length counts everything
//! after it. From the instruction on, each `FF FF FD` is followed by one more `FD`, so that no header stands inside;
//! length and checksum are those of the stuffed bytes.
//!
//! Source: ROBOTIS e-Manual, Protocol 2.0, "Instruction Packet", "Byte Stuffing".

use crate::crc::crc16;

/// The id that every servo listens to.
pub const BROADCAST: u8 = 0xFE;
/// Max. id of a servo.
pub const MAX_ID: u8 = 252;
/// Max. bytes of a packet in either direction.
pub const MAX_PACKET: usize = 1024;

pub(crate) const HEADER: [u8; 4] = [0xFF, 0xFF, 0xFD, 0x00];
/// What a header begins with, and stuffing breaks up.
const MARK: [u8; 3] = [0xFF, 0xFF, 0xFD];
const STUFFING: u8 = 0xFD;
/// Where the instruction stands.
pub(crate) const INSTRUCTION: usize = 7;

/// One read of a bulk read: its servos need not have the same address and length.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BulkItem {
    /// The servo.
    pub id: u8,
    /// First address.
    pub address: u16,
    /// Bytes.
    pub length: u16,
}

/// What is asked of servos.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Instruction<'a> {
    /// Is it there: model and firmware. [`BROADCAST`] asks all.
    Ping {
        /// The servo, or all.
        id: u8,
    },
    /// Bytes of the control table.
    Read {
        /// The servo.
        id: u8,
        /// First address.
        address: u16,
        /// Bytes.
        length: u16,
    },
    /// Sets bytes of the control table. [`BROADCAST`] sets those of all, and none answers.
    Write {
        /// The servo, or all.
        id: u8,
        /// First address.
        address: u16,
        /// The bytes, at least one.
        data: &'a [u8],
    },
    /// Keeps a write until the action.
    RegWrite {
        /// The servo, or all.
        id: u8,
        /// First address.
        address: u16,
        /// The bytes, at least one.
        data: &'a [u8],
    },
    /// Does the write that was kept.
    Action {
        /// The servo, or all.
        id: u8,
    },
    /// Starts the servo anew: torque is off, what is no EEPROM is at its defaults, a latched hardware error is gone.
    Reboot {
        /// The servo, or all.
        id: u8,
    },
    /// The same bytes of several servos, each of which answers.
    SyncRead {
        /// First address.
        address: u16,
        /// Bytes of each.
        length: u16,
        /// The servos, in the order of their answers, none twice.
        ids: &'a [u8],
    },
    /// The same bytes of several servos, which answer with one packet.
    FastSyncRead {
        /// First address.
        address: u16,
        /// Bytes of each.
        length: u16,
        /// The servos, in the order of their parts, none twice.
        ids: &'a [u8],
    },
    /// Sets the same bytes of several servos. None answers: what is refused is not seen.
    SyncWrite {
        /// First address.
        address: u16,
        /// Bytes of each.
        length: u16,
        /// The servos, none twice.
        ids: &'a [u8],
        /// `length` bytes of each, in the order of the ids.
        data: &'a [u8],
    },
    /// Bytes of several servos, each of which answers.
    BulkRead {
        /// The reads, no servo twice.
        items: &'a [BulkItem],
    },
}

/// An instruction that no packet can carry.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum RequestError {
    /// No servo has this id.
    #[error("id {seen}: must be 0 to 252")]
    Id {
        /// The id.
        seen: u8,
    },
    /// A servo would answer twice.
    #[error("id {seen} is named twice: each servo must be named once")]
    Repeated {
        /// The id.
        seen: u8,
    },
    /// No servo at all.
    #[error("no servo is named: must be at least one")]
    NoServo,
    /// More servos than [`crate::MAX_SERVOS`] in one read.
    #[error("{seen} servos in one read: must be at most {}", crate::MAX_SERVOS)]
    TooMany {
        /// Servos that were named.
        seen: usize,
    },
    /// Nothing to read or to write.
    #[error("length 0: must be at least one byte")]
    Empty,
    /// The addresses end at 65535.
    #[error("{length} bytes from address {address}: must end at 65535")]
    Addresses {
        /// First address.
        address: u16,
        /// Bytes.
        length: usize,
    },
    /// Bytes of a sync write that do not fit its servos.
    #[error("{seen} bytes for the servos of a sync write: must be {allowed}, the same number for each")]
    Share {
        /// Bytes that there are.
        seen: usize,
        /// Servos times bytes of each.
        allowed: usize,
    },
    /// The packet, or its answer, would be longer than [`MAX_PACKET`].
    #[error("a packet of {seen} bytes or more: must be at most {MAX_PACKET}")]
    TooLong {
        /// Bytes at which it was given up.
        seen: usize,
    },
}

/// The bytes of one instruction, in memory of its own.
#[derive(Debug, Clone)]
pub struct Packet {
    bytes: [u8; MAX_PACKET],
    length: usize,
}

impl Default for Packet {
    fn default() -> Self {
        Self { bytes: [0; MAX_PACKET], length: 0 }
    }
}

impl Packet {
    /// The bytes to send; none before the first [`Self::encode`] and after one that failed.
    pub fn bytes(&self) -> &[u8] {
        &self.bytes[..self.length]
    }

    /// Becomes the packet of an instruction.
    pub fn encode(&mut self, instruction: &Instruction<'_>) -> Result<(), RequestError> {
        self.length = 0;
        let result = self.try_encode(instruction);
        if result.is_err() {
            self.length = 0;
        }
        result
    }

    fn try_encode(&mut self, instruction: &Instruction<'_>) -> Result<(), RequestError> {
        match *instruction {
            Instruction::Ping { id } => self.begin(anyone(id)?, 0x01)?,
            Instruction::Read { id, address, length } => {
                self.begin(one(id)?, 0x02)?;
                self.span(address, usize::from(length))?;
            }
            Instruction::Write { id, address, data } => self.write(anyone(id)?, 0x03, address, data)?,
            Instruction::RegWrite { id, address, data } => self.write(anyone(id)?, 0x04, address, data)?,
            Instruction::Action { id } => self.begin(anyone(id)?, 0x05)?,
            Instruction::Reboot { id } => self.begin(anyone(id)?, 0x08)?,
            Instruction::SyncRead { address, length, ids } => self.sync_read(0x82, address, length, ids)?,
            Instruction::FastSyncRead { address, length, ids } => {
                self.sync_read(0x8A, address, length, ids)?;
            }
            Instruction::SyncWrite { address, length, ids, data } => {
                named_once(ids.iter().copied())?;
                let share = usize::from(length);
                self.begin(BROADCAST, 0x83)?;
                self.span(address, share)?;
                if data.len() != share * ids.len() {
                    return Err(RequestError::Share { seen: data.len(), allowed: share * ids.len() });
                }
                for (&id, of_one) in ids.iter().zip(data.chunks_exact(share)) {
                    self.put(&[id])?;
                    self.put(of_one)?;
                }
            }
            Instruction::BulkRead { items } => {
                named_once(items.iter().map(|item| item.id))?;
                self.begin(BROADCAST, 0x92)?;
                for item in items {
                    self.put(&[item.id])?;
                    self.span(item.address, usize::from(item.length))?;
                }
            }
        }
        self.finish()
    }

    fn write(&mut self, id: u8, code: u8, address: u16, data: &[u8]) -> Result<(), RequestError> {
        check_span(address, data.len())?;
        self.begin(id, code)?;
        self.put(&address.to_le_bytes())?;
        self.put(data)
    }

    fn sync_read(&mut self, code: u8, address: u16, length: u16, ids: &[u8]) -> Result<(), RequestError> {
        named_once(ids.iter().copied())?;
        self.begin(BROADCAST, code)?;
        self.span(address, usize::from(length))?;
        self.put(ids)
    }

    fn begin(&mut self, id: u8, code: u8) -> Result<(), RequestError> {
        self.bytes[..4].copy_from_slice(&HEADER);
        self.bytes[4] = id;
        self.length = INSTRUCTION;
        self.put(&[code])
    }

    fn span(&mut self, address: u16, length: usize) -> Result<(), RequestError> {
        check_span(address, length)?;
        self.put(&address.to_le_bytes())?;
        // At most what a u16 holds, for `check_span` has seen it.
        self.put(&u16::try_from(length).unwrap_or(u16::MAX).to_le_bytes())
    }

    /// Adds bytes, stuffed; room for the checksum remains.
    fn put(&mut self, bytes: &[u8]) -> Result<(), RequestError> {
        for &byte in bytes {
            if self.length + 4 > MAX_PACKET {
                return Err(RequestError::TooLong { seen: self.length + 4 });
            }
            self.bytes[self.length] = byte;
            self.length += 1;
            if self.bytes[INSTRUCTION..self.length].ends_with(&MARK) {
                self.bytes[self.length] = STUFFING;
                self.length += 1;
            }
        }
        Ok(())
    }

    fn finish(&mut self) -> Result<(), RequestError> {
        let end = self.length + 2;
        let counted = u16::try_from(end - INSTRUCTION).map_err(|_| RequestError::TooLong { seen: end })?;
        self.bytes[5..7].copy_from_slice(&counted.to_le_bytes());
        let crc = crc16(&self.bytes[..self.length]);
        self.bytes[self.length..end].copy_from_slice(&crc.to_le_bytes());
        self.length = end;
        Ok(())
    }
}

/// Takes the stuffing out of bytes, in place; how many are left, or none if an unstuffed header stands among them.
pub(crate) fn without_stuffing(bytes: &mut [u8]) -> Option<usize> {
    let mut kept = 0;
    let mut expected = false;
    for index in 0..bytes.len() {
        let byte = bytes[index];
        if expected {
            if byte != STUFFING {
                return None;
            }
            expected = false;
            continue;
        }
        bytes[kept] = byte;
        kept += 1;
        expected = bytes[..kept].ends_with(&MARK);
    }
    // A mark at the very end is stuffed as any other.
    (!expected).then_some(kept)
}

fn one(id: u8) -> Result<u8, RequestError> {
    if id <= MAX_ID { Ok(id) } else { Err(RequestError::Id { seen: id }) }
}

fn anyone(id: u8) -> Result<u8, RequestError> {
    if id == BROADCAST { Ok(id) } else { one(id) }
}

fn named_once(ids: impl Iterator<Item = u8>) -> Result<(), RequestError> {
    let mut named = [0_u64; 4];
    let mut any = false;
    for id in ids {
        one(id)?;
        let (word, bit) = (usize::from(id / 64), 1_u64 << (id % 64));
        if named[word] & bit != 0 {
            return Err(RequestError::Repeated { seen: id });
        }
        named[word] |= bit;
        any = true;
    }
    if any { Ok(()) } else { Err(RequestError::NoServo) }
}

fn check_span(address: u16, length: usize) -> Result<(), RequestError> {
    if length == 0 {
        return Err(RequestError::Empty);
    }
    if usize::from(address) + length > usize::from(u16::MAX) + 1 {
        return Err(RequestError::Addresses { address, length });
    }
    Ok(())
}
