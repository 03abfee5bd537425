//! The whole chain of one master tick: from a device sample to the force it is told to exert.

mod chain;
mod door;
mod settings;
#[cfg(test)]
mod tests;
mod tick;

pub use settings::LayerSettings;
pub use tick::{Advance, SafetyTick};

use crate::{
    Axes, DeviceModel, Fault, ParameterError, Real,
    controller::{ControllerKind, SafetyController},
    estimator::{AnyEstimator, MeasuredVelocity},
    lanes::{option, pack, part},
    limiter::{Limiter, LimiterSettings},
};

/// Estimator, grasp force, observers, controllers and limiter in one step.
///
/// The limiter stands at both ends: before the observers, so that they see the force that can be rendered, and after
/// the controllers, so that nothing leaves unbounded.
///
/// Source: paper Eq. 1 to 14, in the order of `docs/architecture.md`, "One master tick".
#[derive(Clone, Debug)]
pub struct SafetyLayer<const N: usize, S = f64> {
    device: DeviceModel<N, S>,
    estimator: AnyEstimator<N, S>,
    measured: MeasuredVelocity<N, S>,
    /// The estimator once more, as the kernel for `F_v`; only where HSC reads it.
    rendered: Option<AnyEstimator<N, S>>,
    last_rendered: Axes<N, S>,
    /// What the device can render of what is asked: norm, growth and ramp-in of `F_v` alone.
    rendering: Limiter<N, S>,
    controller: SafetyController<N, S>,
    /// The bounds on the sum.
    limiter: Limiter<N, S>,
    device_force: Axes<N, S>,
    fault: Option<Fault>,
}

impl<const N: usize> SafetyLayer<N> {
    /// A layer for a device at rest, without force.
    pub fn new(settings: &LayerSettings<N>) -> Result<Self, ParameterError> {
        let LayerSettings { device, period_s, estimator, safety, limiter } = settings;
        Ok(Self {
            device: *device,
            estimator: estimator.build(*period_s)?,
            measured: MeasuredVelocity::new(*period_s)?,
            rendered: safety
                .controllers
                .contains(ControllerKind::Hsc)
                .then(|| estimator.build(*period_s))
                .transpose()?,
            last_rendered: Axes::zeros(),
            controller: SafetyController::new(device, *period_s, safety)?,
            rendering: Limiter::new(*period_s, *limiter)?,
            limiter: Limiter::new(*period_s, LimiterSettings { ramp_in_s: 0.0, ..*limiter })?,
            device_force: Axes::zeros(),
            fault: None,
        })
    }
}

impl<const N: usize, S: Real> SafetyLayer<N, S> {
    /// As many layers as there are lanes, without fault, whose parts can be gathered; else None. Period, estimator
    /// and what is watched must be the same in all; thresholds, bounds, times and the device need not.
    pub fn gather(of: &[SafetyLayer<N>]) -> Option<Self> {
        if of.iter().any(|one| one.fault.is_some()) {
            return None;
        }
        Some(Self {
            device: part(of, |one| one.device, DeviceModel::gather)?,
            estimator: part(of, |one| one.estimator.clone(), AnyEstimator::gather)?,
            measured: part(of, |one| one.measured.clone(), MeasuredVelocity::gather)?,
            rendered: option(of, |one| one.rendered.clone(), AnyEstimator::gather)?,
            last_rendered: pack(of, |one| one.last_rendered)?,
            rendering: part(of, |one| one.rendering.clone(), Limiter::gather)?,
            controller: part(of, |one| one.controller.clone(), SafetyController::gather)?,
            limiter: part(of, |one| one.limiter.clone(), Limiter::gather)?,
            device_force: pack(of, |one| one.device_force)?,
            fault: None,
        })
    }
}
