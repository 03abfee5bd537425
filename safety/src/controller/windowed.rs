//! Windowing safety controller, WSC.

use crate::{
    About, DeviceModel, Observation, ParameterError, Real,
    controller::{Controller, Observed, SafetySettings, Verdict},
    lanes::{pack, part},
    observer::WindowedSafetyObserver,
    parameter::{in_range, whole},
};

/// WSC: unsafe while `E_wso < delta`, with delta negative.
///
/// Source: paper Eq. 13.
#[derive(Clone, Debug, PartialEq)]
pub struct WindowedSafetyController<const N: usize, S = f64> {
    observer: WindowedSafetyObserver<N, S>,
    energy_threshold_j: S,
}

impl<const N: usize> WindowedSafetyController<N> {
    /// Energy threshold delta in J (< 0: a safe hand may take out a little energy).
    pub fn new(observer: WindowedSafetyObserver<N>, energy_threshold_j: f64) -> Result<Self, ParameterError> {
        let energy_threshold_j = in_range(
            "energy_threshold_j",
            "delta",
            energy_threshold_j,
            f64::MIN,
            -f64::MIN_POSITIVE,
            "finite and below 0",
        )?;
        Ok(Self { observer, energy_threshold_j })
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
        let SafetySettings { window, energy_ratio, energy_threshold_j, .. } = *settings;
        whole("window", "w", window, 1, WindowedSafetyObserver::<N>::MAX_WINDOW, "1 to 3600000 ticks")?;
        // A window that nobody reads is not reserved.
        let window = if is_used { window } else { 1 };
        let observer = WindowedSafetyObserver::new(*device, period_s, energy_ratio, window)?;
        WindowedSafetyController::new(observer, energy_threshold_j)
    }

    /// If their observers can be gathered.
    fn gather(of: &[Self::One]) -> Option<Self> {
        Some(Self {
            observer: part(of, |one| one.observer.clone(), WindowedSafetyObserver::gather)?,
            energy_threshold_j: pack(of, |one| one.energy_threshold_j)?,
        })
    }

    #[inline(always)]
    fn step(&mut self, seen: &Observation<N, S>) -> Verdict<N, S> {
        let observed = self.observer.step(seen);
        Verdict::without_force(observed, observed.simd_lt(self.energy_threshold_j))
    }

    /// delta, of Eq. 10.
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
    fn it_is_unsafe_below_its_threshold_and_forgets_by_a_reset() {
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
}
