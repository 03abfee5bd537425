//! Packet checksum: CRC-16, polynomial x^16 + x^15 + x^2 + 1, most significant bit first, initial value 0,
//! not reflected, not inverted.
//!
//! Source: ROBOTIS e-Manual, "CRC".

const POLYNOMIAL: u16 = 0x8005;

const TABLE: [u16; 256] = {
    let mut table = [0; 256];
    let mut index = 0_u16;
    while index < 256 {
        let mut remainder = index << 8;
        let mut bit = 0;
        while bit < 8 {
            let carry = remainder & 0x8000 != 0;
            remainder = (remainder << 1) ^ if carry { POLYNOMIAL } else { 0 };
            bit += 1;
        }
        table[index as usize] = remainder;
        index += 1;
    }
    table
};

/// Running checksum: a fast reply has one after each servo, over everything before it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Crc16(u16);

impl Crc16 {
    /// Add bytes.
    pub fn update(&mut self, bytes: &[u8]) {
        for &byte in bytes {
            let index = (self.0 >> 8) ^ u16::from(byte);
            self.0 = (self.0 << 8) ^ TABLE[usize::from(index)];
        }
    }

    /// Checksum of all bytes so far.
    pub fn value(self) -> u16 {
        self.0
    }
}

/// Checksum of some bytes.
pub fn crc16(bytes: &[u8]) -> u16 {
    let mut crc = Crc16::default();
    crc.update(bytes);
    crc.value()
}
