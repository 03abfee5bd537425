//! Arms against closed forms, and the exact solution against the integrator.
#![allow(clippy::unwrap_used)] // a test may

use haptether_slave::{
    ArmControl, ArmModel, Axes, Contact, ContactLaw, Environment, Object, PushShape, Pusher, Shape,
    SimulatedSlave,
};

const MS: u64 = 1_000_000;

fn voigt(stiffness: f64, damping: f64) -> Contact {
    Contact::new(ContactLaw::KelvinVoigt { stiffness, damping }, 0.0).unwrap()
}

/// A sine push without force, which forces the use of the integrator.
fn no_push<const N: usize>() -> Pusher<N> {
    Pusher::shaped(PushShape::Sine { frequency_hz: 1.0 }, 0.0, 1.0, Axes::zeros()).unwrap()
}

#[test]
fn pd_is_the_damped_oscillator_of_the_textbook() {
    let (mass, stiffness, damping, goal, speed) = (2.0_f64, 800.0, 24.0, 0.03, 0.2);
    let arm = ArmModel::new(ArmControl::Pd { stiffness, damping }, mass, None, None).unwrap();
    // x'' = K/M (goal - x) + B/M (V_cmd - x'): rests at goal + B V_cmd / K.
    let (sigma, rest) = (damping / (2.0 * mass), goal + damping * speed / stiffness);
    let rate = (stiffness / mass - sigma * sigma).sqrt();
    for (pushers, exact, tolerance) in [(Vec::new(), true, 1e-12), (vec![no_push()], false, 1e-9)] {
        let mut slave = SimulatedSlave::in_environment(
            arm,
            Environment::new(Vec::new(), pushers),
            None,
            Axes::<1>::zeros(),
            0,
        )
        .unwrap();
        assert_eq!(slave.is_exact(), exact);
        slave.write(&Axes::<1>::new(goal), &Axes::<1>::new(speed));
        for tick in 1..=700_u32 {
            let sample = slave.read(u64::from(tick) * MS);
            let t = f64::from(tick) * 1e-3;
            let decay = (-sigma * t).exp();
            let (sin, cos) = (rate * t).sin_cos();
            let x = rest - rest * decay * (cos + sigma / rate * sin);
            let v = rest * decay * (stiffness / mass / rate) * sin;
            assert!((sample.position[0] - x).abs() < tolerance, "{tick}: {:e}", sample.position[0] - x);
            assert!(
                (sample.velocity[0] - v).abs() < 10.0 * tolerance,
                "{tick}: {:e}",
                sample.velocity[0] - v
            );
        }
    }
}

#[test]
fn a_velocity_control_is_critically_damped_and_an_admittance() {
    let (mass, goal, speed, force) = (3.0, 0.5, 0.03, 6.0);
    let pole = std::f64::consts::TAU * 10.0;
    let arm = ArmModel::new(ArmControl::Velocity { bandwidth_hz: 10.0 }, mass, None, None).unwrap();
    let push = Pusher::shaped(PushShape::Step, 0.0, 9.0, Axes::<1>::new(force)).unwrap();
    let environment = Environment::new(Vec::new(), vec![push]);
    let mut slave = SimulatedSlave::in_environment(arm, environment, None, Axes::zeros(), 0).unwrap();
    slave.start(0);
    slave.write(&Axes::<1>::new(goal), &Axes::<1>::new(speed));
    // M x'' = M w ((w / 4) (x_cmd - x) + V_cmd - x') + F: both poles are w / 2.
    let rest = goal + 4.0 * speed / pole + force / (0.25 * mass * pole * pole);
    for tick in 1..=400_u32 {
        let at = 0.5 * pole * f64::from(tick) * 1e-3;
        let off = slave.read(u64::from(tick) * MS).position[0] - rest * (1.0 - (1.0 + at) * (-at).exp());
        assert!(off.abs() < 1e-9, "{tick}: {off:e}");
    }
    // Held in place.
    let held = slave.stop()[0];
    assert!((slave.read(3000 * MS).position[0] - held - (rest - goal - 4.0 * speed / pole)).abs() < 1e-9);
}

#[test]
fn limits_hold_at_every_sample_and_are_reached() {
    let (speed, acceleration) = (0.4, 3.0);
    for control in [ArmControl::Position { bandwidth_hz: 12.0 }, ArmControl::Velocity { bandwidth_hz: 12.0 }]
    {
        let arm = ArmModel::new(control, 2.0, Some(speed), Some(acceleration)).unwrap();
        let mut slave =
            SimulatedSlave::in_environment(arm, Environment::empty(), None, Axes::<3>::zeros(), 0).unwrap();
        let (mut before, mut fastest, mut hardest) = (Axes::<3>::zeros(), 0.0_f64, 0.0_f64);
        for tick in 1..=4000_u32 {
            if tick % 777 == 1 {
                let k = f64::from(tick / 777);
                slave.write(&Axes::<3>::new(0.3 * (k * 2.3).sin(), 0.4 * k.cos(), 0.01 * k), &Axes::zeros());
            }
            let v = slave.read(u64::from(tick) * MS).velocity;
            // The arm has no overshoot and smooths the motion: neither speed nor acceleration grows.
            fastest = fastest.max(v.amax());
            hardest = hardest.max((v - before).amax() / 1e-3);
            before = v;
        }
        assert!(fastest <= speed * (1.0 + 1e-9) && fastest > 0.95 * speed, "{control:?}: {fastest}");
        assert!(
            hardest <= acceleration * (1.0 + 1e-6) && hardest > 0.95 * acceleration,
            "{control:?}: {hardest}"
        );
    }
}

#[test]
fn a_limited_set_position_takes_the_shortest_time_and_does_not_overshoot() {
    // 0.1 m at 2 m/s² and at most 0.3 m/s: 0.15 s up, 0.0275 m / 0.3 m/s... in closed form d / v + v / a.
    let arm = ArmModel::new(ArmControl::Position { bandwidth_hz: 400.0 }, 1.0, Some(0.3), Some(2.0)).unwrap();
    let mut slave =
        SimulatedSlave::in_environment(arm, Environment::empty(), None, Axes::<1>::zeros(), 0).unwrap();
    slave.write(&Axes::<1>::new(0.1), &Axes::zeros());
    let arrives = 0.1 / 0.3 + 0.3 / 2.0;
    let mut lag = None;
    for tick in 1..=1000_u32 {
        let x = slave.read(u64::from(tick) * MS).position[0];
        assert!(x <= 0.1 + 1e-12, "{tick}: {x}");
        let t = f64::from(tick) * 1e-3;
        if x > 0.1 - 1e-7 && lag.is_none() {
            lag = Some(t - arrives);
        }
    }
    // The arm lags by 2 / w = 0.8 ms and settles to 1e-7 within a few more time constants.
    let lag = lag.unwrap();
    assert!((-1e-3..5e-3).contains(&lag), "{lag}");
}

#[test]
fn stop_brakes_within_the_limits() {
    let arm = ArmModel::new(ArmControl::Position { bandwidth_hz: 20.0 }, 2.0, Some(0.5), Some(4.0)).unwrap();
    let mut slave =
        SimulatedSlave::in_environment(arm, Environment::empty(), None, Axes::<1>::zeros(), 0).unwrap();
    slave.write(&Axes::<1>::new(1.0), &Axes::zeros());
    slave.read(500 * MS);
    slave.stop();
    // The set position was at v²/2a + v (0.5 s - v/a) and brakes over v²/2a.
    let rest = 0.5 * 0.5 / 4.0 + 0.5 * (0.5 - 0.5 / 4.0);
    let end = slave.read(1500 * MS);
    assert!((end.position[0] - rest).abs() < 1e-9 && end.velocity[0].abs() < 1e-9, "{end:?}");
}

#[test]
fn exact_and_adaptive_agree() {
    let controls =
        [ArmControl::Position { bandwidth_hz: 15.0 }, ArmControl::Pd { stiffness: 900.0, damping: 30.0 }];
    // Without a limit on its acceleration the set position arrives within nearly every tick, at a different time on
    // each axis.
    let limits = controls.into_iter().flat_map(|control| [(control, Some(6.0)), (control, None)]);
    for (control, acceleration) in limits {
        for (stiffness, damping) in [(800.0, 0.0), (2e4, 40.0), (1e6, 0.0)] {
            let arm = ArmModel::new(control, 1.5, Some(0.5), acceleration).unwrap();
            let run = |extra: Option<Pusher<2>>| {
                let floor = Shape::plane(Axes::<2>::zeros(), Axes::<2>::new(0.0, 1.0)).unwrap();
                let wall = Shape::plane(Axes::<2>::new(0.02, 0.0), Axes::<2>::new(-2.0, 0.0)).unwrap();
                let spring = Shape::spring(Axes::<2>::new(0.0, 0.05)).unwrap();
                let objects = vec![
                    Object::fixed(floor, voigt(stiffness, damping)).unwrap(),
                    Object::fixed(wall, voigt(0.5 * stiffness, 2.0 * damping)).unwrap(),
                    Object::fixed(spring, voigt(30.0, 1.0)).unwrap(),
                ];
                let force = Axes::<2>::new(-8.0, 5.0);
                let push = Pusher::shaped(PushShape::Ramp { rise_s: 0.0503 }, 0.1507, 0.2, force).unwrap();
                let pushers = [Some(push), extra].into_iter().flatten().collect();
                let start = Axes::<2>::new(0.0, 0.01);
                let environment = Environment::new(objects, pushers);
                let mut slave = SimulatedSlave::in_environment(arm, environment, None, start, 0).unwrap();
                slave.start(0);
                let mut touched = 0;
                let samples: Vec<_> = (1..=600_u32)
                    .map(|tick| {
                        let t = f64::from(tick) * 1e-3;
                        let goal = Axes::<2>::new(0.03 * (9.0 * t).sin(), -0.01 + 0.03 * (14.0 * t).cos());
                        slave.write(&goal, &Axes::<2>::new(0.27 * (9.0 * t).cos(), -0.42 * (14.0 * t).sin()));
                        let sample = slave.read(u64::from(tick) * MS);
                        touched += u32::from(sample.position[1] < 0.0) + u32::from(sample.position[0] > 0.02);
                        sample
                    })
                    .collect();
                assert!(touched > 30, "{touched}");
                assert_eq!(slave.coarse_steps(), 0);
                (samples, slave.is_exact())
            };
            let (exact, adaptive) = (run(None), run(Some(no_push())));
            assert!(exact.1 && !adaptive.1);
            for (tick, (a, b)) in exact.0.iter().zip(&adaptive.0).enumerate() {
                // 600 ticks of several steps, each with an error of 1e-10 of some cm; bounces on a stiff wall amplify
                // it.
                let off = (a.position - b.position).norm();
                assert!(off < 1e-9, "{control:?} {acceleration:?} {stiffness} {damping} {tick}: {off:e}");
            }
        }
    }
}
