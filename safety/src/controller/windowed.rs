//! Windowing safety controller, WSC.

use crate::{Observation, ParameterError, observer::WindowedSafetyObserver, parameter::in_range};

/// WSC: unsafe while `E_wso < delta`, with delta negative.
///
/// Source: paper Eq. 13.
#[derive(Clone, Debug, PartialEq)]
pub struct WindowedSafetyController<const N: usize> {
    observer: WindowedSafetyObserver<N>,
    energy_threshold_j: f64,
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

    /// `E_wso` in J after this tick and whether it is unsafe.
    pub fn step(&mut self, seen: &Observation<N>) -> (f64, bool) {
        let observed = self.observer.step(seen);
        (observed, observed < self.energy_threshold_j)
    }

    /// Forgets all energy.
    pub fn reset(&mut self) {
        self.observer.reset();
    }
}
