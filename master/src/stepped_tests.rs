//! Steps against the exact solution, and lanes against single runs.

use nalgebra::SimdValue;
use proptest::prelude::*;
use simba::simd::AutoSimd;

use crate::*;

const TICK_NS: u64 = 1_000_000;

type Lanes = AutoSimd<[f64; 8]>;

fn hand(depth: f64, strength: f64, kind: ReleaseKind, at_s: f64) -> Hand<1> {
    let at = Axes::<1>::new;
    let legs = vec![
        Leg { duration_s: 0.05, end: at(0.5 * depth), shape: LegShape::Smooth },
        Leg { duration_s: 0.02 + depth.abs(), end: at(depth), shape: LegShape::MinimumJerk },
    ];
    let release = Some(Release { at_s, decay_s: 0.03, kind });
    let hand = Hand::new(300.0, 5.0, strength, Path::new(at(0.002), legs).unwrap(), release).unwrap();
    hand.with_tremor(Tremor { amplitude: 1e-4, frequency_hz: 10.0 }).unwrap()
}

/// Largest difference in m to the exact solution over 0.25 s.
fn error(stepping: Stepping, step_s: f64) -> f64 {
    let device = DeviceParameters::<1>::ideal(0.157, 0.5, 0.0);
    let hand = hand(-0.02, f64::INFINITY, ReleaseKind::Gain, 0.15);
    let wall = ContinuousWall::new(Axes::<1>::zeros(), Axes::<1>::new(1.0), 200.0, 1.0, true).unwrap();
    let mut exact = SimulatedMaster::new(device, hand.clone(), 0).unwrap().among(vec![wall]).unwrap();
    let mut stepped = SteppedMaster::new(&device, &hand, &[wall], stepping, step_s, 1e-3).unwrap();
    let mut worst: f64 = 0.0;
    for tick in 1..=250 {
        exact.read(tick * TICK_NS);
        stepped.advance(tick * TICK_NS);
        worst = worst.max((exact.position() - stepped.position()).norm());
    }
    worst
}

#[test]
fn each_method_has_its_order() {
    for (stepping, order) in
        [(Stepping::SemiImplicitEuler, 1), (Stepping::VelocityVerlet, 2), (Stepping::RungeKutta4, 4)]
    {
        let (coarse, fine) = (error(stepping, 1e-3), error(stepping, 5e-4));
        let halved = 2.0_f64.powi(order);
        // The kinks of path and grip lie on steps, so each method keeps its order to 20 %.
        assert!((coarse / fine / halved - 1.0).abs() < 0.2, "{stepping:?}: {coarse:e} {fine:e}");
    }
    assert!(error(Stepping::RungeKutta4, 1e-4) < 1e-11);
}

/// One scenario per row: depth, mass, coulomb, stiffness of the wall, grip strength, time of the release.
type Row = (f64, f64, f64, f64, f64, f64);

fn build(row: &Row, stepping: Stepping, kind: ReleaseKind) -> SteppedMaster<1> {
    let (depth, mass, coulomb, stiffness, strength, at_s) = *row;
    let device = DeviceParameters::<1> {
        encoder_quantum: 2.3e-5,
        force_quantum_n: 0.01,
        max_force_n: 7.9,
        stops: (Axes::<1>::new(-0.03), Axes::<1>::new(0.03)),
        ..DeviceParameters::ideal(mass, -0.005, coulomb)
    };
    let wall = ContinuousWall::new(Axes::<1>::zeros(), Axes::<1>::new(1.0), stiffness, 0.1, false).unwrap();
    SteppedMaster::new(&device, &hand(depth, strength, kind, at_s), &[wall], stepping, 5e-4, 1e-3).unwrap()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn a_lane_is_a_run_of_its_own(
        rows in prop::collection::vec(
            (-0.05..0.0f64, 0.05..0.5f64, 0.0..0.1f64, 10.0..1000.0f64, 0.1..20.0f64, 0.13..0.17f64), 8),
        which in 0usize..3,
        gain in any::<bool>(),
    ) {
        let stepping =
            [Stepping::SemiImplicitEuler, Stepping::VelocityVerlet, Stepping::RungeKutta4][which];
        let kind = if gain { ReleaseKind::Gain } else { ReleaseKind::Strength };
        let mut singles: Vec<_> = rows.iter().map(|row| build(row, stepping, kind)).collect();
        let mut lanes = SteppedMaster::gather::<Lanes>(&singles.iter().collect::<Vec<_>>()).unwrap();
        for tick in 1..=220 {
            lanes.advance(tick * TICK_NS);
            lanes.write(&lanes.measured_position().map(|x| x * Lanes::splat(-50.0)));
            for (lane, single) in singles.iter_mut().enumerate() {
                single.advance(tick * TICK_NS);
                single.write(&(single.measured_position() * -50.0));
                let bits = |value: f64| value.to_bits();
                prop_assert_eq!(bits(lanes.position()[0].extract(lane)), bits(single.position()[0]));
                prop_assert_eq!(bits(lanes.velocity()[0].extract(lane)), bits(single.velocity()[0]));
                prop_assert_eq!(bits(lanes.hand_force()[0].extract(lane)), bits(single.hand_force()[0]));
            }
        }
    }
}

#[test]
fn what_lanes_cannot_share_is_refused() {
    let row = (-0.02, 0.157, 0.0, 200.0, 5.0, 0.15);
    let built = |stepping, kind| build(&row, stepping, kind);
    let alike: Vec<_> = (0..8).map(|_| built(Stepping::RungeKutta4, ReleaseKind::Gain)).collect();
    let mut of: Vec<_> = alike.iter().collect();
    assert!(SteppedMaster::gather::<Lanes>(&of).is_some());
    assert!(SteppedMaster::gather::<Lanes>(&of[..4]).is_none());
    let others = [
        built(Stepping::VelocityVerlet, ReleaseKind::Gain),
        built(Stepping::RungeKutta4, ReleaseKind::Strength),
    ];
    for other in &others {
        of[3] = other;
        assert!(SteppedMaster::gather::<Lanes>(&of).is_none());
    }
}

/// The grip against its definition: full before `at_s`, down a line in `decay_s`, and up one in `rise_s`, if ever.
#[test]
fn the_grip_falls_and_rises_at_its_times() {
    let at = Axes::<1>::new;
    let path = Path::new(at(0.01), Vec::new()).unwrap();
    let courses = [(0.05, None), (0.0, None), (0.05, Some((0.2, 0.1))), (0.05, Some((0.02, 0.1)))];
    let kinds =
        [(ReleaseKind::Gain, f64::INFINITY), (ReleaseKind::Gain, 12.0), (ReleaseKind::Strength, 12.0)];
    let cases = courses.into_iter().flat_map(|course| kinds.map(|kind| (course, kind)));
    for ((decay_s, again), (kind, strength_n)) in cases {
        let release = Release { at_s: 1.0, decay_s, kind };
        let mut hand = Hand::new(300.0, 0.0, strength_n, path.clone(), Some(release)).unwrap();
        if let Some((reaction_s, rise_s)) = again {
            hand = hand.with_regrasp(Regrasp { reaction_s, rise_s }).unwrap();
        }
        let [ends, regrips, full] = hand.schedule().unwrap_or([1.0 + decay_s; 3]);
        let stepped = SteppedHand::new(&hand);
        let times = [
            0.0,
            0.5,
            1.0 - 1e-6,
            1.0,
            1.0 + 1e-6,
            1.02,
            ends - 1e-6,
            ends,
            ends + 1e-6,
            1.1,
            1.25,
            1.3,
            2.0,
        ];
        for t in times.into_iter().chain([regrips, regrips + 0.01, full - 1e-6, full, full + 1e-6]) {
            let falls = if t < 1.0 {
                1.0
            } else if t >= ends {
                0.0
            } else {
                1.0 - (t - 1.0) / decay_s
            };
            let rises = match again {
                Some((_, rise_s)) if t >= regrips => ((t - regrips) / rise_s).min(1.0),
                _ => 0.0,
            };
            let share = falls.max(rises);
            for (x, wish) in [(0.0, 3.0_f64), (0.02, -3.0)] {
                let expected = match kind {
                    ReleaseKind::Gain => wish * share,
                    ReleaseKind::Strength => wish.clamp(-12.0 * share, 12.0 * share),
                };
                let force = stepped.force(t, &at(x), &at(0.0))[0];
                // Times are sums of seconds: a few roundings of 1 s, on the steepest line.
                assert!((force - expected).abs() < 1e-12, "{kind:?} {decay_s} {again:?} {t}: {force}");
                assert!(share > 0.0 || force.to_bits() == 0, "{kind:?} {t}: {force}");
            }
        }
    }
}

/// Below `V_f` friction is a damping, under which a speed never reaches zero: it is zero once nobody can tell, alone and in
/// lanes, and above that what it would be without.
#[test]
fn a_device_that_friction_has_stopped_is_at_rest() {
    let device = DeviceParameters::<1>::ideal(0.157, 0.0, 0.038);
    let hand = Hand::absent(Axes::<1>::zeros()).unwrap();
    let build = |speed: f64| {
        let mut master =
            SteppedMaster::new(&device, &hand, &[], Stepping::SemiImplicitEuler, 1e-3, 1e-3).unwrap();
        master.place(Axes::zeros(), Axes::<1>::new(speed)).unwrap();
        master
    };
    let mut singles: Vec<_> = (0..8).map(|lane| build(0.01 * f64::from(lane - 4))).collect();
    let mut lanes = SteppedMaster::gather::<Lanes>(&singles.iter().collect::<Vec<_>>()).unwrap();
    let mut decays: Vec<f64> = singles.iter().map(|single| single.velocity()[0]).collect();
    let mut subnormal = 0;
    for tick in 1..=8000 {
        lanes.advance(tick * TICK_NS);
        for (lane, (single, v)) in singles.iter_mut().zip(&mut decays).enumerate() {
            single.advance(tick * TICK_NS);
            let now = single.velocity()[0];
            assert_eq!(now.to_bits(), lanes.velocity()[0].extract(lane).to_bits(), "{tick} {lane}");
            *v += 1e-3 * ((0.0 - 0.038 * (*v * 1e-3_f64.recip()).clamp(-1.0, 1.0)) * 0.157_f64.recip());
            if v.abs() > 1e-84 {
                assert_eq!(now, *v, "{tick} {lane}");
            }
            subnormal += i32::from(v.is_subnormal());
            assert!(!now.is_subnormal(), "{tick} {lane}: {now:e}");
        }
    }
    assert!(subnormal > 0, "it would not have decayed that far");
    assert!(singles.iter().all(|single| single.velocity()[0] == 0.0));
}
