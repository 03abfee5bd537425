//! A frame whose bytes nobody changes travels through virtual time without them: no result may show it.
#![allow(clippy::unwrap_used)] // a test may

use std::sync::atomic::AtomicBool;

use haptether_bridge::scene::{simulate, simulate_encoded};
use serde_json::{Value, json};

/// A remote push of 1.5 s with both directions of the link changed.
fn scene(changes: &Value, seed: u64) -> Vec<u8> {
    let mut scene: Value = serde_json::from_slice(include_bytes!("../remote_push.json")).unwrap();
    scene["run"]["duration_s"] = 1.5.into();
    scene["run"]["seed"] = seed.into();
    scene["record"] = json!({ "every": 1 });
    for direction in ["forward", "backward"] {
        for (key, value) in changes.as_object().unwrap() {
            scene["link"][direction][key] = value.clone();
        }
    }
    serde_json::to_vec(&scene).unwrap()
}

#[test]
fn no_signal_event_outcome_or_report_shows_how_frames_travel() {
    let cases = [
        ("perfect", json!({ "delay_s": 0.0, "jitter_s": 0.0, "loss": 0.0 })),
        ("delay, jitter, loss", json!({})),
        (
            "overtaking and repeated",
            json!({ "keep_order": false, "jitter_correlation_s": 0.0, "duplicate": 0.1, "duplicate_gap_s": 0.003 }),
        ),
        // Some frames have their bytes changed, and travel as these between the others.
        ("damaged", json!({ "corrupt": 0.05, "corrupt_bits": 2, "truncate": 0.02, "truncate_bytes": 9 })),
        // The queue of the bottleneck counts the bytes.
        ("rate", json!({ "rate_bps": 1.4e6, "queue_packets": 20 })),
    ];
    for (name, changes) in &cases {
        let mut texts = Vec::new();
        for seed in [1, 7] {
            let (scene, stop) = (scene(changes, seed), AtomicBool::new(false));
            let run = simulate(&scene, &stop).unwrap();
            assert!(
                run.signals.iter().any(|signal| signal.name == "device_force"),
                "{name}: nothing recorded"
            );
            // As text, for numbers that are none differ from themselves.
            let text = format!("{run:?}");
            assert!(text == format!("{:?}", simulate_encoded(&scene, &stop).unwrap()), "{name}, seed {seed}");
            texts.push(text);
        }
        assert!(*name == "perfect" || texts[0] != texts[1], "{name}: the seed changes nothing");
    }
}
