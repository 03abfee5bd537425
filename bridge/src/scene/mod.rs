//! Scenes: whole experiments as values, run in virtual time, one by one or in sweeps.

mod aims;
mod assemble;
mod bilateral;
mod coupling;
mod live;
mod local;
mod measures;
mod metrics;
mod outline;
mod pose;
mod record;
mod replay;
mod research;
mod shared;
mod sides;
mod spec;
mod sweep;
mod timed;
mod tool_environment;
mod tracking;
mod watched;

use haptether_numeric::of_axes;

use std::sync::atomic::AtomicBool;

use bilateral::RunOptions;

pub use assemble::{SceneError, scene_environment};
pub use bilateral::RecordingFiles;
pub use live::{
    KeptRecords, LiveError, LiveParts, LiveSide, MasterDriverLoop, MasterInput, MasterOutput,
    SlaveDriverLoop, SlaveInput, SlaveOutput, pace_scene_master, pace_scene_slave, run_scene_side,
};
pub use measures::{Divergence, DivergenceCause, Ending, Outcome};
pub use metrics::{Metric, Metrics};
pub use outline::{SceneOutline, scene_outline};
pub use pose::as_pose;
pub use record::{SceneEvent, SceneRun, Signal};
pub use replay::{
    HandImpedance, RecordedColumns, RecordedTick, Replay, ReplayError, ReplayedColumn, ReplayedColumns,
    ReplayedTick, replay_columns,
};
pub use research::ResearchFactory;
pub use sides::{
    LiveDevice, driven_master, driven_slave, simulated_master, simulated_pose_master, simulated_pose_slave,
    simulated_slave,
};
pub use spec::{ResearchSpec, SceneSpec, scene_axes, scene_schema};
pub use sweep::{Progress, Refused, SweepError, SweepPart, SweepSettings, Variation, sweep, sweep_parts};
pub use timed::Timed;
pub use tool_environment::{ToolEnvironment, tool_environment};

/// Run a scene given as JSON in the form of [`SceneSpec`], to its end or until `stop` is set.
///
/// # Errors
///
/// As [`run`], and if the text is not a scene.
pub fn simulate(scene: &[u8], stop: &AtomicBool) -> Result<SceneRun, SceneError> {
    simulate_recorded(scene, stop, None, None)
}

/// Same as [`simulate`], with recording to `files` and research controllers from `research`.
///
/// # Errors
///
/// As [`simulate`], and if a file cannot be written, or the scene to record has no arm.
pub fn simulate_recorded(
    scene: &[u8],
    stop: &AtomicBool,
    files: Option<&RecordingFiles>,
    research: Option<&dyn ResearchFactory>,
) -> Result<SceneRun, SceneError> {
    simulate_with_options(scene, stop, &RunOptions { files, research, ..RunOptions::default() })
}

/// Same as [`simulate`], but every frame is encoded and decoded as on a live link. The result is bit-identical, and
/// the run takes longer.
///
/// # Errors
///
/// As [`simulate`].
pub fn simulate_encoded(scene: &[u8], stop: &AtomicBool) -> Result<SceneRun, SceneError> {
    simulate_with_options(scene, stop, &RunOptions { encoded: true, ..RunOptions::default() })
}

fn simulate_with_options(
    scene: &[u8],
    stop: &AtomicBool,
    options: &RunOptions<'_>,
) -> Result<SceneRun, SceneError> {
    of_axes!(
        scene_axes(scene)?,
        N => run_with_options::<N>(&outline::scene_spec(scene)?, stop, options),
        axes => Err(assemble::bad_axes(axes))
    )
}

/// Run a scene to its end or until `stop` is set.
///
/// # Errors
///
/// A number or combination of settings is invalid, or [`SceneError::Stopped`]. Divergence is an outcome, not an error.
pub fn run<const N: usize>(scene: &SceneSpec<N>, stop: &AtomicBool) -> Result<SceneRun, SceneError> {
    run_with_options(scene, stop, &RunOptions::default())
}

/// Same as [`run`], for the outcome only and in less time.
pub(crate) fn outcome<const N: usize>(
    scene: &SceneSpec<N>,
    stop: &AtomicBool,
    research: Option<&dyn ResearchFactory>,
) -> Result<Outcome, SceneError> {
    let options = RunOptions { outcome_only: true, research, ..RunOptions::default() };
    run_with_options(scene, stop, &options).map(|run| run.outcome)
}

fn run_with_options<const N: usize>(
    scene: &SceneSpec<N>,
    stop: &AtomicBool,
    options: &RunOptions<'_>,
) -> Result<SceneRun, SceneError> {
    pose::check_kind(scene)?;
    if options.files.is_some() && scene.safety.research.is_some() {
        return assemble::contradiction(
            "safety.research: what is recorded is replayed, which has no such controller",
        );
    }
    if let Some(scene) = pose::as_pose(scene)? {
        return bilateral::simulate_pose(scene, stop, options);
    }
    if scene.slave.is_some() {
        return bilateral::simulate(scene, stop, options);
    }
    if options.files.is_some() {
        return assemble::contradiction("record: a scene without a [slave] has no two sides to record");
    }
    local::simulate(scene, stop, options.research)
}
