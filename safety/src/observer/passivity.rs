//! Energy-based passivity observer, PO.

use crate::{About, Axes, Real};
use haptether_numeric::{option, pack};

/// PO: energy that has flowed from the hand into the source of the force since the start.
///
/// `E(n) = - sum_{k<n} F_device(k)·(x(k+1) - x(k))`
///
/// The force is constant over a tick, so force times displacement is the exact work for any velocity within the tick.
/// `F V dT` is not exact. Sign: `F_device` pushes the device along +x, so the environment takes in `-F·dx`. A
/// negative value means an active environment, which has given out more energy than it took in.
///
/// Source: Hannaford and Ryu 2002, Eq. 5, with the exact sampled energy of Stramigioli et al. 2005.
#[derive(Clone, Debug, PartialEq)]
pub struct PassivityObserver<const N: usize, S = f64> {
    energy_j: S,
    position: Option<Axes<N, S>>,
}

impl<const N: usize> PassivityObserver<N> {
    /// Name, title and source.
    pub const ABOUT: About =
        About { name: "po", title: "passivity", source: "Hannaford and Ryu 2002, Eq. 5" };

    /// Create an observer without past.
    pub fn new() -> Self {
        Self::default()
    }
}

impl<const N: usize, S: Real> Default for PassivityObserver<N, S> {
    fn default() -> Self {
        Self { energy_j: S::splat(0.0), position: None }
    }
}

impl<const N: usize, S: Real> PassivityObserver<N, S> {
    /// Gather one observer per lane. Return None if some have a position and others have none, or if there are more
    /// observers than lanes.
    pub fn gather(of: &[&PassivityObserver<N>]) -> Option<Self> {
        Some(Self {
            energy_j: pack(of, |one| one.energy_j)?,
            position: option(of, |one| one.position.as_ref(), |positions| pack(positions, |at| **at))?,
        })
    }

    /// Return E in J at position x(n) in m; `held_force` in N acted since the last position.
    #[inline]
    pub fn step(&mut self, position: &Axes<N, S>, held_force: &Axes<N, S>) -> S {
        if let Some(last) = self.position {
            self.energy_j -= held_force.dot(&(position - last));
        }
        self.position = Some(*position);
        self.energy_j
    }

    /// Clear all energy.
    pub fn reset(&mut self) {
        *self = Self::default();
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::SimdValue;
    use simba::simd::AutoF64x4;

    use super::*;

    /// A sampled spring wall gives out more than it takes in: by Colgate's K T / 2 it acts as negative damping.
    #[test]
    fn sees_the_energy_leak_of_a_sampled_wall() {
        let (stiffness, period) = (200.0, 1e-3);
        let mut observer = PassivityObserver::<1>::new();
        let depth = |n: i32| 0.02 * (f64::from(n) / 1000.0 * std::f64::consts::TAU).cos() - 0.02;
        let mut held = Axes::<1>::zeros();
        let mut energy = 0.0;
        for n in 0..=1000 {
            energy = observer.step(&Axes::<1>::new(depth(n)), &held);
            held = Axes::<1>::new(-stiffness * depth(n));
        }
        // The force lags by half a tick on average: leak = K T/2 * integral of v^2 dt over one cycle of 1 s.
        let v = 0.02 * std::f64::consts::TAU;
        let leak = stiffness * period / 2.0 * v * v / 2.0;
        assert!((energy + leak).abs() < 0.01 * leak, "{energy} against -{leak}");
    }

    #[test]
    fn lanes_continue_from_their_own_past() {
        let mut one = [1.0, -3.0, 0.5, 2.0].map(|force| {
            let mut observer = PassivityObserver::<1>::new();
            for x in [0.0, 0.1] {
                observer.step(&Axes::<1>::new(x), &Axes::<1>::new(force));
            }
            observer
        });
        let mut lanes = PassivityObserver::<1, AutoF64x4>::gather(&one.each_ref()).unwrap();
        let (to, held) = (Axes::<1>::new(0.4), Axes::<1>::new(2.0));
        let seen = lanes
            .step(&Axes::from_element(AutoF64x4::splat(0.4)), &Axes::from_element(AutoF64x4::splat(2.0)));
        for (lane, one) in one.iter_mut().enumerate() {
            assert_eq!(seen.extract(lane), one.step(&to, &held), "{lane}");
        }
        one[2].reset();
        assert!(
            PassivityObserver::<1, AutoF64x4>::gather(&one.each_ref()).is_none(),
            "one observer has no position yet"
        );
    }

    #[test]
    fn reset_clears_energy_and_position() {
        let mut observer = PassivityObserver::<1>::new();
        let held = Axes::<1>::new(2.0);
        for x in [0.0, 0.1] {
            observer.step(&Axes::<1>::new(x), &held);
        }
        assert_eq!(observer.step(&Axes::<1>::new(0.2), &held), -0.4);
        observer.reset();
        assert_eq!(observer.step(&Axes::<1>::new(5.0), &held), 0.0, "a first position is not a motion");
        assert_eq!(observer.step(&Axes::<1>::new(4.5), &held), 1.0);
    }
}
