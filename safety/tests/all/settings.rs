//! Settings deserialize from the tables of a scene, with the key names of a scene file.
#![cfg(feature = "serde")]
#![allow(clippy::unwrap_used)] // a test may

use haptether_safety::{
    LimiterSettings,
    controller::{ControllerKind, SafetySettings},
    estimator::{EstimatorKind, Fit},
    observer::VelocityForceForm,
};
use serde::Deserialize;
use serde_json::{Value, json};

/// `[safety]` of a scene; the flattening table refuses unknown keys.
#[derive(Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
struct Table {
    #[serde(flatten)]
    settings: SafetySettings,
    estimator: EstimatorKind,
    limiter: Option<LimiterSettings>,
}

fn table() -> Value {
    json!({
        "controllers": ["pc", "hsc"],
        "damping": 5.0,
        "velocity_threshold": 0.6,
        "vfc_force_threshold_n": 1,
        "vfc_form": "both",
        "grasp_threshold": 1.5,
        "grasp_floor_n": 1e-3,
        "hsc_force_threshold_n": 0.1,
        "hsc_velocity_threshold": 0.05,
        "energy_threshold_j": -0.03,
        "wsc_force_threshold_n": 0.3,
        "energy_ratio": 0.5,
        "window": 100,
        "pc_max_damping": 10.0,
        "hold_off_s": 0.0,
        "release_ramp_s": 0.1,
        "probe_force_n": 0.5,
        "probe_threshold": 0.2,
        "release_tries": 0,
        "estimator": {"kind": "adaptive-window", "noise_bound_m": 1e-4, "max_window": 16, "fit": "best"},
        "limiter": {"max_force_n": 3.0, "max_slew_n_per_s": 1e3, "max_power_w": 20.0, "ramp_in_s": 0.2},
    })
}

#[test]
fn table_becomes_settings() {
    let read: Table = serde_json::from_value(table()).unwrap();
    let settings = SafetySettings {
        controllers: [ControllerKind::Hsc, ControllerKind::Pc].into(),
        vfc_form: VelocityForceForm::Both,
        release_ramp_s: 0.1,
        hsc_velocity_threshold: 0.05,
        wsc_force_threshold_n: 0.3,
        probe_force_n: 0.5,
        ..SafetySettings::default()
    };
    let estimator = EstimatorKind::AdaptiveWindow { noise_bound_m: 1e-4, max_window: 16, fit: Fit::Best };
    let limiter = LimiterSettings { max_force_n: 3.0, ..LimiterSettings::default() };
    assert_eq!(read, Table { settings, estimator, limiter: Some(limiter) });
}

#[test]
fn keys_are_required_and_unknown_keys_are_refused() {
    let whole = table();
    for key in whole.as_object().unwrap().keys() {
        let mut lacks = whole.clone();
        lacks.as_object_mut().unwrap().remove(key);
        let read = serde_json::from_value::<Table>(lacks);
        assert_eq!(read.is_ok(), key == "limiter", "{key}: {read:?}");
    }
    for (path, value) in [
        ("/unheard_of", json!(1)),
        ("/estimator/unheard_of", json!(1)),
        ("/limiter/unheard_of", json!(1)),
        ("/controllers/0", json!("unheard-of")),
        ("/estimator", json!({"kind": "backward-difference", "unheard_of": 1})),
    ] {
        let mut other = table();
        let (parent, key) = path.rsplit_once('/').unwrap();
        match other.pointer_mut(parent).unwrap() {
            Value::Object(map) => drop(map.insert(key.to_owned(), value)),
            Value::Array(list) => list[0] = value,
            _ => unreachable!(),
        }
        let error = serde_json::from_value::<Table>(other).unwrap_err().to_string();
        assert!(error.contains("unheard"), "{path}: {error}");
    }
}
