//! Lanes of f64: the number of sweeps.
//!
//! The compiler vectorizes loops over an array. A mask holds floats as well: bytes or bits per lane would give scalar
//! logic.

use std::ops::{
    Add, AddAssign, BitAnd, BitOr, BitXor, Div, DivAssign, Mul, MulAssign, Neg, Not, Sub, SubAssign,
};

use nalgebra::{SimdBool, SimdPartialOrd, SimdValue};
use num_traits::{One, Zero};

use crate::Real;

/// Number of lanes: two vectors of AVX2.
pub const WIDTH: usize = 8;

/// One number per lane.
#[derive(Clone, Copy, Debug, PartialEq)]
#[repr(align(64))]
pub struct Lanes([f64; WIDTH]);

/// One truth value per lane: 1 or 0.
#[derive(Clone, Copy, Debug, PartialEq)]
#[repr(align(64))]
pub struct LaneMask([f64; WIDTH]);

const TRUE: f64 = 1.0;
const FALSE: f64 = 0.0;

impl Lanes {
    #[inline(always)]
    fn each(self, f: impl Fn(f64) -> f64) -> Self {
        Self(std::array::from_fn(|lane| f(self.0[lane])))
    }

    #[inline(always)]
    fn with(self, other: Self, f: impl Fn(f64, f64) -> f64) -> Self {
        Self(std::array::from_fn(|lane| f(self.0[lane], other.0[lane])))
    }

    #[inline(always)]
    fn compare(self, other: Self, f: impl Fn(f64, f64) -> bool) -> LaneMask {
        LaneMask(std::array::from_fn(|lane| if f(self.0[lane], other.0[lane]) { TRUE } else { FALSE }))
    }
}

impl LaneMask {
    #[inline(always)]
    fn with(self, other: Self, f: impl Fn(f64, f64) -> f64) -> Self {
        Self(std::array::from_fn(|lane| f(self.0[lane], other.0[lane])))
    }
}

macro_rules! arithmetic {
    ($(($operator:ident, $method:ident, $assign:ident, $assign_method:ident, $sign:tt)),*) => {$(
        impl $operator for Lanes {
            type Output = Self;

            #[inline(always)]
            fn $method(self, other: Self) -> Self {
                self.with(other, |a, b| a $sign b)
            }
        }

        impl $assign for Lanes {
            #[inline(always)]
            fn $assign_method(&mut self, other: Self) {
                *self = *self $sign other;
            }
        }
    )*};
}

arithmetic!(
    (Add, add, AddAssign, add_assign, +),
    (Sub, sub, SubAssign, sub_assign, -),
    (Mul, mul, MulAssign, mul_assign, *),
    (Div, div, DivAssign, div_assign, /)
);

impl Neg for Lanes {
    type Output = Self;

    #[inline(always)]
    fn neg(self) -> Self {
        self.each(|a| -a)
    }
}

impl Zero for Lanes {
    #[inline(always)]
    fn zero() -> Self {
        Self([0.0; WIDTH])
    }

    #[inline(always)]
    fn is_zero(&self) -> bool {
        self.0 == [0.0; WIDTH]
    }
}

impl One for Lanes {
    #[inline(always)]
    fn one() -> Self {
        Self([1.0; WIDTH])
    }
}

macro_rules! logic {
    ($(($operator:ident, $method:ident, $formula:expr)),*) => {$(
        impl $operator for LaneMask {
            type Output = Self;

            #[inline(always)]
            fn $method(self, other: Self) -> Self {
                self.with(other, $formula)
            }
        }
    )*};
}

logic!(
    (BitAnd, bitand, |a, b| a * b),
    (BitOr, bitor, |a, b| if a > b { a } else { b }),
    (BitXor, bitxor, |a, b| (a - b) * (a - b))
);

impl Not for LaneMask {
    type Output = Self;

    #[inline(always)]
    fn not(self) -> Self {
        Self(std::array::from_fn(|lane| TRUE - self.0[lane]))
    }
}

impl LaneMask {
    /// Bits of each lane, read through memory. Otherwise a reduction makes the compiler compute the mask and its
    /// operands lane by lane.
    #[inline(always)]
    fn bits(self) -> [u64; WIDTH] {
        std::hint::black_box(self.0).map(f64::to_bits)
    }
}

impl SimdBool for LaneMask {
    #[inline(always)]
    fn bitmask(self) -> u64 {
        self.0.iter().enumerate().fold(0, |mask, (lane, truth)| mask | u64::from(*truth != FALSE) << lane)
    }

    #[inline(always)]
    fn and(self) -> bool {
        self.all()
    }

    #[inline(always)]
    fn or(self) -> bool {
        self.any()
    }

    #[inline(always)]
    fn xor(self) -> bool {
        self.bitmask().count_ones() % 2 == 1
    }

    #[inline(always)]
    fn all(self) -> bool {
        // Zero iff no bit differs from true: one vector test instead of a stepwise "and" over lanes.
        self.bits().iter().fold(0, |differs, bits| differs | (bits ^ TRUE.to_bits())) == 0
    }

    #[inline(always)]
    fn any(self) -> bool {
        self.bits().iter().fold(0, |any, bits| any | bits) != 0
    }

    #[inline(always)]
    fn none(self) -> bool {
        !self.any()
    }

    #[inline(always)]
    fn if_else<Res: SimdValue<SimdBool = Self>>(
        self,
        if_value: impl FnOnce() -> Res,
        else_value: impl FnOnce() -> Res,
    ) -> Res {
        if_value().select(self, else_value())
    }

    #[inline(always)]
    fn if_else2<Res: SimdValue<SimdBool = Self>>(
        self,
        if_value: impl FnOnce() -> Res,
        else_if: (impl FnOnce() -> Self, impl FnOnce() -> Res),
        else_value: impl FnOnce() -> Res,
    ) -> Res {
        let otherwise = else_if.1().select(else_if.0(), else_value());
        if_value().select(self, otherwise)
    }

    #[inline(always)]
    fn if_else3<Res: SimdValue<SimdBool = Self>>(
        self,
        if_value: impl FnOnce() -> Res,
        else_if: (impl FnOnce() -> Self, impl FnOnce() -> Res),
        else_else_if: (impl FnOnce() -> Self, impl FnOnce() -> Res),
        else_value: impl FnOnce() -> Res,
    ) -> Res {
        let last = else_else_if.1().select(else_else_if.0(), else_value());
        let otherwise = else_if.1().select(else_if.0(), last);
        if_value().select(self, otherwise)
    }
}

#[allow(unsafe_code)] // the trait has unsafe methods that require a valid lane
impl SimdValue for Lanes {
    const LANES: usize = WIDTH;
    type Element = f64;
    type SimdBool = LaneMask;

    #[inline(always)]
    fn splat(value: f64) -> Self {
        Self([value; WIDTH])
    }

    #[inline(always)]
    fn extract(&self, lane: usize) -> f64 {
        self.0[lane]
    }

    #[inline(always)]
    unsafe fn extract_unchecked(&self, lane: usize) -> f64 {
        self.0[lane]
    }

    #[inline(always)]
    fn replace(&mut self, lane: usize, value: f64) {
        self.0[lane] = value;
    }

    #[inline(always)]
    unsafe fn replace_unchecked(&mut self, lane: usize, value: f64) {
        self.0[lane] = value;
    }

    #[inline(always)]
    fn select(self, mask: LaneMask, other: Self) -> Self {
        Self(std::array::from_fn(|lane| if mask.0[lane] == FALSE { other.0[lane] } else { self.0[lane] }))
    }
}

#[allow(unsafe_code)] // as above
impl SimdValue for LaneMask {
    const LANES: usize = WIDTH;
    type Element = bool;
    type SimdBool = Self;

    #[inline(always)]
    fn splat(value: bool) -> Self {
        Self([if value { TRUE } else { FALSE }; WIDTH])
    }

    #[inline(always)]
    fn extract(&self, lane: usize) -> bool {
        self.0[lane] != FALSE
    }

    #[inline(always)]
    unsafe fn extract_unchecked(&self, lane: usize) -> bool {
        self.0[lane] != FALSE
    }

    #[inline(always)]
    fn replace(&mut self, lane: usize, value: bool) {
        self.0[lane] = if value { TRUE } else { FALSE };
    }

    #[inline(always)]
    unsafe fn replace_unchecked(&mut self, lane: usize, value: bool) {
        self.replace(lane, value);
    }

    #[inline(always)]
    fn select(self, mask: Self, other: Self) -> Self {
        (self & mask) | (other & !mask)
    }
}

impl SimdPartialOrd for Lanes {
    #[inline(always)]
    fn simd_gt(self, other: Self) -> LaneMask {
        self.compare(other, |a, b| a > b)
    }

    #[inline(always)]
    fn simd_lt(self, other: Self) -> LaneMask {
        self.compare(other, |a, b| a < b)
    }

    #[inline(always)]
    fn simd_ge(self, other: Self) -> LaneMask {
        self.compare(other, |a, b| a >= b)
    }

    #[inline(always)]
    fn simd_le(self, other: Self) -> LaneMask {
        self.compare(other, |a, b| a <= b)
    }

    #[inline(always)]
    #[allow(clippy::float_cmp)] // lane-wise equality is intended
    fn simd_eq(self, other: Self) -> LaneMask {
        self.compare(other, |a, b| a == b)
    }

    #[inline(always)]
    fn simd_ne(self, other: Self) -> LaneMask {
        self.compare(other, |a, b| a != b)
    }

    #[inline(always)]
    fn simd_max(self, other: Self) -> Self {
        self.with(other, SimdPartialOrd::simd_max)
    }

    #[inline(always)]
    fn simd_min(self, other: Self) -> Self {
        self.with(other, SimdPartialOrd::simd_min)
    }

    #[inline(always)]
    fn simd_clamp(self, min: Self, max: Self) -> Self {
        // `f64::clamp` for ordered bounds in two instructions: NaN stays, and so does a zero between zeros.
        Self(std::array::from_fn(|lane| {
            let (x, min, max) = (self.0[lane], min.0[lane], max.0[lane]);
            let below = if max < x { max } else { x };
            if min > below { min } else { below }
        }))
    }

    #[inline(always)]
    fn simd_horizontal_min(self) -> f64 {
        self.0.into_iter().fold(f64::INFINITY, f64::min)
    }

    #[inline(always)]
    fn simd_horizontal_max(self) -> f64 {
        self.0.into_iter().fold(f64::NEG_INFINITY, f64::max)
    }
}

impl Real for Lanes {
    #[inline(always)]
    fn root(self) -> Self {
        self.each(f64::sqrt)
    }

    #[inline(always)]
    fn magnitude(self) -> Self {
        self.each(f64::abs)
    }

    #[inline(always)]
    fn rounded(self) -> Self {
        self.each(f64::round)
    }

    #[inline(always)]
    fn larger(self, other: Self) -> Self {
        self.with(other, |a, b| if a > b { a } else { b })
    }

    #[inline(always)]
    fn lesser(self, other: Self) -> Self {
        self.with(other, |a, b| if a < b { a } else { b })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn any_number() -> impl Strategy<Value = f64> {
        prop_oneof![
            -10.0..10.0f64,
            Just(0.0),
            Just(-0.0),
            Just(f64::NAN),
            Just(f64::INFINITY),
            Just(f64::NEG_INFINITY),
            Just(f64::MAX),
            Just(5e-324),
        ]
    }

    fn same(lanes: Lanes, lane: usize, single: f64) -> bool {
        lanes.extract(lane).to_bits() == single.to_bits() || (lanes.extract(lane).is_nan() && single.is_nan())
    }

    proptest! {
        /// Every operation equals the `f64` operation in each lane.
        #[test]
        fn lanes_match_scalar(
            a in prop::array::uniform::<_, WIDTH>(any_number()),
            b in prop::array::uniform::<_, WIDTH>(any_number()),
            m in prop::array::uniform::<_, WIDTH>(any::<bool>()),
        ) {
            let (x, y) = (Lanes(a), Lanes(b));
            let mut mask = LaneMask::splat(false);
            for (lane, set) in m.iter().enumerate() {
                mask.replace(lane, *set);
            }
            prop_assert_eq!(mask.any(), m.contains(&true));
            prop_assert_eq!(mask.all(), !m.contains(&false));
            prop_assert_eq!(mask.none(), !m.contains(&true));
            for lane in 0..WIDTH {
                let (p, q) = (a[lane], b[lane]);
                prop_assert!(same(x + y, lane, p + q) && same(x - y, lane, p - q));
                prop_assert!(same(x * y, lane, p * q) && same(x / y, lane, p / q));
                prop_assert!(same(-x, lane, -p) && same(Real::magnitude(x), lane, p.abs()));
                prop_assert!(same(Real::root(x), lane, p.sqrt()));
                prop_assert!(same(Real::rounded(x), lane, p.round()));
                prop_assert!(same(x.simd_max(y), lane, p.simd_max(q)));
                prop_assert!(same(x.simd_min(y), lane, p.simd_min(q)));
                prop_assert!(same(x.select(mask, y), lane, p.select(m[lane], q)));
                let most = Real::magnitude(y);
                prop_assert!(same(x.simd_clamp(-most, most), lane, p.simd_clamp(-q.abs(), q.abs())));
                prop_assert_eq!(x.simd_lt(y).extract(lane), p < q);
                prop_assert_eq!(x.simd_le(y).extract(lane), p <= q);
                prop_assert_eq!(x.simd_gt(y).extract(lane), p > q);
                prop_assert_eq!(x.simd_ge(y).extract(lane), p >= q);
                prop_assert_eq!(x.simd_eq(y).extract(lane), p == q);
                prop_assert_eq!(x.simd_ne(y).extract(lane), p != q);
                prop_assert_eq!((x.simd_lt(y) | mask).extract(lane), p < q || m[lane]);
                let is_less = p < q;
                prop_assert_eq!((!x.simd_lt(y) & mask).extract(lane), !is_less && m[lane]);
                prop_assert_eq!(mask.bitmask() >> lane & 1 == 1, m[lane]);
            }
        }
    }
}
