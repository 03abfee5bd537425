//! Runs without kept signals, including rows of a sweep, let each side do several ticks in a row, as far as the link
//! allows. The results must not depend on it.
#![allow(clippy::unwrap_used)] // a test may

use std::sync::atomic::AtomicBool;

use haptether_bridge::scene::{
    Ending, Metrics, Outcome, Progress, SceneRun, SweepSettings, Variation, simulate, sweep,
};
use proptest::prelude::*;
use serde_json::{Value, json};

/// Remote push with a release after 1 s. `both` changes fields of both link directions, `others` any fields.
fn scene(both: &Value, others: &Value) -> Value {
    let mut scene: Value = serde_json::from_slice(include_bytes!("../remote_push.json")).unwrap();
    scene["run"]["duration_s"] = 2.0.into();
    scene["operator"]["release"]["at_s"] = 1.0.into();
    for direction in ["forward", "backward"] {
        for (key, value) in both.as_object().unwrap() {
            scene["link"][direction][key] = value.clone();
        }
    }
    for (path, value) in others.as_object().unwrap() {
        *scene.pointer_mut(path).unwrap() = value.clone();
    }
    scene
}

/// Return the outcome of each seed as a row of a sweep.
fn rows(scene: &Value, seeds: &[u64]) -> Vec<Option<Outcome>> {
    let values = seeds.iter().map(|seed| *seed as f64).collect();
    let variations = [Variation { path: "run.seed".into(), values }];
    let settings = SweepSettings { threads: 1, lanes: true, metrics: Metrics::ALL };
    let bytes = serde_json::to_vec(scene).unwrap();
    let rows = sweep(&bytes, &variations, settings, &Progress::default(), None).unwrap();
    rows.into_iter().map(Result::ok).collect()
}

/// Run these seeds, with the signals of every tick or without signals.
fn runs(scene: &Value, seeds: &[u64], record: &Value) -> Vec<Option<SceneRun>> {
    let mut scene = scene.clone();
    scene["record"] = record.clone();
    let run = |seed: &u64| {
        scene["run"]["seed"] = (*seed).into();
        simulate(&serde_json::to_vec(&scene).unwrap(), &AtomicBool::new(false)).ok()
    };
    seeds.iter().map(run).collect()
}

/// Compare rows of a sweep, and runs without signals, with runs whose signals are kept, in which both sides tick in
/// turn. They are compared as text, because NaN is not equal to NaN.
fn compare(name: &str, scene: &Value, seeds: &[u64]) {
    let in_turn = runs(scene, seeds, &json!({ "every": 1 }));
    assert!(in_turn.iter().any(Option::is_some), "{name}: refused");
    let outcomes: Vec<_> = in_turn.iter().map(|run| run.as_ref().map(|run| run.outcome)).collect();
    assert_eq!(format!("{:?}", rows(scene, seeds)), format!("{outcomes:?}"), "{name}");
    let without = |run: Option<SceneRun>| run.map(|run| SceneRun { signals: Vec::new(), ..run });
    let without_signals: Vec<_> = in_turn.into_iter().map(without).collect();
    let in_a_row = runs(scene, seeds, &Value::Null);
    assert_eq!(format!("{in_a_row:?}"), format!("{without_signals:?}"), "{name}");
}

#[test]
fn run_equals_a_run_in_turn() {
    let none = json!({});
    let cases = [
        ("as it is", none.clone(), none.clone()),
        ("without delay", json!({ "delay_s": 0.0, "jitter_s": 0.0 }), none.clone()),
        ("less than a tick", json!({ "delay_s": 4e-4, "jitter_s": 0.0 }), none.clone()),
        ("a whole number of ticks", json!({ "delay_s": 0.003, "jitter_s": 0.0 }), none.clone()),
        ("far", json!({ "delay_s": 0.4, "jitter_s": 0.04 }), none.clone()),
        (
            "overtaking and repeated",
            json!({ "keep_order": false, "jitter_correlation_s": 0.0, "duplicate": 0.1, "duplicate_gap_s": 0.003 }),
            none.clone(),
        ),
        ("reordered", json!({ "reorder": 0.1, "reorder_depth": 3 }), none.clone()),
        ("damaged", json!({ "corrupt": 0.05, "corrupt_bits": 2 }), none.clone()),
        ("rate", json!({ "rate_bps": 1.4e6, "queue_packets": 20 }), none.clone()),
        (
            "outage",
            json!({ "outages": [{ "times": { "kind": "once", "at_s": 1.2, "duration_s": 0.03 } }] }),
            none.clone(),
        ),
        (
            "shorter and longer again",
            json!({ "jitter_s": 0.0, "timeline": [{ "at_s": 0.8, "delay_s": 0.005 }, { "at_s": 1.3, "delay_s": 0.06 }] }),
            none.clone(),
        ),
        (
            "back without delay",
            none.clone(),
            json!({ "/link/backward/delay_s": 0.0, "/link/backward/jitter_s": 0.0 }),
        ),
        (
            "there without delay",
            none.clone(),
            json!({ "/link/forward/delay_s": 0.0, "/link/forward/jitter_s": 0.0 }),
        ),
        (
            "back without delay, at twice the rate",
            none.clone(),
            json!({ "/link/backward/delay_s": 0.0, "/link/backward/jitter_s": 0.0, "/run/period_s": 0.0005 }),
        ),
        (
            "there damaged, the slave at four times the rate",
            none.clone(),
            json!({ "/link/forward/corrupt": 0.05, "/link/forward/duplicate": 0.1, "/slave/period_s": 0.00025 }),
        ),
        ("another rate of the slave", none.clone(), json!({ "/slave/period_s": 0.002 })),
        ("periods without a common tick", none.clone(), json!({ "/slave/period_s": 0.0007 })),
        (
            "clocks",
            none.clone(),
            json!({
                "/link/master_clock": { "offset_s": 3.0, "drift_ppm": 80.0, "step_s": 0.0, "step_at_s": 0.0 },
                "/link/slave_clock": { "offset_s": 0.0, "drift_ppm": -90.0, "step_s": 0.004, "step_at_s": 1.1 },
            }),
        ),
        (
            "mirrored",
            json!({ "attacks": [{ "action": { "kind": "mirror" }, "target": { "every": 7 } }] }),
            json!({ "/slave/period_s": 0.00025 }),
        ),
        ("secure", none.clone(), json!({ "/security": { "secure": true } })),
        ("it ends early", none, json!({ "/run/stop_early": true, "/run/duration_s": 6.0 })),
    ];
    for (name, both, others) in &cases {
        compare(name, &scene(both, others), &[1, 7]);
    }
}

/// A side of a diverging run is ahead of the observed tick, so a single run is repeated in turn for its reports.
#[test]
fn diverging_run_equals_a_run_in_turn() {
    let scene = scene(&json!({}), &json!({ "/run/diverged_speed": 0.3 }));
    compare("it diverges", &scene, &[1, 7]);
    for run in runs(&scene, &[1, 7], &Value::Null) {
        assert_eq!(run.unwrap().outcome.ending, Ending::Diverged);
    }
}

/// No delay in half of the cases.
fn delay_ms() -> impl Strategy<Value = u32> {
    prop_oneof![Just(0), 0_u32..120]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(40))]

    #[test]
    fn run_over_any_link_equals_a_run_in_turn(
        (forward_ms, backward_ms) in (delay_ms(), delay_ms()),
        (jitter, loss) in (0_u32..30, 0_u32..10),
        keep_order in prop::bool::weighted(0.8),
        slave_us in prop::sample::select(vec![500_u32, 700, 1000, 1300, 4000]),
    ) {
        let jitter = f64::from(jitter) * 1e-2;
        let link = |ms: u32| json!({
            "delay_s": f64::from(ms) * 1e-3, "jitter_s": f64::from(ms) * 1e-3 * jitter,
            "loss": f64::from(loss) * 1e-2, "keep_order": keep_order,
        });
        let mut scene = scene(&link(forward_ms), &json!({ "/slave/period_s": f64::from(slave_us) * 1e-6 }));
        for (key, value) in link(backward_ms).as_object().unwrap() {
            scene["link"]["backward"][key] = value.clone();
        }
        compare("over any link", &scene, &[3]);
    }
}
