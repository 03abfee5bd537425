//! Error byte of a servo: refusal of an instruction, and hardware errors.

use core::fmt;

/// Bit of the error byte: the servo has a hardware error; address 70 holds the details.
const ALERT: u8 = 0x80;

/// Error byte of a status packet.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct StatusError(u8);

impl StatusError {
    /// Wrap the error byte as received.
    pub fn new(byte: u8) -> Self {
        Self(byte)
    }

    /// Return the byte.
    pub fn byte(self) -> u8 {
        self.0
    }

    /// Tests for a hardware error (overload, overheating, voltage, encoder, electrical shock).
    pub fn alert(self) -> bool {
        self.0 & ALERT != 0
    }

    /// Reason for a refusal; `None` if the instruction was accepted.
    pub fn refusal(self) -> Option<Refusal> {
        Some(match self.0 & !ALERT {
            0 => return None,
            1 => Refusal::ResultFail,
            2 => Refusal::Instruction,
            3 => Refusal::Crc,
            4 => Refusal::DataRange,
            5 => Refusal::DataLength,
            6 => Refusal::DataLimit,
            7 => Refusal::Access,
            number => Refusal::Unknown(number),
        })
    }
}

impl fmt::Display for StatusError {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match (self.refusal(), self.alert()) {
            (None, false) => formatter.write_str("no error"),
            (None, true) => formatter.write_str("hardware error (see address 70)"),
            (Some(refusal), false) => write!(formatter, "{refusal}"),
            (Some(refusal), true) => write!(formatter, "{refusal}, and hardware error (see address 70)"),
        }
    }
}

/// Reason for the refusal of an instruction.
///
/// Source: ROBOTIS e-Manual, Protocol 2.0, "Error".
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Refusal {
    /// 1: the packet could not be processed.
    ResultFail,
    /// 2: unknown instruction, or an action without a registered write.
    Instruction,
    /// 3: the checksum of the instruction was wrong.
    Crc,
    /// 4: a value is outside the range of its address; also a goal after the bus watchdog has fired.
    DataRange,
    /// 5: fewer bytes than the address has.
    DataLength,
    /// 6: a value exceeds a limit in the control table.
    DataLimit,
    /// 7: a read-only or undefined address, or an EEPROM address while torque is on.
    Access,
    /// Number not defined by Protocol 2.0.
    Unknown(u8),
}

impl fmt::Display for Refusal {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(match self {
            Self::ResultFail => "result fail (1)",
            Self::Instruction => "instruction error (2)",
            Self::Crc => "CRC error (3)",
            Self::DataRange => "data range error (4)",
            Self::DataLength => "data length error (5)",
            Self::DataLimit => "data limit error (6)",
            Self::Access => "access error (7)",
            Self::Unknown(number) => return write!(formatter, "unknown error ({number})"),
        })
    }
}
