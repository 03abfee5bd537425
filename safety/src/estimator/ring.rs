//! The last samples of a vector, newest first.

use super::MAX_WINDOW;
use crate::lanes::{pack, shared};
use crate::{Axes, Real};

/// A ring of the last `length` samples; never allocates.
#[derive(Clone, Debug)]
pub(super) struct Ring<const N: usize, S = f64> {
    samples: [Axes<N, S>; MAX_WINDOW],
    newest: usize,
    length: usize,
}

impl<const N: usize, S: Real> Ring<N, S> {
    /// A ring of `length` zeros, from 1 to [`MAX_WINDOW`].
    pub(super) fn new(length: usize) -> Self {
        Self { samples: [Axes::zeros(); MAX_WINDOW], newest: 0, length: length.clamp(1, MAX_WINDOW) }
    }

    /// As many rings as there are lanes, all of one length and at the same place; else None.
    pub(super) fn gather(of: &[&Ring<N>]) -> Option<Self> {
        let mut ring = Self::new(shared(of, |one| one.length)?);
        ring.newest = shared(of, |one| one.newest)?;
        for (tick, sample) in ring.samples.iter_mut().enumerate() {
            *sample = pack(of, |one| one.samples[tick])?;
        }
        Some(ring)
    }

    /// Makes every sample equal to `sample`.
    pub(super) fn fill(&mut self, sample: &Axes<N, S>) {
        self.samples.fill(*sample);
    }

    /// Puts `sample` in the place of the oldest.
    #[inline]
    pub(super) fn push(&mut self, sample: &Axes<N, S>) {
        self.newest = (self.newest + 1) % self.length;
        self.samples[self.newest] = *sample;
    }

    /// The samples from the newest to the oldest.
    #[inline]
    pub(super) fn newest_first(&self) -> impl Iterator<Item = &Axes<N, S>> {
        let (recent, old) = self.samples[..self.length].split_at(self.newest + 1);
        recent.iter().rev().chain(old.iter().rev())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_newest_comes_first_and_the_oldest_falls_out() {
        let mut ring = Ring::<1>::new(3);
        for sample in [1.0, 2.0, 3.0, 4.0, 5.0] {
            ring.push(&Axes::from([sample]));
        }
        let seen: Vec<f64> = ring.newest_first().map(|sample| sample[0]).collect();
        assert_eq!(seen, [5.0, 4.0, 3.0]);
    }
}
