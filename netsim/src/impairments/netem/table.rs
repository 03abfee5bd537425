//! Distribution tables of netem: inverse distribution functions at 4096 probabilities. They end at four
//! standard deviations, the range of 16 bits in units of 1/8192.
//!
//! The tables are computed from their definitions, so a value may differ by one unit from the file of
//! iproute2.
//!
//! Source: `tc-netem(8)`; the definitions are those of NIST Net, in `netem/` of iproute2.

/// Table units per standard deviation.
pub(super) const SCALE: i64 = 8192;
const SIZE: u16 = 4096;
/// Index of the Pareto distribution of the tables. Its mean is 3/2, its standard deviation 3/4 by its
/// defining factor.
const PARETO_SHAPE: f64 = 3.0;

/// Normal: the point below which i/4096 of the probability lies.
pub(super) fn normal() -> Vec<i16> {
    (0..SIZE).map(|position| cut(scaled_normal(position))).collect()
}

/// Pareto: `4/3 (q^(-1/3) - 3/2)`, q the probability above.
pub(super) fn pareto() -> Vec<i16> {
    (0..SIZE).map(|position| cut(scaled_pareto(position))).collect()
}

/// Mix of 1/4 normal and 3/4 Pareto table.
pub(super) fn pareto_normal() -> Vec<i16> {
    let mixed = |position| {
        let normal = scaled_normal(position).round();
        let pareto = scaled_pareto(position).min(f64::from(i16::MAX)).round();
        ((normal + 3.0 * pareto) / 4.0).trunc()
    };
    (0..SIZE).map(|position| cut(mixed(position))).collect()
}

fn scaled_pareto(position: u16) -> f64 {
    let above = f64::from(SIZE - position) / f64::from(SIZE);
    4.0 / 3.0 * (libm::pow(above, -1.0 / PARETO_SHAPE) - 1.5) * SCALE as f64
}

/// Largest x on a grid of 5e-5 whose probability, rounded to 1/16384, is that of the position.
fn scaled_normal(position: u16) -> f64 {
    const STEP: f64 = 5e-5;
    // A remainder below half of 1/16384 rounds to zero.
    let below = (4.0 * f64::from(position) + 0.5) / 16_384.0;
    let (mut low, mut high) = (-10.0, 10.0);
    for _ in 0..40 {
        let middle = 0.5 * (low + high);
        if 0.5 * libm::erfc(-middle / std::f64::consts::SQRT_2) < below {
            low = middle;
        } else {
            high = middle;
        }
    }
    (low / STEP).floor() * STEP * SCALE as f64
}

#[expect(clippy::cast_possible_truncation, reason = "cut to the range just before")]
fn cut(value: f64) -> i16 {
    value.clamp(f64::from(i16::MIN), f64::from(i16::MAX)).round() as i16
}

#[cfg(test)]
mod tests {
    use super::*;

    fn moments(table: &[i16]) -> (f64, f64) {
        let count = table.len() as f64;
        let unit = |value: &i16| f64::from(*value) / SCALE as f64;
        let mean = table.iter().map(unit).sum::<f64>() / count;
        let square = table.iter().map(|value| unit(value).powi(2)).sum::<f64>() / count;
        (mean, (square - mean * mean).sqrt())
    }

    /// Moments measured on the tables of iproute2.
    #[test]
    fn tables_have_the_moments_of_iproute2() {
        let close =
            |seen: f64, expected: f64, within: f64| assert!((seen - expected).abs() < within, "{seen}");
        let (mean, sigma) = moments(&normal());
        close(mean, -0.001, 0.0011);
        close(sigma, 1.0, 0.002);
        close(f64::from(*normal().last().unwrap()) / 8192.0, 3.5, 0.1);
        let pareto = pareto();
        let (mean, sigma) = moments(&pareto);
        close(mean, -0.034, 0.001);
        close(sigma, 0.82, 0.005);
        let unit = |value: i16| f64::from(value) / 8192.0;
        close(unit(pareto[2048]), -0.32, 0.005);
        close(unit(pareto[0]), -0.67, 0.005);
        let at_the_end = pareto.iter().filter(|&&value| value == i16::MAX).count() as f64 / 4096.0;
        close(at_the_end, 0.01, 0.002);
        let (mean, sigma) = moments(&pareto_normal());
        close(mean, -0.025, 0.002);
        close(sigma, 0.83, 0.005);
    }

    #[test]
    fn tables_rise() {
        for table in [normal(), pareto(), pareto_normal()] {
            assert_eq!(table.len(), 4096);
            assert!(table.is_sorted());
        }
    }
}
