//! Counter-based random numbers: a draw is a pure function of (seed, stream, index).
//!
//! A sequential generator ties every draw to the number of draws before it, so one more impairment, or one
//! packet more, changes all that follows. Here nothing precedes a draw, and there is no state to carry or to
//! share.
//!
//! Source: J. K. Salmon, M. A. Moraes, R. O. Dror, D. E. Shaw, "Parallel random numbers: as easy as 1, 2, 3",
//! SC 2011, Philox4x32-10.

use crate::verdict::Direction;

/// Multipliers and Weyl key increments of Philox4x32 (Salmon et al. 2011).
const MULTIPLIER: [u32; 2] = [0xD251_1F53, 0xCD9E_8D57];
const WEYL: [u32; 2] = [0x9E37_79B9, 0xBB67_AE85];
const ROUNDS: usize = 10;

/// What a stream of draws is used for.
///
/// The numbers are part of the recorded results: a new impairment takes a new number, an old one keeps its
/// own.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub(crate) enum Impairment {
    Loss = 1,
    Jitter = 2,
}

/// The draws of one impairment in one direction.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Stream {
    seed: u64,
    id: u64,
}

impl Stream {
    pub(crate) fn new(seed: u64, direction: Direction, impairment: Impairment) -> Self {
        let side = match direction {
            Direction::Forward => 0,
            Direction::Backward => 1,
        };
        Self { seed, id: (u64::from(impairment as u32) << 1) | side }
    }

    /// 64 uniform bits for packet `index`.
    pub(crate) fn bits(&self, index: u64) -> u64 {
        let [low, high, ..] = draw(self.seed, self.id, index);
        join(low, high)
    }

    /// A uniform integer in `0..=last` for packet `index`.
    ///
    /// Multiply-shift without rejection, so that a packet costs exactly one draw; the probability of a value
    /// is off by less than 2^-64.
    ///
    /// Source: D. Lemire, "Fast random integer generation in an interval", ACM TOMACS 29(1), 2019.
    pub(crate) fn up_to(&self, last: u64, index: u64) -> u64 {
        let product = u128::from(self.bits(index)) * (u128::from(last) + 1);
        (product >> 64) as u64
    }
}

/// 128 random bits for draw `index` of `stream`.
pub(crate) fn draw(seed: u64, stream: u64, index: u64) -> [u32; 4] {
    let ([k0, k1], [i0, i1], [s0, s1]) = (split(seed), split(index), split(stream));
    philox4x32([i0, i1, s0, s1], [k0, k1])
}

fn philox4x32(counter: [u32; 4], key: [u32; 2]) -> [u32; 4] {
    let [mut c0, mut c1, mut c2, mut c3] = counter;
    let [mut k0, mut k1] = key;
    for _ in 0..ROUNDS {
        let [low0, high0] = split(u64::from(MULTIPLIER[0]) * u64::from(c0));
        let [low1, high1] = split(u64::from(MULTIPLIER[1]) * u64::from(c2));
        [c0, c1, c2, c3] = [high1 ^ c1 ^ k0, low1, high0 ^ c3 ^ k1, low0];
        k0 = k0.wrapping_add(WEYL[0]);
        k1 = k1.wrapping_add(WEYL[1]);
    }
    [c0, c1, c2, c3]
}

/// Low word, high word.
#[expect(clippy::cast_possible_truncation, reason = "takes the word apart")]
fn split(word: u64) -> [u32; 2] {
    [word as u32, (word >> 32) as u32]
}

fn join(low: u32, high: u32) -> u64 {
    u64::from(low) | (u64::from(high) << 32)
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

    #[test]
    fn an_integer_reaches_both_ends_of_its_range_and_no_further() {
        let stream = Stream::new(7, Direction::Forward, Impairment::Jitter);
        let mut seen = [0_u32; 5];
        for index in 0..1000 {
            seen[usize::try_from(stream.up_to(4, index)).unwrap()] += 1;
        }
        assert!(seen.iter().all(|&count| count > 150), "{seen:?}");
        assert_eq!(stream.up_to(0, 3), 0);
        assert_eq!(stream.up_to(u64::MAX, 3), stream.bits(3));
    }

    #[test]
    fn every_direction_and_impairment_has_its_own_stream() {
        let first = |direction, impairment| Stream::new(1, direction, impairment).bits(0);
        let draws = [
            first(Direction::Forward, Impairment::Loss),
            first(Direction::Forward, Impairment::Jitter),
            first(Direction::Backward, Impairment::Loss),
            first(Direction::Backward, Impairment::Jitter),
        ];
        for (i, a) in draws.iter().enumerate() {
            assert!(draws[..i].iter().all(|b| a != b));
        }
    }
}
