//! Velocity and acceleration of the device from its sampled position.
//!
//! Each estimator is one file. All share one contract ([`Estimator`]); what sets them apart is how much of the
//! encoder's quantisation they let through and how late they are. [`EstimatorKind`] names them with their
//! parameters, [`AnyEstimator`] holds any of them. [`MeasuredVelocity`] stands apart: it serves the devices that
//! measure V themselves.

use crate::{Axes, Real};

mod adaptive_window;
mod any;
mod backward_difference;
#[cfg(test)]
mod contract_tests;
mod kalman;
mod low_pass;
mod measured_velocity;
mod ring;
mod savitzky_golay;
mod straight_line;

pub use adaptive_window::AdaptiveWindow;
pub use any::{AnyEstimator, EstimatorKind};
pub use backward_difference::BackwardDifference;
pub use kalman::Kalman;
pub use low_pass::LowPass;
pub use measured_velocity::MeasuredVelocity;
pub use savitzky_golay::SavitzkyGolay;
pub use straight_line::Fit;

/// Longest window in ticks that a windowed estimator takes; its memory is reserved for it.
pub const MAX_WINDOW: usize = 128;

/// Velocity V in m/s and acceleration A in m/s² of the device at one tick (rad/s, rad/s² for joints).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Motion<const N: usize, S = f64> {
    /// V.
    pub velocity: Axes<N, S>,
    /// A, a weighted mean of the true acceleration over the last ticks.
    pub acceleration: Axes<N, S>,
}

/// A causal estimator of velocity and acceleration.
///
/// Per tick n: first [`step`](Estimator::step) with x\[n\], then at most once
/// [`align`](Estimator::align) with `F_device`\[n-1\]. A caller that needs `align` calls it at every tick, for it
/// remembers past forces; one that does not need it never calls it and pays nothing.
///
/// A new estimator takes the device to have rested at the first position it is given.
pub trait Estimator<const N: usize, S: Real = f64> {
    /// Takes the position x\[n\] in m and gives V\[n\] and A\[n\].
    fn step(&mut self, position: &Axes<N, S>) -> Motion<N, S>;

    /// Passes the force held over the tick that ended with the newest position through the same kernel that
    /// stands between the true acceleration and A.
    ///
    /// An estimate A\[n\] is late: it is a mean of the true acceleration over some past ticks. Eq. 4 subtracts a
    /// force from m A, so the force must be the same mean, or every step of the device force would look like a hand.
    fn align(&mut self, device_force: &Axes<N, S>) -> Axes<N, S>;

    /// Forgets the past: the device has been at rest at `position`, without force.
    fn reset(&mut self, position: &Axes<N, S>);
}
