//! How a run of a scene is judged.

use haptether_netsim::LinkSettings;

use super::super::{measures::MeasureSettings, spec::SceneSpec};

/// How a run is judged.
pub(crate) fn measures(scene: &SceneSpec) -> MeasureSettings {
    let operator = scene.operator.as_ref();
    let release = operator.and_then(|operator| operator.release.as_ref());
    let mut quiet_after: f64 = 0.0;
    if let Some(operator) = operator {
        let legs: f64 = operator.legs.iter().map(|leg| leg.duration_s).sum();
        let recorded = operator.recorded.as_ref().and_then(|series| series.time_s.last().copied());
        quiet_after = quiet_after.max(legs).max(recorded.unwrap_or(0.0));
        if let Some(release) = release {
            let regrasp = operator.regrasp.as_ref();
            let regrips = regrasp.map_or(0.0, |regrasp| regrasp.reaction_s + regrasp.rise_s);
            quiet_after = quiet_after.max(release.at_s + release.decay_s + regrips);
        }
        if operator.tremor.is_some() && (release.is_none() || operator.regrasp.is_some()) {
            // A hand that trembles and holds is never quiet.
            quiet_after = f64::MAX;
        }
    }
    if let Some(environment) = &scene.environment {
        for pusher in &environment.pushers {
            quiet_after = quiet_after.max(pusher.at_s + pusher.duration_s);
        }
        for object in &environment.objects {
            if object.body.is_some() {
                quiet_after = f64::MAX;
            }
            if let Some(motion) = &object.motion {
                let swings = motion.amplitude.iter().any(|a| *a != 0.0);
                quiet_after = quiet_after.max(if swings { f64::MAX } else { motion.until_s });
            }
        }
    }
    // What was scheduled last arrives late.
    let late = scene.environment.as_ref().map_or(0, |environment| environment.delay_ticks);
    let links = scene.link.iter().flat_map(|links| [&links.forward, &links.backward]).flatten();
    let round_trip: f64 = links.clone().map(LinkSettings::longest_delay_s).sum();
    quiet_after = links.map(LinkSettings::last_change_s).fold(quiet_after, f64::max);
    let ramp = scene.safety.limiter.as_ref().map_or(0.0, |limiter| limiter.ramp_in_s);
    quiet_after += late as f64 * scene.run.period_s + 2.0 * round_trip + ramp;
    MeasureSettings {
        release_s: release.map(|release| release.at_s),
        diverged_position: scene.run.diverged_position,
        diverged_speed: scene.run.diverged_speed,
        quiet_after_s: scene.run.stop_early.then_some(quiet_after),
    }
}
