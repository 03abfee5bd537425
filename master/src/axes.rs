//! Vectors over the axes of a device, and the numbers they are made of.

use std::ops::Neg;

use nalgebra::{
    ClosedAddAssign, ClosedDivAssign, ClosedMulAssign, ClosedSubAssign, SVector, Scalar, SimdPartialOrd,
    SimdRealField, SimdValue,
};
use num_traits::{One, Zero};

/// One value per axis: position in m (rad), velocity in m/s (rad/s) or force in N (N m).
pub type Axes<const N: usize, S = f64> = SVector<S, N>;

/// A real number, or one for each of several scenarios that are advanced side by side.
///
/// Code that is generic over it chooses with `select` where scenarios may differ and branches only on what they share,
/// so a lane computes exactly the bits that `f64` does.
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
    /// The square root of each.
    #[must_use]
    fn root(self) -> Self;

    /// The absolute value of each.
    #[must_use]
    fn magnitude(self) -> Self;

    /// The nearest whole number of each, halves away from zero.
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

/// The Euclidean norm in each lane; along one axis without a root, to the same bits unless the square leaves the range of
/// numbers.
#[inline(always)]
pub(crate) fn norm<const N: usize, S: Real>(value: &Axes<N, S>) -> S {
    if N == 1 { value[0].magnitude() } else { value.dot(value).root() }
}
