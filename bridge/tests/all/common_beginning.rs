//! Rows of sweeps that differ in their controllers alone share a beginning: no outcome may show it.
#![allow(clippy::unwrap_used)] // a test may

use haptether_bridge::scene::{
    Metrics, Outcome, Progress, SweepPart, SweepSettings, Variation, sweep, sweep_parts,
};
use proptest::prelude::*;
use serde_json::{Value, json};

const SETTINGS: SweepSettings = SweepSettings { threads: 1, lanes: true, metrics: Metrics::ALL };

/// A remote push in which the hand lets go after 1 s, with fields changed.
fn scene(fields: &Value) -> Value {
    let mut scene: Value = serde_json::from_slice(include_bytes!("../remote_push.json")).unwrap();
    scene["run"]["duration_s"] = 2.0.into();
    scene["operator"]["release"]["at_s"] = 1.0.into();
    for (path, value) in fields.as_object().unwrap() {
        *scene.pointer_mut(path).unwrap() = value.clone();
    }
    scene
}

fn with(scene: &Value, safety: &Value) -> Vec<u8> {
    let mut scene = scene.clone();
    for (key, value) in safety.as_object().unwrap() {
        scene["safety"][key] = value.clone();
    }
    serde_json::to_vec(&scene).unwrap()
}

/// Numbers that are none differ from themselves, so as text.
fn text(outcome: Option<&Outcome>) -> String {
    format!("{outcome:?}")
}

/// Each scene as a part of one sweep over seeds, and by itself; how many different outcomes there are.
fn assert_same(name: &str, scene: &Value, safeties: &[Value], seeds: &[u64]) -> usize {
    let variations =
        [Variation { path: "run.seed".into(), values: seeds.iter().map(|seed| *seed as f64).collect() }];
    let scenes: Vec<_> = safeties.iter().map(|safety| with(scene, safety)).collect();
    let parts: Vec<_> = scenes.iter().map(|scene| SweepPart { scene, variations: &variations }).collect();
    let together = sweep_parts(&parts, SETTINGS, &Progress::default(), None).unwrap();
    let mut seen = std::collections::BTreeSet::new();
    for ((scene, safety), together) in scenes.iter().zip(safeties).zip(&together) {
        for (row, seed) in seeds.iter().enumerate() {
            let one = [Variation { path: "run.seed".into(), values: vec![*seed as f64] }];
            let alone = sweep(scene, &one, SETTINGS, &Progress::default(), None).unwrap();
            let (alone, together) = (alone[0].as_ref().ok(), together[row].as_ref().ok());
            assert!(alone.is_some(), "{name} {safety} {seed}: refused");
            assert_eq!(text(together), text(alone), "{name} {safety} {seed}");
            seen.insert(text(alone));
        }
    }
    seen.len()
}

#[test]
fn rows_with_other_controllers_are_those_of_runs_of_their_own() {
    let sets: Vec<_> =
        [&[][..], &["wsc"], &["hsc"], &["vfc"], &["pc"], &["wsc", "hsc"], &["wsc", "hsc", "vfc", "pc"]]
            .iter()
            .map(|controllers| json!({ "controllers": controllers }))
            .collect();
    for (name, fields) in [
        ("as it is", json!({})),
        (
            "near",
            json!({ "/link/forward/delay_s": 1e-3, "/link/forward/jitter_s": 0.0, "/link/backward/delay_s": 1e-3, "/link/backward/jitter_s": 0.0 }),
        ),
        ("far", json!({ "/link/forward/delay_s": 0.3, "/link/backward/delay_s": 0.3 })),
        ("another rate", json!({ "/slave/period_s": 0.002 })),
        ("ends early", json!({ "/run/stop_early": true })),
        ("damaged", json!({ "/link/forward/corrupt": 0.05, "/link/backward/corrupt": 0.05 })),
        ("reordered", json!({ "/link/forward/reorder": 0.1, "/link/forward/reorder_depth": 3 })),
        ("measured", json!({ "/master/measures_velocity": true })),
        ("diverges", json!({ "/run/diverged_speed": 0.02 })),
        (
            "clocks",
            json!({
                "/link/master_clock": { "offset_s": 3.0, "drift_ppm": 80.0, "step_s": 0.03, "step_at_s": 0.9 },
                "/link/slave_clock": { "offset_s": 0.0, "drift_ppm": -90.0, "step_s": 0.004, "step_at_s": 1.1 },
            }),
        ),
        ("changed", json!({ "/coupling/changes": [{ "at_s": 0.7, "force_scale": 0.5 }] })),
    ] {
        let different = assert_same(name, &scene(&fields), &sets, &[1, 7]);
        assert!(different > 6 || name == "diverges", "{name}: {different} outcomes");
    }
}

#[test]
fn rows_with_other_thresholds_are_those_of_runs_of_their_own() {
    let scene = scene(&json!({}));
    let safeties: Vec<_> = [-0.02, -0.03, -0.05, -0.1, -0.3, -10.0]
        .iter()
        .map(|threshold| json!({ "controllers": ["wsc"], "energy_threshold_j": threshold }))
        .chain([
            json!({ "controllers": ["wsc"], "window": 40 }),
            json!({ "controllers": ["wsc"], "damping": 2.0 }),
            json!({ "controllers": ["hsc"], "hold_off_s": 0.02, "release_ramp_s": 0.05 }),
            json!({ "controllers": ["hsc"], "release_tries": 1 }),
            // Nobody watches, and nobody ever intervenes.
            json!({ "controllers": [] }),
            json!({ "controllers": ["hsc"], "grasp_threshold": 1e3 }),
        ])
        .collect();
    assert!(assert_same("thresholds", &scene, &safeties, &[3]) > 4);
}

/// Numbers of the controllers as columns of one sweep.
#[test]
fn rows_of_one_part_share_a_beginning_too() {
    let scene = with(&scene(&json!({})), &json!({ "controllers": ["wsc"] }));
    // The first one leads, and intervenes last.
    let values = vec![-0.1, -0.03, -0.01, -0.03];
    let column = |values: Vec<f64>| [Variation { path: "safety.energy_threshold_j".into(), values }];
    let rows = sweep(&scene, &column(values.clone()), SETTINGS, &Progress::default(), None).unwrap();
    for (row, value) in values.into_iter().enumerate() {
        let alone = sweep(&scene, &column(vec![value]), SETTINGS, &Progress::default(), None).unwrap();
        assert_eq!(text(rows[row].as_ref().ok()), text(alone[0].as_ref().ok()), "{value}");
    }
    assert_ne!(text(rows[0].as_ref().ok()), text(rows[2].as_ref().ok()));
    assert_eq!(text(rows[1].as_ref().ok()), text(rows[3].as_ref().ok()));
}

#[test]
fn a_row_that_cannot_be_is_refused_and_the_others_are_run() {
    let base = scene(&json!({}));
    let scene = with(&base, &json!({ "controllers": ["wsc"] }));
    for (path, values) in [
        ("safety.damping", vec![-1.0, 2.0, f64::NAN, 5.0]),
        ("safety.energy_threshold_j", vec![-0.03, f64::INFINITY, -0.1]),
    ] {
        let column = |values: Vec<f64>| [Variation { path: path.into(), values }];
        let rows = sweep(&scene, &column(values.clone()), SETTINGS, &Progress::default(), None).unwrap();
        for (row, value) in values.iter().enumerate() {
            let alone = sweep(&scene, &column(vec![*value]), SETTINGS, &Progress::default(), None).unwrap();
            assert_eq!(format!("{:?}", rows[row]), format!("{:?}", alone[0]), "{path} {value}");
        }
        let refused = values.iter().filter(|value| !value.is_finite() || **value == -1.0).count();
        assert_eq!(rows.iter().filter(|row| row.is_err()).count(), refused, "{path}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn any_settings_are_those_of_runs_of_their_own(
        settings in prop::collection::vec(
            (prop::sample::subsequence(vec!["wsc", "hsc", "vfc", "pc"], 0..=4), 0.5..8.0_f64, -0.2..-0.01_f64, 20_u32..150),
            2..6,
        ),
        // Jitter of 5 ms asks for a delay of 13 ms.
        (delay_s, seed, push_n) in (0.013..0.2_f64, 0_u64..1000, 0.5..5.0_f64),
    ) {
        let safeties: Vec<_> = settings
            .iter()
            .map(|(controllers, damping, energy, window)| json!({
                "controllers": controllers, "damping": damping, "energy_threshold_j": energy, "window": window,
            }))
            .collect();
        let scene = scene(&json!({
            "/link/forward/delay_s": delay_s,
            "/link/backward/delay_s": delay_s,
            "/environment/pushers": [{
                "shape": "ramp", "at_s": 0.3, "duration_s": 1.0, "rise_s": 0.1, "frequency_hz": 0.0,
                "force_n": [push_n], "recorded": null,
            }],
        }));
        assert_same("any", &scene, &safeties, &[seed]);
    }
}
