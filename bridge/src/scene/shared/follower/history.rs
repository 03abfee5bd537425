//! Frames of a side that its peer may still receive, for one run or for one run per lane.

use haptether_numeric::no_lanes;
use haptether_safety::{Axes, Real, Signal, is_within};

/// Content of the frame of a tick.
#[derive(Clone, Copy, Debug)]
pub(super) struct Sent<const N: usize, S: Real = f64> {
    pub(super) position: Axes<N, S>,
    pub(super) velocity: Axes<N, S>,
    pub(super) force: Axes<N, S>,
}

impl<const N: usize, S: Real> Sent<N, S> {
    fn nothing() -> Self {
        Self { position: Axes::zeros(), velocity: Axes::zeros(), force: Axes::zeros() }
    }
}

/// Largest number of ticks kept for a peer that receives nothing.
const MAX_HISTORY: usize = 8192;

/// Ticks of a side since the newest one that its peer has received.
pub(super) struct History<const N: usize, S: Real = f64> {
    pub(super) sent: Vec<Sent<N, S>>,
    next: u64,
}

impl<const N: usize, S: Real> History<N, S> {
    pub(super) fn new() -> Self {
        Self { sent: vec![Sent::nothing(); 64], next: 0 }
    }

    /// Store the next tick. Returns the mask of lanes whose frame the peer accepts; empty if the peer has received
    /// nothing for too long.
    ///
    /// `force` is the signal of the force, `heard` the newest tick that the peer has received.
    #[inline(always)]
    pub(super) fn push(&mut self, sent: Sent<N, S>, force: Signal, heard: u64) -> S::SimdBool {
        if self.next - heard >= self.sent.len() as u64 && !self.grow() {
            return no_lanes::<S>();
        }
        let slot = self.slot(self.next);
        self.sent[slot] = sent;
        self.next += 1;
        is_within(&sent.position, Signal::Position.bound())
            & is_within(&sent.velocity, Signal::Velocity.bound())
            & is_within(&sent.force, force.bound())
    }

    /// Return the slot of a tick: its last bits, since the number of slots is a power of two.
    #[inline(always)]
    #[allow(clippy::cast_possible_truncation)] // the bits are masked
    fn slot(&self, tick: u64) -> usize {
        tick as usize & (self.sent.len() - 1)
    }

    /// Double the number of slots, up to [`MAX_HISTORY`].
    #[inline(never)]
    fn grow(&mut self) -> bool {
        if self.sent.len() >= MAX_HISTORY {
            return false;
        }
        let kept = self.sent.len() as u64;
        let mut grown = Self { sent: vec![Sent::nothing(); 2 * self.sent.len()], next: self.next };
        for tick in self.next.saturating_sub(kept)..self.next {
            let slot = grown.slot(tick);
            grown.sent[slot] = *self.of(tick);
        }
        *self = grown;
        true
    }

    #[inline(always)]
    pub(super) fn of(&self, tick: u64) -> &Sent<N, S> {
        debug_assert!(
            tick < self.next && self.next - tick <= self.sent.len() as u64,
            "{tick} of {}",
            self.next
        );
        &self.sent[self.slot(tick)]
    }
}
