//! Counter-based random numbers: a draw is a pure function of (seed, stream, index).
//!
//! In a sequential generator each draw depends on the number of draws before it, so one more impairment or
//! packet changes all later draws. Here no state is carried or shared.

use haptether_numeric::random::{draw, low, rounds, split};

use crate::packet::Direction;

/// Random draws of one impairment in one direction.
///
/// The id combines (position in a list of such impairments, impairment, direction).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Stream {
    seed: u64,
    id: u64,
}

impl Stream {
    pub(crate) const UNUSED: Self = Self { seed: 0, id: 0 };

    pub(crate) fn new(seed: u64, direction: Direction, impairment: u16) -> Self {
        let side = match direction {
            Direction::Forward => 0,
            Direction::Backward => 1,
        };
        Self { seed, id: (u64::from(impairment) << 1) | side }
    }

    /// Stream number `position` derived from this one; 0 is the stream itself. Used for the entries of a
    /// list, such as several outages, or for another use of the same impairment. At most two levels: call it
    /// once more on the result.
    pub(crate) const fn nth(self, position: u8) -> Self {
        let outer = (self.id >> 16) & 0xFF;
        Self { seed: self.seed, id: (self.id & 0xFFFF) | ((position as u64) << 16) | (outer << 24) }
    }

    /// 64 uniform bits for packet or bin `index`.
    pub(crate) fn bits(&self, index: u64) -> u64 {
        self.pair(index)[0]
    }

    /// [`bits`](Self::bits) of [`LANES`] packets from `first`, a multiple of [`LANES`]. Uses vectors of four
    /// where the processor has them.
    #[inline(never)]
    fn lane_bits(self, first: u64) -> [u64; LANES] {
        let draws = LaneBits { stream: self, first };
        #[cfg(target_arch = "x86_64")]
        if let Some(processor) = pulp::x86::V3::try_new() {
            return pulp::Simd::vectorize(processor, draws);
        }
        pulp::WithSimd::with_simd(draws, pulp::Scalar)
    }

    /// Two words of 64 uniform bits for packet or bin `index`; the first equals [`bits`](Self::bits).
    pub(crate) fn pair(&self, index: u64) -> [u64; 2] {
        let [a, b, c, d] = draw(self.seed, self.id, index);
        [join(a, b), join(c, d)]
    }

    /// 64 uniform bits for draw `position` of packet `index`, if one draw is not enough.
    pub(crate) fn at(&self, index: u64, position: usize) -> u64 {
        // The position occupies the upper half of the id, which is otherwise unused.
        Self { seed: self.seed, id: self.id | (1 << 63) | ((position as u64) << 32) }.bits(index)
    }

    /// Uniform number strictly between 0 and 1 for packet or bin `index`: midpoints of 2^53 equal parts.
    pub(crate) fn unit(&self, index: u64) -> f64 {
        unit(self.bits(index))
    }

    /// Uniform integer in `0..=last` for draw `position` of packet `index`.
    pub(crate) fn up_to_at(&self, last: u64, index: u64, position: usize) -> u64 {
        scale(self.at(index, position), last)
    }
}

const LANES: usize = 16;

/// [`LANES`] consecutive draws, compiled for each kind of processor.
struct LaneBits {
    stream: Stream,
    first: u64,
}

impl pulp::WithSimd for LaneBits {
    type Output = [u64; LANES];

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, _: S) -> Self::Output {
        let Stream { seed, id } = self.stream;
        let ([i0, i1], [s0, s1]) = (split(self.first), split(id).map(u64::from));
        let mut bits = [0; LANES];
        for (lane, bits) in (0..).zip(&mut bits) {
            let [a, b, ..] = rounds([u64::from(i0) + lane, u64::from(i1), s0, s1], split(seed));
            *bits = u64::from(low(a)) | (b << 32);
        }
        bits
    }
}

/// Uniform number strictly between 0 and 1: midpoint of one of 2^53 equal parts.
pub(crate) fn unit(bits: u64) -> f64 {
    const PART: f64 = 1.0 / 9_007_199_254_740_992.0;
    // From 2^52 parts on, 0.5 rounds to even and the last draw would be 1; `min` keeps it below.
    (((bits >> 11) as f64 + 0.5) * PART).min(1.0 - PART)
}

/// Uniform integer in `0..=last`.
///
/// Multiply-shift without rejection, so that a packet costs exactly one draw. The probability of each value
/// is off by less than 2^-64.
///
/// Source: D. Lemire, "Fast random integer generation in an interval", ACM TOMACS 29(1), 2019.
fn scale(bits: u64, last: u64) -> u64 {
    let product = u128::from(bits) * (u128::from(last) + 1);
    (product >> 64) as u64
}

/// Event of probability p: it occurs if r < p 2^64, r uniform on `0..2^64`.
///
/// Both sides are integers: p 2^64 is exact in binary floating point up to its last fractional bit. The
/// comparison is therefore the same on every platform.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Chance {
    /// p 2^64; wider than a draw, so that p = 1 always occurs.
    threshold: u128,
}

impl Chance {
    /// Require a probability checked to be in `[0, 1]`.
    pub(crate) fn new(probability: f64) -> Self {
        const TWO_POW_64: f64 = 18_446_744_073_709_551_616.0;
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "0 <= probability <= 1; what is cut off is below 2^-64"
        )]
        let threshold = (probability * TWO_POW_64) as u128;
        Self { threshold }
    }

    pub(crate) fn takes(&self, bits: u64) -> bool {
        u128::from(bits) < self.threshold
    }
}

/// Event that occurs to each packet independently.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Event {
    chance: Chance,
    stream: Stream,
}

impl Event {
    /// Require a probability checked to be in `[0, 1]`.
    pub(crate) fn new(probability: f64, stream: Stream) -> Self {
        Self { chance: Chance::new(probability), stream }
    }

    pub(crate) fn occurs(&self, index: u64) -> bool {
        self.chance.takes(self.stream.bits(index))
    }

    /// Apply `change` to a packet, and independently to each extra, if the event occurs. Each `change` gets
    /// its own stream.
    pub(crate) fn strike<'a, T: 'a>(
        &self,
        index: u64,
        packet: &'a mut T,
        beside: impl Iterator<Item = &'a mut T>,
        change: impl Fn(&mut T, Stream),
    ) {
        for (position, struck) in (0..).zip(std::iter::once(packet).chain(beside)) {
            let event = Self { stream: self.stream.nth(position), ..*self };
            if event.occurs(index) {
                change(struck, event.stream);
            }
        }
    }
}

/// Draws for mostly consecutive packets, [`LANES`] at a time at little more than the cost of one. Each draw
/// equals [`Stream::bits`].
#[derive(Clone, Copy, Debug)]
pub(crate) struct InTurn {
    stream: Stream,
    /// Index of the cached batch: packet index / [`LANES`].
    block: Option<u64>,
    bits: [u64; LANES],
}

impl InTurn {
    pub(crate) fn new(stream: Stream) -> Self {
        // Detects the processor's features now, not at the first packet.
        Self { stream, block: Some(0), bits: stream.lane_bits(0) }
    }

    #[inline]
    pub(crate) fn bits(&mut self, index: u64) -> u64 {
        const WIDTH: u64 = LANES as u64;
        let block = index / WIDTH;
        if self.block != Some(block) {
            self.block = Some(block);
            self.bits = self.stream.lane_bits(block * WIDTH);
        }
        self.bits[usize::try_from(index % WIDTH).unwrap_or(0)]
    }
}

fn join(low: u32, high: u32) -> u64 {
    u64::from(low) | (u64::from(high) << 32)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::impairments::Impairment;

    #[test]
    fn draws_in_turn_are_those_of_single_packets() {
        let stream = Stream::new(0x0123_4567_89ab_cdef, Direction::Backward, Impairment::Loss as u16).nth(2);
        let mut in_turn = InTurn::new(stream);
        // Consecutive, with gaps, backwards, across 2^32, and up to the last index.
        let near = [u64::from(u32::MAX) - 3, u64::MAX - 7].into_iter().flat_map(|from| from..=from + 7);
        for index in (0..40).chain([61, 62, 200, 7, 6, 203]).chain(near) {
            assert_eq!(in_turn.bits(index), stream.bits(index), "{index}");
        }
    }

    #[test]
    fn every_processor_draws_the_same() {
        use pulp::WithSimd;
        let stream = Stream::new(0xfedc_ba98_7654_3210, Direction::Forward, Impairment::Jitter as u16);
        for first in [0, 32, u64::from(u32::MAX) - 15, u64::MAX - 15] {
            let expected: [_; LANES] = std::array::from_fn(|lane| stream.bits(first + lane as u64));
            assert_eq!(LaneBits { stream, first }.with_simd(pulp::Scalar), expected, "{first}");
            // With AVX2, if this machine has it.
            assert_eq!(stream.lane_bits(first), expected, "{first}");
        }
    }

    #[test]
    fn a_uniform_number_reaches_neither_end() {
        let part = 0.5_f64.powi(53);
        for (bits, wanted) in [(0, 0.5 * part), (u64::MAX, 1.0 - part), (1 << 63, 0.5), (1 << 11, 1.5 * part)]
        {
            assert!((unit(bits) - wanted).abs() <= 0.5 * f64::EPSILON * wanted, "{bits}: {}", unit(bits));
            assert!(0.0 < unit(bits) && unit(bits) < 1.0, "{bits}");
        }
    }

    #[test]
    fn an_integer_reaches_both_ends_of_its_range_and_no_further() {
        let stream = Stream::new(7, Direction::Forward, Impairment::Jitter as u16);
        let mut seen = [0_u32; 5];
        for index in 0..1000 {
            seen[usize::try_from(scale(stream.bits(index), 4)).unwrap()] += 1;
        }
        assert!(seen.iter().all(|&count| count > 150), "{seen:?}");
        assert_eq!(scale(stream.bits(3), 0), 0);
        assert_eq!(scale(stream.bits(3), u64::MAX), stream.bits(3));
    }

    #[test]
    fn every_direction_and_impairment_has_its_own_stream() {
        let first = |direction, impairment: Impairment| Stream::new(1, direction, impairment as u16).bits(0);
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
