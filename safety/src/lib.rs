//! Safety observers, controllers and limits that stand between a remote push and a hand.
//!
//! Per tick: position -> [`Guard`] -> [`estimator`] -> grasp force ([`DeviceModel::grasp_force`]) -> [`observer`] ->
//! [`controller`] -> [`Limiter`]. [`SafetyLayer`] is that pipeline in one step, [`RotationLayer`] the same of a rotation,
//! [`WrenchLayer`] both for one hand. Everything is a pure state machine: no clock, no allocation after construction, no
//! lock. What a point needs is written over a [`Real`]: `f64`, or lanes of several scenarios that are stepped at once.

pub mod controller;
pub mod estimator;
mod fault;
mod grasp;
mod lanes;
mod layer;
mod limiter;
pub mod observer;
mod parameter;
mod plausible;
mod rotation;
mod wrench;

pub use fault::{Fault, Signal};
pub use grasp::DeviceModel;
pub use lanes::{Axes, Real, is_within, norm};
pub use layer::{Advance, LayerSettings, SafetyLayer, SafetyTick};
pub use limiter::{Acted, Limited, Limiter, LimiterSettings, SaturatedForce};
pub use observer::Observation;
pub use parameter::ParameterError;
pub use plausible::{Excess, Guard, Sample, SampleBounds, Track, Turned};
pub use rotation::{RotationLayer, RotationModel, RotationSettings};
pub use wrench::{PoseSample, WrenchLayer, WrenchSettings, WrenchTick};

/// What an observer, a controller or an estimator is called, and where it comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct About {
    /// Its name, where one of them is chosen.
    pub name: &'static str,
    /// What it goes by, in a few words.
    pub title: &'static str,
    /// Its equation, or where it is described.
    pub source: &'static str,
}
