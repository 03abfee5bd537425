use super::*;
use crate::coupling::drawn::{direction, orientation, vector};
use nalgebra::Matrix3;
use proptest::prelude::*;
use std::f64::consts::SQRT_2;

fn exp(vector: Vector3<f64>) -> UnitQuaternion<f64> {
    UnitQuaternion::from_scaled_axis(vector)
}

fn scaled(scale: f64) -> RotationCoupling {
    RotationCoupling::new(scale, 1.0).unwrap()
}

fn wxyz(of: &UnitQuaternion<f64>) -> [f64; 4] {
    let [x, y, z, w] = of.coords.into();
    [w, x, y, z]
}

/// Engage at two orientations and lead the hand about an axis to an angle, in steps of less than 0.1 rad.
fn led(
    mut coupling: RotationCoupling,
    [master, slave]: [UnitQuaternion<f64>; 2],
    axis: Vector3<f64>,
    angle: f64,
) -> (RotationCoupling, UnitQuaternion<f64>) {
    coupling.commanded_orientation(&master, &slave);
    let steps = (angle.abs() / 0.1).ceil().max(1.0);
    let mut step = 1.0;
    let mut command = slave;
    while step <= steps {
        command = coupling.commanded_orientation(&(exp(axis * (angle * step / steps)) * master), &slave);
        step += 1.0;
    }
    (coupling, command)
}

fn scale() -> impl Strategy<Value = f64> {
    prop_oneof![Just(1.0), Just(0.5), Just(2.0), 0.1..3.0f64]
}

fn lock() -> impl Strategy<Value = RotationLock> {
    prop_oneof![
        Just(RotationLock::Free),
        direction().prop_map(RotationLock::OnlyAbout),
        Just(RotationLock::Locked)
    ]
}

#[test]
fn engages_where_both_are_and_goes_on_from_there() {
    let mut coupling = RotationCoupling::new(0.5, 2.0).unwrap();
    let (hand, slave) = (exp(Vector3::new(0.3, 0.1, -0.7)), exp(Vector3::new(-1.0, 2.0, 0.4)));
    assert_eq!(coupling.commanded_orientation(&hand, &slave), slave);
    let turned = coupling.commanded_orientation(&(exp(Vector3::y() * 0.8) * hand), &hand);
    assert!(turned.angle_to(&(exp(Vector3::y() * 0.4) * slave)) < 1e-15);
    assert_eq!(coupling.rendered_torque(&Vector3::new(1.0, -2.0, 0.5)), Vector3::new(2.0, -4.0, 1.0));
    coupling.disengage();
    assert_eq!(coupling.commanded_orientation(&exp(Vector3::x()), &turned), turned);
    assert_eq!(coupling.commanded_orientation(&exp(Vector3::x()), &hand), turned);
}

#[test]
fn a_change_of_scale_frame_or_lock_moves_nothing_by_itself() {
    let hand = exp(Vector3::new(0.5, -0.2, 0.9));
    let (mut coupling, mut command) = led(scaled(0.7), [hand; 2], Vector3::z(), 1.0);
    let hand = exp(Vector3::z()) * hand;
    let changes: [fn(&mut RotationCoupling); 4] = [
        |coupling| coupling.set_rotation_scale(2.0, 0).unwrap(),
        |coupling| coupling.set_frame([0.6, 0.8, 0.0, 0.0], 0).unwrap(),
        |coupling| coupling.set_lock(RotationLock::only_about([0.0, 0.0, 1.0]).unwrap()),
        |coupling| coupling.set_torque_scale(3.0, 0).unwrap(),
    ];
    for change in changes {
        change(&mut coupling);
        let seen = coupling.commanded_orientation(&hand, &command);
        assert_eq!(seen, command);
        command = seen;
    }
    // C turns y to z: a turn of the hand about y turns the slave about z by twice as much.
    let c = exp(Vector3::x() * (2.0 * 0.8_f64.atan2(0.6)));
    let alpha = 0.2;
    let by = c.inverse() * Vector3::z() * alpha;
    let seen = coupling.commanded_orientation(&(exp(by) * hand), &command);
    assert!(seen.angle_to(&(exp(Vector3::z() * (2.0 * alpha)) * command)) < 1e-14);
    let torque = coupling.rendered_torque(&Vector3::new(5.0, 5.0, 1.0));
    assert!((torque - c.inverse() * Vector3::z() * 3.0).norm() < 1e-14);
}

/// A hand that turns evenly, far from its anchor and across phi. Scales and frames that fade over n ticks
/// move nothing by themselves; at a tick they change the velocity by at most their share.
#[test]
fn changes_of_a_rotation_fade_without_a_step() {
    type Change = fn(&mut RotationCoupling, f64);
    const TICKS: u32 = 200;
    let rate = 1e-3;
    let about = Vector3::new(0.2, 1.0, -0.5).normalize();
    let axis = RotationLock::only_about([0.0, 0.6, 0.8]).unwrap();
    let scale: Change = |coupling, to| coupling.set_rotation_scale(to, TICKS).unwrap();
    let frame: Change = |coupling, _| coupling.set_frame([0.6, 0.0, 0.8, 0.0], TICKS).unwrap();
    for lock in [RotationLock::Free, axis] {
        for (from, to, change) in [
            (1.0, 2.0, scale),
            (2.0, 1.0, scale),
            (0.7, 1.4, scale),
            (2.0, 0.5, scale),
            (1.0, 1.0, frame),
            (0.5, 0.5, frame),
        ] {
            for moves in [false, true] {
                let mut coupling = scaled(from);
                coupling.set_lock(lock);
                let mut hand = exp(Vector3::new(0.5, -0.2, 0.9));
                let mut command = coupling.commanded_orientation(&hand, &exp(Vector3::x()));
                // Turn by 1.2 rad first.
                for _ in 0..1200 {
                    hand = exp(Vector3::z() * 1e-3) * hand;
                    command = coupling.commanded_orientation(&hand, &command);
                }
                let mut before = None::<Vector3<f64>>;
                for tick in 0..3 * TICKS {
                    if tick == TICKS / 2 {
                        change(&mut coupling, to);
                    }
                    // A second change starts while the first is in progress.
                    if tick == TICKS && from != to {
                        change(&mut coupling, from.midpoint(to));
                    }
                    hand = if moves { exp(about * rate) * hand } else { hand };
                    let next = coupling.commanded_orientation(&hand, &command);
                    let step = (next * command.inverse()).scaled_axis();
                    command = next;
                    let Some(before) = before.replace(step) else { continue };
                    let most = if moves { 3.0 * from.max(to) * rate / f64::from(TICKS) } else { 1e-14 };
                    let off = (step - before).norm();
                    assert!(
                        off <= most,
                        "{lock:?} {from} to {to}, moves {moves}, at {tick}: {off:e}, must be {most:e}"
                    );
                }
            }
        }
    }
}

/// Both bodies turn about axes that C maps to one another, the slave `lambda_r` times as fast. This is a
/// screw: the slave's tool point moves on a helix, as its shifted twist says.
#[test]
fn a_screw_of_the_hand_is_a_screw_of_the_slave() {
    for (scale, speed) in [(1.0, 2.0), (0.5, 6.0), (2.5, -1.0)] {
        let (frame, master, slave) =
            (exp(Vector3::new(0.3, 0.9, -0.4)), exp(Vector3::x()), exp(Vector3::new(0.0, 2.0, 1.0)));
        let axis = Vector3::new(0.36, 0.48, -0.8);
        let mut coupling = scaled(scale);
        coupling.set_frame(wxyz(&frame), 0).unwrap();
        coupling.commanded_orientation(&master, &slave);
        let tip = Vector3::new(0.1, 0.0, 0.25);
        let expected = frame * axis * (scale * speed);
        let at = |time: f64| exp(expected * time) * slave;
        for tick in 1..=5000 {
            let time = f64::from(tick) * 1e-3;
            let command = coupling.commanded_orientation(&(exp(axis * (speed * time)) * master), &slave);
            let velocity = coupling.commanded_velocity(&(axis * speed));
            // 30 rad, with an ulp of it in the angle; each new anchor adds rounding.
            assert!(command.angle_to(&at(time)) < 1e-13, "{time} s");
            assert!((velocity - expected).norm() < 1e-12);
            let twist = crate::coupling::Twist { velocity: Vector3::zeros(), angular_velocity: velocity };
            let slope = (at(time + 1e-5) * tip - at(time - 1e-5) * tip) / 2e-5;
            // h^2 / 6 |w|^3 |r|, at most 2e-10, and 4 eps / h.
            assert!((twist.shifted(&(command * tip)).velocity - slope).norm() < 5e-10);
        }
    }
}

/// Closed form of the product against the two Jacobians (Sola, Deray and Atchuthan, Eq. 145 and 146).
#[test]
fn the_velocity_is_the_product_of_the_jacobians() {
    let left = |phi: Vector3<f64>| {
        let (angle, cross) = (phi.norm(), phi.cross_matrix());
        Matrix3::identity()
            + cross * ((1.0 - angle.cos()) / angle.powi(2))
            + cross * cross * ((angle - angle.sin()) / angle.powi(3))
    };
    let inverse = |phi: Vector3<f64>| {
        let (angle, cross) = (phi.norm(), phi.cross_matrix());
        let last = 1.0 / angle.powi(2) - (1.0 + angle.cos()) / (2.0 * angle * angle.sin());
        Matrix3::identity() - cross * 0.5 + cross * cross * last
    };
    let axis = Vector3::new(-0.6, 0.64, 0.48);
    for scale in [0.3, 0.5, 2.0, 2.7] {
        for angle in [0.2, 1.0, 2.5, 3.1, 3.5, 4.7] {
            let (coupling, _) = led(scaled(scale), [UnitQuaternion::identity(); 2], axis, angle);
            let velocity = Vector3::new(1.0, -2.0, 0.5);
            let phi = axis * angle;
            let expected = left(phi * scale) * inverse(phi) * velocity * scale;
            let seen = coupling.commanded_velocity(&velocity);
            // 1 / sin(3.1) = 24 and (0.2)^-3 = 125 amplify the rounding of the matrices.
            assert!((seen - expected).norm() < 1e-12, "{scale} {angle}: {seen} {expected}");
            // The result must differ from the formula that holds only about a constant axis.
            assert!((seen - velocity * scale).norm() > 1e-4, "{scale} {angle}");
        }
    }
}

proptest! {
    #[test]
    fn the_velocity_is_the_derivative_of_the_command(
        (frame, master, slave) in (orientation(), orientation(), orientation()),
        (axis, angle, velocity) in (direction(), 0.0..4.5f64, vector(1.0)),
        (scale, lock) in (scale(), lock()),
    ) {
        let mut coupling = scaled(scale);
        coupling.set_frame(wxyz(&frame), 0).unwrap();
        coupling.set_lock(lock);
        let (coupling, command) = led(coupling, [master, slave], axis.into_inner(), angle);
        let step = 1e-5;
        let at = |time: f64| {
            let mut coupling = coupling;
            let hand = exp(velocity * time) * exp(axis.into_inner() * angle) * master;
            let command = coupling.commanded_orientation(&hand, &slave);
            (command, coupling.anchor.map(|anchor| anchor.slave))
        };
        // At a new anchor the derivative has two sides.
        prop_assume!([step, -step].into_iter().all(|time| at(time).1 == coupling.anchor.map(|anchor| anchor.slave)));
        let slope = (at(step).0 * at(-step).0.inverse()).scaled_axis() / (2.0 * step);
        let seen = coupling.commanded_velocity(&velocity);
        // Rounding: 8 eps / 2h, 1e-10. Truncation: h^2 / 6 times the third derivative. That derivative is
        // below 1e3 for |w| < 1.8, lambda < 3 and a stretch below sqrt 2.
        prop_assert!((slope - seen).norm() < 2e-8, "{slope} {seen}");
        prop_assert!(command.angle_to(&at(0.0).0) < 1e-14);
    }

    /// For lambda_r = 1 the command is `C R_m R_m0' C' R_s0`, by any way and for any number of turns.
    #[test]
    fn unscaled_command_is_the_rotation_itself(
        (frame, master, slave) in (orientation(), orientation(), orientation()),
        way in prop::collection::vec(vector(3.0), 1..20),
    ) {
        let mut coupling = scaled(1.0);
        coupling.set_frame(wxyz(&frame), 0).unwrap();
        coupling.commanded_orientation(&master, &slave);
        let mut hand = master;
        for by in way {
            hand = exp(by) * hand;
            let seen = coupling.commanded_orientation(&hand, &slave);
            let expected = frame * hand * master.inverse() * frame.inverse() * slave;
            prop_assert!(seen.angle_to(&expected) < 1e-14);
            let velocity = coupling.commanded_velocity(&by);
            prop_assert!((velocity - frame * by).norm() < 1e-14);
        }
    }

    /// Any walk of the hand, far beyond the reach of one anchor. At each tick the command turns at most by
    /// the bound times the hand's turn, on both sides of pi, [`ANCHOR_REACH_RAD`] and 2 pi.
    #[test]
    fn nothing_jumps_anywhere(
        (master, slave, drift) in (orientation(), orientation(), direction()),
        (scale, lock, tremor) in (scale(), lock(), prop::collection::vec(vector(0.02), 300)),
    ) {
        let mut coupling = scaled(scale);
        coupling.set_lock(lock);
        let bound = match lock {
            RotationLock::Free => scale.max(SQRT_2),
            RotationLock::OnlyAbout(_) => scale * SQRT_2,
            RotationLock::Locked => 0.0,
        };
        let mut hand = master;
        let mut command = coupling.commanded_orientation(&hand, &slave);
        for by in tremor {
            let turn = exp(by + drift.into_inner() * 0.03);
            hand = turn * hand;
            let next = coupling.commanded_orientation(&hand, &slave);
            // The stretch along the way of one tick exceeds that of its ends by less than |w dt|^2, 5e-3.
            prop_assert!(next.angle_to(&command) <= bound * turn.angle() * 1.005 + 1e-14);
            command = next;
        }
    }

    /// The same for jumps of the hand after lost frames.
    #[test]
    fn a_jump_of_the_hand_is_followed_by_no_larger_one(
        (master, slave, hands) in (orientation(), orientation(), prop::collection::vec(orientation(), 1..30)),
        (scale, lock) in (scale(), lock()),
    ) {
        let mut coupling = scaled(scale);
        coupling.set_lock(lock);
        let bound = match lock {
            RotationLock::Free => scale.max(SQRT_2),
            RotationLock::OnlyAbout(_) => scale * SQRT_2,
            RotationLock::Locked => 0.0,
        };
        let mut last = master;
        let mut command = coupling.commanded_orientation(&master, &slave);
        for hand in hands {
            let next = coupling.commanded_orientation(&hand, &slave);
            let way = hand.angle_to(&last);
            // Within a piece of 0.5 rad the way may leave the reach by its sagitta, 0.5^2 / 8.
            prop_assert!(next.angle_to(&command) <= bound * way * 1.04 + 1e-14);
            (last, command) = (hand, next);
        }
    }

    /// The same on lines that pass pi and 2 pi at any distance.
    #[test]
    fn nothing_jumps_on_a_line_past_pi(
        (axis, off) in (direction(), direction()),
        (scale, exponent) in (0.1..0.9f64, -12.0..-0.5f64),
    ) {
        let mut coupling = scaled(scale);
        let apart = exp(off.into_inner() * 10.0_f64.powf(exponent));
        let origin = UnitQuaternion::identity();
        let mut command = coupling.commanded_orientation(&origin, &origin);
        let (mut largest, mut last) = (0.0_f64, origin);
        for step in 0..=1300 {
            let hand = exp(axis.into_inner() * (0.01 * f64::from(step))) * apart;
            let next = coupling.commanded_orientation(&hand, &origin);
            let moved = if step == 0 { apart.angle() } else { 0.01 };
            prop_assert!(next.angle_to(&command) < SQRT_2 * moved * 1.005 + 1e-14);
            // The power of the principal logarithm would jump.
            let naive = exp(hand.scaled_axis() * scale);
            largest = largest.max(naive.angle_to(&last));
            (command, last) = (next, naive);
        }
        prop_assert!(largest > 0.1, "the line does not pass pi");
    }

    /// Within reach the command depends on the hand's orientation, not on its way.
    #[test]
    fn the_way_does_not_matter_within_reach(
        (master, slave) in (orientation(), orientation()),
        (axis, angle, detour) in (direction(), 0.0..1.2 * PI, vector(0.15)),
        (scale, about) in (scale(), any::<bool>()),
    ) {
        let mut coupling = scaled(scale);
        coupling.set_lock(if about { RotationLock::OnlyAbout(axis) } else { RotationLock::Free });
        let (mut coupling, mut command) = led(coupling, [master, slave], axis.into_inner(), angle);
        // A detour of at most 0.26 rad, which phi stretches by at most 2, then back to the start.
        let there = exp(axis.into_inner() * angle) * master;
        for share in [0.3, 0.6, 1.0, 0.7, 0.4, 0.0] {
            let hand = exp(detour * share) * exp(detour.yzx() * (share * (1.0 - share))) * there;
            coupling.commanded_orientation(&hand, &slave);
        }
        let back = coupling.commanded_orientation(&there, &slave);
        prop_assert!(back.angle_to(&command) < 1e-13);
        for step in (0..40).rev() {
            let hand = exp(axis.into_inner() * (angle * f64::from(step) / 40.0)) * master;
            command = coupling.commanded_orientation(&hand, &slave);
        }
        prop_assert!(command.angle_to(&slave) < 1e-13);
    }

    /// Clutch cycles: each begins where the last one left the slave, and the hand returns while uncoupled.
    #[test]
    fn clutch_cycles_return_to_the_anchor(
        (slave, frame, hands) in (orientation(), orientation(), prop::collection::vec((orientation(), vector(1.5)), 1..30)),
        (scale, lock) in (scale(), lock()),
    ) {
        let mut coupling = scaled(scale);
        coupling.set_frame(wxyz(&frame), 0).unwrap();
        coupling.set_lock(lock);
        let mut command = slave;
        let mut cycle = |from: UnitQuaternion<f64>, to: UnitQuaternion<f64>| {
            coupling.disengage();
            coupling.commanded_orientation(&from, &command);
            command = coupling.commanded_orientation(&to, &command);
            command
        };
        let mut moved = 0.0_f64;
        for (hand, by) in &hands {
            moved = moved.max(cycle(*hand, exp(*by) * hand).angle_to(&slave));
        }
        for (hand, by) in hands.iter().rev() {
            cycle(exp(*by) * hand, *hand);
        }
        prop_assert!(command.angle_to(&slave) < 1e-12, "{:e}", command.angle_to(&slave));
        prop_assert!(moved > 1e-3 || lock != RotationLock::Free || hands.iter().all(|(_, by)| by.norm() < 0.02));
    }

    /// Frame invariance: any rotation of both base frames and of both tool frames.
    #[test]
    fn turning_everything_changes_nothing(
        (master, slave, frame) in (orientation(), orientation(), orientation()),
        (master_base, slave_base) in (orientation(), orientation()),
        (master_tool, slave_tool) in (orientation(), orientation()),
        (way, scale, lock) in (prop::collection::vec(vector(0.7), 1..12), scale(), lock()),
    ) {
        let mut coupling = scaled(scale);
        coupling.set_frame(wxyz(&frame), 0).unwrap();
        coupling.set_lock(lock);
        let mut turned = scaled(scale);
        turned.set_frame(wxyz(&(slave_base * frame * master_base.inverse())), 0).unwrap();
        turned.set_lock(match lock {
            RotationLock::OnlyAbout(axis) => RotationLock::OnlyAbout(slave_base * axis),
            other => other,
        });
        let mut hand = master;
        for by in std::iter::once(Vector3::zeros()).chain(way) {
            hand = exp(by) * hand;
            let there = master_base * hand * master_tool;
            let command = coupling.commanded_orientation(&hand, &slave);
            let seen = turned.commanded_orientation(&there, &(slave_base * slave * slave_tool));
            prop_assert!(seen.angle_to(&(slave_base * command * slave_tool)) < 1e-12);
            let velocity = coupling.commanded_velocity(&by);
            let seen = turned.commanded_velocity(&(master_base * by));
            prop_assert!((seen - slave_base * velocity).norm() < 1e-12);
            let torque = coupling.rendered_torque(&by);
            let seen = turned.rendered_torque(&(slave_base * by));
            prop_assert!((seen - master_base * torque).norm() < 1e-13);
        }
    }

    /// `tau_m·w_m = (lambda_tau / lambda_r) tau_s·w_s` about a constant axis; with a lock that is the lock's
    /// axis.
    #[test]
    fn power_is_the_same_on_both_sides_up_to_the_scales(
        (frame, axis, torque) in (orientation(), direction(), vector(5.0)),
        (angle, speed) in (0.0..30.0f64, -3.0..3.0f64),
        (scale, torque_scale, locks) in (scale(), 0.1..3.0f64, 0..3_u8),
    ) {
        let mut coupling = RotationCoupling::new(scale, torque_scale).unwrap();
        coupling.set_frame(wxyz(&frame), 0).unwrap();
        coupling.set_lock(match locks {
            0 => RotationLock::Free,
            1 => RotationLock::OnlyAbout(frame * axis),
            _ => RotationLock::Locked,
        });
        let at = [UnitQuaternion::identity(); 2];
        let (coupling, _) = led(coupling, at, axis.into_inner(), angle);
        let velocity = axis.into_inner() * speed;
        let felt = coupling.rendered_torque(&torque).dot(&velocity);
        let done = torque.dot(&coupling.commanded_velocity(&velocity));
        // 26 W at most, times 3, and the rounding of 30 rad in the axis.
        prop_assert!((felt - done * torque_scale / scale).abs() < 1e-12);
        prop_assert!(locks < 2 || (felt == 0.0 && done == 0.0));
    }

    /// A swing before or after the turn about the axis leaves that turn as it is.
    #[test]
    fn about_one_axis_the_slave_turns_as_far_as_the_hand(
        (master, slave, free) in (orientation(), orientation(), direction()),
        (across, swing) in (direction(), 0.0..1.5f64),
        (scale, angle) in (scale(), -40.0..40.0f64),
    ) {
        let tilt = free.cross(&across);
        prop_assume!(tilt.norm() > 0.1);
        let tilt = exp(tilt.normalize() * swing);
        let mut coupling = scaled(scale);
        coupling.set_lock(RotationLock::OnlyAbout(free));
        coupling.commanded_orientation(&master, &slave);
        prop_assert!(coupling.commanded_orientation(&(tilt * master), &slave).angle_to(&slave) < 1e-14);
        let mut command = slave;
        for step in 1..=100 {
            let turn = exp(free.into_inner() * (angle * f64::from(step) * 0.01));
            command = coupling.commanded_orientation(&(turn * tilt * master), &slave);
        }
        let expected = exp(free.into_inner() * (scale * angle)) * slave;
        prop_assert!(command.angle_to(&expected) < 1e-12, "{}", command.angle_to(&expected));
    }
}

/// The turn continues past pi; 0.2 turns beyond, the naive power would have returned from the other side.
#[test]
fn a_turn_goes_on_past_pi() {
    let axis = Vector3::new(0.8, 0.0, 0.6);
    for scale in [0.25, 0.5, 1.5] {
        for angle in
            [0.9 * PI, PI - 1e-9, PI, PI + 1e-9, 1.2 * PI, 1.499 * PI, 1.501 * PI, 2.0 * PI, 9.0 * PI]
        {
            let at = [UnitQuaternion::identity(); 2];
            let (_, command) = led(scaled(scale), at, axis, angle);
            assert!(command.angle_to(&exp(axis * (scale * angle))) < 1e-13, "{scale} {angle}");
            let (_, back) = led(scaled(scale), at, axis, -angle);
            assert!(back.angle_to(&command.inverse()) < 1e-13, "{scale} {angle}");
        }
    }
}

/// The stretch is at most `max(lambda, 1)` up to pi, and `max(lambda, sqrt 2)` within reach. It reaches the
/// bound for 1/2 at pi (`sin(pi / 4) / 1`) and for 2/3 at the end (`sin(pi / 2) / sin(3 pi / 4)`).
#[test]
fn the_stretch_has_its_bound() {
    for (scale, angle, expected) in [
        (0.5, PI, SQRT_2 / 2.0),
        (2.0 / 3.0, ANCHOR_REACH_RAD * (1.0 - 1e-12), SQRT_2),
        (2.0, 1e-9, 2.0),
        (2.0, PI, 0.0),
        (3.0, PI, 1.0),
    ] {
        let at = [UnitQuaternion::identity(); 2];
        let (coupling, _) = led(scaled(scale), at, Vector3::z(), angle);
        let across = coupling.commanded_velocity(&Vector3::x()).norm();
        assert!((across - expected).abs() < 1e-11, "{scale} {angle}: {across} must be {expected}");
        let along = coupling.commanded_velocity(&Vector3::z());
        assert!((along - Vector3::z() * scale).norm() < 1e-15);
    }
}

/// Beyond the reach, a way of several axes leaves the slave elsewhere: the cost of the anchor's reach.
#[test]
fn beyond_reach_the_anchor_changes() {
    let at = [UnitQuaternion::identity(); 2];
    let (mut coupling, _) = led(scaled(0.5), at, Vector3::z(), 1.6 * PI);
    assert_ne!(coupling.anchor.unwrap().slave, at[1]);
    // From a turn of -0.4 pi about z, the nearer way home.
    let mut command = at[1];
    for step in (0..=8).rev() {
        let hand = exp(Vector3::z() * (-0.05 * PI * f64::from(step)));
        command = coupling.commanded_orientation(&hand, &at[1]);
    }
    assert!(command.angle_to(&exp(Vector3::z() * PI)) < 1e-13, "a whole turn of the hand is half a turn");
}

#[test]
fn hidden_turns_beyond_pi_take_the_shorter_way() {
    let origin = UnitQuaternion::identity();
    for (hidden, taken) in [(0.9 * PI, 0.9 * PI), (1.1 * PI, -0.9 * PI), (2.3 * PI, 0.3 * PI)] {
        for begin in [0.0, 1.2, 4.0] {
            let (mut coupling, _) = led(scaled(0.5), [origin; 2], Vector3::z(), begin);
            let hand = exp(Vector3::z() * (begin + hidden));
            let command = coupling.commanded_orientation(&hand, &origin);
            let expected = exp(Vector3::z() * (0.5 * (begin + taken)));
            assert!(command.angle_to(&expected) < 1e-13, "{hidden} {begin}");
            let (mut unscaled, _) = led(scaled(1.0), [origin; 2], Vector3::z(), begin);
            assert!(unscaled.commanded_orientation(&hand, &origin).angle_to(&hand) < 1e-14);
        }
    }
}

/// A swing of pi has no turn about the axis: nothing jumps up to it and past it, and the turn continues from
/// there.
#[test]
fn turned_over_hand_causes_no_jump_about_the_free_axis() {
    for off in [0.0, 1e-12, 1e-3] {
        let mut coupling = scaled(1.0);
        coupling.set_lock(RotationLock::only_about([0.0, 0.0, 1.0]).unwrap());
        let origin = UnitQuaternion::identity();
        let mut command = coupling.commanded_orientation(&origin, &origin);
        for step in 0..=700 {
            let hand = exp(Vector3::new(0.01 * f64::from(step), off, 0.0));
            let next = coupling.commanded_orientation(&hand, &origin);
            assert!(next.angle_to(&command) < 0.01 * SQRT_2 + off * SQRT_2, "{off} {step}");
            command = next;
        }
        // A hand that turns about x only has turned nothing about z.
        assert!(command.angle() < 10.0 * off + 1e-12, "{off}: {}", command.angle());
    }
}

#[test]
fn locked_rotation_keeps_its_orientation_and_renders_no_torque() {
    let mut coupling = scaled(0.5);
    coupling.set_lock(RotationLock::Locked);
    let (hand, slave) = (exp(Vector3::x()), exp(Vector3::y() * 2.0));
    coupling.commanded_orientation(&hand, &slave);
    assert_eq!(coupling.commanded_orientation(&slave, &hand), slave);
    assert_eq!(coupling.commanded_velocity(&Vector3::x()), Vector3::zeros());
    assert_eq!(coupling.rendered_torque(&Vector3::x()), Vector3::zeros());
    coupling.set_lock(RotationLock::only_about([0.0, 1.0, 0.0]).unwrap());
    assert_eq!(coupling.commanded_velocity(&Vector3::new(1.0, 2.0, 3.0)), Vector3::y());
    assert_eq!(coupling.rendered_torque(&Vector3::new(1.0, 2.0, 3.0)), Vector3::y() * 2.0);
}

#[test]
fn nan_orientation_is_not_followed() {
    let none = Unit::new_unchecked(Quaternion::new(1.0, f64::NAN, 0.0, 0.0));
    let (hand, slave) = (exp(Vector3::x()), exp(Vector3::y() * 2.0));
    for lock in [RotationLock::Free, RotationLock::only_about([1.0, 0.0, 0.0]).unwrap()] {
        let mut coupling = scaled(0.5);
        coupling.set_lock(lock);
        assert_eq!(coupling.commanded_orientation(&none, &slave), slave);
        assert_eq!(coupling.commanded_orientation(&hand, &hand), hand, "not engaged yet");
        let command = coupling.commanded_orientation(&(exp(Vector3::x()) * hand), &slave);
        assert_eq!(coupling.commanded_orientation(&none, &slave), command);
        let back = coupling.commanded_orientation(&hand, &slave);
        assert!(back.angle_to(&hand) < 1e-15);
    }
}

/// Norms off by 1e-9, on either side, as `checked` accepts them.
#[test]
fn command_has_norm_1_for_inexact_inputs() {
    for off in [1.0 + 1e-9, 1.0 - 1e-9] {
        let bent = |of: UnitQuaternion<f64>| Unit::new_unchecked(of.into_inner() * off);
        for scale in [1.0, 0.5] {
            let mut coupling = scaled(scale);
            let slave = exp(Vector3::y());
            coupling.commanded_orientation(&bent(exp(Vector3::z())), &bent(slave));
            let command = coupling.commanded_orientation(&bent(exp(Vector3::z() * 2.0)), &slave);
            assert!((command.norm() - 1.0).abs() < 4.0 * f64::EPSILON);
            assert!(command.angle_to(&(exp(Vector3::z() * scale) * slave)) < 1e-14);
        }
    }
}

#[test]
fn invalid_settings_are_refused() {
    for (r, tau, text) in [
        (0.0, 1.0, "rotation_scale (lambda_r) = 0"),
        (f64::NAN, 1.0, "rotation_scale (lambda_r) = NaN"),
        (1.0, -1.0, "torque_scale (lambda_tau) = -1"),
        (1.0, f64::INFINITY, "torque_scale (lambda_tau) = inf"),
    ] {
        let error = RotationCoupling::new(r, tau).unwrap_err().to_string();
        assert!(error.starts_with(text), "{error}");
        let mut coupling = scaled(1.0);
        assert!(coupling.set_rotation_scale(r, 0).is_err() || coupling.set_torque_scale(tau, 0).is_err());
    }
    let before = scaled(1.0);
    let mut coupling = before;
    for quat_wxyz in [[0.9, 0.0, 0.0, 0.0], [f64::NAN; 4], [1.0; 4]] {
        let error = coupling.set_frame(quat_wxyz, 0).unwrap_err().to_string();
        assert!(error.contains("must be 1 to within 1e-6"), "{error}");
    }
    for axis in [[0.0; 3], [1.0, 1.0, 0.0], [f64::NAN, 0.0, 1.0]] {
        let error = RotationLock::only_about(axis).unwrap_err().to_string();
        assert!(error.starts_with("axis of rotation has a length of "), "{error}");
    }
    assert_eq!(coupling, before);
}
