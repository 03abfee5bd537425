//! Vectors over the axes of a device.

use nalgebra::SVector;

/// One value per axis: position in m (rad), velocity in m/s (rad/s) or force in N (N m).
pub type Axes<const N: usize> = SVector<f64, N>;

/// Sign of each axis, with `sign(0) = 0`, as Eq. 3 needs it: a device at rest has no dynamic friction.
///
/// Source: paper Eq. 3.
pub fn sign<const N: usize>(velocity: &Axes<N>) -> Axes<N> {
    velocity.map(|v| if v == 0.0 { 0.0 } else { v.signum() })
}

/// Whether every axis is finite and at most `bound` in absolute value.
pub fn is_within<const N: usize>(value: &Axes<N>, bound: f64) -> bool {
    // A comparison with NaN is false, so one test covers NaN, infinity and absurdity.
    value.iter().all(|x| x.abs() <= bound)
}
