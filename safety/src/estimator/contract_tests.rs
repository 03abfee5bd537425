//! Contract of all estimators.

use proptest::prelude::*;

use super::{Estimator, EstimatorKind, Fit};
use crate::Axes;

const PERIOD_S: f64 = 1e-3;
const QUANTUM_M: f64 = 2.3e-5;
const MASS_KG: f64 = 0.3;

const KINDS: [EstimatorKind; 10] = [
    EstimatorKind::BackwardDifference {},
    EstimatorKind::LowPass { cutoff_hz: 30.0 },
    EstimatorKind::AdaptiveWindow { noise_bound_m: QUANTUM_M, max_window: 32, fit: Fit::End },
    EstimatorKind::AdaptiveWindow { noise_bound_m: QUANTUM_M, max_window: 32, fit: Fit::Best },
    EstimatorKind::SavitzkyGolay { degree: 2, window: 21 },
    EstimatorKind::SavitzkyGolay { degree: 3, window: 31 },
    EstimatorKind::SavitzkyGolay { degree: 2, window: 3 },
    EstimatorKind::Kalman { jerk_density: 10.0, quantum_m: QUANTUM_M },
    EstimatorKind::Kalman { jerk_density: 1e6, quantum_m: QUANTUM_M },
    EstimatorKind::DualKalman { velocity_jerk_density: 1000.0, jerk_density: 10.0, quantum_m: QUANTUM_M },
];

/// Return positions of a device that rests at `start` and then accelerates, constantly over each tick.
fn moved_by<const N: usize>(start: Axes<N>, accelerations: &[Axes<N>]) -> Vec<Axes<N>> {
    let mut position = start;
    let mut velocity = Axes::zeros();
    let mut positions = vec![start];
    for acceleration in accelerations {
        position += velocity * PERIOD_S + acceleration * (PERIOD_S * PERIOD_S / 2.0);
        velocity += acceleration * PERIOD_S;
        positions.push(position);
    }
    positions
}

/// Return the largest |m A - align(m a)| in N and the largest |x| in m.
fn misalignment<const N: usize>(estimator: &mut impl Estimator<N>, accelerations: &[Axes<N>]) -> (f64, f64) {
    let positions = moved_by(Axes::repeat(0.7), accelerations);
    estimator.step(&positions[0]);
    estimator.align(&Axes::zeros());
    let mut worst = (0.0_f64, 0.7_f64);
    for (position, acceleration) in positions[1..].iter().zip(accelerations) {
        let motion = estimator.step(position);
        let force = estimator.align(&(acceleration * MASS_KG));
        let apart = (motion.acceleration * MASS_KG - force).amax();
        assert!(apart.is_finite());
        worst = (worst.0.max(apart), worst.1.max(position.amax()));
    }
    worst
}

/// Accelerations of a smooth arm motion from rest: 2 cm at 0.7 Hz and 2 mm at 3 Hz.
fn hand_motion(ticks: i32) -> Vec<Axes<1>> {
    let at = |n: i32| {
        let t = f64::from(n) * PERIOD_S;
        Axes::from([0.387 * (4.4 * t).sin() + 0.711 * (18.85 * t).sin()])
    };
    (0..ticks).map(at).collect()
}

/// Return the root mean square and the largest |A - kernel(a)| in m/s² on quantised hand motion, without the
/// start-up.
fn quantisation_noise(kind: EstimatorKind) -> (f64, f64) {
    let accelerations = hand_motion(5000);
    let positions = moved_by(Axes::from([0.1]), &accelerations);
    let quantised = |x: &Axes<1>| x.map(|x| (x / QUANTUM_M).round() * QUANTUM_M);
    let mut estimator = kind.build::<1>(PERIOD_S).unwrap();
    estimator.step(&quantised(&positions[0]));
    estimator.align(&Axes::zeros());
    let mut noise = Vec::new();
    for (position, acceleration) in positions[1..].iter().zip(&accelerations) {
        let motion = estimator.step(&quantised(position));
        noise.push((motion.acceleration - estimator.align(acceleration))[0].abs());
    }
    let settled = &noise[500..];
    let mean_square = settled.iter().map(|e| e * e).sum::<f64>() / settled.len() as f64;
    (mean_square.sqrt(), settled.iter().copied().fold(0.0, f64::max))
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn the_aligned_force_is_the_mass_times_the_estimate(
        accelerations in prop::collection::vec(prop::array::uniform3(-20.0..20.0), 1..300),
    ) {
        let accelerations: Vec<Axes<3>> = accelerations.into_iter().map(Axes::from).collect();
        for kind in KINDS {
            let mut estimator = kind.build::<3>(PERIOD_S).unwrap();
            let (apart, reach) = misalignment(&mut estimator, &accelerations);
            // A position is rounded about four times (two sums here, two in the estimator), each time by eps/2 of its
            // size. No estimator weights positions more than the second difference, 4 / dT².
            let tolerance = MASS_KG * 4.0 / (PERIOD_S * PERIOD_S) * 2.0 * f64::EPSILON * reach;
            prop_assert!(apart <= tolerance, "{:?}: {} > {}", kind, apart, tolerance);
        }
    }

    #[test]
    fn axes_do_not_disturb_each_other(
        positions in prop::collection::vec(prop::array::uniform3(-0.01..0.01), 1..100),
    ) {
        for kind in KINDS {
            let mut vector = kind.build::<3>(PERIOD_S).unwrap();
            let mut scalars = [(); 3].map(|()| kind.build::<1>(PERIOD_S).unwrap());
            for position in &positions {
                let motion = vector.step(&Axes::from(*position));
                // Any force will do, so the test reuses the positions.
                let force = vector.align(&Axes::from(*position));
                for (axis, scalar) in scalars.iter_mut().enumerate() {
                    let alone = scalar.step(&Axes::from([position[axis]]));
                    let force_alone = scalar.align(&Axes::from([position[axis]]));
                    prop_assert_eq!(motion.velocity[axis].to_bits(), alone.velocity[0].to_bits());
                    prop_assert_eq!(motion.acceleration[axis].to_bits(), alone.acceleration[0].to_bits());
                    prop_assert_eq!(force[axis].to_bits(), force_alone[0].to_bits());
                }
            }
        }
    }

    #[test]
    fn reset_estimator_equals_a_new_one(
        past in prop::collection::vec(-0.01..0.01_f64, 1..100),
        positions in prop::collection::vec(-0.01..0.01_f64, 1..100),
    ) {
        for kind in KINDS {
            let mut used = kind.build::<1>(PERIOD_S).unwrap();
            for position in past.iter().map(|x| Axes::from([*x])) {
                used.step(&position);
                used.align(&position);
            }
            used.reset(&Axes::from([positions[0]]));
            let mut new = kind.build::<1>(PERIOD_S).unwrap();
            for position in positions.iter().map(|x| Axes::from([*x])) {
                prop_assert_eq!(used.step(&position), new.step(&position));
                prop_assert_eq!(used.align(&position), new.align(&position));
            }
        }
    }
}

#[test]
fn device_at_rest_has_no_motion_at_any_position() {
    for kind in KINDS {
        let mut estimator = kind.build::<2>(PERIOD_S).unwrap();
        for _ in 0..1000 {
            let motion = estimator.step(&Axes::from([0.123_456_7, -98.7]));
            assert_eq!(motion.velocity, Axes::<2>::zeros(), "{kind:?}");
            assert_eq!(motion.acceleration, Axes::<2>::zeros(), "{kind:?}");
            assert_eq!(estimator.align(&Axes::zeros()), Axes::<2>::zeros(), "{kind:?}");
        }
    }
}

#[test]
fn lasting_force_is_aligned_without_drift() {
    // A hand holds the device against 3 N for 2000 s at 1 kHz; a free mass would move 6e6 m.
    for kind in KINDS {
        let mut estimator = kind.build::<1>(PERIOD_S).unwrap();
        let mut aligned = Axes::zeros();
        for _ in 0..2_000_000 {
            estimator.step(&Axes::from([0.05]));
            aligned = estimator.align(&Axes::from([3.0]));
        }
        // The sum has at most 128 weights, which cancel by a factor below 100; each is rounded a few times.
        assert!((aligned[0] - 3.0).abs() < 3.0 * 100.0 * 4.0 * f64::EPSILON, "{kind:?} {aligned}");
    }
}

#[test]
fn difference_passes_all_quantisation_noise_and_the_others_a_part() {
    let quantum_of_acceleration = QUANTUM_M / (PERIOD_S * PERIOD_S);
    let (difference_rms, difference_worst) = quantisation_noise(EstimatorKind::BackwardDifference {});
    assert!(difference_worst > 0.9 * quantum_of_acceleration, "{difference_worst}");
    // White rounding noise of variance q²/12 gives sqrt(6/12) of a quantum after the second difference.
    assert!((difference_rms / quantum_of_acceleration - 0.5_f64.sqrt()).abs() < 0.1, "{difference_rms}");
    // The limits are about 1.5 times the actual noise, so a worse choice of weights or windows fails.
    for (kind, part) in [(1, 0.16), (2, 0.006), (3, 0.0036), (4, 0.008), (5, 0.018), (7, 0.01), (9, 0.01)] {
        let (rms, _) = quantisation_noise(KINDS[kind]);
        assert!(rms < part * difference_rms, "{:?}: {rms}", KINDS[kind]);
    }
}

#[test]
fn invalid_parameter_is_named() {
    for (kind, name) in [
        (EstimatorKind::LowPass { cutoff_hz: -1.0 }, "cutoff_hz"),
        (EstimatorKind::SavitzkyGolay { degree: 5, window: 21 }, "degree"),
        (EstimatorKind::Kalman { jerk_density: f64::NAN, quantum_m: QUANTUM_M }, "jerk_density"),
    ] {
        assert_eq!(kind.build::<1>(PERIOD_S).unwrap_err().name, name);
    }
    assert_eq!(EstimatorKind::default().build::<1>(0.0).unwrap_err().name, "period_s");
}

/// A multiplication with a subnormal number is about forty times slower, and a device mostly rests.
#[test]
fn decaying_motion_does_not_end_in_subnormal_numbers() {
    for kind in KINDS {
        let mut estimator = kind.build::<1>(PERIOD_S).unwrap();
        estimator.step(&Axes::from([0.0]));
        // The slowest estimator decays by 0.1 per tick and passes 1e-308 after 7000 ticks.
        for n in 0..20_000_i32 {
            let moves = f64::from((200 - n).max(0));
            let motion = estimator.step(&Axes::from([0.2 - 1e-3 * moves]));
            let force = estimator.align(&Axes::from([moves]));
            for x in [motion.velocity[0], motion.acceleration[0], force[0]] {
                // Its square, as in an energy, must be normal as well.
                assert!(x == 0.0 || (x * x).is_normal(), "{kind:?} at tick {n}: {x:e}");
            }
        }
    }
}
