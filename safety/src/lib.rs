//! Safety observers, controllers and limits between a remote push and a hand.
//!
//! Per tick: position -> [`Guard`] -> [`estimator`] -> grasp force ([`DeviceModel::grasp_force`]) -> [`observer`] ->
//! [`controller`] -> [`Limiter`]. [`SafetyLayer`] runs these steps for a position, [`RotationLayer`] for a rotation, and
//! [`WrenchLayer`] for position and rotation of one hand. They are pure state machines. They read no clock and take
//! no lock, and they allocate only at construction. The code for positions is generic over [`Real`]: an `f64`, or SIMD lanes that step
//! several scenarios at once.
//!
//! "The paper" is *Safety Control for Impedance Haptic Interfaces*: see `docs/paper.md`.

pub mod controller;
pub mod estimator;
mod fault;
mod grasp;
mod layer;
mod limiter;
pub mod observer;
mod parameter;
mod plausible;
mod renewal;
mod rotation;
mod wrench;

pub use fault::{Fault, Signal};
pub use grasp::DeviceModel;
pub use haptether_numeric::{Axes, Real, is_within, norm};
pub use layer::{Advance, Coupled, LayerSettings, SafetyLayer, SafetyTick};
pub use limiter::{ActiveLimits, Limited, Limiter, LimiterSettings, SaturatedForce};
pub use observer::Observation;
pub use parameter::ParameterError;
pub use plausible::{Excess, Guard, Sample, SampleBounds, Track, Turned};
pub use renewal::{MIN_RENEWAL, Renewal, Stamped};
pub use rotation::{CoupledTurn, RotationLayer, RotationModel, RotationSettings};
pub use wrench::{PoseSample, WrenchLayer, WrenchSettings, WrenchTick};

/// Name, title and source of an observer, a controller or an estimator.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct About {
    /// Name in settings and on the command line.
    pub name: &'static str,
    /// Title of a few words.
    pub title: &'static str,
    /// Equation or reference.
    pub source: &'static str,
}
