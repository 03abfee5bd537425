//! Conversion of the numbers of a scene to its parts.

mod master;
mod safety;
mod touched;
mod trigger;

use haptether_master::ModelError as MasterError;
use haptether_safety::ParameterError;
use haptether_slave::{ArmSettings, ModelError as SlaveError};

use super::spec::{CouplingSpec, SceneSpec};

pub use touched::scene_environment;

pub(super) use master::{clutch, device_model, driven_clutch, exact_master, live_clutch};
pub(super) use safety::{limiter, watch};
pub(super) use touched::{environment, is_continuous, is_formula, rendered_walls};
pub(super) use trigger::{simulated_trigger, trigger_feedback};

/// Error of a scene that cannot be built.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum SceneError {
    /// The JSON is not a scene; holds the text of serde.
    #[error("scene: {0}")]
    Json(String),
    /// A value of device or hand is invalid.
    #[error("master or operator: {0}")]
    Master(#[from] MasterError),
    /// A value of arm or environment is invalid.
    #[error("slave or environment: {0}")]
    Slave(#[from] SlaveError),
    /// A parameter of the safety layer is invalid.
    #[error("safety: {0}")]
    Safety(#[from] ParameterError),
    /// A setting of an endpoint is invalid.
    #[error("{0}")]
    Endpoint(#[from] crate::EndpointError),
    /// A setting of the network is invalid.
    #[error("link: {0}")]
    Link(#[from] haptether_netsim::LinkSettingsError),
    /// A setting of the clutch is invalid.
    #[error("operator.clutch: {0}")]
    Clutch(#[from] crate::ClutchError),
    /// A setting of the buttons is invalid.
    #[error(transparent)]
    Buttons(#[from] crate::ButtonError),
    /// The session could not be built.
    #[error("security: {0}")]
    Session(#[from] crate::session::EndError),
    /// The run was stopped from outside.
    #[error("stopped")]
    Stopped,
    /// Tables or keys contradict each other.
    #[error("{0}")]
    Contradiction(String),
}

impl<const N: usize> SceneSpec<N> {
    /// Return the arm and the coupling of a scene with two sides.
    pub(super) fn coupled(&self) -> Result<(&ArmSettings<N>, &CouplingSpec), SceneError> {
        let missing = |text: &str| SceneError::Contradiction(text.to_owned());
        let slave = self.slave.as_ref().ok_or_else(|| missing("slave: is missing"))?;
        let coupling =
            self.coupling.as_ref().ok_or_else(|| missing("coupling: a [slave] must be coupled"))?;
        Ok((slave, coupling))
    }
}

impl From<serde_json::Error> for SceneError {
    fn from(error: serde_json::Error) -> Self {
        Self::Json(error.to_string())
    }
}

impl From<crate::VirtualError> for SceneError {
    fn from(error: crate::VirtualError) -> Self {
        match error {
            crate::VirtualError::Link(error) => error.into(),
            crate::VirtualError::Session(error) => error.into(),
        }
    }
}

/// Return the error of an invalid number of axes.
pub(super) fn bad_axes(axes: usize) -> SceneError {
    SceneError::Contradiction(format!("master.axes = {axes}: must be 1 to 7"))
}

pub(super) fn contradiction<T>(text: impl Into<String>) -> Result<T, SceneError> {
    Err(SceneError::Contradiction(text.into()))
}

/// Convert a time of a scene from s to ns.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // not negative, and saturates
pub(super) fn ns(seconds: f64) -> u64 {
    (seconds * 1e9).round() as u64
}

/// Convert a period from s to a whole number of ns.
pub(super) fn period_ns(name: &str, seconds: f64) -> Result<u64, SceneError> {
    let exact = seconds * 1e9;
    if !(1e4..=2e7).contains(&exact) || (exact - exact.round()).abs() > 1e-3 {
        return contradiction(format!(
            "{name} = {seconds}: must be a whole number of nanoseconds between 1e-5 and 2e-2 s"
        ));
    }
    Ok(ns(seconds))
}

/// Largest number of ticks of one run.
const MAX_TICKS: f64 = 2e7;

/// Return the number of ticks of the run.
pub(super) fn ticks<const N: usize>(scene: &SceneSpec<N>) -> Result<u64, SceneError> {
    let (duration, period) = (scene.run.duration_s, scene.run.period_s);
    let ticks = (duration / period).round();
    if !(duration > 0.0 && (1.0..=MAX_TICKS).contains(&ticks)) {
        return contradiction(format!(
            "run: duration_s = {duration} of ticks of {period} s is {ticks} ticks, must be 1 to 2e7"
        ));
    }
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // checked above
    Ok(ticks as u64)
}

/// Largest delay of an environment in ticks.
const MAX_DELAY_TICKS: usize = 100_000;

/// Return the delay in ticks of the environment's force.
pub(super) fn delay_ticks<const N: usize>(scene: &SceneSpec<N>) -> Result<usize, SceneError> {
    let ticks = scene.environment.as_ref().map_or(0, |environment| environment.delay_ticks);
    if ticks > MAX_DELAY_TICKS {
        return contradiction(format!(
            "environment.delay_ticks = {ticks}: must be at most {MAX_DELAY_TICKS}"
        ));
    }
    Ok(ticks)
}
