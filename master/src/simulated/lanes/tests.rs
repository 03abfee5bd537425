use proptest::prelude::*;
use simba::simd::AutoF64x4;

use super::*;
use crate::{DeviceParameters, Friction, Leg, LegShape, Path, Regrasp, Release, ReleaseKind};

/// Parameters that differ between the masters of a test.
#[derive(Clone, Copy, Debug)]
struct Drawn {
    mass_kg: f64,
    viscous: f64,
    coulomb: f64,
    stiffness: f64,
    damping: f64,
    strength_n: f64,
    stop: f64,
    max_force_n: f64,
}

fn drawn() -> impl Strategy<Value = Drawn> {
    let coulomb = prop_oneof![1 => Just(0.0), 3 => 0.001..0.3f64];
    let stop = prop_oneof![1 => 0.02..0.05f64, 3 => Just(0.5)];
    let impedance = (0.0..800.0f64, 0.0..20.0f64);
    (0.05..0.5f64, -0.01..0.05f64, coulomb, impedance, 0.5..20.0f64, stop, 1.0..9.0f64).prop_map(
        |(mass_kg, viscous, coulomb, (stiffness, damping), strength_n, stop, max_force_n)| Drawn {
            mass_kg,
            viscous,
            coulomb,
            stiffness,
            damping,
            strength_n,
            stop,
            max_force_n,
        },
    )
}

/// Parameters that the masters share.
#[derive(Clone, Copy, Debug)]
#[allow(clippy::struct_excessive_bools)] // independent flags
struct Shared {
    release: Option<Release>,
    regrips: bool,
    moves: bool,
    encoder_quantum: f64,
    force_quantum_n: f64,
    measures_velocity: bool,
    has_no_limit: bool,
}

fn master<const N: usize>(drawn: &Drawn, shared: &Shared) -> SimulatedMaster<N> {
    let leg = |duration_s, end, shape| Leg {
        duration_s,
        end: Axes::<N>::from_fn(|axis, _| end * (axis as f64 - 0.8)),
        shape,
    };
    let legs = vec![leg(0.04, -0.03, LegShape::MinimumJerk), leg(0.03, 0.02, LegShape::Linear)];
    let path = Path::new(Axes::zeros(), if shared.moves { legs } else { Vec::new() }).unwrap();
    let strength = if shared.has_no_limit { f64::INFINITY } else { drawn.strength_n };
    let mut hand = Hand::new(drawn.stiffness, drawn.damping, strength, path, shared.release).unwrap();
    if shared.regrips && shared.release.is_some() {
        hand = hand.with_regrasp(Regrasp { reaction_s: 0.03, rise_s: 0.01 }).unwrap();
    }
    let device = DeviceParameters {
        friction: Friction::Axis,
        encoder_quantum: shared.encoder_quantum,
        measures_velocity: shared.measures_velocity,
        stops: (Axes::repeat(-drawn.stop), Axes::repeat(drawn.stop)),
        max_force_n: drawn.max_force_n,
        force_quantum_n: shared.force_quantum_n,
        ..DeviceParameters::ideal(drawn.mass_kg, drawn.viscous, drawn.coulomb)
    };
    let mut master = SimulatedMaster::new(device, hand, 0).unwrap();
    master.set_waiting(true);
    master
}

/// Checks that masters in lanes match single masters bit by bit at every tick, in measured and hidden state.
/// Returns the number of ticks taken in lanes.
fn check<const N: usize>(of: &[Drawn; 4], shared: &Shared, periods_ns: &[u64], force_n: f64) -> u64 {
    let mut alone: Vec<_> = of.iter().map(|drawn| master::<N>(drawn, shared)).collect();
    let mut beside = MasterLanes::<N, AutoF64x4>::new(alone.clone()).unwrap();
    assert!(beside.fast.is_some());
    let (mut now_ns, mut lanes, mut taken) = (0, 0b1111, 0);
    for (tick, period_ns) in periods_ns.iter().cycle().take(200).enumerate() {
        now_ns += period_ns;
        if tick == 150 {
            lanes = 0b1101;
        }
        let sample = beside.read(lanes, now_ns);
        taken += u64::from(beside.fast.as_ref().unwrap().occupancy.loaded().count_ones());
        let force = |lane: usize| {
            let push = if tick % 50 > 25 { force_n } else { 0.0 };
            Axes::<N>::from_fn(|axis, _| {
                push * (0.07 * tick as f64 * (1.0 + lane as f64) + axis as f64).sin()
            })
        };
        let mut forces = Axes::<N, AutoF64x4>::zeros();
        for lane in 0..4 {
            forces.replace(lane, force(lane));
        }
        for lane in lanes_of(lanes, 4) {
            let found = alone[lane].read(now_ns);
            assert_eq!(sample.velocity.is_some(), found.velocity.is_some());
            let pairs = [
                (sample.position, found.position),
                (sample.velocity.unwrap_or(forces), found.velocity.unwrap_or(force(lane))),
                (*beside.position(), *alone[lane].position()),
                (*beside.velocity(), *alone[lane].velocity()),
                (*beside.hand_force(), alone[lane].hand_force()),
            ];
            for (which, (in_lanes, by_itself)) in pairs.iter().enumerate() {
                let [in_lanes, by_itself] =
                    [in_lanes.extract(lane), *by_itself].map(|axes| axes.map(f64::to_bits));
                assert_eq!(in_lanes, by_itself, "signal {which} of lane {lane} at tick {tick}");
            }
        }
        let fast = beside.fast.as_ref().unwrap();
        for lane in lanes_of(lanes & fast.occupancy.loaded(), 4) {
            // Rounding errors show in the state only later.
            for (lost, by_itself) in fast.motion.lost.iter().zip(&alone[lane].motion.lost) {
                assert_eq!(lost.extract(lane), *by_itself, "of lane {lane} at tick {tick}");
            }
        }
        beside.write(lanes, &forces);
        for lane in lanes_of(lanes, 4) {
            alone[lane].write(&force(lane));
        }
        if tick == 10 {
            beside.set_waiting(false);
            for master in &mut alone {
                master.set_waiting(false);
            }
        }
    }
    taken
}

proptest! {
    #[test]
    fn lanes_match_single_masters(
        of in [drawn(), drawn(), drawn(), drawn()],
        release in prop::option::of((0.02..0.1f64, prop_oneof![Just(0.0), 0.001..0.05f64], any::<bool>())),
        (regrips, moves, measures_velocity, has_no_limit) in any::<(bool, bool, bool, bool)>(),
        encoder_quantum in prop_oneof![Just(0.0), Just(2.3e-5)],
        force_quantum_n in prop_oneof![3 => Just(0.0), 1 => Just(0.01)],
        periods_ns in prop_oneof![
            3 => Just(vec![1_000_000]),
            1 => Just(vec![500_000]),
            1 => prop::collection::vec(100_000..3_000_000u64, 1..5),
        ],
        force_n in 0.0..6.0f64,
    ) {
        let release = release.map(|(at_s, decay_s, of_gain)| {
            let kind = if of_gain || has_no_limit { ReleaseKind::Gain } else { ReleaseKind::Strength };
            Release { at_s, decay_s, kind }
        });
        let shared =
            Shared { release, regrips, moves, encoder_quantum, force_quantum_n, measures_velocity, has_no_limit };
        check::<1>(&of, &shared, &periods_ns, force_n);
        check::<3>(&of, &shared, &periods_ns, force_n);
    }
}

/// Equality alone does not prove that lanes are used.
#[test]
fn nearly_all_ticks_are_taken_in_lanes() {
    let drawn = Drawn {
        mass_kg: 0.157,
        viscous: -0.005,
        coulomb: 0.038,
        stiffness: 300.0,
        damping: 8.0,
        strength_n: 12.0,
        stop: 0.08,
        max_force_n: 7.9,
    };
    let release = Some(Release { at_s: 0.12, decay_s: 0.005, kind: ReleaseKind::Strength });
    let shared = Shared {
        release,
        regrips: false,
        moves: true,
        encoder_quantum: 2.3e-5,
        force_quantum_n: 0.0,
        measures_velocity: false,
        has_no_limit: false,
    };
    let taken = check::<1>(&[drawn; 4], &shared, &[1_000_000], 1.0);
    assert!(taken > 4 * 200 * 3 / 4, "{taken} of 800");
}
