//! An inverse distribution function by its values at evenly spaced probabilities, as in a `.dist` file of iproute2.
//!
//! The i-th of n values, in order of size, belongs to the probability `(i + 1/2) / n`; between them it is linear,
//! outside of them constant. The tables of iproute2 have neither mean 0 nor standard deviation 1 (that of its Pareto
//! has 0.82), so a table is standardised first: what is asked for is what comes out.
//!
//! Source: iproute2, `netem/maketable.c`; Linux, `net/sched/sch_netem.c`, `tabledist`.

use super::{Tails, at_most};
use crate::settings::LinkError;

/// As many as netem takes.
const MAX_VALUES: usize = 16384;

#[derive(Clone, Debug)]
pub(super) struct Table {
    values_s: Box<[f64]>,
}

impl Table {
    pub(super) fn new(mean_s: f64, sigma_s: f64, values: &[i16]) -> Result<Self, LinkError> {
        let refuse = |problem: String| Err(LinkError::contradiction("distribution", problem));
        let count = values.len();
        if !(2..=MAX_VALUES).contains(&count) {
            return refuse(format!("a table of {count} values: must have from 2 to {MAX_VALUES}"));
        }
        let mut sorted: Vec<f64> = values.iter().copied().map(f64::from).collect();
        sorted.sort_by(f64::total_cmp);
        let (first, last) = (sorted[0], sorted[count - 1]);
        if first == last {
            return refuse(format!("all values of the table are {first}: must differ"));
        }
        let mean = sorted.iter().sum::<f64>() / count as f64;
        let (low, high) = (first - mean, last - mean);
        let ends = 0.5 * (low * low + high * high);
        let inner: f64 = sorted
            .windows(2)
            .map(|pair| {
                let (a, b) = (pair[0] - mean, pair[1] - mean);
                (a * a + a * b + b * b) / 3.0
            })
            .sum();
        let deviation = ((ends + inner) / count as f64).sqrt();
        let least = (first - mean) / deviation;
        at_most(sigma_s, mean_s / -least, "of this table", mean_s, "use a larger delay_s")?;
        let scaled = |value: f64| (mean_s + sigma_s * (value - mean) / deviation).max(0.0);
        Ok(Self { values_s: sorted.into_iter().map(scaled).collect() })
    }

    pub(super) fn at(&self, point: Tails) -> f64 {
        let last = self.values_s.len() - 1;
        let place = point.below * self.values_s.len() as f64 - 0.5;
        if place.is_nan() {
            return place;
        }
        let place = place.clamp(0.0, last as f64);
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped to the indices")]
        let left = (place as usize).min(last - 1);
        let [a, b] = [self.values_s[left], self.values_s[left + 1]];
        a + (b - a) * (place - left as f64)
    }
}
