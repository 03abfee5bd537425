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
