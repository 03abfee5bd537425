//! A tool against closed forms.

use proptest::prelude::*;

use super::*;
use crate::{
    ContactLawKind, ContactSettings, ObjectMotionSettings, ObjectSettings, PushKind, SeriesSettings,
    ShapeSettings,
};

const MS: u64 = 1_000_000;
const UPRIGHT: [f64; 4] = [1.0, 0.0, 0.0, 0.0];
type V = Axes<3>;
type Made = (ArmSettings<3>, ToolSettings);

fn free(moments: [f64; 3], points: Vec<[f64; 3]>) -> Made {
    let arm = ArmSettings {
        control: ControlKind::Pd,
        mass_kg: 0.5,
        bandwidth_hz: 10.0,
        stiffness: 0.0,
        damping: 0.0,
        max_speed: None,
        max_acceleration: None,
        takes_force: true,
        viscous: 0.0,
        max_force_n: 50.0,
        max_torque_nm: 5.0,
        speed_bound: None,
        period_s: 1e-3,
        position: V::zeros(),
        force_sensor: None,
        gripper: None,
        tool: None,
    };
    let tool = ToolSettings {
        inertia_kg_m2: V::from(moments),
        rotational_stiffness: 0.0,
        rotational_damping: 0.0,
        max_angular_speed: None,
        quat_wxyz: UPRIGHT,
        points,
        jaw_width_m: 0.08,
        jaw_friction: 0.5,
        jaw_stiffness: 2e4,
        jaw_radius_m: 0.01,
    };
    (arm, tool)
}

/// Critically damped at 50 rad/s in translation, at 60 rad/s in rotation.
fn servoed(points: Vec<[f64; 3]>) -> Made {
    let (m, i, p, q) = (0.5, 1e-3, 50.0, 60.0);
    let (arm, tool) = free([i; 3], points);
    let arm = ArmSettings { stiffness: m * p * p, damping: 2.0 * m * p, ..arm };
    (arm, ToolSettings { rotational_stiffness: i * q * q, rotational_damping: 2.0 * i * q, ..tool })
}

fn at((arm, tool): Made, position: [f64; 3], quat_wxyz: [f64; 4]) -> Made {
    (ArmSettings { position: V::from(position), ..arm }, ToolSettings { quat_wxyz, ..tool })
}

fn contact(stiffness: f64, damping: f64, friction: f64) -> ContactSettings {
    ContactSettings { law: ContactLawKind::KelvinVoigt, stiffness, damping, exponent: 1.0, friction }
}

fn ground(stiffness: f64, damping: f64, friction: f64) -> ObjectSettings<3> {
    let shape = ShapeSettings::Plane { point: V::zeros(), normal: V::z() };
    ObjectSettings { shape, contact: contact(stiffness, damping, friction), motion: None, body: None }
}

fn push(force: [f64; 3]) -> PusherSettings<3> {
    PusherSettings {
        shape: PushKind::Step,
        at_s: 0.0,
        duration_s: 1e3,
        rise_s: 0.0,
        frequency_hz: 0.0,
        force_n: V::from(force),
        recorded: None,
    }
}

fn handle() -> HandleSettings {
    HandleSettings {
        point: [0.0; 3],
        axis: [0.0, 0.0, 2.0],
        grip: [0.1, 0.0, 0.0],
        reach_m: 0.02,
        width_m: 0.02,
        inertia_kg_m2: 0.01,
        viscous: 0.0,
        coulomb: 0.0,
        stiffness: 0.16,
        stops_rad: [-2.0, 2.0],
        hold_stiffness: 5e3,
        hold_rotational_stiffness: 20.0,
    }
}

/// A box of 0.5 kg, 4 cm wide.
fn brick(gravity: f64) -> RigidBodySettings {
    let (position, quat_wxyz) = ([0.0; 3], UPRIGHT);
    RigidBodySettings { mass_kg: 0.5, half_extents: [0.02, 0.02, 0.03], position, quat_wxyz, gravity }
}

fn hole(radius: f64, chamfer_m: f64) -> HoleSettings {
    let (entrance, axis) = ([0.0; 3], [0.0, 0.0, 3.0]);
    HoleSettings { entrance, axis, radius, depth: 0.05, chamfer_m, contact: contact(2e4, 20.0, 0.0) }
}

fn tool((arm, tool): &Made, world: &ToolWorldSettings) -> SimulatedTool {
    let mut tool = SimulatedTool::new(arm, tool, world, 0).unwrap();
    tool.start(0);
    tool
}

fn nothing() -> ToolWorldSettings {
    ToolWorldSettings::default()
}

/// A tool with a mass that keeps it at rest, and a body between its jaws.
fn gripping(gravity: f64) -> SimulatedTool {
    let (arm, settings) = free([1e3; 3], vec![[0.0; 3]]);
    let world = ToolWorldSettings { bodies: vec![brick(gravity)], ..nothing() };
    tool(&(ArmSettings { mass_kg: 1e6, ..arm }, settings), &world)
}

fn spin(tool: &mut SimulatedTool, v: [f64; 3], w: [f64; 3]) {
    let moments = tool.world.inertia.moments;
    let one = &mut tool.motion.tool;
    one.velocity = V::from(v);
    one.momentum = one.orientation * moments.component_mul(&(one.orientation.inverse() * V::from(w)));
}

fn turn(axis: V, angle: f64) -> [f64; 4] {
    let q = UnitQuaternion::from_scaled_axis(axis.normalize() * angle);
    [q.w, q.i, q.j, q.k]
}

#[test]
fn a_free_tool_keeps_energy_and_momentum() {
    let mut tool = tool(&free([1e-3, 2e-3, 2.5e-3], vec![[0.0; 3]]), &nothing());
    spin(&mut tool, [0.3, -0.2, 0.1], [0.1, 2.0, 1.0]);
    let (energy, start) = (tool.kinetic_energy_j(), tool.motion.tool);
    for tick in 1..=100_000 {
        tool.read(tick * MS);
    }
    let end = &tool.motion.tool;
    assert!(
        (tool.kinetic_energy_j() / energy - 1.0).abs() < 1e-9,
        "{}",
        tool.kinetic_energy_j() / energy - 1.0
    );
    assert_eq!((end.velocity, end.momentum), (start.velocity, start.momentum));
    assert!((end.position - start.velocity * 100.0).norm() < 1e-9);
    assert!((end.orientation.norm() - 1.0).abs() < 1e-15);
}

/// `e(t) = (1 + p t) exp(-p t)`
#[test]
fn the_servo_takes_a_step_as_a_critically_damped_system_does() {
    let mut tool = tool(&servoed(vec![[0.0; 3]]), &nothing());
    let (step, angle) = (V::new(0.1, -0.05, 0.02), V::new(0.3, 0.4, -0.5));
    tool.write_rotation(&UnitQuaternion::from_scaled_axis(angle), &V::zeros());
    tool.write(&step, &V::zeros());
    for tick in 1..=200 {
        let (sample, t) = (tool.read(tick * MS), tick as f64 * 1e-3);
        let share = |p: f64| 1.0 - (1.0 + p * t) * (-p * t).exp();
        // Order 4 with p h = 0.06: (p h)^4 / 120 = 1.1e-7 of the step.
        assert!((sample.position - step * share(50.0)).norm() < 1e-7, "{tick}");
        assert!((sample.orientation.scaled_axis() - angle * share(60.0)).norm() < 2e-7, "{tick}");
    }
}

#[test]
fn the_set_pose_keeps_within_its_speeds() {
    let (arm, settings) = servoed(vec![[0.0; 3]]);
    let bounded = (
        ArmSettings { max_speed: Some(0.1), ..arm },
        ToolSettings { max_angular_speed: Some(0.5), ..settings },
    );
    let mut tool = tool(&bounded, &nothing());
    let (mut fastest, mut turning) = (0.0_f64, 0.0_f64);
    for tick in 1..=1000 {
        let sample = tool.read(tick * MS);
        tool.write_rotation(&UnitQuaternion::from_scaled_axis(V::x()), &V::zeros());
        tool.write(&V::new(0.3, 0.4, 0.0), &V::zeros());
        (fastest, turning) =
            (fastest.max(sample.velocity.norm()), turning.max(sample.angular_velocity.norm()));
    }
    // The set pose advances in steps of a tick: a ripple of (p h)^2 / 8 = 4.5e-4 of the speed.
    assert!((fastest / 0.1 - 1.0).abs() < 1e-3 && (turning / 0.5 - 1.0).abs() < 1e-3, "{fastest} {turning}");
    let (rest, turned) = tool.stop();
    assert_eq!(tool.stop(), (rest, turned));
    let sample = tool.read(3000 * MS);
    assert!((sample.position - rest).norm() < 1e-9 && sample.orientation.angle_to(&turned) < 1e-7);
}

/// `I phi'' = tau(t)` and `m x'' = f(t)` of a tool under pushes only, which may start, end their rise and stop anywhere
/// in a tick. Both are cubic in time between these instants, and order 4 integrates a cubic to rounding.
#[test]
fn pushes_and_torques_begin_and_end_by_the_closed_form() {
    for (at_s, rise_s, duration_s, started_ns) in [
        (0.01, 0.0, 0.02, 0),
        (0.0104, 0.0, 0.02, 0),
        (0.0003, 0.0, 0.0004, 300_001),
        (0.0, 0.0, 0.0173, 3_700_000),
        (0.002, 0.004, 0.02, 0),
        (0.0021, 0.0045, 0.0052, 1_234_567),
        (0.0102, 0.0003, 0.0005, 0),
    ] {
        for shape in [PushKind::Ramp, PushKind::Recorded] {
            // The recorded push is the same ramp.
            let (time_s, rows) = (vec![0.0, rise_s], |most: V| vec![V::zeros(), most]);
            if shape == PushKind::Recorded && rise_s == 0.0 {
                continue;
            }
            let one = |most: V| {
                let recorded = Some(SeriesSettings { time_s: time_s.clone(), values: rows(most) });
                PusherSettings { shape, at_s, duration_s, rise_s, recorded, force_n: most, ..push([0.0; 3]) }
            };
            let (torques, pushers) = (vec![one(V::z() * 0.1)], vec![one(V::y() * 0.3)]);
            let (arm, settings) = free([0.02; 3], vec![[0.0; 3]]);
            let world = ToolWorldSettings { pushers, torques, ..nothing() };
            let mut tool = SimulatedTool::new(&arm, &settings, &world, 0).unwrap();
            tool.start(started_ns);
            // Angle and rate for a unit acceleration.
            let rising = |s: f64| [s.powi(3) / (6.0 * rise_s), s * s / (2.0 * rise_s)];
            let goes_on = |[angle, rate]: [f64; 2], s: f64, push: f64| {
                [angle + rate * s + 0.5 * push * s * s, rate + push * s]
            };
            for tick in 1..=60 {
                let sample = tool.read(tick * MS);
                let since = ((tick * MS) as f64 * 1e-9 - started_ns as f64 * 1e-9 - at_s).max(0.0);
                let lasting = since.min(duration_s);
                let risen = if rise_s == 0.0 { [0.0; 2] } else { rising(lasting.min(rise_s)) };
                let [share, _] =
                    goes_on(goes_on(risen, (lasting - rise_s).max(0.0), 1.0), since - lasting, 0.0);
                let angle = sample.orientation.scaled_axis().z - 5.0 * share;
                let place = sample.position.y - 0.6 * share;
                assert!(
                    angle.abs() < 1e-15 && place.abs() < 1e-15,
                    "{at_s} {rise_s} {tick}: {angle:e} {place:e}"
                );
            }
        }
    }
}

/// A spring whose other end starts to move at a velocity u anywhere in a tick: `x = u (s - sin(o s) / o)` after s.
#[test]
fn a_spring_sets_off_by_the_closed_form() {
    let (rate, speed) = (50.0, 0.1);
    for from_s in [0.01, 0.0104, 0.00099] {
        let motion = ObjectMotionSettings {
            velocity: V::x() * speed,
            from_s,
            until_s: 1.0,
            amplitude: V::zeros(),
            frequency_hz: 0.0,
        };
        let object = ObjectSettings {
            shape: ShapeSettings::Spring { anchor: V::zeros() },
            contact: contact(0.5 * rate * rate, 0.0, 0.0),
            motion: Some(motion),
            body: None,
        };
        let world = ToolWorldSettings { objects: vec![object], ..nothing() };
        let mut tool = tool(&free([1e-3; 3], vec![[0.0; 3]]), &world);
        for tick in 1..=100 {
            let (sample, since) = (tool.read(tick * MS), (tick as f64 * 1e-3 - from_s).max(0.0));
            let off = sample.position.x - speed * (since - (rate * since).sin() / rate);
            // Order 4 with z = 0.05: z^4 / 120 of the swing per rad of phase.
            assert!(off.abs() < 5.2e-8 * speed / rate * (rate * since + 0.05), "{from_s} {tick}: {off:e}");
        }
    }
}

/// `theta = (theta_0 -+ c/k) cos(w t) +- c/k` between reversals. Each half swing loses `2 c / k`, until
/// `k |theta| <= c`.
#[test]
fn a_handle_on_a_spring_swings_and_sticks_by_the_closed_form() {
    // Five half swings of pi / 4 s, or one.
    for (coulomb, until) in [(0.0, 3926), (0.016, 3926), (0.07, 785)] {
        let world = ToolWorldSettings { handles: vec![HandleSettings { coulomb, ..handle() }], ..nothing() };
        let mut tool = tool(&free([1e-3; 3], vec![[0.0; 3]]), &world);
        assert!(!tool.holds());
        tool.motion.handles[0] = [1.0, 0.0];
        let (rate, dead) = (4.0_f64, coulomb / 0.16);
        for n in 0..until {
            tool.read(n * MS);
            let half = (rate * n as f64 * 1e-3 / std::f64::consts::PI).floor();
            let sign = if half % 2.0 == 0.0 { 1.0 } else { -1.0 };
            let phase = rate * n as f64 * 1e-3 - half * std::f64::consts::PI;
            let peak = 1.0 - 2.0 * dead * half;
            let expected = sign * ((peak - dead) * phase.cos() + dead);
            // Below 0.01 rad/s friction is reduced. A reversal lacks 0.005 c / (k theta - c) rad/s, divided by the rate
            // for the angle; c = k theta - c at the last one.
            assert!((tool.handle(0).unwrap()[0] - expected).abs() < 0.005 / rate, "{coulomb} {n}");
        }
        if until == 785 {
            // It creeps from -0.125 rad: k theta = -c theta' / (0.01 rad/s).
            let expected = -0.125 * (-0.16 * 0.01 / coulomb * (3.0 - std::f64::consts::FRAC_PI_4)).exp();
            tool.read(3000 * MS);
            assert!((tool.handle(0).unwrap()[0] - expected).abs() < 5e-4);
        }
    }
}

/// A constant torque presses it against a stop: `(theta - stop) 500 = tau - k theta`. The stop never pulls.
#[test]
fn a_handle_stays_within_its_stops() {
    let world =
        ToolWorldSettings { handles: vec![HandleSettings { stiffness: 0.0, ..handle() }], ..nothing() };
    let mut tool = tool(&free([1e-3; 3], vec![[0.0; 3]]), &world);
    for sign in [1.0, -1.0] {
        tool.motion.handles[0] = [1.9 * sign, 3.0 * sign];
        let (mut furthest, mut now_ns) = (0.0_f64, tool.now_ns);
        for _ in 0..100 {
            now_ns += MS;
            tool.read(now_ns);
            furthest = furthest.max(tool.handle(0).unwrap()[0] * sign);
        }
        // Critically damped from speed v: deepest at v / (e w) = 4.9e-3 rad, and the handle is released without
        // rebound. In the 1 ms step of the impact its damper, 2 p v in rad/s^2, may be missing: p v h^2 = 6.7e-4 rad.
        let rate = (500.0_f64 / 0.01).sqrt();
        let late = rate * 3.0 * 1e-6;
        let deepest = 3.0 / (1_f64.exp() * rate);
        assert!((furthest - 2.0 - deepest).abs() < late, "{furthest} {deepest}");
        let [angle, rate] = tool.handle(0).unwrap();
        assert!(
            angle * sign <= 2.0 + deepest + late && rate * sign <= 0.0 && rate.abs() < 3.0,
            "{angle} {rate}"
        );
    }
}

/// A tool that holds a handle turns it; at rest the torque of the tool is `k theta`.
#[test]
fn a_held_handle_turns_with_the_tool() {
    let world = ToolWorldSettings { handles: vec![handle()], ..nothing() };
    let mut tool = tool(&at(servoed(vec![[0.0; 3]]), [0.1, 0.0, 0.0], UPRIGHT), &world);
    assert!(tool.holds());
    let to = UnitQuaternion::from_scaled_axis(V::z());
    tool.write_rotation(&to, &V::zeros());
    tool.write(&(to * V::x() * 0.1), &V::zeros());
    let sample = tool.read(2000 * MS);
    let [angle, _] = tool.handle(0).unwrap();
    // The servo yields k / (K r^2 + k_r) = 0.16 / 16.1 rad, and the hold yields a little.
    assert!((0.985..0.991).contains(&angle), "{angle}");
    let about_axis = (sample.position.cross(&sample.force) + sample.torque).z;
    assert!((about_axis + 0.16 * angle).abs() < 1e-9, "{about_axis} {angle}");
}

/// Depths `d_i = -z - (R p_i)_z`; force `K d_i` at each.
#[test]
fn a_tilted_tool_on_a_plane_has_the_moment_of_its_contacts() {
    let points = vec![[0.05, 0.03, 0.0], [-0.05, 0.03, 0.0], [0.05, -0.03, 0.0], [-0.05, -0.03, 0.0]];
    let world = ToolWorldSettings { objects: vec![ground(2e4, 40.0, 0.0)], ..nothing() };
    for touching in [points.clone(), points[..1].to_vec()] {
        let quat_wxyz = turn(V::new(1.0, 2.0, 0.5), 0.02);
        let mut tool = tool(&at(servoed(touching.clone()), [0.0, 0.0, -1e-3], quat_wxyz), &world);
        let sample = tool.read(3000 * MS);
        let (mut force, mut torque) = (V::zeros(), V::zeros());
        for point in touching {
            let arm = sample.orientation * V::from(point);
            let one = V::z() * (2e4 * -(sample.position + arm).z).max(0.0);
            force += one;
            torque += arm.cross(&one);
        }
        assert!(tool.touches() && force.z > 0.1 && torque.norm() > 1e-3);
        assert!((sample.force - force).norm() < 1e-6 && (sample.torque - torque).norm() < 1e-7);
        // At rest the servo balances the contact force.
        assert!((sample.force.z - 1250.0 * (sample.position.z + 1e-3)).abs() < 1e-6);
        let back = settings::orientation("", quat_wxyz).unwrap();
        let turned = (back * sample.orientation.inverse()).scaled_axis();
        assert!((sample.torque + turned * 3.6).norm() < 1e-6);
    }
}

/// `v' = -mu g`
#[test]
fn a_sliding_box_is_slowed_by_friction() {
    let lying = RigidBodySettings { position: [0.0, 0.0, 0.03 - 6.1e-5], ..brick(9.81) };
    let world = ToolWorldSettings { objects: vec![ground(2e4, 60.0, 0.3)], bodies: vec![lying], ..nothing() };
    let mut tool = tool(&at(free([1e-3; 3], vec![[0.0; 3]]), [1.0; 3], UPRIGHT), &world);
    tool.read(100 * MS);
    tool.motion.bodies[0].velocity.x = 1.0;
    tool.read(200 * MS);
    // The box may rock a little at the start; 2 % of 0.294 m/s.
    let v = tool.motion.bodies[0].velocity;
    assert!((v.x - (1.0 - 0.3 * 9.81 * 0.1)).abs() < 6e-3, "{v}");
    tool.read(700 * MS);
    assert!(tool.motion.bodies[0].velocity.norm() < 1e-6);
}

#[test]
fn held_body_slips_at_the_friction_cone() {
    for (share, slips) in [(0.95, false), (1.05, true)] {
        let mut tool = gripping(9.81);
        let meet = tool.between_jaws().unwrap();
        assert!((meet - 0.5).abs() < 1e-12 && !tool.holds());
        let mut speeds = [0.0; 2];
        for tick in 1..=200 {
            // m g = 2 mu F share
            tool.grip(meet, 0.5 * 9.81 / (2.0 * 0.5 * share));
            tool.read(tick * MS);
            speeds = if tick == 100 { [tool.motion.bodies[0].velocity.norm(); 2] } else { speeds };
        }
        speeds[1] = tool.motion.bodies[0].velocity.norm();
        // The transient of the sudden load has ended after 100 ms.
        let expected = if slips { (1.0 - 1.0 / share) * 9.81 * 0.1 } else { 0.0 };
        assert!((speeds[1] - speeds[0] - expected).abs() < 1e-3, "{share}: {speeds:?} {expected}");
        assert!(tool.holds() && (slips || speeds[1] < 1e-3), "{speeds:?}");
    }
}

/// `v' = -2 mu F / m` across the closing direction, `w' = -2 mu F r / I`.
#[test]
fn a_slipping_body_is_slowed_by_the_jaws_alone() {
    let mut tool = gripping(0.0);
    tool.grip(0.5, 1.0);
    let moment = tool.world.bodies[0].inertia.moments.z;
    tool.motion.bodies[0].velocity.y = 1.0;
    tool.motion.bodies[0].momentum.z = moment * 20.0;
    // Before the body has slipped out of the jaws.
    tool.read(20 * MS);
    let body = &tool.motion.bodies[0];
    let (v, w) = (1.0 - 1.0 / 0.5 * 0.02, 20.0 - 0.01 / moment * 0.02);
    assert!((body.velocity.y - v).abs() < 0.01 * (1.0 - v), "{} {v}", body.velocity);
    assert!((body.momentum.z / moment - w).abs() < 0.01 * (20.0 - w), "{} {w}", body.momentum.z / moment);
}

#[test]
fn a_held_body_hangs_with_its_weight_and_moment() {
    let body = RigidBodySettings { position: [0.0, 0.0, -0.02], ..brick(9.81) };
    let world = ToolWorldSettings { bodies: vec![body], ..nothing() };
    let mut tool = tool(&at(servoed(vec![[0.0; 3]]), [0.0, 0.01, 0.0], UPRIGHT), &world);
    tool.grip(0.5, 60.0);
    let sample = tool.read(3000 * MS);
    let arm = tool.body(0).unwrap().0 - sample.position;
    let weight = V::z() * (-0.5 * 9.81);
    assert!((sample.force - weight).norm() < 1e-5, "{}", sample.force);
    assert!((sample.torque - arm.cross(&weight)).norm() < 1e-6 && arm.y < -5e-3, "{arm}");
}

#[test]
fn gripped_forces_cancel() {
    let world = ToolWorldSettings { bodies: vec![brick(0.0)], ..nothing() };
    let mut tool = tool(&free([1e-3; 3], vec![[0.0; 3]]), &world);
    tool.grip(0.5, 30.0);
    spin(&mut tool, [0.5, -1.0, 0.3], [1.0, 2.0, -3.0]);
    let momenta = |tool: &SimulatedTool| {
        let (own, body) = (&tool.motion.tool, &tool.motion.bodies[0]);
        let about = |one: &Rigid| one.momentum + one.position.cross(&one.velocity) * 0.5;
        [(own.velocity + body.velocity) * 0.5, about(own) + about(body)]
    };
    let (before, energy) = (momenta(&tool), tool.kinetic_energy_j());
    for tick in 1..=1000 {
        tool.read(tick * MS);
        tool.grip(0.5, 30.0);
    }
    let after = momenta(&tool);
    assert!((after[0] - before[0]).norm() < 1e-12, "{before:?} {after:?}");
    // Position and velocity are integrated to order 4, with 200 rad/s h = 0.2: (0.2)^5 / 120 of each oscillating step.
    assert!((after[1] - before[1]).norm() < 1e-5, "{before:?} {after:?}");
    assert!(tool.motion.bodies[0].velocity.norm() > 0.1 && tool.kinetic_energy_j() < energy);
}

#[test]
fn a_peg_in_a_hole_is_loaded_beyond_its_clearance() {
    let ring = |z: f64| [[0.01, 0.0, z], [-0.01, 0.0, z], [0.0, 0.01, z], [0.0, -0.01, z]];
    let points = [ring(0.0), ring(-0.02)].concat();
    let world = ToolWorldSettings { holes: vec![hole(0.0101, 0.0)], ..nothing() };
    let measured = |x: f64, tilt: f64| {
        tool(&at(servoed(points.clone()), [x, 0.0, -0.015], turn(V::y(), tilt)), &world).read(0)
    };
    for (x, expected) in [(0.0, 0.0), (0.9e-4, 0.0), (3e-4, -2e4 * 2e-4 * 2.0)] {
        let sample = measured(x, 0.0);
        // Points across the offset lie at most 5 um further out: x² / (2 r).
        assert!((sample.force.x - expected).abs() < 1e-9 && sample.force.yz().norm() < 1e-9, "{sample:?}");
        assert!((sample.torque.y - expected * -0.01).abs() < 1e-10);
    }
    // Tilted by theta about y: (r, 0, 0) stays inside, (-r, 0, -L) goes beyond by r cos + L sin - R.
    let theta = 5_f64.to_radians();
    let beyond = 0.01 * theta.cos() + 0.02 * theta.sin() - 0.0101;
    // (0, +-r, -L) lie (L sin, r) from the axis.
    let swing = 0.02 * theta.sin();
    let aside = swing.hypot(0.01);
    let expected = 2e4 * (beyond + 2.0 * (aside - 0.0101) * swing / aside);
    let sample = measured(0.0, theta);
    assert!((sample.force.x - expected).abs() < 1e-9, "{sample:?} {expected}");
}

/// The two corners of a tilted peg touch opposite walls: moment `K d (L cos - 2 r sin)`, no force.
#[test]
fn a_tilted_peg_has_the_moment_of_two_points() {
    let (r, l, theta) = (0.01, 0.02, 5_f64.to_radians());
    let points = vec![[r, 0.0, l], [-r, 0.0, l], [r, 0.0, -l], [-r, 0.0, -l]];
    let world = ToolWorldSettings { holes: vec![hole(r + 1e-4, 0.0)], ..nothing() };
    let mut tool = tool(&at(servoed(points), [0.0, 0.0, -0.025], turn(V::y(), theta)), &world);
    let sample = tool.read(0);
    let depth = r * theta.cos() + l * theta.sin() - r - 1e-4;
    let arm = l * theta.cos() - r * theta.sin();
    let expected = -2.0 * 2e4 * depth * arm;
    assert!(sample.force.norm() < 1e-9, "{sample:?}");
    assert!((sample.torque - V::y() * expected).norm() < 1e-9, "{} {expected}", sample.torque);
    // The state stays finite while the servo presses.
    let sample = tool.read(1000 * MS);
    assert!(sample.velocity.norm() < 1e-6 && sample.angular_velocity.norm() < 1e-6, "{sample:?}");
    tool.world(&mut |name, depths| assert!(name == "hole_depth" && (0.03..0.05).contains(&depths[0])));
}

#[test]
fn a_tool_without_points_is_not_in_the_hole() {
    let world = ToolWorldSettings { holes: vec![hole(0.01, 0.0)], ..nothing() };
    let tool = tool(&servoed(vec![]), &world);
    tool.world(&mut |_, depths| assert_eq!(depths, [0.0]));
}

/// `F = K d (inward + axis) / sqrt 2` with `d = (rho - r - h + s) / sqrt 2`.
#[test]
fn a_chamfer_pushes_along_45_degrees() {
    let world = ToolWorldSettings { holes: vec![hole(0.01, 2e-3)], ..nothing() };
    for (s, expected) in [(1.5e-3, 2e4 * 0.5e-3 / 2.0), (0.9e-3, 0.0)] {
        let sample = tool(&at(servoed(vec![[0.0; 3]]), [0.011, 0.0, -s], UPRIGHT), &world).read(0);
        assert!((sample.force - V::new(-expected, 0.0, expected)).norm() < 1e-9, "{sample:?}");
    }
}

#[test]
fn torques_and_pushers_begin_once() {
    let world = ToolWorldSettings {
        pushers: vec![push([1.0, 0.0, 0.0])],
        torques: vec![push([0.0, 1e-3, 0.0])],
        ..nothing()
    };
    let (arm, settings) = free([1e-3; 3], vec![[0.0; 3]]);
    let mut tool = SimulatedTool::new(&arm, &settings, &world, 5 * MS).unwrap();
    tool.begin(10 * MS);
    assert_eq!(tool.read(20 * MS).velocity, V::zeros());
    tool.start(20 * MS);
    tool.start(90 * MS);
    let sample = tool.read(120 * MS);
    assert!((sample.velocity - V::x() * 0.2).norm() < 3e-9, "{}", sample.velocity);
    assert!((sample.angular_velocity - V::y() * 0.1).norm() < 2e-9);
}

#[test]
fn nan_and_infinity_change_nothing() {
    let world = ToolWorldSettings { bodies: vec![brick(0.0)], ..nothing() };
    let mut one = tool(&servoed(vec![[0.0; 3]]), &world);
    one.grip(0.5, 30.0);
    let before = one.clone();
    let (zero, nan) = (V::zeros(), V::new(0.0, f64::NAN, 0.0));
    let turned = UnitQuaternion::from_scaled_axis(V::x());
    one.write_rotation(&UnitQuaternion::new_unchecked(turned.into_inner() * f64::NAN), &zero);
    one.write(&nan, &zero);
    one.grip(f64::NAN, 1.0);
    one.grip(0.0, f64::INFINITY);
    assert_eq!(one, before);
    // An invalid velocity counts as zero.
    one.write_rotation(&turned, &nan);
    one.write(&V::x(), &nan);
    let mut other = before.clone();
    other.write_rotation(&turned, &zero);
    other.write(&V::x(), &zero);
    assert_eq!(one, other);
    one.grip(0.0, 0.0);
    assert!(!one.holds() && before.holds());
}

#[test]
fn invalid_settings_are_refused() {
    let good = || servoed(vec![[0.0; 3]]);
    let refused = |name: &str, (arm, tool): Made, world: ToolWorldSettings| {
        let error = SimulatedTool::new(&arm, &tool, &world, 0).unwrap_err();
        assert!(error.to_string().contains(name), "{name}: {error}");
    };
    let of_arm = |name: &str, change: fn(&mut ArmSettings<3>)| {
        let mut made = good();
        change(&mut made.0);
        refused(name, made, nothing());
    };
    of_arm("control", |arm| arm.control = ControlKind::Position);
    of_arm("mass_kg", |arm| arm.mass_kg = 0.0);
    of_arm("stiffness", |arm| arm.stiffness = f64::NAN);
    of_arm("rate", |arm| arm.damping = 1e6);
    of_arm("position", |arm| arm.position.x = f64::INFINITY);
    let of_tool = |name: &str, change: fn(&mut ToolSettings)| {
        let mut made = good();
        change(&mut made.1);
        refused(name, made, nothing());
    };
    of_tool("inertia", |tool| tool.inertia_kg_m2.y = 0.0);
    of_tool("rotational_stiffness", |tool| tool.rotational_stiffness = -1.0);
    of_tool("rotational_damping", |tool| tool.rotational_damping = f64::NAN);
    of_tool("max_angular_speed", |tool| tool.max_angular_speed = Some(0.0));
    of_tool("quat_wxyz", |tool| tool.quat_wxyz = [1.0, 0.1, 0.0, 0.0]);
    of_tool("points", |tool| tool.points[0][1] = f64::NAN);
    of_tool("jaw_width", |tool| tool.jaw_width_m = -1.0);
    of_tool("jaw_radius", |tool| tool.jaw_radius_m = 0.0);
    let of_world = |name: &str, world: ToolWorldSettings| refused(name, good(), world);
    of_world("rate", ToolWorldSettings { objects: vec![ground(1e10, 0.0, 0.0)], ..nothing() });
    of_world("hole radius", ToolWorldSettings { holes: vec![hole(0.0, 0.0)], ..nothing() });
    of_world("hole chamfer", ToolWorldSettings { holes: vec![hole(0.01, -1.0)], ..nothing() });
    let crossed = HandleSettings { stops_rad: [1.0, -1.0], ..handle() };
    of_world("stops_rad", ToolWorldSettings { handles: vec![crossed], ..nothing() });
    let pointless = HandleSettings { axis: [0.0; 3], ..handle() };
    of_world("handle axis", ToolWorldSettings { handles: vec![pointless], ..nothing() });
    let light = RigidBodySettings { mass_kg: -1.0, ..brick(0.0) };
    of_world("body mass", ToolWorldSettings { bodies: vec![light], ..nothing() });
    let flat = RigidBodySettings { half_extents: [0.02, 0.0, 0.02], ..brick(0.0) };
    of_world("half_extents", ToolWorldSettings { bodies: vec![flat], ..nothing() });
}

fn vector(size: f64) -> impl Strategy<Value = V> {
    prop::array::uniform3(-size..size).prop_map(V::from)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    /// Rotating the world and the tool rotates the motion.
    #[test]
    fn no_frame_is_preferred(axis in vector(3.0), v in vector(0.3), w in vector(5.0)) {
        let c = UnitQuaternion::from_scaled_axis(axis);
        let run = |c: &UnitQuaternion<f64>| {
            let shape = ShapeSettings::Plane { point: V::zeros(), normal: c * V::z() };
            let object = ObjectSettings { shape, ..ground(2e3, 5.0, 0.3) };
            let world = ToolWorldSettings { objects: vec![object], ..nothing() };
            let points = vec![[0.03, 0.0, -0.01], [-0.02, 0.02, -0.01], [-0.02, -0.02, -0.01]];
            let mut tool = tool(&at(servoed(points), [0.0; 3], [c.w, c.i, c.j, c.k]), &world);
            spin(&mut tool, (c * v).into(), (c * w).into());
            tool.read(30 * MS)
        };
        let (one, turned) = (run(&UnitQuaternion::identity()), run(&c));
        prop_assert!((turned.position - c * one.position).norm() < 1e-9);
        prop_assert!((turned.force - c * one.force).norm() < 1e-5);
        prop_assert!((turned.torque - c * one.torque).norm() < 1e-6);
        prop_assert!((c * one.orientation).angle_to(&turned.orientation) < 1e-7);
    }

    #[test]
    fn nobody_who_does_not_push_makes_energy(v in vector(0.3), w in vector(5.0), friction in 0.0..1.0_f64) {
        let thrown = RigidBodySettings { position: [0.3, 0.0, 0.05], ..brick(0.0) };
        let world = ToolWorldSettings {
            objects: vec![ground(2e3, 20.0, friction)],
            bodies: vec![thrown],
            ..nothing()
        };
        let points = vec![[0.03, 0.0, -0.01], [-0.02, 0.02, -0.01], [-0.02, -0.02, -0.01]];
        let mut tool = tool(&at(free([1e-3; 3], points), [0.0, 0.0, 0.02], UPRIGHT), &world);
        spin(&mut tool, v.into(), w.into());
        tool.motion.bodies[0].velocity = v;
        let most = tool.kinetic_energy_j();
        for tick in 1..=300 {
            tool.read(tick * MS);
            let now = tool.kinetic_energy_j();
            // Only contact springs exchange energy; a contact that starts within a step is detected late.
            prop_assert!(now <= most * (1.0 + 1e-3), "{tick}: {most} {now}");
        }
    }
}
