//! Velocity and acceleration of the device from its sampled position.
//!
//! An estimator is one file here, which implements [`Estimator`], and one entry in the registry below, with its
//! parameters. What sets them apart is how much of the encoder's quantisation they let through and how late they are.
//! [`MeasuredVelocity`] stands apart: it serves the devices that measure V themselves.

use crate::{About, Axes, ParameterError, Real, lanes::part};

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

/// Declares all that depends on which estimators there are. Each entry has the parameters of `new` after the period,
/// in their order, and says how the estimator is kept: as it is, on the heap, or one for each lane.
macro_rules! estimators {
    ($($(#[$doc:meta])* $kind:ident { $($(#[$meaning:meta])* $parameter:ident: $number:ty,)* } as $kept:ty;)+) => {
        /// An estimator and its parameters.
        #[derive(Clone, Copy, Debug, PartialEq)]
        #[cfg_attr(
            feature = "serde",
            derive(serde::Deserialize, schemars::JsonSchema),
            serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)
        )]
        pub enum EstimatorKind {
            $($(#[$doc])* $kind { $($(#[$meaning])* $parameter: $number,)* },)+
        }

        /// Any of the estimators; those with a window lie on the heap, allocated once when built.
        #[derive(Clone, Debug)]
        pub enum AnyEstimator<const N: usize, S = f64> {
            $($(#[$doc])* $kind($kept),)+
        }

        /// The estimators.
        pub const ESTIMATORS: [About; [$(stringify!($kind)),+].len()] = [$($kind::<1>::ABOUT),+];

        impl EstimatorKind {
            /// The estimator for positions sampled every `period_s`.
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

            /// All of one kind.
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
        /// The line that is fitted.
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
        /// Spectral density `q_v` of the jerk in m²/s⁵ (rad²/s⁵ for joints) that V is filtered for.
        velocity_jerk_density: f64,
        /// The same, q, that A is filtered for.
        jerk_density: f64,
        /// Position quantum in m (rad for joints).
        quantum_m: f64,
    } as DualKalman<N, S>;
}

impl EstimatorKind {
    /// The estimator of a rotation whose handle is held at this lever r in m: angles are x / r, so that what it takes for
    /// noise and for jerk is smaller by r and r².
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

    /// The same for positions of this quantum in m (rad for joints), where it takes one.
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
    /// A Kalman filter for a stylus with a quantum of 23 µm; at 1 kHz its bandwidth is 39 Hz.
    fn default() -> Self {
        Self::Kalman { jerk_density: 10.0, quantum_m: 2.3e-5 }
    }
}

/// Longest window in ticks that a windowed estimator takes; its memory is reserved for it.
pub const MAX_WINDOW: usize = 128;

/// Velocity V in m/s and acceleration A in m/s² of the device at one tick (rad/s, rad/s² for joints).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Motion<const N: usize, S = f64> {
    /// V.
    pub velocity: Axes<N, S>,
    /// A, a weighted mean of the true acceleration over the last ticks.
    pub acceleration: Axes<N, S>,
}

/// A causal estimator of velocity and acceleration.
///
/// Per tick n: first [`step`](Estimator::step) with x\[n\], then at most once
/// [`align`](Estimator::align) with `F_device`\[n-1\]. A caller that needs `align` calls it at every tick, for it
/// remembers past forces; one that does not need it never calls it and pays nothing.
///
/// A new estimator takes the device to have rested at the first position it is given.
pub trait Estimator<const N: usize, S: Real = f64>: Sized {
    /// The same estimator over `f64`.
    type One;

    /// As many estimators as there are lanes, if they can be stepped at once; else None.
    fn gather(of: &[&Self::One]) -> Option<Self>;

    /// Takes the position x\[n\] in m and returns V\[n\] and A\[n\].
    fn step(&mut self, position: &Axes<N, S>) -> Motion<N, S>;

    /// Passes the force held over the tick that ended with the newest position through the same kernel that
    /// stands between the true acceleration and A.
    ///
    /// An estimate A\[n\] is late: it is a mean of the true acceleration over some past ticks. Eq. 4 subtracts a
    /// force from m A, so the force must be the same mean, or every step of the device force would look like a hand.
    fn align(&mut self, device_force: &Axes<N, S>) -> Axes<N, S>;

    /// Moves the origin: all past positions were by so much in m further. V and A of the next positions, given from
    /// the new origin, are what they would have been, but for rounding.
    fn shift(&mut self, by: &Axes<N, S>);

    /// Whether V is a mean over past ticks as A is, which is then a difference of it; else V is of the newest position.
    fn has_late_velocity(&self) -> bool;

    /// Clears the past: the device has been at rest at `position`, without force.
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
