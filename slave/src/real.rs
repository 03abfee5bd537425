//! Scalar type of the control laws: one number, or one per lane for several scenarios.

use std::ops::Neg;

use nalgebra::{
    ClosedAddAssign, ClosedDivAssign, ClosedMulAssign, ClosedSubAssign, Scalar, SimdPartialOrd,
    SimdRealField, SimdValue,
};
use num_traits::{One, Zero};

/// A real number `f64`, or several in parallel, one per lane.
///
/// No operation mixes lanes: each lane is bit-identical to a separate `f64`.
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
