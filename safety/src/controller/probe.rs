//! The probe for a hand: after a trip the force comes back to a hand only.

use nalgebra::SimdValue as _;

use crate::{
    Axes, DeviceModel, Observation, ParameterError, Real,
    controller::{ControllerKind, SafetySettings},
    lanes::norm,
    parameter::{in_range, positive},
};

/// How long each half of the probe lasts, in s.
const HALF_S: f64 = 0.1;
/// Rise and fall of each half in s, so that nothing of it is felt as a knock.
const EDGE_S: f64 = 0.01;
/// From when on the resistance counts, in s: `F_h` is late, and a model whose mass is wrong errs while the device speeds up.
const JUDGED_FROM_S: f64 = 0.03;
/// Until when it counts in the half that brings the device back, in s: before it can be at a stop again that it leaned on.
const BACK_S: f64 = 0.08;
/// Damping in mu while the device is probed: what a free one can reach is slower by as much, and what a hand adds is not.
pub const PROBED_DAMPING: f64 = 1.25;
/// How long a hand must drive the device without a break, in s.
const DRIVEN_S: f64 = 0.06;
/// How long the device must be still before a probe, in s.
const STILL_S: f64 = 0.05;
/// Below so much of `A / mu` the device is still.
const STILL_SHARE: f64 = 0.2;
/// From one try to the next, in s; so long after an intervention the next has all its tries.
const INTERVAL_S: f64 = 1.0;
/// What a model of Coulomb friction may be wrong by, in shares of it, with room for what else is wrong.
pub const FRICTION_ROOM: f64 = 2.0;
/// How much longer a hand may bear nothing more of what comes back than it bears more, in s.
const UNBORNE_S: f64 = 0.5;
/// Up to so much of the power at which a controller trips the force comes back.
const TAKEN_SHARE: f64 = 0.9;
/// Within the last quarter of what it may come back by, it does so more slowly.
const EASE_SLOPE: f64 = 4.0;
/// Below that ease nothing more is borne.
const LEAST_EASE: f64 = 0.05;
/// Ease where no hand was felt: nothing of the force comes back.
pub(crate) const NOT_FELT: f64 = f64::NEG_INFINITY;

/// Whether a hand holds the device, asked while an intervention keeps `F_v` away and damps.
///
/// **Still hands are probed.** Once the device is still, `F_p = +-A d - 0.25 mu V` is added, A a trapezoid of 100 ms for each sign, first
/// with d against the push that tripped (a stylus that was thrown against its stop moves away from it, so the stop cannot
/// pass for a hand), then back. In each half, from 30 ms on and in the second to 80 ms, `r = mean |F_h . d| / A` is what a hand adds. A
/// free device has r = 0 but for errors of the model, `|eps| + (|c - c^| + gravity + 3 sigma_F) / A`; a hand adds its mass,
/// damping and stiffness, or the motion that it was in. It is felt where `r > r_th`; each half is judged by itself.
///
/// **Moving hands are listened to.** With `F_v` away and damping on, a free device slows down. A hand drives it where
/// `F_h . V / |V| > r_th A + mu |V| / 2` for 60 ms without a break: a stop gives no energy for so long, and of a free device
/// `F_h` is at most `|eps| mu |V|` beside what `r_th A` covers. Without a probe (A = 0) c stands for `r_th A`: a free device shows
/// `c^ - c + |eps| (mu |V| + c)` at most, a hand `c^ + mu |V|`.
///
/// **What comes back must be borne.** Once a hand was felt, the force comes back over the ramp as long as the hand takes it up.
/// Of P that is let through, `U = P - max(0, -F_h . F_v / |F_v|)` is not borne, and turns into speed: `U = m A + mu V`. The ramp
/// slows down from three quarters of `A / 1.25` (of 4 c without a probe) and rests at all of it, so that a device that nobody
/// holds becomes no faster than by the probe. So it does where the hand has yielded so far that a spring of `mu / HALF_S` in N/m
/// would bear as much more than P: what is softer is no hand. It slows down likewise as `P . V` nears 0.9 of the power at which a controller
/// trips that watches: `V_t F_t` of VFC, `-delta / w dT` of WSC. Where nothing more was borne for 0.5 s it was no hand.
///
/// Nothing fades without a yes. Tries are 1 s apart. After `release_tries` without the force being back for 1 s it is withheld until the
/// authority has been at zero, which is what a hold of the ladder leads to, or a [`reset`](Self::reset). The probe moves a
/// free device by less than `A / 1.25 mu` in speed and `A HALF_S / 1.25 mu` in way.
///
/// Source: derived here; the trials of `safety/tests/all/probe.rs` and `benches/regrasp.py` have its error rates.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct GraspProbe<const N: usize> {
    /// A; 0 only listens.
    force_n: f64,
    /// `r_th`.
    threshold: f64,
    /// What a free device that slows down shows along its motion at most, beside what goes with its speed.
    free_n: f64,
    /// Of what comes back, so much turns a free device as fast as the probe, in N.
    bear_n: f64,
    /// The power in W at which a controller trips that watches; infinite where none does by power.
    power_w: f64,
    damping: f64,
    /// Tries before the force is withheld; none is no end of them.
    limit: Option<u32>,
    period_s: f64,
    phase: Phase,
    /// Ticks in this phase.
    ticks: u32,
    tries: u32,
    still_for: u32,
    driven_for: u32,
    calm_for: u32,
    /// d.
    direction: Axes<N>,
    /// Sum of `|F_h . d|` over the ticks that count.
    resisted_n: f64,
    /// By how much the hand has yielded to what came back.
    yielded_m: f64,
    unborne_for: u32,
    /// Whether the last try has felt a hand.
    has_felt: bool,
}

/// What is going on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    /// No intervention.
    Idle,
    /// The device is being brought to rest.
    Settling,
    /// The probe acts.
    Probing,
    /// No hand was felt; the next try is to come.
    Waiting,
    /// A hand was felt: the force may come back.
    Felt,
    /// No hand was felt in all tries.
    Withheld,
}

/// What is known of the intervention at a tick.
#[derive(Clone, Copy)]
pub(super) struct Intervening {
    /// It was on at the last tick.
    pub(super) is_on: bool,
    /// Its least duration is over.
    pub(super) may_end: bool,
    /// This tick is unsafe.
    pub(super) is_unsafe: bool,
    /// Share of `F_v` that was let through at the last tick.
    pub(super) let_through: f64,
    /// Share of the damping that may act.
    pub(super) authority: f64,
}

impl<const N: usize> GraspProbe<N> {
    /// The probe of these settings; None where they have none.
    pub(super) fn new(
        device: &DeviceModel<N>,
        period_s: f64,
        settings: &SafetySettings,
    ) -> Result<Option<Self>, ParameterError> {
        let allowed = "above 0 and below 1";
        let threshold = in_range(
            "probe_threshold",
            "r_th",
            settings.probe_threshold,
            f64::MIN_POSITIVE,
            1.0 - f64::EPSILON,
            allowed,
        )?;
        let limit = (settings.release_tries > 0).then_some(settings.release_tries);
        let probes = settings.probe_force_n != 0.0;
        if !probes && limit.is_none() {
            return Ok(None);
        }
        let least = if probes { FRICTION_ROOM * device.largest_coulomb() / threshold } else { 0.0 };
        let allowed = "0, or at least 2 c / r_th: a weaker probe cannot tell a hand from friction";
        let force_n = in_range("probe_force_n", "A", settings.probe_force_n, least, f64::MAX, allowed)?;
        let window_s = settings.window as f64 * period_s;
        let power_w = |kind| match kind {
            ControllerKind::Vfc => settings.velocity_threshold * settings.vfc_force_threshold_n,
            ControllerKind::Wsc => -settings.energy_threshold_j / window_s,
            ControllerKind::Hsc | ControllerKind::Pc => f64::INFINITY,
        };
        Ok(Some(Self {
            force_n,
            threshold,
            // Friction that is not there looks like a hand of c.
            free_n: if probes { threshold * force_n } else { device.largest_coulomb() },
            bear_n: if probes {
                force_n / PROBED_DAMPING
            } else {
                2.0 * FRICTION_ROOM * device.largest_coulomb()
            },
            power_w: TAKEN_SHARE * settings.controllers.iter().map(power_w).fold(f64::INFINITY, f64::min),
            damping: if probes { positive("damping", "mu", settings.damping)? } else { settings.damping },
            limit,
            period_s,
            phase: Phase::Idle,
            ticks: 0,
            tries: 0,
            still_for: 0,
            driven_for: 0,
            calm_for: 0,
            direction: Axes::zeros(),
            resisted_n: 0.0,
            yielded_m: 0.0,
            unborne_for: 0,
            has_felt: false,
        }))
    }

    /// Whether so many ticks are so long.
    fn lasts(&self, ticks: u32, seconds: f64) -> bool {
        f64::from(ticks) * self.period_s >= seconds - self.period_s / 2.0
    }

    /// Whether so long is over at this tick.
    fn ends(&self, seconds: f64) -> bool {
        self.lasts(self.ticks, seconds) && !self.lasts(self.ticks - 1, seconds)
    }

    /// `F_p` in N of this tick, and how fast the force may come back.
    fn step(&mut self, seen: &Observation<N>, now: Intervening) -> (Axes<N>, f64) {
        let force = self.probed(seen, now);
        let ease = match self.phase {
            Phase::Idle => 1.0,
            Phase::Felt => self.ease(seen, now.let_through),
            Phase::Settling | Phase::Probing | Phase::Waiting | Phase::Withheld => NOT_FELT,
        };
        (force, ease)
    }

    /// How fast the force may come back, of which so much is let through: 0 to 1, or not at all.
    fn ease(&mut self, seen: &Observation<N>, let_through: f64) -> f64 {
        let push_n = norm(&seen.rendered_force);
        // Without friction and damping nothing tells what is borne.
        if push_n == 0.0 || self.bear_n == 0.0 {
            return 1.0;
        }
        let along = seen.rendered_force / push_n;
        let returned_n = push_n * let_through;
        // What drives the device along the push bears nothing of it.
        let borne_n = -seen.grasp_force.dot(&along);
        let speed = seen.velocity.dot(&along);
        self.yielded_m = (self.yielded_m + speed * self.period_s).max(0.0);
        let yielded_n = self.damping / HALF_S * self.yielded_m;
        let unborne = (returned_n - borne_n.max(0.0)).max(yielded_n - returned_n) / self.bear_n;
        let power_w = returned_n * speed;
        let bears = EASE_SLOPE * (1.0 - unborne);
        self.unborne_for =
            if bears < LEAST_EASE { self.unborne_for + 1 } else { self.unborne_for.saturating_sub(1) };
        if self.lasts(self.unborne_for, UNBORNE_S) {
            self.give_up();
            return NOT_FELT;
        }
        bears.min(EASE_SLOPE * (1.0 - power_w / self.power_w)).clamp(0.0, 1.0)
    }

    fn probed(&mut self, seen: &Observation<N>, now: Intervening) -> Axes<N> {
        let Intervening { is_on, may_end, is_unsafe, authority, .. } = now;
        if !is_on && !is_unsafe {
            self.phase = Phase::Idle;
            self.calm_for = self.calm_for.saturating_add(1);
            if self.lasts(self.calm_for, INTERVAL_S) {
                self.tries = 0;
            }
            return Axes::zeros();
        }
        self.calm_for = 0;
        self.watch(seen);
        self.ticks = self.ticks.saturating_add(1);
        match self.phase {
            Phase::Idle | Phase::Felt if is_unsafe => self.begin(seen),
            // Without a peer it is for a person to begin anew, and then all tries are there again.
            Phase::Withheld if authority <= 0.0 => {
                self.tries = 0;
                // Who cannot be probed has said by the press that there is a hand.
                self.enter(if self.probes() { Phase::Settling } else { Phase::Felt });
            }
            Phase::Settling if authority < 1.0 => self.ticks = 0,
            Phase::Settling if may_end && !is_unsafe => {
                if self.is_driven() {
                    self.attempt(Phase::Felt);
                } else if self.probes() && self.lasts(self.still_for, STILL_S) {
                    self.attempt(Phase::Probing);
                } else if self.lasts(self.ticks, INTERVAL_S) {
                    // What never rests and is not driven: nobody can say that there is a hand.
                    self.attempt(Phase::Settling);
                }
            }
            Phase::Probing if authority < 1.0 => {
                // Cut off, so it was no try.
                self.tries = self.tries.saturating_sub(1);
                self.enter(Phase::Settling);
            }
            Phase::Probing => return self.probe(seen),
            Phase::Waiting if self.is_driven() && !is_unsafe && authority >= 1.0 => self.attempt(Phase::Felt),
            Phase::Waiting if self.lasts(self.ticks, INTERVAL_S - 2.0 * HALF_S) => {
                self.enter(Phase::Settling);
            }
            _ => {}
        }
        Axes::zeros()
    }

    /// Takes it that a hand is there or not, as it was found elsewhere.
    fn agree(&mut self, is_felt: bool) {
        match self.phase {
            Phase::Settling | Phase::Probing | Phase::Waiting if is_felt => self.enter(Phase::Felt),
            Phase::Felt if !is_felt => self.give_up(),
            _ => {}
        }
    }

    /// The try is over, and the force is not back.
    fn give_up(&mut self) {
        self.enter(if self.limit == Some(self.tries) { Phase::Withheld } else { Phase::Waiting });
    }

    /// Whether a tick without an intervention would change nothing that counts.
    fn is_at_rest(&self) -> bool {
        self.phase == Phase::Idle && self.tries == 0
    }

    /// Whether it is given up.
    pub(super) fn is_withheld(&self) -> bool {
        self.phase == Phase::Withheld
    }

    /// Whether it is given up although the last try has felt a hand.
    pub(super) fn yields(&self) -> bool {
        self.is_withheld() && self.has_felt
    }

    pub(super) fn reset(&mut self) {
        (self.phase, self.ticks, self.tries) = (Phase::Idle, 0, 0);
        (self.still_for, self.driven_for, self.calm_for) = (0, 0, 0);
        (self.direction, self.resisted_n) = (Axes::zeros(), 0.0);
        (self.yielded_m, self.unborne_for, self.has_felt) = (0.0, 0, false);
    }

    fn enter(&mut self, phase: Phase) {
        (self.phase, self.ticks) = (phase, 0);
        match phase {
            Phase::Felt => (self.yielded_m, self.unborne_for, self.has_felt) = (0.0, 0, true),
            Phase::Probing => self.has_felt = false,
            Phase::Idle | Phase::Settling | Phase::Waiting | Phase::Withheld => {}
        }
    }

    /// An intervention begins, or the force that came back has tripped.
    fn begin(&mut self, seen: &Observation<N>) {
        let against = |vector: &Axes<N>| vector.try_normalize(0.0).map(|along| -along);
        self.direction =
            against(&seen.rendered_force).or_else(|| against(&seen.velocity)).unwrap_or_else(|| {
                let mut first = Axes::zeros();
                first[0] = 1.0;
                first
            });
        (self.still_for, self.driven_for) = (0, 0);
        self.enter(Phase::Settling);
    }

    /// Goes on to `phase` with a try less, or gives up.
    fn attempt(&mut self, phase: Phase) {
        if self.limit == Some(self.tries) {
            self.enter(Phase::Withheld);
            return;
        }
        self.tries = self.tries.saturating_add(1);
        self.resisted_n = 0.0;
        self.enter(phase);
    }

    /// Follows whether the device rests and whether it is driven.
    fn watch(&mut self, seen: &Observation<N>) {
        let speed = norm(&seen.velocity);
        let count = |ticks: u32, goes_on: bool| if goes_on { ticks.saturating_add(1) } else { 0 };
        self.still_for = count(self.still_for, speed < STILL_SHARE * self.force_n / self.damping);
        let along_n = seen.grasp_force.dot(&seen.velocity);
        let free_n = self.free_n + self.damping * speed / 2.0;
        // At rest `c sign V` of an estimate that dies out is as large as what is asked for.
        let moves = self.probes() || speed * self.damping > STILL_SHARE * self.free_n;
        let is_driven = self.phase != Phase::Probing && moves && along_n > free_n * speed;
        self.driven_for = count(self.driven_for, is_driven);
    }

    /// Without damping a free device does not slow down, and nothing tells it from one that is driven.
    fn is_driven(&self) -> bool {
        self.damping > 0.0 && self.lasts(self.driven_for, DRIVEN_S)
    }

    fn probes(&self) -> bool {
        self.force_n > 0.0
    }

    fn probe(&mut self, seen: &Observation<N>) -> Axes<N> {
        let first_half = !self.lasts(self.ticks, HALF_S);
        let (begun_s, judged_s) =
            if first_half || self.ends(HALF_S) { (0.0, HALF_S) } else { (HALF_S, BACK_S) };
        if self.lasts(self.ticks, begun_s + JUDGED_FROM_S) && !self.lasts(self.ticks, begun_s + judged_s) {
            self.resisted_n += seen.grasp_force.dot(&self.direction).abs();
        } else if self.ends(begun_s + judged_s) {
            let counted = (judged_s - JUDGED_FROM_S) / self.period_s;
            // The way back begins with a step of 2 A, so that a wrong mass errs by twice as much.
            let room = if first_half || self.ends(HALF_S) { 1.0 } else { 2.0 };
            if self.resisted_n > room * self.threshold * self.force_n * counted {
                self.enter(Phase::Felt);
                return Axes::zeros();
            }
            self.resisted_n = 0.0;
        }
        if self.lasts(self.ticks, 2.0 * HALF_S) {
            self.give_up();
            return Axes::zeros();
        }
        let time_s = f64::from(self.ticks) * self.period_s - if first_half { 0.0 } else { HALF_S };
        let share = (time_s.min(HALF_S - time_s) / EDGE_S).clamp(0.0, 1.0);
        let damped = seen.velocity * ((PROBED_DAMPING - 1.0) * self.damping);
        self.direction * (if first_half { self.force_n } else { -self.force_n } * share) - damped
    }
}

/// The probes of all lanes.
///
/// Each has a state of its own: what a lane does depends on what it has felt.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct GraspProbes<const N: usize, S> {
    lanes: Box<[GraspProbe<N>]>,
    /// Nothing goes on in any lane, and each has all its tries.
    at_rest: bool,
    /// `F_p` in N of this tick.
    pub(super) force: Axes<N, S>,
}

impl<const N: usize> GraspProbes<N, f64> {
    pub(super) fn one(probe: GraspProbe<N>) -> Self {
        Self { lanes: Box::new([probe]), at_rest: true, force: Axes::zeros() }
    }
}

impl<const N: usize, S: Real> GraspProbes<N, S> {
    /// As many as there are lanes; else None.
    pub(super) fn gather(of: &[&GraspProbes<N, f64>]) -> Option<Self> {
        let lanes: Box<[_]> = of.iter().flat_map(|one| one.lanes.iter().cloned()).collect();
        let mut force = Axes::<N, S>::zeros();
        for (lane, one) in of.iter().enumerate() {
            force.replace(lane, one.force);
        }
        let at_rest = of.iter().all(|one| one.at_rest);
        (lanes.len() == S::LANES).then_some(Self { lanes, at_rest, force })
    }

    /// Whether there is nothing to do at this tick; `any` is whether an intervention is on, or begins, in any lane. Then the
    /// force may come back everywhere.
    #[inline(always)]
    pub(super) fn rests(&self, any: bool) -> bool {
        self.at_rest && !any
    }

    /// How fast the force may come back after this tick.
    pub(super) fn step(
        &mut self,
        seen: &Observation<N, S>,
        mut intervening: impl FnMut(usize) -> Intervening,
    ) -> S {
        let mut eases = S::splat(NOT_FELT);
        for (lane, probe) in self.lanes.iter_mut().enumerate() {
            let seen = Observation {
                velocity: seen.velocity.extract(lane),
                rendered_force: seen.rendered_force.extract(lane),
                grasp_force: seen.grasp_force.extract(lane),
                aligned_rendered_force: seen.aligned_rendered_force.extract(lane),
            };
            let (force, ease) = probe.step(&seen, intervening(lane));
            self.force.replace(lane, force);
            eases.replace(lane, ease);
        }
        self.at_rest = self.lanes.iter().all(GraspProbe::is_at_rest);
        eases
    }

    /// Takes it that a hand is there or not, as another probe has it.
    pub(super) fn agree(&mut self, is_felt: bool) {
        self.lanes.iter_mut().for_each(|probe| probe.agree(is_felt));
    }

    /// Where the last try has felt a hand.
    pub(super) fn yields(&self) -> S::SimdBool {
        self.mask(GraspProbe::yields)
    }

    /// Where no hand was felt in all tries.
    pub(super) fn withheld(&self) -> S::SimdBool {
        self.mask(GraspProbe::is_withheld)
    }

    fn mask(&self, is_set: impl Fn(&GraspProbe<N>) -> bool) -> S::SimdBool {
        let mut set = S::splat(0.0);
        for (lane, probe) in self.lanes.iter().enumerate() {
            set.replace(lane, f64::from(u8::from(is_set(probe))));
        }
        set.simd_gt(S::splat(0.0))
    }

    pub(super) fn reset(&mut self) {
        self.lanes.iter_mut().for_each(GraspProbe::reset);
        (self.at_rest, self.force) = (true, Axes::zeros());
    }
}
