//! Force on the finger: closed forms, conditions under which it vanishes, and its bounds.

use haptether_master::{DeviceParameters, Hand, Path, Release, ReleaseKind, SimulatedMaster};
use haptether_safety::{
    SampleBounds,
    controller::{ControllerKind, Controllers},
};
use proptest::prelude::*;

use super::*;

const PERIOD_NS: u64 = 1_000_000;
const DT: f64 = 1e-3;
const TRAVEL_M: f64 = 0.03;
const MASS_KG: f64 = 0.05;
const SCALE: f64 = 0.05;
/// Ticks over which the force rises.
const RISE: u64 = 200;

fn settings() -> TriggerSettings {
    TriggerSettings {
        travel_m: TRAVEL_M,
        device: DeviceModel::uniform(MASS_KG, 0.0, 0.0).unwrap(),
        estimator: EstimatorKind::BackwardDifference {},
        safety: SafetySettings::default(),
        limiter: LimiterSettings {
            max_force_n: 5.0,
            max_slew_n_per_s: 250.0,
            max_power_w: 5.0,
            ramp_in_s: 0.0,
        },
        force_scale: SCALE,
    }
}

fn feedback(settings: &TriggerSettings) -> TriggerFeedback {
    TriggerFeedback::new(settings, DT, RISE as f64 * DT).unwrap()
}

/// State of jaws that press on something and follow the trigger.
fn jaws(force_n: f64) -> GripperState {
    GripperState { position: Some(0.6), velocity: 0.0, force_n, holds_object: true, follows: true }
}

/// Trigger that a finger of this stiffness holds at `at_m`, until the finger lets go at `release_s`.
fn held(stiffness: f64, at_m: f64, release_s: Option<f64>) -> SimulatedMaster<1> {
    let device = DeviceParameters {
        measures_velocity: false,
        stops: (Axes::<1>::new(-1.0), Axes::<1>::new(1.0)),
        ..DeviceParameters::ideal(MASS_KG, 0.0, 0.0)
    };
    let release = release_s.map(|at_s| Release { at_s, decay_s: 0.0, kind: ReleaseKind::Gain });
    let path = Path::new(Axes::<1>::new(at_m), Vec::new()).unwrap();
    // Critically damped.
    let damping = 2.0 * (stiffness * MASS_KG).sqrt();
    SimulatedMaster::new(device, Hand::new(stiffness, damping, f64::INFINITY, path, release).unwrap(), 0)
        .unwrap()
}

fn force(tick: &SafetyTick<1>) -> f64 {
    tick.device_force[0]
}

#[test]
fn held_trigger_feels_scaled_jaw_force() {
    for (jaws_n, stiffness) in [(40.0, 300.0), (80.0, 500.0), (0.0, 300.0), (1e4, 500.0)] {
        let mut trigger = feedback(&settings());
        let mut plant = held(stiffness, 0.024, None);
        for n in 0..2000 {
            let x = plant.read(n * PERIOD_NS).position[0];
            let tick = trigger.tick(Some(x / TRAVEL_M), Some(jaws(jaws_n)), true, 1.0, 0);
            plant.write(&tick.device_force);
        }
        // In balance the finger yields by the force over its stiffness. The slowest pole, sqrt(K / m), has
        // had at least 1.8 s, and exp(-77 * 1.8) is negligible beside rounding.
        let expected = (SCALE * jaws_n).min(settings().limiter.max_force_n);
        assert!((plant.motor_force()[0] + expected).abs() < 1e-12);
        assert!((plant.hand_force()[0] - expected).abs() < 1e-9);
        assert!((plant.position()[0] - (0.024 - expected / stiffness)).abs() < 1e-12);
    }
}

#[test]
fn only_pressing_and_following_jaws_are_felt() {
    let pressing = jaws(40.0);
    let unknown = GripperState::default();
    // The force then rises from zero. If the jaws follow throughout and press on something again, only the
    // limiter's slew bounds the growth.
    let (rise, growth) = (SCALE * 40.0 / RISE as f64, settings().limiter.max_slew_n_per_s * DT);
    let free = GripperState { holds_object: false, ..pressing };
    let led_by_nobody = GripperState { follows: false, ..pressing };
    for (what, position, jaws, is_coupled, gain, next) in [
        ("jaws press on nothing", Some(0.6), Some(free), true, 1.0, growth),
        ("jaws do not follow", Some(0.6), Some(led_by_nobody), true, 1.0, rise),
        ("jaws are unknown", Some(0.6), Some(unknown), true, 1.0, rise),
        ("no frame", Some(0.6), None, true, 1.0, rise),
        ("unknown trigger", None, Some(pressing), true, 1.0, 0.0),
        ("the sides are apart", Some(0.6), Some(pressing), false, 0.0, rise),
    ] {
        let mut trigger = feedback(&settings());
        for _ in 0..2 * RISE {
            trigger.tick(Some(0.6), Some(pressing), true, 1.0, 0);
        }
        let tick = trigger.tick(position, jaws, is_coupled, gain, 0);
        assert_eq!((force(&tick), tick.rendered_force[0], tick.fault), (0.0, 0.0, None), "{what}");
        let again = force(&trigger.tick(Some(0.6), Some(pressing), true, 1.0, 0));
        assert!((again + next).abs() < 1e-12, "{what}: {again}");
    }
}

#[test]
fn force_rises_once_jaws_follow_and_fades_with_the_ladder() {
    let mut trigger = feedback(&settings());
    let still = GripperState { follows: false, ..jaws(40.0) };
    for _ in 0..50 {
        assert_eq!(force(&trigger.tick(Some(0.6), Some(still), true, 1.0, 0)), 0.0);
    }
    for n in 1..=2 * RISE {
        let share = (n as f64 / RISE as f64).min(1.0);
        let felt = force(&trigger.tick(Some(0.6), Some(jaws(40.0)), true, 1.0, 0));
        assert!((felt + SCALE * 40.0 * share).abs() < 1e-12, "{n}: {felt}");
    }
    // After the sides part, the gripper keeps its grip and stops following; the ladder fades the force.
    for n in 1..=75 {
        let gain = 1.0 - f64::from(n) / 75.0;
        let felt = force(&trigger.tick(Some(0.6), Some(still), false, gain, 0));
        assert!((felt + SCALE * 40.0 * gain).abs() < 1e-12, "{n}: {felt}");
    }
    assert_eq!(force(&trigger.tick(Some(0.6), Some(jaws(40.0)), false, 0.0, 0)), 0.0);
}

#[test]
fn released_trigger_is_no_faster_than_the_closed_form() {
    // Soft jaws: their force grows with the trigger's displacement beyond the object, k = lambda K_jaws.
    let (held_m, k, x) = (0.012, 200.0, 0.009);
    let peak = |controllers: &[ControllerKind]| {
        let scaled = SafetySettings { controllers: controllers.to_vec().into(), ..SafetySettings::default() }
            .at_scale(5.0 / 7.9, TRAVEL_M / 0.14);
        let most = MASS_KG / (5.0 * DT);
        let safety = SafetySettings {
            damping: scaled.damping.min(most),
            pc_max_damping: scaled.pc_max_damping.min(most),
            ..scaled
        };
        let limiter = LimiterSettings { max_slew_n_per_s: 1e6, ..settings().limiter };
        let mut trigger = feedback(&TriggerSettings { safety, limiter, ..settings() });
        // The finger pushes so that the trigger rests at `x` beyond the object.
        let mut plant = held(4000.0, held_m + x + k * x / 4000.0, Some(2.0));
        let mut fastest = 0.0_f64;
        for n in 0..2400 {
            let at = plant.read(n * PERIOD_NS).position[0];
            let pressing =
                GripperState { holds_object: at > held_m, ..jaws((at - held_m).max(0.0) * k / SCALE) };
            let tick = trigger.tick(Some(at / TRAVEL_M), Some(pressing), true, 1.0, 0);
            plant.write(&tick.device_force);
            if n > 2000 {
                fastest = fastest.max(-plant.velocity()[0]);
            }
        }
        fastest
    };
    let omega = (k / MASS_KG).sqrt();
    let expected = omega * x;
    let free = peak(&[]);
    // A force held over a tick is late by dT / 2, which acts as a damping of -k dT / 2. Over a quarter period
    // the speed then grows by the share omega dT pi / 8.
    //
    // The release falls on a tick, and the last tick of the push is held beyond the spring's end. This adds
    // less than k (v dT) dT / m = omega² dT² v.
    let share = omega * DT * std::f64::consts::PI / 8.0;
    let most = expected * ((2.0 * share).exp() + (omega * DT).powi(2));
    assert!((expected * (1.0 - share)..=most).contains(&free), "{free} m/s, closed form {expected}");
    for kind in ControllerKind::ALL {
        let caught = peak(&[kind]);
        assert!(caught < 0.95 * free, "{kind:?}: {caught} m/s, without {free} m/s");
    }
}

#[test]
fn controller_adds_no_force_after_the_sides_part() {
    let safety = SafetySettings {
        controllers: [ControllerKind::Vfc].into(),
        damping: 5.0,
        hold_off_s: 1.0,
        ..SafetySettings::default()
    };
    let mut trigger = feedback(&TriggerSettings { safety, ..settings() });
    for _ in 0..2 * RISE {
        trigger.tick(Some(0.9), Some(jaws(40.0)), true, 1.0, 0);
    }
    // The trigger opens at 0.9 m/s and continues after the sides part.
    let opened = |n: u32| Some(0.9 - 0.03 * f64::from(n));
    // Fast enough that the guard holds the first samples.
    for n in 0..14 {
        let tick = trigger.tick(opened(n), Some(jaws(40.0)), true, 1.0, 0);
        assert!(n < 9 || force(&tick) > 1.0, "{n}: must be damped, {}", force(&tick));
    }
    for n in 14..30 {
        let tick = trigger.tick(opened(n), Some(jaws(40.0)), false, 0.0, 0);
        assert_ne!(tick.intervention.tripped.bits(), 0);
        assert_eq!(force(&tick), 0.0);
    }
}

#[test]
fn missed_ticks_do_not_raise_the_speed() {
    // At 0.3 m/s, with three of four ticks missing.
    let mut trigger = feedback(&settings());
    for n in 0..10 {
        let tick = trigger.tick(Some(0.04 * f64::from(n)), None, true, 1.0, 3);
        let expected = if n == 0 { 0.0 } else { 0.3 };
        assert!((tick.motion.velocity[0] - expected).abs() < 1e-12, "{n}: {}", tick.motion.velocity[0]);
    }
}

#[test]
fn fault_removes_the_force_until_reset() {
    let mut trigger = feedback(&settings());
    let run = |trigger: &mut TriggerFeedback, ticks| {
        (0..ticks).map(|_| trigger.tick(Some(0.6), Some(jaws(40.0)), true, 1.0, 0)).last().unwrap()
    };
    assert!(force(&run(&mut trigger, 2 * RISE)) < 0.0);
    assert_eq!(trigger.fail(Fault::Device).fault, Some(Fault::Device));
    trigger.restart();
    let tick = run(&mut trigger, RISE);
    assert_eq!((force(&tick), tick.fault), (0.0, Some(Fault::Device)));
    trigger.reset();
    assert!((force(&run(&mut trigger, 1)) + SCALE * 40.0 / RISE as f64).abs() < 1e-12);
}

#[test]
fn invalid_settings_are_refused() {
    for bad in [
        TriggerSettings { travel_m: 0.0, ..settings() },
        TriggerSettings { travel_m: f64::NAN, ..settings() },
        TriggerSettings { travel_m: 1.1, ..settings() },
        TriggerSettings { force_scale: 0.0, ..settings() },
        TriggerSettings { force_scale: f64::INFINITY, ..settings() },
        TriggerSettings { limiter: LimiterSettings { max_force_n: 0.0, ..settings().limiter }, ..settings() },
    ] {
        assert!(TriggerFeedback::new(&bad, DT, 0.2).is_err(), "{bad:?}");
    }
}

proptest! {
    /// For any jaws, any motion of the finger, with and without controllers.
    #[test]
    fn norm_growth_and_power_hold_at_every_tick(
        ticks in prop::collection::vec((0.0..=1.0f64, 0.0..=1e4f64, any::<(bool, bool, bool)>(), 0.0..=1.0f64), 1..200),
        watched in any::<bool>(),
    ) {
        let limiter = settings().limiter;
        let controllers = if watched { ControllerKind::ALL.into() } else { Controllers::NONE };
        let most = MASS_KG / (5.0 * DT);
        let safety = SafetySettings { controllers, damping: most, pc_max_damping: most, ..settings().safety };
        let mut trigger = feedback(&TriggerSettings { safety, ..settings() });
        trigger.layer = trigger.layer.with_samples(SampleBounds::UNBOUNDED);
        let mut before = 0.0_f64;
        for (position, force_n, (holds_object, follows, is_coupled), gain) in ticks {
            let state = GripperState { holds_object, follows, ..jaws(force_n) };
            let gain = if is_coupled { 1.0 } else { gain };
            let tick = trigger.tick(Some(position), Some(state), is_coupled, gain, 0);
            let felt = force(&tick);
            prop_assert!(tick.fault.is_none());
            prop_assert!(felt.abs() <= limiter.max_force_n * (1.0 + 1e-12));
            prop_assert!(felt * tick.motion.velocity[0] <= limiter.max_power_w + 1e-9);
            prop_assert!(tick.rendered_force[0] <= 0.0, "the jaws never close the trigger");
            prop_assert!(tick.rendered_force[0] == 0.0 || holds_object);
            let grown = if felt * before > 0.0 { felt.abs() - before.abs() } else { felt.abs() };
            prop_assert!(grown <= limiter.max_slew_n_per_s * DT + 1e-9);
            before = felt;
        }
    }
}

#[test]
fn unknown_trigger_is_felt_again_after_the_next_engagement() {
    let mut trigger = feedback(&settings());
    let run = |trigger: &mut TriggerFeedback, position, is_coupled, ticks| {
        let gain = f64::from(u8::from(is_coupled));
        (0..ticks)
            .map(|_| force(&trigger.tick(position, Some(jaws(40.0)), is_coupled, gain, 0)))
            .last()
            .unwrap()
    };
    assert!(run(&mut trigger, Some(0.6), true, 2 * RISE) < 0.0);
    assert_eq!(run(&mut trigger, None, true, 1), 0.0);
    assert_eq!(run(&mut trigger, Some(0.6), true, 5 * RISE), 0.0, "a gap must not clear a trip");
    assert_eq!(run(&mut trigger, Some(0.6), false, 1), 0.0);
    assert!((run(&mut trigger, Some(0.6), true, 1) + SCALE * 40.0 / RISE as f64).abs() < 1e-12);
    // An unknown position while the sides are apart does not withhold the force.
    assert_eq!(run(&mut trigger, None, false, 1), 0.0);
    assert!(run(&mut trigger, Some(0.6), true, 2 * RISE) < 0.0);
}
