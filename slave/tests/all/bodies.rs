//! Free bodies: momentum, stopping distance, stiction.
#![allow(clippy::unwrap_used)] // a test may

use haptether_slave::{
    ArmControl, ArmModel, Axes, Contact, ContactLaw, Environment, FreeBody, Object, PushShape, Pusher, Shape,
    SimulatedSlave,
};

const MS: u64 = 1_000_000;

fn voigt(stiffness: f64, damping: f64, friction: f64) -> Contact {
    Contact::new(ContactLaw::KelvinVoigt { stiffness, damping }, friction).unwrap()
}

#[test]
fn an_oblique_push_conserves_momentum() {
    for law in [
        ContactLaw::KelvinVoigt { stiffness: 2e4, damping: 15.0 },
        ContactLaw::HuntCrossley { stiffness: 1e6, exponent: 1.5, damping: 0.8 },
    ] {
        let arm = ArmModel::new(ArmControl::Pd { stiffness: 0.0, damping: 0.0 }, 0.4, None, None).unwrap();
        let shape = Shape::sphere(Axes::<3>::new(0.05, 0.004, -0.003), 0.02).unwrap();
        let body = FreeBody::new(0.15, 0.0, 0.0, Axes::<3>::new(-0.1, 0.05, 0.02)).unwrap();
        let ball = Object::free(shape, Contact::new(law, 0.4).unwrap(), body).unwrap();
        let push = Pusher::shaped(PushShape::HalfSine, 0.0, 0.01, Axes::<3>::new(20.0, 0.0, 0.0)).unwrap();
        let environment = Environment::new(vec![ball], vec![push]);
        let mut slave = SimulatedSlave::in_environment(arm, environment, None, Axes::zeros(), 0).unwrap();
        slave.start(0);
        let momentum = |slave: &mut SimulatedSlave<3>, tick: u64| {
            let tool = slave.read(tick * MS).velocity;
            tool * 0.4 + slave.environment().body_velocity(0).unwrap() * 0.15
        };
        // 20 N over a half sine of 10 ms: 2 / pi of the product.
        let pushed = Axes::<3>::new(20.0 * 0.01 * 2.0 / std::f64::consts::PI, 0.0, 0.0);
        let start = Axes::<3>::new(-0.1, 0.05, 0.02) * 0.15 + pushed;
        for tick in 10..300 {
            let now = momentum(&mut slave, tick);
            assert!((now - start).norm() < 1e-10, "{law:?} {tick}: {:e}", (now - start).norm());
        }
        let hit = slave.environment().body_velocity(0).unwrap();
        assert!(hit[0] > 0.3 && hit[1] > 0.06, "it was hit off its centre: {hit}");
        assert_eq!(slave.coarse_steps(), 0);
    }
}

#[test]
fn a_body_stops_where_its_friction_says() {
    // Within reach of the tool (integrated) and far from it (closed form).
    for gap in [0.002, 0.5] {
        let start = Axes::<2>::new(0.24, 0.32);
        let shape = Shape::sphere(Axes::<2>::new(gap + 0.01, 0.0), 0.01).unwrap();
        let body = FreeBody::new(0.5, 0.0, 1.5, start).unwrap();
        let ball = Object::free(shape, voigt(1e3, 0.0, 0.0), body).unwrap();
        let mut environment = Environment::new(vec![ball], Vec::new());
        let from = environment.body_position(0).unwrap();
        let origin = Axes::<2>::zeros();
        for tick in 0..300_u32 {
            environment.advance(f64::from(tick) * 1e-3, 1e-3, &origin, &origin);
        }
        let way = environment.body_position(0).unwrap() - from;
        // v² / (2 mu g) with mu g = c / m
        let expected = start.normalize() * (0.4 * 0.4 / (2.0 * 1.5 / 0.5));
        assert!((way - expected).norm() < 1e-9, "{gap}: {:e}", (way - expected).norm());
        assert_eq!(environment.body_velocity(0).unwrap(), origin);
    }
}

#[test]
fn friction_holds_a_body_up_to_its_limit() {
    let pressed = |force: f64| {
        let shape = Shape::plane(Axes::<1>::new(0.0), Axes::<1>::new(-1.0)).unwrap();
        let body = FreeBody::new(0.5, 0.0, 2.0, Axes::zeros()).unwrap();
        let block = Object::free(shape, voigt(1e4, 20.0, 0.0), body).unwrap();
        let arm = ArmModel::new(ArmControl::Pd { stiffness: 0.0, damping: 40.0 }, 1.0, None, None).unwrap();
        let push = Pusher::shaped(PushShape::Ramp { rise_s: 0.5 }, 0.0, 9.0, Axes::<1>::new(force)).unwrap();
        let environment = Environment::new(vec![block], vec![push]);
        let mut slave =
            SimulatedSlave::in_environment(arm, environment, None, Axes::<1>::new(-1e-5), 0).unwrap();
        slave.start(0);
        slave.read(2000 * MS);
        let environment = slave.environment();
        (environment.body_position(0).unwrap()[0], environment.body_velocity(0).unwrap()[0])
    };
    // While the push rises at 4 N/s the contact, at 100 rad/s, oscillates about it by up to 4 / 100 N.
    assert_eq!(pressed(1.95), (0.0, 0.0), "not by a hair");
    let (position, velocity) = pressed(2.5);
    // Both creep at (2.5 - 2) N / 40 N s/m.
    assert!((velocity - 0.0125).abs() < 1e-6, "{velocity}");
    assert!((0.015..0.025).contains(&position), "{position}");
}

#[test]
fn a_body_is_moved_alike_in_one_step_and_in_many() {
    // The same push in one step of 20 ms and in 20 steps of 1 ms.
    let run = |steps: u32| {
        let shape = Shape::sphere(Axes::<2>::new(0.012, 0.003), 0.01).unwrap();
        let body = FreeBody::new(0.05, 0.5, 0.1, Axes::zeros()).unwrap();
        let ball = Object::free(shape, voigt(2e3, 1.0, 0.2), body).unwrap();
        let mut environment = Environment::new(vec![ball], Vec::new());
        let velocity = Axes::<2>::new(0.5, 0.0);
        let step = 0.02 / f64::from(steps);
        for k in 0..steps {
            let t = f64::from(k) * step;
            environment.advance(t, step, &(velocity * t), &velocity);
        }
        (environment.body_position(0).unwrap(), environment.body_velocity(0).unwrap())
    };
    let (one, many) = (run(1), run(20));
    assert!((one.0 - many.0).norm() < 1e-11 && (one.1 - many.1).norm() < 1e-8, "{one:?} {many:?}");
    assert!(one.1.norm() > 0.1);
}
