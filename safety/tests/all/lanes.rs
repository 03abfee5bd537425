//! Several scenarios at once: each lane gives, bit for bit, the result of its scenario alone.

#![allow(clippy::unwrap_used)] // the settings of these tests are valid

use haptether_numeric::Lanes;
use haptether_safety::controller::{ControllerKind, Intervention, SafetySettings};
use haptether_safety::estimator::{EstimatorKind, Fit};
use haptether_safety::observer::VelocityForceForm;
use haptether_safety::{
    Axes, DeviceModel, LayerSettings, Limiter, LimiterSettings, Real, SafetyLayer, SafetyTick, SampleBounds,
};
use nalgebra::{SimdBool as _, SimdValue};
use proptest::prelude::*;

const PERIOD_S: f64 = 1e-3;
const QUANTUM_M: f64 = 2.3e-5;
const LANES: usize = Lanes::LANES;

/// x, V and `F_v` of one scenario.
type Sample = [[f64; 3]; 3];
type Tick = [Sample; LANES];

/// Input of the pipeline at a tick.
#[derive(Clone, Copy)]
struct Input<const N: usize, S: Real = f64> {
    position: Axes<N, S>,
    velocity: Axes<N, S>,
    force: Axes<N, S>,
}

fn input<const N: usize>(sample: &Sample) -> Input<N> {
    let [position, velocity, force] = sample.map(|values| Axes::from_column_slice(&values[..N]));
    Input { position, velocity, force }
}

fn spread(of: impl Fn(usize) -> f64) -> Lanes {
    let mut all = Lanes::splat(0.0);
    for lane in 0..LANES {
        all.replace(lane, of(lane));
    }
    all
}

fn inputs<const N: usize>(tick: &Tick) -> Input<N, Lanes> {
    let [position, velocity, force] =
        [0, 1, 2].map(|signal| Axes::from_fn(|axis, _| spread(|lane| tick[lane][signal][axis])));
    Input { position, velocity, force }
}

/// Draw three values; exact zeros occur among them, to cover their selections.
fn triple(bound: f64) -> impl Strategy<Value = [f64; 3]> {
    prop_oneof![1 => Just([0.0; 3]), 1 => Just([-0.0, 1e-3, 0.0]), 8 => prop::array::uniform3(-bound..bound)]
}

fn ticks() -> impl Strategy<Value = Vec<Tick>> {
    let step = prop_oneof![9 => triple(5e-4), 1 => triple(5e-3)];
    let sample = (step, triple(2.0), triple(12.0)).prop_map(|(x, v, f)| [x, v, f]);
    prop::collection::vec(prop::array::uniform8(sample), 1..80).prop_map(|mut ticks| {
        let mut at = [[0.02; 3]; LANES];
        for (position, sample) in ticks.iter_mut().flat_map(|tick| (0..LANES).zip(tick)) {
            for (x, dx) in at[position].iter_mut().zip(&mut sample[0]) {
                *x += *dx;
                *dx = (*x / QUANTUM_M).round() * QUANTUM_M;
            }
        }
        ticks
    })
}

/// Values that may differ between lanes: device, thresholds, energies and times, limits.
///
/// m, b, c; mu, `V_t`, `F_t`, zeta, alpha, `F_t` of HSC; delta, eta, alpha of PC, hold-off, ramp; four limits.
type Numbers = ([f64; 3], [f64; 6], [f64; 5], [f64; 4]);

fn numbers() -> impl Strategy<Value = [Numbers; LANES]> {
    let device = [0.1..0.4, -0.01..0.5, 0.0..0.1];
    let thresholds = [0.5..20.0, 0.2..1.0, 0.5..3.0, 1.1..3.0, 1e-4..1e-2, 0.05..2.0];
    let energies = [-0.03..-1e-3, 0.2..1.0, 0.5..20.0, 0.0..0.02, 0.0..0.03];
    let bounds = [2.0..9.0, 100.0..5000.0, 0.5..20.0, 0.0..0.03];
    prop::array::uniform8((device, thresholds, energies, bounds))
}

/// Values that must be equal in all lanes.
type Shared = ([bool; 4], bool, usize);

fn shared() -> impl Strategy<Value = Shared> {
    (prop::array::uniform4(any::<bool>()), any::<bool>(), 1_usize..30)
}

fn device<const N: usize>(numbers: &Numbers) -> DeviceModel<N> {
    let [mass, viscous, coulomb] = numbers.0;
    DeviceModel::new(
        Axes::from_fn(|axis, _| mass * (1.0 + 0.1 * axis as f64)),
        Axes::repeat(viscous),
        Axes::repeat(coulomb),
    )
    .unwrap()
}

fn safety((on, both, window): Shared, numbers: &Numbers) -> SafetySettings {
    let (_, thresholds, energies, _) = *numbers;
    let [damping, velocity_threshold, vfc_force_threshold_n, grasp_threshold, grasp_floor_n, hsc_force] =
        thresholds;
    let [energy_threshold_j, energy_ratio, pc_max_damping, hold_off_s, ramp] = energies;
    SafetySettings {
        controllers: ControllerKind::ALL
            .into_iter()
            .zip(on)
            .filter(|(_, on)| *on)
            .map(|(kind, _)| kind)
            .collect(),
        damping,
        velocity_threshold,
        vfc_force_threshold_n,
        vfc_form: if both { VelocityForceForm::Both } else { VelocityForceForm::Product },
        grasp_threshold,
        grasp_floor_n,
        hsc_force_threshold_n: hsc_force,
        // 0 in some lanes.
        hsc_velocity_threshold: (velocity_threshold - 0.6).max(0.0),
        energy_threshold_j,
        // 0 in some lanes.
        wsc_force_threshold_n: (vfc_force_threshold_n - 1.0).max(0.0),
        energy_ratio,
        window,
        pc_max_damping,
        hold_off_s,
        // Some lanes have no ramp; Eq. 14 then holds as printed.
        release_ramp_s: (ramp - 0.01).max(0.0),
        probe_force_n: if window % 2 == 0 { 0.0 } else { 2.0 * energy_ratio + 1.0 },
        probe_threshold: 0.25,
        release_tries: if window % 3 == 0 { 0 } else { 1 + 3 * u32::from(energy_ratio > 0.5) },
    }
}

fn limits(numbers: &Numbers) -> LimiterSettings {
    let [max_force_n, max_slew_n_per_s, max_power_w, ramp_in_s] = numbers.3;
    LimiterSettings { max_force_n, max_slew_n_per_s, max_power_w, ramp_in_s: (ramp_in_s - 0.01).max(0.0) }
}

/// Return the estimator of index `which`; parameters that may differ between lanes do.
fn kind(which: usize, numbers: &Numbers) -> EstimatorKind {
    let own = numbers.3[0];
    let noise_bound_m = QUANTUM_M * own;
    match which {
        0 => EstimatorKind::BackwardDifference {},
        1 => EstimatorKind::LowPass { cutoff_hz: 10.0 * own },
        2 => EstimatorKind::SavitzkyGolay { degree: 2, window: 15 },
        3 => EstimatorKind::Kalman { jerk_density: 10.0 * own, quantum_m: QUANTUM_M },
        4 => EstimatorKind::DualKalman {
            velocity_jerk_density: 100.0 * own,
            jerk_density: 10.0 * own,
            quantum_m: QUANTUM_M,
        },
        5 if own > 5.0 => EstimatorKind::AdaptiveWindow { noise_bound_m, max_window: 8, fit: Fit::Best },
        _ => EstimatorKind::AdaptiveWindow { noise_bound_m, max_window: 16, fit: Fit::End },
    }
}

fn layer<const N: usize>(which: usize, shared: Shared, numbers: &Numbers) -> SafetyLayer<N> {
    SafetyLayer::new(&LayerSettings {
        device: device(numbers),
        period_s: PERIOD_S,
        estimator: kind(which, numbers),
        safety: safety(shared, numbers),
        limiter: limits(numbers),
    })
    .unwrap()
    .with_samples(SampleBounds::UNBOUNDED)
}

/// Return an intervention bit for bit; all NaN are equal.
fn bits<const N: usize>(of: &Intervention<N>) -> ([u64; N], [u64; 4], u8) {
    let plain = of.observed.0.map(|value| if value.is_nan() { f64::NAN } else { value });
    (of.safety_force.map(f64::to_bits).into(), plain.map(f64::to_bits), of.tripped.bits())
}

/// Return a tick bit for bit.
fn tick_bits<const N: usize>(
    tick: &SafetyTick<N>,
) -> ([[u64; N]; 5], impl PartialEq + std::fmt::Debug + use<N>) {
    let SafetyTick { motion, rendered_force, grasp_force, device_force, .. } = *tick;
    let vectors = [motion.velocity, motion.acceleration, rendered_force, grasp_force, device_force];
    let rest = (bits(&tick.intervention), tick.acted.bits(), tick.owed_energy_j.to_bits());
    (vectors.map(|vector| vector.map(f64::to_bits).into()), rest)
}

fn limiter_agrees<const N: usize>(numbers: &[Numbers; LANES], ticks: &[Tick]) -> Result<(), TestCaseError> {
    let build = |of: &Numbers| Limiter::<N>::new(PERIOD_S, limits(of)).unwrap();
    let mut ones: Vec<_> = numbers.iter().map(build).collect();
    let mut lanes = Limiter::<N, Lanes>::gather(&ones.iter().collect::<Vec<_>>()).unwrap();
    for (n, tick) in ticks.iter().enumerate() {
        let mut tick = *tick;
        // A lane with an invalid value pauses its ramp and disturbs no other lane.
        if n % 5 == 1 {
            tick[n % LANES][2][0] = f64::NAN;
        }
        let at = inputs::<N>(&tick);
        let bounded = lanes.limit(&at.force, &at.velocity);
        for (lane, (one, sample)) in ones.iter_mut().zip(&tick).enumerate() {
            let Input { force, velocity, .. } = input(sample);
            let alone = one.step(&force, &velocity);
            prop_assert_eq!(bounded.force.extract(lane).map(f64::to_bits), alone.force.map(f64::to_bits));
            prop_assert_eq!(bounded.acted(lane), alone.acted);
        }
    }
    Ok(())
}

fn layer_agrees<const N: usize>(
    which: usize,
    measures_velocity: bool,
    shared: Shared,
    numbers: &[Numbers; LANES],
    ticks: &[Tick],
) -> Result<(), TestCaseError> {
    let mut ones: Vec<_> = numbers.iter().map(|of| layer::<N>(which, shared, of)).collect();
    let mut lanes = SafetyLayer::<N, Lanes>::gather(&ones.iter().collect::<Vec<_>>()).unwrap();
    let first = &ticks[0];
    lanes.rest_at(&inputs::<N>(first).position);
    for (one, sample) in ones.iter_mut().zip(first) {
        one.reset(&input(sample).position).unwrap();
    }
    let authority = numbers.map(|of| of.1[1]);
    // An invalid value in one lane stops its layer and disturbs no other lane.
    let (bad_lane, bad_from) = (which % LANES, ticks.len() / 2);
    for (n, tick) in ticks.iter().enumerate() {
        let mut tick = *tick;
        if n >= bad_from {
            tick[bad_lane][0][0] = f64::NAN;
        }
        let at = inputs::<N>(&tick);
        let velocity = measures_velocity.then_some(&at.velocity);
        let advance = lanes.advance(&at.position, velocity, &at.force, spread(|lane| authority[lane]));
        let passes = advance.seen().passes().bitmask();
        for (lane, (one, sample)) in ones.iter_mut().zip(&tick).enumerate() {
            let Input { position, velocity, force, .. } = input(sample);
            let velocity = measures_velocity.then_some(&velocity);
            let alone = one.tick_with_authority(&position, velocity, &force, authority[lane]);
            if alone.fault.is_none() {
                prop_assert!(passes >> lane & 1 == 1);
                prop_assert_eq!(tick_bits(&advance.lane(lane)), tick_bits(&alone));
            } else {
                prop_assert!(lane == bad_lane && n >= bad_from);
            }
        }
    }
    Ok(())
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn the_limiter(numbers in numbers(), ticks in ticks()) {
        limiter_agrees::<1>(&numbers, &ticks)?;
        limiter_agrees::<3>(&numbers, &ticks)?;
    }

    #[test]
    fn the_layer(
        which in 0_usize..6,
        measures_velocity in any::<bool>(),
        shared in shared(),
        numbers in numbers(),
        ticks in ticks(),
    ) {
        layer_agrees::<1>(which, measures_velocity, shared, &numbers, &ticks)?;
        layer_agrees::<3>(which, measures_velocity, shared, &numbers, &ticks)?;
    }
}

/// Return whether eight layers can be gathered, the last of them with changed settings.
fn gathers(change: impl FnOnce(&mut LayerSettings<1>)) -> bool {
    let mut settings = LayerSettings {
        device: DeviceModel::phantom_desktop(),
        period_s: PERIOD_S,
        estimator: EstimatorKind::default(),
        safety: SafetySettings {
            controllers: [ControllerKind::Vfc, ControllerKind::Wsc].into(),
            ..SafetySettings::default()
        },
        limiter: LimiterSettings::default(),
    };
    let mut layers = vec![SafetyLayer::new(&settings).unwrap(); LANES - 1];
    change(&mut settings);
    layers.push(SafetyLayer::new(&settings).unwrap());
    SafetyLayer::<1, Lanes>::gather(&layers.iter().collect::<Vec<_>>()).is_some()
}

#[test]
fn only_layers_with_equal_structure_are_gathered() {
    assert!(gathers(|_| ()));
    assert!(gathers(|of| of.device = DeviceModel::uniform(0.2, 0.0, 0.0).unwrap()));
    assert!(gathers(|of| of.safety.hold_off_s = 0.1));
    assert!(gathers(|of| of.limiter.ramp_in_s = 0.1));
    assert!(gathers(|of| of.estimator = EstimatorKind::Kalman { jerk_density: 1e4, quantum_m: QUANTUM_M }));
    assert!(!gathers(|of| of.period_s = 2e-3));
    assert!(!gathers(|of| of.safety.controllers = of.safety.controllers.with(ControllerKind::Hsc, true)));
    assert!(!gathers(|of| of.safety.controllers = of.safety.controllers.with(ControllerKind::Vfc, false)));
    assert!(!gathers(|of| of.safety.window = 50));
    assert!(!gathers(|of| of.safety.vfc_form = VelocityForceForm::Both));
    assert!(!gathers(|of| of.estimator = EstimatorKind::BackwardDifference {}));
    let one = Limiter::<1>::new(PERIOD_S, LimiterSettings::default()).unwrap();
    assert!(Limiter::<1, Lanes>::gather(&[&one; LANES + 1]).is_none());
}
