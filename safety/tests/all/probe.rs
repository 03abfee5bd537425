//! Trials of the return of the force after a trip, with several devices, wrong models and hands: it returns only to a
//! hand.
#![allow(clippy::unwrap_used)] // a test may

use haptether_safety::{
    Axes, DeviceModel, LayerSettings, LimiterSettings, SafetyLayer,
    controller::{ControllerKind, Controllers, SafetySettings, Tripped},
    estimator::EstimatorKind,
};

const PERIOD_S: f64 = 1e-3;
const SUBSTEPS: u32 = 4;
const RELEASED_AT: u32 = 400;
/// Default probe force of a scene at this damping; it keeps a free device below 0.1 m/s.
const PROBE_N: f64 = 0.6;
/// Device with its default probe.
#[derive(Clone, Copy, Debug)]
struct Device {
    mass_kg: f64,
    viscous: f64,
    coulomb: f64,
    max_force_n: f64,
    probe_n: f64,
    /// Coarsest drawn encoder quantum as a power of ten in m; a light device must be damped with little lag.
    coarsest: f64,
}
const DESKTOP: Device = Device {
    mass_kg: 0.157,
    viscous: -0.005,
    coulomb: 0.038,
    max_force_n: 7.9,
    probe_n: PROBE_N,
    coarsest: -4.0,
};
/// Friction hides a probe on this device, so the layer only waits for a moving hand.
const OMNI: Device =
    Device { mass_kg: 0.045, viscous: 0.0, coulomb: 0.26, max_force_n: 3.3, probe_n: 0.0, coarsest: -4.26 };
/// Time in ms after the trip at which the first throw is over.
const CAUGHT_MS: u32 = 150;
const DAMPING: f64 = 5.0;

/// `SplitMix64` generator; values are in [low, high).
struct Draws(u64);

impl Draws {
    fn within(&mut self, low: f64, high: f64) -> f64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        low + (high - low) * ((z ^ (z >> 31)) >> 11) as f64 / (1_u64 << 53) as f64
    }
}

/// Situation of the device after the release.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Class {
    Free,
    /// A stop 15 to 40 mm away, in the direction of the push.
    Stop,
    Light,
    Firm,
    /// A firm hand whose target drifts.
    Moving,
    /// A hand of 150 to 600 N/m under 2 to 5 N.
    Bearing,
    /// A hand of 60 to 150 N/m under 1 to 3 N.
    Yielding,
    /// A spring of 5 to 45 N/m under 2 to 7.9 N.
    Spring,
    /// A cable of 50 to 300 N/m that becomes taut after 0 to 30 mm, against the push.
    Cable,
    /// Uncompensated gravity of 0.05 to 0.3 N in either direction.
    Gravity,
}

impl Class {
    fn hand(self, draws: &mut Draws) -> Option<Held> {
        match self {
            Self::Free | Self::Stop | Self::Gravity | Self::Cable => None,
            Self::Spring => {
                Some(Held { stiffness: draws.within(5.0, 45.0), damping: 0.0, mass_kg: 0.0, drift: 0.0 })
            }
            Self::Bearing | Self::Yielding => {
                let stiffness = if self == Self::Bearing {
                    draws.within(150.0, 600.0)
                } else {
                    draws.within(60.0, 150.0)
                };
                let mass_kg = draws.within(0.0, 0.4);
                let critical = 2.0 * (stiffness * (0.157 + mass_kg)).sqrt();
                Some(Held { stiffness, damping: critical * draws.within(0.1, 1.0), mass_kg, drift: 0.0 })
            }
            Self::Light => Some(Held {
                stiffness: draws.within(50.0, 150.0),
                damping: draws.within(1.0, 4.0),
                mass_kg: draws.within(0.05, 0.5),
                drift: 0.0,
            }),
            Self::Firm | Self::Moving => Some(Held {
                stiffness: draws.within(250.0, 600.0),
                damping: draws.within(5.0, 20.0),
                mass_kg: draws.within(0.05, 0.5),
                drift: if self == Self::Moving { draws.within(0.0, 0.1) } else { 0.0 },
            }),
        }
    }
}

/// Hand as an impedance towards its target, with its own mass.
struct Held {
    stiffness: f64,
    damping: f64,
    mass_kg: f64,
    drift: f64,
}

struct Outcome {
    /// Time in s from the release to the first trip after it.
    tripped_after_s: Option<f64>,
    /// True if the force is present in the last 0.2 s.
    has_it: bool,
    yields: bool,
    /// Time in s from the first trip to the end of the intervention, if it ended.
    back_after_s: Option<f64>,
    /// Largest speed in m/s from 150 ms after the first trip on.
    later_speed: f64,
    /// Largest distance in m from the position at that time.
    displacement: f64,
    /// Drift in m of a free device under the uncompensated gravity in the whole time.
    drift: f64,
    withheld: bool,
}

/// Simulate a push along `N` axes on a hand that lets go for good, or is surprised and returns at once.
#[allow(clippy::too_many_lines)] // one simulated trial in order of time
fn trial<const N: usize>(
    device: Device,
    class: Class,
    controllers: Controllers,
    seed: u64,
    ticks: u32,
) -> Outcome {
    let mut draws = Draws(seed);
    // With more than three axes each has its own mass, as joints have.
    let share = |axis: usize| if N > 3 { 1.0 - 0.1 * axis as f64 } else { 1.0 };
    let model = DeviceModel::<N>::new(
        Axes::from_fn(|axis, _| device.mass_kg * share(axis)),
        Axes::repeat(device.viscous),
        Axes::repeat(device.coulomb),
    )
    .unwrap();
    let mass_error = draws.within(-0.2, 0.2);
    let mass_kg = Axes::<N>::from_fn(|axis, _| device.mass_kg * share(axis) / (1.0 + mass_error));
    let coulomb = device.coulomb * draws.within(0.5, 2.0);
    let push_n = draws.within(2.0, device.max_force_n);
    let along = Axes::<N>::from_fn(|_, _| draws.within(-1.0, 1.0)).normalize();
    let mut gravity = Axes::<N>::from_fn(|_, _| draws.within(-0.05, 0.05)) / (N as f64).sqrt();
    let stop_m = draws.within(0.015, 0.04);
    let mut held = class.hand(&mut draws);
    // A yielding hand takes energy, and more than delta trips WSC again whichever way the intervention ends. The push
    // is chosen so that F^2 / 2 K is half of delta.
    let push_n = match class {
        Class::Bearing => draws.within(2.0, 5.0),
        Class::Yielding => draws.within(1.0, 3.0),
        Class::Spring => push_n,
        _ => held.as_ref().map_or(push_n, |hand| push_n.min((0.03 * hand.stiffness).sqrt())),
    };
    // A hand that moves along the push takes power; 0.3 W trips WSC.
    if let Some(hand) = &mut held {
        hand.drift = hand.drift.min(0.2 / push_n);
    }
    if class == Class::Gravity {
        gravity = along * draws.within(0.05, 0.3) * if draws.within(-1.0, 1.0) > 0.0 { 1.0 } else { -1.0 };
    }
    let (slack_m, taut) = (draws.within(0.0, 0.03), draws.within(50.0, 300.0));
    let drift = Axes::<N>::from_fn(|_, _| draws.within(-1.0, 1.0)).normalize();
    let (tremor, tremor_hz) = (draws.within(2e-5, 2e-4), draws.within(8.0, 12.0));
    let quantum_m = 10.0_f64.powf(draws.within(-6.0, device.coarsest));
    let mut layer = SafetyLayer::<N>::new(&LayerSettings {
        device: model,
        period_s: PERIOD_S,
        estimator: EstimatorKind::default().with_quantum(quantum_m),
        safety: SafetySettings {
            controllers,
            hsc_force_threshold_n: 1.0,
            hsc_velocity_threshold: 0.05,
            hold_off_s: 0.1,
            release_ramp_s: 0.2,
            probe_force_n: device.probe_n,
            release_tries: 5,
            ..SafetySettings::default()
        },
        limiter: LimiterSettings { ramp_in_s: 0.3, ..LimiterSettings::default() },
    })
    .unwrap();
    let (mut x, mut v) = (Axes::<N>::zeros(), Axes::<N>::zeros());
    let mut target = Axes::<N>::zeros();
    let (mut tripped_at, mut back_at, mut later_speed, mut withheld) = (None, None, 0.0_f64, false);
    let (mut has_it, mut yields) = (true, false);
    let (mut origin, mut displacement, mut caught) = (Axes::<N>::zeros(), 0.0_f64, false);
    for tick in 0..RELEASED_AT + ticks {
        let time_s = f64::from(tick) * PERIOD_S;
        let sample = x.map(|at| (at / quantum_m).round() * quantum_m);
        let step = layer.tick(&sample, None, &(along * push_n));
        let intervention = step.intervention;
        // The force of PC is not an intervention.
        let is_on = intervention.tripped.bits() & !Tripped::of(ControllerKind::Pc).bits() != 0;
        match tripped_at {
            None if tick >= RELEASED_AT && is_on => tripped_at = Some(tick),
            Some(at) if !is_on => {
                back_at.get_or_insert(f64::from(tick - at) * PERIOD_S);
            }
            Some(at) if tick == at + CAUGHT_MS => origin = x,
            Some(at) if tick > at + CAUGHT_MS => {
                later_speed = later_speed.max(v.norm());
                displacement = displacement.max((x - origin).norm());
            }
            _ => {}
        }
        withheld |= intervention.withheld;
        yields |= intervention.yields;
        if tick + 200 >= RELEASED_AT + ticks {
            has_it &= !is_on && step.device_force.dot(&along) > 0.9 * push_n;
        }
        // The hand takes hold again 50 ms after it feels the jerk of the trip.
        let gone = tick >= RELEASED_AT && tripped_at.is_none_or(|at| tick < at + 50);
        let gone = gone && class != Class::Spring;
        let hand = held.as_ref().filter(|_| !gone);
        if hand.is_some() && tick >= RELEASED_AT && !caught {
            (target, caught) = (x, true);
        }
        let still = (Axes::<N>::zeros(), 0.0, 3000.0, 60.0);
        for _ in 0..SUBSTEPS {
            let dt = PERIOD_S / f64::from(SUBSTEPS);
            let (moves, hand_kg, stiffness, damping) = match hand {
                Some(hand) if caught => (drift * hand.drift, hand.mass_kg, hand.stiffness, hand.damping),
                _ => still,
            };
            target += moves * dt;
            let mut force = step.device_force + gravity;
            let holds = tick < RELEASED_AT || hand.is_some();
            if holds {
                let trembles = drift * (tremor * (std::f64::consts::TAU * tremor_hz * time_s).sin());
                force += (target + trembles - x) * stiffness + (moves - v) * damping;
            }
            let stretch = x.dot(&along) - slack_m;
            if class == Class::Cable && stretch > 0.0 && tick >= RELEASED_AT {
                force -= along * (taut * stretch);
            }
            let depth = x.dot(&along) - stop_m;
            if class == Class::Stop && depth > 0.0 {
                let normal = (3000.0 * depth + 5.0 * v.dot(&along)).max(0.0);
                force -= along * normal;
            }
            let total_kg = mass_kg.add_scalar(if holds { hand_kg } else { 0.0 });
            v += force.component_div(&total_kg) * dt;
            let direction = v.try_normalize(0.0).unwrap_or_else(Axes::zeros);
            let drag = direction.component_div(&total_kg) * (coulomb * dt);
            v = if drag.norm() < v.norm() { v - drag } else { Axes::zeros() };
            x += v * dt;
        }
    }
    Outcome {
        tripped_after_s: tripped_at.map(|at: u32| f64::from(at - RELEASED_AT) * PERIOD_S),
        has_it,
        yields,
        back_after_s: back_at,
        later_speed,
        displacement,
        drift: gravity.norm() / DAMPING * f64::from(ticks) * PERIOD_S,
        withheld,
    }
}

/// Return Wilson's interval at 95 %.
///
/// Source: Wilson 1927, "Probable inference, the law of succession, and statistical inference".
fn interval(hits: u32, trials: u32) -> (f64, f64) {
    let (n, z) = (f64::from(trials), 1.96_f64);
    let share = f64::from(hits) / n;
    let middle = (share + z * z / (2.0 * n)) / (1.0 + z * z / n);
    let half = z * (share * (1.0 - share) / n + z * z / (4.0 * n * n)).sqrt() / (1.0 + z * z / n);
    ((middle - half).max(0.0), (middle + half).min(1.0))
}

/// Return the number of trials per class; the environment variable `PROBE_TRIALS` overrides it.
fn trials() -> u32 {
    std::env::var("PROBE_TRIALS").ok().and_then(|count| count.parse().ok()).unwrap_or(100)
}

fn nobody_is_thrown_again<const N: usize>(device: Device, class: Class) {
    let (mut again, mut fastest, mut furthest) = (0, 0.0_f64, 0.0_f64);
    for seed in 0..trials() {
        let outcome = trial::<N>(device, class, [ControllerKind::Wsc].into(), u64::from(seed), 7000);
        again += u32::from(outcome.back_after_s.is_some());
        fastest = fastest.max(outcome.later_speed);
        furthest = furthest.max(outcome.displacement - outcome.drift);
        assert!(outcome.withheld || outcome.back_after_s.is_some(), "{class:?} {seed}: it is not given up");
    }
    println!(
        "{class:?}, {N} axes, A {} N: {again} of {} given force, at most {:.4}; speed {fastest:.3} m/s, way {furthest:.4} m",
        device.probe_n,
        trials(),
        interval(again, trials()).1
    );
    assert_eq!(again, 0, "{class:?}: force without a hand");
    assert!(fastest < 0.1 && furthest < 0.02, "{class:?}: {fastest} m/s, {furthest} m");
}

#[test]
fn nothing_returns_without_a_hand() {
    for device in [DESKTOP, OMNI] {
        nobody_is_thrown_again::<1>(device, Class::Free);
        nobody_is_thrown_again::<3>(device, Class::Free);
        nobody_is_thrown_again::<1>(device, Class::Stop);
        nobody_is_thrown_again::<3>(device, Class::Stop);
    }
    nobody_is_thrown_again::<6>(DESKTOP, Class::Free);
}

#[test]
fn hand_gets_its_force_back() {
    for (device, class, within_ms, share) in [
        (DESKTOP, Class::Light, 600, 0.98),
        (DESKTOP, Class::Light, 1700, 0.99),
        (DESKTOP, Class::Firm, 600, 0.99),
        (DESKTOP, Class::Moving, 600, 0.9),
        (DESKTOP, Class::Moving, 2500, 0.95),
        (OMNI, Class::Moving, 600, 0.85),
    ] {
        let within_s = f64::from(within_ms) * PERIOD_S;
        let mut late = 0;
        for seed in 0..trials() {
            let back =
                trial::<1>(device, class, [ControllerKind::Wsc].into(), u64::from(seed), within_ms + 300)
                    .back_after_s;
            late += u32::from(back.is_none_or(|after_s| after_s > within_s));
        }
        let (least, most) = interval(late, trials());
        println!(
            "{class:?}, A {} N: {late} of {} not within {within_s} s, {least:.4} to {most:.4}",
            device.probe_n,
            trials()
        );
        assert!(least <= 1.0 - share, "{class:?}: {late} late");
    }
}

/// Iterate over every union of the cancelling controllers, each also with PC.
fn unions() -> impl Iterator<Item = Controllers> {
    ControllerKind::cancelling()
        .fold(vec![Controllers::NONE], |sets, kind| {
            sets.iter().flat_map(|set| [*set, set.with(kind, true)]).collect()
        })
        .into_iter()
        .filter(|set| *set != Controllers::NONE)
        .flat_map(|set| [set, set.with(ControllerKind::Pc, true)])
}

/// Return how many trials trip within 0.2 s of the release, and how many of these have the force 2.5 s later.
fn returned(class: Class, controllers: Controllers, trials: u32) -> (u32, u32) {
    let (mut tripped, mut returned, mut fastest, mut yielding) = (0, 0, 0.0_f64, 0);
    for seed in 0..trials {
        let outcome = trial::<1>(DESKTOP, class, controllers, u64::from(seed), 2900);
        if outcome.tripped_after_s.is_some_and(|after_s| after_s < 0.2) {
            tripped += 1;
            returned += u32::from(outcome.has_it);
            fastest = fastest.max(outcome.later_speed);
            yielding += u32::from(outcome.yields);
        }
    }
    println!(
        "{class:?} {controllers:?}: {returned} of {tripped} have the force, {yielding} yield, {fastest:.3} m/s"
    );
    (tripped, returned)
}

#[test]
fn bearing_hand_gets_its_force_back_from_any_controllers() {
    for class in [Class::Bearing, Class::Yielding] {
        for controllers in unions() {
            let (of, has_it) = returned(class, controllers, trials() / 5);
            assert!(
                interval(of - has_it, of.max(1)).0 <= 0.05,
                "{class:?} {controllers:?}: {has_it} of {of}"
            );
        }
    }
}

/// A probe may take a spring, a cable or gravity for a hand, since they act on the device.
///
/// Gravity bears no more as the force returns, and a spring below `mu / HALF_S` = 50 N/m yields too far. A stiffer
/// spring and a taut cable bear a push as a hand does.
#[test]
fn objects_that_bear_no_push_get_no_force() {
    for (class, most) in
        [(Class::Free, 0.0), (Class::Gravity, 0.0), (Class::Cable, 0.15), (Class::Spring, 0.15)]
    {
        for controllers in unions() {
            let (of, has_it) = returned(class, controllers, trials() / 5);
            // Rounding may leave the lower end of the interval just above 0.
            assert!(
                interval(has_it, of.max(1)).0 <= most + 1e-9,
                "{class:?} {controllers:?}: {has_it} of {of}"
            );
        }
    }
}
