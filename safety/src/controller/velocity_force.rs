//! Velocity and force controller, VFC.

use crate::{Observation, Real, lanes::part, observer::VelocityForceObserver};

/// VFC: unsafe while `S_vf > 1`.
///
/// Source: paper Eq. 2.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct VelocityForceController<S = f64> {
    observer: VelocityForceObserver<S>,
}

impl<S: Real> VelocityForceController<S> {
    /// A controller on that observer.
    pub fn new(observer: VelocityForceObserver<S>) -> Self {
        Self { observer }
    }

    /// As many controllers as there are lanes, all of one form; else None.
    pub fn gather(of: &[VelocityForceController]) -> Option<Self> {
        part(of, |one| one.observer, VelocityForceObserver::gather).map(Self::new)
    }

    /// `S_vf` and whether it is unsafe.
    #[inline(always)]
    pub fn judge<const N: usize>(&self, seen: &Observation<N, S>) -> (S, S::SimdBool) {
        let observed = self.observer.observe(seen);
        (observed, observed.simd_gt(S::splat(1.0)))
    }
}
