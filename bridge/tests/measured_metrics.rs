//! A sweep measures what it is asked for, with the values that it has beside all others.
#![allow(clippy::unwrap_used)] // a test may

use haptether_bridge::scene::{
    Metric, Metrics, Outcome, Progress, SweepPart, SweepSettings, Variation, sweep_parts,
};
use serde_json::{Value, json};

/// Rows of a scene without controllers and with WSC, which share a beginning where they can.
fn outcomes(scene: &Value, path: &str, values: &[f64], lanes: bool, metrics: Metrics) -> Vec<Outcome> {
    let variations = [Variation { path: path.into(), values: values.to_vec() }];
    let scenes: Vec<_> = [json!([]), json!(["wsc"])]
        .into_iter()
        .map(|controllers| {
            let mut scene = scene.clone();
            scene["safety"]["controllers"] = controllers;
            serde_json::to_vec(&scene).unwrap()
        })
        .collect();
    let parts: Vec<_> = scenes.iter().map(|scene| SweepPart { scene, variations: &variations }).collect();
    let settings = SweepSettings { threads: 1, lanes, metrics };
    let rows = sweep_parts(&parts, settings, &Progress::default(), None).unwrap();
    rows.into_iter().flatten().map(Result::unwrap).collect()
}

/// With none of its metrics.
fn ending(outcome: &Outcome) -> String {
    format!("{:?} {:?} {}", outcome.ending, outcome.diverged, outcome.ticks)
}

#[test]
fn a_metric_alone_has_the_bits_that_it_has_beside_all_others() {
    let of = |bytes: &[u8]| -> Value { serde_json::from_slice(bytes).unwrap() };
    let mut remote = of(include_bytes!("remote_push.json"));
    remote["run"]["duration_s"] = 2.0.into();
    remote["operator"]["release"]["at_s"] = 1.0.into();
    let mut early = remote.clone();
    early["run"]["stop_early"] = true.into();
    let mut diverging = of(include_bytes!("../benches/work_unit.json"));
    diverging["run"]["diverged_position"] = 0.05.into();
    let remote_metrics = &[Metric::PositionError, Metric::ForceError];
    for (name, scene, path, also) in [
        ("lanes", of(include_bytes!("../benches/work_unit.json")), "operator.legs.0.end.0", &[][..]),
        ("lanes of which some end early", diverging, "operator.legs.0.end.0", &[]),
        ("remote", remote, "run.seed", remote_metrics),
        ("remote, until it settles", early, "run.seed", remote_metrics),
    ] {
        let values: &[f64] = if path == "run.seed" { &[1.0, 7.0] } else { &[-0.02, -0.04, -0.06] };
        for lanes in [false, true] {
            let whole = outcomes(&scene, path, values, lanes, Metrics::ALL);
            let mut measured = vec![];
            for metric in Metric::ALL {
                let alone = outcomes(&scene, path, values, lanes, [metric].into_iter().collect());
                for (alone, whole) in alone.iter().zip(&whole) {
                    let bits = |outcome: &Outcome, one: Metric| one.of(outcome, 1e-3).map(f64::to_bits);
                    assert_eq!(bits(alone, metric), bits(whole, metric), "{name} {metric:?} {lanes}");
                    assert_eq!(ending(alone), ending(whole), "{name} {metric:?} {lanes}");
                    for other in Metric::ALL {
                        // Both are of the same ticks.
                        let is_ticks = |metric: Metric| metric.name().starts_with("intervention");
                        let is_same = other == metric || is_ticks(other) && is_ticks(metric);
                        assert!(is_same || other.of(alone, 1e-3).is_none(), "{name} {metric:?}: {other:?}");
                    }
                }
                if whole.iter().any(|one| metric.of(one, 1e-3).is_some()) {
                    measured.push(metric);
                }
            }
            let wanted = Metric::ALL.into_iter().filter(|metric| {
                let is_remote = matches!(metric, Metric::PositionError | Metric::ForceError);
                !metric.is_of_rotation() && (!is_remote || also.contains(metric))
            });
            assert_eq!(measured, wanted.collect::<Vec<_>>(), "{name}");
        }
    }
}
