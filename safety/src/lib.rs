//! Safety observers, controllers and limits that stand between a remote push and a hand.
//!
//! Per tick: position -> [`estimator`] -> grasp force ([`DeviceModel::grasp_force`]) -> [`observer`] ->
//! [`controller`] -> [`Limiter`]. [`SafetyLayer`] is that chain in one step. Everything is a pure state machine:
//! no clock, no allocation after construction, no lock. All of it is written over a [`Real`]: `f64`, or lanes of
//! several scenarios that are stepped at once.

mod axes;
pub mod controller;
pub mod estimator;
mod fault;
mod grasp;
mod lanes;
mod layer;
mod limiter;
mod observation;
pub mod observer;
mod parameter;

pub use axes::{Axes, is_within};
pub use fault::{Fault, Signal};
pub use grasp::DeviceModel;
pub use lanes::Real;
pub use layer::{Advance, LayerSettings, SafetyLayer, SafetyTick};
pub use limiter::{Acted, Bounded, Limited, Limiter, LimiterSettings};
pub use observation::Observation;
pub use parameter::ParameterError;
