//! Changes of a packet's bytes in transit: flipped bits, truncation, altered numbers.

use arrayvec::ArrayVec;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::random::Stream;

/// Change of a packet's bytes, determined by (seed, packet index) before the bytes are known.
///
/// Applied in this order: forged bytes, sequence, flipped bits, truncation, altered numbers.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Damage {
    /// Replaces bytes from this offset on by random bytes of the stream.
    pub(crate) forged: Option<(u32, Stream)>,
    /// Offset of a little-endian u64 and the amount to add.
    pub(crate) lead: Option<(u32, u64)>,
    /// Bits flipped by the network.
    pub(crate) corrupted: Flips,
    /// Bits flipped by an attacker.
    pub(crate) attacked: Flips,
    /// Number of bytes kept.
    pub(crate) keep: u32,
    /// Numbers changed by an attacker.
    pub(crate) altered: Alteration,
    pub(crate) index: u64,
}

/// Distinct bits to flip within a range of bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Flips {
    pub(crate) bits: u32,
    /// First byte of the range.
    pub(crate) start: u32,
    /// First byte after the range.
    pub(crate) end: u32,
    /// Stream of the bit positions.
    pub(crate) stream: Stream,
}

pub(crate) const MAX_FLIPS: u32 = 1024;

/// Byte count as stored in [`Damage`]; saturates, which no packet size reaches.
pub(crate) fn bytes(count: usize) -> u32 {
    u32::try_from(count).unwrap_or(u32::MAX)
}

impl Damage {
    pub(crate) const NONE: Self = Self {
        forged: None,
        lead: None,
        corrupted: Flips::NONE,
        attacked: Flips::NONE,
        keep: u32::MAX,
        altered: Alteration::NONE,
        index: 0,
    };

    pub(crate) fn cut_to(&mut self, kept: usize) {
        self.keep = self.keep.min(bytes(kept));
    }

    /// Test if the bytes stay unchanged.
    #[inline]
    pub fn is_none(&self) -> bool {
        self.forged.is_none()
            && self.lead.is_none()
            && !self.corrupts()
            && self.keep == u32::MAX
            && self.altered.is_none()
    }

    /// Test if bits are flipped.
    pub fn corrupts(&self) -> bool {
        self.corrupted.bits > 0 || self.attacked.bits > 0
    }

    /// Length after truncation; `None` if the packet is not truncated.
    pub fn truncates_to(&self) -> Option<usize> {
        (self.keep != u32::MAX).then_some(self.keep as usize)
    }

    /// Changes the bytes; returns the remaining length.
    pub fn apply(&self, payload: &mut [u8]) -> usize {
        if let Some((from, stream)) = self.forged {
            forge(payload, from as usize, stream.nth(FORGED), self.index);
        }
        if let Some((offset, lead)) = self.lead {
            add(payload, offset as usize, lead);
        }
        self.corrupted.apply(payload, self.index);
        self.attacked.apply(payload, self.index);
        let kept = payload.len().min(self.keep as usize);
        self.altered.apply(&mut payload[..kept]);
        kept
    }
}

/// Substreams of forged bytes and of bit positions; substream 0 decides on the event.
const FORGED: u8 = 1;
const FLIPPED: u8 = 2;

impl Flips {
    /// No flips, over all bytes.
    pub(crate) const NONE: Self = Self { bits: 0, start: 0, end: u32::MAX, stream: Stream::UNUSED };

    /// Flips distinct bits, chosen by Floyd's subset sampling, so that no bit is flipped back.
    ///
    /// Source: J. Bentley, R. Floyd, "A sample of brilliance", Comm. ACM 30(9), 1987.
    fn apply(&self, payload: &mut [u8], index: u64) {
        let start = (self.start as usize).min(payload.len());
        let end = (self.end as usize).clamp(start, payload.len());
        let bits = (end - start) as u64 * 8;
        let wanted = u64::from(self.bits.min(MAX_FLIPS)).min(bits);
        let stream = self.stream.nth(FLIPPED);
        let mut chosen = ArrayVec::<u64, { MAX_FLIPS as usize }>::new();
        for last in bits - wanted..bits {
            let drawn = stream.up_to_at(last, index, chosen.len());
            let bit = if chosen.contains(&drawn) { last } else { drawn };
            chosen.push(bit);
        }
        for bit in chosen {
            let (byte, mask) = ((bit / 8) as usize, 1 << (bit % 8));
            payload[start + byte] ^= mask;
        }
    }
}

fn forge(payload: &mut [u8], from: usize, stream: Stream, index: u64) {
    let forged = payload.get_mut(from..).unwrap_or_default();
    for (position, bytes) in forged.chunks_mut(8).enumerate() {
        let random = stream.at(index, position).to_le_bytes();
        bytes.copy_from_slice(&random[..bytes.len()]);
    }
}

/// Adds to a little-endian u64; skipped if the packet is too short.
fn add(payload: &mut [u8], offset: usize, lead: u64) {
    let Some(field) = payload.get_mut(offset..).and_then(|rest| rest.first_chunk_mut::<8>()) else {
        return;
    };
    *field = u64::from_le_bytes(*field).wrapping_add(lead).to_le_bytes();
}

/// Change of one little-endian number.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(tag = "type", rename_all = "kebab-case", deny_unknown_fields)]
pub enum Edit {
    /// Changes a binary64.
    F64 {
        /// Offset of its first byte.
        offset: usize,
        /// Operation.
        operation: Operation,
        /// Operand, from -1e12 to 1e12; set other values, including NaN, as the bits of a u64.
        value: f64,
    },
    /// Changes a u64, modulo 2^64.
    U64 {
        /// Offset of its first byte.
        offset: usize,
        /// Operation.
        operation: Operation,
        /// Operand.
        value: u64,
    },
}

/// Operation on a number.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, Serialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Operation {
    /// Replaces the number.
    Set,
    /// Adds the operand.
    Add,
    /// Multiplies by the operand.
    Multiply,
}

/// Checksum that an attacker who knows the format repairs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, Serialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Checksum {
    /// CRC-32 (IEEE 802.3) of all but the last four bytes, little-endian in the last four.
    Crc32,
}

pub(crate) const MAX_EDITS: usize = 4;

pub(crate) const NUMBER_BYTES: usize = 8;

const CHECKSUM_BYTES: usize = 4;

/// Edits by an attacker who knows the format, applied in order, followed by a repaired checksum.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Alteration {
    pub(crate) edits: [Option<Edit>; MAX_EDITS],
    pub(crate) checksum: Option<Checksum>,
}

impl Alteration {
    pub(crate) const NONE: Self = Self { edits: [None; MAX_EDITS], checksum: None };

    #[inline]
    pub(crate) fn is_none(&self) -> bool {
        self.checksum.is_none() && self.edits.iter().all(Option::is_none)
    }

    /// Minimum packet size in bytes; a shorter packet stays unchanged.
    pub(crate) fn least_bytes(&self) -> usize {
        let ends = self.edits.iter().flatten().map(|edit| offset(edit).saturating_add(NUMBER_BYTES));
        ends.chain(self.checksum.map(|_| CHECKSUM_BYTES)).max().unwrap_or(0)
    }

    pub(crate) fn apply(&self, payload: &mut [u8]) {
        if payload.len() < self.least_bytes() {
            return;
        }
        for edit in self.edits.iter().flatten() {
            let field = payload.get_mut(offset(edit)..).and_then(|rest| rest.first_chunk_mut());
            if let Some(field) = field {
                *field = changed(edit, *field);
            }
        }
        if self.checksum == Some(Checksum::Crc32)
            && let Some((body, tail)) = payload.split_last_chunk_mut::<CHECKSUM_BYTES>()
        {
            *tail = crc32fast::hash(body).to_le_bytes();
        }
    }
}

pub(crate) fn offset(edit: &Edit) -> usize {
    match *edit {
        Edit::F64 { offset, .. } | Edit::U64 { offset, .. } => offset,
    }
}

fn changed(edit: &Edit, field: [u8; NUMBER_BYTES]) -> [u8; NUMBER_BYTES] {
    match *edit {
        Edit::F64 { operation, value, .. } => {
            let seen = f64::from_le_bytes(field);
            let result = match operation {
                Operation::Set => value,
                Operation::Add => seen + value,
                Operation::Multiply => seen * value,
            };
            // The bits of a NaN result depend on the processor, so they are replaced.
            if result.is_nan() { f64::NAN } else { result }.to_le_bytes()
        }
        Edit::U64 { operation, value, .. } => {
            let seen = u64::from_le_bytes(field);
            match operation {
                Operation::Set => value,
                Operation::Add => seen.wrapping_add(value),
                Operation::Multiply => seen.wrapping_mul(value),
            }
            .to_le_bytes()
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::impairments::Impairment;
    use crate::packet::Direction;

    fn flips(bits: u32, start: u32, end: u32) -> Flips {
        Flips { bits, start, end, stream: Stream::new(9, Direction::Forward, Impairment::Corrupt as u16) }
    }

    #[test]
    fn sequence_is_changed_only_if_the_packet_holds_it() {
        let added = |size: usize, offset| {
            let mut payload = vec![0xFF; size];
            Damage { lead: Some((offset, 3)), ..Damage::NONE }.apply(&mut payload);
            payload
        };
        assert_eq!(added(8, 0), [2, 0, 0, 0, 0, 0, 0, 0]);
        assert_eq!(added(9, 1), [0xFF, 2, 0, 0, 0, 0, 0, 0, 0]);
        for (size, offset) in [(0, 0), (7, 0), (9, 2), (9, u32::MAX)] {
            assert_eq!(added(size, offset), vec![0xFF; size]);
        }
    }

    #[test]
    fn no_damage_leaves_the_bytes_and_says_so() {
        let mut payload = [5; 100];
        assert_eq!(Damage::NONE.apply(&mut payload), 100);
        assert_eq!(payload, [5; 100]);
        assert!(Damage::NONE.is_none() && !Damage::NONE.corrupts() && Damage::NONE.truncates_to().is_none());
        let cut = Damage { keep: 3, ..Damage::NONE };
        assert!(!cut.is_none() && cut.truncates_to() == Some(3));
        assert_eq!(cut.apply(&mut payload), 3);
    }

    proptest! {
        #[test]
        fn as_many_different_bits_are_flipped_as_asked_within_the_range(
            size in 0..400_usize, bits in 0..2000_u32, start in 0..500_u32, length in 0..500_u32, index: u64,
        ) {
            let end = start + length;
            let mut payload = vec![0; size];
            Damage { corrupted: flips(bits, start, end), index, ..Damage::NONE }.apply(&mut payload);
            let range = (start as usize).min(size)..(end as usize).min(size);
            let wanted = bits.min(MAX_FLIPS).min(8 * u32::try_from(range.len()).unwrap());
            let flipped = |bytes: &[u8]| bytes.iter().map(|byte| byte.count_ones()).sum::<u32>();
            prop_assert_eq!(flipped(&payload), wanted);
            prop_assert_eq!(flipped(&payload[range]), wanted);
        }

        #[test]
        fn any_damage_fits_any_payload(
            size in 0..300_usize,
            forged: Option<u32>,
            lead: Option<(u32, u64)>,
            numbers: [u32; 6],
            keep: u32,
            index: u64,
        ) {
            let [bits, start, end, more_bits, other_start, other_end] = numbers;
            let stream = Stream::UNUSED;
            let damage = Damage {
                forged: forged.map(|from| (from, stream)),
                lead,
                corrupted: flips(bits, start, end),
                attacked: flips(more_bits, other_start, other_end),
                keep,
                altered: Alteration::NONE,
                index,
            };
            let mut payload = vec![0xA5; size];
            prop_assert_eq!(damage.apply(&mut payload), size.min(keep as usize));
            prop_assert_eq!(payload.len(), size);
            let mut again = vec![0xA5; size];
            damage.apply(&mut again);
            prop_assert_eq!(again, payload);
        }

        #[test]
        fn forged_bytes_begin_where_asked(size in 0..300_usize, from in 0..400_usize, index: u64) {
            let stream = Stream::new(9, Direction::Backward, Impairment::Attack as u16);
            let mut payload = vec![0xA5; size];
            Damage { forged: Some((bytes(from), stream)), index, ..Damage::NONE }.apply(&mut payload);
            let kept = from.min(size);
            prop_assert!(payload[..kept].iter().all(|&byte| byte == 0xA5));
            // 16 random bytes equal the old ones with probability 2^-128.
            prop_assert!(size - kept < 16 || payload[kept..].iter().any(|&byte| byte != 0xA5));
        }
    }
}

#[cfg(test)]
mod alteration_tests {
    use proptest::prelude::*;

    use super::*;

    fn altered(edits: &[Edit], checksum: Option<Checksum>, payload: &[u8]) -> Vec<u8> {
        let mut list = [None; MAX_EDITS];
        for (slot, edit) in list.iter_mut().zip(edits) {
            *slot = Some(*edit);
        }
        let mut payload = payload.to_vec();
        Alteration { edits: list, checksum }.apply(&mut payload);
        payload
    }

    /// Bitwise CRC-32 of IEEE 802.3 by definition: reflected, initial value and final XOR all ones.
    fn crc32(bytes: &[u8]) -> u32 {
        !bytes.iter().fold(!0, |remainder: u32, byte| {
            (0..8).fold(remainder ^ u32::from(*byte), |remainder, _| {
                (remainder >> 1) ^ (0xEDB8_8320 & (remainder & 1).wrapping_neg())
            })
        })
    }

    #[test]
    fn the_checksum_is_the_common_one() {
        // Check value of CRC-32/ISO-HDLC in the catalogue of parametrised CRC algorithms.
        assert_eq!(crc32(b"123456789"), 0xCBF4_3926);
        let sealed = altered(&[], Some(Checksum::Crc32), b"123456789....");
        assert_eq!(sealed, b"123456789\x26\x39\xF4\xCB");
    }

    #[test]
    fn numbers_are_changed_as_asked_and_nothing_else_is() {
        use Operation::{Add, Multiply, Set};
        let f64_at = |operation, value| Edit::F64 { offset: 3, operation, value };
        let u64_at = |operation, value| Edit::U64 { offset: 3, operation, value };
        let quiet = 0x7FF8_0000_0000_0000;
        let cases: &[(Edit, u64, u64)] = &[
            (f64_at(Set, -0.5), 0, (-0.5_f64).to_bits()),
            (f64_at(Add, 0.25), 0.5_f64.to_bits(), 0.75_f64.to_bits()),
            (f64_at(Multiply, -1.0), 0.03_f64.to_bits(), (-0.03_f64).to_bits()),
            (f64_at(Multiply, 1e12), 1e300_f64.to_bits(), f64::INFINITY.to_bits()),
            (f64_at(Multiply, 0.0), f64::INFINITY.to_bits(), quiet),
            // A NaN with other bits becomes the canonical NaN.
            (f64_at(Add, 1.0), quiet | 1 << 63 | 5, quiet),
            (u64_at(Set, quiet), 7, quiet),
            (u64_at(Add, 1000), 41, 1041),
            (u64_at(Add, 2), u64::MAX, 1),
            (u64_at(Multiply, 3), 1 << 63, 1 << 63),
        ];
        for &(edit, seen, expected) in cases {
            let mut payload = [0xA5; 16];
            payload[3..11].copy_from_slice(&seen.to_le_bytes());
            let mut wanted = payload;
            wanted[3..11].copy_from_slice(&expected.to_le_bytes());
            assert_eq!(altered(&[edit], None, &payload), wanted, "{edit:?}");
        }
    }

    #[test]
    fn edits_act_one_after_the_other() {
        let at = |operation, value| Edit::U64 { offset: 0, operation, value };
        let edits = [at(Operation::Set, 5), at(Operation::Multiply, 7), at(Operation::Add, 1)];
        assert_eq!(altered(&edits, None, &[9; 8]), 36_u64.to_le_bytes());
    }

    #[test]
    fn short_packet_stays_unchanged() {
        let edits = [0, 9].map(|offset| Edit::U64 { offset, operation: Operation::Set, value: 1 });
        assert_eq!(altered(&edits, Some(Checksum::Crc32), &[9; 16]), [9; 16]);
        assert_ne!(altered(&edits, Some(Checksum::Crc32), &[9; 17]), [9; 17]);
        assert_eq!(altered(&[], Some(Checksum::Crc32), &[9; 3]), [9; 3]);
        // CRC-32 of the empty string is 0.
        assert_eq!(altered(&[], Some(Checksum::Crc32), &[9; 4]), [0; 4]);
    }

    proptest! {
        #[test]
        fn altered_packet_has_valid_checksum_and_same_length(
            payload in prop::collection::vec(any::<u8>(), 0..300),
            edits in prop::collection::vec((0..400_usize, any::<u64>(), any::<bool>()), 0..4),
        ) {
            let edits: Vec<Edit> = edits.iter().map(|&(offset, value, add)| {
                let operation = if add { Operation::Add } else { Operation::Multiply };
                Edit::U64 { offset, operation, value }
            }).collect();
            let result = altered(&edits, Some(Checksum::Crc32), &payload);
            prop_assert_eq!(result.len(), payload.len());
            let least = edits.iter().map(|edit| offset(edit) + 8).max().unwrap_or(0).max(4);
            if payload.len() < least {
                prop_assert_eq!(result, payload);
            } else {
                let (body, tail) = result.split_last_chunk::<4>().unwrap();
                prop_assert_eq!(crc32(body), u32::from_le_bytes(*tail));
            }
        }
    }
}
