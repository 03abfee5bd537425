//! One value along each of N axes.

use crate::{ModelError, require};

/// One value along each of N axes: m, m/s or N.
pub type Axes<const N: usize> = nalgebra::SVector<f64, N>;

/// Requires of every axis what `require` requires of a number.
pub(crate) fn require_axes<const N: usize>(
    name: &'static str,
    seen: &Axes<N>,
    holds: impl Fn(f64) -> bool,
    allowed: &'static str,
) -> Result<(), ModelError> {
    seen.iter().try_for_each(|&value| require(name, value, holds(value), allowed))
}

pub(crate) fn all_finite<const N: usize>(values: &Axes<N>) -> bool {
    values.iter().all(|value| value.is_finite())
}
