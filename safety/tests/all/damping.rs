//! The largest accepted damping still brings a device with an encoder to rest, with every smoothing estimator.
#![allow(clippy::unwrap_used)] // a test may

use haptether_safety::{
    Axes, DeviceModel, LayerSettings, LimiterSettings, SafetyLayer,
    controller::{ControllerKind, SafetySettings},
    estimator::{EstimatorKind, Fit},
};

const PERIOD_S: f64 = 1e-3;
const MASS: f64 = 0.157;
const QUANTUM: f64 = 2.3e-5;

/// Return the largest speed in m/s in the last half second of two, of a free device thrown at 0.6 m/s.
fn speed_at_rest(estimator: EstimatorKind, safety: SafetySettings) -> f64 {
    let mut layer = SafetyLayer::<1>::new(&LayerSettings {
        device: DeviceModel::uniform(MASS, 0.0, 0.0).unwrap(),
        period_s: PERIOD_S,
        estimator,
        safety,
        limiter: LimiterSettings { ramp_in_s: 0.0, ..LimiterSettings::default() },
    })
    .unwrap();
    let (mut x, mut v, mut fastest) = (0.0_f64, 0.6_f64, 0.0_f64);
    for tick in 0..2000 {
        let seen = Axes::<1>::new((x / QUANTUM).round() * QUANTUM);
        let force = layer.tick(&seen, None, &Axes::<1>::new(3.0)).device_force[0];
        x += v * PERIOD_S + force / MASS * PERIOD_S * PERIOD_S / 2.0;
        v += force / MASS * PERIOD_S;
        if tick >= 1500 {
            fastest = fastest.max(v.abs());
        }
    }
    fastest
}

#[test]
fn every_smoothing_estimator_comes_to_rest_at_the_largest_damping() {
    // Backward difference is excluded: its grasp force is noise, so HSC flickers and the push returns in between.
    let most = MASS / (5.0 * PERIOD_S);
    for estimator in [
        EstimatorKind::LowPass { cutoff_hz: 30.0 },
        EstimatorKind::AdaptiveWindow { noise_bound_m: QUANTUM, max_window: 16, fit: Fit::End },
        EstimatorKind::SavitzkyGolay { degree: 2, window: 15 },
        EstimatorKind::default(),
        EstimatorKind::DualKalman { velocity_jerk_density: 1e3, jerk_density: 10.0, quantum_m: QUANTUM },
    ] {
        let safety = SafetySettings {
            controllers: [ControllerKind::Hsc].into(),
            damping: most,
            ..SafetySettings::default()
        };
        let speed = speed_at_rest(estimator, safety);
        // One count per tick is 0.023 m/s; a slower device cannot be told from a resting one.
        assert!(speed < QUANTUM / PERIOD_S, "{estimator:?}: {speed} m/s");
    }
}
