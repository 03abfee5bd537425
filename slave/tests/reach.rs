//! Leaving out objects that are out of reach changes no bit.
#![allow(clippy::unwrap_used)] // a test may

use haptether_slave::{Axes, Contact, ContactLaw, Environment, FreeBody, Object, ObjectMotion, Shape};

type V3 = Axes<3>;

/// A small generator: the test must be the same every time.
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
        // Mostly small steps, sometimes a leap.
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
