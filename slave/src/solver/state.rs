//! The state of tool and bodies, its slopes and the error of a step.

use crate::{Axes, solver::dormand_prince::ERROR};

/// Error of one step, relative and in m or m/s.
const RELATIVE: f64 = 1e-10;
const ABSOLUTE: f64 = 1e-13;

/// Blocks of the state before the bodies: position, velocity and set velocity of the tool.
pub(crate) const TOOL: usize = 3;

/// Room for the steps, and what is remembered from one to the next.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Solver<const N: usize> {
    pub(crate) state: Vec<Axes<N>>,
    pub(crate) next: Vec<Axes<N>>,
    pub(crate) slopes: [Vec<Axes<N>>; 7],
    /// Next step to try, in s.
    pub(crate) step: f64,
    /// Whether the last piece ended coarsely.
    pub(crate) gave_up: bool,
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

    /// Largest estimated error of the step, as a multiple of what is allowed.
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

/// Where in time a step is.
#[derive(Clone, Copy)]
pub(crate) struct Piece {
    /// When the call began, in s.
    pub(crate) origin: f64,
    /// A time within the present smooth piece, in s.
    pub(crate) inside: f64,
}
