//! Test of the rotation layer: spins, tops, principal axes, frames, invalid values.

use std::f64::consts::{PI, TAU};

use nalgebra::Quaternion;
use proptest::prelude::*;

use super::*;
use crate::{
    ActiveLimits,
    controller::{ControllerKind, Controllers, Tripped},
    estimator::{Estimator as _, Fit},
};

const PERIOD: f64 = 1e-3;
const QUANTUM: f64 = 2.3e-5;
const KINDS: [EstimatorKind; 5] = [
    EstimatorKind::BackwardDifference {},
    EstimatorKind::LowPass { cutoff_hz: 30.0 },
    EstimatorKind::SavitzkyGolay { degree: 2, window: 15 },
    EstimatorKind::Kalman { jerk_density: 10.0, quantum_m: QUANTUM },
    EstimatorKind::AdaptiveWindow { noise_bound_m: QUANTUM, max_window: 16, fit: Fit::End },
];

/// HSC makes the layer estimate the grasp torque; an unreachable threshold keeps it from acting.
fn watching(inertia: [f64; 3], estimator: EstimatorKind) -> RotationSettings {
    let safety = SafetySettings {
        controllers: [ControllerKind::Hsc].into(),
        hsc_force_threshold_n: 1e3,
        ..SafetySettings::default().at_lever(0.05)
    };
    RotationSettings {
        device: RotationModel::new(Axes::from(inertia), 0.0, 0.0).unwrap(),
        period_s: PERIOD,
        estimator,
        safety,
        limiter: LimiterSettings { ramp_in_s: 0.0, ..LimiterSettings::default() },
    }
}

fn about(axis: usize, angle: f64) -> UnitQuaternion<f64> {
    UnitQuaternion::from_scaled_axis(along(axis, angle))
}

fn along(axis: usize, value: f64) -> Axes<3> {
    Axes::from_fn(|at, _| if at == axis { value } else { 0.0 })
}

fn negated(of: &UnitQuaternion<f64>) -> UnitQuaternion<f64> {
    UnitQuaternion::new_unchecked(-of.into_inner())
}

#[test]
fn spin_is_as_exact_after_a_hundred_turns_as_after_one() {
    let (axis, speed) = (Axes::<3>::new(2.0, -1.0, 2.0) / 3.0, 30.0);
    let (step, torque) =
        (UnitQuaternion::from_scaled_axis(axis * speed * PERIOD), Axes::<3>::new(0.1, -0.2, 0.3));
    for kind in KINDS {
        let mut layer = RotationLayer::new(&watching([2e-4; 3], kind)).unwrap();
        let mut flipped = layer.clone();
        let mut orientation = UnitQuaternion::identity();
        let ticks = (100.0 * TAU / (speed * PERIOD)).ceil();
        let mut n = 0.0;
        while n < ticks {
            let tick = layer.tick(&orientation, None, &torque);
            // q and -q are the same rotation.
            let sign = if n % 7.0 < 3.0 { negated(&orientation) } else { orientation };
            let seen = |tick: SafetyTick<3>| (tick.motion, tick.grasp_force, tick.device_force, tick.fault);
            assert_eq!(seen(flipped.tick(&sign, None, &torque)), seen(tick), "{kind:?} {n}");
            if n > 700.0 {
                // A sample and the sum are wrong by about 2e-15 rad; no estimator weights them more than differences
                // do.
                let apart = (tick.motion.velocity - axis * speed).norm();
                assert!(apart < 4e-15 / PERIOD, "{kind:?} {n}: {apart}");
                assert!(tick.motion.acceleration.norm() < 1.2e-14 / (PERIOD * PERIOD), "{kind:?} {n}");
            }
            assert!(layer.turned.amax() <= REBASE);
            orientation = UnitQuaternion::new_normalize((orientation * step).into_inner());
            n += 1.0;
        }
    }
}

/// A free symmetric top, R = `exp(L t / I_1) exp(-l e_3 t)` with `l = (I_3 - I_1) w_3 / I_1`, shows no hand torque.
///
/// Source: Goldstein, Poole and Safko 2002, section 5.6.
#[test]
fn free_top_shows_no_hand() {
    let (inertia, w_t, w_3) = ([1e-4, 1e-4, 3e-4], 4.0, 9.0);
    let rate: f64 = (inertia[2] - inertia[0]) / inertia[0] * w_3;
    let spin = Axes::<3>::new(w_t, 0.0, inertia[2] / inertia[0] * w_3);
    let gyroscopic = (inertia[2] - inertia[0]) * w_3 * w_t;
    let speed = w_t.hypot(w_3);
    // Means over one or two ticks of a and of w in w x I w, and the Magnus term of the increments: each about (rate
    // T)^2 / 12.
    let of_ticks = PERIOD * PERIOD * rate * (rate + speed) / 4.0;
    let bandwidth = (12.0 * 10.0 / (QUANTUM * QUANTUM * PERIOD)).powf(1.0 / 6.0);
    for (estimator, tolerance) in [
        (None, of_ticks),
        (Some(KINDS[0]), of_ticks),
        // V and A lag by the same filter.
        (Some(KINDS[1]), of_ticks),
        // The slope of a parabola at the end of a window W is wrong by x''' W² / 20; the limit has a margin of 2.
        (Some(KINDS[2]), (rate * 15.0 * PERIOD).powi(2) / 10.0),
        // The error of V in the filter's Butterworth form is 2 (rate / omega)²; sampling adds half of it.
        (Some(KINDS[3]), 3.0 * (rate / bandwidth).powi(2)),
    ] {
        let settings = watching(inertia, estimator.unwrap_or(KINDS[0]));
        let mut layer = RotationLayer::new(&settings).unwrap();
        let mut most = 0.0_f64;
        for n in 0..3000 {
            let t = f64::from(n) * PERIOD;
            let orientation = UnitQuaternion::from_scaled_axis(spin * t)
                * UnitQuaternion::from_scaled_axis(along(2, -rate * t));
            let (sine, cosine) = (rate * t).sin_cos();
            let body = Axes::<3>::new(w_t * cosine, w_t * sine, w_3);
            let w = orientation * body;
            let seen = layer.tick(&orientation, estimator.is_none().then_some(&w), &Axes::zeros());
            if n > 700 {
                most = most.max(seen.grasp_force.norm());
                // Without the gyroscopic torque, a hand would seem to turn the top.
                let alone = seen.grasp_force - orientation * settings.device.gyroscopic_torque(&body);
                assert!(alone.norm() > 0.9 * gyroscopic);
            }
        }
        // Rounding of a second difference: I 4 * 4e-15 / dT².
        let rounding = 3e-4 * 1.6e-14 / (PERIOD * PERIOD);
        assert!(most < tolerance * gyroscopic + rounding, "{estimator:?}: {most} {}", tolerance * gyroscopic);
    }
}

/// About one principal axis the rotation equals a point: `w x I w` is zero and the frame has no effect.
#[test]
fn rotation_about_a_principal_axis_equals_a_point() {
    let inertia = Axes::<3>::new(2e-4, 3e-4, 4e-4);
    let (viscous, coulomb) = (1e-4, 2e-3);
    let safety = SafetySettings {
        controllers: ControllerKind::ALL.into_iter().collect(),
        velocity_threshold: 6.0,
        vfc_force_threshold_n: 0.1,
        hsc_force_threshold_n: 0.05,
        damping: 5e-3,
        pc_max_damping: 5e-3,
        energy_threshold_j: -1e-3,
        hold_off_s: 0.02,
        release_ramp_s: 0.05,
        ..SafetySettings::default()
    };
    let limiter =
        LimiterSettings { max_force_n: 0.3, max_slew_n_per_s: 40.0, max_power_w: 2.0, ramp_in_s: 0.05 };
    for kind in KINDS {
        for (axis, measures) in [(0, false), (1, false), (2, false), (0, true), (1, true), (2, true)] {
            let device = RotationModel::new(inertia, viscous, coulomb).unwrap();
            let settings = RotationSettings { device, period_s: PERIOD, estimator: kind, safety, limiter };
            let mut rotation = RotationLayer::new(&settings).unwrap();
            let device = DeviceModel::new(inertia, Axes::repeat(viscous), Axes::repeat(coulomb)).unwrap();
            let point = LayerSettings { device, period_s: PERIOD, estimator: kind, safety, limiter };
            let mut point = SafetyLayer::new(&point).unwrap();
            let (mut last, mut at, mut trips) = (about(axis, 0.0), Axes::zeros(), 0);
            for n in 0..1500 {
                let t = f64::from(n) * PERIOD;
                let (angle, w) = (1.5 * (6.0 * t).sin(), along(axis, 9.0 * (6.0 * t).cos()));
                let torque = along(axis, 0.25 * (11.0 * t).sin());
                let orientation = about(axis, angle);
                at += (last.inverse() * orientation).scaled_axis();
                last = orientation;
                let measured = measures.then_some(&w);
                let (turned, moved) =
                    (rotation.tick(&orientation, measured, &torque), point.tick(&at, measured, &torque));
                // NaN would mark a value that is not observed; here all are observed.
                assert_eq!(turned, moved, "{kind:?} {axis} {n}");
                trips += u32::from(moved.intervention.tripped.any());
            }
            assert!((50..1450).contains(&trips), "trips must come and go, or the test shows little: {trips}");
        }
    }
}

/// A torque that is constant in the base frame does not grow as the body turns.
#[test]
fn held_torque_is_constant_in_the_base_frame() {
    let limiter = LimiterSettings { max_slew_n_per_s: 10.0, ramp_in_s: 0.0, ..LimiterSettings::default() };
    let mut settings = RotationSettings { limiter, ..watching([2e-4; 3], KINDS[0]) };
    settings.safety.controllers = Controllers::NONE;
    let mut layer = RotationLayer::new(&settings).unwrap();
    let torque = Axes::<3>::new(0.3, 0.4, 0.0);
    for n in 0..500 {
        let w = along(2, 30.0);
        let tick = layer.tick(&about(2, 0.03 * f64::from(n)), Some(&w), &torque);
        if n > 60 {
            assert!(!tick.acted.contains(ActiveLimits::SLEW), "{n}");
            assert!((tick.device_force - torque).norm() < 1e-14 && (tick.motion.velocity - w).norm() < 1e-13);
        }
    }
}

/// A hand that turns a handle against a torque of the base frame is seen to exert that torque.
#[test]
fn hand_on_a_turning_handle_is_seen() {
    for estimator in [None, Some(KINDS[0]), Some(KINDS[3])] {
        let mut layer = RotationLayer::new(&watching([2e-4; 3], estimator.unwrap_or(KINDS[0]))).unwrap();
        let (torque, w) = (Axes::<3>::new(0.2, 0.1, -0.1), Axes::<3>::new(3.0, 4.0, 0.0));
        for n in 0..1000 {
            let orientation = UnitQuaternion::from_scaled_axis(w * (f64::from(n) * PERIOD));
            let tick = layer.tick(&orientation, estimator.is_none().then_some(&w), &torque);
            if n > 700 {
                // The torque at the middle of the last tick, the mean of the last two, or with the lag of a kernel of
                // 8 ms.
                let ago = |ticks: f64| UnitQuaternion::from_scaled_axis(w * (ticks * PERIOD)) * torque;
                let (expected, tolerance) = match estimator {
                    None => (ago(0.5), 1e-12),
                    Some(EstimatorKind::BackwardDifference {}) => ((ago(0.5) + ago(1.5)) / 2.0, 1e-11),
                    _ => (ago(8.0), 5.0 * 4e-3 * torque.norm()),
                };
                let apart = (tick.grasp_force + expected).norm();
                assert!(apart < tolerance, "{estimator:?} {n}: {apart}");
            }
        }
    }
}

#[test]
fn full_and_half_turns_have_no_effect() {
    let safety = SafetySettings {
        controllers: ControllerKind::ALL.into_iter().collect(),
        ..SafetySettings::default().at_lever(0.05)
    };
    for kind in KINDS {
        let mut layer =
            RotationLayer::new(&RotationSettings { safety, ..watching([2e-3; 3], kind) }).unwrap();
        let speed = 2.0 * PI;
        for n in 0..4000 {
            let t = f64::from(n) * PERIOD;
            // The rotation starts from rest; angles are within -pi and pi, as a driver may give them.
            let angle = if t < 1.0 { speed * t * t * t * (1.0 - t / 2.0) } else { speed * (t - 0.5) };
            let orientation = about(1, angle - TAU * (angle / TAU).round());
            let tick = layer.tick(&orientation, None, &Axes::zeros());
            assert!(tick.fault.is_none() && tick.motion.velocity.norm() < speed * 1.001, "{kind:?} {n}");
            assert!(!tick.intervention.tripped.contains(Tripped::of(ControllerKind::Vfc)));
        }
    }
}

#[test]
fn invalid_values_stop_the_layer_in_the_same_tick() {
    let good = about(0, 0.1);
    let quaternion = |w, i, j, k| UnitQuaternion::new_unchecked(Quaternion::new(w, i, j, k));
    let none = Axes::<3>::zeros();
    let not_unit = "orientation is no unit quaternion: its norm is not 1 to 1e-9";
    for (orientation, w, torque, name) in [
        (quaternion(f64::NAN, 0.0, 0.0, 0.0), none, none, "orientation is not a finite number"),
        (quaternion(1.0, f64::INFINITY, 0.0, 0.0), none, none, "orientation is not a finite number"),
        (quaternion(1.0 + 2e-9, 0.0, 0.0, 0.0), none, none, not_unit),
        (quaternion(0.0, 0.0, 0.0, 0.0), none, none, not_unit),
        (quaternion(1e200, 0.0, 0.0, 1e200), none, none, not_unit),
        (good, along(1, f64::NAN), none, "angular velocity is not a finite number"),
        (good, along(1, 2e3), none, "angular velocity exceeds 1000 rad/s"),
        (good, none, along(2, f64::NAN), "rendered torque is not a finite number"),
        (good, none, along(2, -2e4), "rendered torque exceeds 10000 N m"),
    ] {
        let mut settings = watching([2e-4; 3], KINDS[0]);
        settings.safety.controllers = Controllers::NONE;
        let mut layer = RotationLayer::new(&settings).unwrap();
        let push = along(0, 0.5);
        for _ in 0..5 {
            layer.tick(&good, Some(&none), &push);
        }
        assert!(layer.tick(&good, Some(&none), &push).device_force[0] > 0.4);
        for _ in 0..3 {
            let tick = layer.tick(&orientation, Some(&w), &torque);
            assert_eq!(tick.device_force, none);
            assert_eq!(tick.fault.unwrap().to_string(), name);
        }
        let fault = layer.tick(&good, Some(&none), &push).fault;
        assert!(fault.is_some(), "latched");
        layer.restart(&good).unwrap();
        assert_eq!(layer.tick(&good, Some(&none), &push).fault, fault);
        if check(&orientation).is_err() {
            assert!(layer.reset(&orientation).is_err() && layer.restart(&orientation).is_err());
        }
        layer.reset(&good).unwrap();
        assert!(layer.tick(&good, Some(&none), &push).fault.is_none());
    }
    let mut layer = RotationLayer::new(&watching([2e-4; 3], KINDS[0])).unwrap();
    layer.fail(Fault::Device);
    assert_eq!(layer.tick(&good, None, &none).fault, Some(Fault::Device));
    assert!(quaternion(1.0 + 5e-10, 0.0, 0.0, 0.0).norm() > 1.0);
    assert!(check(&quaternion(1.0 + 5e-10, 0.0, 0.0, 0.0)).is_ok());
}

#[test]
fn late_loop_does_not_read_several_ticks_as_one() {
    let settings = watching([2e-4; 3], KINDS[3]);
    // Unbounded, since the guard would detect the gap.
    let mut carried = RotationLayer::new(&settings).unwrap().with_samples(SampleBounds::UNBOUNDED);
    let sample = |n: i32| about(2, 0.01 * f64::from(n));
    let none = Axes::zeros();
    for n in 0..1000 {
        carried.tick(&sample(n), None, &none);
    }
    let mut blind = carried.clone();
    let worst = |layer: &mut RotationLayer, missed: u64| {
        let late = layer.tick_after(missed, &sample(1008), None, &none, 1.0).grasp_force.norm();
        (1009..1030).map(|n| layer.tick(&sample(n), None, &none).grasp_force.norm()).fold(late, f64::max)
    };
    assert!(worst(&mut carried, 8) < 1e-9);
    assert!(worst(&mut blind, 0) > 0.1, "the missed ticks must matter, or the test shows nothing");
}

/// On SO(3) as for a point, a stop is accepted after 3 ticks, and an outlier or a step causes no velocity.
#[test]
fn samples_off_the_path_cause_no_velocity() {
    let tilt = UnitQuaternion::from_scaled_axis(Axes::<3>::new(0.4, -0.3, 0.1));
    let wrong = UnitQuaternion::from_scaled_axis(Axes::<3>::new(0.5, 0.2, -0.9));
    let stepped = UnitQuaternion::from_scaled_axis(Axes::<3>::new(0.0, 0.05, 0.0));
    let torque = along(1, 0.05);
    for kind in 0..3 {
        let settings = watching([2e-4; 3], KINDS[3]);
        let mut held = RotationLayer::new(&settings).unwrap();
        let mut direct = RotationLayer::new(&settings).unwrap().with_samples(SampleBounds::UNBOUNDED);
        for n in 0..200 {
            let truth = about(2, 0.015 * f64::from(if kind == 0 { n.min(100) } else { n })) * tilt;
            let seen = match kind {
                1 if n == 100 => wrong * truth,
                2 if n >= 100 => stepped * truth,
                _ => truth,
            };
            let one = held.tick(&seen, None, &torque);
            let other = direct.tick(&truth, None, &torque);
            assert_eq!(one.fault, None);
            assert!((one.device_force - other.device_force).norm() < 1e-9, "{kind} {n}");
            if !(100..104).contains(&n) {
                // After the step, all of the motion is expressed in the stepped frame.
                let frame = if kind == 2 && n >= 104 { stepped } else { UnitQuaternion::identity() };
                let error = one.motion.velocity - frame * other.motion.velocity;
                assert!(error.norm() < 1e-6, "{kind} {n}: {error}");
            }
        }
    }
}

#[test]
fn reset_clears_the_past() {
    let mut settings = watching([1e-4, 2e-4, 3e-4], KINDS[3]);
    settings.safety.hsc_force_threshold_n = 1e-2;
    let next = |layer: &mut RotationLayer| {
        let tick = |n: i32| {
            let turn = Axes::<3>::new(0.01, -0.02, 0.005) * f64::from(n);
            let seen = layer.tick(&UnitQuaternion::from_scaled_axis(turn), None, &along(1, 0.3));
            (seen.device_force, seen.grasp_force)
        };
        (0..60).map(tick).collect::<Vec<_>>()
    };
    let mut fresh = RotationLayer::new(&settings).unwrap();
    let as_new = next(&mut fresh);
    assert_ne!(next(&mut fresh), as_new, "the past must matter");
    fresh.reset(&UnitQuaternion::identity()).unwrap();
    assert_eq!(next(&mut fresh), as_new);
}

#[test]
fn invalid_devices_are_refused() {
    for (inertia, b, c, name) in [
        ([1e-4, 0.0, 1e-4], 0.0, 0.0, "inertia_kg_m2"),
        ([1e-4, 1e-4, f64::NAN], 0.0, 0.0, "inertia_kg_m2"),
        ([1e-4; 3], f64::INFINITY, 0.0, "viscous"),
        ([1e-4; 3], 0.0, -1e-9, "coulomb"),
    ] {
        assert_eq!(RotationModel::new(Axes::from(inertia), b, c).unwrap_err().name, name);
    }
    let model = RotationModel::new(Axes::<3>::new(1.0, 2.0, 3.0), 0.5, 0.1).unwrap();
    let motion =
        Motion { velocity: Axes::<3>::new(3.0, 0.0, 4.0), acceleration: Axes::<3>::new(1.0, 1.0, 1.0) };
    // I a + w x I w + b w + c w / |w| - tau, computed by hand: w x I w = (0, 4 * 3 - 3 * 12, 0).
    let torque = model.grasp_torque(&motion, &Axes::<3>::new(1.0, 0.0, 0.0));
    assert!((torque - Axes::<3>::new(1.0 + 1.5 + 0.06 - 1.0, 2.0 - 24.0, 3.0 + 2.0 + 0.08)).norm() < 1e-14);
    assert_eq!(model.kinetic_energy_j(&motion.velocity), 0.5 * (9.0 + 48.0));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(32))]

    /// The result rotates with the base frame, R to C R, for any body; for an isotropic body also with the body
    /// frame.
    #[test]
    fn frames_do_not_matter(
        by in prop::array::uniform3(-3.0..3.0_f64),
        phase in prop::array::uniform3(0.0..6.0_f64),
        relabels in any::<bool>(),
        measures in any::<bool>(),
    ) {
        let by = UnitQuaternion::from_scaled_axis(Axes::<3>::from(by));
        let inertia = if relabels { [2e-4; 3] } else { [1e-4, 2e-4, 4e-4] };
        let mut settings = watching(inertia, KINDS[3]);
        settings.safety = SafetySettings {
            controllers: [ControllerKind::Hsc, ControllerKind::Wsc].into(),
            hold_off_s: 0.01, release_ramp_s: 0.02, ..SafetySettings::default().at_lever(0.05)
        };
        let mut straight = RotationLayer::new(&settings).unwrap();
        let mut turned = straight.clone();
        for n in 0..300 {
            let t = f64::from(n) * PERIOD;
            let wave = |amplitude: f64, rate: f64| Axes::<3>::from(phase).map(|p| amplitude * (rate * t + p).sin());
            let orientation = UnitQuaternion::from_scaled_axis(wave(0.8, 5.0));
            let (w, torque) = (wave(3.0, 5.0), wave(0.2, 9.0));
            let body_frame = if relabels { by.inverse() } else { UnitQuaternion::identity() };
            let seen = straight.tick(&orientation, measures.then_some(&w), &torque);
            let (w, torque) = (by * w, by * torque);
            let other = turned.tick(&(by * orientation * body_frame), measures.then_some(&w), &torque);
            for (one, two, tolerance) in [
                (seen.motion.velocity, other.motion.velocity, 1e-9),
                (seen.motion.acceleration, other.motion.acceleration, 1e-6),
                (seen.grasp_force, other.grasp_force, 1e-9),
                (seen.rendered_force, other.rendered_force, 1e-9),
            ] {
                prop_assert!((by * one - two).norm() < tolerance, "{}: {} {}", n, by * one, two);
            }
            let observed = seen.intervention.observed;
            // Near a threshold, rounding decides the trip.
            let is_close = (observed[ControllerKind::Hsc] - 1.5).abs() < 1e-6
                || (observed[ControllerKind::Wsc] + 0.03).abs() < 1e-9
                || (seen.rendered_force.norm() - settings.safety.hsc_force_threshold_n).abs() < 1e-9;
            if is_close {
                break;
            }
            prop_assert_eq!(seen.intervention.tripped, other.intervention.tripped);
            prop_assert!((by * seen.device_force - other.device_force).norm() < 1e-9);
            let of = [seen, other].map(|one| one.intervention.safety_force);
            prop_assert!((by * of[0] - of[1]).norm() < 1e-9);
        }
    }

    /// A shift of the origin changes no estimate, for any past of the estimator.
    #[test]
    fn shifted_origin_changes_no_estimate(
        steps in prop::collection::vec(-300..300_i32, 60..200),
        at in 1..50_usize,
    ) {
        for kind in KINDS {
            let mut fixed = kind.build::<1>(PERIOD).unwrap();
            let mut moved = fixed.clone();
            let (mut x, mut origin) = (0.0, 0.0);
            for (n, step) in steps.iter().enumerate() {
                // Binary fractions, so that a shift by 8 is exact.
                x += f64::from(*step) / 65536.0;
                if n == at {
                    origin = -REBASE;
                    moved.shift(&Axes::from([origin]));
                }
                let (one, two) = (fixed.step(&Axes::from([x])), moved.step(&Axes::from([x + origin])));
                let rounding = 4.0 * f64::EPSILON * 16.0;
                prop_assert!((one.velocity - two.velocity).amax() <= rounding / PERIOD, "{:?} {}", kind, n);
                let apart = (one.acceleration - two.acceleration).amax();
                prop_assert!(apart <= 4.0 * rounding / (PERIOD * PERIOD), "{:?} {}: {}", kind, n, apart);
                let force = Axes::from([x * 3.0]);
                prop_assert!((fixed.align(&force) - moved.align(&force)).amax() < 1e-12);
            }
        }
    }
}
