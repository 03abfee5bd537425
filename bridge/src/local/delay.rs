//! A force that acts some ticks late.

use haptether_safety::{Axes, Real};

/// A line of `ticks` values: what goes in comes out so many ticks later; before that, nothing.
#[derive(Clone, Debug, PartialEq)]
pub struct DelayLine<const N: usize, S: Real = f64> {
    under_way: Box<[Axes<N, S>]>,
    next: usize,
}

impl<const N: usize, S: Real> DelayLine<N, S> {
    /// Lines side by side, before their first tick; none if their lengths differ.
    pub(crate) fn gather(of: &[&DelayLine<N>]) -> Option<Self> {
        let ticks = of.first()?.under_way.len();
        of.iter().all(|one| one.under_way.len() == ticks).then(|| Self::new(ticks))
    }

    /// A line of that many ticks; 0 passes at once.
    pub fn new(ticks: usize) -> Self {
        Self { under_way: vec![Axes::zeros(); ticks].into_boxed_slice(), next: 0 }
    }

    /// Puts one in and takes one out.
    #[inline(always)]
    pub fn pass(&mut self, force: Axes<N, S>) -> Axes<N, S> {
        let Some(slot) = self.under_way.get_mut(self.next) else { return force };
        let out = std::mem::replace(slot, force);
        self.next = if self.next + 1 == self.under_way.len() { 0 } else { self.next + 1 };
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_goes_in_comes_out_so_many_ticks_later() {
        for ticks in [0_usize, 1, 3, 50] {
            let mut line = DelayLine::<1>::new(ticks);
            for n in 0..200_usize {
                let out = line.pass(Axes::<1>::new(n as f64 + 1.0))[0];
                let expected = if n < ticks { 0.0 } else { (n - ticks) as f64 + 1.0 };
                assert_eq!(out, expected);
            }
        }
    }
}
