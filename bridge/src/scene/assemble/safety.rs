//! The safety layer of a scene, and who watches one without an arm.

use haptether_safety::{
    LayerSettings, Limiter, LimiterSettings, ParameterError, SafetyLayer,
    controller::{ControllerKind, SafetyController, SafetySettings},
    estimator::{EstimatorKind, Fit},
    observer::VelocityForceForm,
};

use super::{
    super::spec::{ControllerSpec, EstimatorSpec, FitSpec, SafetySpec, SceneSpec, SignalsSpec, VfcFormSpec},
    error::SceneError,
    master::device_model,
};
use crate::local::Watch;

pub(crate) fn safety_settings(spec: &SafetySpec) -> SafetySettings {
    SafetySettings {
        controllers: spec
            .controllers
            .iter()
            .map(|controller| match controller {
                ControllerSpec::Vfc => ControllerKind::Vfc,
                ControllerSpec::Hsc => ControllerKind::Hsc,
                ControllerSpec::Wsc => ControllerKind::Wsc,
                ControllerSpec::Pc => ControllerKind::Pc,
            })
            .collect(),
        damping: spec.damping,
        velocity_threshold: spec.velocity_threshold,
        vfc_force_threshold_n: spec.vfc_force_threshold_n,
        vfc_form: match spec.vfc_form {
            VfcFormSpec::Product => VelocityForceForm::Product,
            VfcFormSpec::Both => VelocityForceForm::Both,
        },
        grasp_threshold: spec.grasp_threshold,
        grasp_floor_n: spec.grasp_floor_n,
        hsc_force_threshold_n: spec.hsc_force_threshold_n,
        energy_threshold_j: spec.energy_threshold_j,
        energy_ratio: spec.energy_ratio,
        window: spec.window,
        pc_max_damping: spec.pc_max_damping,
        hold_off_s: spec.hold_off_s,
        release_ramp_s: spec.release_ramp_s,
    }
}

pub(crate) fn estimator(spec: &EstimatorSpec) -> EstimatorKind {
    match *spec {
        EstimatorSpec::BackwardDifference {} => EstimatorKind::BackwardDifference {},
        EstimatorSpec::LowPass { cutoff_hz } => EstimatorKind::LowPass { cutoff_hz },
        EstimatorSpec::AdaptiveWindow { noise_bound_m, max_window, fit } => EstimatorKind::AdaptiveWindow {
            noise_bound_m,
            max_window,
            fit: match fit {
                FitSpec::End => Fit::End,
                FitSpec::Best => Fit::Best,
            },
        },
        EstimatorSpec::SavitzkyGolay { degree, window } => EstimatorKind::SavitzkyGolay { degree, window },
        EstimatorSpec::Kalman { jerk_density, quantum_m } => {
            EstimatorKind::Kalman { jerk_density, quantum_m }
        }
    }
}

/// Bounds that nothing reaches: a study has switched the limiter off.
const WITHOUT_BOUNDS: LimiterSettings =
    LimiterSettings { max_force_n: 1e15, max_slew_n_per_s: 1e18, max_power_w: 1e18, ramp_in_s: 0.0 };

pub(crate) fn limiter(spec: &SafetySpec) -> LimiterSettings {
    spec.limiter.as_ref().map_or(WITHOUT_BOUNDS, |limiter| LimiterSettings {
        max_force_n: limiter.max_force_n,
        max_slew_n_per_s: limiter.max_slew_n_per_s,
        max_power_w: limiter.max_power_w,
        ramp_in_s: limiter.ramp_in_s,
    })
}

/// Who watches a scene without an arm.
pub(crate) fn watch<const N: usize>(scene: &SceneSpec) -> Result<Watch<N>, SceneError> {
    let (device, safety) = (device_model::<N>(&scene.master)?, safety_settings(&scene.safety));
    let period_s = scene.run.period_s;
    if scene.safety.signals == SignalsSpec::True {
        let controller = SafetyController::new(&device, period_s, &safety)?;
        let limiters = scene.safety.limiter.as_ref().map(|_| {
            let settings = limiter(&scene.safety);
            Ok::<_, ParameterError>([
                Limiter::new(period_s, settings)?,
                Limiter::new(period_s, LimiterSettings { ramp_in_s: 0.0, ..settings })?,
            ])
        });
        return Ok(Watch::True { controller, limiters: limiters.transpose()? });
    }
    let layer = SafetyLayer::new(&LayerSettings {
        device,
        period_s,
        estimator: estimator(&scene.safety.estimator),
        safety,
        limiter: limiter(&scene.safety),
    })?;
    Ok(Watch::Estimated(Box::new(layer)))
}
