//! Probe for a hand: after a trip the force returns only to a hand.

use nalgebra::SimdValue as _;

use crate::{
    Axes, DeviceModel, Observation, ParameterError, Real,
    controller::{ControllerKind, SafetySettings},
    parameter::{in_range, positive},
};
use haptether_numeric::{norm, pack, padded};

/// Duration of each half of the probe in s.
const HALF_S: f64 = 0.1;
/// Rise and fall time of each half in s, so that the probe is not felt as a knock.
const EDGE_S: f64 = 0.01;
/// Start in s of the evaluation of a half. Earlier, `F_h` lags, and a wrong model mass causes an error while the
/// device accelerates.
const JUDGED_FROM_S: f64 = 0.03;
/// End in s of the evaluation of the second half; later, the device may be back at the stop it was leaning on.
const BACK_S: f64 = 0.08;
/// Damping during the probe in units of mu. It reduces the speed of a free device by this factor, but not the force
/// of a hand.
pub const PROBED_DAMPING: f64 = 1.25;
/// Time in s for which a hand must drive the device without interruption.
const DRIVEN_S: f64 = 0.06;
/// Time in s for which the device must be still before a probe.
const STILL_S: f64 = 0.05;
/// The device is still below this share of `A / mu`.
const STILL_SHARE: f64 = 0.2;
/// Time in s between tries. After this time without an intervention, all tries are available again.
const INTERVAL_S: f64 = 1.0;
/// Assumed error of the Coulomb friction model as a factor of c, with room for other errors.
pub const FRICTION_ROOM: f64 = 2.0;
/// Limit in s on the net time in which the hand takes up no further force. Time in which it takes
/// up force is subtracted.
const UNBORNE_S: f64 = 0.5;
/// The force returns up to this share of the power at which a controller trips.
const TAKEN_SHARE: f64 = 0.9;
/// Slope of the ease near a limit: the release ramp slows down within the limit's last quarter. The
/// ease is a factor from 0 to 1 on the speed of the ramp.
const EASE_SLOPE: f64 = 4.0;
/// Ease below which the hand counts as taking up no further force.
const LEAST_EASE: f64 = 0.05;
/// Ease without a felt hand: no force returns.
pub(crate) const NOT_FELT: f64 = f64::NEG_INFINITY;

/// Detection of a hand on the device while an intervention removes `F_v` and damps.
///
/// **Still hand: probe.** Once the device is still, the probe adds `F_p = +-A d - 0.25 mu V`. A is a trapezoid of
/// 100 ms for each sign. The first half pushes along d, against the push that tripped, and the second half pushes
/// back. A stylus that was thrown against its stop moves away from it, so the stop is not mistaken for a hand. In
/// each half, `r = mean |F_h . d| / A` is the share that a hand adds. The mean starts after 30 ms; in the second half
/// it ends at 80 ms.
///
/// A free device has r = 0 except for model errors, `|eps| + (|c - c^| + gravity + 3 sigma_F) / A`: eps is the
/// relative error of the mass, c the friction, c^ that of the model, `sigma_F` the noise of `F_h`. A hand adds its
/// mass, damping and stiffness, or its present motion. It is felt if `r > r_th` in the first half, or `r > 2 r_th` in
/// the second.
///
/// **Moving hand: drive.** With `F_v` removed and damping on, a free device slows down. A hand drives it if
/// `F_h . V / |V| > r_th A + mu |V| / 2` for 60 ms without interruption. A stop does not deliver energy for so long.
/// On a free device, `F_h` is at most `|eps| mu |V|` beyond the part that `r_th A` covers. Without a probe (A = 0), c^
/// replaces `r_th A`: a free device shows at most `c^ - c + |eps| (mu |V| + c)`; a hand that drives the device shows
/// `c^ + mu |V|`.
///
/// **The hand must bear the returning force.** After a hand is felt, the force returns over the ramp while the hand
/// takes it up. P is the force let through. The unborne part is `U = P - max(0, -F_h . F_v / |F_v|)`; it accelerates
/// the device, `U = m dV/dt + mu V`. The ramp slows down from U = three quarters of `A / 1.25` (of 4 c^ without a
/// probe) and stops at `A / 1.25`. A device that nobody holds therefore moves no faster than under
/// the probe. The ramp also stops if the hand yields so far that a spring of `mu / HALF_S` in N/m
/// would bear `P + A / 1.25`. A softer grip is not a hand.
///
/// The ramp slows down likewise as `P . V` nears 0.9 of the power at which an active controller trips: `V_t F_t` of
/// VFC, `-delta / (w dT)` of WSC, with the energy threshold delta and the window w. If the hand takes up no further
/// force for a net 0.5 s, it counts as no hand.
///
/// The intervention does not fade before a hand is felt. Tries are 1 s apart; a force that is back for 1 s clears
/// their count. After `release_tries` the force is withheld until the authority has been zero, as in a hold of the
/// ladder, or until a [`reset`](Self::reset). The probe moves a free device by less than `A / (1.25 mu)` in speed and
/// `A HALF_S / (1.25 mu)` in distance.
///
/// Source: derived here; the trials of `safety/tests/all/probe.rs` and `benches/regrasp.py` state its error rates.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct GraspProbe<const N: usize> {
    /// Force A in N; 0 applies no probe.
    force_n: f64,
    /// `r_th`.
    threshold: f64,
    /// Largest `F_h . V / |V|` in N that a free, slowing device shows, without the term that grows with speed.
    free_n: f64,
    /// Unborne force in N that makes a free device as fast as the probe does.
    bear_n: f64,
    /// Smallest power in W at which an active controller trips, times [`TAKEN_SHARE`]; infinite if none trips by
    /// power.
    power_w: f64,
    damping: f64,
    /// Number of tries before the force is withheld; None is no limit.
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
    /// Sum of `|F_h . d|` over the evaluated ticks.
    resisted_n: f64,
    /// Distance by which the hand has yielded to the returning force.
    yielded_m: f64,
    unborne_for: u32,
    /// True if the last try felt a hand.
    has_felt: bool,
}

/// State of the probe.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    /// No intervention.
    Idle,
    /// The device comes to rest.
    Settling,
    /// The probe acts.
    Probing,
    /// The last try failed (no hand felt, or the hand did not bear the force); the next follows.
    Waiting,
    /// A hand was felt; the force may return.
    Felt,
    /// All tries are used up; the last may have felt a hand that did not bear the force.
    Withheld,
}

/// State of the intervention at a tick.
#[derive(Clone, Copy)]
pub(super) struct Intervening {
    /// The intervention was on at the last tick.
    pub(super) is_on: bool,
    /// The hold-off is over.
    pub(super) may_end: bool,
    /// This tick is unsafe.
    pub(super) is_unsafe: bool,
    /// Share of `F_v` that the last tick let through.
    pub(super) let_through: f64,
    /// Share of the damping that may act.
    pub(super) authority: f64,
}

impl<const N: usize> GraspProbe<N> {
    /// Build the probe from the settings; return None if they require no hand.
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
            // The others do not limit the power.
            _ => f64::INFINITY,
        };
        Ok(Some(Self {
            force_n,
            threshold,
            // If the device has less friction than the model, the difference, up to c^, looks like a hand.
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

    /// Return whether `ticks` last at least `seconds`.
    fn lasts(&self, ticks: u32, seconds: f64) -> bool {
        f64::from(ticks) * self.period_s >= seconds - self.period_s / 2.0
    }

    /// Return whether the phase reaches `seconds` at this tick.
    fn ends(&self, seconds: f64) -> bool {
        self.lasts(self.ticks, seconds) && !self.lasts(self.ticks - 1, seconds)
    }

    /// Compute `F_p` in N of this tick, and the ease with which the force may return.
    fn step(&mut self, seen: &Observation<N>, now: Intervening) -> (Axes<N>, f64) {
        let force = self.probed(seen, now);
        let ease = match self.phase {
            Phase::Idle => 1.0,
            Phase::Felt => self.ease(seen, now.let_through),
            Phase::Settling | Phase::Probing | Phase::Waiting | Phase::Withheld => NOT_FELT,
        };
        (force, ease)
    }

    /// Compute the ease, 0 to 1, with which the force may return, or [`NOT_FELT`].
    fn ease(&mut self, seen: &Observation<N>, let_through: f64) -> f64 {
        let push_n = norm(&seen.rendered_force);
        // Without a push there is nothing to bear. Without probe and friction there is no limit.
        if push_n == 0.0 || self.bear_n == 0.0 {
            return 1.0;
        }
        let along = seen.rendered_force / push_n;
        let returned_n = push_n * let_through;
        // A hand that drives the device along the push bears nothing of it.
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
            // Zero authority is a hold of the ladder. The operator must press again, so all tries become available.
            Phase::Withheld if authority <= 0.0 => {
                self.tries = 0;
                // Without a probe, the press of the operator confirms the hand.
                self.enter(if self.probes() { Phase::Settling } else { Phase::Felt });
            }
            Phase::Settling if authority < 1.0 => self.ticks = 0,
            Phase::Settling if may_end && !is_unsafe => {
                if self.is_driven() {
                    self.attempt(Phase::Felt);
                } else if self.probes() && self.lasts(self.still_for, STILL_S) {
                    self.attempt(Phase::Probing);
                } else if self.lasts(self.ticks, INTERVAL_S) {
                    // The device neither rests nor is driven, so a hand cannot be confirmed.
                    self.attempt(Phase::Settling);
                }
            }
            Phase::Probing if authority < 1.0 => {
                // The probe was interrupted and does not count as a try.
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

    /// Adopt the result of another probe: a hand is felt or not.
    fn adopt_result(&mut self, is_felt: bool) {
        match self.phase {
            Phase::Settling | Phase::Probing | Phase::Waiting if is_felt => self.enter(Phase::Felt),
            Phase::Felt if !is_felt => self.give_up(),
            _ => {}
        }
    }

    /// End the try; the force does not return.
    fn give_up(&mut self) {
        self.enter(if self.limit == Some(self.tries) { Phase::Withheld } else { Phase::Waiting });
    }

    /// Return whether a tick without an intervention would change no relevant state.
    fn is_at_rest(&self) -> bool {
        self.phase == Phase::Idle && self.tries == 0
    }

    /// Return whether the force is withheld.
    pub(super) fn is_withheld(&self) -> bool {
        self.phase == Phase::Withheld
    }

    /// Return whether the force is withheld although the last try felt a hand.
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

    /// Begin when an intervention starts, or when the returning force trips again.
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

    /// Use up a try and enter `phase`, or withhold the force.
    fn attempt(&mut self, phase: Phase) {
        if self.limit == Some(self.tries) {
            self.enter(Phase::Withheld);
            return;
        }
        self.tries = self.tries.saturating_add(1);
        self.resisted_n = 0.0;
        self.enter(phase);
    }

    /// Count the ticks for which the device rests and for which it is driven.
    fn watch(&mut self, seen: &Observation<N>) {
        let speed = norm(&seen.velocity);
        let count = |ticks: u32, goes_on: bool| if goes_on { ticks.saturating_add(1) } else { 0 };
        self.still_for = count(self.still_for, speed < STILL_SHARE * self.force_n / self.damping);
        let along_n = seen.grasp_force.dot(&seen.velocity);
        let free_n = self.free_n + self.damping * speed / 2.0;
        // Near rest, the friction term `c sign V` of a decaying estimate is as large as the threshold.
        let moves = self.probes() || speed * self.damping > STILL_SHARE * self.free_n;
        let is_driven = self.phase != Phase::Probing && moves && along_n > free_n * speed;
        self.driven_for = count(self.driven_for, is_driven);
    }

    /// Return whether a hand drives the device. Without damping a free device does not slow down and looks driven.
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
            // The second half begins with a step of 2 A, so a wrong mass causes twice the error.
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

/// Probes of all lanes.
///
/// Each lane has its own state, since its course depends on what it has felt.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct GraspProbes<const N: usize, S> {
    lanes: Box<[GraspProbe<N>]>,
    /// No lane has an intervention, and each has all its tries.
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
    /// Gather one probe per lane; return None if there are more probes than lanes.
    pub(super) fn gather(of: &[&GraspProbes<N, f64>]) -> Option<Self> {
        let lanes = padded(of, S::LANES).flat_map(|one| one.lanes.iter().cloned()).collect();
        let force = pack(of, |one| one.force)?;
        Some(Self { lanes, at_rest: of.iter().all(|one| one.at_rest), force })
    }

    /// Return whether this tick needs no step; the force may then return in every lane.
    ///
    /// `any` is true if an intervention is on, or begins, in any lane.
    #[inline(always)]
    pub(super) fn rests(&self, any: bool) -> bool {
        self.at_rest && !any
    }

    /// Compute the ease of each lane after this tick.
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

    /// Adopt the result of another probe: a hand is felt or not.
    pub(super) fn adopt_result(&mut self, is_felt: bool) {
        self.lanes.iter_mut().for_each(|probe| probe.adopt_result(is_felt));
    }

    /// Mask of lanes in which the last try felt a hand and the force is withheld.
    pub(super) fn yields(&self) -> S::SimdBool {
        self.mask(GraspProbe::yields)
    }

    /// Mask of lanes in which the force is withheld.
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
