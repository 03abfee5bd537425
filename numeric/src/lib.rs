//! Numbers that all rooms compute with: vectors over the axes of a device, for one scenario or for one scenario per
//! lane, and draws by a counter ([`random`]).
//!
//! Code over [`Real`] is written once; its one-lane case is `f64`. [`Lanes`] is the number of sweeps. A state in lanes
//! is gathered from one checked state per lane: [`pack`], [`shared`], [`part`], [`option`].

mod gather;
pub mod random;
mod wide;

pub use gather::{Occupancy, lanes_of, option, pack, padded, part, shared};
pub use wide::{LaneMask, Lanes, WIDTH};

use std::{fmt::Debug, ops::Neg};

use nalgebra::{
    ClosedAddAssign, ClosedDivAssign, ClosedMulAssign, ClosedSubAssign, SVector, Scalar, SimdPartialOrd,
    SimdRealField, SimdValue,
};
use num_traits::{One, Zero};

/// One value per axis: position in m (rad), velocity in m/s (rad/s) or force in N (N m).
pub type Axes<const N: usize, S = f64> = SVector<S, N>;

/// Mask of lanes in which every axis is finite and at most `bound` in absolute value.
#[inline(always)] // as every check of a tick
pub fn is_within<const N: usize, S: Real>(value: &Axes<N, S>, bound: f64) -> S::SimdBool {
    // A comparison with NaN is false, so one test covers NaN, infinity and values out of range.
    value.iter().fold(!no_lanes::<S>(), |all, x| all & x.magnitude().simd_le(S::splat(bound)))
}

/// Real number: one `f64`, or several that are computed at once, one per lane.
///
/// No operation mixes lanes: each lane holds, bit for bit, the result of a single `f64`, and a NaN stays in its lane.
/// Conditions on a number therefore select and never branch; for `f64`, [`choose!`] compiles to a branch.
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
    + SimdValue<Element = f64, SimdBool: Debug>
{
    /// Return the square root of each lane.
    #[must_use]
    fn root(self) -> Self;

    /// Return the absolute value of each lane.
    #[must_use]
    fn magnitude(self) -> Self;

    /// Return the nearest whole number in each lane, halves away from zero.
    #[must_use]
    fn rounded(self) -> Self;

    /// Return the larger of two, or the second if they are equal or unordered, as one machine instruction does.
    #[inline(always)]
    #[must_use]
    fn larger(self, other: Self) -> Self {
        self.select(self.simd_gt(other), other)
    }

    /// Return the lesser of two, or the second if they are equal or unordered.
    #[inline(always)]
    #[must_use]
    fn lesser(self, other: Self) -> Self {
        self.select(self.simd_lt(other), other)
    }
}

impl<S> Real for S
where
    S: SimdRealField + SimdValue<Element = f64, SimdBool: Debug> + Copy,
{
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

/// Return the Euclidean norm in each lane.
///
/// Along one axis it takes no root. The result has the same bits unless the square over- or underflows, beyond 1e154
/// and below 1e-154, where the root would be wrong.
#[inline(always)]
pub fn norm<const N: usize, S: Real>(value: &Axes<N, S>) -> S {
    if N == 1 { value[0].magnitude() } else { value.dot(value).root() }
}

/// Return false in all lanes.
#[inline(always)]
pub fn no_lanes<S: Real>() -> S::SimdBool {
    S::splat(0.0).simd_lt(S::splat(0.0))
}

/// Return true in all lanes.
#[inline(always)]
pub fn all_lanes<S: Real>() -> S::SimdBool {
    S::splat(0.0).simd_le(S::splat(0.0))
}

/// Mask of lanes in which every axis is finite.
#[inline(always)]
pub fn is_finite<const N: usize, S: Real>(value: &Axes<N, S>) -> S::SimdBool {
    value.iter().fold(all_lanes::<S>(), |all, x| all & (*x * S::zero()).simd_eq(S::zero()))
}

/// Select one of two numbers in each lane; for `f64` only the selected one is computed.
///
/// [`if_else`](nalgebra::SimdBool::if_else) is unsuitable. A closure that is too long for inlining becomes a call
/// without vector instructions. All that it captures is then kept in memory at each tick, even without the call.
#[macro_export]
macro_rules! choose {
    ($S:ty, $first:expr, $one:expr, $other:expr) => {{
        let first = $first;
        if <$S as nalgebra::SimdValue>::LANES == 1 {
            if nalgebra::SimdBool::all(first) { $one } else { $other }
        } else {
            nalgebra::SimdValue::select($one, first, $other)
        }
    }};
}

/// Select one of two vectors in each lane, axis by axis.
#[macro_export]
macro_rules! choose_axes {
    ($S:ty, $first:expr, $one:expr, $other:expr) => {{
        let first = $first;
        if <$S as nalgebra::SimdValue>::LANES == 1 {
            if nalgebra::SimdBool::all(first) { $one } else { $other }
        } else {
            $crate::selected(first, $one, &$other)
        }
    }};
}

/// Select one of two vectors in each lane, axis by axis, inline; nalgebra's own function is a call.
#[inline(always)]
pub fn selected<const N: usize, S: Real>(
    first: S::SimdBool,
    one: Axes<N, S>,
    other: &Axes<N, S>,
) -> Axes<N, S> {
    let mut chosen = *other;
    for axis in 0..N {
        chosen[axis] = one[axis].select(first, other[axis]);
    }
    chosen
}

/// Added and subtracted again, it keeps every value above 1e-84 bit for bit and clears values below 1e-117.
const NEGLIGIBLE: f64 = 1e-100;

/// Set axes to zero that are negligible relative to [`NEGLIGIBLE`].
///
/// At rest, the state of a recursive filter decays towards zero and would end among the subnormal numbers. A
/// multiplication with them takes about 150 cycles instead of 4. Two sums cost less than a comparison in each lane.
#[inline(always)]
pub fn without_residue<const N: usize, S: Real>(innovation: Axes<N, S>) -> Axes<N, S> {
    innovation.map(|x| (x + S::splat(NEGLIGIBLE)) - S::splat(NEGLIGIBLE))
}

/// Return the lesser of two, or the second if they are unordered. `simd_min` depends on the lane type there.
#[inline(always)]
pub fn lesser<S: Real>(a: S, b: S) -> S {
    a.select(a.simd_le(b), b)
}

/// Runs an expression for the number of axes of a device; `$n` is that number as a constant, `$other` what any other
/// number leads to.
#[macro_export]
macro_rules! of_axes {
    ($axes:expr, $n:ident => $body:expr, $other:ident => $refused:expr) => {
        match $axes {
            1 => {
                const $n: usize = 1;
                $body
            }
            2 => {
                const $n: usize = 2;
                $body
            }
            3 => {
                const $n: usize = 3;
                $body
            }
            4 => {
                const $n: usize = 4;
                $body
            }
            5 => {
                const $n: usize = 5;
                $body
            }
            6 => {
                const $n: usize = 6;
                $body
            }
            7 => {
                const $n: usize = 7;
                $body
            }
            $other => $refused,
        }
    };
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn an_unordered_comparison_takes_the_second() {
        for (a, b, larger, lesser) in
            [(f64::NAN, 1.0, 1.0, 1.0), (2.0, 1.0, 2.0, 1.0), (-2.0, 1.0, 1.0, -2.0)]
        {
            assert_eq!([a.larger(b), a.lesser(b)], [larger, lesser], "{a} {b}");
        }
    }

    proptest! {
        #[test]
        fn the_norm_is_that_of_nalgebra(
            significand in 1.0..2.0f64,
            exponent in -511..512i32,
            is_negative in any::<bool>(),
        ) {
            let value = Axes::<1>::new(if is_negative { -significand } else { significand } * 2f64.powi(exponent));
            prop_assert_eq!(norm(&value).to_bits(), value.norm().to_bits(), "{}", value[0]);
            let space = Axes::<3>::new(0.3, -1.0, 0.7) * value[0];
            prop_assert_eq!(norm(&space).to_bits(), space.norm().to_bits(), "{}", value[0]);
        }
    }
}
