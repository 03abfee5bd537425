//! How fast two clocks run apart.

use super::BILLION;

const POINTS: usize = 32;
const PAIRS: usize = POINTS * (POINTS - 1) / 2;
/// Below this number of points the fit says nothing.
const ENOUGH: usize = 4;
const FIRST_BLOCK_NS: u64 = 250_000_000;
/// 32 blocks of this length reach back for 8.5 minutes.
const LAST_BLOCK_NS: u64 = 16_000_000_000;

/// An offset and what it rests on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[expect(clippy::struct_field_names, reason = "they are of one unit")]
pub(crate) struct Point {
    pub(crate) at_ns: u64,
    pub(crate) offset_ns: i64,
    pub(crate) round_trip_ns: u64,
}

/// Fits a rate through the points of least round trip of up to 32 blocks of time.
///
/// The rate is the median of the slopes of all pairs, moved into the range that every pair allows: an offset measured
/// at a round trip `r` is off by at most `(r - r_min) / 2` against the others, more or less the spread of the round
/// trips. That holds while the path stays what it is, so the rate is an estimate and no bound rests on it. The blocks begin short, so that there is a first answer after a second, and double in length, two becoming
/// one, until they reach back for 8.5 minutes.
///
/// Source: H. Theil (1950), A rank-invariant method of linear and polynomial regression analysis; P. K. Sen (1968),
/// Estimates of the regression coefficient based on Kendall's tau; the points as in V. Paxson (1998), On calibrating
/// measurements of packet transit times, section 3 (minima of partitions).
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct DriftFit {
    points: [Point; POINTS],
    count: usize,
    block_ns: u64,
    block_began_ns: u64,
    open: Option<Point>,
    drift_ppb: Option<i64>,
    max_ppb: i64,
}

impl DriftFit {
    /// Believes in drifts up to `max_ppb`.
    pub(crate) fn new(max_ppb: u64) -> Self {
        Self {
            points: [Point { at_ns: 0, offset_ns: 0, round_trip_ns: 0 }; POINTS],
            count: 0,
            block_ns: FIRST_BLOCK_NS,
            block_began_ns: 0,
            open: None,
            drift_ppb: None,
            max_ppb: max_ppb.min(BILLION).cast_signed(),
        }
    }

    /// The rate in parts per billion; none before a second, or if it is greater than believed.
    pub(crate) fn drift_ppb(&self) -> Option<i64> {
        self.drift_ppb.filter(|ppb| ppb.saturating_abs() <= self.max_ppb)
    }

    /// Adds a point.
    pub(crate) fn add(&mut self, point: Point) {
        let Some(open) = self.open else {
            self.begin(point);
            return;
        };
        if point.at_ns.saturating_sub(self.block_began_ns) < self.block_ns {
            if point.round_trip_ns <= open.round_trip_ns {
                self.open = Some(point);
            }
            return;
        }
        self.push(open);
        self.begin(point);
        self.drift_ppb = self.fit();
    }

    fn begin(&mut self, point: Point) {
        self.open = Some(point);
        self.block_began_ns = point.at_ns;
    }

    fn push(&mut self, point: Point) {
        if self.count == POINTS {
            if self.block_ns < LAST_BLOCK_NS {
                self.merge_pairs();
            } else {
                self.points.copy_within(1.., 0);
                self.count -= 1;
            }
        }
        self.points[self.count] = point;
        self.count += 1;
    }

    fn merge_pairs(&mut self) {
        for pair in 0..POINTS / 2 {
            let (first, second) = (self.points[2 * pair], self.points[2 * pair + 1]);
            self.points[pair] = if first.round_trip_ns < second.round_trip_ns { first } else { second };
        }
        self.count = POINTS / 2;
        self.block_ns *= 2;
    }

    fn fit(&self) -> Option<i64> {
        let points = &self.points[..self.count];
        if points.len() < ENOUGH {
            return None;
        }
        let mut trips = self.points.map(|point| point.round_trip_ns);
        let trips = &mut trips[..self.count];
        let (_, &mut typical, _) = trips.select_nth_unstable(self.count / 2);
        let least = trips.iter().copied().min()?;
        // The least of all is above the least possible too, hardly by more than the others are above it.
        let spread = typical - least;
        let mut slopes = [0; PAIRS];
        let mut count = 0;
        let (mut low, mut high) = (-self.max_ppb, self.max_ppb);
        for (index, first) in points.iter().enumerate() {
            for second in &points[index + 1..] {
                let apart = second.at_ns.saturating_sub(first.at_ns).max(1);
                let slope = rate_ppb(second.offset_ns.saturating_sub(first.offset_ns), apart);
                let excess = first.round_trip_ns.midpoint(second.round_trip_ns) - least;
                let off = i64::try_from(excess.saturating_add(spread)).unwrap_or(i64::MAX);
                let within = rate_ppb(off, apart).saturating_add(1);
                low = low.max(slope.saturating_sub(within));
                high = high.min(slope.saturating_add(within));
                slopes[count] = slope;
                count += 1;
            }
        }
        let (_, &mut median, _) = slopes[..count].select_nth_unstable(count / 2);
        // No single rate explains all points if the path or the rate changed meanwhile.
        Some(if low > high { median } else { median.clamp(low, high) })
    }
}

/// `change / duration` in parts per billion. Offsets differ by less than 9 s within a fit, or a step would have been
/// seen; what is more saturates and is refused as a drift that no clock has.
fn rate_ppb(change_ns: i64, duration_ns: u64) -> i64 {
    let duration = i64::try_from(duration_ns).unwrap_or(i64::MAX);
    change_ns.saturating_mul(BILLION.cast_signed()) / duration
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fit_line(ppb: i64, round_trip: impl Fn(u64) -> u64, seconds: u64) -> i64 {
        let mut fit = DriftFit::new(200_000);
        for step in 0..seconds * 20 {
            let at_ns = step * 50_000_000;
            let offset_ns = at_ns.cast_signed() * ppb / BILLION.cast_signed();
            fit.add(Point { at_ns, offset_ns, round_trip_ns: round_trip(step) });
        }
        fit.drift_ppb().unwrap()
    }

    #[test]
    fn a_line_is_found_within_rounding() {
        for ppb in [0, 1_000, -1_000, 100_000, -100_000] {
            for seconds in [3, 60, 5_000] {
                let drift = fit_line(ppb, |_| 1_000_000, seconds);
                // Two offsets rounded to 1 ns, at least a second apart in the median.
                assert!(drift.abs_diff(ppb) <= 2, "{drift} of {ppb} in {seconds} s");
            }
        }
    }

    #[test]
    fn points_of_a_long_round_trip_do_not_bend_it() {
        // Blocks of bad minima: one in five, off by 10 ms, which their round trip confesses.
        let mut fit = DriftFit::new(200_000);
        for block in 0..32u64 {
            let bad = block % 5 == 2;
            let at_ns = block * FIRST_BLOCK_NS;
            let offset_ns = at_ns.cast_signed() / 50_000 + if bad { 10_000_000 } else { 0 };
            fit.add(Point { at_ns, offset_ns, round_trip_ns: 1_000_000 + u64::from(bad) * 20_000_000 });
        }
        let drift = fit.drift_ppb().unwrap();
        assert!(drift.abs_diff(20_000) <= 3, "{drift}");
    }
}
