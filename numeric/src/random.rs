//! Counter-based random numbers: a draw is a pure function of (seed, stream, index).
//!
//! Source: J. K. Salmon, M. A. Moraes, R. O. Dror, D. E. Shaw, "Parallel random numbers: as easy as 1, 2, 3",
//! SC 2011, Philox4x32-10.

/// Multipliers and Weyl key increments of Philox4x32 (Salmon et al. 2011).
const MULTIPLIER: [u32; 2] = [0xD251_1F53, 0xCD9E_8D57];
const WEYL: [u32; 2] = [0x9E37_79B9, 0xBB67_AE85];
const ROUNDS: usize = 10;

/// Four words of 32 uniform bits.
#[must_use]
pub fn draw(seed: u64, stream: u64, index: u64) -> [u32; 4] {
    let ([k0, k1], [i0, i1], [s0, s1]) = (split(seed), split(index), split(stream));
    philox4x32([i0, i1, s0, s1], [k0, k1])
}

fn philox4x32(counter: [u32; 4], key: [u32; 2]) -> [u32; 4] {
    rounds(counter.map(u64::from), key).map(low)
}

/// All rounds on 32-bit words, each in the lower half of a 64-bit word; the upper half is ignored on input
/// and output. The processor's wide multiplications take such words directly, so a loop over draws
/// vectorizes.
#[inline(always)]
#[must_use]
pub fn rounds([mut c0, mut c1, mut c2, mut c3]: [u64; 4], [mut k0, mut k1]: [u32; 2]) -> [u64; 4] {
    for _ in 0..ROUNDS {
        let products =
            [u64::from(MULTIPLIER[0]) * u64::from(low(c0)), u64::from(MULTIPLIER[1]) * u64::from(low(c2))];
        [c0, c1, c2, c3] = [
            (products[1] >> 32) ^ c1 ^ u64::from(k0),
            products[1],
            (products[0] >> 32) ^ c3 ^ u64::from(k1),
            products[0],
        ];
        k0 = k0.wrapping_add(WEYL[0]);
        k1 = k1.wrapping_add(WEYL[1]);
    }
    [c0, c1, c2, c3]
}

/// Low word, high word.
#[inline]
#[must_use]
pub fn split(word: u64) -> [u32; 2] {
    [low(word), low(word >> 32)]
}

/// Low word.
#[inline]
#[must_use]
#[expect(clippy::cast_possible_truncation, reason = "takes the word apart")]
pub fn low(word: u64) -> u32 {
    word as u32
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Source: Random123, `tests/kat_vectors`, lines `philox4x32 10`.
    #[test]
    fn matches_the_known_answers() {
        let cases: [([u32; 4], [u32; 2], [u32; 4]); 3] = [
            ([0; 4], [0; 2], [0x6627_e8d5, 0xe169_c58d, 0xbc57_ac4c, 0x9b00_dbd8]),
            ([u32::MAX; 4], [u32::MAX; 2], [0x408f_276d, 0x41c8_3b0e, 0xa20b_c7c6, 0x6d54_51fd]),
            (
                [0x243f_6a88, 0x85a3_08d3, 0x1319_8a2e, 0x0370_7344],
                [0xa409_3822, 0x299f_31d0],
                [0xd16c_fe09, 0x94fd_cceb, 0x5001_e420, 0x2412_6ea1],
            ),
        ];
        for (counter, key, answer) in cases {
            assert_eq!(philox4x32(counter, key), answer);
        }
    }

    #[test]
    fn seed_stream_and_index_fill_key_and_counter_low_word_first() {
        let answer = draw(0x299f_31d0_a409_3822, 0x0370_7344_1319_8a2e, 0x85a3_08d3_243f_6a88);
        assert_eq!(answer, [0xd16c_fe09, 0x94fd_cceb, 0x5001_e420, 0x2412_6ea1]);
    }
}
