//! Rows that are run in steps: side by side where they may be, else one by one.

use std::sync::atomic::{AtomicBool, Ordering};

use haptether_master::SteppedMaster;
use haptether_safety::SafetyLayer;
use haptether_slave::RenderedWalls;

use super::{Progress, Row};
use crate::{
    lanes::{Lanes, NARROW, WIDE},
    local::{TrueWatch, Watch, gather, gather_estimated, gather_true},
    scene::{
        assemble::{SceneError, contradiction, is_continuous, is_formula, rendered_walls, stepped_master},
        local::{LocalRun, check_local, local_run},
        measures::{Measures, Outcome},
        spec::{Integrator, SceneSpec},
    },
};

type SteppedRun<const N: usize, W, S> = LocalRun<SteppedMaster<N, S>, RenderedWalls<N, S>, W, N, S>;

/// One scenario.
pub(super) type SingleRun<const N: usize> = SteppedRun<N, Watch<N>, f64>;

/// Scenarios side by side. Who watches is known when the loop is compiled: two that are chosen between at each tick would
/// leave all that they say in memory.
enum LaneRun<const N: usize, const WIDTH: usize> {
    Estimated(Box<SteppedRun<N, Box<SafetyLayer<N, Lanes<WIDTH>>>, Lanes<WIDTH>>>),
    True(Box<SteppedRun<N, TrueWatch<N, Lanes<WIDTH>>, Lanes<WIDTH>>>),
}

impl<const N: usize, const WIDTH: usize> LaneRun<N, WIDTH> {
    /// Runs all scenarios to their ends, in the instructions of the function that it is compiled into.
    #[inline(always)]
    fn run(&mut self, stop: &AtomicBool, ended: &mut [Option<Outcome>]) {
        match self {
            Self::Estimated(run) => run.run(stop, ended),
            Self::True(run) => run.run(stop, ended),
        }
    }
}

/// Whether a scenario is run in steps, so that lanes may hold it: not with an arm, located events, an environment of more
/// than resting walls, or more axes than lanes are compiled for.
pub(super) fn takes_steps<const N: usize>(spec: &SceneSpec<N>) -> bool {
    N <= 3
        && spec.slave.is_none()
        && spec.safety.research.is_none()
        && spec.run.integrator != Integrator::Exact
        && spec.environment.as_ref().is_none_or(is_formula)
}

/// Runs scenarios in steps, side by side if they may.
pub(super) fn run_stepped<const N: usize>(
    mut left: Vec<(usize, Box<SingleRun<N>>)>,
    lanes: bool,
    Progress { done, stop }: &Progress,
    rows: &mut [Option<Row>],
) {
    let wide = wide_processor();
    while let Some(taken) = take_block(&mut left, lanes, wide) {
        let (taken, ended) = match taken {
            Block::Narrow(taken, mut run) => {
                let mut ended = vec![None; taken.len()];
                run_narrow(&mut run, stop, &mut ended);
                (taken, ended)
            }
            Block::Wide(taken, mut run, processor) => {
                let mut ended = vec![None; taken.len()];
                run_wide(processor, &mut run, stop, &mut ended);
                (taken, ended)
            }
            Block::Single(row, mut run) => {
                let mut ended = vec![None];
                run.run(stop, &mut ended);
                (vec![row], ended)
            }
        };
        done.fetch_add(taken.len(), Ordering::Relaxed);
        for (row, outcome) in taken.into_iter().zip(ended) {
            rows[row] = outcome.map(Ok);
        }
    }
}

pub(super) fn stepped_run<const N: usize>(spec: &SceneSpec<N>) -> Result<SingleRun<N>, SceneError> {
    check_local(spec)?;
    let Integrator::Stepped(stepping) = spec.run.integrator else {
        return contradiction("run.integrator: must have steps");
    };
    let rendering = rendered_walls(spec.environment.as_ref(), !is_continuous(spec))?;
    local_run(spec, stepped_master(spec, stepping)?, rendering, None)
}

/// Rows, and their scenarios side by side, or one alone.
enum Block<const N: usize> {
    Narrow(Vec<usize>, LaneRun<N, NARROW>),
    Wide(Vec<usize>, LaneRun<N, WIDE>, WideProcessor),
    Single(usize, Box<SingleRun<N>>),
}

/// Takes scenarios that can share lanes with the first one left; alone it is taken alone.
fn take_block<const N: usize>(
    left: &mut Vec<(usize, Box<SingleRun<N>>)>,
    lanes: bool,
    wide: Option<WideProcessor>,
) -> Option<Block<N>> {
    if !lanes {
        return left.pop().map(|(row, run)| Block::Single(row, run));
    }
    // Those that the narrow lanes hold would leave half of the wide ones idle.
    if let Some(processor) = wide
        && let Some((rows, run)) = take_lanes(left, NARROW + 1)
    {
        return Some(Block::Wide(rows, run, processor));
    }
    if let Some((rows, run)) = take_lanes(left, 2) {
        return Some(Block::Narrow(rows, run));
    }
    (!left.is_empty()).then(|| left.remove(0)).map(|(row, run)| Block::Single(row, run))
}

/// Takes as many scenarios as can share lanes with the first one left, unless they are fewer than `least`.
fn take_lanes<const N: usize, const WIDTH: usize>(
    left: &mut Vec<(usize, Box<SingleRun<N>>)>,
    least: usize,
) -> Option<(Vec<usize>, LaneRun<N, WIDTH>)> {
    if left.len() < least {
        return None;
    }
    // Mostly the next ones fit. Otherwise look for those that fit the first, one by one, as few side by side as can be.
    let mut take: Vec<usize> = (0..left.len().min(WIDTH)).collect();
    let mut shared = gathered(left, &take);
    if shared.is_none() {
        let fits = |other: &usize| gathered::<N, NARROW>(left, &[0, *other]).is_some();
        take = std::iter::once(0).chain((1..left.len()).filter(fits)).take(WIDTH).collect();
        shared = (take.len() >= least).then(|| gathered(left, &take)).flatten();
    }
    let run = shared?;
    let rows = take.iter().map(|&index| left[index].0).collect();
    let mut index = 0;
    left.retain(|_| {
        index += 1;
        !take.contains(&(index - 1))
    });
    Some((rows, run))
}

/// Some scenarios side by side; lanes that are left over repeat the last one.
fn gathered<const N: usize, const WIDTH: usize>(
    left: &[(usize, Box<SingleRun<N>>)],
    take: &[usize],
) -> Option<LaneRun<N, WIDTH>> {
    let padded = |lane: usize| &left[take[lane.min(take.len() - 1)]].1;
    let of: Vec<_> = (0..WIDTH).map(padded).collect();
    let ticks = of.first()?.ticks;
    if of.iter().any(|one| one.ticks != ticks) {
        return None;
    }
    let measures: Vec<_> = of.iter().map(|one| one.measures).collect();
    let measures = Measures::gather(&measures)?;
    let loops: Vec<_> = of.into_iter().map(|one| &one.looped).collect();
    if let Some(looped) = gather(&loops, gather_estimated) {
        return Some(LaneRun::Estimated(Box::new(LocalRun { looped, measures, ticks })));
    }
    let looped = gather(&loops, gather_true)?;
    Some(LaneRun::True(Box::new(LocalRun { looped, measures, ticks })))
}

/// Lanes, until when they run, and where their outcomes go: what a processor's instructions are chosen for.
struct InLanes<'a, const N: usize, const WIDTH: usize> {
    run: &'a mut LaneRun<N, WIDTH>,
    stop: &'a AtomicBool,
    ended: &'a mut [Option<Outcome>],
}

impl<const N: usize, const WIDTH: usize> pulp::WithSimd for InLanes<'_, N, WIDTH> {
    type Output = ();

    #[inline(always)]
    fn with_simd<A: pulp::Simd>(self, _: A) {
        self.run.run(self.stop, self.ended);
    }
}

/// Runs lanes with the widest instructions that this processor has. Their width changes no bit: there is no operation
/// across lanes, and none is fused.
fn run_narrow<const N: usize>(
    run: &mut LaneRun<N, NARROW>,
    stop: &AtomicBool,
    ended: &mut [Option<Outcome>],
) {
    pulp::Arch::new().dispatch(InLanes { run, stop, ended });
}

/// A processor with registers for twice as many scenarios: one with AVX-512.
#[cfg(target_arch = "x86_64")]
type WideProcessor = pulp::x86::V4;

/// There is none of another kind.
#[cfg(not(target_arch = "x86_64"))]
#[derive(Clone, Copy)]
enum WideProcessor {}

/// This processor, if it is one.
fn wide_processor() -> Option<WideProcessor> {
    #[cfg(target_arch = "x86_64")]
    return WideProcessor::try_new();
    #[cfg(not(target_arch = "x86_64"))]
    None
}

/// Runs wide lanes, which are compiled for no other processor.
#[cfg_attr(not(target_arch = "x86_64"), allow(unused_variables))]
fn run_wide<const N: usize>(
    processor: WideProcessor,
    run: &mut LaneRun<N, WIDE>,
    stop: &AtomicBool,
    ended: &mut [Option<Outcome>],
) {
    #[cfg(target_arch = "x86_64")]
    pulp::Simd::vectorize(processor, InLanes { run, stop, ended });
    #[cfg(not(target_arch = "x86_64"))]
    match processor {}
}

#[cfg(test)]
mod tests {
    use serde::Deserialize as _;
    use serde_json::Value;

    use super::*;

    fn kind<const N: usize, const WIDTH: usize>(run: Option<&LaneRun<N, WIDTH>>) -> &'static str {
        match run {
            Some(LaneRun::Estimated(_)) => "estimated",
            Some(LaneRun::True(_)) => "true",
            None => "none",
        }
    }

    /// What lanes cannot share is run one by one, with the same outcomes: so nothing else would say that they are used.
    /// This processor may have no use for the wide ones.
    #[test]
    fn scenarios_that_differ_in_a_number_share_lanes() {
        let scene: Value = serde_json::from_slice(include_bytes!("../../../benches/work_unit.json")).unwrap();
        for (signals, controllers) in
            [("true", "wsc"), ("true", "hsc"), ("estimated", "wsc"), ("estimated", "vfc")]
        {
            let runs: Vec<_> = (0..WIDE)
                .map(|lane| {
                    let mut scene = scene.clone();
                    scene["safety"]["signals"] = signals.into();
                    scene["safety"]["controllers"] = vec![controllers].into();
                    scene["operator"]["legs"][0]["end"] = vec![-0.01 * (1.0 + lane as f64)].into();
                    let spec = SceneSpec::<1>::deserialize(&scene).unwrap();
                    (lane, Box::new(stepped_run(&spec).unwrap()))
                })
                .collect();
            let all: Vec<_> = (0..WIDE).collect();
            let found = [
                kind(gathered::<1, NARROW>(&runs, &all[..NARROW]).as_ref()),
                kind(gathered::<1, WIDE>(&runs, &all).as_ref()),
            ];
            assert_eq!(found, [signals; 2], "{controllers}");

            let stop = AtomicBool::new(false);
            let mut narrow = vec![None; NARROW];
            gathered::<1, NARROW>(&runs, &all[..NARROW]).unwrap().run(&stop, &mut narrow);
            let mut wide = vec![None; WIDE];
            gathered::<1, WIDE>(&runs, &all).unwrap().run(&stop, &mut wide);
            for (lane, (_, mut run)) in runs.into_iter().enumerate() {
                let mut alone = [None];
                run.run(&stop, &mut alone);
                assert_eq!(wide[lane], alone[0], "{controllers}, lane {lane}");
                assert!(lane >= NARROW || narrow[lane] == alone[0], "{controllers}, narrow lane {lane}");
            }
        }
    }

    /// How rows are taken: how many at once, and how wide.
    fn taken(windows: &[u64], wide: Option<WideProcessor>) -> Vec<(&'static str, usize)> {
        let scene: Value = serde_json::from_slice(include_bytes!("../../../benches/work_unit.json")).unwrap();
        let build = |(row, window): (usize, &u64)| {
            let mut scene = scene.clone();
            scene["safety"]["window"] = (*window).into();
            let spec = SceneSpec::<1>::deserialize(&scene).unwrap();
            (row, Box::new(stepped_run(&spec).unwrap()))
        };
        let mut left: Vec<_> = windows.iter().enumerate().map(build).collect();
        let (mut found, mut rows) = (Vec::new(), Vec::new());
        while let Some(block) = take_block(&mut left, true, wide) {
            let (kind, taken) = match block {
                Block::Narrow(taken, _) => ("narrow", taken),
                Block::Wide(taken, _, _) => ("wide", taken),
                Block::Single(row, _) => ("single", vec![row]),
            };
            found.push((kind, taken.len()));
            rows.extend(taken);
        }
        rows.sort_unstable();
        assert!(rows.iter().copied().eq(0..windows.len()), "each once");
        found
    }

    #[test]
    fn rows_fill_the_lanes_that_they_fit_into() {
        for (rows, narrow) in [
            (1, vec![("single", 1)]),
            (2, vec![("narrow", 2)]),
            (9, vec![("narrow", 8), ("single", 1)]),
            (17, vec![("narrow", 8), ("narrow", 8), ("single", 1)]),
        ] {
            assert_eq!(taken(&vec![100; rows], None), narrow);
        }
        let mixed: Vec<u64> = (0..17).map(|row| if row % 2 == 0 || row > 13 { 50 } else { 100 }).collect();
        assert_eq!(taken(&mixed, None), [("narrow", 8), ("narrow", 7), ("narrow", 2)]);
        // What this processor has no instructions for it cannot run.
        let Some(wide) = wide_processor() else { return };
        for (rows, found) in [
            (8, vec![("narrow", 8)]),
            (9, vec![("wide", 9)]),
            (17, vec![("wide", 16), ("single", 1)]),
            (24, vec![("wide", 16), ("narrow", 8)]),
        ] {
            assert_eq!(taken(&vec![100; rows], Some(wide)), found);
        }
        assert_eq!(taken(&mixed, Some(wide)), [("wide", 10), ("narrow", 7)]);
    }
}
