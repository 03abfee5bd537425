//! Measures of a run, for one scenario or for several lanes.

use haptether_master::Aim;
use haptether_netsim::LinkSettings;
use haptether_numeric::pack;
use haptether_safety::{Axes, Fault, Real};
use nalgebra::SimdBool as _;

use super::{
    metrics::{Metric, Metrics},
    spec::SceneSpec,
};
use crate::LadderState;

/// Quantity out of bounds when a loop diverged.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum DivergenceCause {
    /// |x| in m.
    Position(f64),
    /// |V| in m/s.
    Speed(f64),
    /// A signal was not a finite number.
    NotFinite,
    /// Distance of the arm in m.
    Arm(f64),
    /// Fault at the boundary check of master or slave; the sides are no longer coupled.
    Fault(&'static str, Fault),
}

/// Time and cause of a divergence.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Divergence {
    /// Time in s.
    pub time_s: f64,
    /// Quantity out of bounds.
    pub cause: DivergenceCause,
}

impl std::fmt::Display for Divergence {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self.cause {
            DivergenceCause::Position(x) => {
                write!(f, "the device was {x:.4e} m away, beyond run.diverged_position")
            }
            DivergenceCause::Speed(v) => {
                write!(f, "the device moved at {v:.4e} m/s, beyond run.diverged_speed")
            }
            DivergenceCause::NotFinite => write!(f, "a force was no longer a finite number"),
            DivergenceCause::Arm(x) => {
                write!(f, "the arm was {x:.4e} m away, beyond run.diverged_position")
            }
            DivergenceCause::Fault(side, fault) => write!(f, "fault of the {side}: {fault}"),
        }
    }
}

/// End of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ending {
    /// All ticks ran.
    Complete,
    /// No measured quantity could change any more.
    Settled,
    /// The loop diverged.
    Diverged,
    /// The run ended before the scheduled release.
    NotReleased,
    /// Master and slave never engaged; nothing was measured.
    NeverEngaged,
    /// The sides engaged and were not coupled at the end. Holds the state of the uncoupled side; of the master if both
    /// are.
    Uncoupled(LadderState),
}

impl Ending {
    /// Return the name used in tables.
    pub fn name(self) -> &'static str {
        match self {
            Self::Complete => "complete",
            Self::Settled => "settled",
            Self::Diverged => "diverged",
            Self::NotReleased => "not-released",
            Self::NeverEngaged => "never-engaged",
            Self::Uncoupled(state) => state.name(),
        }
    }
}

/// Measured values of a run. None means not measured or not requested, never 0.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Outcome {
    /// End of the run.
    pub ending: Ending,
    /// Largest speed in m/s along the rendered force after the release begins; without a release, over the whole run.
    /// A hand that follows aims may grip again: largest speed while it is open.
    pub max_ejection_velocity: Option<f64>,
    /// Largest `|F_device|` in N.
    pub peak_device_force: Option<f64>,
    /// Time in s from the release to the first intervention after it begins; 0 if one was active.
    pub time_to_trip_s: Option<f64>,
    /// Interventions that began before the release; without a release, all of them.
    pub false_trips: Option<u64>,
    /// Ticks under intervention.
    pub intervention_ticks: Option<u64>,
    /// Minimum of the energy in J that has flowed into the renderer of the force, `-sum F_device dx`.
    pub passivity_min_j: Option<f64>,
    /// Root mean square in m of the difference between slave motion and scaled master motion; only with an arm.
    pub position_rmse_m: Option<f64>,
    /// Root mean square in N of the difference between device force and scaled environment force; only with an arm.
    pub force_rmse_n: Option<f64>,
    /// Largest angular speed in rad/s of the device after the release begins; without a release, over the whole run.
    /// This field and the three below require a hand that turns.
    pub max_ejection_rate: Option<f64>,
    /// Largest `|tau_device|` in N m.
    pub peak_device_torque: Option<f64>,
    /// Root mean square in rad of the angle between slave rotation and scaled master rotation.
    pub orientation_rmse_rad: Option<f64>,
    /// Root mean square in N m of the difference between device torque and scaled environment torque.
    pub torque_rmse_n_m: Option<f64>,
    /// Time and cause of a divergence.
    pub diverged: Option<Divergence>,
    /// Number of ticks of the master.
    pub ticks: u64,
}

/// Settings of the measures.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct MeasureSettings {
    /// Start of the release in s.
    pub(crate) release_s: Option<f64>,
    /// |x| in m beyond which the loop has diverged.
    pub(crate) diverged_position: f64,
    /// |V| in m/s beyond which the loop has diverged.
    pub(crate) diverged_speed: f64,
    /// Time in s after which a device at rest ends the run; none to run all ticks.
    pub(crate) quiet_after_s: Option<f64>,
    /// Requested metrics.
    pub(crate) metrics: Metrics,
}

impl MeasureSettings {
    /// Return the settings of a scene.
    pub(super) fn of<const N: usize>(scene: &SceneSpec<N>) -> Self {
        let operator = scene.operator.as_ref();
        let release = operator.and_then(|operator| operator.release.as_ref());
        let mut quiet_after: f64 = 0.0;
        if let Some(operator) = operator {
            let legs: f64 = operator.legs.iter().map(|leg| leg.duration_s).sum();
            let recorded = operator.recorded.as_ref().and_then(|series| series.time_s.last().copied());
            let aimed = operator.aims.as_ref().and_then(|aims| aims.rows.last());
            let expired = aimed.map(|row| row.at_s + Aim::<N>::EXPIRES_S);
            quiet_after = quiet_after.max(legs).max(recorded.unwrap_or(0.0)).max(expired.unwrap_or(0.0));
            if let Some(release) = release {
                let regrasp = operator.regrasp.as_ref();
                let regrips = regrasp.map_or(0.0, |regrasp| regrasp.reaction_s + regrasp.rise_s);
                quiet_after = quiet_after.max(release.at_s + release.decay_s + regrips);
            }
            let gripper = scene.slave.as_ref().and_then(|slave| slave.gripper.as_ref());
            if let (Some([last_s, _]), Some(gripper)) = (operator.trigger.last(), gripper) {
                quiet_after = quiet_after.max(last_s + 1.0 / gripper.speed);
            }
            if operator.tremor.is_some() && (release.is_none() || operator.regrasp.is_some()) {
                // A hand that holds the device with tremor is never at rest.
                quiet_after = f64::MAX;
            }
        }
        if let Some(environment) = &scene.environment {
            for pusher in &environment.pushers {
                quiet_after = quiet_after.max(pusher.at_s + pusher.duration_s);
            }
            for object in &environment.objects {
                if object.body.is_some() {
                    quiet_after = f64::MAX;
                }
                if let Some(motion) = &object.motion {
                    let swings = motion.amplitude.iter().any(|a| *a != 0.0);
                    quiet_after = quiet_after.max(if swings { f64::MAX } else { motion.until_s });
                }
            }
        }
        // Links, environment and limiter delay the effect of the last scheduled event.
        let late = scene.environment.as_ref().map_or(0, |environment| environment.delay_ticks);
        let links = scene.link.iter().flat_map(|links| [&links.forward, &links.backward]).flatten();
        let round_trip: f64 = links.clone().map(LinkSettings::longest_delay_s).sum();
        quiet_after = links.map(LinkSettings::last_change_s).fold(quiet_after, f64::max);
        let ramp = scene.safety.limiter.as_ref().map_or(0.0, |limiter| limiter.ramp_in_s);
        quiet_after += late as f64 * scene.run.period_s + 2.0 * round_trip + ramp;
        // A release of the rotation alone counts as a release.
        let of_turn = operator.and_then(|operator| operator.rotation.as_ref()?.release);
        Self {
            release_s: release.copied().or(of_turn).map(|release| release.at_s),
            diverged_position: scene.run.diverged_position,
            diverged_speed: scene.run.diverged_speed,
            quiet_after_s: scene.run.stop_early.then_some(quiet_after),
            metrics: scene.metrics,
        }
    }
}

/// Speed in m/s below which a device counts as at rest.
const AT_REST: f64 = 1e-4;

/// Time in s of rest after which a run has settled.
const SETTLED_S: f64 = 0.2;

/// Square of the smallest force that defines the direction of an ejection, (1 mN)² in N².
const MIN_SQUARED_FORCE: f64 = 1e-6;

/// Measures of a run, updated at each tick.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Measures<const N: usize, S: Real = f64> {
    metrics: Metrics,
    release: S,
    has_release: bool,
    /// Earliest and latest release of all lanes in s: all hold before the first, and all have let go after the second.
    earliest_release: f64,
    latest_release: f64,
    diverged_position: S,
    diverged_speed: S,
    /// Twice the reciprocals of the squared bounds, so that rounding cannot hide a value at its bound.
    bounds: [S; 2],
    quiet_after: Option<S>,
    direction: Axes<N, S>,
    /// True if every lane has a direction.
    all_directed: bool,
    ejection: S,
    peak_squared_force: S,
    trip: S,
    false_trips: S,
    on: S,
    was_on: S,
    energy: S,
    min_energy: S,
    held: Axes<N, S>,
    last_position: Axes<N, S>,
    active: S,
    /// Time in s of the newest tick.
    newest_s: f64,
}

impl<const N: usize> Measures<N> {
    /// Build the measures before the first tick, for a device that starts at `position` in m.
    pub(crate) fn new(settings: &MeasureSettings, position: &Axes<N>) -> Self {
        Self {
            metrics: settings.metrics,
            release: settings.release_s.unwrap_or(0.0),
            has_release: settings.release_s.is_some(),
            earliest_release: settings.release_s.unwrap_or(f64::NEG_INFINITY),
            latest_release: settings.release_s.unwrap_or(f64::INFINITY),
            diverged_position: settings.diverged_position,
            diverged_speed: settings.diverged_speed,
            bounds: [settings.diverged_position, settings.diverged_speed].map(|bound| 2.0 / (bound * bound)),
            quiet_after: settings.quiet_after_s,
            direction: Axes::zeros(),
            all_directed: false,
            ejection: 0.0,
            peak_squared_force: 0.0,
            trip: f64::INFINITY,
            false_trips: 0.0,
            on: 0.0,
            was_on: 0.0,
            energy: 0.0,
            min_energy: 0.0,
            held: Axes::zeros(),
            last_position: *position,
            active: 0.0,
            newest_s: f64::NEG_INFINITY,
        }
    }

    /// Combine scenarios into lanes before their first tick. Returns none if their metrics differ, or if only some
    /// have a release or an early end.
    pub(crate) fn gather<S: Real>(of: &[Self]) -> Option<Measures<N, S>> {
        let first = of.first()?;
        let shares = |one: &Self| {
            let kinds = |one: &Self| (one.metrics, one.has_release, one.quiet_after.is_some());
            kinds(one) == kinds(first)
        };
        if !of.iter().all(shares) {
            return None;
        }
        let zero = S::splat(0.0);
        Some(Measures {
            metrics: first.metrics,
            release: pack(of, |one| one.release)?,
            has_release: first.has_release,
            earliest_release: of.iter().map(|one| one.earliest_release).fold(f64::INFINITY, f64::min),
            latest_release: of.iter().map(|one| one.latest_release).fold(f64::NEG_INFINITY, f64::max),
            bounds: [pack(of, |one| one.bounds[0])?, pack(of, |one| one.bounds[1])?],
            diverged_position: pack(of, |one| one.diverged_position)?,
            diverged_speed: pack(of, |one| one.diverged_speed)?,
            quiet_after: match first.quiet_after {
                Some(_) => Some(pack(of, |one| one.quiet_after.unwrap_or(0.0))?),
                None => None,
            },
            direction: Axes::zeros(),
            all_directed: false,
            ejection: zero,
            peak_squared_force: zero,
            trip: S::splat(f64::INFINITY),
            false_trips: zero,
            on: zero,
            was_on: zero,
            energy: zero,
            min_energy: zero,
            held: Axes::zeros(),
            last_position: pack(of, |one| one.last_position)?,
            active: zero,
            newest_s: f64::NEG_INFINITY,
        })
    }
}

impl<const N: usize, S: Real> Measures<N, S> {
    /// Return true if a loop may have diverged at this tick. Almost every tick needs only this cheap test.
    #[inline(always)]
    pub(crate) fn may_have_diverged(
        &self,
        position: &Axes<N, S>,
        velocity: &Axes<N, S>,
        device_force: &Axes<N, S>,
    ) -> bool {
        let [room, speed] = self.bounds;
        // A force that is not finite becomes NaN when multiplied by 0, and NaN fails every comparison.
        let poison = device_force.dot(device_force) * S::splat(0.0);
        let excess = position.dot(position) * room + velocity.dot(velocity) * speed + poison;
        !excess.simd_lt(S::splat(1.0)).all()
    }

    /// Return the mask of lanes that have diverged at this tick; do not take the tick in these lanes.
    pub(crate) fn diverged(
        &self,
        position: &Axes<N, S>,
        velocity: &Axes<N, S>,
        device_force: &Axes<N, S>,
    ) -> S::SimdBool {
        let speed = velocity.dot(velocity).simd_le(self.diverged_speed * self.diverged_speed);
        let room = position.dot(position).simd_le(self.diverged_position * self.diverged_position);
        let forced = device_force.dot(device_force).simd_lt(S::splat(f64::INFINITY));
        !(speed & room & forced)
    }

    /// Return the quantity out of bounds in one lane.
    pub(crate) fn cause(&self, lane: usize, position: &Axes<N, S>, velocity: &Axes<N, S>) -> DivergenceCause {
        let norm = |value: &Axes<N, S>| value.map(|x| x.extract(lane)).norm();
        let (distance, speed) = (norm(position), norm(velocity));
        if !(distance.is_finite() && speed.is_finite()) {
            DivergenceCause::NotFinite
        } else if distance > self.diverged_position.extract(lane) {
            DivergenceCause::Position(distance)
        } else if speed > self.diverged_speed.extract(lane) {
            DivergenceCause::Speed(speed)
        } else {
            DivergenceCause::NotFinite
        }
    }

    /// Take one tick at time t in s: x in m, V in m/s, then `F_v`, `F_device` and the hand's force in N.
    ///
    /// `is_on` is the mask of lanes under intervention; None if no controller can intervene. Returns the mask of lanes
    /// in which nothing more will happen; None if no lane may end early.
    #[inline(always)]
    #[allow(clippy::too_many_arguments)] // the signals of a tick
    pub(crate) fn take(
        &mut self,
        t: f64,
        position: &Axes<N, S>,
        velocity: &Axes<N, S>,
        rendered_force: &Axes<N, S>,
        device_force: &Axes<N, S>,
        hand_force: &Axes<N, S>,
        is_on: Option<S::SimdBool>,
    ) -> Option<S::SimdBool> {
        let (zero, one, time) = (S::splat(0.0), S::splat(1.0), S::splat(t));
        self.newest_s = t;
        if self.metrics.has(Metric::PassivityMin) {
            // Work of the force held since the last tick.
            self.energy -= self.held.dot(&(position - self.last_position));
            self.min_energy = self.energy.lesser(self.min_energy);
            (self.held, self.last_position) = (*device_force, *position);
        }
        let squared_force = device_force.dot(device_force);
        if self.metrics.has(Metric::PeakDeviceForce) {
            self.peak_squared_force = squared_force.larger(self.peak_squared_force);
        }

        let squared_speed = velocity.dot(velocity);
        let has_ejection = self.metrics.has(Metric::MaxEjectionVelocity);
        if has_ejection && t <= self.latest_release {
            let squared = rendered_force.dot(rendered_force);
            let points = squared.simd_gt(S::splat(MIN_SQUARED_FORCE));
            let points = if self.has_release { points & time.simd_le(self.release) } else { points };
            if N == 1 {
                let side = one.select(rendered_force[0].simd_gt(zero), -one);
                self.direction[0] = side.select(points, self.direction[0]);
            } else if points.any() {
                let norm = squared.root();
                self.direction = self
                    .direction
                    .zip_map(rendered_force, |before, force| (force / norm).select(points, before));
            }
            if !self.all_directed {
                self.all_directed = self.direction.dot(&self.direction).simd_gt(zero).all();
            }
        }
        let has_begun = time.simd_ge(self.release);
        if has_ejection && t >= self.earliest_release {
            let mut along = velocity.dot(&self.direction);
            if !self.all_directed {
                let has_direction = self.direction.dot(&self.direction).simd_gt(zero);
                along = along.select(has_direction, squared_speed.root());
            }
            self.ejection = along.select(has_begun, zero).larger(self.ejection);
        }
        if !self.metrics.has_interventions() {
            // Interventions are not requested.
        } else if let Some(is_on) = is_on.filter(|is_on| is_on.any()) {
            let on = one.select(is_on, zero);
            let begins = on * (one - self.was_on);
            let is_false = if self.has_release { zero.select(has_begun, begins) } else { begins };
            self.false_trips += is_false;
            self.on += on;
            self.was_on = on;
            self.trip = self.trip.simd_min(time.select(is_on & has_begun, S::splat(f64::INFINITY)));
        } else {
            self.was_on = zero;
        }

        let quiet_after = self.quiet_after?;
        // A device that moves without any force has been ejected and may drift. A device at rest under an intervention
        // will move when the intervention ends.
        let moves = squared_speed.simd_gt(S::splat(AT_REST * AT_REST));
        let forces = squared_force + hand_force.dot(hand_force) + rendered_force.dot(rendered_force);
        let mut acts = moves & forces.simd_gt(zero);
        if let Some(is_on) = is_on {
            acts = acts | is_on;
        }
        self.active = time.select(acts | time.simd_le(quiet_after), self.active);
        Some((time - self.active).simd_gt(S::splat(SETTLED_S)))
    }

    /// Return the outcome of one lane after `ticks` ticks.
    pub(crate) fn outcome(
        &self,
        lane: usize,
        ticks: u64,
        ending: Ending,
        diverged: Option<Divergence>,
    ) -> Outcome {
        let of = |value: S| value.extract(lane);
        let has = |metric| self.metrics.has(metric);
        let trip = of(self.trip);
        let has_begun = self.newest_s >= of(self.release);
        let ending = match ending {
            Ending::Complete | Ending::Settled | Ending::Uncoupled(_) if !has_begun => Ending::NotReleased,
            ending => ending,
        };
        let measured = |value: S| (self.newest_s >= 0.0).then(|| of(value));
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // counts
        let count = |value: S| measured(value).map(|value| value as u64);
        Outcome {
            ending,
            max_ejection_velocity: measured(self.ejection)
                .filter(|_| has_begun && has(Metric::MaxEjectionVelocity)),
            peak_device_force: measured(self.peak_squared_force)
                .filter(|_| has(Metric::PeakDeviceForce))
                .map(f64::sqrt),
            time_to_trip_s: (self.has_release && trip.is_finite() && has(Metric::TimeToTrip))
                .then(|| trip - of(self.release)),
            false_trips: count(self.false_trips).filter(|_| has(Metric::FalseTrips)),
            intervention_ticks: count(self.on).filter(|_| self.metrics.has_intervention_ticks()),
            passivity_min_j: measured(self.min_energy).filter(|_| has(Metric::PassivityMin)),
            position_rmse_m: None,
            force_rmse_n: None,
            max_ejection_rate: None,
            peak_device_torque: None,
            orientation_rmse_rad: None,
            torque_rmse_n_m: None,
            diverged,
            ticks,
        }
    }
}

impl Outcome {
    /// Return the value of a metric, with the master's period in s; none if it was not measured.
    pub fn value(&self, metric: Metric, period_s: f64) -> Option<f64> {
        let count = |count: Option<u64>| count.map(|count| count as f64);
        match metric {
            Metric::MaxEjectionVelocity => self.max_ejection_velocity,
            Metric::PeakDeviceForce => self.peak_device_force,
            Metric::TimeToTrip => self.time_to_trip_s,
            Metric::FalseTrips => count(self.false_trips),
            Metric::InterventionTime => count(self.intervention_ticks).map(|ticks| ticks * period_s),
            Metric::InterventionTicks => count(self.intervention_ticks),
            Metric::PositionError => self.position_rmse_m,
            Metric::ForceError => self.force_rmse_n,
            Metric::MaxEjectionRate => self.max_ejection_rate,
            Metric::PeakDeviceTorque => self.peak_device_torque,
            Metric::OrientationError => self.orientation_rmse_rad,
            Metric::TorqueError => self.torque_rmse_n_m,
            Metric::PassivityMin => self.passivity_min_j,
        }
    }

    /// Remove all values that require engaged sides.
    pub(crate) fn never_engaged(self) -> Self {
        Self {
            ending: if self.diverged.is_some() { Ending::Diverged } else { Ending::NeverEngaged },
            max_ejection_velocity: None,
            peak_device_force: None,
            time_to_trip_s: None,
            false_trips: None,
            intervention_ticks: None,
            passivity_min_j: None,
            position_rmse_m: None,
            force_rmse_n: None,
            max_ejection_rate: None,
            peak_device_torque: None,
            orientation_rmse_rad: None,
            torque_rmse_n_m: None,
            ..self
        }
    }
}
