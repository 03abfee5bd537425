//! Windowing safety controller, WSC.

use crate::{
    Observation, ParameterError, Real,
    lanes::{pack, part},
    observer::WindowedSafetyObserver,
    parameter::in_range,
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

impl<const N: usize, S: Real> WindowedSafetyController<N, S> {
    /// As many controllers as there are lanes, if their observers can be gathered; else None.
    pub fn gather(of: &[WindowedSafetyController<N>]) -> Option<Self> {
        Some(Self {
            observer: part(of, |one| one.observer.clone(), WindowedSafetyObserver::gather)?,
            energy_threshold_j: pack(of, |one| one.energy_threshold_j)?,
        })
    }

    /// `E_wso` in J after this tick and whether it is unsafe.
    #[inline(always)]
    pub fn step(&mut self, seen: &Observation<N, S>) -> (S, S::SimdBool) {
        let observed = self.observer.step(seen);
        (observed, observed.simd_lt(self.energy_threshold_j))
    }

    /// Forgets all energy.
    pub fn reset(&mut self) {
        self.observer.reset();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Axes, DeviceModel};

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
            let (energy_j, seen) = controller.step(&thrown(v));
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
