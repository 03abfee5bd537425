//! Combination of the controllers: any of them trips, one law responds.

use nalgebra::{SimdBool as _, SimdValue as _};

use crate::{
    Axes, DeviceModel, Fault, Observation, ParameterError, Real,
    controller::{
        BuiltControllers, ControllerKind, Controllers, PerController, Tripped, Verdicts, cancel_and_damp,
        dampable,
        probe::{GraspProbe, GraspProbes, Intervening},
    },
    observer::VelocityForceForm,
    parameter::{in_range, positive},
};
use haptether_numeric::{choose, choose_axes, no_lanes, option, pack};

/// Set of controllers, their thresholds, and the times of an intervention.
///
/// Only the controllers of the set are built, and only the observers that they read are computed.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Deserialize, schemars::JsonSchema))] // the outer table refuses unknown keys
pub struct SafetySettings {
    /// Controllers in use.
    pub controllers: Controllers,
    /// mu in N s/m, of Eq. 2, 13, 14.
    pub damping: f64,
    /// `V_t` in m/s, of Eq. 1.
    pub velocity_threshold: f64,
    /// `F_t` in N, of Eq. 1.
    pub vfc_force_threshold_n: f64,
    /// Form of Eq. 1.
    pub vfc_form: VelocityForceForm,
    /// zeta, of Eq. 8.
    pub grasp_threshold: f64,
    /// alpha in N, of Eq. 5.
    pub grasp_floor_n: f64,
    /// `F_t` in N, of Eq. 14.
    pub hsc_force_threshold_n: f64,
    /// `V_s` in m/s: HSC accepts a push up to this speed along `F_v`. 0 is Eq. 14 as printed.
    pub hsc_velocity_threshold: f64,
    /// delta in J, of Eq. 10.
    pub energy_threshold_j: f64,
    /// `F_w` in N: WSC accepts a push along the motion up to this force. 0 is Eq. 13 as printed.
    pub wsc_force_threshold_n: f64,
    /// eta, of Eq. 9.
    pub energy_ratio: f64,
    /// w in ticks, of Eq. 11.
    pub window: usize,
    /// alpha in N s/m: upper bound of the damping of Eq. 12.
    pub pc_max_damping: f64,
    /// Minimum duration of an intervention in s.
    pub hold_off_s: f64,
    /// Minimum fade-out time of an intervention in s. 0 returns the rendered force as a step.
    pub release_ramp_s: f64,
    /// Force A in N of the probe that a hand must answer before an intervention fades. 0 applies no probe and detects
    /// a hand only by its motion.
    pub probe_force_n: f64,
    /// `r_th`: smallest share of the probe that counts as a hand.
    pub probe_threshold: f64,
    /// Number of tries before the force is withheld; a force that is back for 1 s clears the count.
    /// 0 is no limit. Without a probe, 0 also lets the force return without a hand.
    pub release_tries: u32,
}

impl SafetySettings {
    /// Convert the thresholds to a rotation whose handle is held at lever r in m.
    ///
    /// Torque is r F, angular velocity V / r and damping r² mu; energies and times stay.
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

    /// Scale the thresholds to a device with `force` times the forces and `way` times the distances.
    ///
    /// Times stay. Velocity scales by `way`, energy by `force way`, damping by `force / way`.
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
    /// Return the thresholds of the paper (section 4), without controller, hold-off, ramp or probe.
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
/// While VFC, HSC or WSC trips, `F_c = -F_v - mu V`. The intervention lasts at least the hold-off, then fades over
/// the release ramp: `F_c = g (-F_v - mu V)` with `g = 1 - s²`, s from 0 to 1. A new trip sets g to 1 at once. PC
/// adds its own force, scaled by 1 - g.
///
/// With a probe ([`SafetySettings::probe_force_n`]) or a limit of tries ([`SafetySettings::release_tries`]), an
/// intervention waits for a hand. It fades only after a hand is felt, and no faster than the hand bears the force.
/// Otherwise g stays 1, also after the last try.
/// Source: paper Eq. 2, 12, 13, 14.
#[derive(Clone, Debug, PartialEq)]
pub struct SafetyController<const N: usize, S = f64> {
    controllers: BuiltControllers<N, S>,
    damping: S,
    hold_off_ticks: S,
    ramp_ticks: S,
    /// Ticks since the current intervention began, including the first; 0 without an intervention.
    on_for: S,
    /// Elapsed ticks of the ramp since the intervention began to fade.
    fading_for: S,
    /// Share of `F_v` that the last tick let through.
    let_through: S,
    /// Present only if a hand must be felt before an intervention fades.
    probe: Option<GraspProbes<N, S>>,
}

/// Authority at which a probe neither starts, nor counts, nor is given up.
pub(crate) const UNDECIDED: f64 = 0.5;

impl<const N: usize> SafetyController<N> {
    /// Longest hold-off or ramp in s.
    pub const MAX_HOLD_S: f64 = 60.0;

    /// Build the controllers of `settings`, for a device sampled every `period_s`.
    pub fn new(
        device: &DeviceModel<N>,
        period_s: f64,
        settings: &SafetySettings,
    ) -> Result<Self, ParameterError> {
        let period_s = positive("period_s", "dT", period_s)?;
        let ticks = |name, value| {
            let value = in_range(name, "time", value, 0.0, Self::MAX_HOLD_S, "between 0 and 60 s")?;
            // Ticks are counted in S, since each lane has its own count.
            Ok((value / period_s).round())
        };
        let controllers = BuiltControllers::new(device, period_s, settings)?;
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

    /// Compute `F_c` of this tick. A value that is not finite or out of range is a fault and changes no state.
    pub fn step(&mut self, seen: &Observation<N>) -> Result<Intervention<N>, Fault> {
        self.step_with_authority(seen, 1.0)
    }

    /// Compute `F_c` as [`step`](Self::step), with the damping scaled by `authority` (0 to 1).
    ///
    /// Cancelling `F_v` needs no authority, since it only removes a force. Damping is a force: without a peer it
    /// fades as the rendered force does.
    pub fn step_with_authority(
        &mut self,
        seen: &Observation<N>,
        authority: f64,
    ) -> Result<Intervention<N>, Fault> {
        seen.check()?;
        // With exact signals, the hand responds to the force that the last tick asked of the device.
        let share = self.felt_share();
        let damping = self.damping * authority * (1.0 - share);
        let aligned_rendered_force = seen.aligned_rendered_force * share - seen.velocity * damping;
        Ok(self.respond(&Observation { aligned_rendered_force, ..*seen }, authority).lane(0))
    }
}

impl<const N: usize, S: Real> SafetyController<N, S> {
    /// Gather one controller per lane; return None unless all have built the same controllers.
    ///
    /// Thresholds and times may differ; period, window and form of VFC must be equal.
    pub fn gather(of: &[&SafetyController<N>]) -> Option<Self> {
        Some(Self {
            controllers: BuiltControllers::gather(
                &of.iter().map(|one| &one.controllers).collect::<Vec<_>>(),
            )?,
            damping: pack(of, |one| one.damping)?,
            hold_off_ticks: pack(of, |one| one.hold_off_ticks)?,
            ramp_ticks: pack(of, |one| one.ramp_ticks)?,
            on_for: pack(of, |one| one.on_for)?,
            fading_for: pack(of, |one| one.fading_for)?,
            let_through: pack(of, |one| one.let_through)?,
            probe: option(of, |one| one.probe.as_ref(), GraspProbes::gather)?,
        })
    }

    /// Compute `F_c` of this tick without checks, with the damping scaled by `authority` (0 to 1).
    ///
    /// `seen.aligned_rendered_force` is the force [asked](Self::asked_force) of the device, with the lag of `F_h`.
    #[inline(always)]
    pub fn respond(&mut self, seen: &Observation<N, S>, authority: S) -> Response<N, S> {
        if S::LANES == 1 && self.controllers.is_empty() && self.probe.is_none() {
            return Response::none();
        }
        let verdicts = self.judge(seen);
        let is_unsafe = verdicts.is_unsafe();
        let ease = self.step_probe(seen, authority, is_unsafe);
        self.answer(seen, authority, &verdicts, Judged { is_unsafe, ease })
    }

    /// Step each controller. Call [`answer`](Self::answer) afterwards.
    #[inline(always)]
    pub(crate) fn judge(&mut self, seen: &Observation<N, S>) -> Verdicts<N, S> {
        let rendered_force = seen.rendered_force * self.felt_share();
        self.controllers.step(&Observation { rendered_force, ..*seen })
    }

    /// Return the speed at which an intervention may fade, as a share of its ramp.
    ///
    /// It is at most 1, and [`NOT_FELT`] in lanes where no hand is felt. None means that no hand is required. Call
    /// [`answer`](Self::answer) afterwards.
    #[inline(always)]
    pub(crate) fn step_probe(
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
        // Copies: an argument passed by address would be kept in memory at every tick.
        let (seen, on_for, let_through, authority) = (*seen, self.on_for, self.let_through, authority);
        Some(probe.step(&seen, |lane| Intervening {
            is_on: on_for.extract(lane) > 0.0,
            may_end: may_end.bitmask() >> lane & 1 == 1,
            is_unsafe: is_unsafe.bitmask() >> lane & 1 == 1,
            let_through: let_through.extract(lane),
            authority: authority.extract(lane),
        }))
    }

    /// Carry controllers and probe over a missed tick without a decision.
    ///
    /// At full authority a hand may be felt, and without authority the tries restart. [`UNDECIDED`] is neither.
    #[inline(always)]
    pub(crate) fn skip_tick(&mut self, seen: &Observation<N, S>) {
        let verdicts = self.judge(seen);
        let is_unsafe = verdicts.is_unsafe();
        let ease = self.step_probe(seen, S::splat(UNDECIDED), is_unsafe);
        self.answer(seen, S::splat(1.0), &verdicts, Judged { is_unsafe, ease });
    }

    /// Adopt the result of another device that the same hand holds: a hand is felt or not.
    pub(crate) fn adopt_result(&mut self, is_felt: bool) {
        if let Some(probe) = self.probe.as_mut() {
            probe.adopt_result(is_felt);
        }
    }

    /// Compute `F_c` from the verdicts and the joint decision, of this device alone or together with another.
    #[inline(always)]
    pub(crate) fn answer(
        &mut self,
        seen: &Observation<N, S>,
        authority: S,
        verdicts: &Verdicts<N, S>,
        judged: Judged<S>,
    ) -> Response<N, S> {
        let (nothing, all) = (S::splat(0.0), S::splat(1.0));
        let (mut gain, mut is_on) = (nothing, no_lanes::<S>());
        let mut safety_force = Axes::<N, S>::zeros();
        // Most ticks need no intervention and then do not wait for the observers.
        let intervenes = (judged.is_unsafe | self.on_for.simd_gt(nothing)).any();
        if intervenes {
            gain = self.gain(judged);
            // Otherwise it is already 1, since an intervention ends with a gain of 0.
            self.let_through = all - gain;
            is_on = gain.simd_gt(nothing);
            let answer = cancel_and_damp(seen, self.damping * authority) * gain;
            for axis in 0..N {
                // Avoid -0.0 without an intervention, for clean records.
                safety_force[axis] = answer[axis].select(is_on, nothing);
            }
        }
        let held = is_on & !verdicts.is_unsafe();
        let (mut withheld, mut yields) = (no_lanes::<S>(), no_lanes::<S>());
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
            research: no_lanes::<S>(),
            observed: verdicts.observed(),
        };
        verdicts.add_forces(&self.controllers, gain, authority, &mut response);
        response
    }

    /// Return the share of `F_v` that the device was asked to render; every controller observes this share.
    ///
    /// While an intervention cancels `F_v`, the hand has nothing to hold against, and no push can eject the device.
    /// If all of `F_v` counted, `S_h` and `S_vf` would stay large, and a hand that returns would
    /// never get its force back. Without a ramp or a probe, Eq. 2, 13 and 14 hold as printed.
    #[inline(always)]
    fn felt_share(&self) -> S {
        self.let_through.select(self.on_for.simd_gt(S::splat(0.0)) & self.fades(), S::splat(1.0))
    }

    /// Mask of lanes where the force returns over a ramp or after a probe, unlike the printed equations.
    #[inline(always)]
    fn fades(&self) -> S::SimdBool {
        if self.probe.is_some() { !no_lanes::<S>() } else { self.ramp_ticks.simd_gt(S::splat(0.0)) }
    }

    /// Return the force that the hand had to hold at a tick, for comparison with `F_h`.
    ///
    /// It is `F_device` where an intervention fades, else `F_v` as printed.
    #[inline(always)]
    pub(crate) fn asked_force(&self, rendered_force: &Axes<N, S>, device_force: &Axes<N, S>) -> Axes<N, S> {
        choose_axes!(S, self.fades(), *device_force, *rendered_force)
    }

    /// Update the course of the intervention and return its gain g.
    #[inline(always)]
    fn gain(&mut self, judged: Judged<S>) -> S {
        let (nothing, all) = (S::splat(0.0), S::splat(1.0));
        let Self { on_for, fading_for, hold_off_ticks, ramp_ticks, .. } = *self;
        let Judged { is_unsafe, ease } = judged;
        let stays = on_for.simd_lt(hold_off_ticks);
        let faded = (fading_for + ease.unwrap_or(all)).larger(nothing);
        let is_over = faded.simd_gt(ramp_ticks);
        // Each lane is in one of four states: it trips, no intervention is on, the intervention stays, or it fades.
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
        // The fade starts slowly: a hand needs some 50 ms to take up a load, and looks absent until then.
        by_state!(all, nothing, all, {
            let share = faded / (ramp_ticks + all);
            nothing.select(is_over, all - share * share)
        })
    }

    /// Return the share of `F_v` that the last tick let through.
    #[inline(always)]
    pub(crate) fn let_through(&self) -> S {
        self.let_through
    }

    /// Return the controllers in use.
    pub fn kinds(&self) -> Controllers {
        self.controllers.kinds()
    }

    /// Return whether a controller or the probe reads the grasp force.
    #[inline(always)]
    pub fn needs_grasp_force(&self) -> bool {
        self.controllers.reads_grasp_force() || self.probe.is_some()
    }

    /// Return the energy in J that PC requested (`E_so`) and that the force `delivered` beyond `F_v` did not
    /// dissipate.
    ///
    /// It is 0 without PC.
    #[inline(always)]
    pub fn owed_energy_j(
        &self,
        observed: &PerController<S>,
        delivered: &Axes<N, S>,
        velocity: &Axes<N, S>,
    ) -> S {
        self.controllers.owed_energy_j(observed, delivered, velocity)
    }

    /// Clear all energies and end any intervention.
    pub fn reset(&mut self) {
        self.controllers.reset();
        if let Some(probe) = &mut self.probe {
            probe.reset();
        }
        (self.on_for, self.fading_for, self.let_through) = (S::splat(0.0), S::splat(0.0), S::splat(1.0));
    }
}

/// Decision that follows from the verdicts for one hand.
#[derive(Clone, Copy)]
pub(crate) struct Judged<S: Real> {
    /// Mask of lanes in which the tick is unsafe.
    pub(crate) is_unsafe: S::SimdBool,
    /// Speed at which an intervention may fade: [`SafetyController::step_probe`].
    pub(crate) ease: Option<S>,
}

/// Force and observations of the safety controllers at one tick.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Intervention<const N: usize> {
    /// `F_c` in N.
    pub safety_force: Axes<N>,
    /// Controllers that tripped.
    pub tripped: Tripped,
    /// All tries are used up. The force stays away until the authority is zero, or until a reset.
    pub withheld: bool,
    /// The last try felt a hand, which then did not bear the force.
    pub yields: bool,
    /// `S_vf`, `S_h`, `E_wso` and `E_so` in J; NaN for a controller that is not built.
    pub observed: PerController<f64>,
}

impl<const N: usize> Intervention<N> {
    /// Return no force and no observation.
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

/// Force and observations of the safety controllers at one tick, in each lane.
#[derive(Clone, Copy, Debug)]
pub struct Response<const N: usize, S: Real = f64> {
    /// `F_c` in N.
    pub safety_force: Axes<N, S>,
    /// If false, `acts` is false in every lane.
    pub may_act: bool,
    /// Lanes in which any controller acts.
    pub acts: S::SimdBool,
    /// Lanes in which each controller calls the tick unsafe, or adds its own force.
    pub tripped: PerController<S::SimdBool>,
    /// Lanes in which an intervention is on, but no controller calls the tick unsafe.
    ///
    /// The hold-off or the release ramp has not ended, or another device of the same hand tripped.
    pub held: S::SimdBool,
    /// Lanes in which all tries are used up. The force stays away until the authority is zero, or until a reset.
    pub withheld: S::SimdBool,
    /// Lanes in which the last try felt a hand, which then did not bear the force.
    pub yields: S::SimdBool,
    /// Lanes in which a [research controller](crate::controller::ResearchController) adds its own force.
    pub research: S::SimdBool,
    /// Values of the observers; NaN for a controller that is not built.
    pub observed: PerController<S>,
}

impl<const N: usize, S: Real> Response<N, S> {
    /// Return no force and no observation.
    #[inline(always)]
    fn none() -> Self {
        let no_lanes = no_lanes::<S>();
        Self {
            safety_force: Axes::zeros(),
            may_act: false,
            acts: no_lanes,
            tripped: PerController::repeat(no_lanes),
            held: no_lanes,
            withheld: no_lanes,
            yields: no_lanes,
            research: no_lanes,
            observed: PerController::repeat(S::splat(f64::NAN)),
        }
    }

    /// Return the intervention in one lane.
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

    /// Add the `force` of a controller, scaled by the share `1 - gain` that an intervention leaves.
    #[inline(always)]
    pub(super) fn add_force(&mut self, kind: ControllerKind, force: &Axes<N, S>, gain: S, authority: S) {
        let (nothing, all) = (S::splat(0.0), S::splat(1.0));
        let mut pushes = no_lanes::<S>();
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
