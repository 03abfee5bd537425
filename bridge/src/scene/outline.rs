//! The numbers of a scene that its number of axes does not change.

use serde::{Deserialize, de::DeserializeOwned, de::IgnoredAny};

use super::{assemble::SceneError, spec::SceneSpec};
use crate::SideKind;

/// What a caller must know of a scene before its [`SceneSpec`] is read.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SceneOutline {
    /// Number of axes.
    pub axes: usize,
    /// Kind of the coordinates.
    pub kind: SideKind,
    /// Period of the master in s.
    pub period_s: f64,
    /// Period of the slave in s; that of the master without an arm.
    pub slave_period_s: f64,
    /// Whether the finger feels its trigger.
    pub feels_trigger: bool,
}

/// Read the outline of a scene as JSON; the rest of it is not looked at.
///
/// # Errors
///
/// No JSON, or a number that is missing.
pub fn scene_outline(json: &[u8]) -> Result<SceneOutline, SceneError> {
    #[derive(Deserialize)]
    struct Master {
        axes: usize,
        kind: SideKind,
        gripper: Option<IgnoredAny>,
    }
    #[derive(Deserialize)]
    struct Period {
        period_s: f64,
    }
    #[derive(Deserialize)]
    struct Scene {
        run: Period,
        master: Master,
        slave: Option<Period>,
    }
    let Scene { run, master, slave } = serde_json::from_slice(json)?;
    Ok(SceneOutline {
        axes: master.axes,
        kind: master.kind,
        period_s: run.period_s,
        slave_period_s: slave.map_or(run.period_s, |slave| slave.period_s),
        feels_trigger: master.gripper.is_some(),
    })
}

/// Read a scene as JSON, of as many axes as [`SceneOutline::axes`] says.
///
/// Through a tree of values, as the rows of a sweep: the reader of each table is then compiled once.
///
/// # Errors
///
/// No JSON, or no scene of so many axes.
pub(super) fn scene_spec<const N: usize>(json: &[u8]) -> Result<SceneSpec<N>, SceneError>
where
    SceneSpec<N>: DeserializeOwned,
{
    let tree: serde_json::Value = serde_json::from_slice(json)?;
    Ok(SceneSpec::deserialize(&tree)?)
}
