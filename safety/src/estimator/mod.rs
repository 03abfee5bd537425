//! Velocity and acceleration of the device from its sampled position.
//!
//! An estimator is one file in this folder, which implements [`Estimator`], and one entry with its parameters in the
//! registry below. Estimators differ in the quantisation noise that they pass and in their lag. [`MeasuredVelocity`]
//! is separate: it serves devices that measure V.

use crate::{About, Axes, ParameterError, Real};
use haptether_numeric::part;

mod adaptive_window;
mod backward_difference;
#[cfg(test)]
mod contract_tests;
mod dual_kalman;
mod kalman;
mod low_pass;
mod measured_velocity;
mod savitzky_golay;

pub use adaptive_window::{AdaptiveWindow, Fit};
pub use backward_difference::BackwardDifference;
pub use dual_kalman::DualKalman;
pub use kalman::Kalman;
pub use low_pass::LowPass;
pub use measured_velocity::MeasuredVelocity;
pub use savitzky_golay::SavitzkyGolay;

/// Declare every item that depends on the set of estimators.
///
/// Each entry lists the parameters of `new` after the period, in order, and the storage: inline, boxed, or one per
/// lane.
macro_rules! estimators {
    ($($(#[$doc:meta])* $kind:ident { $($(#[$meaning:meta])* $parameter:ident: $number:ty,)* } as $kept:ty;)+) => {
        /// Kind of an estimator with its parameters.
        #[derive(Clone, Copy, Debug, PartialEq)]
        #[cfg_attr(
            feature = "serde",
            derive(serde::Deserialize, schemars::JsonSchema),
            serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)
        )]
        pub enum EstimatorKind {
            $($(#[$doc])* $kind { $($(#[$meaning])* $parameter: $number,)* },)+
        }

        /// Any of the estimators. Those with a window are on the heap, allocated once at construction.
        #[derive(Clone, Debug)]
        pub enum AnyEstimator<const N: usize, S = f64> {
            $($(#[$doc])* $kind($kept),)+
        }

        /// Name, title and source of each estimator.
        pub const ESTIMATORS: [About; [$(stringify!($kind)),+].len()] = [$($kind::<1>::ABOUT),+];

        impl EstimatorKind {
            /// Build the estimator for positions sampled every `period_s`.
            pub fn build<const N: usize>(&self, period_s: f64) -> Result<AnyEstimator<N>, ParameterError> {
                Ok(match *self {
                    $(Self::$kind { $($parameter),* } => {
                        AnyEstimator::$kind($kind::new(period_s, $($parameter),*)?.into())
                    })+
                })
            }
        }

        impl<const N: usize, S: Real> Estimator<N, S> for AnyEstimator<N, S> {
            type One = AnyEstimator<N>;

            /// Gather estimators of one kind.
            fn gather(of: &[&AnyEstimator<N>]) -> Option<Self> {
                Some(match of.first()? {
                    $(AnyEstimator::$kind(_) => {
                        let mut all = Vec::with_capacity(of.len());
                        for one in of {
                            let AnyEstimator::$kind(inside) = one else { return None };
                            all.push(inside);
                        }
                        Self::$kind(<$kept as Estimator<N, S>>::gather(&all)?)
                    })+
                })
            }

            #[inline(always)]
            fn step(&mut self, position: &Axes<N, S>) -> Motion<N, S> {
                match self { $(Self::$kind(estimator) => estimator.step(position),)+ }
            }

            #[inline(always)]
            fn align(&mut self, device_force: &Axes<N, S>) -> Axes<N, S> {
                match self { $(Self::$kind(estimator) => estimator.align(device_force),)+ }
            }

            fn shift(&mut self, by: &Axes<N, S>) {
                match self { $(Self::$kind(estimator) => estimator.shift(by),)+ }
            }

            fn has_late_velocity(&self) -> bool {
                match self { $(Self::$kind(estimator) => Estimator::<N, S>::has_late_velocity(estimator),)+ }
            }

            fn reset(&mut self, position: &Axes<N, S>) {
                match self { $(Self::$kind(estimator) => estimator.reset(position),)+ }
            }
        }
    };
}

estimators! {
    /// [`BackwardDifference`].
    BackwardDifference {} as BackwardDifference<N, S>;
    /// [`LowPass`].
    LowPass {
        /// Cut-off `f_c` in Hz.
        cutoff_hz: f64,
    } as LowPass<N, S>;
    /// [`AdaptiveWindow`].
    AdaptiveWindow {
        /// Noise bound d in m (rad for joints).
        noise_bound_m: f64,
        /// Longest window in ticks.
        max_window: usize,
        /// Line that is fitted.
        fit: Fit,
    } as Box<[AdaptiveWindow<N>]>;
    /// [`SavitzkyGolay`].
    SavitzkyGolay {
        /// Degree p of the polynomial, 2 or 3.
        degree: usize,
        /// Samples w in the window.
        window: usize,
    } as Box<SavitzkyGolay<N, S>>;
    /// [`Kalman`].
    Kalman {
        /// Spectral density q of the jerk in m²/s⁵ (rad²/s⁵ for joints).
        jerk_density: f64,
        /// Position quantum in m (rad for joints).
        quantum_m: f64,
    } as Kalman<N, S>;
    /// [`DualKalman`].
    DualKalman {
        /// Spectral density `q_v` of the jerk in m²/s⁵ (rad²/s⁵ for joints), for the filter of V.
        velocity_jerk_density: f64,
        /// Spectral density q of the jerk in m²/s⁵ (rad²/s⁵ for joints), for the filter of A.
        jerk_density: f64,
        /// Position quantum in m (rad for joints).
        quantum_m: f64,
    } as DualKalman<N, S>;
}

impl EstimatorKind {
    /// Convert the parameters to a rotation whose handle is held at lever r in m.
    ///
    /// Angles are x / r, so noise bounds scale by 1 / r and jerk densities by 1 / r².
    #[must_use]
    pub fn at_lever(self, lever_m: f64) -> Self {
        match self {
            Self::Kalman { jerk_density, quantum_m } => Self::Kalman {
                jerk_density: jerk_density / (lever_m * lever_m),
                quantum_m: quantum_m / lever_m,
            },
            Self::DualKalman { velocity_jerk_density, jerk_density, quantum_m } => Self::DualKalman {
                velocity_jerk_density: velocity_jerk_density / (lever_m * lever_m),
                jerk_density: jerk_density / (lever_m * lever_m),
                quantum_m: quantum_m / lever_m,
            },
            Self::AdaptiveWindow { noise_bound_m, max_window, fit } => {
                Self::AdaptiveWindow { noise_bound_m: noise_bound_m / lever_m, max_window, fit }
            }
            other => other,
        }
    }

    /// Set the position quantum in m (rad for joints), for kinds that have one.
    #[must_use]
    pub fn with_quantum(self, quantum: f64) -> Self {
        match self {
            Self::Kalman { jerk_density, .. } => Self::Kalman { jerk_density, quantum_m: quantum },
            Self::DualKalman { velocity_jerk_density, jerk_density, .. } => {
                Self::DualKalman { velocity_jerk_density, jerk_density, quantum_m: quantum }
            }
            Self::AdaptiveWindow { max_window, fit, .. } => {
                Self::AdaptiveWindow { noise_bound_m: quantum, max_window, fit }
            }
            other => other,
        }
    }
}

impl Default for EstimatorKind {
    /// Return a Kalman filter for a stylus with a quantum of 23 µm; its bandwidth at 1 kHz is 39 Hz.
    fn default() -> Self {
        Self::Kalman { jerk_density: 10.0, quantum_m: 2.3e-5 }
    }
}

/// Longest window in ticks of a windowed estimator; its memory is always reserved.
pub const MAX_WINDOW: usize = 128;

/// Velocity V in m/s and acceleration A in m/s² of the device at one tick (rad/s, rad/s² for joints).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Motion<const N: usize, S = f64> {
    /// V.
    pub velocity: Axes<N, S>,
    /// A, a weighted mean of the true acceleration over the last ticks.
    pub acceleration: Axes<N, S>,
}

/// Causal estimator of velocity and acceleration.
///
/// At tick n, call [`step`](Estimator::step) with x\[n\], then optionally [`align`](Estimator::align) with
/// `F_device`\[n-1\]. `align` remembers past forces, so a caller that uses it must call it at every tick. Without
/// `align` it costs nothing.
///
/// A new estimator assumes that the device has rested at its first position.
pub trait Estimator<const N: usize, S: Real = f64>: Sized {
    /// The same estimator over `f64`.
    type One;

    /// Gather one estimator per lane; return None if they cannot be stepped at once.
    fn gather(of: &[&Self::One]) -> Option<Self>;

    /// Take the position x\[n\] in m and return V\[n\] and A\[n\].
    fn step(&mut self, position: &Axes<N, S>) -> Motion<N, S>;

    /// Filter the force held over the last tick with the kernel between the true acceleration and A.
    ///
    /// A\[n\] lags: it is a mean of the true acceleration over past ticks. Eq. 4 subtracts a force from m A, so the
    /// force must be the same mean. Otherwise every step of the device force would look like a hand.
    fn align(&mut self, device_force: &Axes<N, S>) -> Axes<N, S>;

    /// Move the origin: add `by` in m to all past positions.
    ///
    /// Give later positions relative to the new origin; V and A then change only by rounding.
    fn shift(&mut self, by: &Axes<N, S>);

    /// Return true if V is a mean over past ticks and A its difference, and false if V belongs to the newest
    /// position.
    fn has_late_velocity(&self) -> bool;

    /// Clear the past: the device has rested at `position`, without force.
    fn reset(&mut self, position: &Axes<N, S>);
}

impl<const N: usize, S: Real, T: Estimator<N, S>> Estimator<N, S> for Box<T> {
    type One = Box<T::One>;

    fn gather(of: &[&Self::One]) -> Option<Self> {
        part(of, |one| &**one, T::gather).map(Box::new)
    }

    #[inline(always)]
    fn step(&mut self, position: &Axes<N, S>) -> Motion<N, S> {
        T::step(self, position)
    }

    #[inline(always)]
    fn align(&mut self, device_force: &Axes<N, S>) -> Axes<N, S> {
        T::align(self, device_force)
    }

    fn shift(&mut self, by: &Axes<N, S>) {
        T::shift(self, by);
    }

    fn has_late_velocity(&self) -> bool {
        T::has_late_velocity(self)
    }

    fn reset(&mut self, position: &Axes<N, S>) {
        T::reset(self, position);
    }
}
