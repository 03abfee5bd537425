//! How the bytes of a packet change on the way: which bits flip, where it is cut.

use arrayvec::ArrayVec;

use crate::alteration::Alteration;
use crate::random::Stream;

/// A change of bytes, settled by (seed, packet index) before the bytes are at hand.
///
/// Applied in the order of its parts: forged bytes, sequence, flipped bits, cut; then somebody alters what is left.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Damage {
    /// Bytes from here on are replaced by random ones of the stream.
    pub(crate) forged: Option<(u32, Stream)>,
    /// First byte of a little-endian u64 and what is added to it.
    pub(crate) lead: Option<(u32, u64)>,
    /// Bits that the network flips.
    pub(crate) corrupted: Flips,
    /// Bits that somebody flips.
    pub(crate) attacked: Flips,
    /// Bytes that are kept.
    pub(crate) keep: u32,
    /// Numbers that somebody changes.
    pub(crate) altered: Alteration,
    /// Index of the packet.
    pub(crate) index: u64,
}

/// Bits that are flipped, all different, within a range of bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Flips {
    /// How many.
    pub(crate) bits: u32,
    /// First byte of the range.
    pub(crate) start: u32,
    /// First byte after the range.
    pub(crate) end: u32,
    /// Key of the positions.
    pub(crate) stream: Stream,
}

/// Most bits that are flipped in a packet at once.
pub(crate) const MAX_FLIPS: u32 = 1024;

/// A number of bytes as [`Damage`] keeps it: no packet has as many as are cut off here.
pub(crate) fn bytes(count: usize) -> u32 {
    u32::try_from(count).unwrap_or(u32::MAX)
}

impl Damage {
    /// None.
    pub(crate) const NONE: Self = Self {
        forged: None,
        lead: None,
        corrupted: Flips::NONE,
        attacked: Flips::NONE,
        keep: u32::MAX,
        altered: Alteration::NONE,
        index: 0,
    };

    /// Keeps at most so many bytes.
    pub(crate) fn cut_to(&mut self, kept: usize) {
        self.keep = self.keep.min(bytes(kept));
    }

    /// Whether the bytes stay as they are.
    pub fn is_none(&self) -> bool {
        self.forged.is_none()
            && self.lead.is_none()
            && !self.corrupts()
            && self.keep == u32::MAX
            && self.altered.is_none()
    }

    /// Whether bits of the packet are flipped.
    pub fn corrupts(&self) -> bool {
        self.corrupted.bits > 0 || self.attacked.bits > 0
    }

    /// Whether the packet is cut short to `Some` bytes.
    pub fn truncates_to(&self) -> Option<usize> {
        (self.keep != u32::MAX).then_some(self.keep as usize)
    }

    /// Changes the bytes; the result is how many are left.
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

/// Streams of forged bytes and of positions, beside the one that decides whether.
const FORGED: u8 = 1;
const FLIPPED: u8 = 2;

impl Flips {
    /// None, in all bytes.
    pub(crate) const NONE: Self = Self { bits: 0, start: 0, end: u32::MAX, stream: Stream::UNUSED };

    /// Flips bits at different places: by Floyd's choice of a subset, so that no bit is flipped back.
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

/// Replaces the bytes from `from` on by random ones.
fn forge(payload: &mut [u8], from: usize, stream: Stream, index: u64) {
    let forged = payload.get_mut(from..).unwrap_or_default();
    for (position, bytes) in forged.chunks_mut(8).enumerate() {
        let random = stream.at(index, position).to_le_bytes();
        bytes.copy_from_slice(&random[..bytes.len()]);
    }
}

/// Adds to a little-endian u64, if the packet is long enough to have one there.
fn add(payload: &mut [u8], offset: usize, lead: u64) {
    let Some(field) = payload.get_mut(offset..).and_then(|rest| rest.first_chunk_mut::<8>()) else {
        return;
    };
    *field = u64::from_le_bytes(*field).wrapping_add(lead).to_le_bytes();
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::random::Impairment;
    use crate::verdict::Direction;

    fn flips(bits: u32, start: u32, end: u32) -> Flips {
        Flips { bits, start, end, stream: Stream::new(9, Direction::Forward, Impairment::Corrupt) }
    }

    #[test]
    fn a_sequence_is_changed_only_where_there_is_one() {
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
            let stream = Stream::new(9, Direction::Backward, Impairment::Attack);
            let mut payload = vec![0xA5; size];
            Damage { forged: Some((bytes(from), stream)), index, ..Damage::NONE }.apply(&mut payload);
            let kept = from.min(size);
            prop_assert!(payload[..kept].iter().all(|&byte| byte == 0xA5));
            // Of 16 random bytes not all are as before: 2^-128.
            prop_assert!(size - kept < 16 || payload[kept..].iter().any(|&byte| byte != 0xA5));
        }
    }
}
