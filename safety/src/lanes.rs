//! Arithmetic of the pipeline: a vector over the axes of a device, for one scenario or for several at once.

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
    value.iter().fold(!nowhere::<S>(), |all, x| all & x.magnitude().simd_le(S::splat(bound)))
}

/// Real number: one `f64`, or several that are computed at once, one per lane.
///
/// All steps of this crate are generic over it. No operation mixes lanes: each lane holds, bit for bit, the result of
/// a single `f64`, and a NaN stays in its lane. Conditions on a number therefore select and never branch; for `f64`,
/// `choose!` compiles to a branch.
///
/// Parameters are checked as `f64`: an instance over lanes is gathered from one checked instance per lane.
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
pub(crate) fn nowhere<S: Real>() -> S::SimdBool {
    S::splat(0.0).simd_lt(S::splat(0.0))
}

/// Select one of two numbers in each lane; for `f64` only the selected one is computed.
///
/// [`if_else`](nalgebra::SimdBool::if_else) is unsuitable. A closure that is too long for inlining becomes a call
/// without vector instructions. All that it captures is then kept in memory at each tick, even without the call.
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
macro_rules! choose_axes {
    ($S:ty, $first:expr, $one:expr, $other:expr) => {{
        let first = $first;
        if <$S as nalgebra::SimdValue>::LANES == 1 {
            if nalgebra::SimdBool::all(first) { $one } else { $other }
        } else {
            $crate::lanes::selected(first, $one, &$other)
        }
    }};
}

pub(crate) use {choose, choose_axes};

/// Select one of two vectors in each lane, axis by axis, inline; nalgebra's own function is a call.
#[inline(always)]
pub(crate) fn selected<const N: usize, S: Real>(
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

/// Pack a value of each instance into lanes; return None unless there is one instance per lane.
pub(crate) fn pack<T, P: SimdValue>(of: &[T], value: impl Fn(&T) -> P::Element) -> Option<P> {
    if of.len() != P::LANES {
        return None;
    }
    let mut packed = P::splat(value(of.first()?));
    for (lane, one) in of.iter().enumerate() {
        packed.replace(lane, value(one));
    }
    Some(packed)
}

/// Added and subtracted again, it keeps every value above 1e-84 bit for bit and clears values below 1e-117.
const NEGLIGIBLE: f64 = 1e-100;

/// Set axes to zero that are negligible relative to [`NEGLIGIBLE`].
///
/// At rest, the state of a recursive filter decays towards zero and would end among the subnormal numbers. A
/// multiplication with them takes about 150 cycles instead of 4. Two sums cost less than a comparison in each lane.
#[inline(always)]
pub(crate) fn without_residue<const N: usize, S: Real>(innovation: Axes<N, S>) -> Axes<N, S> {
    innovation.map(|x| (x + S::splat(NEGLIGIBLE)) - S::splat(NEGLIGIBLE))
}

/// Return the lesser of two, or the second if they are unordered. `simd_min` depends on the lane type there.
#[inline(always)]
pub(crate) fn lesser<S: Real>(a: S, b: S) -> S {
    a.select(a.simd_le(b), b)
}

/// Return the value that all instances have in common.
pub(crate) fn shared<T, V: PartialEq>(of: &[T], value: impl Fn(&T) -> V) -> Option<V> {
    let first = value(of.first()?);
    of.iter().all(|one| value(one) == first).then_some(first)
}

/// Gather a part of each instance, in order.
pub(crate) fn part<'a, T, P: 'a, G>(
    of: &[&'a T],
    part: impl Fn(&'a T) -> &'a P,
    gather: impl FnOnce(&[&'a P]) -> Option<G>,
) -> Option<G> {
    gather(&of.iter().map(|one| part(one)).collect::<Vec<_>>())
}

/// Gather a part that all instances have; return None if only some have it.
#[allow(clippy::option_option)] // None: refused; Some(None): absent in all; Some(Some): present in all
pub(crate) fn option<'a, T, P: 'a, G>(
    of: &[&'a T],
    part: impl Fn(&'a T) -> Option<&'a P>,
    gather: impl FnOnce(&[&'a P]) -> Option<G>,
) -> Option<Option<G>> {
    let parts: Vec<_> = of.iter().filter_map(|one| part(one)).collect();
    match parts.len() {
        0 => Some(None),
        built if built == of.len() => gather(&parts).map(Some),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use simba::simd::AutoF64x4;

    proptest! {
        #[test]
        fn the_root_of_a_square_is_the_absolute_value(
            significand in 1.0..2.0f64,
            exponent in -511..512i32,
            is_negative in any::<bool>(),
        ) {
            let value = Axes::<1>::new(if is_negative { -significand } else { significand } * 2f64.powi(exponent));
            prop_assert_eq!(norm(&value).to_bits(), value.dot(&value).root().to_bits(), "{}", value[0]);
        }
    }

    #[test]
    fn part_of_all_or_none_is_gathered() {
        let half = |parts: &[&f64]| (parts.iter().copied().sum::<f64>() < 100.0).then_some(parts.len());
        let all = |of: &[Option<f64>]| option(&of.iter().collect::<Vec<_>>(), |one| one.as_ref(), half);
        assert_eq!(all(&[Some(1.0), Some(2.0)]), Some(Some(2)));
        assert_eq!(all(&[None, None]), Some(None));
        assert_eq!(all(&[Some(1.0), None]), None);
        assert_eq!(all(&[Some(99.0), Some(2.0)]), None, "refused by the gathering function");
        assert_eq!(part(&[&(1.0, 0), &(2.0, 0), &(3.0, 0)], |one| &one.0, half), Some(3));
        assert_eq!(part(&[&(100.0, 0)], |one| &one.0, half), None);
    }

    #[test]
    fn value_is_shared_if_all_have_it() {
        assert_eq!(shared(&[2, 2, 2], |one| *one), Some(2));
        assert_eq!(shared(&[2, 2, 3], |one| *one), None);
        assert_eq!(shared(&[1, 2, 2], |one| *one), None);
        assert_eq!(shared(&[0; 0], |one: &i32| *one), None);
    }

    #[test]
    fn lanes_are_packed_in_order_and_in_full() {
        let packed: AutoF64x4 = pack(&[1.0, 2.0, 3.0, 4.0], |one| *one).unwrap();
        for lane in 0..4_u8 {
            assert_eq!(packed.extract(usize::from(lane)), f64::from(lane + 1));
        }
        assert!(pack::<_, AutoF64x4>(&[1.0, 2.0, 3.0], |one: &f64| *one).is_none());
        assert!(pack::<_, AutoF64x4>(&[1.0; 5], |one: &f64| *one).is_none());
        assert_eq!(pack::<_, f64>(&[7.0], |one| *one), Some(7.0));
    }
}
