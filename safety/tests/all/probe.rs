//! After a trip the force comes back to a hand and to nothing else: trials over devices, models that are wrong, and hands.
#![allow(clippy::unwrap_used)] // a test may

use haptether_safety::{
    Axes, DeviceModel, LayerSettings, LimiterSettings, SafetyLayer,
    controller::{ControllerKind, Controllers, SafetySettings, Tripped},
    estimator::EstimatorKind,
};

const PERIOD_S: f64 = 1e-3;
const SUBSTEPS: u32 = 4;
const RELEASED_AT: u32 = 400;
/// What the resolved default of a scene is at this damping: a free device stays below 0.1 m/s.
const PROBE_N: f64 = 0.6;
/// A device and the probe that it has by default.
#[derive(Clone, Copy, Debug)]
struct Device {
    mass_kg: f64,
    viscous: f64,
    coulomb: f64,
    max_force_n: f64,
    probe_n: f64,
    /// Of the encoders that are drawn, in powers of ten of m: what damps a light device must not lag.
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
/// Friction hides a probe, so that it is only listened to.
const OMNI: Device =
    Device { mass_kg: 0.045, viscous: 0.0, coulomb: 0.26, max_force_n: 3.3, probe_n: 0.0, coarsest: -4.26 };
/// The first throw is over by then.
const CAUGHT_MS: u32 = 150;
const DAMPING: f64 = 5.0;

/// `SplitMix64`, in [low, high).
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

/// What the device meets after the release.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Class {
    Free,
    /// A stop 15 to 40 mm away, in the direction of the push.
    Stop,
    Light,
    Firm,
    /// A firm hand whose target drifts.
    Moving,
    /// 150 to 600 N/m under 2 to 5 N.
    Bearing,
    /// 60 to 150 N/m under 1 to 3 N.
    Yielding,
    /// A spring of 5 to 45 N/m under 2 to 7.9 N.
    Spring,
    /// A cable of 50 to 300 N/m that gets taut 0 to 30 mm away, against the push.
    Cable,
    /// 0.05 to 0.3 N of gravity, either way, that nothing holds.
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

/// A hand: an impedance towards its target, with a mass of its own.
struct Held {
    stiffness: f64,
    damping: f64,
    mass_kg: f64,
    drift: f64,
}

struct Outcome {
    /// From the release to the first trip after it, in s.
    tripped_after_s: Option<f64>,
    /// Whether the force is back in the last 0.2 s.
    has_it: bool,
    yields: bool,
    /// From the first trip to the end of the intervention, if it ended, in s.
    back_after_s: Option<f64>,
    /// Largest speed in m/s from 150 ms after the first trip on.
    later_speed: f64,
    /// From where the device was then, in m.
    displacement: f64,
    /// What gravity that is left over does to a free device in that time, in m.
    drift: f64,
    withheld: bool,
}

/// A push of `N` axes on a hand that lets go, or is surprised and comes back at once.
#[allow(clippy::too_many_lines)] // one simulated trial, in the order of time
fn trial<const N: usize>(
    device: Device,
    class: Class,
    controllers: Controllers,
    seed: u64,
    ticks: u32,
) -> Outcome {
    let mut draws = Draws(seed);
    // Of more than three axes each has a mass of its own, as joints do.
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
    // What yields takes energy, and more than delta of it trips WSC again, whatever ends an intervention: F^2 / 2 K is half
    // of it here.
    let push_n = match class {
        Class::Bearing => draws.within(2.0, 5.0),
        Class::Yielding => draws.within(1.0, 3.0),
        Class::Spring => push_n,
        _ => held.as_ref().map_or(push_n, |hand| push_n.min((0.03 * hand.stiffness).sqrt())),
    };
    // And one that moves along the push takes power: 0.3 W of it trips WSC.
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
        // The force of PC is no intervention.
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
        // The hand takes hold again as it feels the jerk of the trip, 50 ms later.
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

/// Wilson's interval at 95 %.
///
/// Source: Wilson 1927, "Probable inference, the law of succession, and statistical inference".
fn interval(hits: u32, trials: u32) -> (f64, f64) {
    let (n, z) = (f64::from(trials), 1.96_f64);
    let share = f64::from(hits) / n;
    let middle = (share + z * z / (2.0 * n)) / (1.0 + z * z / n);
    let half = z * (share * (1.0 - share) / n + z * z / (4.0 * n * n)).sqrt() / (1.0 + z * z / n);
    ((middle - half).max(0.0), (middle + half).min(1.0))
}

/// How many trials of each class; `PROBE_TRIALS` asks for more.
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
fn without_a_hand_nothing_comes_back() {
    for device in [DESKTOP, OMNI] {
        nobody_is_thrown_again::<1>(device, Class::Free);
        nobody_is_thrown_again::<3>(device, Class::Free);
        nobody_is_thrown_again::<1>(device, Class::Stop);
        nobody_is_thrown_again::<3>(device, Class::Stop);
    }
    nobody_is_thrown_again::<6>(DESKTOP, Class::Free);
}

#[test]
fn a_hand_has_its_force_again() {
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

/// Every union of those that cancel, and each with PC.
fn unions() -> impl Iterator<Item = Controllers> {
    ControllerKind::cancelling()
        .fold(vec![Controllers::NONE], |sets, kind| {
            sets.iter().flat_map(|set| [*set, set.with(kind, true)]).collect()
        })
        .into_iter()
        .filter(|set| *set != Controllers::NONE)
        .flat_map(|set| [set, set.with(ControllerKind::Pc, true)])
}

/// Of the trials that trip within 0.2 s of the release: how many, and how many have the force 2.5 s later.
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
fn whoever_watches_a_hand_that_bears_the_push_has_its_force_again() {
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

/// A probe may feel them as a hand, for they act on the device, but gravity bears nothing more as the force comes back, and a
/// spring of less than `mu / HALF_S` = 50 N/m yields too far. A stiffer one and a cable that is taut bear a push as a hand does.
#[test]
fn what_acts_on_the_device_but_bears_no_push_gets_none() {
    for (class, most) in
        [(Class::Free, 0.0), (Class::Gravity, 0.0), (Class::Cable, 0.15), (Class::Spring, 0.15)]
    {
        for controllers in unions() {
            let (of, has_it) = returned(class, controllers, trials() / 5);
            // The interval ends at 0 but for rounding.
            assert!(
                interval(has_it, of.max(1)).0 <= most + 1e-9,
                "{class:?} {controllers:?}: {has_it} of {of}"
            );
        }
    }
}
