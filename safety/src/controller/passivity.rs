//! Passivity controller, PC.

use crate::{
    About, Axes, DeviceModel, Observation, ParameterError, Real,
    controller::{Controller, Observed, SafetySettings, Verdict, dampable},
    observer::SafetyObserver,
};
use haptether_numeric::{choose_axes, lesser, no_lanes, pack, part, shared};

/// PC: dissipates the energy that the safety observer finds missing.
///
/// `F_pc = E_so / (V dT)` for `E_so < 0`, else 0; for vectors `F_pc = E_so V / (|V|² dT)`.
///
/// The paper prints `-E_so / (V dT)`, where a force counts against the motion. Here a positive force pushes along +x
/// (`docs/architecture.md`, "Signs and symbols").
///
/// The force never exceeds `alpha V`, with alpha the largest damping that the sampled device tolerates. It therefore
/// goes to zero with V instead of to infinity. Energy that this bound leaves undissipated stays in `E_so` and is
/// requested again at the next tick.
///
/// Source: paper Eq. 12; Hannaford and Ryu 2002, section IV.
#[derive(Clone, Debug, PartialEq)]
pub struct PassivityController<const N: usize, S = f64> {
    observer: SafetyObserver<N, S>,
    period_s: f64,
    max_damping: S,
}

impl<const N: usize> PassivityController<N> {
    /// Create a controller with the bound alpha in N s/m, between 0 and m / (5 dT).
    pub fn new(
        observer: SafetyObserver<N>,
        device: &DeviceModel<N>,
        period_s: f64,
        max_damping: f64,
    ) -> Result<Self, ParameterError> {
        let max_damping = dampable("max_damping", "alpha", max_damping, device, period_s, true)?;
        Ok(Self { observer, period_s, max_damping })
    }
}

impl<const N: usize, S: Real> Controller<N, S> for PassivityController<N, S> {
    type One = PassivityController<N>;
    const ABOUT: &'static About = &About { name: "pc", title: "passivity", source: "paper Eq. 12" };
    const OBSERVED: &'static Observed =
        &Observed { symbol: "E_so [J]", column: "energy_j", meaning: "E_so in J; null where not observed" };
    const READS_GRASP_FORCE: bool = true;
    const ADDS_FORCE: bool = true;

    fn build(
        device: &DeviceModel<N>,
        period_s: f64,
        settings: &SafetySettings,
        is_used: bool,
    ) -> Result<Self::One, ParameterError> {
        let observer = SafetyObserver::new(*device, period_s, settings.energy_ratio)?;
        let alpha = dampable("pc_max_damping", "alpha", settings.pc_max_damping, device, period_s, is_used)?;
        PassivityController::new(observer, device, period_s, if is_used { alpha } else { 0.0 })
    }

    /// Gather controllers of one period.
    fn gather(of: &[&Self::One]) -> Option<Self> {
        Some(Self {
            observer: part(of, |one| &one.observer, SafetyObserver::gather)?,
            period_s: shared(of, |one| one.period_s)?,
            max_damping: pack(of, |one| one.max_damping)?,
        })
    }

    /// Compute `F_pc` in N, against the motion; no tick is unsafe.
    #[inline(always)]
    fn step(&mut self, seen: &Observation<N, S>) -> Verdict<N, S> {
        let energy_j = self.observer.step(seen);
        let squared_speed = seen.velocity.dot(&seen.velocity);
        let nothing = S::splat(0.0);
        let is_idle = energy_j.simd_ge(nothing) | squared_speed.simd_eq(nothing);
        let force = choose_axes!(S, is_idle, Axes::zeros(), {
            let missing = -energy_j / (squared_speed * S::splat(self.period_s));
            seen.velocity * -lesser(missing, self.max_damping)
        });
        Verdict { observed: energy_j, is_unsafe: no_lanes::<S>(), force }
    }

    /// Return 0, of Eq. 12.
    fn threshold(_: &SafetySettings) -> f64 {
        0.0
    }

    #[inline(always)]
    fn owed_energy_j(&self, energy_j: S, delivered: &Axes<N, S>, velocity: &Axes<N, S>) -> S {
        let dissipated = -delivered.dot(velocity) * S::splat(self.period_s);
        above_zero(-energy_j - above_zero(dissipated))
    }

    fn reset(&mut self) {
        self.observer.reset();
    }
}

/// Return the value where it is positive, else 0.
#[inline(always)]
fn above_zero<S: Real>(value: S) -> S {
    let nothing = S::splat(0.0);
    value.select(value.simd_gt(nothing), nothing)
}

#[cfg(test)]
mod tests {
    use super::*;

    const PERIOD: f64 = 1e-3;

    fn controller(max_damping: f64) -> PassivityController<1> {
        let device = DeviceModel::uniform(0.157, 0.0, 0.0).unwrap();
        let observer = SafetyObserver::new(device, PERIOD, 0.5).unwrap();
        PassivityController::new(observer, &device, PERIOD, max_damping).unwrap()
    }

    fn ejected(v: f64) -> Observation<1> {
        Observation::exact(Axes::<1>::new(v), Axes::zeros(), Axes::zeros())
    }

    #[test]
    fn dissipates_exactly_the_missing_energy_within_its_bound() {
        // The hand puts energy in, so little is missing: E = dT F_h V - m V² / (2 eta).
        let mut controller = controller(31.0);
        let mut seen = ejected(0.5);
        seen.grasp_force = Axes::<1>::new((0.157 * 0.25 - 0.005) / (0.5 * PERIOD));
        let action = controller.step(&seen);
        assert!((action.observed + 0.005).abs() < 1e-15);
        assert!((action.force[0] - action.observed / (0.5 * PERIOD)).abs() < 1e-10);
        assert!(controller.owed_energy_j(action.observed, &action.force, &Axes::<1>::new(0.5)) < 1e-15);
    }

    #[test]
    fn the_division_by_v_is_bounded_and_the_rest_is_owed() {
        let mut controller = controller(20.0);
        for v in [1e-300, 1e-9, 1e-3, -0.4, 1.4] {
            controller.reset();
            let action = controller.step(&ejected(v));
            assert!(action.force[0].abs() <= 20.0 * v.abs() * (1.0 + 1e-15), "{v}");
            assert!(action.force[0] * v <= 0.0, "against the motion at {v}");
            let owed = controller.owed_energy_j(action.observed, &action.force, &Axes::<1>::new(v));
            let expected = -action.observed - 20.0 * v * v * PERIOD;
            assert!((owed - expected).abs() <= 1e-15, "{v}: {owed} {expected}");
        }
        controller.reset();
        assert_eq!(controller.step(&ejected(0.0)).force[0], 0.0);
    }

    #[test]
    fn no_force_without_missing_energy_or_motion() {
        let mut controller = controller(20.0);
        // The hand puts in a surplus of energy, which must not push.
        let mut seen = ejected(0.5);
        seen.grasp_force = Axes::<1>::new(1e3);
        let action = controller.step(&seen);
        assert!(action.observed > 0.0);
        assert_eq!(action.force[0], 0.0);
        // At rest, with a surplus and with missing energy.
        assert_eq!(controller.step(&ejected(0.0)).force[0], 0.0);
        let mut taken = ejected(0.5);
        taken.grasp_force = Axes::<1>::new(-2e3);
        assert!(controller.step(&taken).observed < 0.0);
        assert_eq!(controller.step(&ejected(0.0)).force[0], 0.0);
        // A reset clears it.
        controller.reset();
        assert_eq!(controller, self::controller(20.0));
        assert_eq!(controller.step(&ejected(0.0)).observed, 0.0);
    }

    #[test]
    fn a_damping_that_would_reverse_the_motion_is_refused() {
        let device = DeviceModel::<1>::uniform(0.157, 0.0, 0.0).unwrap();
        let observer = SafetyObserver::new(device, PERIOD, 0.5).unwrap();
        assert!(PassivityController::new(observer, &device, PERIOD, 32.0).is_err());
    }
}
