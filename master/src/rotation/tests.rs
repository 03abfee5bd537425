//! A rotating handle against closed forms: free bodies, torsion springs, release, friction.

use proptest::prelude::*;

use super::*;
use crate::{LegShape, Release, ReleaseKind};

const UPRIGHT: [f64; 4] = [1.0, 0.0, 0.0, 0.0];
const TICK_NS: u64 = 1_000_000;
const INERTIA: f64 = 2e-4;

fn free(inertia: [f64; 3], w: [f64; 3]) -> SimulatedRotation {
    let device =
        RotationParameters { inertia_kg_m2: Axes::from(inertia), ..RotationParameters::ideal(1.0, 0.0, 0.0) };
    let mut body = SimulatedRotation::new(device, RotationHand::absent(UPRIGHT).unwrap(), 0).unwrap();
    body.place(UPRIGHT, &Axes::from(w)).unwrap();
    body
}

/// A handle about z, turned to `angle`, free of a hand, with a spring of `stiffness` towards 0.
fn turned(viscous: f64, coulomb: f64, stiffness: f64, angle: f64) -> SimulatedRotation {
    let device = RotationParameters::ideal(INERTIA, viscous, coulomb);
    let spring = TorsionSpring::new(stiffness, 0.0, UPRIGHT).unwrap();
    let body = SimulatedRotation::new(device, RotationHand::absent(UPRIGHT).unwrap(), 0).unwrap();
    let mut body = body.with_springs(vec![spring]).unwrap();
    body.place(about_z(angle), &Axes::zeros()).unwrap();
    body
}

fn about_z(angle: f64) -> [f64; 4] {
    [(angle / 2.0).cos(), 0.0, 0.0, (angle / 2.0).sin()]
}

fn angle(body: &SimulatedRotation) -> f64 {
    body.orientation().scaled_axis()[2]
}

#[test]
fn a_free_body_keeps_energy_and_momentum() {
    // Includes the middle axis, about which a rotation tumbles.
    for w in [[3.0, -7.0, 5.0], [0.01, 20.0, 0.01], [25.0, 1.0, -12.0]] {
        let mut body = free([1e-4, 2e-4, 4e-4], w);
        let (energy, momentum) = (body.kinetic_energy_j(), *body.angular_momentum());
        let mut most = 0.0_f64;
        for tick in 1..=100_000 {
            body.read(tick * TICK_NS);
            most = most.max((body.kinetic_energy_j() / energy - 1.0).abs());
        }
        assert!(most < 2e-11, "{w:?}: {most}");
        // L is the state; check it as recomputed from w and R.
        let seen =
            *body.orientation() * body.device.inertia_kg_m2.component_mul(&body.body_angular_velocity());
        assert!((seen - momentum).norm() < 1e-12 * momentum.norm(), "{w:?}");
        assert!((body.orientation().norm() - 1.0).abs() < 1e-15);
    }
}

/// `w = (w_t cos(l t), w_t sin(l t), w_3)`, `l = (I_3 - I_1) w_3 / I_1`, in the body frame. The body axis
/// precesses about L at `|L| / I_1`. Source: Goldstein, Poole and Safko 2002, section 5.6.
#[test]
fn a_symmetric_top_precesses_by_its_closed_form() {
    let (i_1, i_3, w_t, w_3) = (1e-4, 3e-4, 4.0, 9.0);
    let mut body = free([i_1, i_1, i_3], [w_t, 0.0, w_3]);
    let momentum = *body.angular_momentum();
    let rate = (i_3 - i_1) / i_1 * w_3;
    for tick in 1..=5_000 {
        body.read(tick * TICK_NS);
        let t = tick as f64 * 1e-3;
        let (sine, cosine) = (rate * t).sin_cos();
        let expected = Axes::<3>::new(w_t * cosine, w_t * sine, w_3);
        // About z^4 / 30 of each rad: z = 6e-3 per sub-step, 90 rad in 5 s.
        assert!((body.body_angular_velocity() - expected).norm() < w_t * 90.0 * 4.4e-11, "{tick}");
        let around = UnitQuaternion::from_scaled_axis(momentum / i_1 * t);
        let axis = around * Axes::<3>::z();
        assert!((body.orientation() * Axes::<3>::z() - axis).norm() < 1e-8, "{tick}");
    }
}

/// Half the step gives a 16th of the error over the same time.
#[test]
fn the_order_is_four() {
    let spring = TorsionSpring::new(0.02, 1e-3, about_z(0.3)).unwrap();
    let after = |steps: u32| {
        let mut body = free([1e-4, 2e-4, 4e-4], [6.0, -9.0, 7.0]).with_springs(vec![spring]).unwrap();
        body.write(&Axes::<3>::new(1e-3, 2e-3, -1e-3));
        for _ in 0..steps {
            body.state = body.stepped(0.4 / f64::from(steps), Friction::None).state;
        }
        body.state
    };
    let exact = after(2048);
    let apart = |steps| {
        let state = after(steps);
        let turn = (exact.orientation.inverse() * state.orientation).scaled_axis().norm();
        [turn, (state.momentum - exact.momentum).norm()]
    };
    let (coarse, fine) = (apart(64), apart(128));
    for (coarse, fine) in coarse.iter().zip(fine) {
        let order = (coarse / fine).log2();
        assert!((3.7..4.5).contains(&order), "{order}: {coarse} {fine}");
    }
}

/// `phi = phi_0 exp(-d t) (cos(o t) + d / o sin(o t))`, `d = b / (2 I)`, `o² = k / I - d²`.
#[test]
fn a_torsion_spring_swings_by_its_closed_form() {
    let (stiffness, start) = (0.5, 1.2);
    for viscous in [0.0, 1e-4, 4e-3] {
        let mut body = turned(viscous, 0.0, stiffness, start);
        let decay = viscous / (2.0 * INERTIA);
        let rate = (stiffness / INERTIA - decay * decay).sqrt();
        for tick in 1..=1_000 {
            body.read(tick * TICK_NS);
            let t = tick as f64 * 1e-3;
            let (sine, cosine) = (rate * t).sin_cos();
            let expected = start * (-decay * t).exp() * (cosine + decay / rate * sine);
            // 50 rad of phase at z^4 / 120 each, z = 1/64.
            assert!((angle(&body) - expected).abs() < 50.0 * 1.2 * 5e-10, "{viscous} {tick}");
        }
    }
}

/// A hand turns a handle against a torsion spring and releases it: `sqrt(k / I) phi` at most, less friction.
#[test]
fn released_handle_matches_the_closed_form() {
    let (stiffness, held): (f64, f64) = (0.8, 1.0);
    for (viscous, coulomb) in [(0.0, 0.0), (4e-3, 0.0), (0.0, 0.05)] {
        let device = RotationParameters::ideal(INERTIA, viscous, coulomb);
        let leg = RotationLeg { duration_s: 0.5, end_wxyz: about_z(held), shape: LegShape::MinimumJerk };
        let hand = RotationHand::new(&RotationHandParameters {
            stiffness: 4.0,
            damping: 0.05,
            strength_n_m: None,
            start_wxyz: UPRIGHT,
            legs: vec![leg],
            release: Some(Release { at_s: 1.5, decay_s: 0.0, kind: ReleaseKind::Gain }),
        })
        .unwrap();
        let body = SimulatedRotation::new(device, hand, 0).unwrap();
        let mut body = body.with_springs(vec![TorsionSpring::new(stiffness, 0.0, UPRIGHT).unwrap()]).unwrap();
        body.read(1_500 * TICK_NS);
        let (phi, rate) = (angle(&body), (stiffness / INERTIA).sqrt());
        assert!((phi - held * 4.0 / 4.8).abs() <= coulomb / 4.8 + 1e-9, "in balance: {phi}");
        assert_eq!(body.hand_torque(), Axes::<3>::zeros());
        assert!(
            body.body_angular_velocity().norm() < 1e-9,
            "at rest: {viscous} {coulomb} {}",
            body.body_angular_velocity()
        );
        // The peak is where the angular acceleration is first zero, tan(o t) = o / d.
        let decay = viscous / (2.0 * INERTIA);
        let own = (rate * rate - decay * decay).sqrt();
        let at = if decay == 0.0 { std::f64::consts::FRAC_PI_2 / own } else { (own / decay).atan() / own };
        let expected =
            rate * rate / own * (phi - coulomb / stiffness) * (-decay * at).exp() * (own * at).sin();
        // Samples every 10 us; half of that is a phase of 0.3 mrad, 5e-8 below the peak.
        let peak = (1..3_000_u64)
            .map(|n| body.read(1_500 * TICK_NS + n * 10_000).angular_velocity.unwrap().norm())
            .fold(0.0, f64::max);
        assert!((peak / expected - 1.0).abs() < 2e-7, "{viscous} {coulomb}: {peak} {expected}");
    }
}

fn spring_of_a_hand(stiffness: f64, strength_n_m: Option<f64>, legs: Vec<RotationLeg>) -> RotationHand {
    let start_wxyz = UPRIGHT;
    let release = None;
    RotationHand::new(&RotationHandParameters {
        stiffness,
        damping: 0.0,
        strength_n_m,
        start_wxyz,
        legs,
        release,
    })
    .unwrap()
}

/// `I phi'' = tau - min(K phi, S)`, where the motor turns from `tau > S` to `-tau` at a tick while the grip S slips. The
/// grip begins and ceases to slip within ticks.
#[test]
fn a_grip_begins_and_ceases_to_slip_by_the_closed_form() {
    for (stiffness, strength, torque, sign) in
        [(4.0, 0.5, 0.8, 1.0), (4.0, 0.5, 0.8, -1.0), (1.0, 0.05, 0.4, 1.0), (0.3, 0.1, 0.11, -1.0)]
    {
        let hand = spring_of_a_hand(stiffness, Some(strength), Vec::new());
        let device = RotationParameters::ideal(INERTIA, 0.0, 0.0);
        let mut body = SimulatedRotation::new(device, hand, 0).unwrap();
        let (rate, rest, limit) = ((stiffness / INERTIA).sqrt(), torque / stiffness, strength / stiffness);
        let slips_s = (1.0 - limit / rest).acos() / rate;
        let ticks = (2_u32..100).find(|&tick| (f64::from(tick) - 1.0) * 1e-3 >= slips_s).unwrap();
        let turns_s = f64::from(ticks) * 1e-3;
        let moved = |[angle, speed]: [f64; 2], push: f64, t: f64| {
            [angle + (speed + 0.5 * push / INERTIA * t) * t, speed + push / INERTIA * t]
        };
        let slips = [limit, rest * rate * (rate * slips_s).sin()];
        let turns = moved(slips, torque - strength, turns_s - slips_s);
        let pulled = (torque + strength) / INERTIA;
        let holds_s =
            turns_s + (turns[1] + (turns[1].powi(2) + 2.0 * pulled * (turns[0] - limit)).sqrt()) / pulled;
        let holds = moved(turns, -torque - strength, holds_s - turns_s);
        let expected = |t: f64| {
            let phase = rate * (t - holds_s);
            if t < slips_s {
                rest * (1.0 - (rate * t).cos())
            } else if t < turns_s {
                moved(slips, torque - strength, t - slips_s)[0]
            } else if t < holds_s {
                moved(turns, -torque - strength, t - turns_s)[0]
            } else {
                (limit + rest) * phase.cos() - rest + holds[1] / rate * phase.sin()
            }
        };
        // Order 4 with z = 1/64: z^4 / 120 of the swing for each rad of phase.
        let tolerance = 5e-10 * (rest + limit) * rate * holds_s;
        for tick in (1_u32..).take_while(|&tick| (f64::from(tick) - 2.0) * 1e-3 < holds_s) {
            body.write(&(Axes::<3>::z() * if tick <= ticks { sign * torque } else { -sign * torque }));
            body.read(u64::from(tick) * TICK_NS);
            let off = angle(&body) * sign - expected(f64::from(tick) * 1e-3);
            assert!(off.abs() < tolerance, "{stiffness} {strength} {torque} {tick}: {off:e} {tolerance:e}");
        }
    }
}

/// Friction withstands the hand's spring until `K r t = c`, its target turning at the rate r. From there on, after s,
/// `phi = r (s - sin(o s) / o)`.
#[test]
fn a_handle_breaks_away_by_the_closed_form() {
    for (stiffness, coulomb, target_rate) in
        [(4.0, 0.05, 1.0), (4.0, 0.0123, -1.0), (0.3, 0.02, 2.0), (1.0, 0.1, 0.5)]
    {
        let leg = RotationLeg { duration_s: 1.0, end_wxyz: about_z(target_rate), shape: LegShape::Linear };
        let hand = spring_of_a_hand(stiffness, None, vec![leg]);
        let device = RotationParameters::ideal(INERTIA, 0.0, coulomb);
        let mut body = SimulatedRotation::new(device, hand, 0).unwrap();
        let rate = (stiffness / INERTIA).sqrt();
        let breaks_s = coulomb / (stiffness * target_rate.abs());
        // It rests again after a whole swing. Order 4 with z = 1/64, as above.
        let tolerance = 5e-10 * target_rate.abs() / rate * 6.0;
        for tick in (1_u32..).take_while(|&tick| (f64::from(tick) * 1e-3 - breaks_s) * rate < 6.0) {
            body.read(u64::from(tick) * TICK_NS);
            let since = (f64::from(tick) * 1e-3 - breaks_s).max(0.0);
            let off = angle(&body) - target_rate * (since - (rate * since).sin() / rate);
            assert!(off.abs() < tolerance, "{stiffness} {coulomb} {tick}: {off:e} {tolerance:e}");
        }
    }
}

/// Between two halts dry friction takes `2 c / k` of the amplitude; it rests where friction holds the spring.
#[test]
fn dry_friction_takes_its_share_of_each_swing() {
    let (stiffness, coulomb, start) = (0.5, 0.03, 0.5);
    let mut body = turned(0.0, coulomb, stiffness, start);
    let swing = std::time::Duration::from_secs_f64(std::f64::consts::PI / (stiffness / INERTIA).sqrt());
    let swing_ns = u64::try_from(swing.as_nanos()).unwrap();
    let share = coulomb / stiffness;
    let mut expected: f64 = start;
    for swing in 1..=6 {
        body.read(swing * swing_ns);
        if expected.abs() > share {
            expected = -(expected - 2.0 * share * expected.signum());
        }
        assert!((angle(&body) - expected).abs() < 1e-7, "{swing}: {} {expected}", angle(&body));
    }
    assert!(expected.abs() < share);
    assert_eq!(body.body_angular_velocity(), Axes::<3>::zeros(), "at rest, exactly");
}

#[test]
fn friction_at_rest_withstands_its_torque() {
    let device = RotationParameters::ideal(INERTIA, 0.0, 0.02);
    for (torque, acceleration) in
        [(0.0199, 0.0), (-0.02, 0.0), (0.03, 0.01 / INERTIA), (-0.03, -0.01 / INERTIA)]
    {
        let mut body = SimulatedRotation::new(device, RotationHand::absent(UPRIGHT).unwrap(), 0).unwrap();
        body.write(&Axes::<3>::new(0.0, torque, 0.0));
        let w = body.read(100 * TICK_NS).angular_velocity.unwrap();
        assert!((w - Axes::<3>::new(0.0, acceleration * 0.1, 0.0)).norm() < 1e-11, "{torque}: {w}");
    }
    // After a push it comes to rest after I w / c.
    let mut body = SimulatedRotation::new(device, RotationHand::absent(UPRIGHT).unwrap(), 0).unwrap();
    body.place(UPRIGHT, &Axes::<3>::new(3.0, 4.0, 0.0)).unwrap();
    let halt_ns = 50 * TICK_NS;
    assert!(body.read(halt_ns - TICK_NS).angular_velocity.unwrap().norm() > 0.09);
    body.read(halt_ns + TICK_NS);
    assert_eq!(*body.angular_momentum(), Axes::<3>::zeros());
    assert!((body.orientation().angle() - INERTIA * 25.0 / 0.04).abs() < 1e-12);
}

/// A slow body pushed backwards and sideways: the direction of friction rotates within a tick.
#[test]
fn friction_follows_a_motion_that_swerves() {
    let after = |period_ns: u64| {
        let device = RotationParameters::ideal(INERTIA, 0.0, 0.01);
        let mut body = SimulatedRotation::new(device, RotationHand::absent(UPRIGHT).unwrap(), 0).unwrap();
        body.place(UPRIGHT, &Axes::<3>::new(0.01, 0.0, 0.0)).unwrap();
        body.write(&Axes::<3>::new(-0.02, 0.01, 0.0));
        for n in 1..=TICK_NS / period_ns {
            body.read(n * period_ns);
        }
        body.body_angular_velocity()
    };
    let (coarse, fine) = (after(TICK_NS), after(100));
    assert!((coarse - fine).norm() < 1e-5 * fine.norm(), "{coarse} {fine}");
}

/// After a turn by the hand both come to rest, without creep.
#[test]
fn friction_ends_a_turn_of_the_hand() {
    let end_wxyz = about_z(1.5);
    let leg = RotationLeg { duration_s: 0.5, end_wxyz, shape: LegShape::MinimumJerk };
    let hand = RotationHandParameters {
        stiffness: 3.0,
        damping: 0.1,
        strength_n_m: None,
        start_wxyz: UPRIGHT,
        legs: vec![leg],
        release: None,
    };
    let device = RotationParameters::ideal(4e-4, 0.0, 2e-3);
    let mut body = SimulatedRotation::new(device, RotationHand::new(&hand).unwrap(), 0).unwrap();
    for tick in 1..=1500_u32 {
        body.write(&Axes::<3>::new(
            1e-8 * (f64::from(tick) * 0.3).sin(),
            5e-6 * (f64::from(tick) * 0.7).cos(),
            0.0,
        ));
        body.read(u64::from(tick) * TICK_NS);
    }
    assert!(body.hand_torque().norm() < 2e-3);
    assert_eq!(body.angular_velocity().norm(), 0.0);
}

#[test]
fn a_held_torque_adds_its_impulse() {
    let mut body = free([1e-4, 2e-4, 4e-4], [3.0, -2.0, 1.0]);
    let (before, torque) = (*body.angular_momentum(), Axes::<3>::new(1e-3, -2e-3, 5e-4));
    body.write(&torque);
    for tick in 1..=100 {
        body.read(tick * TICK_NS);
    }
    assert!((body.angular_momentum() - before - torque * 0.1).norm() < 1e-17);
    body.write(&Axes::<3>::new(f64::NAN, 1.0, 0.0));
    assert_eq!(*body.motor_torque(), Axes::<3>::zeros());
}

#[test]
fn motors_have_a_bound_and_a_hand_may_wait() {
    let device =
        RotationParameters { max_torque_n_m: Some(0.05), ..RotationParameters::ideal(INERTIA, 0.0, 0.0) };
    let leg = RotationLeg { duration_s: 0.1, end_wxyz: about_z(0.5), shape: LegShape::Smooth };
    let hand = RotationHand::new(&RotationHandParameters {
        stiffness: 2.0,
        damping: 0.03,
        strength_n_m: Some(1.0),
        start_wxyz: UPRIGHT,
        legs: vec![leg],
        release: None,
    })
    .unwrap();
    let mut body = SimulatedRotation::new(device, hand, 0).unwrap();
    body.write(&Axes::<3>::new(0.0, 3.0, 4.0));
    assert!((body.motor_torque() - Axes::<3>::new(0.0, 0.03, 0.04)).norm() < 1e-16);
    body.write(&Axes::zeros());
    body.set_waiting(true);
    body.read(300 * TICK_NS);
    assert_eq!(angle(&body), 0.0);
    body.set_waiting(false);
    body.read(1_300 * TICK_NS);
    assert!((angle(&body) - 0.5).abs() < 1e-9);
}

#[test]
fn rejects_invalid_rotation() {
    let good = RotationParameters::ideal(INERTIA, 0.0, 0.0);
    for bad in [
        RotationParameters { inertia_kg_m2: Axes::<3>::new(1e-4, 0.0, 1e-4), ..good },
        RotationParameters { viscous: -1.0, ..good },
        RotationParameters { coulomb: f64::NAN, ..good },
        RotationParameters { max_torque_n_m: Some(0.0), ..good },
    ] {
        assert!(SimulatedRotation::new(bad, RotationHand::absent(UPRIGHT).unwrap(), 0).is_err(), "{bad:?}");
    }
    let mut body = SimulatedRotation::new(good, RotationHand::absent(UPRIGHT).unwrap(), 0).unwrap();
    assert!(body.place([2.0, 0.0, 0.0, 0.0], &Axes::zeros()).is_err());
    assert!(body.place(UPRIGHT, &Axes::<3>::new(0.0, f64::INFINITY, 0.0)).is_err());
    let rigid = TorsionSpring::new(1e9, 0.0, UPRIGHT).unwrap();
    assert!(body.with_springs(vec![rigid]).is_err(), "no number of sub-steps follows it");
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 24, ..ProptestConfig::default() })]

    /// Springs and friction add no energy, at any orientation and rate.
    #[test]
    fn unforced_body_gains_no_energy(
        inertia in prop::array::uniform3(1e-4..1e-3_f64),
        w in prop::array::uniform3(-10.0..10.0_f64),
        coulomb in prop_oneof![Just(0.0), 1e-4..1e-2_f64],
        viscous in prop_oneof![Just(0.0), 1e-5..1e-3_f64],
        stiffness in 0.01..0.5_f64,
    ) {
        let device = RotationParameters {
            inertia_kg_m2: Axes::from(inertia), ..RotationParameters::ideal(1.0, viscous, coulomb)
        };
        let body = SimulatedRotation::new(device, RotationHand::absent(UPRIGHT).unwrap(), 0).unwrap();
        let mut body = body.with_springs(vec![TorsionSpring::new(stiffness, 0.0, about_z(0.4)).unwrap()]).unwrap();
        body.place(UPRIGHT, &Axes::from(w)).unwrap();
        let energy = |body: &SimulatedRotation| body.kinetic_energy_j() + body.spring_energy_j();
        let (begun, mut last) = (energy(&body), energy(&body));
        // The spring changes side at pi, where it holds pi^2 k / 2.
        prop_assume!(begun < 4.5 * stiffness);
        for tick in 1..=300 {
            body.read(tick * TICK_NS);
            let now = energy(&body);
            prop_assert!(now <= last + 1e-10 * begun, "{} {} {}", tick, last, now);
            last = now;
        }
        if coulomb == 0.0 && viscous == 0.0 {
            prop_assert!((last - begun).abs() < 1e-8 * begun);
        } else {
            prop_assert!(last < begun);
        }
    }

    /// Ticks of 1 ms lead to where ticks of 50 us lead, wherever grip, friction, release, path and the side of the spring at
    /// pi have their events. Mostly to 2e-9 rad; an excursion across a bound for less than a quarter of a sub-step may be
    /// missed, 3e-7 rad in one of 3000 cases.
    #[test]
    fn events_fall_anywhere_in_a_tick(
        (inertia, stiffness, damping) in (3e-5..1e-3_f64, 0.1..5.0_f64, prop_oneof![Just(0.0), 0.0..0.3_f64]),
        (coulomb, viscous) in (prop_oneof![Just(0.0), 1e-4..0.03_f64], prop_oneof![Just(0.0), 0.0..1e-3_f64]),
        (strength, to) in (0.02..0.5_f64, -0.9..0.9_f64),
        (at_s, decay_s, fades) in (0.04..0.06_f64, 0.0..0.03_f64, prop::bool::ANY),
        (push, rate) in (-0.3..0.3_f64, 20.0..300.0_f64),
        is_linear in prop::bool::ANY,
    ) {
        let shape = if is_linear { LegShape::Linear } else { LegShape::MinimumJerk };
        let kind = if fades { ReleaseKind::Strength } else { ReleaseKind::Gain };
        let run = |period_ns: u64| {
            let hand = RotationHand::new(&RotationHandParameters {
                stiffness,
                damping: damping * (stiffness * inertia).sqrt(),
                strength_n_m: Some(strength),
                start_wxyz: UPRIGHT,
                legs: vec![RotationLeg { duration_s: 0.0703, end_wxyz: about_z(to), shape }],
                release: Some(Release { at_s, decay_s, kind }),
            }).unwrap();
            let device = RotationParameters::ideal(inertia, viscous, coulomb);
            let mut body = SimulatedRotation::new(device, hand, 0).unwrap();
            for tick in 0..80_u32 {
                body.write(&(Axes::<3>::z() * push * (rate * f64::from(tick) * 1e-3).sin()));
                for n in 1..=TICK_NS / period_ns {
                    body.read(u64::from(tick) * TICK_NS + n * period_ns);
                }
            }
            *body.orientation()
        };
        let (coarse, fine) = (run(TICK_NS), run(50_000));
        let off = (coarse.inverse() * fine).scaled_axis().norm();
        prop_assert!(off < 1e-6, "{:e}", off);
    }

    /// All of it turned by C moves as before, turned by C.
    #[test]
    fn the_base_frame_does_not_matter(
        by in prop::array::uniform3(-2.0..2.0_f64),
        w in prop::array::uniform3(-10.0..10.0_f64),
        torque in prop::array::uniform3(-0.01..0.01_f64),
    ) {
        let by = UnitQuaternion::from_scaled_axis(Axes::<3>::from(by));
        let wxyz = |of: UnitQuaternion<f64>| [of.w, of.i, of.j, of.k];
        let run = |frame: UnitQuaternion<f64>| {
            let device = RotationParameters {
                inertia_kg_m2: Axes::<3>::new(1e-4, 3e-4, 2e-4), ..RotationParameters::ideal(1.0, 1e-4, 1e-4)
            };
            let hand = RotationHand::new(&RotationHandParameters {
                stiffness: 0.05, damping: 1e-4, strength_n_m: None, start_wxyz: wxyz(frame), legs: Vec::new(),
                release: None,
            }).unwrap();
            let mut body = SimulatedRotation::new(device, hand, 0).unwrap();
            body.place(wxyz(frame), &(frame * Axes::<3>::from(w))).unwrap();
            body.write(&(frame * Axes::<3>::from(torque)));
            body.read(100 * TICK_NS);
            (*body.orientation(), body.angular_velocity(), body.hand_torque())
        };
        let (straight, turned) = (run(UnitQuaternion::identity()), run(by));
        prop_assert!(((by * straight.0).inverse() * turned.0).angle() < 1e-10);
        prop_assert!((by * straight.1 - turned.1).norm() < 1e-8);
        prop_assert!((by * straight.2 - turned.2).norm() < 1e-10);
    }
}
