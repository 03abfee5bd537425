//! Ticks in one step against the same ticks by series.

use proptest::prelude::*;

use crate::*;

const TICK_NS: u64 = 1_000_000;
const TICKS: u64 = 300;

/// A random device with its hand and walls.
#[derive(Clone, Debug)]
struct Drawn {
    mass: [f64; 3],
    viscous: f64,
    coulomb: f64,
    along_motion: bool,
    stiffness: f64,
    damping: f64,
    strength: f64,
    release: Option<(f64, f64, bool, bool)>,
    tremor: Option<(f64, f64)>,
    ends: [f64; 3],
    force: [f64; 3],
    wall: Option<f64>,
    stop: f64,
}

fn drawn() -> impl Strategy<Value = Drawn> {
    let device = (
        prop::array::uniform3(0.012..1.0f64),
        any::<bool>(),
        -0.01..2.0f64,
        prop::option::of(0.01..0.3f64),
        any::<bool>(),
        0.02..0.5f64,
    );
    let hand = (
        0.0..1500.0f64,
        0.0..20.0f64,
        prop::option::of(1.0..20.0f64),
        prop::option::of((0.0..0.2f64, 0.0..0.1f64, any::<bool>(), any::<bool>())),
        prop::option::of((1e-5..2e-3f64, 1.0..12.0f64)),
    );
    let rest = (
        prop::array::uniform3(-0.03..0.03f64),
        prop::array::uniform3(-2.0..2.0f64),
        prop::option::of(0.001..0.05f64),
    );
    (device, hand, rest).prop_map(
        |(
            (mass, same, viscous, coulomb, along_motion, stop),
            (stiffness, damping, strength, release, tremor),
            (ends, force, wall),
        )| Drawn {
            mass: if same { [mass[0]; 3] } else { mass },
            viscous,
            coulomb: coulomb.unwrap_or(0.0),
            along_motion,
            stiffness,
            damping,
            strength: strength.unwrap_or(f64::INFINITY),
            release,
            tremor,
            ends,
            force,
            wall,
            stop,
        },
    )
}

fn master<const N: usize>(drawn: &Drawn) -> SimulatedMaster<N> {
    let device = DeviceParameters::<N> {
        mass_kg: Axes::from_fn(|axis, _| drawn.mass[axis]),
        friction: if drawn.along_motion { Friction::Vector } else { Friction::Axis },
        stops: (Axes::repeat(-drawn.stop), Axes::repeat(drawn.stop)),
        ..DeviceParameters::ideal(1.0, drawn.viscous, drawn.coulomb)
    };
    let end = Axes::from_fn(|axis, _| drawn.ends[axis]);
    let leg = |end, shape| Leg { duration_s: 0.1, end, shape };
    let legs = vec![leg(end, LegShape::MinimumJerk), leg(end * -0.5, LegShape::Linear)];
    let path = Path::new(Axes::zeros(), legs).unwrap();
    let release = drawn.release.map(|(at_s, decay_s, is_gain, _)| {
        let kind =
            if is_gain || drawn.strength.is_infinite() { ReleaseKind::Gain } else { ReleaseKind::Strength };
        Release { at_s, decay_s, kind }
    });
    let mut hand = Hand::new(drawn.stiffness, drawn.damping, drawn.strength, path, release).unwrap();
    if let Some((.., true)) = drawn.release {
        hand = hand.with_regrasp(Regrasp { reaction_s: 0.02, rise_s: 0.02 }).unwrap();
    }
    if let Some((amplitude, frequency_hz)) = drawn.tremor {
        hand = hand.with_tremor(Tremor { amplitude, frequency_hz }).unwrap();
    }
    let normal = Axes::from_fn(|axis, _| if axis == 0 { 1.0 } else { 0.3 });
    let walls = drawn.wall.map(|at| ContinuousWall::new(normal * -at, normal, 800.0, 1.0, false).unwrap());
    SimulatedMaster::new(device, hand, 0).unwrap().with_walls(walls.into_iter().collect()).unwrap()
}

/// Largest differences per tick in m and m/s from the same state, and number of ticks in one step.
fn compared<const N: usize>(drawn: &Drawn) -> ([f64; 2], u64) {
    let mut master = master::<N>(drawn);
    let mut worst = [0.0_f64; 2];
    for tick in 1..=TICKS {
        let swing = (tick as f64 * 0.05).sin();
        master.write(&Axes::from_fn(|axis, _| drawn.force[axis] * swing));
        let mut series = master.clone();
        series.follows_series_only = true;
        let before = master.propagated;
        master.read(tick * TICK_NS);
        series.read(tick * TICK_NS);
        if master.propagated == before {
            assert_eq!(master.position(), series.position());
        }
        assert_eq!(master.touch(), series.touch());
        worst[0] = worst[0].max((master.position() - series.position()).norm());
        worst[1] = worst[1].max((master.velocity() - series.velocity()).norm());
    }
    (worst, master.propagated)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(96))]

    /// From the same state both agree to rounding: a few eps of x (below 0.5 m) and V (below 10 m/s).
    #[test]
    fn a_tick_in_one_step_is_the_tick_by_its_series(drawn in drawn()) {
        let (eps, [x, v]) = (f64::EPSILON, [1.0, 10.0]);
        for ([off, slow], _) in [compared::<1>(&drawn), compared::<3>(&drawn)] {
            prop_assert!(off <= 2.0 * eps * x, "{off:e}");
            prop_assert!(slow <= 2.0 * eps * v, "{slow:e}");
        }
    }
}

/// A trembling hand: nearly every tick takes one step, except those with a turn or a start.
#[test]
fn ticks_without_an_event_take_one_step() {
    fn counted<const N: usize>(friction: Friction) -> u64 {
        let device = DeviceParameters::<N> { friction, ..DeviceParameters::phantom_desktop() };
        let path = Path::new(Axes::zeros(), Vec::new()).unwrap();
        let hand = Hand::new(300.0, 8.0, 12.0, path, None).unwrap();
        let hand = hand.with_tremor(Tremor { amplitude: 1e-3, frequency_hz: 5.0 }).unwrap();
        let mut master = SimulatedMaster::new(device, hand, 0).unwrap();
        for tick in 1..=1000 {
            master.read(tick * TICK_NS);
        }
        master.propagated
    }
    for counted in
        [counted::<1>(Friction::Vector), counted::<3>(Friction::Axis), counted::<3>(Friction::Vector)]
    {
        // At most all but the first tick and ten turns. Starts, and ticks whose bounds do not exclude an
        // event, cost a few more.
        assert!((950..=989).contains(&counted), "{counted}");
    }
}

/// A hand that strokes along edges in space against friction along the motion, with an optional tremor.
fn stroking(trembles: bool) -> SimulatedMaster<3> {
    let legs = (1..30)
        .map(|n| {
            let angle = f64::from(n) * 0.8;
            let end = Axes::<3>::new(angle.cos(), angle.sin(), (0.7 * angle).sin()) * 0.03;
            Leg { duration_s: 0.4, end, shape: LegShape::MinimumJerk }
        })
        .collect();
    let hand = Hand::new(300.0, 8.0, 12.0, Path::new(Axes::zeros(), legs).unwrap(), None).unwrap();
    let tremor = Tremor { amplitude: if trembles { 1e-4 } else { 0.0 }, frequency_hz: 5.0 };
    let device = DeviceParameters::<3> { encoder_quantum: 0.0, ..DeviceParameters::phantom_desktop() };
    SimulatedMaster::new(device, hand.with_tremor(tremor).unwrap(), 0).unwrap()
}

/// A bending motion that is not slow takes one step; its end agrees with a series at a fifth of the tick.
#[test]
fn a_bending_motion_takes_one_step_and_errs_by_rounding() {
    const SHARES: u64 = 5;
    for trembles in [false, true] {
        let (mut master, mut series) = (stroking(trembles), stroking(trembles));
        series.follows_series_only = true;
        let (mut worst, mut bent) = (0.0_f64, 0);
        for tick in 1..=8000_u64 {
            let swing = (tick as f64 * 0.01).sin();
            for one in [&mut master, &mut series] {
                one.write(&(Axes::<3>::new(0.3, -0.2, 0.4) * swing));
            }
            let before = master.propagated;
            master.read(tick * TICK_NS);
            bent += master.propagated - before;
            for share in 1..=SHARES {
                series.read((tick - 1) * TICK_NS + share * TICK_NS / SHARES);
            }
            worst = worst.max((master.position() - series.position()).norm());
        }
        assert!(worst < 1e-14, "{worst:e}");
        assert!(bent > 6500, "{bent}");
    }
}
