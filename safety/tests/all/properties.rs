//! Properties that hold for every sequence of samples, set of controllers, estimator and number of axes.

#![allow(clippy::unwrap_used)] // the settings of these tests are valid

use haptether_safety::controller::{ControllerKind, Intervention, SafetyController, SafetySettings, Tripped};
use haptether_safety::estimator::{Estimator, EstimatorKind, Fit, Motion};
use haptether_safety::observer::{
    HandGraspObserver, PassivityObserver, SafetyObserver, VelocityForceForm, VelocityForceObserver,
    WindowedSafetyObserver,
};
use haptether_safety::{
    ActiveLimits, Axes, DeviceModel, Fault, LayerSettings, Limiter, LimiterSettings, Observation,
    SafetyLayer, SampleBounds, Signal,
};
use nalgebra::Rotation3;
use proptest::prelude::*;

const PERIOD_S: f64 = 1e-3;
const MASS_KG: f64 = 0.157;
const QUANTUM_M: f64 = 2.3e-5;

/// Linear estimators, then those whose windows follow the motion.
const KINDS: [EstimatorKind; 9] = [
    EstimatorKind::BackwardDifference {},
    EstimatorKind::LowPass { cutoff_hz: 30.0 },
    EstimatorKind::SavitzkyGolay { degree: 2, window: 15 },
    EstimatorKind::SavitzkyGolay { degree: 3, window: 31 },
    EstimatorKind::Kalman { jerk_density: 10.0, quantum_m: QUANTUM_M },
    EstimatorKind::Kalman { jerk_density: 1e4, quantum_m: QUANTUM_M },
    EstimatorKind::DualKalman { velocity_jerk_density: 1e3, jerk_density: 10.0, quantum_m: QUANTUM_M },
    EstimatorKind::AdaptiveWindow { noise_bound_m: QUANTUM_M, max_window: 16, fit: Fit::End },
    EstimatorKind::AdaptiveWindow { noise_bound_m: QUANTUM_M, max_window: 32, fit: Fit::Best },
];
const LINEAR: usize = 7;

fn device<const N: usize>() -> DeviceModel<N> {
    DeviceModel::uniform(MASS_KG, -0.005, 0.038).unwrap()
}

/// Three values each for V, `F_v` and `F_h`, or for other triples.
type Sample = [[f64; 3]; 3];

fn triple(bound: f64) -> impl Strategy<Value = [f64; 3]> {
    // Exact zeros occur among the samples, to cover their branches.
    prop_oneof![1 => Just([0.0; 3]), 9 => prop::array::uniform3(-bound..bound)]
}

fn samples(ticks: usize) -> impl Strategy<Value = Vec<Sample>> {
    let sample = (triple(2.0), triple(12.0), triple(12.0)).prop_map(|(v, f_v, f_h)| [v, f_v, f_h]);
    prop::collection::vec(sample, 1..ticks)
}

/// Draw positions of a hand that wanders and may jump.
fn positions(ticks: usize) -> impl Strategy<Value = Vec<[f64; 3]>> {
    let step = prop_oneof![9 => triple(5e-4), 1 => triple(5e-3)];
    prop::collection::vec(step, 1..ticks).prop_map(|steps| {
        let mut at = [0.02; 3];
        let walk = |step: [f64; 3]| {
            at.iter_mut().zip(step).for_each(|(x, dx)| *x += dx);
            at
        };
        steps.into_iter().map(walk).collect()
    })
}

/// Draw any set of controllers, with thresholds that random samples cross.
fn controllers() -> impl Strategy<Value = SafetySettings> {
    let switches = prop::array::uniform4(any::<bool>());
    (switches, any::<bool>(), 0.0..0.02, 0.0..0.02).prop_map(|(on, both, hold, ramp)| SafetySettings {
        controllers: ControllerKind::ALL
            .into_iter()
            .zip(on)
            .filter(|(_, on)| *on)
            .map(|(kind, _)| kind)
            .collect(),
        vfc_form: if both { VelocityForceForm::Both } else { VelocityForceForm::Product },
        window: 20,
        hold_off_s: hold,
        release_ramp_s: ramp,
        // Each of the two is 0 in half of the cases.
        hsc_velocity_threshold: 10.0 * (hold - 0.01).max(0.0),
        wsc_force_threshold_n: 50.0 * (ramp - 0.01).max(0.0),
        ..SafetySettings::default()
    })
}

fn limits() -> LimiterSettings {
    LimiterSettings { ramp_in_s: 0.0, ..LimiterSettings::default() }
}

/// Create a layer with any settings and without sample bounds.
fn layer<const N: usize>(
    safety: SafetySettings,
    estimator: EstimatorKind,
    limiter: LimiterSettings,
) -> SafetyLayer<N> {
    let settings = LayerSettings { device: device(), period_s: PERIOD_S, estimator, safety, limiter };
    SafetyLayer::new(&settings).unwrap().with_samples(SampleBounds::UNBOUNDED)
}

/// Return the first N of three values.
fn axes<const N: usize>(of: &[f64; 3]) -> Axes<N> {
    Axes::from_column_slice(&of[..N])
}

/// Return a vector along one axis of three.
fn along(axis: usize, value: f64) -> Axes<3> {
    Axes::from_fn(|i, _| if i == axis { value } else { 0.0 })
}

fn seen<const N: usize>(sample: &Sample) -> Observation<N> {
    let [velocity, rendered_force, grasp_force] = sample.map(|values| axes(&values));
    Observation::exact(velocity, rendered_force, grasp_force)
}

fn turned(seen: &Observation<3>, by: &Rotation3<f64>) -> Observation<3> {
    Observation::exact(by * seen.velocity, by * seen.rendered_force, by * seen.grasp_force)
}

/// Return the complete observable state of an intervention bit for bit; 0 and -0 are equal.
fn bits<const N: usize>(step: &Intervention<N>) -> ([u64; 4], u8) {
    (step.observed.0.map(|value| (value + 0.0).to_bits()), step.tripped.bits())
}

/// Return whether an observed value is so close to its threshold that rounding may decide.
fn is_close<const N: usize>(
    seen: &Observation<N>,
    step: &Intervention<N>,
    settings: &SafetySettings,
) -> bool {
    let along = seen.velocity.dot(&seen.rendered_force);
    [
        (step.observed[ControllerKind::Vfc], 1.0),
        (step.observed[ControllerKind::Hsc], settings.grasp_threshold),
        (step.observed[ControllerKind::Wsc], settings.energy_threshold_j),
        (seen.rendered_force.norm(), settings.hsc_force_threshold_n),
        (along / seen.rendered_force.norm(), settings.hsc_velocity_threshold),
        (along / seen.velocity.norm(), settings.wsc_force_threshold_n),
    ]
    .iter()
    .any(|(value, threshold)| (value - threshold).abs() < 1e-9)
}

fn is_unsafe(tripped: Tripped) -> bool {
    [Tripped::of(ControllerKind::Vfc), Tripped::of(ControllerKind::Hsc), Tripped::of(ControllerKind::Wsc)]
        .into_iter()
        .any(|who| tripped.contains(who))
}

/// Check cap, power limit and latched faults over N axes.
fn stays_within<const N: usize>(
    mut layer: SafetyLayer<N>,
    limits: LimiterSettings,
    measures_velocity: bool,
    ticks: &[([f64; 3], Sample)],
) -> Result<(), TestCaseError> {
    let mut fault = None;
    for (position, sample) in ticks {
        let velocity: Axes<N> = axes(&sample[0]);
        // A request far beyond the cap.
        let rendered = axes::<N>(&sample[1]) * 100.0;
        let tick = layer.tick(&axes(position), measures_velocity.then_some(&velocity), &rendered);
        let force = tick.device_force;
        prop_assert!(force.norm() <= limits.max_force_n * (1.0 + 1e-12), "{force}");
        let power = force.dot(&tick.motion.velocity);
        prop_assert!(power <= limits.max_power_w * (1.0 + 1e-9), "{power}");
        prop_assert!(tick.owed_energy_j >= 0.0);
        prop_assert!(fault.is_none() || fault == tick.fault, "a fault is latched");
        fault = tick.fault;
        prop_assert!(fault.is_none() || force == Axes::<N>::zeros());
    }
    Ok(())
}

proptest! {
    #[test]
    fn device_force_stays_within_its_limits(
        safety in controllers(),
        kind in prop::sample::select(KINDS.to_vec()),
        measures_velocity in any::<bool>(),
        cap in 0.5..10.0,
        ramp_in_s in 0.0..0.05,
        ticks in (positions(150), samples(150)).prop_map(|(x, s)| x.into_iter().zip(s).collect::<Vec<_>>()),
    ) {
        let limits = LimiterSettings { max_force_n: cap, ramp_in_s, max_power_w: 5.0, ..limits() };
        stays_within::<1>(layer(safety, kind, limits), limits, measures_velocity, &ticks)?;
        stays_within::<3>(layer(safety, kind, limits), limits, measures_velocity, &ticks)?;
    }

    #[test]
    fn intervention_never_adds_energy_to_the_motion(settings in controllers(), samples in samples(150)) {
        let mut controller = SafetyController::<3>::new(&device(), PERIOD_S, &settings).unwrap();
        for sample in &samples {
            let seen = seen::<3>(sample);
            let step = controller.step(&seen).unwrap();
            let (v, f_v, f_c) = (seen.velocity, seen.rendered_force, step.safety_force);
            if is_unsafe(step.tripped) {
                // The sum rounds once per axis.
                let rounding = 4.0 * f64::EPSILON * (f_v.norm() + f_c.norm()) * v.norm();
                prop_assert!((f_v + f_c).dot(&v) <= rounding);
                prop_assert!((f_v + f_c + v * settings.damping).norm() <= 1e-14 * (1.0 + f_c.norm()));
            } else if step.tripped == Tripped::of(ControllerKind::Pc) {
                prop_assert!(f_c.dot(&v) < 0.0);
                prop_assert!(f_c.norm() <= settings.pc_max_damping * v.norm() * (1.0 + 1e-15));
            } else if !step.tripped.any() {
                prop_assert_eq!(f_c, Axes::<3>::zeros());
            }
        }
    }

    /// Velocities, forces and thresholds scale by a common factor; a power of two scales without rounding.
    #[test]
    fn scales(
        settings in controllers(),
        kind in 0..KINDS.len(),
        exponent in -6..7_i32,
        positions in positions(100),
        samples in samples(100),
    ) {
        let s = 2.0_f64.powi(exponent);
        let scaled_settings = SafetySettings {
            velocity_threshold: settings.velocity_threshold * s,
            vfc_force_threshold_n: settings.vfc_force_threshold_n * s,
            grasp_floor_n: settings.grasp_floor_n * s,
            hsc_force_threshold_n: settings.hsc_force_threshold_n * s,
            hsc_velocity_threshold: settings.hsc_velocity_threshold * s,
            energy_threshold_j: settings.energy_threshold_j * s * s,
            wsc_force_threshold_n: settings.wsc_force_threshold_n * s,
            ..settings
        };
        let scaled_kind = match KINDS[kind] {
            EstimatorKind::AdaptiveWindow { noise_bound_m, max_window, fit } => {
                EstimatorKind::AdaptiveWindow { noise_bound_m: noise_bound_m * s, max_window, fit }
            }
            linear => linear,
        };
        let scaled_limits = LimiterSettings {
            max_force_n: limits().max_force_n * s,
            max_slew_n_per_s: limits().max_slew_n_per_s * s,
            max_power_w: limits().max_power_w * s * s,
            ramp_in_s: 0.0,
        };
        let of = |s: f64| DeviceModel::<3>::uniform(MASS_KG, -0.005, 0.038 * s).unwrap();
        let build = |device, estimator, safety, limiter| {
            let settings = LayerSettings { device, period_s: PERIOD_S, estimator, safety, limiter };
            SafetyLayer::new(&settings).unwrap().with_samples(SampleBounds::UNBOUNDED)
        };
        let mut plain = build(of(1.0), KINDS[kind], settings, limits());
        let mut scaled = build(of(s), scaled_kind, scaled_settings, scaled_limits);
        for (position, sample) in positions.iter().zip(&samples) {
            let (x, f_v) = (axes::<3>(position), axes::<3>(&sample[1]));
            let (one, other) = (plain.tick(&x, None, &f_v), scaled.tick(&(x * s), None, &(f_v * s)));
            if one.fault.is_some() || other.fault.is_some() {
                return Ok(()); // the bounds of valid values do not scale
            }
            prop_assert_eq!(one.device_force * s, other.device_force);
            prop_assert_eq!(one.grasp_force * s, other.grasp_force);
            prop_assert_eq!(one.owed_energy_j * s * s, other.owed_energy_j);
            let mut rescaled = one.intervention;
            rescaled.observed[ControllerKind::Wsc] *= s * s;
            rescaled.observed[ControllerKind::Pc] *= s * s;
            prop_assert_eq!(bits(&rescaled), bits(&other.intervention));
        }
    }

    #[test]
    fn observers_and_controllers_rotate_with_the_frame(
        settings in controllers(),
        angles in prop::array::uniform3(-3.0..3.0_f64),
        samples in samples(100),
    ) {
        let by = Rotation3::from_euler_angles(angles[0], angles[1], angles[2]);
        let all = SafetySettings { controllers: ControllerKind::ALL.into(), ..settings };
        let mut observers = SafetyController::new(&device(), PERIOD_S, &all).unwrap();
        let mut turned_observers = observers.clone();
        let mut controller = SafetyController::new(&device(), PERIOD_S, &settings).unwrap();
        let mut turned_controller = controller.clone();
        let (mut passivity, mut turned_passivity) = (PassivityObserver::new(), PassivityObserver::new());
        for sample in &samples {
            let seen = seen::<3>(sample);
            let turned = turned(&seen, &by);
            let (one, other) = (observers.step(&seen).unwrap(), turned_observers.step(&turned).unwrap());
            // E_so and PO sum at most 100 products below 36 N * 4 m/s (dT is 1 for PO).
            let near = |a: f64, b: f64, size: f64| (a - b).abs() <= 1e-12 * size.max(a.abs());
            prop_assert!(near(one.observed[ControllerKind::Vfc], other.observed[ControllerKind::Vfc], 1.0));
            prop_assert!(near(one.observed[ControllerKind::Hsc], other.observed[ControllerKind::Hsc], 1.0));
            prop_assert!(near(one.observed[ControllerKind::Wsc], other.observed[ControllerKind::Wsc], 10.0));
            prop_assert!(near(one.observed[ControllerKind::Pc], other.observed[ControllerKind::Pc], 10.0));
            let energy_j = passivity.step(&seen.velocity, &seen.rendered_force);
            let turned_j = turned_passivity.step(&turned.velocity, &turned.rendered_force);
            prop_assert!(near(energy_j, turned_j, 1e4));
            prop_assume!(!is_close(&seen, &one, &settings));
            let (one, other) = (controller.step(&seen).unwrap(), turned_controller.step(&turned).unwrap());
            // PC divides an energy with an error of about 1e-14 J by V dT.
            let tolerance = 1e-10 / (PERIOD_S * seen.velocity.norm()).max(1e-6);
            prop_assert!((by * one.safety_force - other.safety_force).norm() <= tolerance.max(1e-11));
        }
    }

    /// A device with equal mass and friction on each axis has no preferred axes, nor has a linear estimator.
    #[test]
    fn estimates_and_grasp_force_rotate_with_the_frame(
        angles in prop::array::uniform3(-3.0..3.0_f64),
        positions in positions(100),
    ) {
        let by = Rotation3::from_euler_angles(angles[0], angles[1], angles[2]);
        for kind in &KINDS[..LINEAR] {
            let mut straight = kind.build::<3>(PERIOD_S).unwrap();
            let mut turned = straight.clone();
            for position in &positions {
                let x = axes::<3>(position);
                let (one, other) = (straight.step(&x), turned.step(&(by * x)));
                // Positions of 0.3 m round to 1e-16 m, and A shows up to 4 / dT² of that.
                prop_assert!((by * one.velocity - other.velocity).norm() < 1e-11);
                prop_assert!((by * one.acceleration - other.acceleration).norm() < 1e-8);
                // Any vector serves as force.
                let (force, turned_force) = (straight.align(&(x * 100.0)), turned.align(&(by * x * 100.0)));
                prop_assert!((by * force - turned_force).norm() < 1e-11);
                // Coulomb friction turns with V; near V = 0 its direction is rounding.
                if one.velocity.norm() > 1e-6 {
                    let held = device::<3>().grasp_force(&one, &force);
                    prop_assert!((by * held - device().grasp_force(&other, &turned_force)).norm() < 1e-6);
                }
            }
        }
    }

    #[test]
    fn layer_after_rest_equals_a_new_one(
        settings in controllers(),
        kind in prop::sample::select(KINDS.to_vec()),
        rest in 1..80_usize,
        positions in positions(100),
        samples in samples(100),
    ) {
        // WSO replaces its sum once per pass over its ring, so a shift changes its rounding; it has its own test
        // below.
        let settings = SafetySettings { controllers: settings.controllers.with(ControllerKind::Wsc, false), ..settings };
        let (mut new, mut rested) = (layer::<3>(settings, kind, limits()), layer::<3>(settings, kind, limits()));
        for _ in 0..rest {
            let tick = rested.tick(&axes(&positions[0]), None, &Axes::zeros());
            prop_assert_eq!(tick.device_force, Axes::<3>::zeros());
            prop_assert!(!tick.intervention.tripped.any());
        }
        for (position, sample) in positions.iter().zip(&samples) {
            let (x, f_v) = (axes(position), axes(&sample[1]));
            let (one, other) = (new.tick(&x, None, &f_v), rested.tick(&x, None, &f_v));
            prop_assert_eq!(one.motion, other.motion);
            prop_assert_eq!(one.device_force, other.device_force);
            prop_assert_eq!(bits(&one.intervention), bits(&other.intervention));
            prop_assert_eq!(one.fault, other.fault);
        }
    }

    #[test]
    fn window_after_zeros_equals_a_new_one(
        window in 1..60_usize,
        rest in 1..80_usize,
        samples in samples(150),
    ) {
        let mut new = WindowedSafetyObserver::<3>::new(device(), PERIOD_S, 0.5, window).unwrap();
        let mut rested = new.clone();
        for _ in 0..rest {
            prop_assert_eq!(rested.step(&seen(&[[0.0; 3]; 3])), 0.0);
        }
        for sample in &samples {
            let (one, other) = (new.step(&seen(sample)), rested.step(&seen(sample)));
            // At most 210 additions of powers below 72 W to a sum below 60 * 72 W, times dT.
            prop_assert!((one - other).abs() < 1e-12);
        }
    }

    #[test]
    fn one_axis_of_three_is_one_axis(
        settings in controllers(),
        kind in prop::sample::select(KINDS.to_vec()),
        axis in 0..3_usize,
        measures_velocity in any::<bool>(),
        positions in positions(100),
        samples in samples(100),
    ) {
        let mut one = layer::<1>(settings, kind, limits());
        let mut three = layer::<3>(settings, kind, limits());
        let mut so = (
            SafetyObserver::<1>::new(device(), PERIOD_S, 0.5).unwrap(),
            SafetyObserver::<3>::new(device(), PERIOD_S, 0.5).unwrap(),
        );
        let mut po = (PassivityObserver::<1>::new(), PassivityObserver::<3>::new());
        let hgo = HandGraspObserver::new(1e-3).unwrap();
        let vfo = VelocityForceObserver::new(0.6, 1.0, settings.vfc_form).unwrap();
        for (position, sample) in positions.iter().zip(&samples) {
            let (x, [v, f_v, f_h]) = (position[0], sample.map(|values| values[0]));
            let (v1, v3) = (Axes::from([v]), along(axis, v));
            let a = one.tick(&Axes::from([x]), measures_velocity.then_some(&v1), &Axes::from([f_v]));
            let b = three.tick(&along(axis, x), measures_velocity.then_some(&v3), &along(axis, f_v));
            prop_assert_eq!(along(axis, a.device_force[0]), b.device_force);
            prop_assert_eq!(along(axis, a.grasp_force[0]), b.grasp_force);
            let motion = Motion {
                velocity: along(axis, a.motion.velocity[0]),
                acceleration: along(axis, a.motion.acceleration[0]),
            };
            prop_assert_eq!(motion, b.motion);
            prop_assert_eq!(bits(&a.intervention), bits(&b.intervention));
            prop_assert_eq!(along(axis, a.intervention.safety_force[0]), b.intervention.safety_force);
            prop_assert_eq!((a.acted, a.owed_energy_j, a.fault), (b.acted, b.owed_energy_j, b.fault));

            let of_one = seen::<1>(sample);
            let of_three = Observation::exact(along(axis, v), along(axis, f_v), along(axis, f_h));
            prop_assert_eq!(so.0.step(&of_one), so.1.step(&of_three));
            prop_assert_eq!(hgo.observe(&of_one), hgo.observe(&of_three));
            prop_assert_eq!(vfo.observe(&of_one), vfo.observe(&of_three));
            let energies = (
                po.0.step(&Axes::from([x]), &Axes::from([f_v])),
                po.1.step(&along(axis, x), &along(axis, f_v)),
            );
            prop_assert_eq!(energies.0, energies.1);
        }
    }

    #[test]
    fn one_axis_of_three_is_limited_as_one_axis(
        axis in 0..3_usize,
        ramp_in_s in 0.0..0.05,
        samples in samples(150),
    ) {
        let settings = LimiterSettings { ramp_in_s, max_power_w: 3.0, ..LimiterSettings::default() };
        let mut one = Limiter::<1>::new(PERIOD_S, settings).unwrap();
        let mut three = Limiter::<3>::new(PERIOD_S, settings).unwrap();
        for [[v, ..], [force, ..], _] in samples {
            let a = one.step(&Axes::from([force]), &Axes::from([v]));
            let b = three.step(&along(axis, force), &along(axis, v));
            prop_assert_eq!((along(axis, a.force[0]), a.acted), (b.force, b.acted));
        }
    }

    /// Hold-off, ramp and repeated trips follow from the gain g of `F_c` = g (-`F_v` - mu V).
    #[test]
    fn intervention_lasts_fades_and_restarts_at_once(
        hold_ticks in 0..30_u32,
        ramp_ticks in 0..30_u32,
        is_unsafe in prop::collection::vec(prop::bool::weighted(0.06), 1..300),
    ) {
        let settings = SafetySettings {
            controllers: [ControllerKind::Wsc].into(),
            energy_threshold_j: -0.05,
            hold_off_s: f64::from(hold_ticks) * PERIOD_S,
            release_ramp_s: f64::from(ramp_ticks) * PERIOD_S,
            ..SafetySettings::default()
        };
        let mut controller = SafetyController::<1>::new(&device(), PERIOD_S, &settings).unwrap();
        let (mut last, mut begun, mut last_unsafe) = (0.0, 0_u32, 0_u32);
        for (tick, is_unsafe) in (0_u32..).zip(is_unsafe) {
            let velocity = if is_unsafe { 1.0 } else { -0.1 };
            let seen = Observation::exact(Axes::from([velocity]), Axes::from([2.0]), Axes::zeros());
            let step = controller.step(&seen).unwrap();
            let gain = step.safety_force[0] / (-2.0 - settings.damping * velocity);
            prop_assert_eq!(step.tripped.contains(Tripped::of(ControllerKind::Wsc)), is_unsafe);
            prop_assert_eq!(step.tripped.contains(Tripped::HELD), gain > 0.0 && !is_unsafe);
            if is_unsafe {
                prop_assert_eq!(gain, 1.0, "restored at once");
                // A trip during the fade restarts the intervention.
                (begun, last_unsafe) = (if last < 1.0 { tick } else { begun }, tick);
            } else if last > 0.0 {
                let ends = (begun + hold_ticks).max(last_unsafe + 1);
                let faded = f64::from((tick + 1).saturating_sub(ends)) / f64::from(ramp_ticks + 1);
                let expected = 1.0 - faded * faded;
                prop_assert!((gain - expected).abs() < 1e-12, "{} of {}", gain, expected);
                prop_assert!(gain <= last && (tick < ends || gain < last));
            } else {
                prop_assert_eq!(gain, 0.0);
            }
            last = gain;
        }
    }

    #[test]
    fn invalid_value_at_any_tick_gives_zero_force_and_its_fault(
        settings in controllers(),
        kind in prop::sample::select(KINDS.to_vec()),
        at in 0..40_usize,
        axis in 0..3_usize,
        bad in prop::sample::select(vec![f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 1e5, -1e5, f64::MAX]),
        signal in prop::sample::select(vec![Signal::Position, Signal::Velocity, Signal::RenderedForce]),
        measures_velocity in any::<bool>(),
    ) {
        prop_assume!(measures_velocity || signal != Signal::Velocity);
        let named = if bad.is_finite() { Fault::OutOfRange(signal) } else { Fault::NotFinite(signal) };
        let mut layer = layer::<3>(settings, kind, limits());
        let still = Axes::<3>::zeros();
        let push = Axes::<3>::new(0.3, -0.2, 0.1);
        for tick in 0..60 {
            let (mut x, mut v, mut f_v) = (still, still, push);
            if tick == at {
                match signal {
                    Signal::Position => x[axis] = bad,
                    Signal::Velocity => v[axis] = bad,
                    _ => f_v[axis] = bad,
                }
            }
            let step = layer.tick(&x, measures_velocity.then_some(&v), &f_v);
            prop_assert_eq!(step.fault, (tick >= at).then_some(named));
            if tick >= at {
                prop_assert_eq!(step.device_force, still);
                prop_assert!(!step.intervention.tripped.any());
            }
        }
        let mut nowhere = still;
        nowhere[axis] = f64::NAN;
        prop_assert_eq!(layer.reset(&nowhere), Err(Fault::NotFinite(Signal::Position)));
        prop_assert!(layer.tick(&still, None, &push).fault.is_some(), "still latched");
        layer.reset(&still).unwrap();
        let step = layer.tick(&still, measures_velocity.then_some(&still), &push);
        prop_assert_eq!(step.fault, None);
    }

    #[test]
    fn invalid_observation_changes_no_controller(
        settings in controllers(),
        samples in samples(60),
        place in (0..3_usize, 0..3_usize),
        bad in prop::sample::select(vec![f64::NAN, f64::INFINITY, -1e5]),
    ) {
        let mut controller = SafetyController::<3>::new(&device(), PERIOD_S, &settings).unwrap();
        for sample in &samples {
            let mut broken = *sample;
            broken[place.0][place.1] = bad;
            let before = controller.clone();
            prop_assert!(controller.step(&seen(&broken)).is_err());
            prop_assert!(controller == before);
            controller.step(&seen(sample)).unwrap();
        }
    }

    #[test]
    fn owed_energy_is_within_the_missing_energy(
        settings in controllers(),
        samples in samples(150),
    ) {
        let mut layer = layer::<3>(SafetySettings { controllers: settings.controllers.with(ControllerKind::Pc, true), ..settings }, KINDS[0], limits());
        for sample in &samples {
            let (v, f_v) = (axes::<3>(&sample[0]), axes::<3>(&sample[1]));
            let tick = layer.tick(&Axes::zeros(), Some(&v), &f_v);
            let missing = (-tick.intervention.observed[ControllerKind::Pc]).max(0.0);
            prop_assert!((0.0..=missing).contains(&tick.owed_energy_j));
            let paid = -(tick.device_force - tick.rendered_force).dot(&v) * PERIOD_S;
            if (0.0..missing).contains(&paid) {
                prop_assert!((tick.owed_energy_j - (missing - paid)).abs() < 1e-12);
            }
        }
    }

    /// The commanded force dissipates the missing energy; the part that the damping bound and the cap prevent is
    /// owed.
    #[test]
    fn energy_that_the_cap_prevents_is_owed(speed in 0.05..2.0_f64, cap in 0.5..300.0, way in prop::bool::ANY) {
        let safety = SafetySettings { controllers: [ControllerKind::Pc].into(), pc_max_damping: 0.19 * MASS_KG / PERIOD_S, ..SafetySettings::default() };
        let limiter = LimiterSettings { max_force_n: cap, max_slew_n_per_s: 1e9, ..limits() };
        let device = DeviceModel::<1>::uniform(MASS_KG, 0.0, 0.0).unwrap();
        let settings =
            LayerSettings { device, period_s: PERIOD_S, estimator: KINDS[0], safety, limiter };
        let velocity = Axes::from([if way { speed } else { -speed }]);
        let tick = SafetyLayer::new(&settings).unwrap().tick(&Axes::zeros(), Some(&velocity), &Axes::zeros());
        let asked = tick.intervention.safety_force;
        let paid = -tick.device_force.dot(&velocity) * PERIOD_S;
        let missing = MASS_KG * speed * speed;
        prop_assert_eq!(tick.acted.contains(ActiveLimits::NORM), asked.norm() > cap);
        prop_assert!((tick.owed_energy_j - (missing - paid)).abs() < 1e-12);
        prop_assert!(paid > 0.0 && paid < missing);
    }
}
