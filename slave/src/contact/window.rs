//! Time window in whole nanoseconds; its end is excluded.

/// A time in s as whole ns: exact below 2^53 ns (104 days), while sums of decimal seconds differ by rounding.
pub(crate) fn rounded_to_ns(time_s: f64) -> f64 {
    rounded(time_s * 1e9)
}

/// Same as [`f64::round`], but without the call that it needs on processors without a rounding instruction; it runs at
/// every tick. The truncation is exact below 2^52, and larger numbers are already whole.
#[expect(clippy::cast_possible_truncation, reason = "below 2^52 where it is used")]
fn rounded(number: f64) -> f64 {
    const INTEGERS_FROM: f64 = 4_503_599_627_370_496.0;
    if number.abs() < INTEGERS_FROM {
        let below = number.abs() as i64 as f64;
        (below + f64::from(u8::from(number.abs() - below >= 0.5))).copysign(number)
    } else {
        number
    }
}

/// Time window in whole ns. The end is excluded; a tick at a bound is exactly at the bound.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Window {
    pub(crate) from_ns: f64,
    pub(crate) until_ns: f64,
}

impl Window {
    /// From `at_s` on for `duration_s`.
    pub(crate) fn lasting(at_s: f64, duration_s: f64) -> Self {
        let from_ns = rounded_to_ns(at_s);
        Self { from_ns, until_ns: from_ns + rounded_to_ns(duration_s) }
    }

    /// From `begin_s` until `until_s`.
    pub(crate) fn between(begin_s: f64, until_s: f64) -> Self {
        Self { from_ns: rounded_to_ns(begin_s), until_ns: rounded_to_ns(until_s) }
    }

    pub(crate) fn begins_after(&self, time_s: f64) -> bool {
        rounded_to_ns(time_s) < self.from_ns
    }

    pub(crate) fn contains(&self, time_s: f64) -> bool {
        (self.from_ns..self.until_ns).contains(&rounded_to_ns(time_s))
    }

    pub(crate) fn begin_s(&self) -> f64 {
        self.from_ns / 1e9
    }

    pub(crate) fn until_s(&self) -> f64 {
        self.until_ns / 1e9
    }

    /// First bound after a time, in s; infinity after the last.
    pub(crate) fn next_bound(&self, time_s: f64) -> f64 {
        let now_ns = rounded_to_ns(time_s);
        if now_ns < self.from_ns {
            self.begin_s()
        } else if now_ns < self.until_ns {
            self.until_s()
        } else {
            f64::INFINITY
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// 0.1 + 0.2 is above 0.3 in binary, and 3 x 0.1 too; 0.1 + 0.7 is below 0.8.
    #[test]
    fn a_window_has_the_ticks_of_its_length_in_ns() {
        for period_ns in [1_000_000_u64, 500_000, 700_000, 125_000, 8_000_000] {
            let period_s = period_ns as f64 * 1e-9;
            for (begin, lasts) in [(100_u64, 200_u64), (100, 700), (7, 13), (1000, 1), (3, 999)] {
                let window =
                    Window::lasting((begin * period_ns) as f64 / 1e9, (lasts * period_ns) as f64 / 1e9);
                let as_product = (0..3000_u64).filter(|&n| window.contains(n as f64 * period_s));
                let as_quotient = (0..3000_u64).filter(|&n| window.contains((n * period_ns) as f64 / 1e9));
                let expected: Vec<_> = (begin..begin + lasts).collect();
                assert_eq!(as_product.collect::<Vec<_>>(), expected, "{period_ns} {begin} {lasts}");
                assert_eq!(as_quotient.collect::<Vec<_>>(), expected, "{period_ns} {begin} {lasts}");
            }
        }
    }

    #[test]
    fn rounded_is_round() {
        let edges = [
            0.0,
            0.499_999_999_999_999_94,
            0.5,
            0.500_000_000_000_000_1,
            1.5,
            2.5,
            2f64.powi(52) - 1.5,
            2f64.powi(52) - 0.5,
            2f64.powi(52),
            2f64.powi(52) + 1.0,
            2f64.powi(63),
            f64::MIN_POSITIVE,
            f64::MAX,
            f64::INFINITY,
        ];
        for number in edges.into_iter().flat_map(|edge| [edge, -edge]) {
            assert_eq!(rounded(number).to_bits(), number.round().to_bits(), "{number}");
        }
        assert!(rounded(f64::NAN).is_nan());
    }

    #[test]
    fn its_bounds_follow_one_another_once() {
        let window = Window::between(0.1, 0.3);
        assert_eq!(window.next_bound(0.0), 0.1);
        assert_eq!(window.next_bound(0.1), 0.3);
        assert_eq!(window.next_bound(0.1 + 0.2), f64::INFINITY);
        assert!(window.begins_after(0.0999) && !window.begins_after(0.1));
    }
}
