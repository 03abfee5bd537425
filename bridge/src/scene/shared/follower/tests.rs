use std::cell::Cell;

use proptest::prelude::*;
use serde::Deserialize as _;
use serde_json::{Value, json};

use super::*;
use crate::scene::{DivergenceCause, Ending, Outcome};

thread_local! {
    static WITHHELD: Cell<u64> = const { Cell::new(0) };
    static IN_LANES: Cell<usize> = const { Cell::new(0) };
}

/// Count runs followed in lanes to their ends.
pub(super) fn count_in_lanes(rows: usize) {
    IN_LANES.with(|count| count.set(count.get() + rows));
}

/// Count a run that leaves the shared link and ladders.
pub(super) fn count_withheld() {
    WITHHELD.with(|count| count.set(count.get() + 1));
}

static NO_STOP: AtomicBool = AtomicBool::new(false);

/// Return the value at a path of keys and indices, separated by dots.
fn at<'v>(scene: &'v mut Value, path: &str) -> &'v mut Value {
    scene.pointer_mut(&format!("/{}", path.replace('.', "/"))).unwrap_or_else(|| panic!("{path}"))
}

/// Change the values at these paths of a scene.
fn changed(changes: &[(&str, Value)]) -> Value {
    let mut scene: Value =
        serde_json::from_slice(include_bytes!("../../../../tests/remote_push.json")).unwrap();
    scene["record"] = Value::Null;
    for (path, value) in changes {
        *at(&mut scene, path) = value.clone();
    }
    scene
}

/// Build rows of a scene with these numbers at `path`.
fn rows<const N: usize>(scene: &Value, path: &str, values: &[f64]) -> Vec<SceneSpec<N>> {
    let row = |value: &f64| {
        let mut scene = scene.clone();
        *at(&mut scene, path) = json!(value);
        SceneSpec::deserialize(&scene).unwrap()
    };
    values.iter().map(row).collect()
}

/// How many rows were followed, and how.
struct Followed {
    outcomes: Vec<Outcome>,
    /// Number of runs that left.
    branched: u64,
    /// Number of runs in lanes to their ends.
    in_lanes: usize,
}

/// Return how many rows this processor runs in lanes.
fn here(rows: usize) -> usize {
    if processor().is_some() { rows } else { 0 }
}

/// Run rows together, separately and in lanes; each must equal its separate run.
fn followed<const N: usize>(rows: &[SceneSpec<N>]) -> Followed {
    let connection = Connection::of(&rows[0]).unwrap();
    assert!(rows.iter().all(|row| Connection::of(row).unwrap() == connection));
    let alone: Vec<_> = rows.iter().map(|row| crate::scene::outcome(row, &NO_STOP, None).unwrap()).collect();
    let mut branched = 0;
    for lanes in [false, true] {
        WITHHELD.with(|count| count.set(0));
        IN_LANES.with(|count| count.set(0));
        let found = outcomes(&connection, &rows.iter().collect::<Vec<_>>(), lanes, &NO_STOP).unwrap();
        for (outcome, alone) in found.into_iter().zip(&alone) {
            // Bit for bit; NaN is None.
            let outcome = outcome.expect("run together").unwrap();
            assert_eq!(format!("{outcome:?}"), format!("{alone:?}"), "in lanes: {lanes}");
        }
        let seen = WITHHELD.with(Cell::get);
        assert!(!lanes || seen == branched, "as often in lanes");
        branched = seen;
    }
    Followed { outcomes: alone, branched, in_lanes: IN_LANES.with(Cell::get) }
}

#[test]
fn rows_of_one_connection_are_as_alone() {
    let bandwidths = [8.0, 15.0, 20.0];
    let clock =
        |step_s: f64| json!({"offset_s": 0.0, "drift_ppm": 150.0, "step_s": step_s, "step_at_s": 1.0});
    let outages = |duration_s: f64| {
        let times = json!({"kind": "periodic", "at_s": 0.95, "period_s": 4.0, "duration_s": duration_s});
        json!([{"times": times, "effect": "drop"}])
    };
    // In contact at the hold: after the next engagement the hand feels where the arm has come to rest.
    let long = [
        ("run.duration_s", json!(3.5)),
        ("operator.release.at_s", json!(3.0)),
        ("slave.max_acceleration", json!(1.0)),
    ];
    let sensor = json!({"noise_n": 0.02, "bias_n": [0.05], "quantum_n": 0.01, "rate_hz": 700.0});
    for (name, changes) in [
        ("as it is", vec![]),
        ("no controllers", vec![("safety.controllers", json!([]))]),
        ("all controllers", vec![("safety.controllers", json!(["wsc", "hsc", "vfc", "pc"]))]),
        ("holds", vec![("link.forward.loss", json!(0.3)), ("link.backward.loss", json!(0.3))]),
        ("once", vec![("link.forward.loss", json!(0.4)), ("operator.clutch", json!("once"))]),
        ("times", vec![("operator.clutch_times", json!([[0.1, 0.7], [1.0, 1.6]]))]),
        (
            "lets go in motion",
            [&long[..], &[("operator.clutch_times", json!([[0.1, 0.8], [1.4, 3.4]]))]].concat(),
        ),
        ("a slow slave", vec![("slave.period_s", json!(0.0023))]),
        ("a quick slave", vec![("slave.period_s", json!(0.0007))]),
        ("clocks", vec![("link.master_clock", clock(0.004)), ("link.slave_clock", clock(0.003))]),
        ("stalls", vec![("link.master_clock", clock(0.05)), ("link.slave_clock", clock(0.03))]),
        (
            "comes to rest",
            [
                &long[..],
                &[
                    ("slave.control", json!("velocity")),
                    ("operator.clutch_times", json!([[0.1, 0.4], [1.4, 3.4]])),
                ],
            ]
            .concat(),
        ),
        ("outages", [&long[..], &[("link.forward.outages", outages(0.15))]].concat()),
        ("stops", [&long[..], &[("link.forward.outages", outages(0.5))]].concat()),
        ("meets a stop", vec![("safety.controllers", json!([])), ("master.stops", json!([[-0.08, 0.08]]))]),
        ("nobody holds", vec![("operator", Value::Null)]),
        ("force sensor", vec![("slave.force_sensor", sensor)]),
        ("buttons", vec![("master.buttons", json!({"clutch": 0, "engage": null, "gripper": null}))]),
        (
            "pushed",
            vec![(
                "environment.pushers",
                json!([{"shape": "ramp", "at_s": 0.3, "duration_s": 1.0, "rise_s": 0.5, "frequency_hz": 0.0,
                        "force_n": [3.5], "recorded": null}]),
            )],
        ),
        ("measured velocity", vec![("master.measures_velocity", json!(true))]),
        ("settles", vec![("run.stop_early", json!(true)), ("operator.release.at_s", json!(0.4))]),
        ("leaves", vec![("run.diverged_position", json!(0.02))]),
        ("too fast", vec![("run.diverged_speed", json!(0.1))]),
        ("arm", vec![("coupling.position_scale", json!(3.0)), ("run.diverged_position", json!(0.047))]),
        ("no wire", vec![("link", Value::Null)]),
        ("reorders", vec![("link.forward.keep_order", json!(false)), ("link.forward.jitter_s", json!(0.02))]),
    ] {
        let short = [
            ("run.duration_s", json!(2.0)),
            ("operator.release.at_s", json!(1.2)),
            ("master.stops", json!([[-5.0, 5.0]])),
        ];
        let scene = changed(&[&short[..], &changes].concat());
        let found = followed(&rows::<1>(&scene, "slave.bandwidth_hz", &bandwidths));
        assert_eq!(found.branched, 0, "{name}");
        // Runs that stall, skip ticks, diverge or leave their path at a stop are run separately.
        let in_lanes = match name {
            "clocks" | "stalls" | "leaves" | "too fast" | "meets a stop" => 0,
            "arm" => found.outcomes.iter().filter(|one| one.diverged.is_none()).count(),
            _ => bandwidths.len(),
        };
        assert_eq!(found.in_lanes, here(in_lanes), "{name}");
        assert!(found.outcomes.iter().all(|one| one.ending != Ending::NeverEngaged), "{name}");
    }
}

#[test]
fn rows_of_three_axes_are_as_alone() {
    let mut scene = changed(&[("run.duration_s", json!(1.5)), ("operator.release.at_s", json!(1.0))]);
    for pointer in [
        "/master/mass_kg",
        "/master/viscous",
        "/master/coulomb",
        "/master/position",
        "/master/velocity",
        "/master/stops",
        "/operator/start",
        "/operator/legs/0/end",
        "/slave/position",
        "/environment/objects/0/shape/point",
    ] {
        let one = scene.pointer(pointer).unwrap()[0].clone();
        *scene.pointer_mut(pointer).unwrap() = json!([one, one, one]);
    }
    scene["environment"]["objects"][0]["shape"]["normal"] = json!([0.6, 0.0, 0.8]);
    scene["master"]["axes"] = 3.into();
    let path = "environment.objects.0.contact.stiffness";
    let found = followed(&rows::<3>(&scene, path, &[50.0, 100.0, 200.0]));
    assert!(found.outcomes.iter().all(|one| one.ending == Ending::Complete), "{:?}", found.outcomes);
    assert_eq!(found.in_lanes, here(3));
    // Along the axes and rotated, with friction per joint.
    scene["environment"]["objects"][0]["shape"]["normal"] = json!([0.0, 1.0, 0.0]);
    scene["master"]["friction"] = json!("axis");
    scene["coupling"]["quat_wxyz"] = json!([0.96, 0.0, 0.28, 0.0]);
    assert_eq!(followed(&rows::<3>(&scene, path, &[50.0, 100.0, 200.0])).in_lanes, here(3));
    assert_eq!(followed(&rows::<3>(&scene, path, &[50.0, 200.0])).in_lanes, 0, "too few");
}

/// Rows may differ in anything: those that do not fit into lanes run separately, the others in several groups.
#[test]
fn rows_that_differ_in_anything_are_as_alone() {
    let scene = changed(&[
        ("run.duration_s", json!(2.2)),
        ("operator.release.at_s", json!(1.3)),
        (
            "environment.pushers",
            json!([{"shape": "ramp", "at_s": 0.9, "duration_s": 0.5, "rise_s": 0.2, "frequency_hz": 0.0,
                    "force_n": [3.5], "recorded": null}]),
        ),
    ]);
    let ramp = |low: f64, high: f64| -> Vec<Value> {
        let value = |row: i32| low + (high - low) * f64::from(row) / 10.0;
        (0..11).map(|row| json!((value(row) * 1e6).round() / 1e6)).collect()
    };
    for (path, values, in_lanes) in [
        ("operator.stiffness", ramp(0.0, 600.0), 11),
        ("operator.grip_strength_n", ramp(1.0, 15.0), 11),
        ("operator.release.at_s", ramp(0.7, 1.6), 11),
        ("operator.legs.0.end.0", ramp(-0.06, 0.07), 11),
        ("master.mass_kg.0", ramp(0.05, 0.4), 11),
        ("master.coulomb.0", ramp(0.0, 0.5), 11),
        ("master.stops.0.1", ramp(0.021, 0.1), 11),
        ("slave.mass_kg", ramp(0.5, 9.0), 11),
        ("slave.max_speed", ramp(0.01, 2.0), 11),
        ("environment.objects.0.contact.stiffness", ramp(10.0, 90_000.0), 11),
        ("environment.objects.0.contact.damping", ramp(0.0, 300.0), 11),
        ("environment.pushers.0.at_s", ramp(0.5, 1.5), 11),
        ("environment.pushers.0.force_n.0", ramp(-9.0, 9.0), 11),
        ("coupling.position_scale", ramp(0.3, 1.5), 11),
        ("coupling.force_scale", ramp(0.3, 1.5), 11),
        ("coupling.command_speed", ramp(0.01, 0.2), 11),
        ("safety.damping", ramp(0.0, 9.0), 11),
        ("safety.hold_off_s", ramp(0.0, 0.3), 11),
        ("safety.limiter.max_force_n", ramp(1.0, 9.0), 11),
        // Each row has its own window, or one of two.
        ("safety.window", (0..11).map(|row| json!(100 + row)).collect(), 0),
        ("safety.window", (0..11).map(|row| json!(100 + row % 2)).collect(), 11),
    ] {
        let row = |value: &Value| {
            let mut scene = scene.clone();
            *at(&mut scene, path) = value.clone();
            SceneSpec::<1>::deserialize(&scene).unwrap()
        };
        let all: Vec<_> = values.iter().map(row).collect();
        assert_eq!(followed(&all).in_lanes, here(in_lanes), "{path}");
    }
}

/// Layers withhold, ladders hold and operators press again: link and ladders then differ from those of the other rows.
#[test]
fn rows_whose_force_is_withheld_are_as_alone() {
    let scene = changed(&[
        ("run.duration_s", json!(9.0)),
        ("operator.release.at_s", json!(1.2)),
        ("safety.probe_force_n", json!(0.6)),
        ("safety.release_tries", json!(1)),
    ]);
    let found = followed(&rows::<1>(&scene, "operator.stiffness", &[200.0, 300.0, 400.0]));
    assert!(found.branched >= 6, "{}: more than once each", found.branched);
    assert_eq!(found.in_lanes, 0);
    // Beside rows without it, and with skipped ticks.
    let mut with_clocks = scene;
    *at(&mut with_clocks, "link.master_clock") =
        json!({"offset_s": 0.0, "drift_ppm": 150.0, "step_s": 0.004, "step_at_s": 3.0});
    let mut some = rows::<1>(&with_clocks, "operator.stiffness", &[200.0, 300.0, 400.0]);
    some[1].safety.settings.release_tries = 0;
    let Followed { branched, .. } = followed(&some);
    assert!(branched >= 4, "{branched}: more than once each of two");
}

#[test]
fn a_fault_ends_a_row_as_alone() {
    let scene = changed(&[
        ("run.duration_s", json!(3.0)),
        ("run.diverged_position", json!(1e9)),
        ("run.diverged_speed", json!(1e9)),
        ("safety.controllers", json!([])),
        ("safety.limiter", Value::Null),
        ("coupling.command_speed", json!(1e6)),
        ("master.max_force_n", json!(1e5)),
        ("master.stops", json!([[-1e6, 1e6]])),
        ("operator.grip_strength_n", json!(1e5)),
        ("coupling.force_scale", json!(400.0)),
    ]);
    let path = "environment.objects.0.contact.stiffness";
    let Followed { outcomes: found, in_lanes, .. } = followed(&rows::<1>(&scene, path, &[10.0, 2e3, 3e4]));
    assert!(in_lanes < 3, "{in_lanes}");
    let is_fault = |one: &Outcome| {
        one.diverged.is_some_and(|diverged| matches!(diverged.cause, DivergenceCause::Fault(..)))
    };
    assert!(found.iter().any(is_fault), "{found:?}");
    // In several groups under a push, the first rows leave.
    let mut pushed = scene;
    pushed["environment"]["pushers"] = json!([{"shape": "ramp", "at_s": 0.6, "duration_s": 2.0, "rise_s": 1.0,
        "frequency_hz": 0.0, "force_n": [0.05], "recorded": null}]);
    let stiffness: Vec<_> =
        (0..11).map(|row| if row < 3 { 3e4 } else { 0.1 + 0.01 * f64::from(row) }).collect();
    let Followed { outcomes: found, in_lanes, .. } = followed(&rows::<1>(&pushed, path, &stiffness));
    assert!(found[..3].iter().all(is_fault) && in_lanes == here(8), "{in_lanes} {found:?}");
}

#[test]
fn what_changes_its_frames_or_cannot_be_built_is_run_alone() {
    let scene = changed(&[("link.forward.duplicate", json!(0.1)), ("run.duration_s", json!(0.5))]);
    let rows = rows::<1>(&scene, "operator.stiffness", &[200.0, 300.0]);
    let connection = Connection::of(&rows[0]).unwrap();
    let all = rows.iter().collect::<Vec<_>>();
    assert!(outcomes(&connection, &all, true, &NO_STOP).unwrap().iter().all(Option::is_none));
    // A slave that receives nothing for longer than the history.
    let scene = changed(&[("link.forward.loss", json!(1.0)), ("run.duration_s", json!(9.0))]);
    let rows = self::rows::<1>(&scene, "operator.stiffness", &[200.0, 300.0]);
    let connection = Connection::of(&rows[0]).unwrap();
    let all = rows.iter().collect::<Vec<_>>();
    assert!(outcomes(&connection, &all, true, &NO_STOP).unwrap().iter().all(Option::is_none));
    let scene = changed(&[("run.duration_s", json!(0.5))]);
    let rows = self::rows::<1>(&scene, "slave.bandwidth_hz", &[15.0, -1.0, 10.0]);
    let connection = Connection::of(&rows[0]).unwrap();
    let all = rows.iter().collect::<Vec<_>>();
    let found = outcomes(&connection, &all, true, &NO_STOP).unwrap();
    assert_eq!(found.iter().map(Option::is_some).collect::<Vec<_>>(), [true, false, true]);
    assert_eq!(outcomes(&connection, &all, true, &AtomicBool::new(true)), Err(SceneError::Stopped));
}

/// The fade of a change depends on the ladder of each row.
#[test]
fn what_changes_its_coupling_is_run_alone() {
    let change = |key: &str, value: Value| {
        let mut change = json!({"at_s": 0.6, "position_scale": null, "force_scale": null, "rotation_scale": null,
            "torque_scale": null, "quat_wxyz": null, "locked_axes": null});
        change[key] = value;
        change
    };
    let changes = json!([change("position_scale", json!(2.0)), change("locked_axes", json!([0]))]);
    let scene = changed(&[("run.duration_s", json!(1.0)), ("coupling.changes", changes)]);
    let rows = rows::<1>(&scene, "slave.bandwidth_hz", &[8.0, 15.0, 20.0]);
    IN_LANES.with(|count| count.set(0));
    let found = crate::scene::shared::outcomes(&rows.iter().collect::<Vec<_>>(), true, &NO_STOP).unwrap();
    let alone = rows.iter().map(|row| crate::scene::outcome(row, &NO_STOP, None)).collect::<Vec<_>>();
    assert!(alone.iter().all(Result::is_ok) && IN_LANES.with(Cell::get) == 0);
    assert_eq!(format!("{found:?}"), format!("{alone:?}"));
}

/// An invalid value is refused in each row and does not end the sweep.
#[test]
fn what_no_row_can_have_is_refused_of_each() {
    for changes in [
        [("link.forward.loss", json!(1.5)), ("run.duration_s", json!(0.5))],
        [("master.buttons", json!({"clutch": 40, "engage": null, "gripper": null})), ("run.seed", json!(1))],
        [("safety.ladder.hold_after_s", json!(-1.0)), ("run.seed", json!(1))],
        [("safety.window", json!(0)), ("run.seed", json!(1))],
    ] {
        let rows = rows::<1>(&changed(&changes), "operator.stiffness", &[200.0, 300.0]);
        let found = crate::scene::shared::outcomes(&rows.iter().collect::<Vec<_>>(), true, &NO_STOP).unwrap();
        let alone = rows.iter().map(|row| crate::scene::outcome(row, &NO_STOP, None)).collect::<Vec<_>>();
        assert!(alone.iter().all(Result::is_err), "{changes:?}");
        assert_eq!(found, alone);
    }
}

#[test]
fn a_history_goes_back_as_far_as_it_must_and_takes_no_number_that_cannot_be() {
    let sent = |n: f64| {
        let one = Axes::<1>::repeat(n);
        Sent { position: one, velocity: one, force: one }
    };
    let mut history = History::new();
    for n in 0..2000_u64 {
        // A peer that receives nothing for a while.
        let heard = if n < 900 { n.saturating_sub(20) } else { n.saturating_sub(300).max(880) };
        assert!(history.push(sent(n as f64 * 1e-3), Signal::EnvironmentForce, heard));
        for tick in heard..=n {
            assert_eq!(history.of(tick).position[0].to_bits(), (tick as f64 * 1e-3).to_bits());
        }
    }
    assert_eq!(history.sent.len(), 512, "no more than twice as many as that takes");
    for bad in [f64::NAN, f64::INFINITY, 1e9] {
        assert!(!history.push(sent(bad), Signal::EnvironmentForce, 1999), "{bad}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(12))]
    #[test]
    fn rows_over_any_link_are_as_alone(
        delay_s in 0.0..0.1f64,
        jitter in 0.0..0.3f64,
        loss in 0.0..0.4f64,
        seed in 1..1000u64,
        slave_period_us in 500..4000u64,
        hold_after_s in 0.006..0.1f64,
    ) {
        let mut changes = vec![
            ("run.duration_s", json!(1.2)),
            ("run.seed", json!(seed)),
            ("slave.period_s", json!(slave_period_us as f64 * 1e-6)),
            ("safety.ladder.hold_after_s", json!(hold_after_s)),
            ("safety.ladder.extrapolate_s", json!(0.001)),
            ("operator.release.at_s", json!(0.4)),
        ];
        for [delay, deviation, lost] in [
            ["link.forward.delay_s", "link.forward.jitter_s", "link.forward.loss"],
            ["link.backward.delay_s", "link.backward.jitter_s", "link.backward.loss"],
        ] {
            changes.extend([(delay, json!(delay_s)), (deviation, json!(jitter * delay_s)), (lost, json!(loss))]);
        }
        followed(&rows::<1>(&changed(&changes), "operator.stiffness", &[150.0, 250.0, 350.0]));
    }
}
