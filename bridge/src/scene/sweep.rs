//! Many scenarios of one scene, over threads and in lanes.

use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use haptether_master::SteppedMaster;
use haptether_safety::Real;
use haptether_slave::RenderedWalls;
use rayon::prelude::*;
use serde::Deserialize;
use serde_json::Value;
use simba::simd::AutoSimd;

use super::{
    build::{SceneError, is_continuous, is_plain, rendered_walls, stepped_master, stepping},
    local::{Ending, LocalRun},
    measures::Outcome,
    run::{check_local, local_run, simulate},
    spec::SceneSpec,
};

/// Scenarios that are advanced side by side. The array is a vector of the processor where it has one, and is computed
/// in parts where it has not.
pub(crate) type Lanes = AutoSimd<[f64; 8]>;

/// One number of a scene that differs from scenario to scenario.
#[derive(Clone, Debug, PartialEq)]
pub struct Variation {
    /// Where it is: keys and list indices, such as `operator.legs.0.end.0`.
    pub path: String,
    /// Its value in each scenario.
    pub values: Vec<f64>,
}

/// How a sweep is run; the results do not depend on it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SweepSettings {
    /// Threads; 0 for as many as there are processors.
    pub threads: usize,
    /// Whether scenarios that can be are advanced side by side.
    pub lanes: bool,
}

/// What another thread sees of a sweep, and how it ends one.
#[derive(Debug, Default)]
pub struct Progress {
    /// Scenarios that have been run.
    pub done: AtomicUsize,
    /// Set from outside: the sweep ends soon, with [`SweepError::Stopped`].
    pub stop: AtomicBool,
}

/// A sweep that cannot be run.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum SweepError {
    /// The scene is not one.
    #[error("scene: {0}")]
    Scene(String),
    /// A path leads nowhere.
    #[error("{0}: leads to no number of the scene")]
    Path(String),
    /// Columns of different length.
    #[error("{path}: {seen} values, must have {allowed}, one per scenario")]
    Length {
        /// The column.
        path: String,
        /// Its length.
        seen: usize,
        /// The first column's.
        allowed: usize,
    },
    /// A scenario that cannot be.
    #[error("scenario {row}: {why}")]
    Scenario {
        /// Its number, from 0.
        row: usize,
        /// What is wrong with it.
        why: String,
    },
    /// It was told to stop.
    #[error("stopped")]
    Stopped,
    /// The threads could not be made.
    #[error("threads: {0}")]
    Threads(String),
}

/// Scenarios that a thread takes at once: enough that most fill their lanes, few enough that all threads have some.
const BLOCK: usize = 64;

/// Runs every scenario; `scene` is the scene as JSON, in the form of [`SceneSpec`].
///
/// Which scenarios share a thread or lanes changes nothing, to the last bit: no operation mixes lanes.
pub fn sweep(
    scene: &[u8],
    variations: &[Variation],
    settings: SweepSettings,
    progress: &Progress,
) -> Result<Vec<Outcome>, SweepError> {
    let base: Value = serde_json::from_slice(scene).map_err(|error| SweepError::Scene(error.to_string()))?;
    SceneSpec::deserialize(&base).map_err(|error| SweepError::Scene(error.to_string()))?;
    let rows = variations.first().map_or(1, |first| first.values.len());
    let mut columns = Vec::with_capacity(variations.len());
    for Variation { path, values } in variations {
        if values.len() != rows {
            return Err(SweepError::Length { path: path.clone(), seen: values.len(), allowed: rows });
        }
        let pointer = format!("/{}", path.replace('.', "/"));
        let is_whole = match base.pointer(&pointer) {
            Some(Value::Number(number)) => number.is_u64(),
            // What is not bounded may be bounded, but what is not built has no numbers.
            Some(Value::Null) => false,
            _ => return Err(SweepError::Path(path.clone())),
        };
        columns.push((pointer, is_whole, values.as_slice()));
    }
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(settings.threads)
        .build()
        .map_err(|error| SweepError::Threads(error.to_string()))?;
    let blocks: Vec<_> = (0..rows).step_by(BLOCK).map(|first| first..rows.min(first + BLOCK)).collect();
    let results: Vec<_> = pool.install(|| {
        let run = |block| run_block(&base, &columns, block, settings.lanes, progress);
        blocks.into_par_iter().map(run).collect()
    });
    let mut outcomes = Vec::with_capacity(rows);
    for result in results {
        outcomes.extend(result?);
    }
    Ok(outcomes)
}

/// The specification of one row.
fn row_spec(
    scene: &mut Value,
    columns: &[(String, bool, &[f64])],
    row: usize,
) -> Result<SceneSpec, SweepError> {
    for (pointer, is_whole, values) in columns {
        let value = values[row];
        if let Some(place) = scene.pointer_mut(pointer) {
            *place = if *is_whole && value >= 0.0 && value.fract() == 0.0 && value < 2f64.powi(53) {
                #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // checked above
                Value::from(value as u64)
            } else {
                Value::from(value)
            };
        }
    }
    SceneSpec::deserialize(&*scene).map_err(|error| SweepError::Scenario { row, why: error.to_string() })
}

fn run_block(
    base: &Value,
    columns: &[(String, bool, &[f64])],
    block: std::ops::Range<usize>,
    lanes: bool,
    progress: &Progress,
) -> Result<Vec<Outcome>, SweepError> {
    let Progress { done, stop } = progress;
    if stop.load(Ordering::Relaxed) {
        return Err(SweepError::Stopped);
    }
    let mut scene = base.clone();
    // Outcomes need no recording, and a copy of what is recorded for each row would cost more than the row.
    scene["record"] = Value::Null;
    let specs = block.clone().map(|row| row_spec(&mut scene, columns, row)).collect::<Result<Vec<_>, _>>()?;
    let first = block.start;
    let refused = |(index, error): (usize, SceneError)| match error {
        SceneError::Stopped => SweepError::Stopped,
        error => SweepError::Scenario { row: first + index, why: error.to_string() },
    };
    if lanes {
        let shared = match specs.first().map(|spec| spec.master.axes) {
            Some(1) => run_in_lanes::<1>(&specs, progress),
            Some(2) => run_in_lanes::<2>(&specs, progress),
            Some(3) => run_in_lanes::<3>(&specs, progress),
            _ => Ok(None),
        };
        if let Some(outcomes) = shared.map_err(refused)? {
            return Ok(outcomes);
        }
    }
    let run = |(index, spec): (usize, &SceneSpec)| {
        let outcome = simulate(spec, stop).map_err(|error| refused((index, error)))?.outcome;
        done.fetch_add(1, Ordering::Relaxed);
        Ok(outcome)
    };
    specs.iter().enumerate().map(run).collect()
}

type PlainRun<const N: usize, S> = LocalRun<SteppedMaster<N, S>, RenderedWalls<N, S>, N, S>;

/// Runs scenarios side by side; none if one of them cannot be: an arm, located events, or an environment of more
/// than resting walls.
fn run_in_lanes<const N: usize>(
    specs: &[SceneSpec],
    Progress { done, stop }: &Progress,
) -> Result<Option<Vec<Outcome>>, (usize, SceneError)> {
    let can_share = |spec: &SceneSpec| {
        spec.slave.is_none()
            && spec.master.axes == N
            && stepping(spec.run.integrator).is_some()
            && spec.environment.as_ref().is_none_or(is_plain)
    };
    if !specs.iter().all(can_share) {
        return Ok(None);
    }
    let mut left: Vec<(usize, PlainRun<N, f64>)> = Vec::with_capacity(specs.len());
    for (index, spec) in specs.iter().enumerate() {
        left.push((index, plain_run(spec).map_err(|error| (index, error))?));
    }
    let mut outcomes = vec![None; specs.len()];
    while let Some(taken) = take_block(&mut left) {
        match taken {
            Block::Lanes(rows, mut run) => {
                let mut ended = vec![None; rows.len()];
                vectorised(&mut run, stop, &mut ended);
                done.fetch_add(rows.len(), Ordering::Relaxed);
                for (row, outcome) in rows.into_iter().zip(ended) {
                    outcomes[row] = outcome;
                }
            }
            Block::Single(row, mut run) => {
                let mut ended = [None];
                run.run(stop, &mut ended);
                done.fetch_add(1, Ordering::Relaxed);
                [outcomes[row]] = ended;
            }
        }
    }
    let outcomes: Option<Vec<_>> =
        outcomes.into_iter().map(|outcome| outcome.map(|(outcome, _): (Outcome, Ending)| outcome)).collect();
    outcomes.map(Some).ok_or((0, SceneError::Stopped))
}

fn plain_run<const N: usize>(spec: &SceneSpec) -> Result<PlainRun<N, f64>, SceneError> {
    check_local(spec)?;
    let Some(stepping) = stepping(spec.run.integrator) else {
        return Err(SceneError::Contradiction("run.integrator: must have steps".into()));
    };
    let rendering = rendered_walls(spec.environment.as_ref(), !is_continuous(spec))?;
    local_run(spec, stepped_master(spec, stepping)?, rendering)
}

enum Block<const N: usize> {
    /// Rows, and their scenarios side by side.
    Lanes(Vec<usize>, Box<PlainRun<N, Lanes>>),
    Single(usize, Box<PlainRun<N, f64>>),
}

/// Takes scenarios that can share lanes with the first one left; alone it is taken alone.
fn take_block<const N: usize>(left: &mut Vec<(usize, PlainRun<N, f64>)>) -> Option<Block<N>> {
    if left.is_empty() {
        return None;
    }
    // Mostly the next ones fit. Otherwise look for those that fit the first, one by one.
    let mut take: Vec<usize> = (0..left.len().min(LANES)).collect();
    let mut shared = gathered(left, &take);
    if shared.is_none() {
        take.truncate(1);
        for other in 1..left.len() {
            if take.len() < LANES && gathered(left, &[take[0], other]).is_some() {
                take.push(other);
            }
        }
        shared = (take.len() > 1).then(|| gathered(left, &take)).flatten();
    }
    if take.len() > 1
        && let Some(run) = shared
    {
        let rows = take.iter().map(|&index| left[index].0).collect();
        let mut index = 0;
        left.retain(|_| {
            index += 1;
            !take.contains(&(index - 1))
        });
        return Some(Block::Lanes(rows, Box::new(run)));
    }
    let (row, run) = left.remove(0);
    Some(Block::Single(row, Box::new(run)))
}

const LANES: usize = 8;

/// Some scenarios side by side; lanes that are left over repeat the last one.
fn gathered<const N: usize>(
    left: &[(usize, PlainRun<N, f64>)],
    take: &[usize],
) -> Option<PlainRun<N, Lanes>> {
    let padded = |lane: usize| &left[take[lane.min(take.len() - 1)]].1;
    gather((0..LANES).map(padded).collect())
}

fn gather<const N: usize, S: Real>(of: Vec<&PlainRun<N, f64>>) -> Option<PlainRun<N, S>> {
    let ticks = of.first()?.ticks;
    if of.iter().any(|one| one.ticks != ticks) {
        return None;
    }
    let measures: Vec<_> = of.iter().map(|one| one.measures).collect();
    let loops: Vec<_> = of.into_iter().map(|one| &one.looped).collect();
    Some(LocalRun {
        looped: crate::local::gather(&loops)?,
        measures: super::measures::Measures::gather(&measures)?,
        ticks,
    })
}

/// Runs lanes with the widest instructions that this processor has. Their width changes no bit: there is no operation
/// across lanes, and none is fused.
fn vectorised<const N: usize>(
    run: &mut PlainRun<N, Lanes>,
    stop: &AtomicBool,
    ended: &mut [Option<(Outcome, Ending)>],
) {
    struct Job<'a, const N: usize>(
        &'a mut PlainRun<N, Lanes>,
        &'a AtomicBool,
        &'a mut [Option<(Outcome, Ending)>],
    );

    impl<const N: usize> pulp::WithSimd for Job<'_, N> {
        type Output = ();

        #[allow(clippy::inline_always)] // what is not inlined here is built without those instructions
        #[inline(always)]
        fn with_simd<A: pulp::Simd>(self, _: A) {
            self.0.run(self.1, self.2);
        }
    }
    pulp::Arch::new().dispatch(Job(run, stop, ended));
}
