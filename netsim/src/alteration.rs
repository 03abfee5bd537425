//! Numbers in a packet that are changed by somebody who knows its format.

use crate::settings::{Checksum, Edit, Operation};

/// Most numbers that one attack changes.
pub(crate) const MAX_EDITS: usize = 4;

/// Bytes of a number.
pub(crate) const NUMBER_BYTES: usize = 8;

/// Bytes of a checksum.
const CHECKSUM_BYTES: usize = 4;

/// Edits, one after the other, and what is put right after them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Alteration {
    pub(crate) edits: [Option<Edit>; MAX_EDITS],
    pub(crate) checksum: Option<Checksum>,
}

impl Alteration {
    /// None.
    pub(crate) const NONE: Self = Self { edits: [None; MAX_EDITS], checksum: None };

    /// Whether the bytes stay as they are.
    pub(crate) fn is_none(&self) -> bool {
        self.checksum.is_none() && self.edits.iter().all(Option::is_none)
    }

    /// Bytes that a packet must have for all of it; from a shorter one it takes nothing.
    pub(crate) fn least_bytes(&self) -> usize {
        let ends = self.edits.iter().flatten().map(|edit| offset(edit).saturating_add(NUMBER_BYTES));
        ends.chain(self.checksum.map(|_| CHECKSUM_BYTES)).max().unwrap_or(0)
    }

    /// Changes the bytes, if they are enough.
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

/// First byte of the number.
pub(crate) fn offset(edit: &Edit) -> usize {
    match *edit {
        Edit::F64 { offset, .. } | Edit::U64 { offset, .. } => offset,
    }
}

/// The number as it is afterwards.
fn changed(edit: &Edit, field: [u8; NUMBER_BYTES]) -> [u8; NUMBER_BYTES] {
    match *edit {
        Edit::F64 { operation, value, .. } => {
            let seen = f64::from_le_bytes(field);
            let result = match operation {
                Operation::Set => value,
                Operation::Add => seen + value,
                Operation::Multiply => seen * value,
            };
            // Which of its bits a NaN keeps through an operation is left to the processor.
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

    fn altered(edits: &[Edit], checksum: Option<Checksum>, payload: &[u8]) -> Vec<u8> {
        let mut list = [None; MAX_EDITS];
        for (slot, edit) in list.iter_mut().zip(edits) {
            *slot = Some(*edit);
        }
        let mut payload = payload.to_vec();
        Alteration { edits: list, checksum }.apply(&mut payload);
        payload
    }

    /// CRC-32 of IEEE 802.3 bit by bit, as its definition has it: reflected, all ones before and after.
    fn crc32(bytes: &[u8]) -> u32 {
        !bytes.iter().fold(!0, |remainder: u32, byte| {
            (0..8).fold(remainder ^ u32::from(*byte), |remainder, _| {
                (remainder >> 1) ^ (0xEDB8_8320 & (remainder & 1).wrapping_neg())
            })
        })
    }

    #[test]
    fn the_checksum_is_the_common_one() {
        // The check value of the catalogue of parametrised CRC algorithms, CRC-32/ISO-HDLC.
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
            // A NaN with other bits comes out as the one that all platforms agree on.
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
    fn from_what_is_too_short_nothing_is_taken() {
        let edits = [0, 9].map(|offset| Edit::U64 { offset, operation: Operation::Set, value: 1 });
        assert_eq!(altered(&edits, Some(Checksum::Crc32), &[9; 16]), [9; 16]);
        assert_ne!(altered(&edits, Some(Checksum::Crc32), &[9; 17]), [9; 17]);
        assert_eq!(altered(&[], Some(Checksum::Crc32), &[9; 3]), [9; 3]);
        // Of nothing: 0.
        assert_eq!(altered(&[], Some(Checksum::Crc32), &[9; 4]), [0; 4]);
    }

    proptest! {
        #[test]
        fn whatever_is_altered_is_sealed_and_of_the_same_length(
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
