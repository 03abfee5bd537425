//! How the bytes of a packet change on the way: which bits flip, where it is cut.

use crate::random::Stream;

/// A change of bytes, settled by (seed, packet index) before the bytes are at hand.
///
/// Applied in the order of its parts: forged bytes, sequence, flipped bits, cut.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Damage {
    /// Bytes from here on are replaced by random ones.
    pub(crate) forged_from: Option<u32>,
    /// First byte of a little-endian u64 and what is added to it.
    pub(crate) lead: Option<(u32, u64)>,
    /// Bits that are flipped, all different.
    pub(crate) flips: u32,
    /// First byte of those in which bits are flipped.
    pub(crate) flip_start: u32,
    /// First byte after those in which bits are flipped.
    pub(crate) flip_end: u32,
    /// Bytes that are kept.
    pub(crate) keep: u32,
    /// Key of the random positions and bytes.
    pub(crate) stream: Stream,
    /// Index of the packet.
    pub(crate) index: u64,
}

/// Most bits that are flipped in a packet.
pub(crate) const MOST_FLIPS: u32 = 1024;

impl Damage {
    /// None.
    pub(crate) const NONE: Self = Self {
        forged_from: None,
        lead: None,
        flips: 0,
        flip_start: 0,
        flip_end: u32::MAX,
        keep: u32::MAX,
        stream: Stream::UNUSED,
        index: 0,
    };

    /// Whether the bytes stay as they are.
    pub fn is_none(&self) -> bool {
        self.forged_from.is_none() && self.lead.is_none() && self.flips == 0 && self.keep == u32::MAX
    }

    /// Whether bits of the packet are flipped.
    pub fn corrupts(&self) -> bool {
        self.flips > 0
    }

    /// Whether the packet is cut short to `Some` bytes.
    pub fn truncates_to(&self) -> Option<usize> {
        (self.keep != u32::MAX).then_some(self.keep as usize)
    }

    /// Changes the bytes; the result is how many are left.
    pub fn apply(&self, payload: &mut [u8]) -> usize {
        if let Some(from) = self.forged_from {
            self.forge(payload, from as usize);
        }
        if let Some((offset, lead)) = self.lead {
            add(payload, offset as usize, lead);
        }
        if self.flips > 0 {
            self.flip(payload);
        }
        payload.len().min(self.keep as usize)
    }

    fn forge(&self, payload: &mut [u8], from: usize) {
        let stream = self.stream.nth(1);
        let forged = payload.get_mut(from..).unwrap_or_default();
        for (position, bytes) in forged.chunks_mut(8).enumerate() {
            let random = stream.at(self.index, position).to_le_bytes();
            bytes.copy_from_slice(&random[..bytes.len()]);
        }
    }

    /// Flips bits at different places: by Floyd's choice of a subset, so that no bit is flipped back.
    ///
    /// Source: J. Bentley, R. Floyd, "A sample of brilliance", Comm. ACM 30(9), 1987.
    fn flip(&self, payload: &mut [u8]) {
        let start = (self.flip_start as usize).min(payload.len());
        let end = (self.flip_end as usize).clamp(start, payload.len());
        let bits = (end - start) as u64 * 8;
        let wanted = u64::from(self.flips.min(MOST_FLIPS)).min(bits);
        let stream = self.stream.nth(2);
        let mut chosen = [0_u64; MOST_FLIPS as usize];
        let mut count = 0;
        for last in bits - wanted..bits {
            let drawn = stream.up_to_at(last, self.index, count);
            let bit = if chosen[..count].contains(&drawn) { last } else { drawn };
            chosen[count] = bit;
            count += 1;
        }
        for &bit in &chosen[..count] {
            #[expect(clippy::cast_possible_truncation, reason = "a position within the payload")]
            let (byte, mask) = ((bit / 8) as usize, 1 << (bit % 8));
            payload[start + byte] ^= mask;
        }
    }
}

/// Adds to a little-endian u64, if the packet is long enough to have one there.
fn add(payload: &mut [u8], offset: usize, lead: u64) {
    let Some(field) = payload.get_mut(offset..).and_then(|rest| rest.first_chunk_mut::<8>()) else {
        return;
    };
    *field = u64::from_le_bytes(*field).wrapping_add(lead).to_le_bytes();
}
