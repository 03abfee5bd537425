//! Wrong samples of a device and of an arm: what they change of the force on the hand and of the command to the arm.
#![allow(clippy::unwrap_used)] // a test may

use std::{fmt::Write as _, ops::ControlFlow};

use haptether_bridge::{
    Clutch, Event, LadderState, MasterPlant, MasterSide, SlavePlant, SlaveSide, ToolMotion, Truth,
    VirtualSettings, run_virtual,
    scene::{SceneSpec, simulated_master, simulated_slave},
};
use haptether_netsim::LinkSettings;
use haptether_safety::{Axes, Fault, Signal};
use serde_json::json;

const MS: u64 = 1_000_000;
const TICKS: usize = 3500;
/// The hand lets go: without a controller the device then flies.
const RELEASED: usize = 2600;
/// From one wrong sample to the next.
const EVERY: usize = 97;

/// Errors of a sample: of the position in m (rad), of a measured velocity in m/s (rad/s).
type Wrong<'a> = &'a (dyn Fn(usize) -> [f64; 2] + Send + Sync);

struct Spoiled<'a, P> {
    inner: P,
    tick: usize,
    wrong: Wrong<'a>,
}

impl<P: MasterPlant<1>> MasterPlant<1> for Spoiled<'_, P> {
    fn begin(&mut self, now_ns: u64) {
        self.inner.begin(now_ns);
    }

    fn read(&mut self, now_ns: u64) -> (Axes<1>, Option<Axes<1>>) {
        let (position, velocity) = self.inner.read(now_ns);
        let [dx, dv] = (self.wrong)(self.tick);
        self.tick += 1;
        (position.add_scalar(dx), velocity.map(|velocity| velocity.add_scalar(dv)))
    }

    fn write(&mut self, force: &Axes<1>) {
        self.inner.write(force);
    }

    fn engaged(&mut self) {
        self.inner.engaged();
    }

    fn truth(&self) -> Option<Truth<1>> {
        self.inner.truth()
    }
}

impl<P: SlavePlant<1>> SlavePlant<1> for Spoiled<'_, P> {
    fn begin(&mut self, now_ns: u64) {
        self.inner.begin(now_ns);
    }

    fn read(&mut self, now_ns: u64) -> [Axes<1>; 3] {
        let [position, velocity, force] = self.inner.read(now_ns);
        let [dx, dv] = (self.wrong)(self.tick);
        self.tick += 1;
        // A sample that is wrong is wrong in its force, too.
        let force = if dx == 0.0 { force } else { force.add_scalar(30.0) };
        [position.add_scalar(dx), velocity.add_scalar(dv), force]
    }

    fn write(&mut self, position: &Axes<1>, velocity: &Axes<1>) {
        self.inner.write(position, velocity);
    }

    fn exert(&mut self, wrench: (&Axes<1>, &Axes<3>), motion: &ToolMotion<1>) {
        self.inner.exert(wrench, motion);
    }

    fn stop(&mut self) -> Axes<1> {
        self.inner.stop()
    }

    fn engaged(&mut self, now_ns: u64) {
        self.inner.engaged(now_ns);
    }

    fn touches(&self) -> bool {
        self.inner.touches()
    }
}

/// A hand that presses a device against a wall of the remote side, holds, and lets go at 2.6 s.
fn scene(device: &serde_json::Value, controllers: &[&str]) -> SceneSpec<1> {
    let mut json: serde_json::Value = serde_json::from_slice(include_bytes!("../remote_push.json")).unwrap();
    for (name, value) in device.as_object().unwrap() {
        json["master"][name] = value.clone();
    }
    json["safety"]["controllers"] = controllers.into();
    // At most m / (5 dT) of the lightest device.
    json["safety"]["pc_max_damping"] = 5.0.into();
    json["operator"]["clutch"] = "once".into();
    json["link"]["forward"] = serde_json::Value::Null;
    json["link"]["backward"] = serde_json::Value::Null;
    serde_json::from_value(json).unwrap()
}

/// Device force and command of each tick, how often samples were replaced on each side, and the last states.
struct Seen {
    force_n: Vec<f64>,
    velocity: Vec<f64>,
    command: Vec<f64>,
    outliers: [u64; 2],
    states: [LadderState; 2],
    faults: [u8; 2],
    text: String,
}

fn run(scene: &SceneSpec<1>, near: Wrong<'_>, far: Wrong<'_>) -> Seen {
    let master = simulated_master::<1>(scene, 1).unwrap().side;
    let slave = simulated_slave::<1>(scene, 2).unwrap().side;
    let plant = Spoiled { inner: master.plant, tick: 0, wrong: near };
    let mut master = MasterSide::new(plant, master.endpoint, Clutch::Once).unwrap();
    let mut slave = SlaveSide::new(Spoiled { inner: slave.plant, tick: 0, wrong: far }, slave.endpoint);
    let link = LinkSettings { delay_s: 0.002, ..LinkSettings::default() };
    let settings = VirtualSettings {
        period_ns: MS,
        slave_period_ns: MS,
        ticks: TICKS as u64,
        forward: link.clone(),
        backward: link,
        seed: 7,
        secure: false,
        encoded: false,
        master_clock: None,
        slave_clock: None,
    };
    let mut seen = Seen {
        force_n: Vec::new(),
        velocity: Vec::new(),
        command: Vec::new(),
        outliers: [0; 2],
        states: [LadderState::Disengaged; 2],
        faults: [0; 2],
        text: String::new(),
    };
    run_virtual(&settings, &mut master, &mut slave, |event, _| {
        match event {
            Event::Master(record) => {
                seen.force_n.push(record.device_force[0]);
                seen.velocity.push(record.velocity[0]);
                (seen.outliers[0], seen.states[0], seen.faults[0]) =
                    (record.outliers, record.state, record.fault);
            }
            Event::Slave(record) => {
                seen.command.push(record.command[0]);
                (seen.outliers[1], seen.states[1], seen.faults[1]) =
                    (record.outliers, record.state, record.fault);
            }
        }
        ControlFlow::Continue(())
    })
    .unwrap();
    let diagnosis = [&master.endpoint.exchange, &slave.endpoint.exchange]
        .map(|exchange| exchange.flight().diagnosis().map(|of| of.explain().text));
    seen.text = diagnosis.into_iter().flatten().collect::<Vec<_>>().join("; ");
    seen
}

fn largest(one: &[f64], other: &[f64]) -> f64 {
    one.iter().zip(other).map(|(one, other)| (one - other).abs()).fold(0.0, f64::max)
}

/// Largest speed in m/s (rad/s) after the hand has let go.
fn thrown_at(seen: &Seen) -> f64 {
    seen.velocity[RELEASED..].iter().fold(0.0, |most: f64, velocity| most.max(velocity.abs()))
}

fn right(_: usize) -> [f64; 2] {
    [0.0; 2]
}

/// Wrong samples in a row, every [`EVERY`], whose sign alternates.
fn wrong(size: f64, in_a_row: usize, of_velocity: f64) -> impl Fn(usize) -> [f64; 2] + Send + Sync {
    move |tick| {
        let sign = if tick % 2 == 0 { 1.0 } else { -1.0 };
        // In flight the device meets its stops: with more than one wrong sample there it would be a fault.
        let in_a_row = if tick < RELEASED { in_a_row } else { 1 };
        let is_wrong = tick > 100 && tick % EVERY < in_a_row;
        if is_wrong { [sign * size, sign * of_velocity] } else { [0.0; 2] }
    }
}

/// Devices: name, mechanics, and by how much more they move than a stylus, in m (rad).
fn devices() -> [(&'static str, serde_json::Value, f64); 4] {
    [
        ("PHANTOM Desktop", json!({"encoder_quantum": 2.3e-5}), 1.0),
        (
            "Omni",
            json!({"mass_kg": [0.045], "viscous": [0.0], "coulomb": [0.26], "encoder_quantum": 5.5e-5}),
            1.0,
        ),
        ("measures V", json!({"encoder_quantum": 0.0, "measures_velocity": true}), 1.0),
        (
            "leader joint",
            json!({"kind": "joints", "encoder_quantum": 1.534e-3, "stops": [[-0.5, 0.5]]}),
            10.0,
        ),
    ]
}

const SIZES: [f64; 6] = [0.7e-3, 2e-3, 10e-3, 30e-3, 0.1, 0.5];

/// The table of `docs/samples.md`: `cargo test -p haptether-bridge --test all outliers -- --nocapture`.
#[test]
fn outliers_move_neither_force_nor_arm() {
    let mut table =
        "| device | wrong samples | in a row | force changes by N | command by mm (mrad) |\n".to_owned();
    for (name, device, scale) in devices() {
        // At a quantum of 1.5 mrad the force of HSC and VFC chatters by itself.
        let all = if scale > 1.0 { &["wsc"][..] } else { &["vfc", "hsc", "wsc", "pc"] };
        for controllers in [&[][..], all] {
            let scene = scene(&device, controllers);
            let clean = run(&scene, &right, &right);
            assert_eq!((clean.outliers, clean.faults), ([0; 2], [0; 2]), "{name}");
            let moves = clean.force_n.iter().any(|force| force.abs() > 1.0);
            assert!(moves, "{name}: the wall was met");
            for size in SIZES {
                let quantum = device["encoder_quantum"].as_f64().unwrap_or(0.0);
                // Two quanta of the bound, and three by which rounding shifts the path.
                let size = size * scale + 5.0 * quantum;
                for in_a_row in 1..=3 {
                    let of_velocity = if name == "measures V" { 0.6 + 20.0 * size } else { 0.0 };
                    let near = wrong(size, in_a_row, of_velocity);
                    let seen = run(&scene, &near, &right);
                    let count = (101..TICKS).filter(|tick| near(*tick)[0] != 0.0).count() as u64;
                    let what = format!("{name} {controllers:?} {size} x {in_a_row}");
                    assert_eq!(seen.faults, [0; 2], "{what}: {}", seen.text);
                    // The least ones stay on a path that bends the other way.
                    assert!(
                        seen.outliers[0] * 10 >= count * 7 && seen.outliers[0] <= count + 3,
                        "{what}: {} of {count}",
                        seen.outliers[0]
                    );
                    let force = largest(&seen.force_n[..RELEASED], &clean.force_n);
                    let command = largest(&seen.command[..RELEASED], &clean.command);
                    assert!(force <= 0.5, "{what}: {force} N");
                    if !controllers.is_empty() {
                        // A trip at a threshold may come some ticks earlier or later; the throw stays what it was.
                        let [speed, before] = [&seen, &clean].map(thrown_at);
                        assert!(speed <= 1.1 * before + 0.02, "{what}: {speed} m/s, {before} without");
                    }
                    let most = 0.5e-3 * scale;
                    assert!(command < most, "{what}: {command} m");
                    if !controllers.is_empty() {
                        let _ = writeln!(
                            table,
                            "| {name} | {:.4} | {in_a_row} | {force:.3} | {:.3} |",
                            size,
                            1e3 * command
                        );
                    }
                }
            }
        }
    }
    println!("{table}");
}

/// The same of an arm whose samples are wrong in position, velocity and force.
#[test]
fn wrong_samples_of_an_arm_are_not_felt() {
    let scene = scene(&json!({}), &["vfc", "hsc", "wsc", "pc"]);
    let clean = run(&scene, &right, &right);
    for size in SIZES {
        for in_a_row in 1..=3 {
            let seen = run(&scene, &right, &wrong(size, in_a_row, 3.0));
            assert_eq!((seen.faults, seen.outliers[0]), ([0; 2], 0), "{size} x {in_a_row}: {}", seen.text);
            assert!(seen.outliers[1] > 30, "{size} x {in_a_row}");
            let force = largest(&seen.force_n, &clean.force_n);
            assert!(force <= 0.5, "{size} x {in_a_row}: {force} N");
            assert!(largest(&seen.command, &clean.command) < 0.5e-3);
        }
    }
}

/// One wrong sample in 500 and no force: nobody kicks a free device.
#[test]
fn a_free_device_is_not_kicked() {
    for controllers in [&["vfc"][..], &["hsc"], &["wsc"], &["pc"], &["vfc", "hsc", "wsc", "pc"]] {
        let mut json: serde_json::Value = json!({});
        json["stops"] = json!([[-1.0, 1.0]]);
        let mut scene = scene(&json, controllers);
        scene.operator = None;
        scene.environment = None;
        for size in SIZES {
            let seen = run(&scene, &move |tick| [if tick % 500 == 250 { size } else { 0.0 }, 0.0], &right);
            assert_eq!((seen.faults, seen.outliers), ([0; 2], [TICKS as u64 / 500, 0]), "{size}");
            assert!(seen.force_n.iter().all(|force| *force == 0.0), "{controllers:?} {size}");
        }
    }
}

/// A position that steps beyond the bound of its device, and stays, stops both sides; the message states value and limit.
#[test]
fn a_step_stops_both_sides() {
    let bound = json!({"speed_bound": 10.0});
    for (size, is_near) in [(0.011, true), (-0.03, true), (0.5, true), (0.021, false), (-0.5, false)] {
        let scene = scene(&bound, &["wsc"]);
        let stepped = move |tick: usize| [if tick >= 1500 { size } else { 0.0 }, 0.0];
        let seen = if is_near { run(&scene, &stepped, &right) } else { run(&scene, &right, &stepped) };
        let side = usize::from(!is_near);
        assert_eq!(seen.faults[side], Fault::TooFast(Signal::Position).code(), "{size}");
        assert_eq!(seen.states[side], LadderState::Fault);
        assert!(seen.states[1 - side] >= LadderState::Hold, "{:?}", seen.states);
        // 3 ticks, the link and the fade of the other side.
        assert!(seen.force_n[1600..].iter().all(|force| *force == 0.0), "{size}");
        let rest = seen.command[1600];
        assert!(seen.command[1600..].iter().all(|command| *command == rest), "{size}");
        let limit = if is_near { "at most 10 m/s" } else { "at most 20 m/s" };
        let value = format!("{:.0}", size.abs() * 1e3);
        assert!(seen.text.contains(limit) && seen.text.contains(&value), "{}", seen.text);
    }
}

/// A step within the bound is no motion, and a stop is one: neither is a fault, and neither kicks.
#[test]
fn what_a_device_can_do_is_no_fault() {
    let scene = scene(&json!({}), &["vfc", "hsc", "wsc", "pc"]);
    let clean = run(&scene, &right, &right);
    for size in [1e-3, 5e-3, 15e-3] {
        let seen = run(&scene, &move |tick| [if tick >= 1800 { size } else { 0.0 }, 0.0], &right);
        assert_eq!(seen.faults, [0; 2], "{size}: {}", seen.text);
        let force = largest(&seen.force_n[..1804], &clean.force_n[..1804]);
        assert!(force <= 0.5, "{size}: {force}");
        // Later the arm follows the step, which changes the force.
        let most = seen.force_n[..2600].windows(2).map(|pair| (pair[1] - pair[0]).abs()).fold(0.0, f64::max);
        assert!(most < 0.6, "{size}: {most}");
    }
}
