//! Runs of a scene without an arm: what is touched is rendered on the device itself.

use std::sync::atomic::{AtomicBool, Ordering};

use haptether_master::SimulatedMaster;
use haptether_safety::{Axes, Real, controller::ControllerKind};
use nalgebra::SimdBool as _;

use super::{
    assemble::{
        SceneError, contradiction, delay_ticks, environment, exact_master, is_continuous, is_formula,
        period_ns, rendered_walls, stepped_master, ticks, watch,
    },
    measures::{Divergence, Ending, MeasureSettings, Measures, Outcome},
    record::{EventLog, Recorder, Sample, SceneRun},
    research::ResearchFactory,
    spec::{Integrator, SceneSpec},
};
use crate::{
    local::{DelayLine, LocalLoop, LocalTick, Rendering, SceneRendering, Surfaces, Watch, Watcher},
    plant::ModelPlant,
};

pub(crate) fn simulate<const N: usize>(
    scene: &SceneSpec<N>,
    stop: &AtomicBool,
    research: Option<&dyn ResearchFactory>,
) -> Result<SceneRun, SceneError> {
    check_local(scene)?;
    let environment_spec = scene.environment.as_ref();
    let is_formula = environment_spec.is_none_or(is_formula);
    let is_continuous = is_continuous(scene);
    match (scene.run.integrator, is_formula) {
        (Integrator::Exact, true) => {
            let rendering = rendered_walls::<N>(environment_spec, !is_continuous)?;
            let run = local_run(scene, exact_master(scene)?, rendering, research)?;
            if is_continuous {
                let mut touches = Touches::default();
                follow(run, scene, stop, move |_, _, looped, log| touches.log(looped.plant(), log))
            } else {
                follow(run, scene, stop, log_touch)
            }
        }
        (Integrator::Exact, false) => {
            let rendering = SceneRendering(environment::<N>(environment_spec)?);
            follow(local_run(scene, exact_master(scene)?, rendering, research)?, scene, stop, log_touch)
        }
        (Integrator::Stepped(stepping), true) => {
            // Where the device is says whether it touches, however the walls act on it.
            let walls = rendered_walls::<N>(environment_spec, true)?;
            let rendering = rendered_walls::<N>(environment_spec, !is_continuous)?;
            let run = local_run(scene, stepped_master(scene, stepping)?, rendering, research)?;
            follow(run, scene, stop, move |time_s, tick, _, log| {
                log.touches(time_s, walls.touches(&tick.position));
            })
        }
        (Integrator::Stepped(stepping), false) => {
            let rendering = SceneRendering(environment::<N>(environment_spec)?);
            follow(
                local_run(scene, stepped_master(scene, stepping)?, rendering, research)?,
                scene,
                stop,
                log_touch,
            )
        }
    }
}

fn log_touch<P: ModelPlant<N>, R: Rendering<N, f64> + Surfaces<N>, const N: usize>(
    time_s: f64,
    tick: &LocalTick<N>,
    looped: &LocalLoop<P, R, Watch<N>, N>,
    log: &mut EventLog,
) {
    log.touches(time_s, looped.rendering().touches(&tick.position));
}

/// Contacts with continuous walls, at the times at which they were located.
#[derive(Clone, Copy, Debug, Default)]
struct Touches {
    made_s: Option<f64>,
    broke_s: Option<f64>,
}

impl Touches {
    fn log<const N: usize>(&mut self, master: &SimulatedMaster<N>, log: &mut EventLog) {
        let touch = master.touch();
        for (seen, now, kind) in
            [(&mut self.made_s, touch.made_s, "contact"), (&mut self.broke_s, touch.broke_s, "free")]
        {
            if let Some(time_s) = now.filter(|_| *seen != now) {
                *seen = now;
                log.add(time_s, kind, "");
            }
        }
    }
}

/// Refuses tables that need an arm.
pub(crate) fn check_local<const N: usize>(scene: &SceneSpec<N>) -> Result<(), SceneError> {
    if scene.link.is_some() {
        return contradiction("link: needs a [slave] at its other end");
    }
    if scene.coupling.is_some() {
        return contradiction("coupling: needs a [slave] to couple the master with");
    }
    if is_continuous(scene) && scene.environment.as_ref().is_some_and(|one| one.delay_ticks > 0) {
        return contradiction("environment.delay_ticks: a force that acts at every instant is not late");
    }
    if is_continuous(scene) && scene.environment.as_ref().is_some_and(|one| !is_formula(one)) {
        return contradiction(
            "environment.rendering = \"continuous\": only resting planes and springs of Kelvin and Voigt, \
             without friction, act continuously, and no recorded push",
        );
    }
    Ok(())
}

/// A loop of its parts.
pub(crate) fn local_run<P: ModelPlant<N>, R: Rendering<N, f64>, const N: usize>(
    scene: &SceneSpec<N>,
    plant: P,
    rendering: R,
    research: Option<&dyn ResearchFactory>,
) -> Result<LocalRun<P, R, Watch<N>, N>, SceneError> {
    let period_ns = period_ns("run.period_s", scene.run.period_s)?;
    let judged = Measures::new(&MeasureSettings::of(scene), &plant.state().position);
    let delay = DelayLine::new(delay_ticks(scene)?);
    Ok(LocalRun {
        looped: LocalLoop::new(plant, rendering, delay, watch(scene, research)?, period_ns),
        measures: judged,
        ticks: ticks(scene)?,
    })
}

fn follow<P: ModelPlant<N>, R: Rendering<N, f64>, const N: usize>(
    mut run: LocalRun<P, R, Watch<N>, N>,
    scene: &SceneSpec<N>,
    stop: &AtomicBool,
    mut note: impl FnMut(f64, &LocalTick<N>, &LocalLoop<P, R, Watch<N>, N>, &mut EventLog),
) -> Result<SceneRun, SceneError> {
    let mut log = EventLog::default();
    let mut recorder = Recorder::new(scene.record.as_ref().map_or(0, |record| record.every), run.ticks);
    let mut outcomes = [None];
    run.run_observed(
        stop,
        |time_s, tick, looped| {
            note(time_s, tick, looped, &mut log);
            log.tripped(time_s, tick.response.lane(0).tripped);
            if recorder.begin_tick() {
                // A copy, as in `end_diverged`.
                let tick = *tick;
                record(&mut recorder, time_s, &tick);
            }
        },
        &mut outcomes,
    );
    let [Some(outcome)] = outcomes else {
        return Err(SceneError::Stopped);
    };
    log.schedule(scene, 0.0, &outcome);
    let end_s = outcome.ticks as f64 * scene.run.period_s;
    if outcome.ending == Ending::Settled {
        log.add(end_s, "settled", "nothing more happens");
    }
    log.coarse(end_s, run.looped.rendering().coarse_steps());
    Ok(SceneRun {
        signals: recorder.into_signals(),
        events: log.into_events(),
        outcome,
        period_s: scene.run.period_s,
        reports: None,
    })
}

/// A loop and what it is judged by.
pub(crate) struct LocalRun<P, R, W, const N: usize, S: Real = f64> {
    pub(crate) looped: LocalLoop<P, R, W, N, S>,
    /// As they are before the first tick.
    pub(crate) measures: Measures<N, S>,
    pub(crate) ticks: u64,
}

impl<P, R, W, const N: usize, S: Real> LocalRun<P, R, W, N, S>
where
    P: ModelPlant<N, S>,
    R: Rendering<N, S>,
    W: Watcher<N, S>,
{
    /// Runs all scenarios to their ends, unless `stop` is set meanwhile.
    #[inline(always)]
    pub(crate) fn run(&mut self, stop: &AtomicBool, outcomes: &mut [Option<Outcome>]) {
        self.run_observed(stop, |_, _, _| {}, outcomes);
    }

    /// Runs all scenarios to their ends; `observe` gets each tick, its time in s and the loop. None has an outcome
    /// once `stop` is set before its end.
    ///
    /// A scenario that ends early keeps the measures of that moment; its lane runs on unseen until all have ended.
    #[inline(always)]
    pub(crate) fn run_observed(
        &mut self,
        stop: &AtomicBool,
        mut observe: impl FnMut(f64, &LocalTick<N, S>, &LocalLoop<P, R, W, N, S>),
        outcomes: &mut [Option<Outcome>],
    ) {
        // Theirs is a copy that no call gets the address of: behind a reference, what changes at each tick would go through
        // memory at each tick.
        let mut measures = self.measures;
        for tick in 0..self.ticks {
            if stop.load(Ordering::Relaxed) || self.step(tick, &mut measures, &mut observe, outcomes) {
                return;
            }
        }
        let measures = measures;
        end(&measures, u64::MAX, self.ticks, Ending::Complete, outcomes);
    }

    /// One tick; returns whether all scenarios have ended early.
    #[inline(always)]
    fn step(
        &mut self,
        tick: u64,
        measures: &mut Measures<N, S>,
        observe: &mut impl FnMut(f64, &LocalTick<N, S>, &LocalLoop<P, R, W, N, S>),
        outcomes: &mut [Option<Outcome>],
    ) -> bool {
        let time_s = self.looped.time_s();
        let step = self.looped.step();
        if measures.may_have_diverged(&step.position, &step.velocity, &step.device_force) {
            let (measures, seen) = (*measures, [step.position, step.velocity, step.device_force]);
            if end_diverged(&measures, tick, time_s, &seen, outcomes) {
                return true;
            }
        }
        let settled = measures.take(
            time_s,
            &step.position,
            &step.velocity,
            &(step.requested_force + step.wall_force),
            &step.device_force,
            &step.hand_force,
            step.response.may_act.then_some(step.response.acts),
        );
        observe(time_s, &step, &self.looped);
        match settled {
            Some(settled) if settled.any() => {
                let measures = *measures;
                end(&measures, settled.bitmask(), tick + 1, Ending::Settled, outcomes)
            }
            _ => false,
        }
    }
}

/// Keeps the outcome of the lanes in `mask` that have none yet; says whether now all have one.
#[cold]
fn end<const N: usize, S: Real>(
    measures: &Measures<N, S>,
    mask: u64,
    ticks: u64,
    ending: Ending,
    outcomes: &mut [Option<Outcome>],
) -> bool {
    for (lane, outcome) in outcomes.iter_mut().enumerate().take(S::LANES) {
        if mask >> lane & 1 == 1 && outcome.is_none() {
            *outcome = Some(measures.outcome(lane, ticks, ending, None));
        }
    }
    outcomes.iter().all(Option::is_some)
}

/// Ends the lanes that x in m, V in m/s and `F_device` in N say have diverged. It gets copies: a tick whose address
/// went to a call would have to stand in memory, whole, at each tick.
#[cold]
fn end_diverged<const N: usize, S: Real>(
    measures: &Measures<N, S>,
    tick: u64,
    time_s: f64,
    [position, velocity, device_force]: &[Axes<N, S>; 3],
    outcomes: &mut [Option<Outcome>],
) -> bool {
    let mask = measures.diverged(position, velocity, device_force).bitmask();
    for (lane, outcome) in outcomes.iter_mut().enumerate().take(S::LANES) {
        if mask >> lane & 1 == 1 && outcome.is_none() {
            let cause = measures.cause(lane, position, velocity);
            let divergence = Divergence { time_s, cause };
            *outcome = Some(measures.outcome(lane, tick, Ending::Diverged, Some(divergence)));
        }
    }
    outcomes.iter().all(Option::is_some)
}

#[inline(never)]
fn record<const N: usize>(recorder: &mut Recorder, time_s: f64, tick: &LocalTick<N>) {
    let intervention = tick.response.lane(0);
    let signals = [
        ("time_s", Sample::Scalar(time_s)),
        ("position", Sample::Vector(&tick.position)),
        ("velocity", Sample::Vector(&tick.velocity)),
        ("hand_force", Sample::Vector(&tick.hand_force)),
        ("wall_force", Sample::Vector(&tick.wall_force)),
        ("rendered_force", Sample::Vector(&tick.rendered_force)),
        ("grasp_force", Sample::Vector(&tick.grasp_force)),
        ("safety_force", Sample::Vector(&intervention.safety_force)),
        ("device_force", Sample::Vector(&tick.device_force)),
    ];
    let observed = ControllerKind::ALL
        .into_iter()
        .map(|kind| (kind.observed().column, Sample::Scalar(intervention.observed[kind])));
    let tripped = ("tripped", Sample::Scalar(f64::from(intervention.tripped.bits())));
    recorder.take(signals.into_iter().chain(observed).chain([tripped]));
}
