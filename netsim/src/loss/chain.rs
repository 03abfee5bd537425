//! Markov chains that take one step per packet.

use crate::random::{Chance, Stream};

/// Most packets that a chain steps over at once, those that a rule before it dropped. After more than these it
/// starts from its stationary law again, so that no packet costs more.
const MAX_STEPS: u64 = 10_000;

/// A distribution over the states `0..N`, as a table of its sums.
#[derive(Clone, Copy, Debug)]
struct Law<const N: usize> {
    up_to: [Chance; N],
}

impl<const N: usize> Law<N> {
    /// Of probabilities that sum to 1, but for rounding.
    fn new(probabilities: [f64; N]) -> Self {
        let mut sum = 0.0;
        Self {
            up_to: probabilities.map(|probability| {
                sum += probability;
                Chance::new(sum.clamp(0.0, 1.0))
            }),
        }
    }

    fn pick(&self, bits: u64) -> usize {
        // What rounding leaves below 1 belongs to the last state.
        self.up_to.iter().position(|chance| chance.takes(bits)).unwrap_or(N - 1)
    }
}

/// A Markov chain over the states `0..N`, whose state at packet n follows from that at n - 1 and one draw.
#[derive(Clone, Copy, Debug)]
pub(super) struct Chain<const N: usize> {
    stationary: Law<N>,
    rows: [Law<N>; N],
    stream: Stream,
    /// Index of the last packet and the state at it.
    last: Option<(u64, usize)>,
}

impl<const N: usize> Chain<N> {
    /// A chain by its stationary law, in which it starts, and its rows of transition probabilities.
    pub(super) fn new(stationary: [f64; N], rows: [[f64; N]; N], stream: Stream) -> Self {
        Self { stationary: Law::new(stationary), rows: rows.map(Law::new), stream, last: None }
    }

    /// The state at a packet. Packets that never came here take a step each all the same, so that a rule before
    /// this one leaves the states as they are.
    pub(super) fn state(&mut self, index: u64) -> usize {
        let state = match self.last {
            Some((last, state)) if last <= index && index - last <= MAX_STEPS => {
                (last + 1..=index).fold(state, |state, index| self.rows[state].pick(self.stream.bits(index)))
            }
            _ => self.stationary.pick(self.stream.bits(index)),
        };
        self.last = Some((index, state));
        state
    }
}
