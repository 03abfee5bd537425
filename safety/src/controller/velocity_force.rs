//! Velocity and force controller, VFC.

use crate::{Observation, observer::VelocityForceObserver};

/// VFC: unsafe while `S_vf > 1`.
///
/// Source: paper Eq. 2.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct VelocityForceController {
    observer: VelocityForceObserver,
}

impl VelocityForceController {
    /// A controller on that observer.
    pub fn new(observer: VelocityForceObserver) -> Self {
        Self { observer }
    }

    /// `S_vf` and whether it is unsafe.
    pub fn judge<const N: usize>(&self, seen: &Observation<N>) -> (f64, bool) {
        let observed = self.observer.observe(seen);
        (observed, observed > 1.0)
    }
}
