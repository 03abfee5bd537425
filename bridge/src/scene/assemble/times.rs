//! Periods, ticks and lateness of a scene.

use super::{
    super::spec::SceneSpec,
    error::{SceneError, contradiction},
};

/// A period as a whole number of ns.
pub(crate) fn period_ns(name: &str, seconds: f64) -> Result<u64, SceneError> {
    let ns = seconds * 1e9;
    if !(1e4..=2e7).contains(&ns) || (ns - ns.round()).abs() > 1e-3 {
        return contradiction(format!(
            "{name} = {seconds}: must be a whole number of nanoseconds between 1e-5 and 2e-2 s"
        ));
    }
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // checked above
    Ok(ns.round() as u64)
}

/// Most ticks of one run.
const MAX_TICKS: f64 = 2e7;

/// How many ticks of `period_s` a run of `duration_s` has.
pub(crate) fn ticks(scene: &SceneSpec) -> Result<u64, SceneError> {
    let (duration, period) = (scene.run.duration_s, scene.run.period_s);
    let ticks = (duration / period).round();
    if !(duration > 0.0 && (1.0..=MAX_TICKS).contains(&ticks)) {
        return contradiction(format!(
            "run: duration_s = {duration} of ticks of {period} s is {ticks} ticks, must be 1 to 2e7"
        ));
    }
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // checked above
    Ok(ticks as u64)
}

/// Most ticks by which an environment is late.
const MAX_LATE: usize = 100_000;

/// By how many ticks the force of the environment is late.
pub(crate) fn late(scene: &SceneSpec) -> Result<usize, SceneError> {
    let ticks = scene.environment.as_ref().map_or(0, |environment| environment.delay_ticks);
    if ticks > MAX_LATE {
        return contradiction(format!("environment.delay_ticks = {ticks}: must be at most {MAX_LATE}"));
    }
    Ok(ticks)
}
