//! Safety observer, SO.

use crate::{
    About, DeviceModel, Observation, ParameterError, Real,
    parameter::{positive, ratio},
};
use haptether_numeric::{choose, pack, part, shared};

/// SO: energy that the hand has put in since the start, less the kinetic energy divided by eta.
///
/// `E_so(n) = dT sum_{i=1..n} F_h(i)·V(i) - V(n)' M V(n) / (2 eta)`
///
/// SO keeps all energy, so a long press hides a later ejection. The windowed observer avoids this.
///
/// Source: paper Eq. 9.
#[derive(Clone, Debug, PartialEq)]
pub struct SafetyObserver<const N: usize, S = f64> {
    device: DeviceModel<N, S>,
    period_s: f64,
    /// 1 / eta.
    per_ratio: S,
    hand_energy_j: CompensatedSum<S>,
}

impl<const N: usize> SafetyObserver<N> {
    /// Name, title and source.
    pub const ABOUT: About = About { name: "so", title: "energy of the hand", source: "paper Eq. 9" };

    /// Create an observer with period dT in s (> 0) and energy ratio eta in (0, 1].
    pub fn new(device: DeviceModel<N>, period_s: f64, energy_ratio: f64) -> Result<Self, ParameterError> {
        Ok(Self {
            device,
            period_s: positive("period_s", "dT", period_s)?,
            per_ratio: ratio("energy_ratio", "eta", energy_ratio)?.recip(),
            hand_energy_j: CompensatedSum::default(),
        })
    }
}

impl<const N: usize, S: Real> SafetyObserver<N, S> {
    /// Gather one observer per lane, all of one period; else return None.
    pub fn gather(of: &[&SafetyObserver<N>]) -> Option<Self> {
        Some(Self {
            device: part(of, |one| &one.device, DeviceModel::gather)?,
            period_s: shared(of, |one| one.period_s)?,
            per_ratio: pack(of, |one| one.per_ratio)?,
            hand_energy_j: CompensatedSum {
                sum: pack(of, |one| one.hand_energy_j.sum)?,
                lost: pack(of, |one| one.hand_energy_j.lost)?,
            },
        })
    }

    /// Add this tick and return `E_so` in J.
    #[inline(always)]
    pub fn step(&mut self, seen: &Observation<N, S>) -> S {
        self.hand_energy_j.add(S::splat(self.period_s) * seen.grasp_force.dot(&seen.velocity));
        self.hand_energy_j.total() - self.device.kinetic_energy_j(&seen.velocity) * self.per_ratio
    }

    /// Clear all energy.
    pub fn reset(&mut self) {
        self.hand_energy_j = CompensatedSum::default();
    }
}

/// Sum with a carried rounding error, since SO adds for hours at 1 kHz.
///
/// Source: Neumaier, Z. Angew. Math. Mech. 54 (1974).
#[derive(Clone, Copy, Debug, PartialEq)]
struct CompensatedSum<S = f64> {
    sum: S,
    lost: S,
}

impl<S: Real> Default for CompensatedSum<S> {
    fn default() -> Self {
        Self { sum: S::splat(0.0), lost: S::splat(0.0) }
    }
}

impl<S: Real> CompensatedSum<S> {
    #[inline(always)]
    fn add(&mut self, term: S) {
        let next = self.sum + term;
        self.lost += choose!(
            S,
            self.sum.magnitude().simd_ge(term.magnitude()),
            (self.sum - next) + term,
            (term - next) + self.sum
        );
        self.sum = next;
    }

    #[inline(always)]
    fn total(self) -> S {
        self.sum + self.lost
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Axes;

    #[test]
    fn equals_its_defining_sum() {
        let device = DeviceModel::<1>::uniform(0.157, 0.0, 0.0).unwrap();
        let mut observer = SafetyObserver::new(device, 1e-3, 0.5).unwrap();
        let mut sum = 0.0;
        for n in 1..=5000 {
            let t = f64::from(n) * 1e-3;
            let (v, f) = ((3.0 * t).sin(), (2.0 * t).cos());
            sum += 1e-3 * f * v;
            let energy =
                observer.step(&Observation::exact(Axes::<1>::new(v), Axes::zeros(), Axes::<1>::new(f)));
            assert!((energy - (sum - 0.157 * v * v)).abs() < 1e-13);
        }
    }

    #[test]
    fn small_terms_of_a_year_are_kept() {
        let mut sum = CompensatedSum::<f64>::default();
        sum.add(1e9);
        for _ in 0..1_000_000 {
            sum.add(1e-9);
        }
        sum.add(-1e9);
        // A plain sum would give 0, since 1e-9 is below half an ulp of 1e9. Each of the 1e6 additions to the carried
        // part rounds by at most half an ulp of 1e-3.
        assert!((sum.total() - 1e-3).abs() < 2e-13);
    }
}
