//! Markov chains of losses evaluated from their matrices: a reference without draws or closed forms.

use crate::{Direction, Link, LinkSettings, Packet, Verdict};

pub(super) const SEED: u64 = 0x5EED_0000_0000_0001;
pub(super) const MANY: u64 = 1_000_000;

/// Loss of each packet, sent at a regular spacing.
pub(super) fn lost(settings: &LinkSettings, spacing_ns: u64, packets: u64) -> Vec<bool> {
    let mut link = Link::new(Direction::Forward, SEED, settings).unwrap();
    (0..packets)
        .map(|index| {
            let packet =
                Packet { direction: Direction::Forward, sent_ns: index * spacing_ns, size: 64, index };
            matches!(link.judge(&packet).verdict, Verdict::Drop { .. })
        })
        .collect()
}

/// Markov chain with a loss probability per state.
pub(super) struct LossChain<const N: usize> {
    pub(super) rows: [[f64; N]; N],
    pub(super) loss: [f64; N],
}

impl<const N: usize> LossChain<N> {
    fn step(&self, law: [f64; N]) -> [f64; N] {
        std::array::from_fn(|to| (0..N).map(|from| law[from] * self.rows[from][to]).sum())
    }

    fn lost_in(&self, law: [f64; N]) -> f64 {
        law.iter().zip(&self.loss).map(|(share, loss)| share * loss).sum()
    }

    /// Iterates the lazy chain, which stays or steps with probability 1/2: same stationary distribution, no
    /// period.
    fn stationary(&self) -> [f64; N] {
        (0..200_000).fold([1.0 / N as f64; N], |law, _| {
            let next = self.step(law);
            std::array::from_fn(|state| f64::midpoint(law[state], next[state]))
        })
    }

    /// Fraction of lost packets.
    pub(super) fn rate(&self) -> f64 {
        self.lost_in(self.stationary())
    }

    /// Standard deviation of the number of losses in `packets`: `Var = n (c_0 + 2 sum_k c_k)`, `c_k` the
    /// covariance of two losses k packets apart.
    pub(super) fn sigma(&self, packets: u64) -> f64 {
        let stationary = self.stationary();
        let rate = self.lost_in(stationary);
        let mut both: [f64; N] = std::array::from_fn(|state| stationary[state] * self.loss[state]);
        let mut sum = rate * (1.0 - rate);
        for _ in 0..20_000 {
            both = self.step(both);
            sum += 2.0 * (self.lost_in(both) - rate * rate);
        }
        (sum.max(0.0) * packets as f64).sqrt()
    }

    /// Check the number of losses against the chain, within 3 sigma of the correlated process. `closed_form`
    /// is the same rate by a formula.
    pub(super) fn check_rate(&self, lost: &[bool], closed_form: f64) {
        let rate = self.rate();
        assert!((rate - closed_form).abs() < 1e-9, "{rate} {closed_form}");
        let count = lost.iter().filter(|&&lost| lost).count() as f64;
        let expected = rate * lost.len() as f64;
        // One packet of tolerance for the edges of deterministic cases.
        let tolerance = 3.0 * self.sigma(lost.len() as u64) + 1.0;
        assert!((count - expected).abs() < tolerance, "{count}, expected {expected} +- {tolerance}");
    }
}

/// Chain with loss probability `start` after a delivered packet and `stay` after a lost one.
pub(super) fn two_states(start: f64, stay: f64) -> LossChain<2> {
    LossChain { rows: [[1.0 - start, start], [1.0 - stay, stay]], loss: [0.0, 1.0] }
}

/// Lengths of runs of lost packets, without runs at either end.
pub(super) fn bursts(lost: &[bool]) -> Vec<usize> {
    let runs: Vec<_> = lost.chunk_by(|a, b| a == b).collect();
    let inner = runs.get(1..runs.len().saturating_sub(1)).unwrap_or_default();
    inner.iter().filter(|run| run[0]).map(|run| run.len()).collect()
}

/// Chi-square test of `P(length = k) = (1 - stay) stay^(k - 1)`, two-sided at 4 sigma.
pub(super) fn check_geometric(lengths: &[usize], stay: f64) {
    const MIN_EXPECTED: f64 = 20.0;
    let n = lengths.len() as f64;
    let mean = lengths.iter().sum::<usize>() as f64 / n;
    let expected_mean = 1.0 / (1.0 - stay);
    let sigma = stay.sqrt() * expected_mean / n.sqrt();
    assert!(
        (mean - expected_mean).abs() <= 4.0 * sigma + 1e-9,
        "{mean}, expected {expected_mean} +- {sigma}"
    );
    let mut left = lengths.len();
    let mut tail = n;
    let mut length = 1;
    let mut chi_square = 0.0;
    let mut bins = 0;
    while tail * stay > MIN_EXPECTED {
        let expected = tail * (1.0 - stay);
        let seen = lengths.iter().filter(|&&seen| seen == length).count();
        chi_square += (seen as f64 - expected).powi(2) / expected;
        (left, tail, length, bins) = (left - seen, tail - expected, length + 1, bins + 1);
    }
    chi_square += (left as f64 - tail).powi(2) / tail;
    let freedom = f64::from(bins);
    assert!((chi_square - freedom).abs() <= 4.0 * (2.0 * freedom).sqrt() + 1e-9, "{chi_square} of {freedom}");
}
