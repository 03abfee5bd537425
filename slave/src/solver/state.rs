//! The state of tool and bodies in steps of the Runge-Kutta method of Dormand and Prince, of order 5 with an estimate
//! of order 4 and a continuous extension.
//!
//! Source: J. R. Dormand, P. J. Prince, "A family of embedded Runge-Kutta formulae", J. Comp. Appl. Math. 6, 1980;
//! continuous extension: E. Hairer, S. P. Norsett, G. Wanner, "Solving ordinary differential equations I", 2nd ed.,
//! section II.6.

use crate::Axes;

/// Error of one step, relative and in m or m/s.
const RELATIVE: f64 = 1e-10;
const ABSOLUTE: f64 = 1e-13;

/// Blocks of the state before the bodies: position, velocity and set velocity of the tool.
pub(crate) const TOOL: usize = 3;

/// Memory of the steps, and the state kept between them.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Solver<const N: usize> {
    pub(crate) state: Vec<Axes<N>>,
    pub(crate) next: Vec<Axes<N>>,
    pub(crate) slopes: [Vec<Axes<N>>; 7],
    /// Next step to try, in s.
    pub(crate) step: f64,
    /// True if the last piece ended coarsely.
    pub(crate) gave_up: bool,
    /// True if the last piece was too stiff for series.
    pub(crate) series_gave_up: bool,
    pub(crate) coarse_steps: u64,
}

impl<const N: usize> Solver<N> {
    pub(crate) fn new(bodies: usize) -> Self {
        let room = || vec![Axes::zeros(); TOOL + 2 * bodies];
        Self {
            state: room(),
            next: room(),
            slopes: std::array::from_fn(|_| room()),
            step: 1e-4,
            gave_up: false,
            series_gave_up: false,
            coarse_steps: 0,
        }
    }

    /// `next = state + h sum(weights slopes)`
    pub(crate) fn combine(&mut self, blocks: usize, step: f64, weights: &[f64]) {
        for block in 0..blocks {
            let mut sum = Axes::zeros();
            for (slope, &weight) in self.slopes.iter().zip(weights) {
                if weight != 0.0 {
                    sum += slope[block] * weight;
                }
            }
            self.next[block] = self.state[block] + sum * step;
        }
    }

    /// Largest estimated error of the step, as a multiple of the tolerance.
    pub(crate) fn error(&self, blocks: usize, step: f64) -> f64 {
        let mut worst = 0.0_f64;
        for block in 0..blocks {
            let mut sum = Axes::zeros();
            for (slope, &weight) in self.slopes.iter().zip(&ERROR) {
                sum += slope[block] * weight;
            }
            for axis in 0..N {
                let size = self.state[block][axis].abs().max(self.next[block][axis].abs());
                let error = (sum[axis] * step).abs() / (ABSOLUTE + RELATIVE * size);
                // The maximum of a number and NaN would be the number.
                worst = if error.is_finite() { worst.max(error) } else { f64::INFINITY };
            }
        }
        worst
    }
}

/// Times of a step.
#[derive(Clone, Copy)]
pub(crate) struct Piece {
    /// Start of the call, in s.
    pub(crate) origin: f64,
    /// A time within the present smooth piece, in s.
    pub(crate) inside: f64,
    /// Time at which the phases of the drive were planned, in s since `origin`.
    pub(crate) planned: f64,
}

/// Times of the stages, as shares of the step.
pub(crate) const NODES: [f64; 7] = [0.0, 1.0 / 5.0, 3.0 / 10.0, 4.0 / 5.0, 8.0 / 9.0, 1.0, 1.0];

/// Weights of the earlier slopes for each stage; the last row is the solution of order 5.
pub(crate) const STAGES: [&[f64]; 7] = [
    &[],
    &[1.0 / 5.0],
    &[3.0 / 40.0, 9.0 / 40.0],
    &[44.0 / 45.0, -56.0 / 15.0, 32.0 / 9.0],
    &[19372.0 / 6561.0, -25360.0 / 2187.0, 64448.0 / 6561.0, -212.0 / 729.0],
    &[9017.0 / 3168.0, -355.0 / 33.0, 46732.0 / 5247.0, 49.0 / 176.0, -5103.0 / 18656.0],
    &[35.0 / 384.0, 0.0, 500.0 / 1113.0, 125.0 / 192.0, -2187.0 / 6784.0, 11.0 / 84.0],
];

/// Order 5 minus order 4.
pub(crate) const ERROR: [f64; 7] =
    [71.0 / 57600.0, 0.0, -71.0 / 16695.0, 71.0 / 1920.0, -17253.0 / 339_200.0, 22.0 / 525.0, -1.0 / 40.0];

/// Weights of the slopes for the state at share `theta` of the step, of order 4.
pub(crate) fn dense(theta: f64) -> [f64; 7] {
    const D: [f64; 7] = [
        -12_715_105_075.0 / 11_282_082_432.0,
        0.0,
        87_487_479_700.0 / 32_700_410_799.0,
        -10_690_763_975.0 / 1_880_347_072.0,
        701_980_252_875.0 / 199_316_789_632.0,
        -1_453_857_185.0 / 822_651_844.0,
        69_997_945.0 / 29_380_423.0,
    ];
    let rest = 1.0 - theta;
    let mut weights = [0.0; 7];
    for (stage, weight) in weights.iter_mut().enumerate() {
        let end = STAGES[6].get(stage).copied().unwrap_or(0.0);
        let first = f64::from(u8::from(stage == 0));
        let last = f64::from(u8::from(stage == 6));
        // theta (dy + rest (k_1 - dy + theta (2 dy - k_1 - k_7 + rest D)))
        let bend = 2.0 * end - first - last + rest * D[stage];
        *weight = theta * (end + rest * (first - end + theta * bend));
    }
    weights
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_tableau_is_consistent() {
        for (stage, row) in STAGES.iter().enumerate() {
            assert!((row.iter().sum::<f64>() - NODES[stage]).abs() < 1e-14, "{stage}");
        }
        assert!(ERROR.iter().sum::<f64>().abs() < 1e-16);
        // Order 5 integrates t^4 exactly, order 4 t^3.
        let moment = |weights: &[f64], power: i32| -> f64 {
            weights.iter().zip(NODES).map(|(b, c)| b * c.powi(power)).sum()
        };
        for power in 1..5_i32 {
            assert!((moment(STAGES[6], power) - 1.0 / f64::from(power + 1)).abs() < 1e-14, "{power}");
        }
        for power in 1..4 {
            assert!(moment(&ERROR, power).abs() < 1e-15, "{power}");
        }
    }

    #[test]
    fn the_extension_is_of_order_four_everywhere() {
        for tenth in 0..=10_u8 {
            let theta = f64::from(tenth) / 10.0;
            let weights = dense(theta);
            for power in 0..4_i32 {
                let sum: f64 = weights.iter().zip(NODES).map(|(b, c)| b * c.powi(power)).sum();
                let exact = theta.powi(power + 1) / f64::from(power + 1);
                assert!((sum - exact).abs() < 1e-14, "{theta} {power}: {sum} {exact}");
            }
        }
    }
}
