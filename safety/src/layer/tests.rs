//! Test of the complete layer: a hand that holds, releases and returns, a late loop, invalid values.

use super::*;
use crate::controller::Tripped;

const PERIOD: f64 = 1e-3;
const MASS: f64 = 0.157;

fn settings(safety: SafetySettings) -> LayerSettings<1> {
    LayerSettings {
        device: DeviceModel::uniform(MASS, 0.0, 0.0).unwrap(),
        period_s: PERIOD,
        estimator: EstimatorKind::default(),
        safety,
        limiter: LimiterSettings { ramp_in_s: 0.0, ..LimiterSettings::default() },
    }
}

/// Return per tick whether HSC trips: a free mass with an encoder, under the layer's force and `F_v` = 5 N from the
/// start.
fn ejected_trips(force_seen_by_eq_4: impl Fn(f64) -> f64) -> Vec<bool> {
    let safety = SafetySettings { controllers: [ControllerKind::Hsc].into(), ..SafetySettings::default() };
    let settings = settings(safety);
    let mut controller = SafetyController::<1>::new(&settings.device, PERIOD, &safety).unwrap();
    let mut estimator = settings.estimator.build::<1>(PERIOD).unwrap();
    let mut kernel_of_rendered = estimator.clone();
    let (mut x, mut v) = (0.0_f64, 0.0);
    let (mut commanded, rendered) = (None, Axes::<1>::new(5.0));
    let mut trips = Vec::new();
    for _ in 0..200 {
        let encoded = Axes::<1>::new((x / 2.3e-5).round() * 2.3e-5);
        // The pipeline of the layer, with another force subtracted in Eq. 4.
        let motion = estimator.step(&encoded);
        kernel_of_rendered.step(&encoded);
        let of_eq_4 = commanded.map_or(0.0, &force_seen_by_eq_4);
        let aligned = estimator.align(&Axes::<1>::new(of_eq_4));
        let grasp_force = settings.device.grasp_force(&motion, &aligned);
        let mut seen = Observation::exact(motion.velocity, rendered, grasp_force);
        seen.aligned_rendered_force =
            kernel_of_rendered.align(&commanded.map_or(Axes::zeros(), |_| rendered));
        let step = controller.step(&seen).unwrap();
        trips.push(step.tripped.any());
        let force = 5.0 + step.safety_force[0];
        commanded = Some(force);
        x += v * PERIOD + force / MASS * PERIOD * PERIOD / 2.0;
        v += force / MASS * PERIOD;
    }
    trips
}

#[test]
fn hsc_needs_the_complete_commanded_force() {
    let all_commanded = ejected_trips(|commanded| commanded);
    let rendered_only = ejected_trips(|_| 5.0);
    let on = |trips: &[bool]| trips[50..].iter().filter(|&&on| on).count();
    assert_eq!(on(&all_commanded), 150, "HSC stays on without a hand");
    // The damping of HSC cancels F_v; with F_v alone in Eq. 4, this looks like a hand that pushes back with 5 N.
    assert!(on(&rendered_only) < 100, "{}", on(&rendered_only));
}

/// Count the ticks with a trip of HSC while a braced hand (1500 N/m, 20 N s/m) meets a wall of 200 N/m and keeps
/// holding.
fn trips_at_contact(measures_velocity: bool) -> usize {
    let safety = SafetySettings {
        controllers: [ControllerKind::Hsc].into(),
        hsc_force_threshold_n: 0.5,
        ..SafetySettings::default()
    };
    let mut layer = SafetyLayer::new(&settings(safety)).unwrap();
    let (speed, mut x) = (0.15, 0.01_f64);
    let (mut v, mut force, mut trips) = (-speed, 0.0, 0);
    for n in 0..1500 {
        let seen = if measures_velocity { x } else { (x / 2.3e-5).round() * 2.3e-5 };
        let rendered = Axes::<1>::new((-200.0 * seen).max(0.0));
        let velocity = Axes::<1>::new(v);
        let tick = layer.tick(&Axes::<1>::new(seen), measures_velocity.then_some(&velocity), &rendered);
        trips += usize::from(tick.intervention.tripped.any());
        force = tick.device_force[0];
        // Ten steps per tick, since the hand is not part of the servo loop.
        for step in 0..10 {
            let target = 0.01 - speed * (f64::from(n) + f64::from(step) / 10.0) * PERIOD;
            let hand = 1500.0 * (target.max(-0.03) - x) - 20.0 * v;
            v += (force + hand) / MASS * PERIOD / 10.0;
            x += v * PERIOD / 10.0;
        }
    }
    assert!(force > 2.0, "the wall was met");
    trips
}

#[test]
fn lagging_estimate_is_not_a_release() {
    // With exact signals the hand is always seen. Estimated signals must show it too, although they lag by 8 ms.
    assert_eq!((trips_at_contact(true), trips_at_contact(false)), (0, 0));
}

/// Nothing trips while a hand keeps holding: not at a step of the remote force, beyond the cap, or during the
/// ramp-in.
#[test]
fn limited_force_is_not_a_release() {
    let safety = SafetySettings { controllers: [ControllerKind::Hsc].into(), ..SafetySettings::default() };
    let limiter = LimiterSettings { max_force_n: 4.0, ramp_in_s: 0.05, ..LimiterSettings::default() };
    let mut layer = SafetyLayer::new(&LayerSettings { limiter, ..settings(safety) }).unwrap();
    let still = Axes::<1>::zeros();
    for n in 0..300 {
        let requested = Axes::<1>::new(if n < 100 { 1.0 } else { 30.0 });
        let tick = layer.tick(&still, Some(&still), &requested);
        assert!(
            !tick.intervention.tripped.any(),
            "tick {n}: S_h = {}",
            tick.intervention.observed[ControllerKind::Hsc]
        );
        assert!(n < 105 || (tick.device_force[0] - 4.0).abs() < 1e-12);
    }
}

/// Under a constant 4 N, a hand holds, releases for 50 ms, and returns for good.
#[test]
fn returning_hand_gets_its_force_back_over_the_ramp() {
    let safety = SafetySettings {
        controllers: [ControllerKind::Hsc].into(),
        hsc_force_threshold_n: 0.5,
        hold_off_s: 0.1,
        release_ramp_s: 0.2,
        ..SafetySettings::default()
    };
    let mut layer = SafetyLayer::new(&settings(safety)).unwrap();
    let rendered = Axes::<1>::new(4.0);
    let (mut x, mut v, mut largest_step, mut last) = (0.0, 0.0, 0.0_f64, 0.0);
    let mut states = Vec::new();
    for n in 0..1500 {
        let (at, moving) = (Axes::<1>::new(x), Axes::<1>::new(v));
        let tick = layer.tick(&at, Some(&moving), &rendered);
        let force = tick.device_force[0];
        if n > 10 {
            largest_step = largest_step.max(force - last);
        }
        last = force;
        states.push((tick.intervention.tripped, force));
        for _ in 0..10 {
            let hand = if (500..550).contains(&n) { 0.0 } else { -400.0 * x - 15.0 * v };
            v += (force + hand) / MASS * PERIOD / 10.0;
            x += v * PERIOD / 10.0;
        }
    }
    assert!(
        !states[499].0.any() && (states[499].1 - 4.0).abs() < 1e-9,
        "held: the complete force is rendered"
    );
    assert!(
        states[500..550].iter().any(|(tripped, _)| tripped.contains(Tripped::of(ControllerKind::Hsc))),
        "released: HSC trips"
    );
    assert!(
        !states[1499].0.any() && (states[1499].1 - 4.0).abs() < 1e-9,
        "returned: the complete force again"
    );
    assert!(largest_step < 0.3, "the force returns over the ramp, not as a step: {largest_step} N");
}

#[test]
fn late_loop_does_not_read_several_ticks_as_one() {
    // 0.3 m/s without force; ticks 100 to 107 are missed.
    let safety = SafetySettings { controllers: [ControllerKind::Wsc].into(), ..SafetySettings::default() };
    let sample = |n: i32| Axes::<1>::new((3e-4 * f64::from(n) / 2.3e-5).round() * 2.3e-5);
    // Unbounded, since the guard would detect the gap.
    let mut carried = SafetyLayer::new(&settings(safety)).unwrap().with_samples(SampleBounds::UNBOUNDED);
    let mut blind = carried.clone();
    let none = Axes::zeros();
    for n in 0..100 {
        carried.tick(&sample(n), None, &none);
        blind.tick(&sample(n), None, &none);
    }
    let worst = |layer: &mut SafetyLayer<1>, missed: u64| {
        let late = layer.tick_after(missed, &sample(108), None, &none, 1.0).grasp_force[0].abs();
        (109..130).map(|n| layer.tick(&sample(n), None, &none).grasp_force[0].abs()).fold(late, f64::max)
    };
    assert!(worst(&mut carried, 8) < 0.5);
    assert!(worst(&mut blind, 0) > 5.0, "the missed ticks must matter, or the test shows nothing");
}

/// After a stop is accepted, estimator and forces equal those of a layer that accepted each sample at once, bit for
/// bit.
#[test]
fn accepted_stop_leaves_no_trace_of_the_held_ticks() {
    let safety = SafetySettings { controllers: [ControllerKind::Hsc].into(), ..SafetySettings::default() };
    for estimator in [
        EstimatorKind::default(),
        EstimatorKind::LowPass { cutoff_hz: 30.0 },
        EstimatorKind::SavitzkyGolay { degree: 2, window: 15 },
    ] {
        let settings = LayerSettings { estimator, ..settings(safety) };
        let mut held = SafetyLayer::new(&settings).unwrap();
        let mut direct = held.clone().with_samples(SampleBounds::UNBOUNDED);
        for n in 0..200 {
            let x = Axes::<1>::new(2e-3 * f64::from(n.min(100)));
            let rendered = Axes::<1>::new(0.05 * (f64::from(n) * 0.1).sin());
            let (one, other) = (held.tick(&x, None, &rendered), direct.tick(&x, None, &rendered));
            assert_eq!(one.device_force, other.device_force, "{n}: F_v continues");
            if (101..104).contains(&n) {
                assert!(one.motion.velocity[0] > 1.9, "V stays");
            } else {
                let seen = |tick: &SafetyTick<1>| (tick.motion, tick.grasp_force);
                assert_eq!(seen(&one), seen(&other), "{estimator:?} {n}");
            }
        }
        assert_eq!(held.guard().outliers(), 0);
    }
}

/// While samples are held, the damping of the last tick remains beside a changing `F_v`: `F_c = d - g F_v` with
/// `d = F_c + g F_v` of the last tick. It fades with the authority and does not grow again.
#[test]
fn damping_of_held_ticks_fades_with_the_authority() {
    let safety = SafetySettings { controllers: [ControllerKind::Vfc].into(), ..SafetySettings::default() };
    let mut layer = SafetyLayer::new(&settings(safety)).unwrap();
    let mut tick = |n: u32, outlier: f64, push: f64, authority| {
        let x = Axes::<1>::new(3e-4 * f64::from(n) + outlier);
        layer.tick_with_authority(&x, None, &Axes::<1>::new(push), authority)
    };
    for n in 0..200 {
        tick(n, 0.0, 3.0, 1.0);
    }
    let before = tick(200, 0.0, 3.0, 1.0);
    assert!(before.intervention.tripped.any());
    // VFC lets nothing of F_v through, so g = 1.
    let damping = (before.intervention.safety_force + before.rendered_force)[0];
    assert!(damping < -0.1, "{damping}");
    for (n, push, authority, share) in [(201, 2.5, 0.5, 0.5), (202, 1.0, 0.8, 0.5), (203, 2.0, 0.4, 0.4)] {
        let held = tick(n, 0.02, push, authority);
        assert_eq!(held.rendered_force[0], push, "F_v continues");
        assert_eq!(held.motion, before.motion, "held");
        let expected = damping * share;
        assert!(
            (held.device_force[0] - expected).abs() < 1e-12,
            "{n}: {} instead of {expected}",
            held.device_force
        );
        assert!((held.intervention.safety_force[0] - (expected - push)).abs() < 1e-12, "{n}");
    }
}

/// A step within the bound causes no velocity, before and after it is accepted.
#[test]
fn step_causes_no_velocity() {
    let mut layer = SafetyLayer::new(&settings(SafetySettings::default())).unwrap();
    for n in 0..200 {
        let x = 3e-4 * f64::from(n) + if n < 100 { 0.0 } else { 0.015 };
        let tick = layer.tick(&Axes::<1>::new(x), None, &Axes::zeros());
        assert!(n < 90 || (tick.motion.velocity[0] - 0.3).abs() < 1e-3, "{n}: {}", tick.motion.velocity);
        assert_eq!(tick.fault, None);
    }
}

#[test]
fn invalid_values_stop_the_layer_in_the_same_tick() {
    let good = Axes::<1>::new(0.0);
    for (x, v, f, name) in [
        (f64::NAN, 0.0, 0.0, "position is not a finite number"),
        (2e3, 0.0, 0.0, "position exceeds 1000 m"),
        (0.0, f64::INFINITY, 0.0, "velocity is not a finite number"),
        (0.0, 0.0, f64::NAN, "rendered force is not a finite number"),
        (0.0, 0.0, -2e4, "rendered force exceeds 10000 N"),
    ] {
        let mut layer = SafetyLayer::new(&settings(SafetySettings::default())).unwrap();
        let push = Axes::<1>::new(1.0);
        for _ in 0..5 {
            layer.tick(&good, Some(&good), &push);
        }
        assert!(layer.tick(&good, Some(&good), &push).device_force[0] > 0.9);
        let (x, v, f) = (Axes::<1>::new(x), Axes::<1>::new(v), Axes::<1>::new(f));
        for _ in 0..3 {
            let tick = layer.tick(&x, Some(&v), &f);
            assert_eq!(tick.device_force[0], 0.0);
            assert_eq!(tick.fault.unwrap().to_string(), name);
        }
        assert!(layer.tick(&good, Some(&good), &push).fault.is_some(), "latched");
        layer.reset(&good).unwrap();
        assert!(layer.tick(&good, Some(&good), &push).fault.is_none());
    }
}

#[test]
fn rendered_force_passes_without_a_controller() {
    let mut layer = SafetyLayer::new(&settings(SafetySettings::default())).unwrap();
    let still = Axes::<1>::zeros();
    for n in 0..10 {
        let tick = layer.tick(&still, Some(&still), &Axes::<1>::new(0.3 * f64::from(n)));
        assert!((tick.device_force[0] - 0.3 * f64::from(n)).abs() < 1e-12);
        assert!(!tick.intervention.tripped.any());
    }
}

/// The owed energy is the part of PC's request that the force beyond `F_v` does not dissipate within the tick.
#[test]
fn owed_energy_follows_from_the_commanded_force() {
    let safety = SafetySettings { controllers: [ControllerKind::Pc].into(), ..SafetySettings::default() };
    for max_force_n in [1.0, 1.6, 50.0] {
        let limiter = LimiterSettings { max_force_n, ramp_in_s: 0.0, ..LimiterSettings::default() };
        let mut layer = SafetyLayer::new(&LayerSettings { limiter, ..settings(safety) }).unwrap();
        let mut owed = 0;
        for n in 0..200 {
            let v = Axes::<1>::new(0.3 * (f64::from(n) * 0.05).sin());
            let rendered = Axes::<1>::new(0.2 * f64::from(n % 10));
            let tick = layer.tick(&Axes::zeros(), Some(&v), &rendered);
            let beyond = tick.device_force[0] - tick.rendered_force[0];
            let dissipated = (-beyond * tick.motion.velocity[0] * PERIOD).max(0.0);
            let expected = (-tick.intervention.observed[ControllerKind::Pc] - dissipated).max(0.0);
            assert!((tick.owed_energy_j - expected).abs() < 1e-15, "{n}: {tick:?} {expected}");
            owed += u32::from(expected > 0.0);
        }
        assert!(owed > 20, "{owed}");
    }
}

/// Create a layer with an encoder and a past: motion, energy, an intervention, a force.
fn with_a_past() -> SafetyLayer<1> {
    let safety = SafetySettings {
        controllers: [ControllerKind::Hsc, ControllerKind::Wsc, ControllerKind::Pc].into(),
        ..SafetySettings::default()
    };
    let mut layer = SafetyLayer::new(&settings(safety)).unwrap();
    for n in 0..300 {
        let x = 0.05 * (f64::from(n) * 0.02).sin();
        layer.tick(&Axes::<1>::new(x), None, &Axes::<1>::new(3.0));
    }
    layer
}

/// Run 50 more ticks, starting at position `from`.
fn next(layer: &mut SafetyLayer<1>, from: f64) -> Vec<SafetyTick<1>> {
    let tick = |n: i32| {
        let x = Axes::<1>::new(from + 1e-4 * f64::from(n));
        layer.tick(&x, None, &Axes::<1>::new(0.1 * f64::from(n)))
    };
    (0..50).map(tick).collect()
}

fn forces(ticks: &[SafetyTick<1>]) -> Vec<(f64, f64, Option<Fault>)> {
    ticks.iter().map(|tick| (tick.device_force[0], tick.motion.velocity[0], tick.fault)).collect()
}

#[test]
fn reset_clears_the_past_and_restart_keeps_a_fault() {
    let place = Axes::<1>::new(0.2);
    let mut fresh = SafetyLayer::new(&settings(SafetySettings {
        controllers: [ControllerKind::Hsc, ControllerKind::Wsc, ControllerKind::Pc].into(),
        ..SafetySettings::default()
    }))
    .unwrap();
    fresh.reset(&place).unwrap();
    let as_new = forces(&next(&mut fresh, 0.2));
    assert_ne!(forces(&next(&mut with_a_past(), 0.2)), as_new, "the past must matter");
    let mut layer = with_a_past();
    layer.reset(&place).unwrap();
    assert_eq!(forces(&next(&mut layer, 0.2)), as_new);
    let mut layer = with_a_past();
    layer.restart(&place).unwrap();
    assert_eq!(forces(&next(&mut layer, 0.2)), as_new);

    let (first, second) = (Fault::Device, Fault::NotFinite(Signal::Position));
    let mut layer = with_a_past();
    layer.fail(first);
    layer.fail(second);
    let stopped = next(&mut layer, 0.2);
    assert!(stopped.iter().all(|tick| tick.fault == Some(first) && tick.device_force[0] == 0.0));
    layer.restart(&place).unwrap();
    assert!(next(&mut layer, 0.2).iter().all(|tick| tick.fault == Some(first)), "restart keeps the fault");
    assert!(layer.restart(&Axes::<1>::new(f64::NAN)).is_err());
    assert!(layer.reset(&Axes::<1>::new(f64::INFINITY)).is_err());
    layer.reset(&place).unwrap();
    assert_eq!(forces(&next(&mut layer, 0.2)), as_new);
}

/// VFC as a researcher would write it (Eq. 1 and 2); it fails at tick `fails_at`.
struct VelocityForceByHand {
    settings: SafetySettings,
    fails_at: Option<u64>,
    gives: f64,
    tick: u64,
}

impl ResearchController for VelocityForceByHand {
    fn step(&mut self, seen: &crate::controller::ResearchObservation<'_>, safety_force: &mut [f64]) -> bool {
        self.tick += 1;
        let (v, f) = (seen.velocity[0], seen.rendered_force[0]);
        let SafetySettings { velocity_threshold, vfc_force_threshold_n, damping, .. } = self.settings;
        if v * f / (velocity_threshold * vfc_force_threshold_n) > 1.0 {
            safety_force[0] = (-f - v * damping) * self.gives;
        }
        self.fails_at != Some(self.tick)
    }

    fn reset(&mut self) {
        self.tick = 0;
    }

    fn boxed_clone(&self) -> Box<dyn ResearchController> {
        Box::new(Self { ..*self })
    }
}

fn by_hand(settings: SafetySettings, fails_at: Option<u64>, gives: f64) -> Box<dyn ResearchController> {
    Box::new(VelocityForceByHand { settings, fails_at, gives, tick: 0 })
}

/// Run 400 ticks with 3 N and without a hand; return force and trips of each tick.
fn thrown(mut layer: SafetyLayer<1>) -> Vec<(f64, Tripped)> {
    let (mut x, mut v) = (0.0_f64, 0.0);
    let mut ticks = Vec::new();
    for n in 0..400 {
        let rendered = Axes::<1>::new(if n < 50 { 0.0 } else { 3.0 });
        let tick = layer.tick(&Axes::<1>::new((x / 2.3e-5).round() * 2.3e-5), None, &rendered);
        let force = tick.device_force[0];
        ticks.push((force, tick.intervention.tripped));
        x += v * PERIOD + force / MASS * PERIOD * PERIOD / 2.0;
        v += force / MASS * PERIOD;
    }
    ticks
}

#[test]
fn research_controller_matches_the_registered_one() {
    let vfc = SafetySettings { controllers: [ControllerKind::Vfc].into(), ..SafetySettings::default() };
    let nobody = SafetySettings { controllers: crate::controller::Controllers::NONE, ..vfc };
    let bare = || SafetyLayer::new(&settings(nobody)).unwrap();
    let shipped = thrown(SafetyLayer::new(&settings(vfc)).unwrap());
    let written = thrown(bare().with_research(by_hand(vfc, None, 1.0)));
    assert!(shipped.iter().any(|(_, tripped)| tripped.any()));
    for (tick, ((a, by), (b, of))) in shipped.iter().zip(&written).enumerate() {
        assert_eq!(a.to_bits(), b.to_bits(), "{tick}");
        assert_eq!(by.any(), *of == Tripped::RESEARCH, "{tick}");
    }
}

#[test]
fn failing_research_controller_renders_no_force() {
    let vfc = SafetySettings { controllers: [ControllerKind::Vfc].into(), ..SafetySettings::default() };
    let nobody = SafetySettings { controllers: crate::controller::Controllers::NONE, ..vfc };
    let bare = || SafetyLayer::new(&settings(nobody)).unwrap();
    for (fails_at, gives) in [(Some(60), 1.0), (None, f64::NAN), (None, f64::INFINITY), (None, 1e9)] {
        let ticks = thrown(bare().with_research(by_hand(vfc, fails_at, gives)));
        let first = ticks.iter().position(|(_, tripped)| tripped.any()).unwrap();
        assert!(fails_at.is_none_or(|tick| first as u64 + 1 == tick), "{first}");
        assert_eq!(ticks[first].0, 0.0, "{fails_at:?}, {gives}");
    }
}

/// A research controller runs after the others: an intervention leaves it a share as for PC, a reset reaches it, and
/// lanes have none.
#[test]
fn research_controller_runs_after_the_others() {
    let vfc = SafetySettings { controllers: [ControllerKind::Vfc].into(), ..SafetySettings::default() };
    let layer = || SafetyLayer::new(&settings(vfc)).unwrap();
    let alone = thrown(layer());
    let both = thrown(layer().with_research(by_hand(vfc, None, 1.0)));
    // Whenever it requests a force, an intervention of VFC is on and leaves it no share.
    for (tick, (a, b)) in alone.iter().zip(&both).enumerate() {
        assert_eq!((a.0.to_bits(), a.1), (b.0.to_bits(), b.1), "{tick}");
    }
    let mut reset = layer().with_research(by_hand(vfc, Some(1), 1.0));
    for _ in 0..2 {
        let tick = reset.tick(&Axes::zeros(), None, &Axes::<1>::new(1.0));
        assert_eq!(tick.intervention.tripped, Tripped::RESEARCH, "the first tick fails");
        assert_eq!(tick.device_force[0], 0.0);
        reset.reset(&Axes::zeros()).unwrap();
    }
    let of = layer().with_research(by_hand(vfc, None, 1.0));
    assert!(SafetyLayer::<1, simba::simd::AutoF64x4>::gather(&[&of; 4]).is_none());
}

/// Research controller with a share of `-F_v`, a push and damping.
struct Linear {
    cancels: f64,
    push: f64,
    damping: f64,
}

impl ResearchController for Linear {
    fn step(&mut self, seen: &crate::controller::ResearchObservation<'_>, safety_force: &mut [f64]) -> bool {
        safety_force[0] =
            -self.cancels * seen.rendered_force[0] + self.push - self.damping * seen.velocity[0];
        true
    }

    fn reset(&mut self) {}

    fn boxed_clone(&self) -> Box<dyn ResearchController> {
        Box::new(Self { ..*self })
    }
}

/// As for the registered controllers, cancelling a force needs no authority, and pushing does.
#[test]
fn research_controller_may_cancel_without_authority() {
    let nobody = SafetySettings::default();
    let rendered = 2.0;
    for (cancels, push, authority, device_force) in [
        (1.0, 0.0, 1.0, 0.0),
        (1.0, 0.0, 0.5, 0.0),
        (1.0, 0.0, 0.0, 0.0),
        (0.5, 0.0, 0.25, 1.0),
        // Beyond -F_v it pushes the other way: 1 N, scaled by the authority.
        (1.5, 0.0, 0.5, -0.5),
        (0.0, 1.0, 0.25, 2.25),
        // The push of 1 N takes back a part of the cancelling force, which then cancels 1 N of 2 N.
        (1.0, 1.0, 0.0, 1.0),
    ] {
        let controller = Box::new(Linear { cancels, push, damping: 0.0 });
        let mut layer = SafetyLayer::new(&settings(nobody)).unwrap().with_research(controller);
        // 20 ticks, so that the force has grown.
        let mut tick =
            || layer.tick_with_authority(&Axes::zeros(), None, &Axes::<1>::new(rendered), authority);
        let force = (0..20).map(|_| tick().device_force[0]).last().unwrap();
        assert!((force - device_force).abs() < 1e-12, "{cancels} {push} {authority}: {force}");
    }
}

/// V of a device that samples every few ticks is read: a guarded layer is at most two samples and a hold late.
#[test]
fn motion_of_a_slow_device_is_read() {
    let safety = SafetySettings { controllers: [ControllerKind::Vfc].into(), ..SafetySettings::default() };
    let settings = settings(safety);
    for every in 1..=8_usize {
        for acceleration in [20.0, 50.0, 105.0] {
            let quantum = 2.3e-5;
            let bounds = SampleBounds { quantum, ..SampleBounds::LINEAR };
            let mut guarded = SafetyLayer::new(&settings).unwrap().with_samples(bounds);
            let mut blind = SafetyLayer::new(&settings).unwrap().with_samples(SampleBounds::UNBOUNDED);
            let mut first = [None, None];
            for n in 0..400_usize {
                let t = (n - n % every).saturating_sub(200) as f64 * PERIOD;
                let x = Axes::<1>::new((0.5 * acceleration * t * t / quantum).round() * quantum);
                for (layer, first) in [&mut guarded, &mut blind].into_iter().zip(&mut first) {
                    let tick = layer.tick(&x, None, &Axes::<1>::new(1.0));
                    if n < 240 {
                        // A sensor that is slower than a quarter of the loop may look like a step.
                        assert!(layer.excess().is_none() || every > 4, "{every} {acceleration} {n}");
                        if tick.motion.velocity[0] > 0.5 || layer.excess().is_some() {
                            first.get_or_insert(n);
                        }
                    }
                }
            }
            let [guarded, blind] = first.map(|tick| tick.unwrap_or(400));
            assert!(
                guarded <= blind + 3 + 2 * every,
                "every {every}, {acceleration} m/s^2: {guarded}, {blind}"
            );
        }
    }
}

/// One wrong sample below the speed bound, while a hand moves evenly and `F_v` is 0.5 N: it is counted, trips no
/// controller, and changes the force by at most 0.5 N.
#[test]
fn a_wrong_sample_in_a_quick_motion_is_not_felt() {
    // Mass in kg, speed bound in m/s, quantum in m, period in s, acceleration in m/s^2 and frequency in Hz.
    let devices = [
        (0.075, 16.0, 3e-5, 1e-3, 113.0, 20.0),
        (0.157, 10.0, 2.3e-5, 2e-3, 38.0, 8.0),
        (0.157, 10.0, 2.3e-5, 3e-3, 24.0, 5.0),
        (0.157, 10.0, 2.3e-5, 5e-3, 14.0, 3.0),
    ];
    for (mass, speed, quantum, period_s, acceleration, frequency) in devices {
        let damping = f64::min(5.0, 0.999 * mass / (5.0 * period_s));
        let mut compared = 0;
        for kind in ControllerKind::ALL {
            let safety = SafetySettings {
                controllers: [kind].into(),
                damping,
                pc_max_damping: damping,
                hsc_force_threshold_n: 0.4,
                energy_threshold_j: -0.03,
                window: 50,
                ..SafetySettings::default()
            };
            let estimator = EstimatorKind::DualKalman {
                velocity_jerk_density: 1e3,
                jerk_density: 10.0,
                quantum_m: quantum,
            };
            let device = DeviceModel::uniform(mass, 0.0, 0.03).unwrap();
            let settings = LayerSettings { device, period_s, estimator, ..settings(safety) };
            let bounds = SampleBounds { speed, quantum, ..SampleBounds::LINEAR };
            let run = |phase: f64, wrong: f64| {
                let mut layer = SafetyLayer::new(&settings).unwrap().with_samples(bounds);
                let w = std::f64::consts::TAU * frequency;
                let ticks: Vec<_> = (0..330)
                    .map(|n| {
                        let x = acceleration / (w * w) * (w * f64::from(n) * period_s + phase).sin();
                        let x = (x / quantum).round() * quantum + if n == 300 { wrong } else { 0.0 };
                        let force = 0.5 * f64::min(1.0, 10.0 * f64::from(n) * period_s);
                        let tick = layer.tick(&Axes::<1>::new(x), None, &Axes::<1>::new(force));
                        (tick.device_force[0], tick.intervention.tripped.any(), tick.fault)
                    })
                    .collect();
                (ticks, layer.guard().outliers())
            };
            for phase in 0..12 {
                let phase = std::f64::consts::TAU / 12.0 * f64::from(phase);
                let (clean, _) = run(phase, 0.0);
                if clean[250..].iter().any(|tick| tick.1) {
                    continue;
                }
                for share in [0.9, 0.5, -0.5, -0.9] {
                    let (ticks, outliers) = run(phase, share * speed * period_s);
                    let case = format!("{mass} kg, {period_s} s, {kind:?}, phase {phase}, {share}");
                    assert_eq!(outliers, 1, "{case}");
                    compared += 1;
                    for (n, (one, other)) in ticks.iter().zip(&clean).enumerate().skip(296) {
                        let off = (one.0 - other.0).abs();
                        assert!(one.2.is_none() && !one.1 && off <= 0.5, "{case}, tick {n}: {off} N");
                    }
                }
            }
        }
        assert!(compared >= 48, "{mass} kg, {period_s} s: {compared}");
    }
}
