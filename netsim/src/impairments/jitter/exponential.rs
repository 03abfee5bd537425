//! Exponential variate of a draw without a division: on a [path](super::path) each draw depends on the
//! previous variate.
//!
//! `-ln u = -(e ln 2 + ln c + ln(1 + r))` with `u = 2^e m`, m in [1, 2). The leading bits of m select
//! `1 / c`, which is close to `1 / m`. `r = m / c - 1` is small enough for a short polynomial.
//!
//! A library's logarithm divides first and then evaluates its polynomial, which takes nearly twice as long;
//! other code uses it. All processors have the instructions used here, so the variate is the same on all.
//!
//! Source: P. T. P. Tang, "Table-driven implementation of the logarithm function in IEEE floating-point
//! arithmetic", ACM TOMS 16(4), 1990.

use std::f64::consts::LN_2;

/// Leading bits of m that select the cell.
const CELL_BITS: u32 = 6;
const CELLS: usize = 1 << CELL_BITS;
/// Stored bits of a mantissa.
const MANTISSA_BITS: u32 = f64::MANTISSA_DIGITS - 1;

/// `1 / c`, the reciprocal of about the middle of a cell, and `ln c`.
#[derive(Clone, Copy, Debug)]
struct Cell {
    reciprocal: f64,
    logarithm: f64,
}

static TABLE: [Cell; CELLS] = table();

const fn table() -> [Cell; CELLS] {
    let mut table = [Cell { reciprocal: 0.0, logarithm: 0.0 }; CELLS];
    let mut k = 0;
    while k < CELLS {
        let reciprocal = CELLS as f64 / (CELLS as f64 + k as f64 + 0.5);
        // `ln c = -ln(1 / c)` of the rounded reciprocal.
        table[k] = Cell { reciprocal, logarithm: -logarithm(reciprocal) };
        k += 1;
    }
    table
}

/// `ln x = 2 artanh((x - 1) / (x + 1))` for x in (1/2, 1), by its series.
const fn logarithm(x: f64) -> f64 {
    let t = (x - 1.0) / (x + 1.0);
    // t| < 1/3, and (1/9)^20 is below a unit in the last place. Small terms first.
    let (mut n, mut sum) = (20, 0.0);
    while n > 0 {
        n -= 1;
        sum = sum * (t * t) + 1.0 / (2 * n + 1) as f64;
    }
    2.0 * t * sum
}

/// `-ln u` of a uniform number in (0, 1); never negative. Error: 3e-16 plus two units in the last place.
#[inline(always)] // latency between two draws
pub(super) fn exponential(uniform: f64) -> f64 {
    debug_assert!(
        uniform.is_normal() && uniform < 1.0 && uniform > 0.0,
        "uniform = {uniform}: must be in (0, 1)"
    );
    let bits = uniform.to_bits();
    let mantissa = bits & ((1 << MANTISSA_BITS) - 1);
    let Cell { reciprocal, logarithm } = TABLE[(mantissa >> (MANTISSA_BITS - CELL_BITS)) as usize % CELLS];
    let halvings = 1023 - (bits >> MANTISSA_BITS).cast_signed();
    let r = f64::from_bits(mantissa | 1.0_f64.to_bits()) * reciprocal - 1.0;
    // `ln(1 + r)` to r^7; the next term is below 2e-18, as |r| <= 1/128.
    let r2 = r * r;
    let low = r2 * (r * (1.0 / 3.0) - 0.5);
    let high = (r * 0.2 - 0.25) + r2 * (r * (1.0 / 7.0) - 1.0 / 6.0);
    let whole = halvings as f64 * LN_2 - logarithm;
    (whole - (r + (low + r2 * r2 * high))).max(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Compares with a library's logarithm, which is within one unit in the last place. Errors here: the
    /// table by 1.7e-16, r by half a unit in the last place of 1. Ln 2, its product and two subtractions add
    /// half a unit of the sum each.
    fn check(uniform: f64) {
        let (seen, wanted) = (exponential(uniform), -libm::log(uniform));
        let most = 3e-16 + 3.0 * f64::EPSILON * wanted;
        assert!((seen - wanted).abs() <= most, "{uniform:e}: {seen:e} {wanted:e}");
        assert!(seen >= 0.0 && seen.is_sign_positive(), "{uniform:e}: {seen:e}");
    }

    #[test]
    fn is_the_logarithm_at_the_ends_of_all_cells_and_of_the_range() {
        for halvings in 1..=54 {
            for cell in 0..=CELLS {
                let begin = (1.0 + cell as f64 / CELLS as f64) * 0.5_f64.powi(halvings);
                for uniform in [begin.next_down(), begin, begin.next_up(), begin * (1.0 + 0.5 / CELLS as f64)]
                {
                    if uniform < 1.0 {
                        check(uniform);
                    }
                }
            }
        }
        for bits in [0, 1, 1 << 11, u64::MAX >> 1, u64::MAX - (1 << 11), u64::MAX] {
            check(crate::random::unit(bits));
        }
    }

    proptest! {
        #[test]
        fn is_the_logarithm_of_any_draw(bits in any::<u64>(), halvings in 0_u32..53) {
            check(crate::random::unit(bits >> halvings));
        }
    }
}
