//! Runs of a scene without an arm: its environment is rendered on the device itself.

use std::sync::atomic::{AtomicBool, Ordering};

use haptether_master::SimulatedMaster;
use haptether_safety::controller::ControllerKind;

use super::{
    assemble::{
        SceneError, contradiction, delay_ticks, environment, exact_master, is_continuous, is_formula,
        period_ns, rendered_walls, ticks, watch,
    },
    measures::{Divergence, Ending, MeasureSettings, Measures, Outcome},
    record::{EventLog, Recorder, Sample, SceneRun},
    research::ResearchFactory,
    spec::SceneSpec,
};
use crate::local::{DelayLine, LocalLoop, LocalTick, Rendering, SceneRendering, Surfaces};

type Loop<R, const N: usize> = LocalLoop<SimulatedMaster<N>, R, N>;

pub(crate) fn simulate<const N: usize>(
    scene: &SceneSpec<N>,
    stop: &AtomicBool,
    research: Option<&dyn ResearchFactory>,
) -> Result<SceneRun, SceneError> {
    check_local(scene)?;
    let environment_spec = scene.environment.as_ref();
    let is_formula = environment_spec.is_none_or(is_formula);
    let is_continuous = is_continuous(scene);
    if !is_formula {
        let rendering = SceneRendering(environment::<N>(environment_spec)?);
        return local_run(scene, rendering, research)?.follow(scene, stop, log_touch);
    }
    let rendering = rendered_walls::<N>(environment_spec, !is_continuous)?;
    let run = local_run(scene, rendering, research)?;
    let mut continuous = is_continuous.then(Touches::default);
    run.follow(scene, stop, move |time_s, tick, looped, log| match &mut continuous {
        Some(touches) => touches.log(looped.plant(), log),
        None => log_touch(time_s, tick, looped, log),
    })
}

fn log_touch<R: Rendering<N> + Surfaces<N>, const N: usize>(
    time_s: f64,
    tick: &LocalTick<N>,
    looped: &Loop<R, N>,
    log: &mut EventLog,
) {
    log.touches(time_s, looped.rendering().touches(&tick.position));
}

/// Contacts with continuous walls, at their located times in s.
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

/// Refuse tables that need an arm.
fn check_local<const N: usize>(scene: &SceneSpec<N>) -> Result<(), SceneError> {
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

/// Loop and its measures.
struct LocalRun<R, const N: usize> {
    looped: Loop<R, N>,
    measures: Measures<N>,
    ticks: u64,
}

/// Build the loop of a scene.
fn local_run<R: Rendering<N>, const N: usize>(
    scene: &SceneSpec<N>,
    rendering: R,
    research: Option<&dyn ResearchFactory>,
) -> Result<LocalRun<R, N>, SceneError> {
    if scene.operator.as_ref().is_some_and(|operator| operator.aims.is_some()) {
        return contradiction("operator.aims: needs an arm to lead: add [slave] or leave it out");
    }
    let plant = exact_master(scene)?;
    let period_ns = period_ns("run.period_s", scene.run.period_s)?;
    let measures = Measures::new(&MeasureSettings::of(scene), plant.position());
    let delay = DelayLine::new(delay_ticks(scene)?);
    Ok(LocalRun {
        looped: LocalLoop::new(plant, rendering, delay, watch(scene, research)?, period_ns),
        measures,
        ticks: ticks(scene)?,
    })
}

impl<R: Rendering<N>, const N: usize> LocalRun<R, N> {
    /// Run the scene to its end; `note` receives each tick, with its time in s and the loop.
    fn follow(
        mut self,
        scene: &SceneSpec<N>,
        stop: &AtomicBool,
        mut note: impl FnMut(f64, &LocalTick<N>, &Loop<R, N>, &mut EventLog),
    ) -> Result<SceneRun, SceneError> {
        let mut log = EventLog::default();
        let mut recorder = Recorder::new(scene.record.as_ref().map_or(0, |record| record.every), self.ticks);
        let outcome = self.run(stop, |time_s, tick, looped| {
            note(time_s, tick, looped, &mut log);
            log.tripped(time_s, tick.response.lane(0).tripped);
            if recorder.begin_tick() {
                // A copy: if the address of the tick left this function, the tick would be stored in memory each time.
                let tick = *tick;
                record(&mut recorder, time_s, &tick);
            }
        })?;
        log.schedule(scene, 0.0, &outcome);
        let end_s = outcome.ticks as f64 * scene.run.period_s;
        if outcome.ending == Ending::Settled {
            log.add(end_s, "settled", "nothing more happens");
        }
        log.coarse(end_s, self.looped.rendering().coarse_steps());
        Ok(SceneRun {
            signals: recorder.into_signals(),
            events: log.into_events(),
            outcome,
            period_s: scene.run.period_s,
            reports: None,
        })
    }

    fn run(
        &mut self,
        stop: &AtomicBool,
        mut observe: impl FnMut(f64, &LocalTick<N>, &Loop<R, N>),
    ) -> Result<Outcome, SceneError> {
        let Self { looped, measures, ticks } = self;
        // A copy that stays in registers, for the same reason.
        let mut measures = *measures;
        for tick in 0..*ticks {
            if stop.load(Ordering::Relaxed) {
                return Err(SceneError::Stopped);
            }
            let time_s = looped.time_s();
            let step = looped.step();
            let (x, v, force) = (&step.position, &step.velocity, &step.device_force);
            if measures.may_have_diverged(x, v, force) && measures.diverged(x, v, force) {
                let measures = measures;
                let divergence = Divergence { time_s, cause: measures.cause(0, x, v) };
                return Ok(measures.outcome(0, tick, Ending::Diverged, Some(divergence)));
            }
            let rendered = step.requested_force + step.wall_force;
            let is_on = step.response.may_act.then_some(step.response.acts);
            let settled = measures.take(time_s, x, v, &rendered, force, &step.hand_force, is_on);
            observe(time_s, &step, looped);
            if settled == Some(true) {
                let measures = measures;
                return Ok(measures.outcome(0, tick + 1, Ending::Settled, None));
            }
        }
        Ok(measures.outcome(0, *ticks, Ending::Complete, None))
    }
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
