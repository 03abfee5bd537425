//! Windowed safety observer, WSO.

use crate::{
    About, DeviceModel, Observation, ParameterError, Real,
    parameter::{integer_in_range, positive, ratio},
};
use haptether_numeric::{pack, padded, part, shared};

/// WSO: the safety observer over the last w ticks only, so that old energy hides nothing.
///
/// `E_wso(n) = dT sum_{i=max(1, n-w+1)..n} F_h(i)·V(i) - V(n)' M V(n) / (2 eta)`
///
/// Each tick costs one addition and one subtraction for any w. A plain running sum would keep the rounding error of
/// every large sample. Here, each pass over the ring also builds a fresh sum, which replaces the running sum at its
/// end. A rounding error therefore lasts at most one window after its sample has left.
///
/// Source: paper Eq. 11, both branches: an empty ring holds zeros, which gives the branch n < w.
#[derive(Clone, Debug, PartialEq)]
pub struct WindowedSafetyObserver<const N: usize, S = f64> {
    device: DeviceModel<N, S>,
    period_s: f64,
    /// 1 / eta.
    per_ratio: S,
    power: Box<[S]>,
    next: usize,
    /// Sum over the ring.
    running: S,
    /// Sum over the values that this pass has written; it becomes `running` at the end of the pass.
    fresh: S,
}

impl<const N: usize> WindowedSafetyObserver<N> {
    /// Name, title and source.
    pub const ABOUT: About =
        About { name: "wso", title: "energy of the hand in a window", source: "paper Eq. 11" };

    /// Longest window: an hour at 1 kHz.
    pub const MAX_WINDOW: usize = 3_600_000;

    /// Create an observer with period dT in s (> 0), energy ratio eta in (0, 1] and window w in ticks (1 to
    /// [`Self::MAX_WINDOW`]).
    pub fn new(
        device: DeviceModel<N>,
        period_s: f64,
        energy_ratio: f64,
        window: usize,
    ) -> Result<Self, ParameterError> {
        integer_in_range("window", "w", window, 1, Self::MAX_WINDOW, "1 to 3600000 ticks")?;
        Ok(Self {
            device,
            period_s: positive("period_s", "dT", period_s)?,
            per_ratio: ratio("energy_ratio", "eta", energy_ratio)?.recip(),
            power: vec![0.0; window].into_boxed_slice(),
            next: 0,
            running: 0.0,
            fresh: 0.0,
        })
    }
}

impl<const N: usize, S: Real> WindowedSafetyObserver<N, S> {
    /// Gather one observer per lane, all of one period, one window and one ring position; else return None.
    pub fn gather(of: &[&WindowedSafetyObserver<N>]) -> Option<Self> {
        let window = shared(of, |one| one.power.len())?;
        let mut power = vec![S::splat(0.0); window].into_boxed_slice();
        // Copy one ring after the other, the fastest order while a window fits into a cache.
        for (lane, one) in padded(of, S::LANES).enumerate() {
            for (lanes, watts) in power.iter_mut().zip(&one.power) {
                lanes.replace(lane, *watts);
            }
        }
        Some(Self {
            device: part(of, |one| &one.device, DeviceModel::gather)?,
            period_s: shared(of, |one| one.period_s)?,
            per_ratio: pack(of, |one| one.per_ratio)?,
            power,
            next: shared(of, |one| one.next)?,
            running: pack(of, |one| one.running)?,
            fresh: pack(of, |one| one.fresh)?,
        })
    }

    /// Add this tick and return `E_wso` in J.
    #[inline(always)]
    pub fn step(&mut self, seen: &Observation<N, S>) -> S {
        let power = seen.grasp_force.dot(&seen.velocity);
        self.push(power);
        S::splat(self.period_s) * self.running - self.device.kinetic_energy_j(&seen.velocity) * self.per_ratio
    }

    #[inline(always)]
    fn push(&mut self, power: S) {
        self.running += power - self.power[self.next];
        self.fresh += power;
        self.power[self.next] = power;
        self.next += 1;
        if self.next == self.power.len() {
            self.next = 0;
            self.running = self.fresh;
            self.fresh = S::splat(0.0);
        }
    }

    /// Clear all energy.
    pub fn reset(&mut self) {
        let nothing = S::splat(0.0);
        self.power.fill(nothing);
        (self.next, self.running, self.fresh) = (0, nothing, nothing);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Axes;
    use nalgebra::SimdValue as _;
    use proptest::prelude::*;
    use simba::simd::AutoF64x4;

    fn observer(window: usize) -> WindowedSafetyObserver<1> {
        let device = DeviceModel::uniform(0.157, 0.0, 0.0).unwrap();
        WindowedSafetyObserver::new(device, 1e-3, 0.5, window).unwrap()
    }

    fn seen(velocity: f64, force: f64) -> Observation<1> {
        Observation::exact(Axes::<1>::new(velocity), Axes::zeros(), Axes::<1>::new(force))
    }

    proptest! {
        #[test]
        fn equals_eq_11(
            samples in prop::collection::vec((-2.0..2.0f64, -10.0..10.0f64), 1..300),
            window in 1usize..120,
        ) {
            let mut observer = observer(window);
            for n in 0..samples.len() {
                let (v, f) = samples[n];
                let energy = observer.step(&seen(v, f));
                let first = (n + 1).saturating_sub(window);
                let sum: f64 = samples[first..=n].iter().map(|(v, f)| v * f).sum();
                // |power| <= 20, at most 420 additions: 420 * 8400 * 2^-53 * dT.
                prop_assert!((energy - (1e-3 * sum - 0.157 * v * v)).abs() < 1e-12);
            }
        }
    }

    /// Gathered observers with partly filled windows continue bit for bit like the single ones.
    #[test]
    fn gather_keeps_the_windows() {
        let speed = |lane: usize| [0.1, -0.2, 0.3, -0.4][lane];
        let mut alone = [7; 4].map(observer);
        for tick in 0..10 {
            for (lane, one) in alone.iter_mut().enumerate() {
                one.step(&seen(speed(lane), f64::from(tick)));
            }
        }
        let mut together = WindowedSafetyObserver::<1, AutoF64x4>::gather(&alone.each_ref()).unwrap();
        for tick in 10..30 {
            let velocity = AutoF64x4::new(speed(0), speed(1), speed(2), speed(3));
            let force = Axes::<1, AutoF64x4>::new(AutoF64x4::splat(f64::from(tick)));
            let energy =
                together.step(&Observation::exact(Axes::<1, AutoF64x4>::new(velocity), Axes::zeros(), force));
            for (lane, one) in alone.iter_mut().enumerate() {
                let expected = one.step(&seen(speed(lane), f64::from(tick)));
                assert_eq!(energy.extract(lane).to_bits(), expected.to_bits(), "{tick} {lane}");
            }
        }
    }

    /// Noise from `SplitMix64`, since the test needs 1e8 draws quickly.
    fn noise(state: &mut u64) -> f64 {
        *state = state.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let z = (*state ^ (*state >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        #[allow(clippy::cast_possible_wrap)]
        let signed = (z ^ (z >> 27)) as i64;
        signed as f64 / 9.3e18
    }

    #[test]
    fn does_not_drift_over_1e8_updates() {
        const WINDOW: usize = 100;
        const SPIKE_EVERY: usize = 1_000_000;
        let mut observer = observer(WINDOW);
        let mut raw = 0.0;
        let mut raw_ring = [0.0; WINDOW];
        let mut state = 1;
        let mut worst: f64 = 0.0;
        for n in 0..100_000_000 {
            let size = if n % SPIKE_EVERY == 0 { 1e6 } else { 1.0 };
            let power = 10.0 * size * noise(&mut state);
            observer.push(power);
            raw += power - raw_ring[n % WINDOW];
            raw_ring[n % WINDOW] = power;
            // The spike leaves the ring after WINDOW ticks; the test allows one more window.
            if n % SPIKE_EVERY == 2 * WINDOW {
                let sum: f64 = observer.power.iter().sum();
                worst = worst.max(1e-3 * (observer.running - sum).abs());
            }
        }
        assert!(worst < 1e-11, "{worst:e} J");
        let sum: f64 = raw_ring.iter().sum();
        assert!(1e-3 * (raw - sum).abs() > 1e-11, "a plain sum must drift, or the test shows nothing");
    }
}
