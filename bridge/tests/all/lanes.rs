//! Scenarios side by side have, to the last bit, the outcomes that they have one by one.
#![allow(clippy::unwrap_used, missing_docs)] // a test may

use haptether_bridge::scene::{Metrics, Outcome, Progress, SweepSettings, Variation, sweep};
use serde_json::Value;

const SCENE: &[u8] = include_bytes!("../../benches/work_unit.json");

fn outcomes(scene: &Value, lanes: bool) -> Vec<Outcome> {
    // Full lanes of either width, and some that are left over: 16 and 3, or 8, 8 and 3.
    let values = (0..19).map(|i| -0.01 - 0.005 * f64::from(i)).collect();
    let variations = [Variation { path: "operator.legs.0.end.0".into(), values }];
    let settings = SweepSettings { threads: 1, lanes, metrics: Metrics::ALL };
    let scene = serde_json::to_vec(scene).unwrap();
    let rows = sweep(&scene, &variations, settings, &Progress::default(), None).unwrap();
    rows.into_iter().map(Result::unwrap).collect()
}

#[test]
fn lanes_have_the_bits_of_single_runs() {
    for (signals, controllers, force_threshold_n, ramp_s) in [
        ("true", "wsc", 0.0, 0.0),
        ("true", "wsc", 0.5, 0.05),
        ("true", "hsc", 0.0, 0.05),
        ("true", "pc", 0.0, 0.0),
        ("estimated", "wsc", 0.0, 0.0),
        ("estimated", "hsc", 0.0, 0.05),
        ("estimated", "vfc", 0.0, 0.0),
    ] {
        let mut scene: Value = serde_json::from_slice(SCENE).unwrap();
        scene["safety"]["signals"] = signals.into();
        scene["safety"]["controllers"] = vec![controllers].into();
        scene["safety"]["wsc_force_threshold_n"] = force_threshold_n.into();
        scene["safety"]["release_ramp_s"] = ramp_s.into();
        let case = format!("{signals} {controllers} {force_threshold_n} {ramp_s}");
        let (one_by_one, side_by_side) = (outcomes(&scene, false), outcomes(&scene, true));
        // Debug prints the shortest digits that have the bits, and the sign of a zero.
        assert_eq!(format!("{one_by_one:?}"), format!("{side_by_side:?}"), "{case}");
        let peak = |outcome: &Outcome| outcome.max_ejection_velocity.unwrap();
        assert!(peak(&one_by_one[0]) != peak(&one_by_one[10]), "{case}: nothing varies");
    }
}
