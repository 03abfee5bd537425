//! The estimators by name, for whoever chooses one at run time.

use super::{AdaptiveWindow, BackwardDifference, Estimator, Fit, Kalman, LowPass, Motion, SavitzkyGolay};
use crate::{Axes, ParameterError, Real};

/// An estimator and its parameters.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(
    feature = "serde",
    derive(serde::Deserialize, schemars::JsonSchema),
    serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)
)]
pub enum EstimatorKind {
    /// [`BackwardDifference`].
    BackwardDifference {},
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
            Self::BackwardDifference {} => {
                AnyEstimator::BackwardDifference(BackwardDifference::new(period_s)?)
            }
            Self::LowPass { cutoff_hz } => AnyEstimator::LowPass(LowPass::new(period_s, cutoff_hz)?),
            Self::AdaptiveWindow { noise_bound_m, max_window, fit } => {
                let estimator = AdaptiveWindow::new(period_s, noise_bound_m, max_window, fit)?;
                AnyEstimator::AdaptiveWindow(Box::new([estimator]))
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
pub enum AnyEstimator<const N: usize, S = f64> {
    /// [`BackwardDifference`].
    BackwardDifference(BackwardDifference<N, S>),
    /// [`LowPass`].
    LowPass(LowPass<N, S>),
    /// [`AdaptiveWindow`], one for each lane.
    AdaptiveWindow(Box<[AdaptiveWindow<N>]>),
    /// [`SavitzkyGolay`].
    SavitzkyGolay(Box<SavitzkyGolay<N, S>>),
    /// [`Kalman`].
    Kalman(Kalman<N, S>),
}

impl<const N: usize, S: Real> AnyEstimator<N, S> {
    /// As many estimators as there are lanes, all of one kind, if that kind can be gathered; else None.
    pub fn gather(of: &[AnyEstimator<N>]) -> Option<Self> {
        // The estimators inside, if all are of the kind that is asked for.
        macro_rules! all {
            ($kind:ident, $inside:ident => $taken:expr) => {
                of.iter()
                    .map(|one| if let AnyEstimator::$kind($inside) = one { Some($taken) } else { None })
                    .collect::<Option<Vec<_>>>()?
            };
        }
        Some(match of.first()? {
            AnyEstimator::BackwardDifference(_) => {
                let all = all!(BackwardDifference, one => one.clone());
                Self::BackwardDifference(BackwardDifference::gather(&all)?)
            }
            AnyEstimator::LowPass(_) => Self::LowPass(LowPass::gather(&all!(LowPass, one => one.clone()))?),
            AnyEstimator::AdaptiveWindow(_) => {
                let all = all!(AdaptiveWindow, one => one.first()?.clone());
                AdaptiveWindow::are_lanes(&all, S::LANES).then_some(Self::AdaptiveWindow(all.into()))?
            }
            AnyEstimator::SavitzkyGolay(_) => {
                let all = all!(SavitzkyGolay, one => SavitzkyGolay::clone(one));
                Self::SavitzkyGolay(Box::new(SavitzkyGolay::gather(&all)?))
            }
            AnyEstimator::Kalman(_) => Self::Kalman(Kalman::gather(&all!(Kalman, one => one.clone()))?),
        })
    }
}

impl<const N: usize, S: Real> Estimator<N, S> for AnyEstimator<N, S> {
    #[inline(always)]
    fn step(&mut self, position: &Axes<N, S>) -> Motion<N, S> {
        match self {
            Self::BackwardDifference(estimator) => estimator.step(position),
            Self::LowPass(estimator) => estimator.step(position),
            Self::AdaptiveWindow(estimator) => estimator.step(position),
            Self::SavitzkyGolay(estimator) => estimator.step(position),
            Self::Kalman(estimator) => estimator.step(position),
        }
    }

    #[inline(always)]
    fn align(&mut self, device_force: &Axes<N, S>) -> Axes<N, S> {
        match self {
            Self::BackwardDifference(estimator) => estimator.align(device_force),
            Self::LowPass(estimator) => estimator.align(device_force),
            Self::AdaptiveWindow(estimator) => estimator.align(device_force),
            Self::SavitzkyGolay(estimator) => estimator.align(device_force),
            Self::Kalman(estimator) => estimator.align(device_force),
        }
    }

    fn reset(&mut self, position: &Axes<N, S>) {
        match self {
            Self::BackwardDifference(estimator) => estimator.reset(position),
            Self::LowPass(estimator) => estimator.reset(position),
            Self::AdaptiveWindow(estimator) => estimator.reset(position),
            Self::SavitzkyGolay(estimator) => estimator.reset(position),
            Self::Kalman(estimator) => estimator.reset(position),
        }
    }
}
