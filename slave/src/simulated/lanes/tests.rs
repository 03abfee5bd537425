use proptest::prelude::*;
use simba::simd::AutoF64x4;

use super::*;
use crate::{ArmControl, ArmModel, Contact, ContactLaw, PushShape, Pusher, Shape};

/// Parameters in which the slaves of a test differ.
#[derive(Clone, Copy, Debug)]
struct Drawn {
    mass_kg: f64,
    bandwidth_hz: f64,
    pd: Option<[f64; 2]>,
    speed: Option<f64>,
    wall: [f64; 3],
    wall_above: [f64; 2],
    spring: Option<[f64; 3]>,
    push_n: f64,
}

fn drawn() -> impl Strategy<Value = Drawn> {
    let speed = prop_oneof![1 => Just(None), 4 => (0.02..2.0f64).prop_map(Some)];
    let wall = [-0.02..0.02f64, 50.0..5e4, 0.0..100.0];
    (0.2..8.0f64, 5.0..60.0f64, speed, wall, [0.02..0.05f64, 100.0..5e3], -8.0..8.0f64).prop_map(
        |(mass_kg, bandwidth_hz, speed, wall, wall_above, push_n)| Drawn {
            mass_kg,
            bandwidth_hz,
            pd: None,
            speed,
            wall,
            wall_above,
            spring: None,
            push_n,
        },
    )
}

fn slave<const N: usize>(drawn: &Drawn, kinds: u8, push_at_s: f64) -> SimulatedSlave<N> {
    let Drawn { mass_kg, bandwidth_hz, pd, speed, wall, wall_above, spring, push_n } = *drawn;
    let control = pd.map_or(ArmControl::Position { bandwidth_hz }, |[stiffness, damping]| ArmControl::Pd {
        stiffness,
        damping,
    });
    let arm = ArmModel::new(control, mass_kg, speed, None).unwrap();
    let along = |axis: usize, value: f64| {
        let mut vector = Axes::<N>::zeros();
        vector[axis] = value;
        vector
    };
    let contact = |stiffness, damping, friction| {
        Contact::new(ContactLaw::KelvinVoigt { stiffness, damping }, friction).unwrap()
    };
    let last = N - 1;
    let friction = if N == 1 { 0.3 } else { 0.0 };
    let mut objects = Vec::new();
    if kinds & 1 != 0 {
        let plane = Shape::plane(along(0, wall[0]), along(0, 1.0)).unwrap();
        objects.push(Object::fixed(plane, contact(wall[1], wall[2], friction)).unwrap());
    }
    if let Some([anchor, stiffness, damping]) = spring {
        let spring = Shape::spring(Axes::<N>::repeat(anchor)).unwrap();
        objects.push(Object::fixed(spring, contact(stiffness, damping, 0.0)).unwrap());
    }
    if kinds & 2 != 0 {
        let plane = Shape::plane(along(last, wall_above[0]), along(last, -1.0)).unwrap();
        objects.push(Object::fixed(plane, contact(wall_above[1], 0.0, friction)).unwrap());
    }
    let ramp = PushShape::Ramp { rise_s: 0.013 };
    let mut pushers = vec![Pusher::shaped(ramp, push_at_s, 0.05, Axes::<N>::repeat(push_n)).unwrap()];
    if kinds & 4 != 0 {
        pushers.push(Pusher::shaped(PushShape::Step, 0.02, 0.0305, along(last, -0.5 * push_n)).unwrap());
    }
    SimulatedSlave::in_environment(arm, Environment::new(objects, pushers), None, Axes::repeat(0.01), 0)
        .unwrap()
}

/// Slaves in lanes are bit-identical to separate ones at each tick, in all measurements and rest positions. Returns the
/// number of lane ticks.
fn check<const N: usize>(
    of: &[Drawn; 4],
    kinds: u8,
    (push_at_s, pushes_differ): (f64, bool),
    periods_ns: &[u64],
    (reach, stop_at): (f64, usize),
) -> u64 {
    let at = |lane: usize| if pushes_differ { push_at_s * (1.0 + 0.3 * lane as f64) } else { push_at_s };
    let mut alone: Vec<_> =
        of.iter().enumerate().map(|(lane, drawn)| slave::<N>(drawn, kinds, at(lane))).collect();
    let mut beside = SlaveLanes::<N, AutoF64x4>::new(alone.clone()).unwrap();
    assert!(beside.fast.as_ref().is_some_and(|fast| fast.shares_pushes || pushes_differ));
    let (mut now_ns, mut lanes, mut taken) = (0, 0b1111, 0);
    for (tick, period_ns) in periods_ns.iter().cycle().take(160).enumerate() {
        now_ns += period_ns;
        if tick == 120 {
            lanes = 0b1011;
        }
        let sample = *beside.read(lanes, now_ns);
        taken += u64::from(beside.fast.as_ref().unwrap().occupancy.loaded().count_ones());
        let phase = tick as f64 * 0.06;
        let command = |lane: usize| {
            Axes::<N>::from_fn(|axis, _| reach * (phase * (1.0 + 0.1 * lane as f64) + axis as f64).sin())
        };
        let velocity = |lane: usize| command(lane) * 3.0;
        let (mut positions, mut velocities) = (Axes::<N, _>::zeros(), Axes::<N, _>::zeros());
        for lane in 0..4 {
            positions.replace(lane, command(lane));
            velocities.replace(lane, velocity(lane));
        }
        // The second stop follows other commands, so it differs from the first.
        let stops = tick == stop_at || tick == stop_at + 20;
        let rests = stops.then(|| beside.stop(lanes));
        for lane in lanes_of(lanes, 4) {
            let found = alone[lane].read(now_ns);
            let pairs = [
                (sample.position, found.position),
                (sample.velocity, found.velocity),
                (sample.environment_force, found.environment_force),
            ];
            for (which, (in_lanes, by_itself)) in pairs.iter().enumerate() {
                let [in_lanes, by_itself] =
                    [in_lanes.extract(lane), *by_itself].map(|axes| axes.map(f64::to_bits));
                assert_eq!(in_lanes, by_itself, "signal {which} of lane {lane} at tick {tick}");
            }
            if let Some(rests) = &rests {
                assert_eq!(rests.extract(lane), alone[lane].stop());
            }
        }
        // Two ticks without a command after a stop, then the same command again.
        if tick < stop_at || tick > stop_at + 2 {
            beside.write(lanes, &positions, &velocities);
            for lane in lanes_of(lanes, 4) {
                alone[lane].write(&command(lane), &velocity(lane));
            }
        }
        if tick == 3 {
            beside.start(now_ns);
            for slave in &mut alone {
                slave.start(now_ns);
            }
        }
    }
    taken
}

proptest! {
    #[test]
    fn lanes_match_separate_slaves(
        mut of in [drawn(), drawn(), drawn(), drawn()],
        kinds in 0..8u8,
        springs in prop::option::of([-0.03..0.03f64, 1.0..5e3, 0.0..50.0]),
        pd in prop::option::of([10.0..1e4f64, 0.0..300.0]),
        pushes in (0.005..0.05f64, any::<bool>()),
        periods_ns in prop_oneof![
            Just(vec![1_000_000]),
            Just(vec![2_000_000]),
            prop::collection::vec(100_000..3_000_000u64, 1..5),
        ],
        reach in 0.001..0.03f64,
        stop_at in 10..140usize,
    ) {
        let push_n = of[0].push_n;
        for drawn in &mut of {
            if !pushes.1 {
                drawn.push_n = push_n;
            }
            drawn.spring = springs;
            drawn.pd = pd.map(|pd| [pd[0].max(drawn.mass_kg * 2.0), pd[1]]);
        }
        check::<1>(&of, kinds, pushes, &periods_ns, (reach, stop_at));
        check::<3>(&of, kinds, pushes, &periods_ns, (reach, stop_at));
    }
}

/// Bit-identical results do not show that lanes are used.
#[test]
fn nearly_all_ticks_are_taken_in_lanes() {
    let drawn = Drawn {
        mass_kg: 4.0,
        bandwidth_hz: 15.0,
        pd: None,
        speed: Some(1.0),
        wall: [0.0, 100.0, 0.0],
        wall_above: [0.05, 1000.0],
        spring: None,
        push_n: 3.0,
    };
    let taken = check::<1>(&[drawn; 4], 3, (0.01, false), &[1_000_000], (0.03, 150));
    assert!(taken > 4 * 160 * 3 / 4, "{taken} of 640");
}

/// A plane that leans by less than the rounding of its length pushes along the other axes too: not for lanes.
#[test]
fn slightly_leaning_plane_is_not_for_lanes() {
    let drawn = |lean: f64| {
        let arm = ArmModel::new(ArmControl::Position { bandwidth_hz: 15.0 }, 4.0, Some(1.0), None).unwrap();
        let plane = Shape::plane(Axes::<3>::zeros(), Axes::<3>::new(lean, 1.0, 0.0)).unwrap();
        let law = ContactLaw::KelvinVoigt { stiffness: 100.0, damping: 0.0 };
        let object = Object::fixed(plane, Contact::new(law, 0.0).unwrap()).unwrap();
        let environment = Environment::new(vec![object], Vec::new());
        SimulatedSlave::in_environment(arm, environment, None, Axes::zeros(), 0).unwrap()
    };
    for (lean, is_fast) in [(0.0, true), (-0.0, true), (6e-17, false), (1e-9, false)] {
        let slaves = (0..4).map(|_| drawn(lean)).collect();
        assert_eq!(SlaveLanes::<3, AutoF64x4>::new(slaves).unwrap().fast.is_some(), is_fast, "{lean}");
    }
    let many = (0..5).map(|_| drawn(0.0)).collect();
    assert!(SlaveLanes::<3, AutoF64x4>::new(many).is_none());
}
