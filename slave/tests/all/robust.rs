//! Stiff, light and unusual scenes end and stay finite; invalid parameters are rejected by name.
#![allow(clippy::unwrap_used)] // a test may

use haptether_slave::{
    ArmControl, ArmModel, Axes, Contact, ContactLaw, Environment, ForceSensor, FreeBody, ModelError, Object,
    ObjectMotion, PushShape, Pusher, Series, Shape, SimulatedSlave,
};
use proptest::prelude::*;

const MS: u64 = 1_000_000;

fn voigt(stiffness: f64, damping: f64, friction: f64) -> Contact {
    Contact::new(ContactLaw::KelvinVoigt { stiffness, damping }, friction).unwrap()
}

#[test]
fn a_gram_on_a_hard_wall_stays_finite_and_ends() {
    for damping in [0.0, 100.0, 1e7] {
        for control in [
            ArmControl::Position { bandwidth_hz: 20.0 },
            ArmControl::Velocity { bandwidth_hz: 20.0 },
            ArmControl::Pd { stiffness: 5.0, damping: 0.1 },
        ] {
            let arm = ArmModel::new(control, 1e-3, Some(1.0), None).unwrap();
            let shape = Shape::plane(Axes::<2>::zeros(), Axes::<2>::new(0.1, 1.0)).unwrap();
            let plane = Object::fixed(shape, voigt(1e7, damping, 0.5)).unwrap();
            let environment = Environment::new(vec![plane], Vec::new());
            let start = Axes::<2>::new(0.0, 5e-3);
            let mut slave = SimulatedSlave::in_environment(arm, environment, None, start, 0).unwrap();
            slave.write(&Axes::<2>::new(0.01, -0.01), &Axes::zeros());
            let mut deepest = 0.0_f64;
            for tick in 1..=50 {
                let sample = slave.read(tick * MS);
                deepest = deepest.max(-sample.position[1]);
                let finite = sample.position.iter().chain(&sample.velocity).chain(&sample.environment_force);
                assert!(finite.copied().all(f64::is_finite), "{sample:?}");
            }
            // 2 g at 1 m/s on 1e7 N/m go 14 um deep; a coarse step of 20 us moves up to 20 um more.
            assert!(deepest < 1.1e-3 + 4e-5, "{damping} {control:?}: {deepest}");
            assert_eq!(
                slave.coarse_steps() > 0,
                damping > 1e6,
                "{damping} {control:?} {}",
                slave.coarse_steps()
            );
        }
    }
}

#[test]
fn a_coarse_wall_holds_a_pressing_arm_where_it_should() {
    // With so much damping only coarse steps succeed; it must still settle at F / K.
    let arm = ArmModel::new(ArmControl::Pd { stiffness: 0.0, damping: 1.0 }, 1e-3, None, None).unwrap();
    let shape = Shape::plane(Axes::<1>::zeros(), Axes::<1>::new(1.0)).unwrap();
    let plane = Object::fixed(shape, voigt(1e7, 1e6, 0.0)).unwrap();
    let push = Pusher::shaped(PushShape::Step, 0.0, 9.0, Axes::<1>::new(-10.0)).unwrap();
    let environment = Environment::new(vec![plane], vec![push]);
    let mut slave = SimulatedSlave::in_environment(arm, environment, None, Axes::<1>::new(1e-4), 0).unwrap();
    slave.start(0);
    let mut sample = slave.read(MS);
    for tick in 2..=1500 {
        sample = slave.read(tick * MS);
    }
    assert!(slave.coarse_steps() > 0);
    // K / B = 10 / s: after 1.5 s, e^-15 of 1 um is left.
    assert!((sample.position[0] + 1e-6).abs() < 1e-11, "{sample:?}");
    assert!((sample.true_environment_force[0] - 0.0).abs() < 1e-3, "wall and push balance: {sample:?}");
}

#[test]
fn bad_parameters_are_refused_by_name() {
    let nan = f64::NAN;
    let x = Axes::<2>::zeros();
    let one = Axes::<2>::new(1.0, 1.0);
    let bad = Axes::<2>::new(0.0, nan);
    let position = ArmControl::Position { bandwidth_hz: 1.0 };
    let ball = Shape::sphere(x, 1.0).unwrap();
    let hunt = |exponent| ContactLaw::HuntCrossley { stiffness: 1.0, exponent, damping: 0.0 };
    let law = |stiffness, damping| ContactLaw::KelvinVoigt { stiffness, damping };
    let spring = Shape::spring(x).unwrap();
    let refused: Vec<(Option<ModelError>, &str)> = vec![
        (Shape::plane(bad, one).err(), "plane point"),
        (Shape::plane(x, x).err(), "plane normal"),
        (Shape::sphere(bad, 1.0).err(), "sphere centre"),
        (Shape::sphere(x, 0.0).err(), "sphere radius"),
        (Shape::cuboid(bad, one).err(), "box centre"),
        (Shape::cuboid(x, x).err(), "box half extents"),
        (Shape::spring(bad).err(), "spring anchor"),
        (Contact::new(law(-1.0, 0.0), 0.0).err(), "contact stiffness"),
        (Contact::new(law(1.0, f64::INFINITY), 0.0).err(), "contact damping"),
        (Contact::new(law(1.0, 0.0), -0.1).err(), "contact friction"),
        (Contact::new(hunt(0.5), 0.0).err(), "contact exponent"),
        (Object::fixed(spring, voigt(1.0, 0.0, 0.1)).err(), "friction of a spring"),
        (Object::fixed(spring, Contact::new(hunt(1.5), 0.0).unwrap()).err(), "exponent of a spring"),
        (ObjectMotion::new(bad, 0.0, 1.0, x, 0.0).err(), "motion velocity"),
        (ObjectMotion::new(x, nan, 1.0, x, 0.0).err(), "motion begin"),
        (ObjectMotion::new(x, 2.0, 1.0, x, 0.0).err(), "motion end"),
        (ObjectMotion::new(x, 0.0, 1.0, bad, 0.0).err(), "motion amplitude"),
        (ObjectMotion::new(x, 0.0, 1.0, x, -1.0).err(), "motion frequency"),
        (FreeBody::new(0.0, 0.0, 0.0, x).err(), "body mass"),
        (FreeBody::new(1.0, -1.0, 0.0, x).err(), "body viscous friction"),
        (FreeBody::new(1.0, 0.0, -1.0, x).err(), "body Coulomb friction"),
        (FreeBody::new(1.0, 0.0, 0.0, bad).err(), "body velocity"),
        (Pusher::shaped(PushShape::Step, nan, 1.0, x).err(), "push time"),
        (Pusher::shaped(PushShape::Step, 0.0, -1.0, x).err(), "push duration"),
        (Pusher::shaped(PushShape::Step, 0.0, 1.0, bad).err(), "push force"),
        (Pusher::shaped(PushShape::Ramp { rise_s: -1.0 }, 0.0, 1.0, x).err(), "push rise"),
        (Pusher::shaped(PushShape::Sine { frequency_hz: nan }, 0.0, 1.0, x).err(), "push frequency"),
        (Series::<2>::new(vec![], vec![]).err(), "number of recorded times"),
        (Series::new(vec![0.0], vec![x, x]).err(), "number of recorded values"),
        (Series::new(vec![0.0, 0.0], vec![x, x]).err(), "recorded time"),
        (Series::new(vec![0.0], vec![bad]).err(), "recorded value"),
        (ArmModel::new(position, 0.0, None, None).err(), "arm mass"),
        (ArmModel::new(position, 1.0, Some(0.0), None).err(), "arm speed"),
        (ArmModel::new(position, 1.0, None, Some(nan)).err(), "arm acceleration"),
        (ArmModel::new(ArmControl::Velocity { bandwidth_hz: 0.0 }, 1.0, None, None).err(), "arm bandwidth"),
        (
            ArmModel::new(ArmControl::Pd { stiffness: -1.0, damping: 0.0 }, 1.0, None, None).err(),
            "arm stiffness",
        ),
        (
            ArmModel::new(ArmControl::Pd { stiffness: 1.0, damping: nan }, 1.0, None, None).err(),
            "arm damping",
        ),
        (ForceSensor::new(-1.0, x, 0.0, None, 0).err(), "sensor noise"),
        (ForceSensor::new(0.0, bad, 0.0, None, 0).err(), "sensor bias"),
        (ForceSensor::new(0.0, x, -1.0, None, 0).err(), "sensor quantum"),
        (ForceSensor::new(0.0, x, 0.0, Some(0.0), 0).err(), "sensor rate"),
    ];
    for (error, name) in refused {
        let message = error.unwrap_or_else(|| panic!("{name} was accepted")).to_string();
        assert!(message.starts_with(&format!("{name} = ")) && message.contains("must be"), "{message}");
    }
    let arm = ArmModel::new(position, 1.0, None, None).unwrap();
    let fixed = Object::fixed(ball, voigt(1.0, 0.0, 0.0)).unwrap();
    let environment = Environment::new(vec![fixed], Vec::new());
    let error = SimulatedSlave::in_environment(arm, environment, None, bad, 0).unwrap_err();
    assert_eq!(error.name, "arm position");
}

fn vector(size: f64) -> impl Strategy<Value = Axes<3>> {
    prop::array::uniform3(-size..size).prop_map(Axes::<3>::from)
}

fn shape() -> impl Strategy<Value = Shape<3>> {
    (0..4_u8, vector(0.1), prop::array::uniform3(1e-3..0.1_f64)).prop_map(|(kind, at, size)| match kind {
        0 => Shape::plane(at, Axes::<3>::from(size)).unwrap(),
        1 => Shape::sphere(at, size[0]).unwrap(),
        2 => Shape::cuboid(at, Axes::<3>::from(size)).unwrap(),
        _ => Shape::spring(at).unwrap(),
    })
}

fn object() -> impl Strategy<Value = Object<3>> {
    let contact = (0..2_u8, 1.0..7.0_f64, 0.0..1e3_f64, 1.0..3.0_f64, 0.0..1.5_f64);
    (shape(), contact, 0..3_u8, vector(0.5), 1e-3..1.0_f64).prop_map(
        |(shape, (kind, power, damping, exponent, friction), mobility, v, mass)| {
            let stiffness = 10_f64.powf(power);
            let hunt = ContactLaw::HuntCrossley { stiffness, exponent, damping: 1e-2 * damping };
            let soft = voigt(stiffness, damping, 0.0);
            let contact = match kind {
                _ if Object::fixed(shape, voigt(1.0, 0.0, 0.1)).is_err() => soft,
                0 => voigt(stiffness, damping, friction),
                _ => Contact::new(hunt, friction).unwrap(),
            };
            match mobility {
                0 => Object::fixed(shape, contact).unwrap(),
                1 => {
                    let motion = ObjectMotion::new(v, 0.003, 0.02, v * 0.01, 20.0).unwrap();
                    Object::moving(shape, contact, motion).unwrap()
                }
                _ => {
                    let body = FreeBody::new(mass, friction, friction, v).unwrap();
                    Object::free(shape, contact, body).unwrap()
                }
            }
        },
    )
}

fn control() -> impl Strategy<Value = ArmControl> {
    (0..3_u8, 1.0..60.0_f64, 0.0..1e4_f64, 0.0..50.0_f64).prop_map(|(kind, hertz, stiffness, damping)| {
        match kind {
            0 => ArmControl::Position { bandwidth_hz: hertz },
            1 => ArmControl::Velocity { bandwidth_hz: hertz },
            _ => ArmControl::Pd { stiffness, damping },
        }
    })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]
    #[test]
    fn nothing_is_ever_infinite(
        objects in prop::collection::vec(object(), 0..6),
        control in control(),
        mass in 1e-3..5.0_f64,
        limits in (prop::option::of(0.1..2.0_f64), prop::option::of(0.5..20.0_f64)),
        goals in prop::collection::vec((vector(0.1), vector(1.0)), 1..5),
        force in vector(50.0),
    ) {
        let arm = ArmModel::new(control, mass, limits.0, limits.1).unwrap();
        let push = Pusher::shaped(PushShape::HalfSine, 2e-3, 8e-3, force).unwrap();
        let environment = Environment::new(objects, vec![push]);
        let mut slave = SimulatedSlave::in_environment(arm, environment, None, Axes::zeros(), 0).unwrap();
        slave.start(0);
        for tick in 0..24_u64 {
            let (goal, v) = goals[usize::try_from(tick).unwrap() / 6 % goals.len()];
            slave.write(&goal, &v);
            let sample = slave.read(tick * MS);
            for value in sample.position.iter().chain(&sample.velocity).chain(&sample.environment_force) {
                prop_assert!(value.is_finite(), "{:?}", sample);
            }
        }
    }
}
