//! Steps against the exact solution, and lanes against single runs.

use nalgebra::SimdValue;
use proptest::prelude::*;
use simba::simd::AutoSimd;

use crate::*;

const TICK_NS: u64 = 1_000_000;

type Lanes = AutoSimd<[f64; 8]>;

fn hand(depth: f64, strength: f64, kind: ReleaseKind) -> Hand<1> {
    let at = Axes::<1>::new;
    let legs = vec![
        Leg { duration_s: 0.05, end: at(0.5 * depth), shape: LegShape::Smooth },
        Leg { duration_s: 0.02 + depth.abs(), end: at(depth), shape: LegShape::MinimumJerk },
    ];
    let release = Some(Release { at_s: 0.15, decay_s: 0.03, kind });
    let hand = Hand::new(300.0, 5.0, strength, Path::new(at(0.002), legs).unwrap(), release).unwrap();
    hand.with_tremor(Tremor { amplitude: 1e-4, frequency_hz: 10.0 }).unwrap()
}

/// Largest difference in m to the exact solution over 0.25 s.
fn error(stepping: Stepping, step_s: f64) -> f64 {
    let device = DeviceParameters::<1>::ideal(0.157, 0.5, 0.0);
    let hand = hand(-0.02, f64::INFINITY, ReleaseKind::Gain);
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

/// One scenario per row: depth, mass, coulomb, stiffness of the wall, grip strength.
type Row = (f64, f64, f64, f64, f64);

fn build(row: &Row, stepping: Stepping, kind: ReleaseKind) -> SteppedMaster<1> {
    let (depth, mass, coulomb, stiffness, strength) = *row;
    let device = DeviceParameters::<1> {
        encoder_quantum: 2.3e-5,
        force_quantum_n: 0.01,
        max_force_n: 7.9,
        stops: (Axes::<1>::new(-0.03), Axes::<1>::new(0.03)),
        ..DeviceParameters::ideal(mass, -0.005, coulomb)
    };
    let wall = ContinuousWall::new(Axes::<1>::zeros(), Axes::<1>::new(1.0), stiffness, 0.1, false).unwrap();
    SteppedMaster::new(&device, &hand(depth, strength, kind), &[wall], stepping, 5e-4, 1e-3).unwrap()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn a_lane_is_a_run_of_its_own(
        rows in prop::collection::vec(
            (-0.05..0.0f64, 0.05..0.5f64, 0.0..0.1f64, 10.0..1000.0f64, 0.1..20.0f64), 8),
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
    let row = (-0.02, 0.157, 0.0, 200.0, 5.0);
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
