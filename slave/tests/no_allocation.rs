//! Advancing, reading and writing do not allocate, for any number of axes; a counting allocator checks this.
#![allow(clippy::unwrap_used)] // a test may

use haptether_slave::{
    ArmControl, ArmModel, Axes, Contact, ContactLaw, Environment, ForceSensor, FreeBody, Object,
    ObjectMotion, PushShape, Pusher, Series, Shape, SimulatedSlave, UrInverse, UrPose, UrRows,
};

#[path = "../../numeric/tests/allocations/mod.rs"]
mod allocations;

use allocations::allocations;

fn contact(damping: f64, friction: f64) -> Contact {
    Contact::new(ContactLaw::KelvinVoigt { stiffness: 500.0, damping }, friction).unwrap()
}

fn unit<const N: usize>(size: f64) -> Axes<N> {
    let mut unit = Axes::zeros();
    unit[0] = size;
    unit
}

fn objects<const N: usize>() -> Vec<Object<N>> {
    let ball = |at| Shape::sphere(unit(at), 0.01).unwrap();
    let motion = ObjectMotion::new(unit(0.05), 0.1, 0.3, unit(0.01), 2.0).unwrap();
    let body = |v| FreeBody::new(0.3, 0.2, 0.1, unit(v)).unwrap();
    vec![
        Object::fixed(Shape::plane(unit(-0.02), unit(1.0)).unwrap(), contact(1.0, 0.3)).unwrap(),
        Object::moving(Shape::cuboid(unit(0.2), Axes::repeat(0.02)).unwrap(), contact(0.0, 0.0), motion)
            .unwrap(),
        Object::free(ball(0.03), contact(2.0, 0.2), body(0.0)).unwrap(),
        Object::free(ball(0.5), contact(2.0, 0.2), body(-0.2)).unwrap(),
    ]
}

fn swing<const N: usize>(objects: Vec<Object<N>>, control: ArmControl) -> (u64, bool, u32) {
    let arm = ArmModel::new(control, 2.0, Some(0.5), Some(5.0)).unwrap();
    let series = Series::new(vec![0.0, 0.1, 0.2], vec![unit(1.0), unit(-2.0), unit(0.0)]).unwrap();
    let pushers = vec![
        Pusher::recorded(series, 0.05, 0.2).unwrap(),
        Pusher::shaped(PushShape::Ramp { rise_s: 0.1 }, 0.2, 0.1, unit(3.0)).unwrap(),
    ];
    let sensor = ForceSensor::new(0.1, Axes::zeros(), 0.01, Some(700.0), 1).unwrap();
    let environment = Environment::new(objects, pushers);
    let mut slave = SimulatedSlave::in_environment(arm, environment, Some(sensor), Axes::zeros(), 0).unwrap();
    slave.start(0);
    let (mut touched, mut finite) = (0, true);
    let before = allocations();
    for tick in 1..=600_u32 {
        slave.write(&unit(0.05 * (f64::from(tick) * 0.01).sin()), &Axes::zeros());
        let sample = slave.read(u64::from(tick) * 1_000_000);
        touched += u32::from(sample.position[0] < -0.02);
        finite &= sample.position.iter().chain(&sample.environment_force).all(|value| value.is_finite());
        if tick == 400 {
            slave.stop();
        }
    }
    let allocated = allocations() - before;
    assert!(finite && slave.coarse_steps() == 0);
    (allocated, slave.is_exact(), touched)
}

fn on<const N: usize>() {
    for control in [
        ArmControl::Position { bandwidth_hz: 10.0 },
        ArmControl::Velocity { bandwidth_hz: 10.0 },
        ArmControl::Pd { stiffness: 900.0, damping: 30.0 },
    ] {
        let (allocated, exact, touched) = swing::<N>(objects(), control);
        assert!(allocated == 0 && !exact && touched > 20, "{N} {control:?}: {allocated} {touched}");
    }
    let plane = Shape::plane(unit(-0.02), unit(1.0)).unwrap();
    let planes = vec![Object::fixed(plane, contact(1.0, 0.0)).unwrap()];
    let (allocated, exact, touched) = swing::<N>(planes, ArmControl::Position { bandwidth_hz: 10.0 });
    assert!(allocated == 0 && exact && touched > 20, "{N}: {allocated} {touched}");
}

#[test]
fn a_tick_allocates_nothing() {
    on::<1>();
    on::<2>();
    on::<3>();
    on::<6>();
    on::<7>();
}

#[test]
fn inverse_kinematics_allocates_nothing() {
    let half = std::f64::consts::FRAC_PI_2;
    let model = UrRows {
        theta: [0.0; 6],
        a: [0.0, -0.425, -0.3922, 0.0, 0.0, 0.0],
        d: [0.1625, 0.0, 0.0, 0.1333, 0.0997, 0.0996],
        alpha: [half, 0.0, 0.0, half, -half, 0.0],
    };
    let unit = UrRows { theta: [1e-3; 6], ..model };
    let rows = |x| [[1.0, 0.0, 0.0, x], [0.0, 0.0, 1.0, -0.3], [0.0, -1.0, 0.0, 0.2]];
    for unit in [None, Some(&unit)] {
        let inverse = UrInverse::new(&model, unit, [-7.0; 6], [7.0; 6]).unwrap();
        let before = allocations();
        for x in [0.3, 0.4, 3.0] {
            let pose = UrPose::from_rows(&rows(x)).unwrap();
            assert_eq!(inverse.nearest(&pose, &[0.1; 6]).is_ok(), x < 1.0);
            assert_eq!(inverse.all(&pose).postures().is_empty(), x > 1.0);
        }
        assert_eq!(allocations(), before);
    }
}
