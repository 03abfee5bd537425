//! Delay distribution as a table: cells of equal width in z, the standard normal variate of the delay.
//!
//! The delay is linear within a cell. This changes mean and standard deviation by about 1e-5 of the latter,
//! and a tail of 1e-16 is missing on each side. The delays are therefore scaled and shifted to the exact
//! moments.

use std::sync::LazyLock;

use crate::impairments::law::{DelayLaw, Tails};

const PER_UNIT: usize = 64;
pub(super) const WIDTH: f64 = 1.0 / PER_UNIT as f64;
/// The cells span -8.25 to 8.25.
pub(super) const COUNT: usize = 2 * 528;
const FIRST: f64 = -8.25;

/// Cell borders, the same for every distribution.
static POINTS: LazyLock<Box<[Tails]>> =
    LazyLock::new(|| (0..=COUNT).map(|k| Tails::of_normal(FIRST + k as f64 * WIDTH)).collect());

#[derive(Clone, Debug)]
pub(super) struct Cells {
    /// Delay in ns at the cell borders, ascending.
    pub(super) delay_ns: Box<[f64]>,
    /// Probability of each cell.
    pub(super) mass: Box<[f64]>,
}

impl Cells {
    pub(super) fn of(law: &DelayLaw) -> Self {
        let points = &*POINTS;
        let mut mass: Box<[f64]> =
            points
                .windows(2)
                // The smaller tail has full precision.
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

    /// Cell of a normal variate, and the fraction within the cell.
    pub(super) fn place(z: f64) -> (usize, f64) {
        let place = ((z - FIRST) * PER_UNIT as f64).clamp(0.0, COUNT as f64);
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped to the cells")]
        let cell = (place as usize).min(COUNT - 1);
        (cell, place - cell as f64)
    }

    /// Test if the delay is linear in the variate, as for an untruncated normal distribution. Both then have
    /// the same correlation.
    pub(super) fn are_linear(&self) -> bool {
        let span = self.delay_ns[COUNT] - self.delay_ns[0];
        let step = span / COUNT as f64;
        // Far above the rounding of delays up to an hour, and far below a correlation change of 1e-4.
        self.delay_ns.windows(2).all(|ends| (ends[1] - ends[0] - step).abs() <= 1e-6 * span)
    }

    /// Correlation of two standard normal variates whose delays have the correlation `exp(-1)`. It is at
    /// least `exp(-1)`: no function of normal variates has a higher correlation than they have.
    ///
    /// With the coefficients `a_n = E[D He_n(z)] / sqrt(n!)` the correlation of delays is
    /// `sum a_n² rho^n / sum a_n²`.
    ///
    /// Source: Mehler's formula; G. Cario, B. Nelson, "Autoregressive to anything", Operations Research
    /// Letters 19, 1996 (a prescribed autocorrelation).
    pub(super) fn correlation_for_one_e(&self) -> f64 {
        const ORDERS: u8 = 64;
        let wanted = libm::exp(-1.0);
        let places = (0..=COUNT).map(|k| FIRST + k as f64 * WIDTH);
        // The trapezoidal rule is exact to rounding for a smooth function that vanishes at both ends; the
        // constant factor cancels.
        let weights: Vec<f64> = places.clone().map(|z| libm::exp(-0.5 * z * z)).collect();
        let total: f64 = weights.iter().sum();
        let mean =
            weights.iter().zip(&self.delay_ns).map(|(weight, delay)| weight * delay).sum::<f64>() / total;
        let apart: Vec<f64> =
            weights.iter().zip(&self.delay_ns).map(|(weight, delay)| weight * (delay - mean)).collect();
        let variance: f64 =
            apart.iter().zip(&self.delay_ns).map(|(apart, delay)| apart * (delay - mean)).sum();
        // He_n / sqrt(n!) at every border, order by order.
        let (mut before, mut here) = (vec![0.0; COUNT + 1], vec![1.0; COUNT + 1]);
        let shares: Vec<f64> = (0..ORDERS)
            .map(|n| {
                let n = f64::from(n);
                for ((before, here), z) in before.iter_mut().zip(&mut here).zip(places.clone()) {
                    let next = (z * *here - n.sqrt() * *before) / (n + 1.0).sqrt();
                    (*before, *here) = (*here, next);
                }
                let product: f64 = apart.iter().zip(&here).map(|(apart, here)| apart * here).sum();
                product * product / (variance * total)
            })
            .collect();
        let correlation = |rho: f64| shares.iter().rev().fold(0.0, |sum, share| (sum + share) * rho);
        let (mut low, mut high) = (wanted, 1.0);
        for _ in 0..60 {
            let middle = 0.5 * (low + high);
            if correlation(middle) < wanted { low = middle } else { high = middle }
        }
        high
    }

    pub(super) fn delay_ns(&self, z: f64) -> f64 {
        let (cell, part) = Self::place(z);
        let [a, b] = [self.delay_ns[cell], self.delay_ns[cell + 1]];
        a + (b - a) * part
    }
}

/// Mean and standard deviation of delays that are uniform within each cell; `near` is any value close to the
/// mean.
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
    use crate::{Distribution, LinkSettings};

    #[test]
    fn correlation_of_delays_matches_closed_forms() {
        let rho =
            |settings: LinkSettings| Cells::of(&DelayLaw::new(&settings).unwrap()).correlation_for_one_e();
        let of = |jitter_s, distribution| LinkSettings {
            delay_s: 0.05,
            jitter_s,
            distribution,
            ..LinkSettings::default()
        };
        // The delay is linear in the variate.
        assert!((rho(of(0.001, Distribution::Normal)) - (-1.0_f64).exp()).abs() < 1e-5);
        let linear = |settings| Cells::of(&DelayLaw::new(&settings).unwrap()).are_linear();
        assert!(linear(of(0.001, Distribution::Normal)) && linear(of(0.005, Distribution::Normal)));
        assert!(
            ![Distribution::Uniform, Distribution::Lognormal, Distribution::Gamma]
                .into_iter()
                .any(|distribution| linear(of(0.01, distribution)))
        );
        // (6 / pi) asin(rho / 2) (Pearson 1907).
        let uniform = 2.0 * (std::f64::consts::PI / 6.0 * (-1.0_f64).exp()).sin();
        assert!((rho(of(0.001, Distribution::Uniform)) - uniform).abs() < 1e-4);
        // (exp(s² rho) - 1) / (exp(s²) - 1), with exp(s²) - 1 = (sigma / mean)².
        let square = 1.04_f64.ln();
        let lognormal = (0.04 * (-1.0_f64).exp()).ln_1p() / square;
        assert!((rho(of(0.01, Distribution::Lognormal)) - lognormal).abs() < 1e-4);
    }

    #[test]
    fn mean_and_deviation_match_the_settings() {
        let settings = LinkSettings { delay_s: 0.05, jitter_s: 0.03, ..LinkSettings::default() };
        let cells = Cells::of(&DelayLaw::new(&settings).unwrap());
        let (mean, deviation) = moments(&cells.delay_ns, &cells.mass, 0.0);
        assert!((mean / 50e6 - 1.0).abs() < 1e-6, "{mean}");
        assert!((deviation / 30e6 - 1.0).abs() < 1e-6, "{deviation}");
    }
}
