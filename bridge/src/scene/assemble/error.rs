//! Why a scene cannot be built.

use haptether_master::ModelError as MasterError;
use haptether_safety::ParameterError;
use haptether_slave::ModelError as SlaveError;

/// A scene that cannot be built.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum SceneError {
    /// A number of the device or the hand.
    #[error("master or operator: {0}")]
    Master(#[from] MasterError),
    /// A number of the arm or of what is touched.
    #[error("slave or environment: {0}")]
    Slave(#[from] SlaveError),
    /// A parameter of the safety layer.
    #[error("safety: {0}")]
    Safety(#[from] ParameterError),
    /// An endpoint.
    #[error("{0}")]
    Endpoint(#[from] crate::EndpointError),
    /// The network.
    #[error("link: {0}")]
    Link(#[from] haptether_netsim::LinkSettingsError),
    /// The clutch.
    #[error("operator.clutch: {0}")]
    Clutch(#[from] crate::ClutchError),
    /// The session.
    #[error("security: {0}")]
    Session(#[from] crate::session::EndError),
    /// It was told to stop.
    #[error("stopped")]
    Stopped,
    /// Tables or keys that contradict each other.
    #[error("{0}")]
    Contradiction(String),
}

impl From<crate::VirtualError> for SceneError {
    fn from(error: crate::VirtualError) -> Self {
        match error {
            crate::VirtualError::Link(error) => error.into(),
            crate::VirtualError::Session(error) => error.into(),
        }
    }
}

pub(super) fn contradiction<T>(text: impl Into<String>) -> Result<T, SceneError> {
    Err(SceneError::Contradiction(text.into()))
}
