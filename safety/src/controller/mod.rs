//! Safety controllers: when an observer calls the hand unsafe, take the push away and damp.

mod combined;
mod hand_grasp;
mod passivity;
mod registry;
mod response;
mod velocity_force;
mod windowed;

pub use combined::{SafetyController, SafetySettings};
pub use hand_grasp::HandGraspController;
pub use passivity::{PassivityAction, PassivityController};
pub use registry::{ControllerKind, Controllers};
pub use response::{Intervention, Response, Tripped};
pub use velocity_force::VelocityForceController;
pub use windowed::WindowedSafetyController;

use crate::{Axes, DeviceModel, Observation, ParameterError, Real, parameter::in_range};

/// `F_c = -F_v - mu V`: cancels the rendered force and damps the motion, so that the device renders `-mu V`.
///
/// Source: paper Eq. 2, 13 and 14, which share it.
#[inline(always)]
pub(crate) fn cancel_and_damp<const N: usize, S: Real>(seen: &Observation<N, S>, damping: S) -> Axes<N, S> {
    -seen.rendered_force - seen.velocity * damping
}

/// Passes a damping mu in N s/m that a sampled loop can apply without feeding the motion: up to `m / (5 dT)`.
///
/// Held over a tick, `-mu V` turns V into `V (1 - mu dT / m)`, which reverses the motion above `m / dT`; but an
/// estimated V lags by several ticks, and damping that is late becomes a spring that pushes. At a fifth, every
/// smoothing estimator of this crate still brings a device to rest (`tests/damping.rs`).
pub(crate) fn dampable<const N: usize>(
    name: &'static str,
    symbol: &'static str,
    damping: f64,
    device: &DeviceModel<N>,
    period_s: f64,
) -> Result<f64, ParameterError> {
    let most = device.lightest_kg() / (5.0 * period_s);
    in_range(name, symbol, damping, 0.0, most, "between 0 and m / (5 dT)")
}
