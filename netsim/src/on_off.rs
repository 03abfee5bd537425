//! Process that alternates between on and off for exponentially distributed times.
//!
//! With mean times `U` on and `D` off it is the two-state Markov process. An equivalent description has no
//! memory: at the times of a Poisson process of mean gap `U D / (U + D)` the state is redrawn. It is off with
//! probability `D / (U + D)`, independent of the previous state (uniformization).
//!
//! The state at a time is therefore the last one drawn before it, a pure function of (seed, time). A Poisson
//! process restarts at any time, so it is drawn by blocks of time; a long silence skips blocks at no cost.
//!
//! Source: A. Jensen, "Markoff chains as an aid in the study of Markoff processes", Skand. Aktuarietidskr.
//! 36, 1953.

use crate::checks::nanoseconds;
use crate::random::{Chance, Stream, unit};

/// Minimum mean time between state draws in s: times are whole ns.
pub(crate) const MIN_GAP_S: f64 = 5e-7;
pub(crate) const MAX_MEAN_S: f64 = 1e6;

/// Mean number of draws per block. Few blocks have none, so looking back more than one block is rare.
const DRAWS_PER_BLOCK: f64 = 8.0;
/// Maximum number of blocks to look back; the probability that none of them has a draw is `exp(-512)`.
const MAX_BLOCKS_BACK: u64 = 64;

/// On/off state as a function of time.
#[derive(Clone, Copy, Debug)]
pub(crate) struct OnOff {
    mean_gap_ns: f64,
    block_ns: u64,
    off: Chance,
    stream: Stream,
    /// Latest stretch queried: the next query usually falls in it or slightly later.
    stretch: Stretch,
    /// Time queried, and time at which the process is on again.
    off_time: (u64, u64),
}

/// Time between two draws, or between a draw and an end of its block.
#[derive(Clone, Copy, Debug)]
struct Stretch {
    from_ns: u64,
    until_ns: u64,
    off: bool,
    block: u64,
    block_end_ns: u64,
    /// Number of draws in the block before the end of the stretch.
    draws: usize,
}

impl OnOff {
    /// From the mean time between state draws, `U D / (U + D)`, and the fraction of time off.
    pub(crate) fn new(mean_gap_s: f64, off_share: f64, stream: Stream) -> Self {
        let mut process = Self {
            mean_gap_ns: mean_gap_s * 1e9,
            block_ns: nanoseconds(mean_gap_s * DRAWS_PER_BLOCK).max(1),
            off: Chance::new(off_share),
            stream,
            stretch: Stretch { from_ns: 0, until_ns: 0, off: false, block: 0, block_end_ns: 0, draws: 0 },
            off_time: (0, 0),
        };
        process.stretch = process.block(0);
        process
    }

    pub(crate) fn by_means(mean_on_s: f64, mean_off_s: f64, stream: Stream) -> Self {
        let sum_s = mean_on_s + mean_off_s;
        Self::new(mean_on_s * (mean_off_s / sum_s), mean_off_s / sum_s, stream)
    }

    pub(crate) fn is_off(&mut self, at_ns: u64) -> bool {
        let mut stretch = self.stretch;
        if at_ns < stretch.from_ns || at_ns >= stretch.block_end_ns {
            stretch = self.block(at_ns / self.block_ns);
        }
        while stretch.until_ns <= at_ns && stretch.until_ns < stretch.block_end_ns {
            stretch = self.following(&stretch);
        }
        self.stretch = stretch;
        stretch.off
    }

    /// Time at which the process is on again; `None` if it is on. The work grows with mean off time / mean on
    /// time.
    pub(crate) fn off_until(&mut self, at_ns: u64) -> Option<u64> {
        if !self.is_off(at_ns) {
            return None;
        }
        let (from_ns, until_ns) = self.off_time;
        if !(from_ns..until_ns).contains(&at_ns) {
            self.off_time = (at_ns, self.end_of_off_time());
        }
        Some(self.off_time.1)
    }

    fn end_of_off_time(&self) -> u64 {
        let mut stretch = self.stretch;
        while stretch.off && stretch.until_ns < u64::MAX {
            stretch = if stretch.until_ns < stretch.block_end_ns {
                self.following(&stretch)
            } else {
                self.first_of(stretch.block + 1, stretch.off)
            };
        }
        if stretch.off { u64::MAX } else { stretch.from_ns }
    }

    /// First stretch of a block.
    fn block(&self, block: u64) -> Stretch {
        let back = (1..=block.min(MAX_BLOCKS_BACK)).find_map(|back| self.last_drawn(block - back));
        // No block precedes block 0, so its state is drawn.
        let off = back.unwrap_or_else(|| self.off.takes(self.stream.bits(block)));
        self.first_of(block, off)
    }

    fn first_of(&self, block: u64, off: bool) -> Stretch {
        let from_ns = block.saturating_mul(self.block_ns);
        let block_end_ns = from_ns.saturating_add(self.block_ns);
        self.ended(Stretch { from_ns, until_ns: from_ns, off, block, block_end_ns, draws: 0 })
    }

    /// State at the end of a block; `None` if the block has no draw.
    fn last_drawn(&self, block: u64) -> Option<bool> {
        let mut stretch = self.first_of(block, false);
        let mut last = None;
        while stretch.until_ns < stretch.block_end_ns {
            stretch = self.following(&stretch);
            last = Some(stretch.off);
        }
        last
    }

    fn following(&self, before: &Stretch) -> Stretch {
        let off = self.off.takes(self.stream.at(before.block, 2 * before.draws + 1));
        self.ended(Stretch { from_ns: before.until_ns, off, draws: before.draws + 1, ..*before })
    }

    /// Set the end of a stretch: next time of the Poisson process, or end of the block.
    fn ended(&self, stretch: Stretch) -> Stretch {
        let drawn = unit(self.stream.at(stretch.block, 2 * stretch.draws));
        let gap_ns = nanoseconds(-libm::log(drawn) * self.mean_gap_ns * 1e-9);
        let until_ns = stretch.from_ns.saturating_add(gap_ns).min(stretch.block_end_ns);
        Stretch { until_ns, ..stretch }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::impairments::Impairment;
    use crate::packet::Direction;

    fn process(mean_on_s: f64, mean_off_s: f64) -> OnOff {
        OnOff::by_means(mean_on_s, mean_off_s, Stream::new(11, Direction::Forward, Impairment::Outage as u16))
    }

    #[test]
    fn state_depends_on_time_not_on_earlier_queries() {
        let mut forward = process(0.003, 0.002);
        let states: Vec<_> = (0..50_000).map(|step| forward.is_off(step * 100_000)).collect();
        let mut jumping = process(0.003, 0.002);
        for step in (0..50_000).map(|step| step * 7919 % 50_000) {
            let fresh = process(0.003, 0.002).is_off(step * 100_000);
            let state = states[usize::try_from(step).unwrap()];
            assert_eq!((jumping.is_off(step * 100_000), fresh), (state, state), "{step}");
        }
    }

    #[test]
    fn process_is_off_until_the_reported_time() {
        let mut process = process(0.003, 0.02);
        let mut ends = 0;
        for step in 0..20_000 {
            let at_ns = step * 333_333;
            let Some(end_ns) = process.off_until(at_ns) else { continue };
            assert!(end_ns > at_ns);
            for between in 0..=10 {
                assert!(process.is_off(at_ns + (end_ns - 1 - at_ns) / 10 * between));
            }
            assert!(process.is_off(end_ns - 1) && !process.is_off(end_ns));
            ends += 1;
        }
        assert!(ends > 10_000, "{ends}");
    }

    /// The remainder of an exponential time is exponential with the same mean, from any query time.
    #[test]
    fn times_off_are_exponential() {
        const MEAN_OFF_NS: f64 = 2e6;
        let mut process = process(0.003, MEAN_OFF_NS * 1e-9);
        // Queries far enough apart that no state is reused.
        let times = (0..100_000).map(|step| step * 50_000_000);
        let mut left: Vec<_> = times.filter_map(|at_ns| Some(process.off_until(at_ns)? - at_ns)).collect();
        let n = left.len() as f64;
        assert!((n - 40_000.0).abs() < 4.0 * (100_000.0 * 0.4 * 0.6_f64).sqrt(), "{n}");
        let mean = left.iter().sum::<u64>() as f64 / n;
        assert!((mean - MEAN_OFF_NS).abs() < 4.0 * MEAN_OFF_NS / n.sqrt(), "{mean}");
        left.sort_unstable();
        let distance = (0..).zip(&left).map(|(rank, &left_ns)| {
            let law = 1.0 - (-(left_ns as f64) / MEAN_OFF_NS).exp();
            (law - f64::from(rank) / n).abs()
        });
        // Kolmogorov-Smirnov at 1e-4.
        let distance = distance.fold(0.0, f64::max);
        assert!(distance < 2.23 / n.sqrt(), "{distance}");
    }
}
