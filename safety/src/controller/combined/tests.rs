//! Test of trips, of the course of an intervention, and of the return of the force.

use proptest::prelude::*;

use super::*;
use crate::controller::NOT_FELT;
use simba::simd::{AutoBoolx4, AutoF64x4};

const PERIOD_S: f64 = 1e-3;

fn controller(settings: &SafetySettings) -> SafetyController<1> {
    let device = DeviceModel::uniform(0.157, 0.0, 0.0).unwrap();
    SafetyController::new(&device, PERIOD_S, settings).unwrap()
}

fn seen(velocity: f64, rendered: f64) -> Observation<1> {
    Observation::exact(Axes::<1>::new(velocity), Axes::<1>::new(rendered), Axes::<1>::zeros())
}

/// Settings in which the bits of `places` select VFC, HSC and WSC.
fn watching(places: u8) -> SafetySettings {
    SafetySettings {
        controllers: (0..3)
            .filter(|place| places >> place & 1 == 1)
            .map(|at| ControllerKind::ALL[at])
            .collect(),
        energy_threshold_j: -1e-6,
        ..SafetySettings::default()
    }
}

/// A scaled device trips at the same ticks, with forces `F_c f`. Its forces are F f, its distances x l, its mass m f
/// / l, and its times the same. The factors are powers of two, so that the comparison is exact.
#[test]
fn scaled_device_trips_as_the_original() {
    let (force, way) = (0.5, 0.25);
    let settings = SafetySettings {
        controllers: ControllerKind::ALL.into(),
        velocity_threshold: 0.1,
        energy_threshold_j: -1e-3,
        hsc_velocity_threshold: 0.25,
        wsc_force_threshold_n: 0.5,
        window: 20,
        hold_off_s: 0.01,
        release_ramp_s: 0.02,
        ..SafetySettings::default()
    };
    let build = |mass_kg: f64, settings: &SafetySettings| {
        let device = DeviceModel::<1>::uniform(mass_kg, 0.0, 0.0).unwrap();
        SafetyController::new(&device, PERIOD_S, settings).unwrap()
    };
    let mut hand = build(0.157, &settings);
    let mut scaled = build(0.157 * force / way, &settings.at_scale(force, way));
    let mut tripped = 0;
    for tick in 0..2000 {
        let t = f64::from(tick) * PERIOD_S;
        let [velocity, rendered, grasp] = [(7.0 * t).sin(), 3.0 * (11.0 * t).cos(), 2.0 * (3.0 * t).sin()];
        let of = |force: f64, way: f64| {
            let [rendered, grasp] = [rendered, grasp].map(|n| Axes::<1>::new(n * force));
            Observation::exact(Axes::<1>::new(velocity * way), rendered, grasp)
        };
        let answer = hand.step(&of(1.0, 1.0)).unwrap();
        let like = scaled.step(&of(force, way)).unwrap();
        assert_eq!(like.tripped, answer.tripped, "{tick}");
        assert_eq!(like.safety_force, answer.safety_force * force, "{tick}");
        tripped |= answer.tripped.bits();
    }
    assert_eq!(tripped & 0xF, 0xF, "each controller has tripped");
}

/// The shortcut for no controller gives the result of the full computation, and applies only without a controller.
#[test]
fn no_response_without_controllers() {
    let settings = SafetySettings { probe_force_n: 0.5, release_tries: 3, ..SafetySettings::default() };
    let mut short = controller(&settings);
    let mut long = short.clone();
    assert!(short.controllers.is_empty() && short.probe.is_none());
    for seen in [seen(0.0, 0.0), seen(1.4, 7.0), seen(-1.4, 7.0), seen(1e3, -1e3)] {
        let answer = short.respond(&seen, 1.0);
        let verdicts = long.judge(&seen);
        let is_unsafe = verdicts.is_unsafe();
        let ease = long.step_probe(&seen, 1.0, is_unsafe);
        let expected = long.answer(&seen, 1.0, &verdicts, Judged { is_unsafe, ease });
        assert_eq!(
            format!("{answer:?}"),
            format!("{expected:?}"),
            "compared as text, since NaN differs from NaN"
        );
        assert_eq!(short, long);
    }
    for kind in ControllerKind::ALL {
        let built = controller(&SafetySettings { controllers: [kind].into(), ..settings });
        assert!(!built.controllers.is_empty(), "{kind:?}");
    }
}

#[test]
fn one_law_responds_to_any_set_of_trips() {
    for places in 0..8_u8 {
        let mut controller = controller(&watching(places));
        let mut last = Intervention::none();
        for tick in 0..50_u8 {
            last = controller.step(&seen(0.7 + f64::from(tick) * 0.01, 2.0)).unwrap();
        }
        assert_eq!(last.tripped.bits(), places, "all active controllers trip");
        let velocity = 0.7 + 49.0 * 0.01;
        let expected = if places == 0 { 0.0 } else { -2.0 - 5.0 * velocity };
        assert!((last.safety_force[0] - expected).abs() < 1e-12, "{places}: {last:?}");
        assert_eq!(controller.kinds(), watching(places).controllers);
        assert_eq!(controller.needs_grasp_force(), places & 6 != 0);
        for (value, bit) in last.observed.0.into_iter().zip([1, 2, 4, 8]) {
            assert_eq!(value.is_nan(), places & bit == 0);
        }
    }
}

#[test]
fn damping_needs_authority_and_cancelling_none() {
    for authority in [0.0, 0.25, 1.0] {
        let mut controller = controller(&watching(1));
        let step = controller.step_with_authority(&seen(1.0, 2.0), authority).unwrap();
        assert_eq!(step.safety_force[0], -2.0 - 5.0 * authority);
        assert_eq!(step.tripped, Tripped::of(ControllerKind::Vfc));
    }
}

#[test]
fn reset_ends_an_intervention() {
    let settings = SafetySettings { hold_off_s: 0.1, release_ramp_s: 0.1, ..watching(1) };
    let mut controller = controller(&settings);
    controller.step(&seen(1.0, 2.0)).unwrap();
    assert_eq!(controller.step(&seen(0.0, 2.0)).unwrap().tripped, Tripped::HELD);
    controller.reset();
    assert_eq!(controller, self::controller(&settings));
    assert_eq!(controller.step(&seen(0.0, 2.0)).unwrap().tripped, Tripped::NONE);
}

/// While the force returns, the hand is compared with the share of the force that it can have felt.
#[test]
fn hand_that_holds_the_returning_force_ends_the_intervention() {
    let settings = SafetySettings { release_ramp_s: 0.05, ..watching(2) };
    for (holds, stays) in [(true, false), (false, true)] {
        let mut controller = controller(&settings);
        controller.step(&seen(0.0, 2.0)).unwrap();
        let (mut on, mut last_share) = (0, 0.0);
        for _ in 0..500 {
            let grasp = if holds { -2.0 * last_share } else { 0.0 };
            let felt = Observation { grasp_force: Axes::<1>::new(grasp), ..seen(0.0, 2.0) };
            let step = controller.step(&felt).unwrap();
            last_share = 1.0 + step.safety_force[0] / 2.0;
            on += u32::from(step.tripped.any());
        }
        assert_eq!(on == 500, stays, "{on}");
    }
}

/// PC acts in the share that an intervention leaves.
#[test]
fn pc_acts_in_the_share_that_an_intervention_leaves() {
    let pc = SafetySettings { controllers: [ControllerKind::Pc].into(), ..SafetySettings::default() };
    let (mut alone, mut both) = (
        controller(&pc),
        controller(&SafetySettings { controllers: [ControllerKind::Vfc, ControllerKind::Pc].into(), ..pc }),
    );
    let push = |tick: u8| seen(if tick == 20 { 1.0 } else { 0.1 }, 2.0);
    for tick in 0..40 {
        let (one, two) = (alone.step(&push(tick)).unwrap(), both.step(&push(tick)).unwrap());
        if tick == 20 {
            assert_eq!(two.tripped, Tripped::of(ControllerKind::Vfc), "PC does not act during the trip");
            assert!((two.safety_force[0] - (-2.0 - 5.0)).abs() < 1e-12);
        } else if tick < 20 {
            assert_eq!((one.safety_force, one.tripped), (two.safety_force, two.tripped));
            assert_eq!(one.tripped == Tripped::of(ControllerKind::Pc), one.safety_force[0] != 0.0);
        }
    }
    assert!(alone.step(&push(1)).unwrap().tripped.contains(Tripped::of(ControllerKind::Pc)), "PC acts here");
    let half = alone.clone().step_with_authority(&push(1), 0.5).unwrap().safety_force[0];
    assert_eq!(half, alone.step(&push(1)).unwrap().safety_force[0] * 0.5);
}

/// An intervention lasts for the hold-off, including the first tick; then `g = 1 - s²` over the ramp, then 0.
#[test]
fn an_intervention_lasts_its_hold_off_and_fades_by_its_law() {
    for (hold_off, ramp) in [(1_u32, 3_u32), (4, 1), (5, 4), (3, 0)] {
        let settings = SafetySettings {
            hold_off_s: f64::from(hold_off) * PERIOD_S,
            release_ramp_s: f64::from(ramp) * PERIOD_S,
            energy_threshold_j: -0.05,
            ..watching(4)
        };
        let mut controller = controller(&settings);
        let force = |gain: f64, velocity: f64| gain * (-2.0 - 5.0 * velocity);
        // Increasing durations of the unsafe state: the hold-off counts from the first tick.
        for unsafe_ticks in [1, hold_off.max(2) - 1, hold_off, hold_off + 2] {
            for tick in 0..unsafe_ticks {
                let step = controller.step(&seen(1.0, 2.0)).unwrap();
                assert_eq!(step.safety_force[0], force(1.0, 1.0), "{tick}");
            }
            let held = hold_off.saturating_sub(unsafe_ticks);
            for tick in 1..=held + ramp + 3 {
                let step = controller.step(&seen(0.1, 2.0)).unwrap();
                let s = f64::from(tick.saturating_sub(held)) / f64::from(ramp + 1);
                let gain = if s < 1.0 { 1.0 - s * s } else { 0.0 };
                let apart = (step.safety_force[0] - force(gain, 0.1)).abs();
                assert!(apart < 1e-14, "{hold_off} {ramp} {unsafe_ticks} {tick}: {step:?}");
                let tripped = if gain > 0.0 { Tripped::HELD } else { Tripped::NONE };
                assert_eq!(step.tripped, tripped);
            }
        }
    }
}

/// During a fading intervention the force of Eq. 12 is scaled by `1 - g`.
#[test]
fn pc_returns_as_an_intervention_fades() {
    let pc = SafetySettings { controllers: [ControllerKind::Pc].into(), ..SafetySettings::default() };
    let vfc = SafetySettings { hold_off_s: 5e-3, release_ramp_s: 0.02, ..watching(1) };
    let settings =
        [pc, vfc, SafetySettings { controllers: [ControllerKind::Vfc, ControllerKind::Pc].into(), ..vfc }];
    let mut of = settings.map(|settings| controller(&settings));
    let mut partly = 0;
    for tick in 0..60 {
        let seen = seen(if tick == 20 { 1.0 } else { 0.1 }, 2.0);
        let [alone, intervention, both] = of.each_mut().map(|one| one.respond(&seen, 0.5));
        let gain = -intervention.safety_force[0] / (2.0 + 0.5 * 5.0 * seen.velocity[0]);
        let expected = intervention.safety_force[0] + (1.0 - gain) * alone.safety_force[0];
        assert!((both.safety_force[0] - expected).abs() < 1e-14, "{tick}: {both:?} {expected}");
        assert_eq!(
            both.tripped[ControllerKind::Pc],
            alone.tripped[ControllerKind::Pc] && gain < 1.0,
            "{tick}"
        );
        assert_eq!(both.acts, gain > 0.0 || both.tripped[ControllerKind::Pc], "{tick}");
        assert_eq!(both.observed[ControllerKind::Pc], alone.observed[ControllerKind::Pc]);
        partly += u32::from(both.tripped[ControllerKind::Pc] && gain > 0.0);
    }
    assert!(partly >= 19, "ticks of the ramp on which PC acts: {partly}");
}

#[test]
fn pc_acts_on_any_axis() {
    let device = DeviceModel::uniform(0.157, 0.0, 0.0).unwrap();
    let settings = SafetySettings { controllers: [ControllerKind::Pc].into(), ..SafetySettings::default() };
    for velocity in [[0.5, 0.0], [0.0, -0.5], [0.5, 0.5], [0.0, 0.0]] {
        let mut controller = SafetyController::<2>::new(&device, PERIOD_S, &settings).unwrap();
        let seen = Observation::exact(Axes::<2>::from(velocity), Axes::zeros(), Axes::zeros());
        let response = controller.respond(&seen, 1.0);
        let moves = velocity != [0.0; 2];
        assert_eq!((response.tripped[ControllerKind::Pc], response.acts), (moves, moves), "{velocity:?}");
        for (force, velocity) in response.safety_force.iter().zip(velocity) {
            assert_eq!(*force < 0.0, velocity > 0.0);
            assert_eq!(*force == 0.0, velocity == 0.0);
        }
    }
}

/// Return a controller in which VFC has tripped, and an observation: a hand drives the device at 0.2 m/s with 4 N
/// against the push.
fn tripped_and_driven(settings: &SafetySettings) -> (SafetyController<1>, Observation<1>) {
    let mut controller = controller(settings);
    let answer = controller.step(&seen(1.0, 2.0)).unwrap();
    assert!(answer.tripped.any());
    (controller, Observation { grasp_force: Axes::<1>::new(-4.0), ..seen(-0.2, 2.0) })
}

fn probing() -> SafetySettings {
    SafetySettings { probe_force_n: 0.6, release_tries: 3, ..watching(1) }
}

#[test]
fn missed_tick_decides_nothing() {
    let fades = SafetySettings { release_ramp_s: 0.05, ..probing() };
    let (mut controller, driven) = tripped_and_driven(&fades);
    for _ in 0..5000 {
        controller.skip_tick(&driven);
    }
    // The missed ticks decided neither that a hand is there, which would have ended the ramp, nor that none is.
    assert!(controller.step(&driven).unwrap().tripped.any());
    let mut ticks = 0;
    while controller.step(&driven).unwrap().tripped.any() {
        ticks += 1;
        assert!(ticks < 150, "a hand that drives the device is felt");
    }
    let (mut controller, driven) = tripped_and_driven(&SafetySettings { probe_force_n: 0.0, ..probing() });
    controller.skip_tick(&driven);
    assert!(controller.step(&driven).unwrap().tripped.any(), "no decision without a probe either");
}

#[test]
fn hand_felt_by_another_probe_is_adopted() {
    let (mut controller, _) = tripped_and_driven(&probing());
    let still = seen(0.0, 2.0);
    for _ in 0..20 {
        assert!(controller.step(&still).unwrap().tripped.any());
    }
    controller.adopt_result(true);
    assert!(!controller.step(&still).unwrap().tripped.any());
}

/// The probe acts `release_tries` times, or the layer waits for a moving hand as often; then the force is withheld.
#[test]
fn after_all_tries_the_force_is_withheld() {
    for (force_n, tries) in [(0.0, 1), (0.0, 4), (0.6, 1), (0.6, 3)] {
        let mut controller =
            controller(&SafetySettings { probe_force_n: force_n, release_tries: tries, ..probing() });
        let (mut came_back, mut probed, mut withheld) = (0, 0, false);
        let (mut was_on, mut was_probed) = (false, false);
        for tick in 0..8000 {
            // A returned force throws the device; without force it rests.
            let answer = controller.step(&seen(if was_on { 0.0 } else { 1.0 }, 2.0)).unwrap();
            let is_on = answer.tripped.any();
            let pushes = is_on && (answer.safety_force[0] + 2.0).abs() > 0.1 && was_on;
            came_back += u32::from(was_on && !is_on);
            probed += u32::from(pushes && !was_probed);
            assert!(!withheld || (is_on && !pushes && answer.withheld), "{force_n} {tries} {tick}");
            (was_on, was_probed, withheld) = (is_on, pushes, answer.withheld);
        }
        assert!(withheld);
        // Each probe has two halves.
        let expected = if force_n > 0.0 { 2 * tries } else { 0 };
        assert_eq!((came_back, probed), (0, expected), "{force_n}");
    }
}

/// A probe is answered in all tries or in none; an answered probe returns the force, which nobody bears.
#[test]
fn felt_hand_that_bears_nothing_yields() {
    for (answers, tries) in [(false, 1), (false, 3), (true, 1), (true, 3)] {
        let ramp = SafetySettings { release_ramp_s: 0.2, release_tries: tries, ..probing() };
        let mut controller = controller(&ramp);
        let (mut answer, mut largest_n, mut first) = (Intervention::none(), 0.0_f64, None);
        for tick in 0..8000 {
            let device_n = 2.0 + answer.safety_force[0];
            let probed = answer.tripped.any() && device_n < 0.0;
            let grasp_n = if answers && probed { 0.5 } else { 0.0 };
            let seen = seen(if tick == 0 { 1.0 } else { 0.0 }, 2.0);
            answer = controller.step(&Observation { grasp_force: Axes::<1>::new(grasp_n), ..seen }).unwrap();
            assert!(answer.tripped.any(), "{answers} {tries} {tick}: nobody bears the force");
            assert!(answer.withheld || !answer.yields, "{tick}");
            if answer.withheld {
                first = first.or(Some(answer.yields));
            }
            largest_n = largest_n.max(2.0 + answer.safety_force[0]);
        }
        assert_eq!((first, answer.yields), (Some(answers), answers), "{tries}");
        // The limit is A / 1.25, or A of the half of the probe along the push.
        assert!(largest_n <= 1e-9 + if answers { 0.6 / 1.25 } else { 0.6 }, "{answers}: {largest_n} N");
    }
}

#[test]
fn each_lane_has_its_own_answer() {
    for lane in 0..4 {
        let only = |place: usize| {
            let mut mask = AutoBoolx4::splat(false);
            mask.replace((lane + place) % 4, true);
            mask
        };
        let number = |from: f64| AutoF64x4::new(from, from + 1.0, from + 2.0, from + 3.0);
        let response = Response::<1, AutoF64x4> {
            safety_force: Axes::<1, AutoF64x4>::new(number(1.0)),
            may_act: true,
            acts: only(0),
            tripped: PerController(std::array::from_fn(only)),
            held: only(0),
            withheld: only(1),
            yields: only(2),
            research: only(1),
            observed: PerController(std::array::from_fn(|place| number(10.0 * place as f64))),
        };
        let own = response.lane(lane);
        assert_eq!(own.tripped, Tripped::from_bits(1 | 16));
        for (place, one) in [
            (1, Tripped::of(ControllerKind::Hsc).and(Tripped::RESEARCH)),
            (2, Tripped::of(ControllerKind::Wsc)),
            (3, Tripped::of(ControllerKind::Pc)),
        ] {
            let other = response.lane((lane + place) % 4);
            assert_eq!((other.tripped, other.withheld, other.yields), (one, place == 1, place == 2));
        }
        let place = lane as f64;
        assert_eq!(own.safety_force[0], 1.0 + place);
        assert_eq!(own.observed, PerController(std::array::from_fn(|of| 10.0 * of as f64 + place)));
    }
}

/// Duration of an intervention and of its fade so far, in ticks.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Course {
    on: f64,
    fading: f64,
}

/// Gain of an intervention from its states in turn: trips, is off, stays, fades, is over.
fn gain_by_states(
    now: Course,
    [hold_off, ramp]: [f64; 2],
    is_unsafe: bool,
    ease: Option<f64>,
) -> (f64, Course) {
    let over = Course { on: 0.0, fading: 0.0 };
    if is_unsafe {
        // A trip during the fade restarts the intervention.
        let on = if now.fading > 0.0 { 1.0 } else { now.on + 1.0 };
        return (1.0, Course { on, fading: 0.0 });
    }
    if now.on == 0.0 {
        return (0.0, over);
    }
    if now.on < hold_off {
        return (1.0, Course { on: now.on + 1.0, ..now });
    }
    let fading = (now.fading + ease.unwrap_or(1.0)).max(0.0);
    if fading > ramp {
        return (0.0, over);
    }
    let share = fading / (ramp + 1.0);
    (1.0 - share * share, Course { fading, ..now })
}

proptest! {
    /// The gain equals that of the states bit for bit, with scalars and with lanes, each lane with its own course.
    #[test]
    fn an_intervention_follows_its_states(
        hold_off in 0..4_u32,
        ramp in 0..5_u32,
        ticks in prop::collection::vec(
            prop::array::uniform4((prop::bool::weighted(0.2), prop::sample::select(vec![NOT_FELT, 0.0, 0.25, 1.0, 1.0]))),
            1..60,
        ),
        asks in any::<bool>(),
    ) {
        let settings = SafetySettings {
            hold_off_s: f64::from(hold_off) * PERIOD_S,
            release_ramp_s: f64::from(ramp) * PERIOD_S,
            ..watching(4)
        };
        let one = controller(&settings);
        let mut lanes = SafetyController::<1, AutoF64x4>::gather(&[&one; 4]).unwrap();
        let mut alone = [(); 4].map(|()| one.clone());
        // Controllers and lanes that are stepped through `answer` instead of `gain`.
        let (mut answering, mut lanes_answering) = (alone.clone(), lanes.clone());
        let seen_in_lanes = Observation::exact(
            Axes::<1, AutoF64x4>::new(AutoF64x4::splat(0.1)),
            Axes::<1, AutoF64x4>::new(AutoF64x4::splat(2.0)),
            Axes::<1, AutoF64x4>::zeros(),
        );
        let mut states = [Course { on: 0.0, fading: 0.0 }; 4];
        for tick in ticks {
            let ease = asks.then(|| AutoF64x4::from(tick.map(|(_, ease)| ease)));
            let judged = Judged { is_unsafe: AutoBoolx4::from(tick.map(|(bad, _)| bad)), ease };
            let shared = lanes.gain(judged);
            let verdicts = lanes_answering.judge(&seen_in_lanes);
            let together = lanes_answering.answer(&seen_in_lanes, AutoF64x4::splat(1.0), &verdicts, judged);
            let may_act = |lane: usize| tick[lane].0 || states[lane].on > 0.0;
            prop_assert_eq!(together.may_act, (0..4).any(may_act));
            let of_each = [0, 1, 2, 3].map(may_act);
            for (lane, (is_unsafe, ease)) in tick.into_iter().enumerate() {
                let ease = asks.then_some(ease);
                let times = [hold_off, ramp].map(f64::from);
                let (gain, next) = gain_by_states(states[lane], times, is_unsafe, ease);
                states[lane] = next;
                prop_assert_eq!(alone[lane].gain(Judged { is_unsafe, ease }), gain);
                prop_assert_eq!(shared.extract(lane), gain);
                let verdicts = answering[lane].judge(&seen(0.1, 2.0));
                let judged = Judged { is_unsafe, ease };
                let answer = answering[lane].answer(&seen(0.1, 2.0), 1.0, &verdicts, judged);
                // The force is -F_v - mu V, and 0.0 instead of -0.0.
                let force = if gain > 0.0 { (-2.0 - 0.1 * 5.0) * gain } else { 0.0 };
                prop_assert_eq!(answer.safety_force[0].to_bits(), force.to_bits());
                prop_assert_eq!(together.safety_force[0].extract(lane).to_bits(), force.to_bits());
                prop_assert_eq!((answer.may_act, answer.acts), (of_each[lane], gain > 0.0));
                prop_assert_eq!(together.acts.extract(lane), gain > 0.0);
                prop_assert_eq!(answering[lane].let_through, 1.0 - gain);
                prop_assert_eq!(lanes_answering.let_through.extract(lane), 1.0 - gain);
                for one in [&alone[lane], &answering[lane]] {
                    prop_assert_eq!(Course { on: one.on_for, fading: one.fading_for }, next);
                }
                for of in [&lanes, &lanes_answering] {
                    let found = Course {
                        on: of.on_for.extract(lane),
                        fading: of.fading_for.extract(lane),
                    };
                    prop_assert_eq!(found, next);
                }
            }
        }
    }
}
