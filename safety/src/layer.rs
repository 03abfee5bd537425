//! Pipeline of one master tick, from the device sample to the commanded device force.

use nalgebra::SimdValue as _;

use crate::{
    Axes, DeviceModel, Fault, Observation, ParameterError, Real, Signal,
    controller::{
        ControllerKind, Intervention, Research, ResearchController, Response, SafetyController,
        SafetySettings,
    },
    estimator::{AnyEstimator, Estimator, EstimatorKind, MeasuredVelocity, Motion},
    limiter::{ActiveLimits, Limiter, LimiterSettings, SaturatedForce},
    plausible::{Between, Excess, Guard, Judged, MAX_HELD, Parts, Sample, SampleBounds},
};
use haptether_numeric::{option, pack, part, shared};

#[cfg(test)]
mod tests;

/// Settings of a safety layer.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LayerSettings<const N: usize> {
    /// Dynamics of the device, for the grasp force and the kinetic energy.
    pub device: DeviceModel<N>,
    /// dT in s.
    pub period_s: f64,
    /// Estimator of V and A from positions, for a device that does not measure its velocity.
    pub estimator: EstimatorKind,
    /// Observers and controllers.
    pub safety: SafetySettings,
    /// Bounds on the device force.
    pub limiter: LimiterSettings,
}

/// Speed in m/s (rad/s) below which Coulomb friction fades from the `F_h` of a coupling.
const SLOW: f64 = 0.01;

/// Default lever of a handle in m.
pub(crate) const DEFAULT_LEVER_M: f64 = 0.05;

/// Estimator, grasp force, observers, controllers and limiter in one step.
///
/// The limiter acts twice. Before the observers it reduces `F_v` to the force that the device can render. After the
/// controllers it bounds the sum that leaves.
///
/// Source: paper Eq. 1 to 14, in the order of `docs/architecture.md`, "One master tick".
#[derive(Clone, Debug)]
pub struct SafetyLayer<const N: usize, S = f64> {
    device: DeviceModel<N, S>,
    period_s: f64,
    estimator: AnyEstimator<N, S>,
    measured: MeasuredVelocity<N, S>,
    /// Second copy of the estimator, whose kernel filters the asked force; present only where a controller compares
    /// that force with `F_h`.
    rendered: Option<AnyEstimator<N, S>>,
    last_rendered: Axes<N, S>,
    /// Force that the device was asked to render at the last tick.
    asked_force: Axes<N, S>,
    /// Limiter of `F_v` alone: norm, growth and ramp-in.
    rendering: Limiter<N, S>,
    controller: SafetyController<N, S>,
    /// Limiter of the sum `F_v + F_c`.
    limiter: Limiter<N, S>,
    device_force: Axes<N, S>,
    fault: Option<Fault>,
    /// Present only in simulated runs that configure one.
    research: Option<Research>,
    /// True if `F_h` is estimated although no controller reads it.
    needs_grasp_force: bool,
    /// Largest acceleration in m/s² (rad/s²) by the motors alone.
    acceleration: f64,
    /// Sample guard and held ticks; used by a scalar layer only.
    entry: Entry<N>,
}

/// Entry of the samples: the guard, and the ticks whose samples are held.
#[derive(Clone, Debug)]
struct Entry<const N: usize> {
    guard: Guard<N>,
    last: LastTick<N>,
    held: [HeldTick<N>; MAX_HELD + 1],
    count: usize,
    /// Index in `held` of the tick that is being caught up with.
    recalled: Option<usize>,
    excess: Option<Excess>,
}

/// Values of the last tick that a held tick repeats.
#[derive(Clone, Copy, Debug)]
struct LastTick<const N: usize> {
    motion: Motion<N>,
    grasp_force: Axes<N>,
    intervention: Intervention<N>,
    authority: f64,
}

impl<const N: usize> LastTick<N> {
    fn still() -> Self {
        let SafetyTick { motion, grasp_force, intervention, .. } = SafetyTick::still();
        Self { motion, grasp_force, intervention, authority: 0.0 }
    }
}

/// Forces of a tick whose sample is held.
#[derive(Clone, Copy, Debug)]
struct HeldTick<const N: usize> {
    /// Ticks since the last accepted sample.
    at: f64,
    /// `F_v` in N at this tick.
    rendered_force: Axes<N>,
    /// `F_device` in N up to this tick.
    device_force: Axes<N>,
    /// Force in N that the device was asked to render up to this tick.
    asked_force: Axes<N>,
}

impl<const N: usize> Entry<N> {
    fn new(guard: Guard<N>) -> Self {
        let zeros = Axes::zeros();
        let nothing = HeldTick { at: 0.0, rendered_force: zeros, device_force: zeros, asked_force: zeros };
        let (last, held) = (LastTick::still(), [nothing; MAX_HELD + 1]);
        Self { guard, last, held, count: 0, recalled: None, excess: None }
    }

    fn hold(&mut self, tick: HeldTick<N>) {
        self.held[self.count] = tick;
        self.count += 1;
    }

    /// Restore the state before the first tick.
    fn clear(&mut self, at: &Sample<N>) {
        self.guard.restart_at(at);
        (self.last, self.count, self.recalled, self.excess) = (LastTick::still(), 0, None, None);
    }
}

impl<const N: usize> SafetyLayer<N> {
    /// Create a layer for a device at rest, without force.
    pub fn new(settings: &LayerSettings<N>) -> Result<Self, ParameterError> {
        let LayerSettings { device, period_s, estimator, safety, limiter } = settings;
        let layer = Self {
            device: *device,
            period_s: *period_s,
            estimator: estimator.build(*period_s)?,
            measured: MeasuredVelocity::new(*period_s)?,
            rendered: safety
                .controllers
                .iter()
                .any(ControllerKind::reads_aligned_force)
                .then(|| estimator.build(*period_s))
                .transpose()?,
            last_rendered: Axes::zeros(),
            asked_force: Axes::zeros(),
            controller: SafetyController::new(device, *period_s, safety)?,
            rendering: Limiter::new(*period_s, *limiter)?,
            limiter: Limiter::new(*period_s, LimiterSettings { ramp_in_s: 0.0, ..*limiter })?,
            device_force: Axes::zeros(),
            fault: None,
            research: None,
            needs_grasp_force: false,
            acceleration: limiter.max_force_n / device.lightest(),
            entry: Entry::new(Guard::new(SampleBounds::UNBOUNDED, SampleBounds::UNBOUNDED, *period_s)),
        };
        Ok(layer.with_samples(SampleBounds::of_axes(N)))
    }

    /// Widen the bounds so that the motors alone cannot exceed them:
    /// [`SampleBounds::with_acceleration`].
    pub(crate) fn reachable(&self, bounds: SampleBounds) -> SampleBounds {
        bounds.with_acceleration(self.acceleration, self.period_s)
    }

    /// Set the sample bounds of position and rotation. Call this before the first tick.
    #[must_use]
    pub(crate) fn guarded(mut self, bounds: SampleBounds, rotation: SampleBounds, period_s: f64) -> Self {
        self.entry = Entry::new(Guard::new(self.reachable(bounds), rotation, period_s));
        self
    }

    /// Replace the default sample bounds, [`SampleBounds::of_axes`]. Call this before the first tick.
    #[must_use]
    pub fn with_samples(self, bounds: SampleBounds) -> Self {
        let period_s = self.period_s;
        self.guarded(bounds, SampleBounds::UNBOUNDED, period_s)
    }

    /// Estimate `F_h` at every tick, for a coupling that uses it. Call this before the first tick.
    #[must_use]
    pub fn with_grasp_force(mut self) -> Self {
        self.needs_grasp_force = true;
        self
    }

    /// Return `F_h` in N of the last tick; zero in a fault, and if nothing needs it.
    ///
    /// Near rest the estimated V changes its sign with its noise, so Coulomb friction fades to zero below [`SLOW`].
    #[inline]
    pub fn grasp_force(&self) -> Axes<N> {
        if self.fault.is_some() || !self.needs_grasp_force {
            return Axes::zeros();
        }
        let LastTick { motion, grasp_force, .. } = &self.entry.last;
        grasp_force
            - self.device.coulomb_force(&motion.velocity) * (1.0 - motion.velocity.norm() / SLOW).max(0.0)
    }

    /// Add a controller of the caller after the built-in ones. Call this before the first tick.
    #[must_use]
    pub fn with_research(mut self, controller: Box<dyn ResearchController>) -> Self {
        self.rendered.get_or_insert_with(|| self.estimator.clone());
        self.research = Some(Research::new(controller));
        self
    }

    /// Compute one tick from position x in m, velocity V in m/s and `F_v` in N.
    ///
    /// Pass the velocity at every tick if the device measures it, else never.
    ///
    /// [`Guard`] holds a sample that leaves the path of the others and replaces it by its prediction. A value that is
    /// not finite or out of range, and a step beyond the speed bound of the device, are faults. A fault gives zero
    /// force at this tick and stays until [`reset`](Self::reset).
    pub fn tick(
        &mut self,
        position: &Axes<N>,
        velocity: Option<&Axes<N>>,
        requested_force: &Axes<N>,
    ) -> SafetyTick<N> {
        self.tick_with_authority(position, velocity, requested_force, 1.0)
    }

    /// Compute one tick as [`tick`](Self::tick), with the controllers' damping scaled by `authority` (0 to 1).
    #[inline(always)]
    pub fn tick_with_authority(
        &mut self,
        position: &Axes<N>,
        velocity: Option<&Axes<N>>,
        requested_force: &Axes<N>,
        authority: f64,
    ) -> SafetyTick<N> {
        self.tick_after(0, position, velocity, requested_force, authority)
    }

    /// Compute the tick that follows `missed` skipped ticks, during which the device kept its force.
    ///
    /// Estimator and observers advance over the skipped ticks along a straight line, without decisions. A late loop
    /// therefore does not read several ticks of motion as one.
    #[inline(always)] // the return value is large, and callers read only part of it
    pub fn tick_after(
        &mut self,
        missed: u64,
        position: &Axes<N>,
        velocity: Option<&Axes<N>>,
        requested_force: &Axes<N>,
        authority: f64,
    ) -> SafetyTick<N> {
        self.tick_coupled(missed, position, velocity, |_| *requested_force, authority)
    }

    /// Compute a tick as [`tick_after`](Self::tick_after), with `F_v` from `couple`.
    ///
    /// The layer first estimates the motion, then calls `couple` once, then observes and decides. So `couple` gets the
    /// x and V of this tick. `F_h` of this tick is not known yet: the layer computes it after `F_v`. A fault of the
    /// sample ends the tick before the call.
    #[inline(always)]
    pub fn tick_coupled(
        &mut self,
        missed: u64,
        position: &Axes<N>,
        velocity: Option<&Axes<N>>,
        couple: impl FnOnce(&Coupled<'_, N>) -> Axes<N>,
        authority: f64,
    ) -> SafetyTick<N> {
        let judged = self
            .check(position, velocity)
            .and_then(|()| self.judge(missed, Parts { position, velocity, rotation: None }));
        let perceived = match judged {
            Ok(Judged::Held(at)) => return self.hold_coupled(at, couple, authority),
            Err(fault) => return self.stop(fault),
            Ok(judged) => {
                if matches!(judged, Judged::Settled) {
                    self.catch_up();
                }
                self.perceived(position, velocity, couple, &mut PointMass)
            }
        };
        match perceived {
            Ok(perceived) => {
                let advance = self.decide(&perceived, authority);
                self.keep(&advance, authority)
            }
            Err(fault) => self.stop(fault),
        }
    }

    /// Compute a tick whose sample is held, on its prediction: the coupling gets the last V.
    #[inline(always)]
    pub(crate) fn hold_coupled(
        &mut self,
        at: f64,
        couple: impl FnOnce(&Coupled<'_, N>) -> Axes<N>,
        authority: f64,
    ) -> SafetyTick<N> {
        let requested = couple(&self.coupled(&self.sample_in_use().position, &self.entry.last.motion));
        match Signal::RenderedForce.check(&requested) {
            Ok(()) => self.hold(at, &requested, authority),
            Err(fault) => self.stop(fault),
        }
    }

    fn coupled<'a>(&'a self, position: &'a Axes<N>, motion: &'a Motion<N>) -> Coupled<'a, N> {
        Coupled { position, velocity: &motion.velocity, limiter: &self.rendering }
    }

    /// Return the stored fault, or a fault for a value that is not finite or out of range.
    #[inline(always)]
    pub(crate) fn check(&self, position: &Axes<N>, velocity: Option<&Axes<N>>) -> Result<(), Fault> {
        if let Some(fault) = self.fault {
            return Err(fault);
        }
        Signal::Position.check(position)?;
        velocity.map_or(Ok(()), |v| Signal::Velocity.check(v))
    }

    /// Judge a sample against its path; return a fault if the device cannot move so fast.
    #[inline(always)]
    pub(crate) fn judge(&mut self, missed: u64, parts: Parts<'_, N>) -> Result<Judged<N>, Fault> {
        let judged = self.entry.guard.judge(parts, (missed + 1) as f64);
        if let Judged::Stepped(excess) = &judged {
            self.entry.excess = Some(*excess);
            return Err(excess.fault());
        }
        Ok(judged)
    }

    /// Store the values of this tick for the next.
    #[inline(always)]
    pub(crate) fn keep(&mut self, advance: &Advance<N>, authority: f64) -> SafetyTick<N> {
        let tick = advance.lane(0);
        let SafetyTick { motion, grasp_force, intervention, .. } = tick;
        self.entry.last = LastTick { motion, grasp_force, intervention, authority };
        tick
    }

    /// Compute a tick whose sample is held, without estimation, observation or decision.
    ///
    /// V stays, `F_v` continues, and the damping of the intervention fades with the authority.
    #[inline(never)]
    pub(crate) fn hold(&mut self, at: f64, requested_force: &Axes<N>, authority: f64) -> SafetyTick<N> {
        let LastTick { motion, grasp_force, intervention, authority: before } = self.entry.last;
        let rendering = self.rendering.limit(requested_force, &Axes::zeros());
        let rendered_force = rendering.force;
        self.hold_forces(at, rendered_force);
        // F_c = damping - g F_v.
        let g = 1.0 - self.controller.let_through();
        let damping = intervention.safety_force + self.last_rendered * g;
        let share = if authority < before { authority / before } else { 1.0 };
        let safety_force = damping * share - rendered_force * g;
        let limited = self.limiter.limit(&(rendered_force + safety_force), &motion.velocity);
        self.device_force = limited.force;
        self.ask(&rendered_force);
        let intervention = Intervention { safety_force, ..intervention };
        self.entry.last = LastTick { motion, grasp_force, intervention, authority: authority.min(before) };
        SafetyTick {
            motion,
            rendered_force,
            grasp_force,
            device_force: limited.force,
            intervention,
            acted: rendering.acted(0).and(limited.acted(0)),
            owed_energy_j: 0.0,
            fault: None,
        }
    }

    /// Advance over the ticks since the last accepted sample.
    #[inline(never)]
    fn catch_up(&mut self) {
        let Some(between) = self.begin_to_catch_up() else { return };
        for tick in 1..between.ticks {
            let Sample { position, velocity, .. } = between.at(tick);
            self.recall(tick);
            self.missed(&position, velocity.as_ref());
        }
        self.recall(between.ticks);
    }

    /// Return the ticks to catch up with. Call [`recall`](Self::recall) before each of them and before the current
    /// tick.
    pub(crate) fn begin_to_catch_up(&mut self) -> Option<Between<N>> {
        let between = self.entry.guard.between()?;
        self.hold_until(between.ticks);
        if let Some(shift) = &between.shift {
            self.shift(&shift.position);
        }
        Some(between)
    }

    /// Store the forces in effect as those of the current tick, the last one to catch up with.
    pub(crate) fn hold_until(&mut self, tick: u64) {
        self.hold_forces(tick as f64, Axes::zeros());
    }

    fn hold_forces(&mut self, at: f64, rendered_force: Axes<N>) {
        let Self { device_force, asked_force, .. } = *self;
        self.entry.hold(HeldTick { at, rendered_force, device_force, asked_force });
    }

    /// Restore the forces that acted at a tick to catch up with.
    pub(crate) fn recall(&mut self, tick: u64) {
        let at = tick as f64;
        let entry = &mut self.entry;
        let now = entry.held[..entry.count].iter().position(|held| held.at >= at);
        if let Some(held) = now.map(|now| entry.held[now]) {
            (self.device_force, self.asked_force) = (held.device_force, held.asked_force);
            if now == Some(entry.count - 1) {
                (entry.count, entry.recalled) = (0, None);
            } else {
                entry.recalled = now.filter(|_| held.at == at);
            }
        }
    }

    /// Return whether lanes lack something that this layer has.
    fn cannot_join_lanes(&self) -> bool {
        self.fault.is_some() || self.research.is_some() || self.needs_grasp_force || self.entry.count > 0
    }

    /// Return the force in N of the coupling that the device has exerted since the last tick: the share of `F_v` in
    /// `F_device`, without the controllers' damping, which is not power of the coupling.
    #[inline]
    pub fn exerted(&self) -> Axes<N> {
        if self.fault.is_some() {
            return Axes::zeros();
        }
        let let_through = self.last_rendered * self.controller.let_through();
        let damping = self.entry.last.intervention.safety_force + self.last_rendered - let_through;
        if damping == Axes::<N>::zeros() {
            return self.device_force;
        }
        // The last limiter may cut off more than the damping.
        let squared = let_through.norm_squared();
        if squared == 0.0 {
            return Axes::zeros();
        }
        let_through * ((self.device_force - damping).dot(&let_through) / squared).clamp(0.0, 1.0)
    }

    /// Return the accepted sample, or the prediction while the newest sample is held.
    #[inline]
    pub fn sample_in_use(&self) -> &Sample<N> {
        self.entry.guard.sample_in_use()
    }

    /// Return the guard of the samples.
    pub fn guard(&self) -> &Guard<N> {
        &self.entry.guard
    }

    /// Return the speed beyond the bound of the device that caused the fault.
    pub fn excess(&self) -> Option<Excess> {
        self.entry.excess
    }

    /// Check the values and observe one tick; the sample must be on its path.
    #[inline(always)]
    pub(crate) fn checked(
        &mut self,
        position: &Axes<N>,
        velocity: Option<&Axes<N>>,
        couple: impl FnOnce(&Coupled<'_, N>) -> Axes<N>,
        inertia: &mut impl Inertia<N>,
    ) -> Result<Perceived<N, f64>, Fault> {
        self.check(position, velocity)?;
        self.perceived(position, velocity, couple, inertia)
    }

    #[inline(always)]
    fn perceived(
        &mut self,
        position: &Axes<N>,
        velocity: Option<&Axes<N>>,
        couple: impl FnOnce(&Coupled<'_, N>) -> Axes<N>,
        inertia: &mut impl Inertia<N>,
    ) -> Result<Perceived<N, f64>, Fault> {
        let motion = self.estimate(position, velocity);
        let requested = couple(&self.coupled(position, &motion));
        Signal::RenderedForce.check(&requested)?;
        let rendering = self.render(&requested);
        let seen = self.observe(position, velocity, &motion, &rendering.force, inertia);
        seen.check().map(|()| Perceived { rendering, motion, seen })
    }

    /// Carry the controllers over a missed tick: the device kept its force, and `position` lies between two
    /// samples.
    pub(crate) fn missed(&mut self, position: &Axes<N>, velocity: Option<&Axes<N>>) {
        if let Some(seen) = self.missed_observation(position, velocity, &mut PointMass) {
            self.controller.skip_tick(&seen);
        }
    }

    /// Observe a missed tick; return None if a value is invalid.
    pub(crate) fn missed_observation(
        &mut self,
        position: &Axes<N>,
        velocity: Option<&Axes<N>>,
        inertia: &mut impl Inertia<N>,
    ) -> Option<Observation<N>> {
        let recalled = self.entry.recalled.take().map(|held| self.entry.held[held].rendered_force);
        let rendered_force = recalled.unwrap_or(self.last_rendered);
        let motion = self.estimate(position, velocity);
        let seen = self.observe(position, velocity, &motion, &rendered_force, inertia);
        seen.check().ok().map(|()| seen)
    }

    /// Move the origin of the positions by `by` in m.
    pub(crate) fn shift(&mut self, by: &Axes<N>) {
        self.estimator.shift(by);
        if let Some(kernel) = &mut self.rendered {
            kernel.shift(by);
        }
    }

    /// Express the stored forces in turned axes.
    ///
    /// Forces of the last tick turn to the axes in the middle of that tick. The growth of the next force is measured
    /// in the current axes.
    pub(crate) fn turn(
        &mut self,
        to_middle: impl Fn(&Axes<N>) -> Axes<N>,
        to_now: impl Fn(&Axes<N>) -> Axes<N>,
    ) {
        self.device_force = to_middle(&self.device_force);
        self.last_rendered = to_middle(&self.last_rendered);
        self.asked_force = to_middle(&self.asked_force);
        self.rendering.turn(&to_now);
        self.limiter.turn(&to_now);
        for held in &mut self.entry.held[..self.entry.count] {
            held.rendered_force = to_now(&held.rendered_force);
            held.device_force = to_now(&held.device_force);
            held.asked_force = to_now(&held.asked_force);
        }
    }

    /// Return the fault that keeps the force at zero.
    pub(crate) fn fault(&self) -> Option<Fault> {
        self.fault
    }

    /// Set a fault that the layer cannot detect itself: no force until [`reset`](Self::reset).
    pub fn fail(&mut self, fault: Fault) {
        self.fault.get_or_insert(fault);
    }

    pub(crate) fn stop(&mut self, fault: Fault) -> SafetyTick<N> {
        self.fault = Some(fault);
        (self.device_force, self.asked_force) = (Axes::zeros(), Axes::zeros());
        self.rendering.reset();
        self.limiter.reset();
        (self.entry.last, self.entry.count) = (LastTick::still(), 0);
        SafetyTick { fault: Some(fault), ..SafetyTick::still() }
    }

    /// Clear the past as [`reset`](Self::reset) does, but keep the fault.
    pub fn restart(&mut self, position: &Axes<N>) -> Result<(), Fault> {
        let (fault, excess) = (self.fault, self.entry.excess);
        let restarted = self.reset(position);
        self.fault = fault;
        self.entry.excess = self.entry.excess.or(excess);
        restarted
    }

    /// Clear fault and past: the device rests at `position`, and its force rises from zero.
    pub fn reset(&mut self, position: &Axes<N>) -> Result<(), Fault> {
        Signal::Position.check(position)?;
        self.rest_at(position);
        self.enter_at(&Sample::point(position, None));
        self.fault = None;
        Ok(())
    }

    /// Start the path at this sample.
    pub(crate) fn enter_at(&mut self, sample: &Sample<N>) {
        self.entry.clear(sample);
    }
}

impl<const N: usize, S: Real> SafetyLayer<N, S> {
    /// Gather one layer per lane.
    ///
    /// Returns None if a layer has a fault, a research controller or a held sample, or if the parts cannot be
    /// gathered. Period, estimator and the set of controllers must be equal; thresholds, bounds, times and the device
    /// may differ.
    pub fn gather(of: &[&SafetyLayer<N>]) -> Option<Self> {
        if of.iter().any(|one| one.cannot_join_lanes()) {
            return None;
        }
        Some(Self {
            acceleration: of.first()?.acceleration,
            entry: of.first()?.entry.clone(),
            device: part(of, |one| &one.device, DeviceModel::gather)?,
            period_s: shared(of, |one| one.period_s)?,
            estimator: part(of, |one| &one.estimator, AnyEstimator::gather)?,
            measured: part(of, |one| &one.measured, MeasuredVelocity::gather)?,
            rendered: option(of, |one| one.rendered.as_ref(), AnyEstimator::gather)?,
            last_rendered: pack(of, |one| one.last_rendered)?,
            asked_force: pack(of, |one| one.asked_force)?,
            rendering: part(of, |one| &one.rendering, Limiter::gather)?,
            controller: part(of, |one| &one.controller, SafetyController::gather)?,
            limiter: part(of, |one| &one.limiter, Limiter::gather)?,
            device_force: pack(of, |one| one.device_force)?,
            fault: None,
            research: None,
            needs_grasp_force: false,
        })
    }

    /// Compute one tick in each lane as [`tick_with_authority`](SafetyLayer::tick_with_authority), without its
    /// checks.
    ///
    /// An invalid value stops no lane. The checked tick would stop where an argument is invalid or [`Advance::seen`]
    /// does not [pass](Observation::passes).
    #[inline(always)]
    pub fn advance(
        &mut self,
        position: &Axes<N, S>,
        velocity: Option<&Axes<N, S>>,
        requested_force: &Axes<N, S>,
        authority: S,
    ) -> Advance<N, S> {
        let rendering = self.render(requested_force);
        let motion = self.estimate(position, velocity);
        let seen = self.observe(position, velocity, &motion, &rendering.force, &mut PointMass);
        let perceived = Perceived { rendering, motion, seen };
        self.decide(&perceived, authority)
    }

    /// Return `F_v`, limited to what the device can render.
    #[inline(always)]
    fn render(&mut self, requested_force: &Axes<N, S>) -> SaturatedForce<N, S> {
        // The observers compare F_v with the force of the hand. A force that the device cannot render yet would look
        // like one that nobody holds, so F_v is limited first. The power bound is idle at V = 0.
        self.rendering.limit(requested_force, &Axes::zeros())
    }

    #[inline(always)]
    pub(crate) fn decide(&mut self, perceived: &Perceived<N, S>, authority: S) -> Advance<N, S> {
        let mut response = self.controller.respond(&perceived.seen, authority);
        if S::LANES == 1
            && let Some(research) = &mut self.research
        {
            research.add(&perceived.seen, self.controller.let_through(), authority, &mut response);
        }
        self.bound(perceived, response)
    }

    /// Scale a requested force by `gain`. If `gain` < 1, first clip its norm to the largest force
    /// of the device.
    #[inline(always)]
    pub fn faded(&self, requested_force: &Axes<N, S>, gain: f64) -> Axes<N, S> {
        self.rendering.faded(requested_force, gain)
    }

    /// Return the observers and controllers.
    #[inline(always)]
    pub(crate) fn controller(&mut self) -> &mut SafetyController<N, S> {
        &mut self.controller
    }

    /// Add the controllers' response to `F_v` and limit the sum.
    #[inline(always)]
    pub(crate) fn bound(&mut self, perceived: &Perceived<N, S>, response: Response<N, S>) -> Advance<N, S> {
        let Perceived { rendering, motion, seen } = *perceived;
        let rendered_force = seen.rendered_force;
        let limited = self.limiter.limit(&(rendered_force + response.safety_force), &motion.velocity);
        let delivered = limited.force - rendered_force;
        let owed_energy_j = self.controller.owed_energy_j(&response.observed, &delivered, &motion.velocity);
        self.device_force = limited.force;
        self.ask(&rendered_force);
        Advance {
            motion,
            rendered_force,
            grasp_force: seen.grasp_force,
            aligned_rendered_force: seen.aligned_rendered_force,
            device_force: limited.force,
            response,
            rendering,
            limited,
            owed_energy_j,
        }
    }

    /// Store `F_v` and the force that the device is asked to render.
    #[inline(always)]
    fn ask(&mut self, rendered_force: &Axes<N, S>) {
        self.last_rendered = *rendered_force;
        // The force of a research controller does not count as asked.
        self.asked_force = match self.research {
            None => self.controller.asked_force(rendered_force, &self.device_force),
            Some(_) => rendered_force * self.controller.let_through(),
        };
    }

    /// Estimate V and A.
    #[inline(always)]
    fn estimate(&mut self, position: &Axes<N, S>, velocity: Option<&Axes<N, S>>) -> Motion<N, S> {
        match velocity {
            Some(velocity) => self.measured.step(velocity),
            None => self.estimator.step(position),
        }
    }

    /// Compute the observation from V and A.
    #[inline(always)]
    fn observe(
        &mut self,
        position: &Axes<N, S>,
        velocity: Option<&Axes<N, S>>,
        motion: &Motion<N, S>,
        rendered_force: &Axes<N, S>,
        inertia: &mut impl Inertia<N, S>,
    ) -> Observation<N, S> {
        let grasp_force =
            if self.controller.needs_grasp_force() || self.research.is_some() || self.needs_grasp_force {
                let held = &self.device_force;
                let aligned = if velocity.is_some() {
                    inertia.align(motion, held, true, |force| self.measured.align(force))
                } else {
                    let is_late = Estimator::<N, S>::has_late_velocity(&self.estimator);
                    inertia.align(motion, held, is_late, |force| self.estimator.align(force))
                };
                self.device.grasp_force(motion, &aligned)
            } else {
                Axes::zeros()
            };
        let aligned_rendered_force = self.align_asked(position, velocity, rendered_force);
        Observation {
            velocity: motion.velocity,
            rendered_force: *rendered_force,
            grasp_force,
            aligned_rendered_force,
        }
    }

    /// Return the force asked of the device in the past ticks, filtered by the kernel of A. Without a controller
    /// that compares it with `F_h`, returns `F_v`.
    #[inline(always)]
    fn align_asked(
        &mut self,
        position: &Axes<N, S>,
        velocity: Option<&Axes<N, S>>,
        rendered_force: &Axes<N, S>,
    ) -> Axes<N, S> {
        match (&mut self.rendered, velocity) {
            // F_h is a mean over the last tick, during which the device rendered this force.
            (Some(_), Some(_)) => self.asked_force,
            (Some(kernel), None) => {
                // The kernel may depend on the motion, so it sees the same positions.
                kernel.step(position);
                kernel.align(&self.asked_force)
            }
            (None, _) => *rendered_force,
        }
    }

    /// Clear the past: the device rests at `position`, and its force rises from zero.
    pub fn rest_at(&mut self, position: &Axes<N, S>) {
        self.estimator.reset(position);
        self.measured.reset();
        if let Some(kernel) = &mut self.rendered {
            kernel.reset(position);
        }
        (self.last_rendered, self.asked_force) = (Axes::zeros(), Axes::zeros());
        self.controller.reset();
        if let Some(research) = &mut self.research {
            research.reset();
        }
        self.rendering.reset();
        self.limiter.reset();
        self.device_force = Axes::zeros();
    }
}

/// State of a tick that a coupling computes `F_v` from, between estimate and observation.
#[derive(Clone, Copy, Debug)]
pub struct Coupled<'a, const N: usize> {
    /// x in m: the sample, or its prediction while the sample is held.
    pub position: &'a Axes<N>,
    /// V in m/s.
    pub velocity: &'a Axes<N>,
    limiter: &'a Limiter<N>,
}

impl<const N: usize> Coupled<'_, N> {
    /// Return the share `gain` of a requested force, at most of the largest force of the device.
    #[inline(always)]
    pub fn faded(&self, requested_force: &Axes<N>, gain: f64) -> Axes<N> {
        self.limiter.faded(requested_force, gain)
    }
}

/// Motion, observation and limited `F_v` of a tick, before the controllers decide.
#[derive(Clone, Copy)]
pub(crate) struct Perceived<const N: usize, S: Real> {
    rendering: SaturatedForce<N, S>,
    motion: Motion<N, S>,
    pub(crate) seen: Observation<N, S>,
}

/// Inertial forces of a device beyond `m A`.
pub(crate) trait Inertia<const N: usize, S: Real = f64> {
    /// Return `F_device` with the lag of A, less the inertial forces beyond `m A`.
    ///
    /// `kernel` is the filter between the true acceleration and A. `is_late` is true if V itself is filtered and A is
    /// the difference of V ([`Estimator::has_late_velocity`]).
    fn align(
        &mut self,
        motion: &Motion<N, S>,
        device_force: &Axes<N, S>,
        is_late: bool,
        kernel: impl FnOnce(&Axes<N, S>) -> Axes<N, S>,
    ) -> Axes<N, S>;
}

/// A point mass, without inertial forces beyond `m A`.
pub(crate) struct PointMass;

impl<const N: usize, S: Real> Inertia<N, S> for PointMass {
    #[inline(always)]
    fn align(
        &mut self,
        _: &Motion<N, S>,
        device_force: &Axes<N, S>,
        _: bool,
        kernel: impl FnOnce(&Axes<N, S>) -> Axes<N, S>,
    ) -> Axes<N, S> {
        kernel(device_force)
    }
}

/// Observations and decisions of the safety layer at one tick.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SafetyTick<const N: usize> {
    /// V and A.
    pub motion: Motion<N>,
    /// `F_v` in N, limited to what the device can render; the observers see this force.
    pub rendered_force: Axes<N>,
    /// `F_h` in N; zero when no controller reads it.
    pub grasp_force: Axes<N>,
    /// `F_device` in N, commanded until the next tick.
    pub device_force: Axes<N>,
    /// `F_c` and the observers' values.
    pub intervention: Intervention<N>,
    /// The bounds that acted.
    pub acted: ActiveLimits,
    /// Energy in J that PC asked to dissipate and that the bounds left over.
    pub owed_energy_j: f64,
    /// Fault that keeps the force at zero. It stays until
    /// [`SafetyLayer::reset`](SafetyLayer::reset).
    pub fault: Option<Fault>,
}

impl<const N: usize> SafetyTick<N> {
    /// Return a tick without motion, force or fault.
    pub fn still() -> Self {
        Self {
            motion: Motion { velocity: Axes::zeros(), acceleration: Axes::zeros() },
            rendered_force: Axes::zeros(),
            grasp_force: Axes::zeros(),
            device_force: Axes::zeros(),
            intervention: Intervention::none(),
            acted: ActiveLimits::default(),
            owed_energy_j: 0.0,
            fault: None,
        }
    }
}

/// Observations and decisions of the safety layer at one tick, in each lane.
#[derive(Clone, Copy, Debug)]
pub struct Advance<const N: usize, S: Real = f64> {
    /// V and A.
    pub motion: Motion<N, S>,
    /// `F_v` in N, limited to what the device can render; the observers see this force.
    pub rendered_force: Axes<N, S>,
    /// `F_h` in N; zero when no controller reads it.
    pub grasp_force: Axes<N, S>,
    /// Force in N that the device was asked to render, with the lag of `F_h`.
    pub aligned_rendered_force: Axes<N, S>,
    /// `F_device` in N, commanded until the next tick.
    pub device_force: Axes<N, S>,
    /// `F_c` and the observers' values.
    pub response: Response<N, S>,
    /// `F_v` and the lanes in which a bound acted on it.
    pub rendering: SaturatedForce<N, S>,
    /// `F_device` and the lanes in which a bound acted on it.
    pub limited: SaturatedForce<N, S>,
    /// Energy in J that PC asked to dissipate and that the bounds left over.
    pub owed_energy_j: S,
}

impl<const N: usize, S: Real> Advance<N, S> {
    /// Return the observation of the tick.
    #[inline(always)]
    pub fn seen(&self) -> Observation<N, S> {
        Observation {
            velocity: self.motion.velocity,
            rendered_force: self.rendered_force,
            grasp_force: self.grasp_force,
            aligned_rendered_force: self.aligned_rendered_force,
        }
    }

    /// Return the tick of one lane.
    #[inline(always)]
    pub fn lane(&self, lane: usize) -> SafetyTick<N> {
        SafetyTick {
            motion: Motion {
                velocity: self.motion.velocity.extract(lane),
                acceleration: self.motion.acceleration.extract(lane),
            },
            rendered_force: self.rendered_force.extract(lane),
            grasp_force: self.grasp_force.extract(lane),
            device_force: self.device_force.extract(lane),
            intervention: self.response.lane(lane),
            acted: self.rendering.acted(lane).and(self.limited.acted(lane)),
            owed_energy_j: self.owed_energy_j.extract(lane),
            fault: None,
        }
    }
}
