//! Controllers combined: any of them trips, one law answers.

use nalgebra::{SimdBool as _, SimdValue as _};

use crate::{
    Axes, DeviceModel, Fault, Observation, ParameterError, Real,
    controller::{
        Built, ControllerKind, Controllers, PerController, Tripped, Verdicts, cancel_and_damp, dampable,
        probe::{GraspProbe, GraspProbes, Intervening},
    },
    lanes::{choose, choose_axes, nowhere, option, pack},
    observer::VelocityForceForm,
    parameter::{in_range, positive},
};

/// Which controllers watch, their thresholds, and how an intervention begins and ends.
///
/// A controller that does not watch is not built, and an observer that no controller reads is not computed.
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
    /// `V_s` in m/s: speed along `F_v` up to which HSC lets a push pass; 0 is Eq. 14 as printed.
    pub hsc_velocity_threshold: f64,
    /// delta in J, of Eq. 10.
    pub energy_threshold_j: f64,
    /// `F_w` in N: push along the motion up to which WSC lets a motion pass; 0 is Eq. 13 as printed.
    pub wsc_force_threshold_n: f64,
    /// eta, of Eq. 9.
    pub energy_ratio: f64,
    /// w in ticks, of Eq. 11.
    pub window: usize,
    /// alpha in N s/m: bound on the damping of Eq. 12.
    pub pc_max_damping: f64,
    /// Least duration of an intervention in s.
    pub hold_off_s: f64,
    /// Least time in s over which an intervention fades out; 0 returns the rendered force as a step.
    pub release_ramp_s: f64,
    /// A in N of the probe that a hand must answer before an intervention fades; 0 only listens for one that moves.
    pub probe_force_n: f64,
    /// `r_th`: share of the probe that a hand holds against, at least.
    pub probe_threshold: f64,
    /// After so many tries without the force being back for 1 s it is withheld; 0 is no end, and without a probe asks for no
    /// hand.
    pub release_tries: u32,
}

impl SafetySettings {
    /// The thresholds of a rotation whose handle is held at this lever r in m: torque is r F, angular velocity V / r,
    /// damping r² mu; energies and times are the same.
    #[must_use]
    pub fn at_lever(self, lever_m: f64) -> Self {
        Self {
            damping: self.damping * lever_m * lever_m,
            velocity_threshold: self.velocity_threshold / lever_m,
            vfc_force_threshold_n: self.vfc_force_threshold_n * lever_m,
            grasp_floor_n: self.grasp_floor_n * lever_m,
            hsc_force_threshold_n: self.hsc_force_threshold_n * lever_m,
            hsc_velocity_threshold: self.hsc_velocity_threshold / lever_m,
            wsc_force_threshold_n: self.wsc_force_threshold_n * lever_m,
            pc_max_damping: self.pc_max_damping * lever_m * lever_m,
            probe_force_n: self.probe_force_n * lever_m,
            ..self
        }
    }

    /// The thresholds of a device whose forces are `force` and whose ways are `way` times those of the device that these
    /// are meant for, in the same times: velocity by `way`, energy by `force way`, damping by `force / way`.
    #[must_use]
    pub fn at_scale(self, force: f64, way: f64) -> Self {
        Self {
            damping: self.damping * force / way,
            velocity_threshold: self.velocity_threshold * way,
            vfc_force_threshold_n: self.vfc_force_threshold_n * force,
            grasp_floor_n: self.grasp_floor_n * force,
            hsc_force_threshold_n: self.hsc_force_threshold_n * force,
            hsc_velocity_threshold: self.hsc_velocity_threshold * way,
            wsc_force_threshold_n: self.wsc_force_threshold_n * force,
            energy_threshold_j: self.energy_threshold_j * force * way,
            pc_max_damping: self.pc_max_damping * force / way,
            probe_force_n: self.probe_force_n * force,
            ..self
        }
    }
}

impl Default for SafetySettings {
    /// The paper's thresholds (section 4), no controller, no hold-off, no ramp, no probe.
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
            hsc_velocity_threshold: 0.0,
            energy_threshold_j: -0.03,
            wsc_force_threshold_n: 0.0,
            energy_ratio: 0.5,
            window: 100,
            pc_max_damping: 10.0,
            hold_off_s: 0.0,
            release_ramp_s: 0.0,
            probe_force_n: 0.0,
            probe_threshold: 0.2,
            release_tries: 0,
        }
    }
}

/// Controllers combined by "any of".
///
/// While one of VFC, HSC, WSC trips, `F_c = -F_v - mu V`. It stays so for at least the hold-off, then fades over
/// the release ramp: `F_c = g (-F_v - mu V)` with `g = 1 - s²`, s from 0 to 1. A new trip sets g to 1 at once. PC adds
/// its own force in the share 1 - g that the intervention leaves.
///
/// With a probe ([`SafetySettings::probe_force_n`]) or a number of tries ([`SafetySettings::release_tries`]) it fades only once a
/// hand was felt, and no faster than that hand bears; until then, and after so many tries, g = 1.
///
/// Source: paper Eq. 2, 12, 13, 14.
#[derive(Clone, Debug, PartialEq)]
pub struct SafetyController<const N: usize, S = f64> {
    controllers: Built<N, S>,
    damping: S,
    hold_off_ticks: S,
    ramp_ticks: S,
    /// Ticks since the current intervention began, the first counted; 0 while none is on.
    on_for: S,
    /// Ticks of the ramp that are over since the intervention began to fade.
    fading_for: S,
    /// Share of `F_v` that the last tick let through.
    let_through: S,
    /// Only where a hand must be felt before an intervention fades.
    probe: Option<GraspProbes<N, S>>,
}

/// Authority at which a probe neither begins, nor counts, nor is given up.
pub(crate) const UNDECIDED: f64 = 0.5;

impl<const N: usize> SafetyController<N> {
    /// Longest hold-off or ramp in s.
    pub const MAX_HOLD_S: f64 = 60.0;

    /// Builds what `settings` name, for a device sampled every `period_s`.
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
        let controllers = Built::new(device, period_s, settings)?;
        let damps = ControllerKind::cancelling().any(|kind| settings.controllers.contains(kind));
        let damping = dampable("damping", "mu", settings.damping, device, period_s, damps)?;
        Ok(Self {
            controllers,
            damping,
            hold_off_ticks: ticks("hold_off_s", settings.hold_off_s)?,
            ramp_ticks: ticks("release_ramp_s", settings.release_ramp_s)?,
            on_for: 0.0,
            fading_for: 0.0,
            let_through: 1.0,
            probe: GraspProbe::new(device, period_s, settings)?.filter(|_| damps).map(GraspProbes::one),
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
        // Exact signals: the hand answers what the last tick asked the device to render.
        let share = self.felt_share();
        let damping = self.damping * authority * (1.0 - share);
        let aligned_rendered_force = seen.aligned_rendered_force * share - seen.velocity * damping;
        Ok(self.respond(&Observation { aligned_rendered_force, ..*seen }, authority).lane(0))
    }
}

impl<const N: usize, S: Real> SafetyController<N, S> {
    /// As many controllers as there are lanes, which have built the same; else None. Thresholds and times may differ,
    /// the period, the window and the form of VFC may not.
    pub fn gather(of: &[&SafetyController<N>]) -> Option<Self> {
        Some(Self {
            controllers: Built::gather(&of.iter().map(|one| &one.controllers).collect::<Vec<_>>())?,
            damping: pack(of, |one| one.damping)?,
            hold_off_ticks: pack(of, |one| one.hold_off_ticks)?,
            ramp_ticks: pack(of, |one| one.ramp_ticks)?,
            on_for: pack(of, |one| one.on_for)?,
            fading_for: pack(of, |one| one.fading_for)?,
            let_through: pack(of, |one| one.let_through)?,
            probe: option(of, |one| one.probe.as_ref(), GraspProbes::gather)?,
        })
    }

    /// `F_c` for this tick, with damping in the share `authority` (0 to 1) only; nothing is checked.
    ///
    /// `seen.aligned_rendered_force` is what the device was [asked](Self::asked) to render, as late as `F_h`.
    #[inline(always)]
    pub fn respond(&mut self, seen: &Observation<N, S>, authority: S) -> Response<N, S> {
        if S::LANES == 1 && self.controllers.is_empty() && self.probe.is_none() {
            return Response::none();
        }
        let verdicts = self.judge(seen);
        let is_unsafe = verdicts.is_unsafe();
        let ease = self.feel(seen, authority, is_unsafe);
        self.answer(seen, authority, &verdicts, Judged { is_unsafe, ease })
    }

    /// What each controller makes of this tick. An [`answer`](Self::answer) must follow.
    #[inline(always)]
    pub(crate) fn judge(&mut self, seen: &Observation<N, S>) -> Verdicts<N, S> {
        let rendered_force = seen.rendered_force * self.felt_share();
        self.controllers.step(&Observation { rendered_force, ..*seen })
    }

    /// How fast an intervention may fade, in shares of its ramp: at most 1, and [`NOT_FELT`] where no hand was felt; None where
    /// no hand is asked for. An [`answer`](Self::answer) must follow.
    #[inline(always)]
    pub(crate) fn feel(
        &mut self,
        seen: &Observation<N, S>,
        authority: S,
        is_unsafe: S::SimdBool,
    ) -> Option<S> {
        let probe = self.probe.as_mut()?;
        let may_end = self.on_for.simd_ge(self.hold_off_ticks);
        let any = (is_unsafe | self.on_for.simd_gt(S::splat(0.0))).any();
        if probe.rests(any) {
            return Some(S::splat(1.0));
        }
        // Copies: what a call gets the address of would have to stand in memory at each tick.
        let (seen, on_for, let_through, authority) = (*seen, self.on_for, self.let_through, authority);
        Some(probe.step(&seen, |lane| Intervening {
            is_on: on_for.extract(lane) > 0.0,
            may_end: may_end.bitmask() >> lane & 1 == 1,
            is_unsafe: is_unsafe.bitmask() >> lane & 1 == 1,
            let_through: let_through.extract(lane),
            authority: authority.extract(lane),
        }))
    }

    /// Carries all along over a tick that was missed, and decides nothing: whoever is in full authority may be felt, and who
    /// has none may try anew, so it is neither.
    #[inline(always)]
    pub(crate) fn carry(&mut self, seen: &Observation<N, S>) {
        let verdicts = self.judge(seen);
        let is_unsafe = verdicts.is_unsafe();
        let ease = self.feel(seen, S::splat(UNDECIDED), is_unsafe);
        self.answer(seen, S::splat(1.0), &verdicts, Judged { is_unsafe, ease });
    }

    /// Takes it that a hand is there or not, as the probe of another device that it holds has it.
    pub(crate) fn agree(&mut self, is_felt: bool) {
        if let Some(probe) = self.probe.as_mut() {
            probe.agree(is_felt);
        }
    }

    /// `F_c` for verdicts and what is made of them: by this device alone, or also by another that the same hand holds.
    #[inline(always)]
    pub(crate) fn answer(
        &mut self,
        seen: &Observation<N, S>,
        authority: S,
        verdicts: &Verdicts<N, S>,
        judged: Judged<S>,
    ) -> Response<N, S> {
        let (nothing, all) = (S::splat(0.0), S::splat(1.0));
        let (mut gain, mut is_on) = (nothing, nowhere::<S>());
        let mut safety_force = Axes::<N, S>::zeros();
        // Most ticks need no answer: what follows then waits for no observer.
        let intervenes = (judged.is_unsafe | self.on_for.simd_gt(nothing)).any();
        if intervenes {
            gain = self.gain(judged);
            // Else it is 1 already: an intervention ends with a gain of 0.
            self.let_through = all - gain;
            is_on = gain.simd_gt(nothing);
            let answer = cancel_and_damp(seen, self.damping * authority) * gain;
            for axis in 0..N {
                // Not -0.0 where nothing is on: records stay clean.
                safety_force[axis] = answer[axis].select(is_on, nothing);
            }
        }
        let held = is_on & !verdicts.is_unsafe();
        let (mut withheld, mut yields) = (nowhere::<S>(), nowhere::<S>());
        if let Some(probe) = &self.probe {
            safety_force += probe.force * authority;
            (withheld, yields) = (probe.withheld(), probe.yields());
        }
        let mut response = Response {
            safety_force,
            may_act: intervenes,
            acts: is_on,
            tripped: verdicts.tripped(),
            held,
            withheld,
            yields,
            research: nowhere::<S>(),
            observed: verdicts.observed(),
        };
        verdicts.add_forces(&self.controllers, gain, authority, &mut response);
        response
    }

    /// Share of `F_v` that the device was asked to render: what every controller watches.
    ///
    /// While an intervention cancels `F_v`, a hand has nothing to hold against, and a push that is not there throws nothing.
    /// Against all of `F_v`, `S_h` and `S_vf` would stay large, and the hand that has come back would never get its force again.
    /// Without a ramp or a probe, Eq. 2, 13 and 14 stand as printed.
    #[inline(always)]
    fn felt_share(&self) -> S {
        self.let_through.select(self.on_for.simd_gt(S::splat(0.0)) & self.fades(), S::splat(1.0))
    }

    /// Where the force comes back over a ramp or to a hand, not as printed.
    #[inline(always)]
    fn fades(&self) -> S::SimdBool {
        if self.probe.is_some() { !nowhere::<S>() } else { self.ramp_ticks.simd_gt(S::splat(0.0)) }
    }

    /// The force that a hand had to answer at a tick, to be compared with `F_h`: what the device was asked to render, and as
    /// printed `F_v`.
    #[inline(always)]
    pub(crate) fn asked(&self, rendered_force: &Axes<N, S>, device_force: &Axes<N, S>) -> Axes<N, S> {
        choose_axes!(S, self.fades(), *device_force, *rendered_force)
    }

    /// Share of the intervention that is on at this tick.
    #[inline(always)]
    fn gain(&mut self, judged: Judged<S>) -> S {
        let (nothing, all) = (S::splat(0.0), S::splat(1.0));
        let Self { on_for, fading_for, hold_off_ticks, ramp_ticks, .. } = *self;
        let Judged { is_unsafe, ease } = judged;
        let stays = on_for.simd_lt(hold_off_ticks);
        let faded = (fading_for + ease.unwrap_or(all)).larger(nothing);
        let is_over = faded.simd_gt(ramp_ticks);
        // One of four in each lane: it trips, nothing is on, it stays on, it fades.
        macro_rules! by_state {
            ($trips:expr, $rests:expr, $stays:expr, $fades:expr) => {
                choose!(
                    S,
                    is_unsafe,
                    $trips,
                    choose!(S, on_for.simd_eq(nothing), $rests, choose!(S, stays, $stays, $fades))
                )
            };
        }
        self.on_for = by_state!(
            nothing.select(fading_for.simd_gt(nothing), on_for) + all,
            nothing,
            on_for + all,
            nothing.select(is_over, on_for)
        );
        self.fading_for = by_state!(nothing, nothing, fading_for, nothing.select(is_over, faded));
        // Fading slowly at first: a hand needs some 50 ms to take up a load, and one that is still taking it up looks gone.
        by_state!(all, nothing, all, {
            let share = faded / (ramp_ticks + all);
            nothing.select(is_over, all - share * share)
        })
    }

    /// Share of `F_v` that the last tick let through.
    #[inline(always)]
    pub(crate) fn let_through(&self) -> S {
        self.let_through
    }

    /// Which of them watch.
    pub fn kinds(&self) -> Controllers {
        self.controllers.kinds()
    }

    /// Whether a controller reads the grasp force.
    #[inline(always)]
    pub fn needs_grasp_force(&self) -> bool {
        self.controllers.reads_grasp_force() || self.probe.is_some()
    }

    /// Energy in J that PC requested (`E_so` of the tick) and the force `delivered` beyond `F_v` did not dissipate; 0
    /// without PC.
    #[inline(always)]
    pub fn owed_energy_j(
        &self,
        observed: &PerController<S>,
        delivered: &Axes<N, S>,
        velocity: &Axes<N, S>,
    ) -> S {
        self.controllers.owed_energy_j(observed, delivered, velocity)
    }

    /// Clears all energy and ends any intervention.
    pub fn reset(&mut self) {
        self.controllers.reset();
        if let Some(probe) = &mut self.probe {
            probe.reset();
        }
        (self.on_for, self.fading_for, self.let_through) = (S::splat(0.0), S::splat(0.0), S::splat(1.0));
    }
}

/// What is made of the verdicts of one hand.
#[derive(Clone, Copy)]
pub(crate) struct Judged<S: Real> {
    /// Where the tick is unsafe.
    pub(crate) is_unsafe: S::SimdBool,
    /// How fast an intervention may fade, as [`SafetyController::feel`] has it.
    pub(crate) ease: Option<S>,
}

/// What the safety controllers add at one tick, and what they saw.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Intervention<const N: usize> {
    /// `F_c` in N.
    pub safety_force: Axes<N>,
    /// Who tripped.
    pub tripped: Tripped,
    /// All tries are over without the force being back: there is none until the authority was at zero, or a reset.
    pub withheld: bool,
    /// The last try has felt a hand, which then did not bear the force.
    pub yields: bool,
    /// `S_vf`, `S_h`, `E_wso` and `E_so` in J; NaN where the controller is not built.
    pub observed: PerController<f64>,
}

impl<const N: usize> Intervention<N> {
    /// No force, and nothing was observed.
    pub fn none() -> Self {
        Self {
            safety_force: Axes::zeros(),
            tripped: Tripped::NONE,
            withheld: false,
            yields: false,
            observed: PerController::repeat(f64::NAN),
        }
    }
}

/// What the safety controllers add at one tick, and what they saw, in each lane.
#[derive(Clone, Copy, Debug)]
pub struct Response<const N: usize, S: Real = f64> {
    /// `F_c` in N.
    pub safety_force: Axes<N, S>,
    /// If false, `acts` is false in every lane.
    pub may_act: bool,
    /// Where any of them acts.
    pub acts: S::SimdBool,
    /// Where each called the tick unsafe, or adds a force of its own.
    pub tripped: PerController<S::SimdBool>,
    /// Where no controller does now, but the minimum time on or the release ramp has not ended, or the intervention is
    /// that of another device of the same hand.
    pub held: S::SimdBool,
    /// Where all tries are over without the force being back: there is none until the authority was at zero, or a reset.
    pub withheld: S::SimdBool,
    /// Where the last try has felt a hand, which then did not bear the force.
    pub yields: S::SimdBool,
    /// Where a [research controller](crate::controller::ResearchController) adds a force of its own.
    pub research: S::SimdBool,
    /// The observers' values; NaN where the controller is not built.
    pub observed: PerController<S>,
}

impl<const N: usize, S: Real> Response<N, S> {
    /// No force, and nothing was observed.
    #[inline(always)]
    fn none() -> Self {
        let nowhere = nowhere::<S>();
        Self {
            safety_force: Axes::zeros(),
            may_act: false,
            acts: nowhere,
            tripped: PerController::repeat(nowhere),
            held: nowhere,
            withheld: nowhere,
            yields: nowhere,
            research: nowhere,
            observed: PerController::repeat(S::splat(f64::NAN)),
        }
    }

    /// The intervention in one lane.
    #[inline]
    pub fn lane(&self, lane: usize) -> Intervention<N> {
        let is_set = |mask: S::SimdBool| mask.bitmask() >> lane & 1 == 1;
        let mut tripped = if is_set(self.held) { Tripped::HELD } else { Tripped::NONE };
        for kind in ControllerKind::ALL {
            if is_set(self.tripped[kind]) {
                tripped = tripped.and(Tripped::of(kind));
            }
        }
        if is_set(self.research) {
            tripped = tripped.and(Tripped::RESEARCH);
        }
        Intervention {
            safety_force: self.safety_force.extract(lane),
            tripped,
            withheld: is_set(self.withheld),
            yields: is_set(self.yields),
            observed: PerController(self.observed.0.map(|value| value.extract(lane))),
        }
    }

    /// Adds the `force` of a controller in the share `1 - gain` that an intervention leaves.
    #[inline(always)]
    pub(super) fn add_force(&mut self, kind: ControllerKind, force: &Axes<N, S>, gain: S, authority: S) {
        let (nothing, all) = (S::splat(0.0), S::splat(1.0));
        let mut pushes = nowhere::<S>();
        for axis in 0..N {
            pushes = pushes | force[axis].simd_ne(nothing);
        }
        let acts = gain.simd_lt(all) & pushes;
        let without = self.safety_force;
        self.tripped[kind] = acts;
        self.may_act = true;
        self.acts = self.acts | acts;
        self.safety_force = choose_axes!(S, acts, without + force * ((all - gain) * authority), without);
    }
}

#[cfg(test)]
mod tests;
