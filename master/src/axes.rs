//! Vectors over the axes of a device, and their scalar types.

use std::ops::Neg;

use nalgebra::{
    ClosedAddAssign, ClosedDivAssign, ClosedMulAssign, ClosedSubAssign, SVector, Scalar, SimdPartialOrd,
    SimdRealField, SimdValue,
};
use num_traits::{One, Zero};

/// One value per axis: position in m (rad), velocity in m/s (rad/s) or force in N (N m).
pub type Axes<const N: usize, S = f64> = SVector<S, N>;

/// A real number, or one lane per scenario when several scenarios advance side by side.
///
/// Generic code uses `select` where lanes may differ and branches only on what they share. Each lane is
/// therefore bit-identical to `f64`.
pub trait Real:
    Scalar
    + Copy
    + Zero
    + One
    + ClosedAddAssign
    + ClosedSubAssign
    + ClosedMulAssign
    + ClosedDivAssign
    + Neg<Output = Self>
    + SimdPartialOrd
    + SimdValue<Element = f64>
{
    /// Square root per lane.
    #[must_use]
    fn root(self) -> Self;

    /// Absolute value per lane.
    #[must_use]
    fn magnitude(self) -> Self;

    /// Nearest whole number per lane, halves away from zero.
    #[must_use]
    fn rounded(self) -> Self;
}

impl<S: SimdRealField + SimdValue<Element = f64> + Copy> Real for S {
    #[inline(always)]
    fn root(self) -> Self {
        self.simd_sqrt()
    }

    #[inline(always)]
    fn magnitude(self) -> Self {
        self.simd_abs()
    }

    #[inline(always)]
    fn rounded(self) -> Self {
        self.simd_round()
    }
}

/// Euclidean norm per lane. One axis needs no root; the bits are the same unless the square over- or
/// underflows.
#[inline(always)]
pub(crate) fn norm<const N: usize, S: Real>(value: &Axes<N, S>) -> S {
    if N == 1 { value[0].magnitude() } else { value.dot(value).root() }
}
