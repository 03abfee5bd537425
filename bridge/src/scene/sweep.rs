//! Sweep over scenarios of a scene, with threads and lanes.

mod plan;

use haptether_numeric::of_axes;

use std::{
    collections::HashMap,
    sync::atomic::{AtomicBool, AtomicUsize, Ordering},
};

use plan::{Job, Place, Plan, bad_axes, jobs};
use rayon::prelude::*;
use serde::Deserialize;
use serde_json::Value;

use super::{
    assemble::SceneError, measures::Outcome, metrics::Metrics, outcome, research::ResearchFactory, shared,
    spec::SceneSpec,
};

/// Number of a scene that differs between scenarios.
#[derive(Clone, Debug, PartialEq)]
pub struct Variation {
    /// Path of keys and list indices, such as `operator.legs.0.end.0`.
    pub path: String,
    /// Value in each scenario.
    pub values: Vec<f64>,
}

/// Execution of a sweep, and its metrics; neither changes a value.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SweepSettings {
    /// Number of threads; 0 for one per processor.
    pub threads: usize,
    /// True to use lanes for scenarios that fit.
    pub lanes: bool,
    /// Metrics of each scenario; others are None in its outcome.
    pub metrics: Metrics,
}

/// Progress of a sweep for other threads, and a request to stop it.
#[derive(Debug, Default)]
pub struct Progress {
    /// Number of scenarios done.
    pub done: AtomicUsize,
    /// Set by another thread to end the sweep soon, with [`SweepError::Stopped`].
    pub stop: AtomicBool,
}

/// Error of a whole sweep.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum SweepError {
    /// Invalid scene.
    #[error("scene: {0}")]
    Scene(String),
    /// Path that does not exist.
    #[error("{0}: leads to no number of the scene")]
    Path(String),
    /// Columns of different lengths.
    #[error("{path}: {seen} values, must have {allowed}, one per scenario")]
    Length {
        /// The column.
        path: String,
        /// Its length.
        seen: usize,
        /// Length of the first column.
        allowed: usize,
    },
    /// The sweep was stopped.
    #[error("stopped")]
    Stopped,
    /// The threads could not be created.
    #[error("threads: {0}")]
    Threads(String),
}

/// Invalid scenario with the reason; the others of its sweep are run.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct Refused(pub String);

type Row = Result<Outcome, Refused>;

/// Scenarios of a scene.
#[derive(Clone, Copy, Debug)]
pub struct SweepPart<'a> {
    /// The scene as JSON, in the form of [`SceneSpec`].
    pub scene: &'a [u8],
    /// Numbers that differ between scenarios; without any there is one scenario.
    pub variations: &'a [Variation],
}

/// Run every scenario of a scene.
///
/// # Errors
///
/// Those of [`sweep_parts`].
pub fn sweep(
    scene: &[u8],
    variations: &[Variation],
    settings: SweepSettings,
    progress: &Progress,
    research: Option<&dyn ResearchFactory>,
) -> Result<Vec<Row>, SweepError> {
    let mut parts = sweep_parts(&[SweepPart { scene, variations }], settings, progress, research)?;
    // The list of rows is moved and not copied, because it may be long.
    Ok(parts.pop().unwrap_or_default())
}

/// Run every scenario of each part.
///
/// Threads, lanes and shared beginnings change no bit of a result: no operation mixes lanes, and runs share a
/// beginning only while they are equal. Scenarios with a controller of the caller share neither lanes nor beginnings.
///
/// # Errors
///
/// An invalid scene, columns of different lengths, a path that does not exist, threads that cannot be created, or
/// [`SweepError::Stopped`]. An invalid row is refused in its place.
pub fn sweep_parts(
    parts: &[SweepPart<'_>],
    settings: SweepSettings,
    progress: &Progress,
    research: Option<&dyn ResearchFactory>,
) -> Result<Vec<Vec<Row>>, SweepError> {
    let plans = parts.iter().map(Plan::new).collect::<Result<Vec<_>, _>>()?;
    let threads = if settings.threads == 0 { rayon::current_num_threads() } else { settings.threads };
    let jobs = jobs(&plans, threads, research.is_some());
    let run = |job: Job| {
        let found = match &job {
            Job::Block(part, rows) => {
                let plan = &plans[*part];
                let run = of_axes!(plan.axes, N => run_block::<N>, axes => return Err(bad_axes(axes)));
                run(plan, rows.clone(), settings.metrics, progress, research)?
            }
            Job::Groups(axes, groups) => {
                let run = of_axes!(*axes, N => run_groups::<N>, axes => return Err(bad_axes(axes)));
                run(&plans, groups, settings, progress)?
            }
        };
        Ok((job, found))
    };
    let results: Vec<Result<(Job, Vec<Row>), SweepError>> = if settings.threads == 1 || jobs.len() == 1 {
        // Creating a thread takes longer than many scenarios.
        jobs.into_iter().map(run).collect()
    } else {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(settings.threads)
            .build()
            .map_err(|error| SweepError::Threads(error.to_string()))?;
        pool.install(|| jobs.into_par_iter().map(run).collect())
    };
    let mut outcomes: Vec<Vec<Option<Row>>> = plans.iter().map(|plan| vec![None; plan.rows]).collect();
    for result in results {
        let (job, found) = result?;
        for ((part, row), outcome) in job.places().into_iter().zip(found) {
            outcomes[part][row] = Some(outcome);
        }
    }
    // Each row is in a job.
    let whole = outcomes.into_iter().map(|rows| rows.into_iter().collect::<Option<Vec<_>>>());
    whole.collect::<Option<_>>().ok_or(SweepError::Stopped)
}

/// Set the numbers of a row, and parse their tables again.
fn set_row<const N: usize>(
    spec: &mut SceneSpec<N>,
    scene: &mut Value,
    plan: &Plan<'_>,
    row: usize,
) -> Result<(), Refused> {
    for column in &plan.columns {
        let value = column.values[row];
        if !value.is_finite() {
            return Err(Refused(format!("{} = {value}: must be finite", column.keys.join("."))));
        }
        if let Some(place) = column.place(scene) {
            *place = if column.is_whole && value >= 0.0 && value.fract() == 0.0 && value < 2f64.powi(53) {
                #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // checked above
                Value::from(value as u64)
            } else {
                Value::from(value)
            };
        }
    }
    for table in &plan.tables {
        read_table(spec, scene, table).map_err(|error| Refused(format!("{table}: {error}")))?;
    }
    Ok(())
}

fn read_table<const N: usize>(
    spec: &mut SceneSpec<N>,
    scene: &Value,
    table: &str,
) -> Result<(), serde_json::Error> {
    let value = &scene[table];
    match table {
        "run" => spec.run = Deserialize::deserialize(value)?,
        "master" => spec.master = Deserialize::deserialize(value)?,
        "operator" => spec.operator = Deserialize::deserialize(value)?,
        "slave" => spec.slave = Deserialize::deserialize(value)?,
        "environment" => spec.environment = Deserialize::deserialize(value)?,
        "link" => spec.link = Deserialize::deserialize(value)?,
        "coupling" => spec.coupling = Deserialize::deserialize(value)?,
        "safety" => spec.safety = Deserialize::deserialize(value)?,
        _ => *spec = SceneSpec { metrics: spec.metrics, ..Deserialize::deserialize(scene)? },
    }
    Ok(())
}

/// Scene of a part, typed and as JSON, into which rows are written.
fn spec_of<const N: usize>(plan: &Plan<'_>, metrics: Metrics) -> Result<(SceneSpec<N>, Value), SweepError> {
    let spec = SceneSpec::deserialize(&plan.base).map_err(|error| SweepError::Scene(error.to_string()))?;
    Ok((SceneSpec { metrics, ..spec }, plan.base.clone()))
}

/// Run groups of rows that may share a beginning, or link and ladders.
fn run_groups<const N: usize>(
    plans: &[Plan<'_>],
    groups: &[Vec<Place>],
    SweepSettings { lanes, metrics, .. }: SweepSettings,
    Progress { done, stop }: &Progress,
) -> Result<Vec<Row>, SweepError> {
    let mut read = HashMap::<usize, (SceneSpec<N>, Value)>::new();
    let mut rows = Vec::new();
    for group in groups {
        if stop.load(Ordering::Relaxed) {
            return Err(SweepError::Stopped);
        }
        let mut specs = Vec::with_capacity(group.len());
        for (part, row) in group {
            let plan = &plans[*part];
            if !read.contains_key(part) {
                read.insert(*part, spec_of(plan, metrics)?);
            }
            let set = read
                .get_mut(part)
                .map(|(spec, scene)| set_row(spec, scene, plan, *row).map(|()| spec.clone()));
            specs.push(set.ok_or(SweepError::Stopped)?);
        }
        let built: Vec<_> = specs.iter().filter_map(|spec| spec.as_ref().ok()).collect();
        let outcomes = shared::outcomes(&built, lanes, stop).map_err(|_| SweepError::Stopped)?;
        let mut outcomes = outcomes.into_iter();
        for spec in &specs {
            rows.push(match spec {
                Err(refused) => Err(refused.clone()),
                Ok(_) => match outcomes.next() {
                    Some(Ok(outcome)) => Ok(outcome),
                    Some(Err(error)) => Err(Refused(error.to_string())),
                    None => return Err(SweepError::Stopped),
                },
            });
        }
        done.fetch_add(group.len(), Ordering::Relaxed);
    }
    Ok(rows)
}

fn run_block<const N: usize>(
    plan: &Plan<'_>,
    block: std::ops::Range<usize>,
    metrics: Metrics,
    Progress { done, stop }: &Progress,
    research: Option<&dyn ResearchFactory>,
) -> Result<Vec<Row>, SweepError> {
    if stop.load(Ordering::Relaxed) {
        return Err(SweepError::Stopped);
    }
    let (mut spec, mut scene) = spec_of::<N>(plan, metrics)?;
    let mut rows = Vec::with_capacity(block.len());
    for row in block {
        rows.push(match set_row(&mut spec, &mut scene, plan, row) {
            Err(refused) => Err(refused),
            Ok(()) => match outcome(&spec, stop, research) {
                Ok(outcome) => Ok(outcome),
                Err(SceneError::Stopped) => return Err(SweepError::Stopped),
                Err(error) => Err(Refused(error.to_string())),
            },
        });
        done.fetch_add(1, Ordering::Relaxed);
    }
    Ok(rows)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Rows that are refused when they are set or built keep their places, with and without lanes, and count as done.
    #[test]
    fn refused_rows_have_their_places() {
        let scene = include_bytes!("../../tests/press.json");
        let end =
            |values: &[f64]| Variation { path: "operator.legs.0.end.0".into(), values: values.to_vec() };
        let window = |values: &[f64]| Variation { path: "safety.window".into(), values: values.to_vec() };
        let variations =
            [end(&[-0.01, f64::NAN, -0.02, -0.03, -0.04]), window(&[100.0, 100.0, 0.0, 50.0, 2.5])];
        for lanes in [false, true] {
            let progress = Progress::default();
            let settings = SweepSettings { threads: 1, lanes, metrics: Metrics::ALL };
            let rows = sweep(scene, &variations, settings, &progress, None).unwrap();
            assert_eq!(progress.done.into_inner(), rows.len());
            let refused: Vec<_> =
                rows.iter().map(|row| row.as_ref().err().map(ToString::to_string)).collect();
            assert_eq!(refused[1].as_deref(), Some("operator.legs.0.end.0 = NaN: must be finite"));
            assert!(refused[2].as_ref().is_some_and(|text| text.contains("window")), "{refused:?}");
            assert!(refused[4].as_ref().is_some_and(|text| text.starts_with("safety: ")), "{refused:?}");
            for row in [0, 3] {
                let [end, window] = [0, 1].map(|which| Variation {
                    path: variations[which].path.clone(),
                    values: vec![variations[which].values[row]],
                });
                let alone = sweep(scene, &[end, window], settings, &Progress::default(), None).unwrap();
                assert_eq!(rows[row], alone[0]);
            }
        }
        let stopped = Progress::default();
        stopped.stop.store(true, Ordering::Relaxed);
        let settings = SweepSettings { threads: 1, lanes: true, metrics: Metrics::ALL };
        assert_eq!(sweep(scene, &variations, settings, &stopped, None), Err(SweepError::Stopped));
    }
}
