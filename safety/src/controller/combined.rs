//! Controllers combined: any of them trips, one law answers.

use nalgebra::{SimdBool as _, Vector3};

use crate::{
    Axes, DeviceModel, Fault, Observation, ParameterError, Real,
    controller::{
        ControllerKind, Controllers, HandGraspController, Intervention, PassivityController, Response,
        VelocityForceController, WindowedSafetyController, cancel_and_damp, dampable,
    },
    lanes::{nowhere, option, pack},
    observer::{
        HandGraspObserver, SafetyObserver, VelocityForceForm, VelocityForceObserver, WindowedSafetyObserver,
    },
    parameter::{in_range, non_negative, positive, whole},
};

/// Which controllers watch, their thresholds, and how an intervention begins and ends.
///
/// A controller that is not asked for is not built, and an observer that no controller reads is not computed.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Deserialize, schemars::JsonSchema))] // unknown keys are the table's to refuse: it flattens this
pub struct SafetySettings {
    /// Which of them watch.
    pub controllers: Controllers,
    /// mu in N s/m, of Eq. 2, 13, 14.
    pub damping: f64,
    /// `V_t` in m/s, of Eq. 1.
    pub velocity_threshold: f64,
    /// `F_t` in N, of Eq. 1.
    pub vfc_force_threshold_n: f64,
    /// Which reading of Eq. 1.
    pub vfc_form: VelocityForceForm,
    /// zeta, of Eq. 8.
    pub grasp_threshold: f64,
    /// alpha in N, of Eq. 5.
    pub grasp_floor_n: f64,
    /// `F_t` in N, of Eq. 14.
    pub hsc_force_threshold_n: f64,
    /// delta in J, of Eq. 10.
    pub energy_threshold_j: f64,
    /// eta, of Eq. 9.
    pub energy_ratio: f64,
    /// w in ticks, of Eq. 11.
    pub window: usize,
    /// alpha in N s/m: bound on the damping of Eq. 12.
    pub pc_max_damping: f64,
    /// Least duration of an intervention in s.
    pub hold_off_s: f64,
    /// Time in s over which an intervention fades out; 0 gives the rendered force back as a step.
    pub release_ramp_s: f64,
}

impl Default for SafetySettings {
    /// The paper's thresholds (section 4), no controller, no hold-off, no ramp.
    fn default() -> Self {
        Self {
            controllers: Controllers::NONE,
            damping: 5.0,
            velocity_threshold: 0.6,
            vfc_force_threshold_n: 1.0,
            vfc_form: VelocityForceForm::Product,
            grasp_threshold: 1.5,
            grasp_floor_n: 1e-3,
            hsc_force_threshold_n: 0.1,
            energy_threshold_j: -0.03,
            energy_ratio: 0.5,
            window: 100,
            pc_max_damping: 10.0,
            hold_off_s: 0.0,
            release_ramp_s: 0.0,
        }
    }
}

/// Controllers combined by "any of".
///
/// While one of VFC, HSC, WSC trips, `F_c = -F_v - mu V`. It stays so for at least the hold-off, then fades over
/// the release ramp: `F_c = g (-F_v - mu V)` with `g = 1 - s²`, s from 0 to 1. A new trip sets g to 1 at once. PC adds its own
/// force in the share 1 - g that the intervention leaves.
///
/// Source: paper Eq. 2, 12, 13, 14.
#[derive(Clone, Debug, PartialEq)]
pub struct SafetyController<const N: usize, S = f64> {
    vfc: Option<VelocityForceController<S>>,
    hsc: Option<HandGraspController<S>>,
    wsc: Option<WindowedSafetyController<N, S>>,
    pc: Option<PassivityController<N, S>>,
    damping: S,
    hold_off_ticks: S,
    ramp_ticks: S,
    /// Ticks since the current intervention began, the first counted; 0 while none is on.
    on_for: S,
    /// Ticks since the intervention began to fade.
    fading_for: S,
    /// Share of `F_v` that the last tick let through.
    let_through: S,
}

impl<const N: usize> SafetyController<N> {
    /// Longest hold-off or ramp in s.
    pub const MAX_HOLD_S: f64 = 60.0;

    /// Builds what `settings` asks for, for a device sampled every `period_s`.
    pub fn new(
        device: &DeviceModel<N>,
        period_s: f64,
        settings: &SafetySettings,
    ) -> Result<Self, ParameterError> {
        let period_s = positive("period_s", "dT", period_s)?;
        let ticks = |name, value| {
            let value = in_range(name, "time", value, 0.0, Self::MAX_HOLD_S, "between 0 and 60 s")?;
            // Counted in S, of which each lane has its own.
            Ok((value / period_s).round())
        };
        let SafetySettings { energy_ratio, window, .. } = *settings;
        let [vfc_on, hsc_on, wsc_on, pc_on] =
            ControllerKind::ALL.map(|kind| settings.controllers.contains(kind));
        let named = |name| move |error: ParameterError| error.of_field("force_threshold_n", name);
        // All are checked, also those that are not asked for: a wrong number is wrong before it is needed.
        let vfc = VelocityForceObserver::new(
            settings.velocity_threshold,
            settings.vfc_force_threshold_n,
            settings.vfc_form,
        )
        .map_err(named("vfc_force_threshold_n"))?;
        let hsc = HandGraspController::new(
            HandGraspObserver::new(settings.grasp_floor_n)?,
            settings.grasp_threshold,
            settings.hsc_force_threshold_n,
        )
        .map_err(named("hsc_force_threshold_n"))?;
        whole("window", "w", window, 1, WindowedSafetyObserver::<N>::MAX_WINDOW, "1 to 3600000 ticks")?;
        // A window that nobody reads is not reserved.
        let window = if wsc_on { window } else { 1 };
        let wso = WindowedSafetyObserver::new(*device, period_s, energy_ratio, window)?;
        let wsc = WindowedSafetyController::new(wso, settings.energy_threshold_j)?;
        let so = SafetyObserver::new(*device, period_s, energy_ratio)?;
        // How much damping a device stands is asked only where it is applied: the defaults suit a stylus at 1 kHz.
        let stands = |is_used, name, symbol, value| {
            if is_used {
                dampable(name, symbol, value, device, period_s)
            } else {
                non_negative(name, symbol, value)
            }
        };
        let alpha = stands(pc_on, "pc_max_damping", "alpha", settings.pc_max_damping)?;
        let pc = PassivityController::new(so, device, period_s, if pc_on { alpha } else { 0.0 })?;
        let damps = vfc_on || hsc_on || wsc_on;
        let damping = stands(damps, "damping", "mu", settings.damping)?;
        Ok(Self {
            vfc: vfc_on.then(|| VelocityForceController::new(vfc)),
            hsc: hsc_on.then_some(hsc),
            wsc: wsc_on.then_some(wsc),
            pc: pc_on.then_some(pc),
            damping,
            hold_off_ticks: ticks("hold_off_s", settings.hold_off_s)?,
            ramp_ticks: ticks("release_ramp_s", settings.release_ramp_s)?,
            on_for: 0.0,
            fading_for: 0.0,
            let_through: 1.0,
        })
    }

    /// `F_c` for this tick. A sample that is not finite or absurd changes no state and is returned as a fault.
    pub fn step(&mut self, seen: &Observation<N>) -> Result<Intervention<N>, Fault> {
        self.step_with_authority(seen, 1.0)
    }

    /// As [`step`](Self::step), with damping in the share `authority` (0 to 1) only.
    ///
    /// Cancelling `F_v` needs no authority, for it takes a force away. Damping is a force: without a peer it goes as
    /// the rendered force goes.
    pub fn step_with_authority(
        &mut self,
        seen: &Observation<N>,
        authority: f64,
    ) -> Result<Intervention<N>, Fault> {
        seen.check()?;
        Ok(self.respond(seen, authority).lane(0))
    }
}

impl<const N: usize, S: Real> SafetyController<N, S> {
    /// As many controllers as there are lanes, which have built the same; else None. Thresholds and times may differ,
    /// the period, the window and the form of VFC may not.
    pub fn gather(of: &[SafetyController<N>]) -> Option<Self> {
        Some(Self {
            vfc: option(of, |one| one.vfc, VelocityForceController::gather)?,
            hsc: option(of, |one| one.hsc, HandGraspController::gather)?,
            wsc: option(of, |one| one.wsc.clone(), WindowedSafetyController::gather)?,
            pc: option(of, |one| one.pc.clone(), PassivityController::gather)?,
            damping: pack(of, |one| one.damping)?,
            hold_off_ticks: pack(of, |one| one.hold_off_ticks)?,
            ramp_ticks: pack(of, |one| one.ramp_ticks)?,
            on_for: pack(of, |one| one.on_for)?,
            fading_for: pack(of, |one| one.fading_for)?,
            let_through: pack(of, |one| one.let_through)?,
        })
    }

    /// `F_c` for this tick, with damping in the share `authority` (0 to 1) only; nothing is checked.
    #[inline(always)]
    pub fn respond(&mut self, seen: &Observation<N, S>, authority: S) -> Response<N, S> {
        let (nothing, all) = (S::splat(0.0), S::splat(1.0));
        let unobserved = (S::splat(f64::NAN), nowhere::<S>());
        let (velocity_force, vfc) = match &self.vfc {
            Some(vfc) => vfc.judge(seen),
            None => unobserved,
        };
        let (grasp, hsc) = match &self.hsc {
            Some(hsc) => hsc.judge(&self.felt(seen)),
            None => unobserved,
        };
        let (windowed_energy_j, wsc) = match &mut self.wsc {
            Some(wsc) => wsc.step(seen),
            None => unobserved,
        };
        let pc = match &mut self.pc {
            Some(pc) => Some(pc.step(seen)),
            None => None,
        };

        let is_unsafe = vfc | hsc | wsc;
        let gain = self.gain(is_unsafe);
        self.let_through = all - gain;
        let is_on = gain.simd_gt(nothing);
        let safety_force = is_on.if_else(
            || cancel_and_damp(seen, self.damping * authority) * gain,
            Axes::zeros, // not -0.0: records stay clean
        );
        let mut response = Response {
            safety_force,
            acts: is_on,
            vfc,
            hsc,
            wsc,
            pc: nowhere::<S>(),
            held: is_on & !is_unsafe,
            velocity_force,
            grasp,
            windowed_energy_j,
            energy_j: unobserved.0,
        };
        if let Some(action) = pc {
            let pushes = action.force.iter().fold(nowhere::<S>(), |any, force| any | force.simd_ne(nothing));
            response.pc = gain.simd_lt(all) & pushes;
            response.acts = is_on | response.pc;
            response.safety_force = response
                .pc
                .if_else(|| safety_force + action.force * ((all - gain) * authority), || safety_force);
            response.energy_j = action.energy_j;
        }
        response
    }

    /// What a hand can have felt of `F_v`, for HSC with a release ramp.
    ///
    /// While an intervention cancels `F_v`, a hand has nothing to hold against: against all of `F_v`, `S_h` would stay
    /// large for ever and the hand that has come back would never get its force again. So the force comes back over
    /// the ramp, and `S_h` compares the hand with the share that is rendered: one that holds ends the intervention, one
    /// that is gone trips it anew as soon as that share exceeds `F_t`. Without a ramp, Eq. 14 stands as printed.
    #[inline(always)]
    fn felt(&self, seen: &Observation<N, S>) -> Observation<N, S> {
        let nothing = S::splat(0.0);
        let fades = self.ramp_ticks.simd_gt(nothing) & self.on_for.simd_gt(nothing);
        let share = self.let_through.select(fades, S::splat(1.0));
        Observation { aligned_rendered_force: seen.aligned_rendered_force * share, ..*seen }
    }

    /// Share of the intervention that is on at this tick.
    #[inline(always)]
    fn gain(&mut self, is_unsafe: S::SimdBool) -> S {
        let (nothing, all) = (S::splat(0.0), S::splat(1.0));
        let Self { on_for, fading_for, hold_off_ticks, ramp_ticks, .. } = *self;
        // For one scenario it is but one of the branches below.
        if S::LANES > 1 && (is_unsafe | on_for.simd_gt(nothing)).none() {
            return nothing;
        }
        let off = Vector3::repeat(nothing);
        let next = is_unsafe.if_else3(
            || {
                let begun = nothing.select(fading_for.simd_gt(nothing), on_for);
                Vector3::new(all, begun + all, nothing)
            },
            (|| on_for.simd_eq(nothing), || off),
            (|| on_for.simd_lt(hold_off_ticks), || Vector3::new(all, on_for + all, fading_for)),
            || {
                let fading_for = fading_for + all;
                // Slowly at first: a hand needs some 50 ms to take up a load, and one that is still taking it up
                // looks gone.
                let share = fading_for / (ramp_ticks + all);
                let fades = Vector3::new(all - share * share, on_for, fading_for);
                fading_for.simd_gt(ramp_ticks).if_else(|| off, || fades)
            },
        );
        [_, self.on_for, self.fading_for] = next.into();
        next.x
    }

    /// Which of `S_vf`, `S_h`, `E_wso`, `E_so` are observed.
    pub fn observed(&self) -> [bool; 4] {
        [self.vfc.is_some(), self.hsc.is_some(), self.wsc.is_some(), self.pc.is_some()]
    }

    /// Whether a controller reads the grasp force.
    #[inline(always)]
    pub fn needs_grasp_force(&self) -> bool {
        self.hsc.is_some() || self.wsc.is_some() || self.pc.is_some()
    }

    /// Energy in J that PC asked for (`E_so` of the tick) and the force `delivered` beyond `F_v` did not dissipate; 0
    /// without PC.
    #[inline(always)]
    pub fn owed_energy_j(&self, energy_j: S, delivered: &Axes<N, S>, velocity: &Axes<N, S>) -> S {
        let nothing = S::splat(0.0);
        self.pc.as_ref().map_or(nothing, |pc| pc.owed_energy_j(energy_j, delivered, velocity))
    }

    /// Forgets all energy and ends any intervention.
    pub fn reset(&mut self) {
        if let Some(wsc) = self.wsc.as_mut() {
            wsc.reset();
        }
        if let Some(pc) = self.pc.as_mut() {
            pc.reset();
        }
        (self.on_for, self.fading_for, self.let_through) = (S::splat(0.0), S::splat(0.0), S::splat(1.0));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::controller::Tripped;

    const PERIOD_S: f64 = 1e-3;

    fn controller(settings: &SafetySettings) -> SafetyController<1> {
        let device = DeviceModel::uniform(0.157, 0.0, 0.0).unwrap();
        SafetyController::new(&device, PERIOD_S, settings).unwrap()
    }

    fn seen(velocity: f64, rendered: f64) -> Observation<1> {
        Observation::exact(Axes::<1>::new(velocity), Axes::<1>::new(rendered), Axes::<1>::zeros())
    }

    /// VFC, HSC and WSC, of which some watch.
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

    #[test]
    fn whoever_trips_and_however_many_one_law_answers() {
        for places in 0..8_u8 {
            let mut controller = controller(&watching(places));
            let mut last = Intervention::none();
            for tick in 0..50_u8 {
                last = controller.step(&seen(0.7 + f64::from(tick) * 0.01, 2.0)).unwrap();
            }
            assert_eq!(last.tripped.bits(), places, "all that watch trip");
            let velocity = 0.7 + 49.0 * 0.01;
            let expected = if places == 0 { 0.0 } else { -2.0 - 5.0 * velocity };
            assert!((last.safety_force[0] - expected).abs() < 1e-12, "{places}: {last:?}");
            assert_eq!(controller.observed(), [places & 1 != 0, places & 2 != 0, places & 4 != 0, false]);
            assert_eq!(controller.needs_grasp_force(), places & 6 != 0);
            for (value, bit) in
                [last.velocity_force, last.grasp, last.windowed_energy_j].into_iter().zip([1, 2, 4])
            {
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
            assert_eq!(step.tripped, Tripped::VFC);
        }
    }

    #[test]
    fn an_intervention_is_forgotten_by_a_reset() {
        let settings = SafetySettings { hold_off_s: 0.1, release_ramp_s: 0.1, ..watching(1) };
        let mut controller = controller(&settings);
        controller.step(&seen(1.0, 2.0)).unwrap();
        assert_eq!(controller.step(&seen(0.0, 2.0)).unwrap().tripped, Tripped::HELD);
        controller.reset();
        assert_eq!(controller, self::controller(&settings));
        assert_eq!(controller.step(&seen(0.0, 2.0)).unwrap().tripped, Tripped::NONE);
    }

    /// While the force comes back a hand is held against the share of it that it can have felt.
    #[test]
    fn a_hand_that_holds_what_comes_back_ends_the_intervention() {
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
    fn passivity_control_has_what_an_intervention_leaves() {
        let pc = SafetySettings { controllers: [ControllerKind::Pc].into(), ..SafetySettings::default() };
        let (mut alone, mut both) = (
            controller(&pc),
            controller(&SafetySettings {
                controllers: [ControllerKind::Vfc, ControllerKind::Pc].into(),
                ..pc
            }),
        );
        let push = |tick: u8| seen(if tick == 20 { 1.0 } else { 0.1 }, 2.0);
        for tick in 0..40 {
            let (one, two) = (alone.step(&push(tick)).unwrap(), both.step(&push(tick)).unwrap());
            if tick == 20 {
                assert_eq!(two.tripped, Tripped::VFC, "not beside it");
                assert!((two.safety_force[0] - (-2.0 - 5.0)).abs() < 1e-12);
            } else if tick < 20 {
                assert_eq!((one.safety_force, one.tripped), (two.safety_force, two.tripped));
                assert_eq!(one.tripped == Tripped::PC, one.safety_force[0] != 0.0);
            }
        }
        assert!(alone.step(&push(1)).unwrap().tripped.contains(Tripped::PC), "it acts here");
        let half = alone.clone().step_with_authority(&push(1), 0.5).unwrap().safety_force[0];
        assert_eq!(half, alone.step(&push(1)).unwrap().safety_force[0] * 0.5);
    }

    /// As long as the hold-off, the first tick counted, then `g = 1 - s²` over the ramp, then nothing.
    #[test]
    fn an_intervention_lasts_its_hold_off_and_fades_by_its_law() {
        for (hold_off, ramp) in [(1_u32, 3_u32), (4, 1), (5, 4), (3, 0)] {
            let settings = SafetySettings {
                hold_off_s: f64::from(hold_off) * PERIOD_S,
                release_ramp_s: f64::from(ramp) * PERIOD_S,
                ..watching(1)
            };
            let mut controller = controller(&settings);
            let force = |gain: f64, velocity: f64| gain * (-2.0 - 5.0 * velocity);
            // Longer and longer unsafe: the hold-off counts from the first tick.
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

    /// Beside an intervention that fades, the force of Eq. 12 counts in the share `1 - g`.
    #[test]
    fn passivity_control_comes_back_as_an_intervention_fades() {
        let pc = SafetySettings { controllers: [ControllerKind::Pc].into(), ..SafetySettings::default() };
        let vfc = SafetySettings { hold_off_s: 5e-3, release_ramp_s: 0.02, ..watching(1) };
        let settings = [
            pc,
            vfc,
            SafetySettings { controllers: [ControllerKind::Vfc, ControllerKind::Pc].into(), ..vfc },
        ];
        let mut of = settings.map(|settings| controller(&settings));
        let mut partly = 0;
        for tick in 0..60 {
            let seen = seen(if tick == 20 { 1.0 } else { 0.1 }, 2.0);
            let [alone, intervention, both] = of.each_mut().map(|one| one.respond(&seen, 0.5));
            let gain = -intervention.safety_force[0] / (2.0 + 0.5 * 5.0 * seen.velocity[0]);
            let expected = intervention.safety_force[0] + (1.0 - gain) * alone.safety_force[0];
            assert!((both.safety_force[0] - expected).abs() < 1e-14, "{tick}: {both:?} {expected}");
            assert_eq!(both.pc, alone.pc && gain < 1.0, "{tick}");
            assert_eq!(both.acts, gain > 0.0 || both.pc, "{tick}");
            assert_eq!(both.energy_j, alone.energy_j);
            partly += u32::from(both.pc && gain > 0.0);
        }
        assert!(partly >= 19, "the ramp: {partly}");
    }

    #[test]
    fn passivity_control_acts_on_any_axis() {
        let device = DeviceModel::uniform(0.157, 0.0, 0.0).unwrap();
        let settings =
            SafetySettings { controllers: [ControllerKind::Pc].into(), ..SafetySettings::default() };
        for velocity in [[0.5, 0.0], [0.0, -0.5], [0.5, 0.5], [0.0, 0.0]] {
            let mut controller = SafetyController::<2>::new(&device, PERIOD_S, &settings).unwrap();
            let seen = Observation::exact(Axes::<2>::from(velocity), Axes::zeros(), Axes::zeros());
            let response = controller.respond(&seen, 1.0);
            let moves = velocity != [0.0; 2];
            assert_eq!((response.pc, response.acts), (moves, moves), "{velocity:?}");
            for (force, velocity) in response.safety_force.iter().zip(velocity) {
                assert_eq!(*force < 0.0, velocity > 0.0);
                assert_eq!(*force == 0.0, velocity == 0.0);
            }
        }
    }
}
