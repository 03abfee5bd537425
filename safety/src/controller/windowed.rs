//! Windowing safety controller, WSC.

use crate::{
    About, DeviceModel, Observation, ParameterError, Real,
    controller::{Controller, Observed, SafetySettings, Verdict},
    observer::WindowedSafetyObserver,
    parameter::{in_range, integer_in_range, non_negative},
};
use haptether_numeric::{norm, pack, part};

/// WSC: unsafe while `E_wso < delta`, with delta negative. With a force threshold,
/// `F_v·V / |V| > F_w` must hold too.
///
/// `E_wso` also falls below delta when a hand moves fast in free motion or meets a wall. Then no
/// push could eject the device, and `F_w` accepts the motion.
///
/// Source: paper Eq. 13; `F_w`, `docs/thresholds.md`.
#[derive(Clone, Debug, PartialEq)]
pub struct WindowedSafetyController<const N: usize, S = f64> {
    observer: WindowedSafetyObserver<N, S>,
    energy_threshold_j: S,
    /// `F_w`; 0 disables the condition.
    force_threshold_n: S,
    /// True if `F_w` is 0 in every lane: Eq. 13 as printed.
    has_no_force_threshold: bool,
}

impl<const N: usize> WindowedSafetyController<N> {
    /// Create a controller with the energy threshold delta in J (< 0: a safe hand may extract a little energy).
    pub fn new(observer: WindowedSafetyObserver<N>, energy_threshold_j: f64) -> Result<Self, ParameterError> {
        let energy_threshold_j = in_range(
            "energy_threshold_j",
            "delta",
            energy_threshold_j,
            f64::MIN,
            -f64::MIN_POSITIVE,
            "finite and below 0",
        )?;
        Ok(Self { observer, energy_threshold_j, force_threshold_n: 0.0, has_no_force_threshold: true })
    }

    /// Set the force threshold `F_w` in N (>= 0); 0 is Eq. 13 as printed.
    pub fn with_force_threshold(self, force_threshold_n: f64) -> Result<Self, ParameterError> {
        let force_threshold_n = non_negative("force_threshold_n", "F_w", force_threshold_n)?;
        Ok(Self { force_threshold_n, has_no_force_threshold: force_threshold_n == 0.0, ..self })
    }
}

impl<const N: usize, S: Real> Controller<N, S> for WindowedSafetyController<N, S> {
    type One = WindowedSafetyController<N>;
    const ABOUT: &'static About = &About { name: "wsc", title: "windowed energy", source: "paper Eq. 13" };
    const OBSERVED: &'static Observed = &Observed {
        symbol: "E_wso [J]",
        column: "windowed_energy_j",
        meaning: "E_wso in J; null where not observed",
    };
    const READS_GRASP_FORCE: bool = true;

    fn build(
        device: &DeviceModel<N>,
        period_s: f64,
        settings: &SafetySettings,
        is_used: bool,
    ) -> Result<Self::One, ParameterError> {
        let SafetySettings { window, energy_ratio, energy_threshold_j, wsc_force_threshold_n, .. } =
            *settings;
        integer_in_range(
            "window",
            "w",
            window,
            1,
            WindowedSafetyObserver::<N>::MAX_WINDOW,
            "1 to 3600000 ticks",
        )?;
        // An unused controller reserves no window.
        let window = if is_used { window } else { 1 };
        let observer = WindowedSafetyObserver::new(*device, period_s, energy_ratio, window)?;
        WindowedSafetyController::new(observer, energy_threshold_j)?
            .with_force_threshold(wsc_force_threshold_n)
            .map_err(|error| error.of_field("force_threshold_n", "wsc_force_threshold_n"))
    }

    /// Gather controllers whose observers can be gathered.
    fn gather(of: &[&Self::One]) -> Option<Self> {
        Some(Self {
            observer: part(of, |one| &one.observer, WindowedSafetyObserver::gather)?,
            energy_threshold_j: pack(of, |one| one.energy_threshold_j)?,
            force_threshold_n: pack(of, |one| one.force_threshold_n)?,
            has_no_force_threshold: of.iter().all(|one| one.has_no_force_threshold),
        })
    }

    #[inline(always)]
    fn step(&mut self, seen: &Observation<N, S>) -> Verdict<N, S> {
        let observed = self.observer.step(seen);
        let is_low = observed.simd_lt(self.energy_threshold_j);
        if self.has_no_force_threshold {
            return Verdict::without_force(observed, is_low);
        }
        // Negated comparison: a NaN must not let a push pass.
        let along = seen.rendered_force.dot(&seen.velocity);
        let pushed = !along.simd_le(self.force_threshold_n * norm(&seen.velocity));
        let pushed = pushed | self.force_threshold_n.simd_eq(S::splat(0.0));
        Verdict::without_force(observed, is_low & pushed)
    }

    /// Return delta, of Eq. 10.
    fn threshold(settings: &SafetySettings) -> f64 {
        settings.energy_threshold_j
    }

    fn reset(&mut self) {
        self.observer.reset();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Axes;

    #[test]
    fn unsafe_below_the_threshold_and_cleared_by_reset() {
        let device = DeviceModel::uniform(0.157, 0.0, 0.0).unwrap();
        let observer = WindowedSafetyObserver::<1>::new(device, 1e-3, 0.5, 100).unwrap();
        let build = || WindowedSafetyController::new(observer.clone(), -0.03).unwrap();
        let mut controller = build();
        let thrown = |v: f64| Observation::exact(Axes::<1>::new(v), Axes::zeros(), Axes::zeros());
        // E = -m V^2 / (2 eta) is -0.03 J at 0.437 m/s.
        for (v, is_unsafe) in [(0.43, false), (0.44, true), (-0.44, true), (0.0, false)] {
            controller.reset();
            let Verdict { observed: energy_j, is_unsafe: seen, .. } = controller.step(&thrown(v));
            assert!((energy_j + 0.157 * v * v).abs() < 1e-12, "{v}: {energy_j}");
            assert_eq!(seen, is_unsafe, "{v}");
        }
        let mut held = thrown(0.5);
        held.grasp_force = Axes::<1>::new(100.0);
        controller.step(&held);
        assert_ne!(controller, build());
        controller.reset();
        assert_eq!(controller, build());
    }

    /// Only the force along the motion counts, for any direction of the motion and any force across it.
    #[test]
    fn with_a_force_threshold_a_push_must_drive_the_device() {
        let device = DeviceModel::uniform(0.157, 0.0, 0.0).unwrap();
        let observer = WindowedSafetyObserver::<2>::new(device, 1e-3, 0.5, 100).unwrap();
        let printed = WindowedSafetyController::new(observer, -0.03).unwrap();
        let (along, across) = (Axes::<2>::new(-0.6, 0.8), Axes::<2>::new(0.8, 0.6));
        for (threshold, speed, push, sideways, trips) in [
            (0.0, 0.5, 0.0, 0.0, true),
            (0.0, 0.5, -7.0, 0.0, true),
            (0.3, 0.5, 0.0, 0.0, false),
            (0.3, 0.5, 0.29, 0.0, false),
            (0.3, 0.5, 0.31, 0.0, true),
            (0.3, 0.5, -7.0, 0.0, false),
            (0.3, 0.5, 0.0, 7.0, false),
            (0.3, 0.5, 0.31, -7.0, true),
            (0.3, 0.4, 7.0, 0.0, false),
            (0.3, 0.5, f64::NAN, 0.0, true),
        ] {
            for turn in [1.0, -1.0] {
                let mut controller = printed.clone().with_force_threshold(threshold).unwrap();
                let force = (along * push + across * sideways) * turn;
                let seen = Observation::exact(along * speed * turn, force, Axes::<2>::zeros());
                assert_eq!(controller.step(&seen).is_unsafe, trips, "{threshold} {speed} {push} {sideways}");
            }
        }
        for wrong in [-0.1, f64::NAN, f64::INFINITY] {
            assert!(printed.clone().with_force_threshold(wrong).is_err());
        }
    }
}
