//! Skipping objects out of reach changes no bit.
#![allow(clippy::unwrap_used)] // a test may

use haptether_slave::{
    ArmControl, ArmModel, Axes, Contact, ContactLaw, Environment, FreeBody, Object, ObjectMotion, PushShape,
    Pusher, Shape, SimulatedSlave, SlaveSample,
};

type V3 = Axes<3>;

/// A small generator: the test must be deterministic.
struct Draws(u64);

impl Draws {
    fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 11) as f64 * 2_f64.powi(-52) - 1.0
    }

    fn vector(&mut self, size: f64) -> V3 {
        V3::new(self.next(), self.next(), self.next()) * size
    }
}

fn environment(draws: &mut Draws, spread: f64, bodies: bool) -> Environment<3> {
    let mut objects = Vec::new();
    for index in 0..1000_u32 {
        let centre = draws.vector(spread);
        let size = 0.01 + 0.01 * draws.next().abs();
        let shape = match index % 3 {
            0 => Shape::sphere(centre, size),
            1 => Shape::cuboid(centre, V3::new(size, 2.0 * size, 0.5 * size)),
            2 if index == 302 => Shape::plane(V3::new(-0.55, 0.1, 0.0), V3::new(3.0, 1.0, 0.5)),
            _ => Shape::sphere(centre, 0.3 * size),
        };
        let law = ContactLaw::KelvinVoigt { stiffness: 500.0, damping: 2.0 };
        let contact = Contact::new(law, 0.3).unwrap();
        objects.push(match index % 5 {
            0 => {
                let motion = ObjectMotion::new(draws.vector(0.2), 0.1, 0.9, draws.vector(0.02), 3.0).unwrap();
                Object::moving(shape.unwrap(), contact, motion).unwrap()
            }
            1 if bodies => {
                let body = FreeBody::new(0.2, 0.1, 0.05, draws.vector(0.3)).unwrap();
                Object::free(shape.unwrap(), contact, body).unwrap()
            }
            _ => Object::fixed(shape.unwrap(), contact).unwrap(),
        });
    }
    Environment::new(objects, Vec::new())
}

#[test]
fn a_random_walk_feels_the_same_force() {
    let mut draws = Draws(7);
    let mut environment = environment(&mut draws, 0.3, false);
    let (mut x, mut touched) = (V3::zeros(), 0);
    for tick in 0..4000_u32 {
        // Mostly small steps, sometimes a large one.
        let size = if tick % 97 == 0 { 0.3 } else { 2e-3 };
        x = (x + draws.vector(size)).map(|c| c.clamp(-0.35, 0.35));
        let v = draws.vector(1.0);
        let time = f64::from(tick) * 1e-3;
        let force = environment.force(&x, &v, time);
        assert_eq!(force, environment.force_of_all(&x, &v, time), "{tick}");
        touched += u32::from(force.norm() > 0.0);
    }
    assert!((100..3600).contains(&touched), "the walk should be in and out of contact: {touched}");
}

#[test]
fn sliding_bodies_are_not_forgotten() {
    let mut draws = Draws(3);
    let mut environment = environment(&mut draws, 0.12, true);
    let (mut x, mut touched) = (V3::zeros(), 0);
    for tick in 0..600_u32 {
        let v = draws.vector(2.0);
        let time = f64::from(tick) * 1e-3;
        let force = environment.force(&x, &v, time);
        assert_eq!(force, environment.force_of_all(&x, &v, time), "{tick}");
        touched += u32::from(force.norm() > 0.0);
        environment.advance(time, 1e-3, &x, &v);
        x += v * 1e-3;
    }
    assert!(touched > 40, "{touched}");
}

/// Samples of an arm that draws a Lissajous figure of up to 6 cm above a floor, and the number of ticks in contact.
fn drawn(extra: Vec<Object<3>>, pushers: Vec<Pusher<3>>, period_ns: u64) -> (Vec<SlaveSample<3>>, u32) {
    let arm = ArmModel::new(ArmControl::Position { bandwidth_hz: 12.0 }, 3.0, Some(0.6), Some(20.0)).unwrap();
    let law = ContactLaw::KelvinVoigt { stiffness: 900.0, damping: 3.0 };
    let floor = Shape::plane(V3::new(0.0, -0.03, 0.0), V3::new(0.0, 1.0, 0.0)).unwrap();
    let mut objects = vec![Object::fixed(floor, Contact::new(law, 0.0).unwrap()).unwrap()];
    objects.extend(extra);
    let environment = Environment::new(objects, pushers);
    let mut slave = SimulatedSlave::in_environment(arm, environment, None, V3::zeros(), 0).unwrap();
    slave.start(0);
    let mut touched = 0;
    let samples = (1..=2_000_000_000 / period_ns)
        .map(|tick| {
            let t = (tick * period_ns) as f64 * 1e-9;
            slave.write(&V3::new(0.06 * (5.0 * t).sin(), 0.05 * (7.0 * t).sin(), 0.02 * t), &V3::zeros());
            let sample = slave.read(tick * period_ns);
            touched += u32::from(slave.touches());
            sample
        })
        .collect();
    (samples, touched)
}

fn ball(centre: V3, radius: f64) -> Object<3> {
    let law = ContactLaw::HuntCrossley { stiffness: 2e4, exponent: 1.5, damping: 0.5 };
    Object::fixed(Shape::sphere(centre, radius).unwrap(), Contact::new(law, 0.3).unwrap()).unwrap()
}

#[test]
fn objects_out_of_reach_do_not_change_the_motion() {
    for period_ns in [500_000, 1_000_000, 8_000_000] {
        let (alone, touched) = drawn(Vec::new(), Vec::new(), period_ns);
        assert!(touched > 20);
        let mut draws = Draws(11);
        let contact = Contact::new(ContactLaw::KelvinVoigt { stiffness: 500.0, damping: 2.0 }, 0.3).unwrap();
        let mut far: Vec<_> = (0..1000).map(|n| ball(V3::new(0.5, 0.0, 0.01 * f64::from(n)), 0.05)).collect();
        let cuboid = Shape::cuboid(V3::new(-0.4, 0.0, 0.0), V3::new(0.1, 0.2, 0.1)).unwrap();
        let motion = ObjectMotion::new(draws.vector(0.03), 0.1, 0.9, draws.vector(0.02), 3.0).unwrap();
        far.push(Object::moving(cuboid, contact, motion).unwrap());
        let slope = Shape::plane(V3::new(0.0, 0.6, 0.0), V3::new(0.1, -1.0, 0.2)).unwrap();
        far.push(Object::fixed(slope, contact).unwrap());
        assert_eq!(drawn(far, Vec::new(), period_ns).0, alone);
    }
}

/// Near is not in contact: 3 or 4 mm from a ball, a fixed box and an approaching box.
#[test]
fn near_objects_without_contact_do_not_change_the_motion() {
    for period_ns in [500_000, 1_000_000] {
        let (alone, touched) = drawn(Vec::new(), Vec::new(), period_ns);
        assert!(touched > 20);
        let farthest = |axis: usize| {
            // Only positions clear of the floor: a tick in which contact starts or ends has no bound.
            let places = alone.iter().map(|sample| sample.position).filter(|position| position[1] > -0.01);
            places.max_by(|a, b| a[axis].total_cmp(&b[axis])).unwrap()
        };
        let (right, top) = (farthest(0), farthest(1));
        let contact = Contact::new(ContactLaw::KelvinVoigt { stiffness: 500.0, damping: 2.0 }, 0.3).unwrap();
        // Less than the radius of 1 cm for near objects, more than the bound on the travel of a tick.
        let gap = 3e-3;
        let lid = Shape::cuboid(top + V3::new(0.0, gap + 0.01, 0.0), V3::repeat(0.01)).unwrap();
        let comes = ObjectMotion::new(V3::new(-0.1, 0.0, 0.0), 0.1, 0.3, V3::zeros(), 0.0).unwrap();
        let moving = Shape::cuboid(right + V3::new(gap + 0.041, 0.0, 0.0), V3::repeat(0.02)).unwrap();
        for near in [
            vec![ball(top + V3::new(0.0, gap + 0.02, 0.0), 0.02)],
            vec![Object::fixed(lid, contact).unwrap()],
            vec![Object::moving(moving, contact, comes).unwrap()],
        ] {
            let (with, touched_too) = drawn(near, Vec::new(), period_ns);
            assert_eq!(touched_too, touched);
            let other = with.iter().zip(&alone).position(|(with, alone)| with != alone);
            assert_eq!(other, None, "{period_ns}");
        }
    }
}

#[test]
fn an_arm_that_meets_a_ball_is_integrated_there() {
    let met = || vec![ball(V3::new(0.05, 0.03, 0.01), 0.02), ball(V3::new(-0.06, -0.02, 0.01), 0.025)];
    // A sine push without force makes the integrator solve the whole motion.
    let no_push = Pusher::shaped(PushShape::Sine { frequency_hz: 1.0 }, 0.0, 1.0, V3::zeros()).unwrap();
    let (alone, at_floor) = drawn(Vec::new(), Vec::new(), 1_000_000);
    let (partly, touched) = drawn(met(), Vec::new(), 1_000_000);
    let (integrated, touched_too) = drawn(met(), vec![no_push], 1_000_000);
    assert!(touched > at_floor + 20 && touched == touched_too, "{touched} {touched_too} {at_floor}");
    assert_ne!(partly, alone);
    let mut exact = 0;
    for ((a, b), free) in partly.iter().zip(&integrated).zip(&alone) {
        // 2000 steps, each with an error of 1e-10 of some cm.
        assert!((a.position - b.position).norm() < 1e-9, "{:e}", (a.position - b.position).norm());
        exact += u32::from(a == free);
    }
    assert!(exact > 20, "until the first contact it is solved: {exact}");
}
