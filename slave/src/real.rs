//! What laws are computed with: a number, or one for each of several scenarios side by side.

use std::ops::Neg;

use nalgebra::{
    ClosedAddAssign, ClosedDivAssign, ClosedMulAssign, ClosedSubAssign, Scalar, SimdPartialOrd,
    SimdRealField, SimdValue,
};
use num_traits::{One, Zero};

/// A real number `f64`, or several that are computed with at once, each in a lane of its own.
///
/// No operation mixes lanes: each lane holds, bit for bit, what an `f64` of its own would hold.
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
    /// The square root of each lane.
    #[must_use]
    fn root(self) -> Self;

    /// The absolute value of each lane.
    #[must_use]
    fn magnitude(self) -> Self;
}

impl<S> Real for S
where
    S: SimdRealField + SimdValue<Element = f64> + Copy,
{
    #[inline(always)]
    fn root(self) -> Self {
        self.simd_sqrt()
    }

    #[inline(always)]
    fn magnitude(self) -> Self {
        self.simd_abs()
    }
}
