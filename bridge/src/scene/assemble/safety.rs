//! Safety layer of a scene without an arm.

use haptether_safety::{
    LayerSettings, Limiter, LimiterSettings, ParameterError, SafetyLayer, controller::SafetyController,
};

use super::{
    super::{
        research::{ResearchFactory, research_controller},
        spec::{SafetySpec, SceneSpec, SignalsSpec},
    },
    SceneError, contradiction,
    master::device_model,
};
use crate::local::{TrueWatch, Watch};

/// Build the safety layer of a scene without an arm, with its research controller if there is one.
pub(crate) fn watch<const N: usize>(
    scene: &SceneSpec<N>,
    research: Option<&dyn ResearchFactory>,
) -> Result<Watch<N>, SceneError> {
    let SafetySpec { settings: safety, signals, estimator, .. } = scene.safety;
    let (device, period_s) = (device_model(scene)?, scene.run.period_s);
    if signals == SignalsSpec::True {
        if scene.safety.research.is_some() {
            return contradiction("safety.research: sees what is estimated, not safety.signals = \"true\"");
        }
        let controller = SafetyController::new(&device, period_s, &safety)?;
        let limiters = scene.safety.limiter.map(|settings| {
            Ok::<_, ParameterError>([
                Limiter::new(period_s, settings)?,
                Limiter::new(period_s, LimiterSettings { ramp_in_s: 0.0, ..settings })?,
            ])
        });
        return Ok(Watch::True(Box::new(TrueWatch { controller, limiters: limiters.transpose()? })));
    }
    let limiter = limiter(&scene.safety);
    let layer = SafetyLayer::new(&LayerSettings { device, period_s, estimator, safety, limiter })?;
    let layer = match research_controller(scene, research)? {
        Some(controller) => layer.with_research(controller),
        None => layer,
    };
    Ok(Watch::Estimated(Box::new(layer)))
}

/// Bounds that are never reached, for studies without limiter.
const WITHOUT_BOUNDS: LimiterSettings =
    LimiterSettings { max_force_n: 1e15, max_slew_n_per_s: 1e18, max_power_w: 1e18, ramp_in_s: 0.0 };

pub(crate) fn limiter(spec: &SafetySpec) -> LimiterSettings {
    spec.limiter.unwrap_or(WITHOUT_BOUNDS)
}
