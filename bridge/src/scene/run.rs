//! One scene, run to its end.

use std::sync::atomic::AtomicBool;

use haptether_master::SimulatedMaster;

use super::{
    assemble::{
        SceneError, environment, exact_master, is_continuous, is_plain, late, measures, period_ns,
        rendered_walls, stepped_master, stepping, ticks, watch,
    },
    bilateral,
    events::{EventLog, SceneEvent},
    local::LocalRun,
    measures::{Ending, Measures, Outcome},
    signals::{Recorder, Sample, Signal},
    spec::SceneSpec,
};
use crate::local::{DelayLine, LocalLoop, LocalPlant, LocalTick, Rendering, SceneRendering, Surfaces};

/// What a run leaves behind.
#[derive(Clone, Debug, PartialEq)]
pub struct SceneRun {
    /// Signals; empty where the scene records nothing.
    pub signals: Vec<Signal>,
    /// What happened.
    pub events: Vec<SceneEvent>,
    /// What it is judged by.
    pub outcome: Outcome,
    /// dT of the master in s.
    pub period_s: f64,
}

/// Runs a scene, unless `stop` is set meanwhile.
///
/// # Errors
///
/// A number or a combination that no part can have, or [`SceneError::Stopped`]; a diverging loop is no error but an
/// outcome.
pub fn simulate(scene: &SceneSpec, stop: &AtomicBool) -> Result<SceneRun, SceneError> {
    match scene.master.axes {
        1 => simulate_axes::<1>(scene, stop),
        2 => simulate_axes::<2>(scene, stop),
        3 => simulate_axes::<3>(scene, stop),
        6 => simulate_axes::<6>(scene, stop),
        7 => simulate_axes::<7>(scene, stop),
        axes => Err(SceneError::Contradiction(format!("master.axes = {axes}: must be 1, 2, 3, 6 or 7"))),
    }
}

fn simulate_axes<const N: usize>(scene: &SceneSpec, stop: &AtomicBool) -> Result<SceneRun, SceneError> {
    if scene.slave.is_some() {
        return bilateral::simulate::<N>(scene, stop);
    }
    check_local(scene)?;
    let environment_spec = scene.environment.as_ref();
    let is_plain = environment_spec.is_none_or(is_plain);
    let is_continuous = is_continuous(scene);
    match (stepping(scene.run.integrator), is_plain) {
        (None, true) => {
            let rendering = rendered_walls::<N>(environment_spec, !is_continuous)?;
            let run = local_run(scene, exact_master(scene)?, rendering)?;
            if is_continuous {
                let mut touches = Touches::default();
                follow(run, scene, stop, move |_, _, looped, log| touches.tell(looped.plant(), log))
            } else {
                follow(run, scene, stop, tell_touch)
            }
        }
        (None, false) => {
            let rendering = SceneRendering(environment::<N>(environment_spec)?);
            follow(local_run(scene, exact_master(scene)?, rendering)?, scene, stop, tell_touch)
        }
        (Some(stepping), true) => {
            // Where the device is says whether it touches, however the walls act on it.
            let walls = rendered_walls::<N>(environment_spec, true)?;
            let rendering = rendered_walls::<N>(environment_spec, !is_continuous)?;
            let run = local_run(scene, stepped_master(scene, stepping)?, rendering)?;
            follow(run, scene, stop, move |time_s, tick, _, log| {
                log.touches(time_s, walls.touches(&tick.position));
            })
        }
        (Some(stepping), false) => {
            let rendering = SceneRendering(environment::<N>(environment_spec)?);
            follow(local_run(scene, stepped_master(scene, stepping)?, rendering)?, scene, stop, tell_touch)
        }
    }
}

fn tell_touch<P: LocalPlant<N, f64>, R: Rendering<N, f64> + Surfaces<N>, const N: usize>(
    time_s: f64,
    tick: &LocalTick<N>,
    looped: &LocalLoop<P, R, N>,
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
    fn tell<const N: usize>(&mut self, master: &SimulatedMaster<N>, log: &mut EventLog) {
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
pub(crate) fn check_local(scene: &SceneSpec) -> Result<(), SceneError> {
    let refuse = |text: &str| Err(SceneError::Contradiction(text.to_owned()));
    if scene.link.is_some() {
        return refuse("link: needs a [slave] at its other end");
    }
    if scene.coupling.is_some() {
        return refuse("coupling: needs a [slave] to couple the master with");
    }
    if is_continuous(scene) && scene.environment.as_ref().is_some_and(|one| one.delay_ticks > 0) {
        return refuse("environment.delay_ticks: a force that acts at every instant is not late");
    }
    if is_continuous(scene) && scene.environment.as_ref().is_some_and(|one| !is_plain(one)) {
        return refuse(
            "environment.rendering = \"continuous\": only resting planes and springs of Kelvin and Voigt, \
             without friction, act continuously, and no recorded push",
        );
    }
    Ok(())
}

/// A loop of its parts.
pub(crate) fn local_run<P: LocalPlant<N, f64>, R: Rendering<N, f64>, const N: usize>(
    scene: &SceneSpec,
    plant: P,
    rendering: R,
) -> Result<LocalRun<P, R, N>, SceneError> {
    let late = late(scene)?;
    let period_ns = period_ns("run.period_s", scene.run.period_s)?;
    let judged = Measures::new(&measures(scene), &plant.position());
    let delay = DelayLine::new(late);
    Ok(LocalRun {
        looped: LocalLoop::new(plant, rendering, delay, watch(scene)?, period_ns),
        measures: judged,
        ticks: ticks(scene)?,
    })
}

fn follow<P: LocalPlant<N, f64>, R: Rendering<N, f64>, const N: usize>(
    mut run: LocalRun<P, R, N>,
    scene: &SceneSpec,
    stop: &AtomicBool,
    mut tell: impl FnMut(f64, &LocalTick<N>, &LocalLoop<P, R, N>, &mut EventLog),
) -> Result<SceneRun, SceneError> {
    let mut log = EventLog::default();
    let mut recorder = Recorder::new(scene.record.as_ref().map_or(0, |record| record.every), run.ticks);
    let mut outcomes = [None];
    run.run_telling(
        stop,
        |time_s, tick, looped| {
            tell(time_s, tick, looped, &mut log);
            log.tripped(time_s, tick.response.lane(0).tripped);
            record(&mut recorder, time_s, tick);
        },
        &mut outcomes,
    );
    let [Some(outcome)] = outcomes else {
        return Err(SceneError::Stopped);
    };
    tell_schedule(scene, &outcome, &mut log);
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
    })
}

/// What the scene itself schedules, as far as the run came, and how it diverged.
pub(crate) fn tell_schedule(scene: &SceneSpec, outcome: &Outcome, log: &mut EventLog) {
    let end_s = outcome.ticks as f64 * scene.run.period_s;
    if let Some(operator) = &scene.operator
        && let Some(release) = &operator.release
    {
        let ends = release.at_s + release.decay_s;
        let mut scheduled = vec![(release.at_s, "release")];
        if let Some(regrasp) = &operator.regrasp {
            scheduled.push((ends + regrasp.reaction_s, "regrasp"));
        }
        for (time_s, kind) in scheduled {
            if time_s <= end_s {
                log.add(time_s, kind, "");
            }
        }
    }
    if let Some(divergence) = &outcome.diverged {
        log.add(divergence.time_s, "diverged", divergence.to_string());
    }
}

#[inline]
fn record<const N: usize>(recorder: &mut Recorder, time_s: f64, tick: &LocalTick<N>) {
    let intervention = tick.response.lane(0);
    recorder.take(&[
        ("time_s", Sample::Scalar(time_s)),
        ("position", Sample::Vector(&tick.position)),
        ("velocity", Sample::Vector(&tick.velocity)),
        ("hand_force", Sample::Vector(&tick.hand_force)),
        ("wall_force", Sample::Vector(&tick.wall_force)),
        ("rendered_force", Sample::Vector(&tick.rendered_force)),
        ("grasp_force", Sample::Vector(&tick.grasp_force)),
        ("safety_force", Sample::Vector(&intervention.safety_force)),
        ("device_force", Sample::Vector(&tick.device_force)),
        ("velocity_force", Sample::Scalar(intervention.velocity_force)),
        ("grasp", Sample::Scalar(intervention.grasp)),
        ("windowed_energy_j", Sample::Scalar(intervention.windowed_energy_j)),
        ("energy_j", Sample::Scalar(intervention.energy_j)),
        ("tripped", Sample::Scalar(f64::from(intervention.tripped.bits()))),
    ]);
}
