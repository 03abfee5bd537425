//! A sweep measures what it is asked for, with the values that it has beside all others.
#![allow(clippy::unwrap_used)] // a test may

use haptether_bridge::scene::{
    Ending, Metric, Metrics, Outcome, Progress, SweepPart, SweepSettings, Variation, sweep_parts,
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

/// A scene with three axes: what is one number of an axis is so of each.
fn of_three_axes(one: &Value) -> Value {
    match one {
        Value::Array(items) => match items.as_slice() {
            [Value::Number(number)] => json!([number, number, number]),
            items => items.iter().map(of_three_axes).collect(),
        },
        Value::Object(fields) => {
            fields.iter().map(|(key, value)| (key.clone(), of_three_axes(value))).collect()
        }
        other => other.clone(),
    }
}

#[test]
fn a_metric_alone_has_the_bits_that_it_has_beside_all_others() {
    let of = |bytes: &[u8]| -> Value { serde_json::from_slice(bytes).unwrap() };
    let mut remote = of(include_bytes!("../remote_push.json"));
    remote["run"]["duration_s"] = 2.0.into();
    remote["operator"]["release"]["at_s"] = 1.0.into();
    let mut early = remote.clone();
    early["run"]["duration_s"] = 6.0.into();
    early["run"]["stop_early"] = true.into();
    let local = of(include_bytes!("../press.json"));
    let mut settling = local.clone();
    settling["run"]["duration_s"] = 4.0.into();
    settling["run"]["stop_early"] = true.into();
    // The hand keeps pressing: what settles is held.
    settling["operator"]["release"] = Value::Null;
    let mut diverging = local.clone();
    diverging["run"]["diverged_speed"] = 0.5.into();
    let mut three = of_three_axes(&local);
    three["master"]["axes"] = 3.into();
    three["operator"]["legs"][0]["end"] = json!([-0.05, -0.02, 0.03]);
    three["environment"]["objects"][0]["shape"]["normal"] = json!([1.0, 0.0, 0.0]);
    // A hand that holds, and a wall that is only pressed: nothing intervenes, and no energy is rendered.
    let quiet = [Metric::InterventionTime, Metric::InterventionTicks, Metric::PassivityMin];
    let depth = "operator.legs.0.end.0";
    for (name, scene, path, endings, zeros) in [
        ("local", &local, depth, &[Ending::Complete][..], &[][..]),
        ("local of three axes", &three, depth, &[Ending::Complete], &[]),
        ("local until it settles", &settling, depth, &[Ending::Settled], &quiet),
        ("local of which some diverge", &diverging, depth, &[Ending::Complete, Ending::Diverged], &[]),
        ("remote", &remote, "run.seed", &[Ending::Complete], &[]),
        ("remote, until it settles", &early, "run.seed", &[Ending::Settled], &[]),
    ] {
        let values: &[f64] = if path == "run.seed" { &[1.0, 7.0] } else { &[-0.02, -0.04, -0.06] };
        for lanes in [false, true] {
            let whole = outcomes(scene, path, values, lanes, Metrics::ALL);
            for ending in endings {
                assert!(whole.iter().any(|one| one.ending == *ending), "{name}: {whole:?}");
            }
            for metric in Metric::ALL {
                let alone = outcomes(scene, path, values, lanes, [metric].into_iter().collect());
                for (alone, whole) in alone.iter().zip(&whole) {
                    let bits = |outcome: &Outcome, one: Metric| outcome.value(one, 1e-3).map(f64::to_bits);
                    assert_eq!(bits(alone, metric), bits(whole, metric), "{name} {metric:?} {lanes}");
                    assert_eq!(ending(alone), ending(whole), "{name} {metric:?} {lanes}");
                    for other in Metric::ALL {
                        // Both are of the same ticks.
                        let is_ticks = |metric: Metric| metric.name().starts_with("intervention");
                        let is_same = other == metric || is_ticks(other) && is_ticks(metric);
                        assert!(
                            is_same || alone.value(other, 1e-3).is_none(),
                            "{name} {metric:?}: {other:?}"
                        );
                    }
                }
                // Something is compared: it is there, and not 0 in all rows.
                let is_remote = matches!(metric, Metric::PositionError | Metric::ForceError);
                let is_late =
                    matches!(metric, Metric::TimeToTrip | Metric::FalseTrips) || zeros.contains(&metric);
                if !metric.is_of_rotation() && !is_late && (!is_remote || path == "run.seed") {
                    let seen = whole.iter().filter_map(|one| one.value(metric, 1e-3));
                    assert!(seen.clone().any(|value| value != 0.0), "{name} {metric:?}");
                }
            }
        }
    }
}
