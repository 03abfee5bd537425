//! The estimators by name, for whoever chooses one at run time.

use super::{AdaptiveWindow, BackwardDifference, Estimator, Fit, Kalman, LowPass, Motion, SavitzkyGolay};
use crate::{Axes, ParameterError};

/// An estimator and its parameters.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum EstimatorKind {
    /// [`BackwardDifference`].
    BackwardDifference,
    /// [`LowPass`].
    LowPass {
        /// Cut-off `f_c` in Hz.
        cutoff_hz: f64,
    },
    /// [`AdaptiveWindow`].
    AdaptiveWindow {
        /// Noise bound d in m (rad for joints).
        noise_bound_m: f64,
        /// Longest window in ticks.
        max_window: usize,
        /// The line that is fitted.
        fit: Fit,
    },
    /// [`SavitzkyGolay`].
    SavitzkyGolay {
        /// Degree p of the polynomial, 2 or 3.
        degree: usize,
        /// Samples w in the window.
        window: usize,
    },
    /// [`Kalman`].
    Kalman {
        /// Spectral density q of the jerk in m²/s⁵ (rad²/s⁵ for joints).
        jerk_density: f64,
        /// Position quantum in m (rad for joints).
        quantum_m: f64,
    },
}

impl Default for EstimatorKind {
    /// A Kalman filter for a stylus with a quantum of 23 µm; at 1 kHz its bandwidth is 39 Hz.
    fn default() -> Self {
        Self::Kalman { jerk_density: 10.0, quantum_m: 2.3e-5 }
    }
}

impl EstimatorKind {
    /// The estimator for positions sampled every `period_s`.
    pub fn build<const N: usize>(&self, period_s: f64) -> Result<AnyEstimator<N>, ParameterError> {
        Ok(match *self {
            Self::BackwardDifference => AnyEstimator::BackwardDifference(BackwardDifference::new(period_s)?),
            Self::LowPass { cutoff_hz } => AnyEstimator::LowPass(LowPass::new(period_s, cutoff_hz)?),
            Self::AdaptiveWindow { noise_bound_m, max_window, fit } => {
                let estimator = AdaptiveWindow::new(period_s, noise_bound_m, max_window, fit)?;
                AnyEstimator::AdaptiveWindow(Box::new(estimator))
            }
            Self::SavitzkyGolay { degree, window } => {
                AnyEstimator::SavitzkyGolay(Box::new(SavitzkyGolay::new(period_s, degree, window)?))
            }
            Self::Kalman { jerk_density, quantum_m } => {
                AnyEstimator::Kalman(Kalman::new(period_s, jerk_density, quantum_m)?)
            }
        })
    }
}

/// Any of the estimators; those with a window lie on the heap, allocated once when built.
#[derive(Clone, Debug)]
pub enum AnyEstimator<const N: usize> {
    /// [`BackwardDifference`].
    BackwardDifference(BackwardDifference<N>),
    /// [`LowPass`].
    LowPass(LowPass<N>),
    /// [`AdaptiveWindow`].
    AdaptiveWindow(Box<AdaptiveWindow<N>>),
    /// [`SavitzkyGolay`].
    SavitzkyGolay(Box<SavitzkyGolay<N>>),
    /// [`Kalman`].
    Kalman(Kalman<N>),
}

impl<const N: usize> Estimator<N> for AnyEstimator<N> {
    fn step(&mut self, position: &Axes<N>) -> Motion<N> {
        match self {
            Self::BackwardDifference(estimator) => estimator.step(position),
            Self::LowPass(estimator) => estimator.step(position),
            Self::AdaptiveWindow(estimator) => estimator.step(position),
            Self::SavitzkyGolay(estimator) => estimator.step(position),
            Self::Kalman(estimator) => estimator.step(position),
        }
    }

    fn align(&mut self, device_force: &Axes<N>) -> Axes<N> {
        match self {
            Self::BackwardDifference(estimator) => estimator.align(device_force),
            Self::LowPass(estimator) => estimator.align(device_force),
            Self::AdaptiveWindow(estimator) => estimator.align(device_force),
            Self::SavitzkyGolay(estimator) => estimator.align(device_force),
            Self::Kalman(estimator) => estimator.align(device_force),
        }
    }

    fn reset(&mut self, position: &Axes<N>) {
        match self {
            Self::BackwardDifference(estimator) => estimator.reset(position),
            Self::LowPass(estimator) => estimator.reset(position),
            Self::AdaptiveWindow(estimator) => estimator.reset(position),
            Self::SavitzkyGolay(estimator) => estimator.reset(position),
            Self::Kalman(estimator) => estimator.reset(position),
        }
    }
}
