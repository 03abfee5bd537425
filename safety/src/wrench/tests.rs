//! Force and torque on one hand, with and without shared trips.

use nalgebra::Quaternion;

use super::*;
use crate::{
    DeviceModel, LimiterSettings, RotationModel, Signal,
    controller::{ControllerKind, Controllers, SafetySettings, Tripped},
    estimator::EstimatorKind,
};

const PERIOD: f64 = 1e-3;

/// VFC trips on velocity, so that the test can trip each side separately.
fn settings(shares_trips: bool, controllers: Controllers) -> WrenchSettings {
    let safety = SafetySettings {
        controllers,
        damping: 4.0,
        hold_off_s: 0.01,
        release_ramp_s: 0.02,
        ..SafetySettings::default()
    };
    let limiter = LimiterSettings { ramp_in_s: 0.0, max_slew_n_per_s: 1e6, ..LimiterSettings::default() };
    let lever = 0.05;
    WrenchSettings {
        translation: LayerSettings {
            device: DeviceModel::uniform(0.157, 0.0, 0.0).unwrap(),
            period_s: PERIOD,
            estimator: EstimatorKind::default(),
            safety,
            limiter,
        },
        rotation: RotationSettings {
            device: RotationModel::new(Axes::repeat(4e-4), 0.0, 0.0).unwrap(),
            period_s: PERIOD,
            estimator: EstimatorKind::default(),
            safety: safety.at_lever(lever),
            limiter: limiter.at_lever(lever),
        },
        shares_trips,
    }
}

fn vfc() -> Controllers {
    [ControllerKind::Vfc].into()
}

fn along_x(value: f64) -> Axes<3> {
    Axes::<3>::new(value, 0.0, 0.0)
}

/// Create a layer without sample bounds, since the test sets velocities without matching positions.
fn unguarded(settings: &WrenchSettings) -> WrenchLayer {
    WrenchLayer::new(settings).unwrap().with_samples(SampleBounds::UNBOUNDED, SampleBounds::UNBOUNDED)
}

/// Return a pose at rest with these velocities; only V matters to VFC.
fn moving(velocity: f64, angular_velocity: f64) -> PoseSample {
    PoseSample {
        position: Axes::zeros(),
        orientation: UnitQuaternion::from_scaled_axis(along_x(0.3)),
        velocity: Some(along_x(velocity)),
        angular_velocity: Some(along_x(angular_velocity)),
    }
}

const RESTS: (f64, f64) = (0.0, 0.0);
const FORCE: f64 = 2.0;
const TORQUE: f64 = 0.1;

/// Run these velocities; return device force, device torque and trips of each tick.
fn run(layer: &mut WrenchLayer, ticks: &[(f64, f64)]) -> Vec<(f64, f64, [Tripped; 2])> {
    let tick = |(v, w): &(f64, f64)| {
        let tick = layer.tick(&moving(*v, *w), &along_x(FORCE), &along_x(TORQUE));
        let tripped = [tick.translation.intervention.tripped, tick.rotation.intervention.tripped];
        (tick.translation.device_force[0], tick.rotation.device_force[0], tripped)
    };
    ticks.iter().map(tick).collect()
}

#[test]
fn shared_trip_acts_and_fades_on_both_sides() {
    let own = Tripped::of(ControllerKind::Vfc);
    // 16 rad/s is above V_t / r = 12 rad/s; the power of the torque is then 1.6 W.
    for (unsafe_tick, whose) in [((1.0, 0.0), 0), ((0.0, 16.0), 1)] {
        let mut ticks = vec![RESTS; 60];
        ticks[10] = unsafe_tick;
        let both = run(&mut unguarded(&settings(true, vfc())), &ticks);
        let apart = run(&mut unguarded(&settings(false, vfc())), &ticks);
        assert_eq!(both[9], (FORCE, TORQUE, [Tripped::NONE; 2]));
        let (force, torque, tripped) = both[10];
        assert_eq!((tripped[whose], tripped[1 - whose]), (own, Tripped::HELD));
        // F_c = -F_v - mu V.
        let expected = (-4.0 * unsafe_tick.0, -4.0 * 0.05 * 0.05 * unsafe_tick.1);
        assert!(
            (force - expected.0).abs() < 1e-12 && (torque - expected.1).abs() < 1e-12,
            "{force} {torque}"
        );
        for (n, (force, torque, tripped)) in both.iter().enumerate().skip(11) {
            let held = if n < 40 { Tripped::HELD } else { Tripped::NONE };
            assert_eq!(*tripped, [held; 2], "{n}");
            assert!((force / FORCE - torque / TORQUE).abs() < 1e-12, "both follow one law: {n}");
            assert_eq!(*force == FORCE, n >= 40, "{n}");
        }
        let other = |one: &(f64, f64, [Tripped; 2])| if whose == 0 { one.1 / TORQUE } else { one.0 / FORCE };
        assert!(apart.iter().all(|one| other(one) == 1.0 && !one.2[1 - whose].any()), "not shared");
        assert_eq!(apart[10].2[whose], own);
    }
}

/// Without shared trips, or without trips, neither side affects the other.
#[test]
fn each_side_equals_its_own_layer() {
    let all: Controllers = ControllerKind::ALL.into_iter().collect();
    for (shares_trips, controllers) in [(false, all), (true, [ControllerKind::Pc].into())] {
        let settings = settings(shares_trips, controllers);
        let mut both = WrenchLayer::new(&settings).unwrap();
        let mut translation = SafetyLayer::new(&settings.translation).unwrap();
        let mut rotation = RotationLayer::new(&settings.rotation).unwrap();
        let (mut acted, mut missed) = ([0; 2], 0);
        for n in 0..800 {
            let t = f64::from(n) * PERIOD;
            let wave =
                |a: f64, rate: f64| Axes::<3>::new(a * (rate * t).sin(), a * (rate * t).cos(), a * 0.3);
            let sample = PoseSample {
                position: wave(0.03, 20.0),
                orientation: UnitQuaternion::from_scaled_axis(wave(0.5, 17.0)),
                velocity: None,
                angular_velocity: None,
            };
            let (force, torque) = (wave(3.0, 31.0), wave(0.1, 23.0));
            if n % 50 == 7 {
                missed = 1;
                continue;
            }
            let tick = both.tick_after(missed, &sample, &force, &torque, 0.7);
            let one = translation.tick_after(missed, &sample.position, None, &force, 0.7);
            let two = rotation.tick_after(missed, &sample.orientation, None, &torque, 0.7);
            missed = 0;
            // Compared as text, since NaN marks values that are not observed.
            assert_eq!(format!("{:?}", tick.translation), format!("{one:?}"), "{n}");
            assert_eq!(format!("{:?}", tick.rotation), format!("{two:?}"), "{n}");
            acted[0] += u32::from(one.intervention.tripped.any());
            acted[1] += u32::from(two.intervention.tripped.any());
        }
        assert!(acted.iter().all(|ticks| *ticks > 10), "{acted:?}");
    }
}

/// A hand gets its torque back after a shared trip, although HSC sees nobody hold while the torque is cancelled.
#[test]
fn holding_hand_ends_a_shared_intervention() {
    let mut both = settings(true, [ControllerKind::Hsc].into());
    both.translation.safety.controllers = vfc();
    for safety in [&mut both.translation.safety, &mut both.rotation.safety] {
        (safety.hold_off_s, safety.release_ramp_s) = (0.1, 0.2);
    }
    // Below this threshold, the damping of the fading intervention exceeds the torque that has returned.
    both.rotation.safety.hsc_force_threshold_n = 0.02;
    both.rotation.limiter.ramp_in_s = 0.5;
    let mut layer = unguarded(&both);
    let (torque, mut last) = (along_x(TORQUE), Axes::<3>::zeros());
    let (mut held, mut angle, mut w) = (Vec::new(), 0.0, 0.0);
    for n in 0..2500 {
        let mut sample = moving(if n == 1000 { 1.0 } else { 0.0 }, w);
        sample.orientation = UnitQuaternion::from_scaled_axis(along_x(angle));
        let tick = layer.tick(&sample, &along_x(FORCE), &torque);
        last = tick.rotation.device_force;
        held.push(tick.rotation.intervention.tripped.any());
        for _ in 0..10 {
            w += (last[0] - 2.0 * angle - 0.05 * w) / 4e-4 * PERIOD / 10.0;
            angle += w * PERIOD / 10.0;
        }
    }
    assert!(!held[999] && held[1000], "tripped by the other side");
    assert!(!held[2499] && (last - torque).norm() < 1e-9, "the torque is back");
}

#[test]
fn fault_of_one_side_stops_both() {
    for shares_trips in [true, false] {
        let mut layer = unguarded(&settings(shares_trips, vfc()));
        run(&mut layer, &[RESTS; 10]);
        let rests = moving(0.0, 0.0);
        let mut no_place = rests;
        no_place.position[1] = f64::NAN;
        let mut no_direction = rests;
        no_direction.orientation = UnitQuaternion::new_unchecked(Quaternion::new(1.0, 0.1, 0.0, 0.0));
        for (sample, fault) in [
            (no_place, Fault::NotFinite(Signal::Position)),
            (no_direction, Fault::OutOfRange(Signal::Orientation)),
        ] {
            for sample in [sample, rests, rests] {
                let tick = layer.tick(&sample, &along_x(FORCE), &along_x(TORQUE));
                for side in [tick.translation, tick.rotation] {
                    assert_eq!((side.device_force, side.fault), (Axes::zeros(), Some(fault)));
                }
            }
            layer.restart(&rests.position, &rests.orientation).unwrap();
            assert_eq!(layer.tick(&rests, &along_x(1.0), &along_x(0.0)).rotation.fault, Some(fault));
            assert!(layer.reset(&rests.position, &no_direction.orientation).is_err());
            assert!(layer.reset(&no_place.position, &rests.orientation).is_err());
            layer.reset(&rests.position, &rests.orientation).unwrap();
            assert_eq!(layer.tick(&rests, &along_x(1.0), &along_x(0.0)).rotation.fault, None);
        }
        layer.fail(Fault::Device);
        let tick = layer.tick(&rests, &along_x(FORCE), &along_x(TORQUE));
        assert_eq!((tick.translation.fault, tick.rotation.fault), (Some(Fault::Device), Some(Fault::Device)));
    }
}

/// A missed tick counts on both sides like a normal tick, so that they stay in step.
#[test]
fn missed_ticks_hold_off_in_both() {
    let mut layer = unguarded(&settings(true, vfc()));
    run(&mut layer, &[RESTS, (1.0, 0.0), RESTS]);
    for _ in 0..15 {
        layer.missed(&moving(0.0, 0.0));
    }
    for (force, torque, tripped) in run(&mut layer, &[RESTS; 40]) {
        assert_eq!(tripped[0], tripped[1]);
        assert!((force / FORCE - torque / TORQUE).abs() < 1e-12);
    }
    for (v, w) in [(1.0, 0.0), (0.0, 16.0)] {
        layer.reset(&Axes::zeros(), &moving(0.0, 0.0).orientation).unwrap();
        run(&mut layer, &[RESTS; 3]);
        layer.missed(&moving(v, w));
        assert_eq!(run(&mut layer, &[RESTS])[0].2, [Tripped::HELD; 2], "tripped at a missed tick");
    }
}

#[test]
fn shared_trips_require_equal_times() {
    let good = settings(true, vfc());
    let change = |change: fn(&mut WrenchSettings)| {
        let mut changed = good;
        change(&mut changed);
        WrenchLayer::new(&changed).map(|_| ()).map_err(|error| error.name)
    };
    assert_eq!(change(|_| ()), Ok(()));
    assert_eq!(change(|of| of.rotation.period_s = 2e-3), Err("period_s"));
    assert_eq!(change(|of| of.rotation.safety.hold_off_s = 0.2), Err("hold_off_s"));
    assert_eq!(change(|of| of.rotation.safety.release_ramp_s = f64::NAN), Err("release_ramp_s"));
    assert_eq!(change(|of| (of.rotation.safety.hold_off_s, of.shares_trips) = (0.2, false)), Ok(()));
}

/// With 7.9 N on 45 g and 0.395 N m on 1e-4 kg m² at 5 ms, each sample changes V by more than dV.
#[test]
fn own_acceleration_of_a_light_device_is_no_outlier() {
    let (mass_kg, inertia, period_s) = (0.045, 1e-4, 5e-3);
    let mut light = settings(false, vfc());
    light.translation.device = DeviceModel::uniform(mass_kg, 0.0, 0.0).unwrap();
    light.rotation.device = RotationModel::new(Axes::repeat(inertia), 0.0, 0.0).unwrap();
    (light.translation.period_s, light.rotation.period_s) = (period_s, period_s);
    (light.translation.safety.damping, light.rotation.safety.damping) = (0.5, 1e-3);
    let [force, torque] =
        [light.translation.limiter, light.rotation.limiter].map(|limiter| limiter.max_force_n);
    assert!(force / mass_kg * period_s > 0.5 && torque / inertia * period_s > 0.5 / 0.05);
    for shares in [[1.0, 0.0], [0.0, 1.0]] {
        let mut layer = WrenchLayer::<3>::new(&light).unwrap();
        for tick in 0..5_u32 {
            let half_square = 0.5 * (f64::from(tick.saturating_sub(2)) * period_s).powi(2);
            let [x, angle] =
                [shares[0] * force / mass_kg, shares[1] * torque / inertia].map(|a| a * half_square);
            let sample = PoseSample {
                position: along_x(x),
                orientation: UnitQuaternion::from_scaled_axis(along_x(angle)),
                velocity: None,
                angular_velocity: None,
            };
            layer.tick(&sample, &Axes::zeros(), &Axes::zeros());
            assert!(!layer.translation.guard().holds(), "{shares:?} at tick {tick}");
        }
    }
}
