//! Vectors over the axes of a device.

use nalgebra::SVector;

/// One value per axis: position in m (rad), velocity in m/s (rad/s) or force in N (N m).
pub type Axes<const N: usize, S = f64> = SVector<S, N>;

/// Whether every axis is finite and at most `bound` in absolute value.
#[inline]
pub fn is_within<const N: usize>(value: &Axes<N>, bound: f64) -> bool {
    // A comparison with NaN is false, so one test covers NaN, infinity and absurdity.
    value.iter().all(|x| x.abs() <= bound)
}
