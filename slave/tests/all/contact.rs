//! Restitution and friction of contacts.
#![allow(clippy::unwrap_used)] // a test may

use haptether_slave::{
    ArmControl, ArmModel, Axes, Contact, ContactLaw, Environment, Object, ObjectMotion, PushShape, Pusher,
    Shape, SimulatedSlave,
};
use proptest::prelude::*;

const MS: u64 = 1_000_000;

/// A mass without control.
fn free_mass(mass_kg: f64) -> ArmModel {
    ArmModel::new(ArmControl::Pd { stiffness: 0.0, damping: 0.0 }, mass_kg, None, None).unwrap()
}

fn voigt(stiffness: f64, damping: f64, friction: f64) -> Contact {
    Contact::new(ContactLaw::KelvinVoigt { stiffness, damping }, friction).unwrap()
}

#[test]
fn an_undamped_bounce_conserves_energy() {
    for stiffness in [1e3, 1e5, 1e7] {
        // Two planes that face each other along an oblique line, and a push at the start.
        let along = Axes::<2>::new(0.6, 0.8);
        let plane = |at: f64, side: f64| {
            let shape = Shape::plane(along * at, along * side).unwrap();
            Object::fixed(shape, voigt(stiffness, 0.0, 0.0)).unwrap()
        };
        let push = Pusher::shaped(PushShape::Step, 0.0, 0.01, along * 20.0).unwrap();
        let environment = Environment::new(vec![plane(-0.02, 1.0), plane(0.02, -1.0)], vec![push]);
        let mut slave =
            SimulatedSlave::in_environment(free_mass(0.2), environment, None, Axes::zeros(), 0).unwrap();
        slave.start(0);
        assert!(!slave.is_exact());
        let energy = |slave: &mut SimulatedSlave<2>, now_ns: u64| {
            let sample = slave.read(now_ns);
            0.5 * 0.2 * sample.velocity.norm_squared()
                + 0.5 * sample.true_environment_force.norm_squared() / stiffness
        };
        let start = energy(&mut slave, 10 * MS);
        assert!((start - 0.5 * 0.2).abs() < 1e-9, "20 N for 10 ms on 0.2 kg is 1 m/s: {start}");
        let (mut turned, mut before) = (0, 1.0);
        for tick in 11..=500 {
            let now = energy(&mut slave, tick * MS);
            let off = now / start - 1.0;
            assert!(off.abs() < 1e-9 * f64::from(1 + turned), "K = {stiffness}, tick {tick}: {off:e}");
            let speed = slave.read(tick * MS).velocity.dot(&along);
            turned += u32::from(speed * before < 0.0);
            before = speed;
        }
        assert!(turned >= 5, "{turned}");
        assert_eq!(slave.coarse_steps(), 0);
    }
}

/// From 20 ms, 20 N accelerate 0.2 kg by 0.1 m/s per ms for 50 ms; further starts have no effect.
#[test]
fn pushers_begin_once() {
    let push = Pusher::shaped(PushShape::Step, 0.0, 0.05, Axes::<1>::new(20.0)).unwrap();
    let environment = Environment::new(Vec::new(), vec![push]);
    let mut slave =
        SimulatedSlave::in_environment(free_mass(0.2), environment, None, Axes::zeros(), 0).unwrap();
    slave.begin(10 * MS);
    for (now_ms, speed) in [(20, 0.0), (40, 2.0), (60, 4.0), (90, 5.0), (150, 5.0)] {
        let seen = slave.read(now_ms * MS).velocity[0];
        assert!((seen - speed).abs() < 1e-9, "{now_ms} ms: {seen}");
        slave.start(now_ms * MS);
    }
}

/// Restitution of Hunt and Crossley: `v dv / (1 + chi v)` is the same on the way in and out.
fn restitution(chi: f64, v: f64) -> f64 {
    let work = |s: f64| s / chi - (chi * s).ln_1p() / (chi * chi);
    let (mut low, mut high) = (0.0, 1.0);
    for _ in 0..60 {
        let middle = 0.5 * (low + high);
        if work(-middle * v) < work(v) { low = middle } else { high = middle }
    }
    low
}

#[test]
fn hunt_and_crossley_restitution_matches_the_theory() {
    for (exponent, chi, v) in [(1.5, 0.05, 0.2), (1.5, 0.3, 0.2), (1.0, 0.2, 0.5), (2.0, 1.0, 0.3)] {
        let law = ContactLaw::HuntCrossley { stiffness: 1e5, exponent, damping: chi };
        let shape = Shape::plane(Axes::<1>::new(-0.001), Axes::<1>::new(1.0)).unwrap();
        // The plane moves towards the mass.
        let motion = ObjectMotion::new(Axes::<1>::new(v), 0.0, 10.0, Axes::zeros(), 0.0).unwrap();
        let plane = Object::moving(shape, Contact::new(law, 0.0).unwrap(), motion).unwrap();
        let environment = Environment::new(vec![plane], Vec::new());
        let mut slave =
            SimulatedSlave::in_environment(free_mass(0.5), environment, None, Axes::zeros(), 0).unwrap();
        let sample = slave.read(600 * MS);
        assert_eq!(sample.true_environment_force[0], 0.0, "it has left");
        let e = sample.velocity[0] / v - 1.0;
        assert!((e - restitution(chi, v)).abs() < 1e-8, "{exponent} {chi} {v}: {e} {}", restitution(chi, v));
        // First order of Hunt and Crossley; the next term is below (chi v)².
        assert!((e - (1.0 - 2.0 / 3.0 * chi * v)).abs() < (chi * v).powi(2), "{e}");
    }
}

#[test]
fn damping_that_would_pull_is_left_out() {
    let contact = voigt(100.0, 10.0, 0.0);
    for (depth, rate, force) in
        [(0.1, 0.0, 10.0), (0.1, 0.5, 15.0), (0.1, -0.5, 5.0), (0.1, -2.0, 0.0), (-0.1, 9.0, 0.0)]
    {
        assert!((contact.normal_force(depth, rate) - force).abs() < 1e-13);
    }
}

proptest! {
    #[test]
    fn friction_opposes_slip_within_its_cone(
        depth in 1e-4..0.01_f64,
        v in prop::array::uniform3(-1.0..1.0_f64),
        tiny in 0..2_u8,
        mu in 0.0..1.5_f64,
    ) {
        let scale = if tiny == 1 { 1e-4 } else { 1.0 };
        let v = Axes::<3>::from(v) * scale;
        let shape = Shape::plane(Axes::<3>::zeros(), Axes::<3>::new(0.0, 0.0, 1.0)).unwrap();
        let plane = Object::fixed(shape, voigt(1e4, 0.0, mu)).unwrap();
        let mut environment = Environment::new(vec![plane], Vec::new());
        let force = environment.force(&Axes::<3>::new(0.3, -0.2, -depth), &v, 0.0);
        let (normal, tangent) = (force[2], force.xy());
        let slip = v.xy();
        prop_assert!((normal - 1e4 * depth).abs() < 1e-9);
        prop_assert!(tangent.norm() <= mu * normal * (1.0 + 1e-12));
        prop_assert!(tangent.dot(&slip) <= 0.0);
        let full = (slip.norm() / 1e-3).min(1.0);
        prop_assert!((tangent.norm() - mu * normal * full).abs() < 1e-9);
        prop_assert!((tangent + slip * (tangent.norm() / slip.norm().max(1e-300))).norm() < 1e-9);
    }
}
