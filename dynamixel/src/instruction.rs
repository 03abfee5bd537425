//! Encoding of instructions to servos.
//!
//! `FF FF FD 00 | id | length u16 | instruction | parameters | CRC u16`, little-endian. The length counts
//! everything after it. From the instruction on, each `FF FF FD` is followed by another `FD`, so that no
//! header occurs inside. Length and checksum apply to the stuffed bytes.
//!
//! Source: ROBOTIS e-Manual, Protocol 2.0, "Instruction Packet", "Byte Stuffing".

use crate::crc::crc16;

/// Id of all servos.
pub const BROADCAST: u8 = 0xFE;
/// Maximum id of a servo.
pub const MAX_ID: u8 = 252;
/// Maximum packet size in bytes, in either direction.
pub const MAX_PACKET: usize = 1024;

pub(crate) const HEADER: [u8; 4] = [0xFF, 0xFF, 0xFD, 0x00];
/// Start of a header, broken up by stuffing.
const MARK: [u8; 3] = [0xFF, 0xFF, 0xFD];
const STUFFING: u8 = 0xFD;
/// Offset of the instruction.
pub(crate) const INSTRUCTION: usize = 7;

/// One read of a bulk read: address and length may differ per servo.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BulkItem {
    /// Servo.
    pub id: u8,
    /// First address.
    pub address: u16,
    /// Number of bytes.
    pub length: u16,
}

/// Instruction to servos.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Instruction<'a> {
    /// Requests model and firmware; [`BROADCAST`] asks all servos.
    Ping {
        /// Servo, or all.
        id: u8,
    },
    /// Reads bytes of the control table.
    Read {
        /// Servo.
        id: u8,
        /// First address.
        address: u16,
        /// Number of bytes.
        length: u16,
    },
    /// Writes bytes of the control table. [`BROADCAST`] writes to all servos, and none answers.
    Write {
        /// Servo, or all.
        id: u8,
        /// First address.
        address: u16,
        /// Bytes, at least one.
        data: &'a [u8],
    },
    /// Registers a write until the action.
    RegWrite {
        /// Servo, or all.
        id: u8,
        /// First address.
        address: u16,
        /// Bytes, at least one.
        data: &'a [u8],
    },
    /// Executes the registered write.
    Action {
        /// Servo, or all.
        id: u8,
    },
    /// Restarts the servo: torque off, all but the EEPROM at its defaults, a latched hardware error cleared.
    Reboot {
        /// Servo, or all.
        id: u8,
    },
    /// Reads the same addresses of several servos; each answers.
    SyncRead {
        /// First address.
        address: u16,
        /// Bytes per servo.
        length: u16,
        /// Servos in the order of their answers, without repetition.
        ids: &'a [u8],
    },
    /// Reads the same addresses of several servos, which answer with one packet.
    FastSyncRead {
        /// First address.
        address: u16,
        /// Bytes per servo.
        length: u16,
        /// Servos in the order of their parts, without repetition.
        ids: &'a [u8],
    },
    /// Writes the same addresses of several servos. None answers, so refusals are not reported.
    SyncWrite {
        /// First address.
        address: u16,
        /// Bytes per servo.
        length: u16,
        /// Servos, without repetition.
        ids: &'a [u8],
        /// `length` bytes per servo, in the order of the ids.
        data: &'a [u8],
    },
    /// Reads different addresses of several servos; each answers.
    BulkRead {
        /// Reads, each of another servo.
        items: &'a [BulkItem],
    },
}

/// Instruction that cannot be encoded.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum RequestError {
    /// No servo can have this id.
    #[error("id {seen}: must be 0 to 252")]
    Id {
        /// The id.
        seen: u8,
    },
    /// A servo is named twice.
    #[error("id {seen} is named twice: each servo must be named once")]
    Repeated {
        /// The id.
        seen: u8,
    },
    /// No servo is named.
    #[error("no servo is named: must be at least one")]
    NoServo,
    /// More than [`crate::MAX_SERVOS`] servos in one read.
    #[error("{seen} servos in one read: must be at most {}", crate::MAX_SERVOS)]
    TooMany {
        /// Number of servos.
        seen: usize,
    },
    /// Zero bytes to read or write.
    #[error("length 0: must be at least one byte")]
    Empty,
    /// The range exceeds address 65535.
    #[error("{length} bytes from address {address}: must end at 65535")]
    Addresses {
        /// First address.
        address: u16,
        /// Number of bytes.
        length: usize,
    },
    /// The data of a sync write does not match its servos.
    #[error("{seen} bytes for the servos of a sync write: must be {allowed}, the same number for each")]
    Share {
        /// Bytes given.
        seen: usize,
        /// Number of servos times bytes per servo.
        allowed: usize,
    },
    /// The packet, or its answer, would exceed [`MAX_PACKET`].
    #[error("a packet of {seen} bytes or more: must be at most {MAX_PACKET}")]
    TooLong {
        /// Size in bytes at which encoding stopped.
        seen: usize,
    },
}

/// Encoded instruction, in its own memory.
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
    /// Bytes to send; empty before the first [`Self::encode`] and after a failed one.
    pub fn bytes(&self) -> &[u8] {
        &self.bytes[..self.length]
    }

    /// Encode an instruction.
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
        // `check_span` has checked that it fits in a u16.
        self.put(&u16::try_from(length).unwrap_or(u16::MAX).to_le_bytes())
    }

    /// Add stuffed bytes; leaves room for the checksum.
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

/// Remove stuffing in place. Returns the remaining length, or `None` if there is an unstuffed header.
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
    // A mark at the very end is stuffed as well.
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
