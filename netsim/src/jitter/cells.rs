//! A law of the delay as a table: cells of equal width in z, the standard normal variate that stands for the delay.
//!
//! Within a cell the delay is linear. This moves mean and standard deviation by about 1e-5 of the latter, and the rest
//! of the tails, 1e-16 on each side, is missing; so the delays are scaled and shifted to the moments asked for.

use crate::law::{DelayLaw, Tails};

const PER_UNIT: usize = 64;
pub(super) const WIDTH: f64 = 1.0 / PER_UNIT as f64;
/// The cells reach from -8.25 to 8.25.
pub(super) const COUNT: usize = 2 * 528;
const FIRST: f64 = -8.25;

#[derive(Debug)]
pub(super) struct Cells {
    /// Delay in ns where the cells meet, ascending.
    pub(super) delay_ns: Box<[f64]>,
    /// Probability of each cell.
    pub(super) mass: Box<[f64]>,
}

impl Cells {
    pub(super) fn of(law: &DelayLaw) -> Self {
        let points: Vec<Tails> = (0..=COUNT).map(|k| Tails::of_normal(FIRST + k as f64 * WIDTH)).collect();
        let mut mass: Box<[f64]> =
            points
                .windows(2)
                // The smaller tail has the digits.
                .map(|ends| {
                    if ends[1].z > 0.0 {
                        ends[0].above - ends[1].above
                    } else {
                        ends[1].below - ends[0].below
                    }
                })
                .collect();
        let total: f64 = mass.iter().sum();
        mass.iter_mut().for_each(|mass| *mass /= total);
        let mut latest = 0.0_f64;
        let mut delay_ns: Box<[f64]> = points
            .iter()
            .map(|point| {
                latest = latest.max(law.at(*point) * 1e9);
                latest
            })
            .collect();
        let (mean, deviation) = moments(&delay_ns, &mass, law.mean_s() * 1e9);
        let scale = law.sigma_s() * 1e9 / deviation;
        for delay in &mut delay_ns {
            *delay = (law.mean_s() * 1e9 + (*delay - mean) * scale).max(0.0);
        }
        Self { delay_ns, mass }
    }

    /// Position of a normal variate: its cell, and how far into it.
    pub(super) fn place(z: f64) -> (usize, f64) {
        let place = ((z - FIRST) * PER_UNIT as f64).clamp(0.0, COUNT as f64);
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped to the cells")]
        let cell = (place as usize).min(COUNT - 1);
        (cell, place - cell as f64)
    }

    /// The delay in ns that a normal variate stands for.
    pub(super) fn delay_ns(&self, z: f64) -> f64 {
        let (cell, part) = Self::place(z);
        let [a, b] = [self.delay_ns[cell], self.delay_ns[cell + 1]];
        a + (b - a) * part
    }
}

/// Mean and standard deviation of delays that are uniform within each cell; `near` is some value close to the mean.
fn moments(delay_ns: &[f64], mass: &[f64], near: f64) -> (f64, f64) {
    let (mut first, mut second) = (0.0, 0.0);
    for (ends, mass) in delay_ns.windows(2).zip(mass) {
        let (a, b) = (ends[0] - near, ends[1] - near);
        first += mass * 0.5 * (a + b);
        second += mass * (a * a + a * b + b * b) / 3.0;
    }
    (near + first, (second - first * first).sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::LinkSettings;

    #[test]
    fn mean_and_deviation_are_those_asked_for() {
        let settings = LinkSettings { delay_s: 0.05, jitter_s: 0.03, ..LinkSettings::default() };
        let cells = Cells::of(&DelayLaw::new(&settings).unwrap());
        let (mean, deviation) = moments(&cells.delay_ns, &cells.mass, 0.0);
        assert!((mean / 50e6 - 1.0).abs() < 1e-6, "{mean}");
        assert!((deviation / 30e6 - 1.0).abs() < 1e-6, "{deviation}");
    }
}
