//! Scene data that is read before the number of axes is known.

use serde::{Deserialize, de::DeserializeOwned, de::IgnoredAny};

use super::{assemble::SceneError, spec::SceneSpec};
use crate::SideKind;

/// Scene data that a caller needs before it reads the [`SceneSpec`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SceneOutline {
    /// Number of axes.
    pub axes: usize,
    /// Kind of the coordinates.
    pub kind: SideKind,
    /// Period of the master in s.
    pub period_s: f64,
    /// Period of the slave in s; without an arm, that of the master.
    pub slave_period_s: f64,
    /// True if the trigger has force feedback.
    pub feels_trigger: bool,
}

/// Read the outline of a scene as JSON; other fields are ignored.
///
/// # Errors
///
/// The text is not valid JSON, or a number is missing.
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

/// Read a scene as JSON, with the number of axes in [`SceneOutline::axes`].
///
/// It is read through a tree of values, like the rows of a sweep, so that the reader of each table is compiled only
/// once.
///
/// # Errors
///
/// The text is not valid JSON, or not a scene with N axes.
pub(super) fn scene_spec<const N: usize>(json: &[u8]) -> Result<SceneSpec<N>, SceneError>
where
    SceneSpec<N>: DeserializeOwned,
{
    let tree: serde_json::Value = serde_json::from_slice(json)?;
    Ok(SceneSpec::deserialize(&tree)?)
}
