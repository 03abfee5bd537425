//! How a safety layer is built.

use crate::{DeviceModel, controller::SafetySettings, estimator::EstimatorKind, limiter::LimiterSettings};

/// How a safety layer is built.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LayerSettings<const N: usize> {
    /// Dynamics of the device, for the grasp force and the kinetic energy.
    pub device: DeviceModel<N>,
    /// dT in s.
    pub period_s: f64,
    /// How V and A are had from positions, for a device that does not measure its velocity.
    pub estimator: EstimatorKind,
    /// Observers and controllers.
    pub safety: SafetySettings,
    /// Bounds on the device force.
    pub limiter: LimiterSettings,
}
