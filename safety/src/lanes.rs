//! What the pipeline computes with: a vector over the axes of a device, for one scenario or several side by side.

use std::{fmt::Debug, ops::Neg};

use nalgebra::{
    ClosedAddAssign, ClosedDivAssign, ClosedMulAssign, ClosedSubAssign, SVector, Scalar, SimdPartialOrd,
    SimdRealField, SimdValue,
};
use num_traits::{One, Zero};

/// One value per axis: position in m (rad), velocity in m/s (rad/s) or force in N (N m).
pub type Axes<const N: usize, S = f64> = SVector<S, N>;

/// Where every axis is finite and at most `bound` in absolute value.
#[inline(always)] // as of all that a tick checks
pub fn is_within<const N: usize, S: Real>(value: &Axes<N, S>, bound: f64) -> S::SimdBool {
    // A comparison with NaN is false, so one test covers NaN, infinity and absurdity.
    value.iter().fold(!nowhere::<S>(), |all, x| all & x.magnitude().simd_le(S::splat(bound)))
}

/// A real number `f64`, or several that are computed with at once, each in a lane of its own.
///
/// All of this crate's steps are written over it. No operation mixes lanes: each lane holds, bit for bit, what an
/// `f64` of its own would hold, and a NaN stays in its lane. What depends on a number is therefore selected, never
/// branched on; for `f64`, `choose!` is a branch again.
///
/// Parameters are checked one by one: an instance over lanes is gathered from as many instances over `f64`.
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
    /// The square root of each lane.
    #[must_use]
    fn root(self) -> Self;

    /// The absolute value of each lane.
    #[must_use]
    fn magnitude(self) -> Self;

    /// The larger of two, the second where they are equal or cannot be compared: what one instruction does.
    #[inline(always)]
    #[must_use]
    fn larger(self, other: Self) -> Self {
        self.select(self.simd_gt(other), other)
    }

    /// The lesser of two, as [`larger`](Self::larger).
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

/// The Euclidean norm in each lane; along one axis without a root, to the same bits unless the square leaves the range of
/// numbers, beyond 1e154 and below 1e-154: there the root is wrong.
#[inline(always)]
pub fn norm<const N: usize, S: Real>(value: &Axes<N, S>) -> S {
    if N == 1 { value[0].magnitude() } else { value.dot(value).root() }
}

/// False in all lanes.
#[inline(always)]
pub(crate) fn nowhere<S: Real>() -> S::SimdBool {
    S::splat(0.0).simd_lt(S::splat(0.0))
}

/// One of two numbers in each lane; for `f64` only the one that is needed is computed.
///
/// Not [`if_else`](nalgebra::SimdBool::if_else): a closure that is too long to be inlined is a call that is built without
/// the processor's vectors, and all that it captures stands in memory at each tick, also where it is not called.
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

/// The same of vectors, axis by axis.
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

/// One of two in each lane, axis by axis. nalgebra's own is a call.
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

/// A value of each instance, lane by lane; None unless there are as many instances as lanes.
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

/// Added and taken away again, it leaves all that is above 1e-84 as it is, bit for bit, and nothing below 1e-117.
const NEGLIGIBLE: f64 = 1e-100;

/// The same axes, zero where they are negligible beside [`NEGLIGIBLE`].
///
/// At rest a recursive filter decays towards zero without reaching it: its state would end among the subnormal numbers,
/// with which a multiplication takes some 150 cycles instead of 4. Two sums cost less than a comparison in each lane.
#[inline(always)]
pub(crate) fn without_residue<const N: usize, S: Real>(innovation: Axes<N, S>) -> Axes<N, S> {
    innovation.map(|x| (x + S::splat(NEGLIGIBLE)) - S::splat(NEGLIGIBLE))
}

/// The lesser of two, the second where they cannot be compared. What `simd_min` does there depends on the lanes' type.
#[inline(always)]
pub(crate) fn lesser<S: Real>(a: S, b: S) -> S {
    a.select(a.simd_le(b), b)
}

/// The value that all instances have in common.
pub(crate) fn shared<T, V: PartialEq>(of: &[T], value: impl Fn(&T) -> V) -> Option<V> {
    let first = value(of.first()?);
    of.iter().all(|one| value(one) == first).then_some(first)
}

/// A part of each instance, gathered in order.
pub(crate) fn part<'a, T, P: 'a, G>(
    of: &[&'a T],
    part: impl Fn(&'a T) -> &'a P,
    gather: impl FnOnce(&[&'a P]) -> Option<G>,
) -> Option<G> {
    gather(&of.iter().map(|one| part(one)).collect::<Vec<_>>())
}

/// A part that all instances have, or none of them.
#[allow(clippy::option_option)] // refused, built in none, built in all
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
    fn what_all_have_or_none_is_gathered() {
        let half = |parts: &[&f64]| (parts.iter().copied().sum::<f64>() < 100.0).then_some(parts.len());
        let all = |of: &[Option<f64>]| option(&of.iter().collect::<Vec<_>>(), |one| one.as_ref(), half);
        assert_eq!(all(&[Some(1.0), Some(2.0)]), Some(Some(2)));
        assert_eq!(all(&[None, None]), Some(None));
        assert_eq!(all(&[Some(1.0), None]), None);
        assert_eq!(all(&[Some(99.0), Some(2.0)]), None, "refused by what gathers");
        assert_eq!(part(&[&(1.0, 0), &(2.0, 0), &(3.0, 0)], |one| &one.0, half), Some(3));
        assert_eq!(part(&[&(100.0, 0)], |one| &one.0, half), None);
    }

    #[test]
    fn a_value_is_shared_where_all_have_it() {
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
