//! Velocity and force controller, VFC.

use crate::{
    About, DeviceModel, Observation, ParameterError, Real,
    controller::{Controller, Observed, SafetySettings, Verdict},
    observer::VelocityForceObserver,
};
use haptether_numeric::part;

/// VFC: unsafe while `S_vf > 1`.
///
/// Source: paper Eq. 2.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct VelocityForceController<const N: usize, S = f64> {
    observer: VelocityForceObserver<S>,
}

impl<const N: usize, S> VelocityForceController<N, S> {
    /// Create a controller that reads `observer`.
    pub fn new(observer: VelocityForceObserver<S>) -> Self {
        Self { observer }
    }
}

impl<const N: usize, S: Real> Controller<N, S> for VelocityForceController<N, S> {
    type One = VelocityForceController<N>;
    const ABOUT: &'static About = &About { name: "vfc", title: "velocity and force", source: "paper Eq. 2" };
    const OBSERVED: &'static Observed =
        &Observed { symbol: "S_vf", column: "velocity_force", meaning: "S_vf; null where not observed" };

    fn build(
        _: &DeviceModel<N>,
        _: f64,
        settings: &SafetySettings,
        _: bool,
    ) -> Result<Self::One, ParameterError> {
        let SafetySettings { velocity_threshold, vfc_force_threshold_n, vfc_form, .. } = *settings;
        VelocityForceObserver::new(velocity_threshold, vfc_force_threshold_n, vfc_form)
            .map(VelocityForceController::new)
            .map_err(|error| error.of_field("force_threshold_n", "vfc_force_threshold_n"))
    }

    /// Gather controllers of one form.
    fn gather(of: &[&Self::One]) -> Option<Self> {
        part(of, |one| &one.observer, VelocityForceObserver::gather).map(Self::new)
    }

    #[inline(always)]
    fn step(&mut self, seen: &Observation<N, S>) -> Verdict<N, S> {
        let observed = self.observer.observe(seen);
        Verdict::without_force(observed, observed.simd_gt(S::splat(1.0)))
    }

    /// Return 1, of Eq. 1.
    fn threshold(_: &SafetySettings) -> f64 {
        1.0
    }
}
