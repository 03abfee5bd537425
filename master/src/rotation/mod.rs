//! Rotation of a simulated master: a rigid handle on SO(3) and the hand that turns it.

mod hand;
#[cfg(test)]
mod tests;

pub use hand::{RotationHand, RotationHandParameters, RotationLeg, TorsionSpring};

use nalgebra::UnitQuaternion;

use crate::{Axes, ModelError, device::exerted, require};
use hand::Pull;

/// Mechanics and motors of a device's rotation.
///
/// `I dw/dt + w x I w + b w + c w / |w| = tau`, with w in the body frame, which is the frame of the principal
/// axes.
///
/// Source: Euler's equations, Goldstein, Poole and Safko 2002, Eq. 5.39; friction as paper Eq. 3.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Deserialize, schemars::JsonSchema), serde(deny_unknown_fields))]
pub struct RotationParameters {
    /// I in kg m² about each axis of the body (> 0).
    #[cfg_attr(feature = "serde", schemars(with = "Vec<f64>"))]
    pub inertia_kg_m2: Axes<3>,
    /// b in N m s/rad (>= 0).
    pub viscous: f64,
    /// c in N m (>= 0): friction while moving, and the largest torque that friction withstands at rest.
    pub coulomb: f64,
    /// True if the device measures w itself, exactly.
    pub measures_angular_velocity: bool,
    /// Largest `|tau|` in N m that the motors exert (> 0); none means no bound.
    pub max_torque_n_m: Option<f64>,
}

impl RotationParameters {
    /// Largest rate in rad/s of a spring or a damper on the lightest axis: 2048 sub-steps per ms.
    pub const MAX_RATE: f64 = 32_768.0;

    /// A device with the same I in kg m² about each axis, b in N m s/rad, c in N m, measured w and no torque
    /// bound.
    pub fn ideal(inertia_kg_m2: f64, viscous: f64, coulomb: f64) -> Self {
        Self {
            inertia_kg_m2: Axes::repeat(inertia_kg_m2),
            viscous,
            coulomb,
            measures_angular_velocity: true,
            max_torque_n_m: None,
        }
    }

    /// Return an error if a parameter is invalid.
    pub fn check(&self) -> Result<(), ModelError> {
        for inertia in &self.inertia_kg_m2 {
            require("inertia_kg_m2", *inertia, *inertia > 0.0, "finite and above 0")?;
        }
        require("viscous", self.viscous, self.viscous >= 0.0, "finite and 0 or more")?;
        require("coulomb", self.coulomb, self.coulomb >= 0.0, "finite and 0 or more")?;
        let Some(bound) = self.max_torque_n_m else { return Ok(()) };
        require("max_torque_n_m", bound, bound > 0.0, "finite and above 0")
    }
}

/// Rotation measured by a device at one tick.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RotationSample {
    /// R, `base_from_body`.
    pub orientation: UnitQuaternion<f64>,
    /// w in rad/s in the base frame, if the device measures it.
    pub angular_velocity: Option<Axes<3>>,
}

/// Largest angles in rad per sub-step: rotation of the body, and phase of a spring or a damper.
const STEP_ANGLE: f64 = 1.0 / 256.0;
const STEP_PHASE: f64 = 1.0 / 64.0;

/// Largest angle in rad per sub-step by which a push turns the direction of motion and friction.
const STEP_SWERVE: f64 = 1.0 / 16.0;

/// Angle in rad between a slow motion and its push below which both count as parallel.
const ALIGNED: f64 = 1e-3;

/// Largest number of sub-steps per advance; longer sub-steps beyond it, so that a tick always ends.
const MAX_SUB_STEPS: f64 = 4096.0;

/// Direction opposed by Coulomb friction during a sub-step, in the body frame.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Friction {
    None,
    /// The motion; this direction once the motion no longer has a component along it.
    Along(Axes<3>),
    /// The push, or this where the push no longer has it.
    AlongPush(Axes<3>),
}

/// Least share of a sub-step that is taken up to an event, so that it always ends, and by which halving locates one.
const MIN_SHARE: f64 = 1e-6;

/// Share of a strength or of friction that a change of its side exceeds: rounding is no event.
const CLEAR: f64 = 1e-12;

/// Orientation, and angular momentum in N m s in the base frame.
#[derive(Clone, Copy, Debug, PartialEq)]
struct State {
    orientation: UnitQuaternion<f64>,
    momentum: Axes<3>,
}

/// Result of a sub-step.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Step {
    state: State,
    /// True if the law of the hand differs between its stages.
    changes: bool,
    /// True if a stage moves against the direction in which the step applies friction.
    reverses: bool,
}

/// A rigid handle, the hand on it, torsion springs that act on it by themselves, and a torque held over a tick.
///
/// The state is R and the angular momentum `L = R I w` in the base frame:
///
/// `dR/dt = R hat(w)`, `w = I^-1 R^T L`, `dL/dt = R tau`.
///
/// **Integrator.** Runge-Kutta-Munthe-Kaas of order 4 with the classical tableau:
///
/// `R exp(Theta)` with `dTheta/dt = w + Theta x w / 2 + Theta x (Theta x w) / 12`
///
/// These are the terms of `dexp^-1` that order 4 needs. R stays a rotation. L of a free body is constant, a
/// held torque adds its exact impulse, and `w x I w` does not appear. The step is explicit; a damper needs no
/// backward steps, unlike composed symmetric methods of order 4. The equations are reversible, so the error
/// of order 4 in the energy only oscillates. The drift is of order 5, `z⁶ / 144` of the energy per step of z
/// rad (linear test equation). Sub-steps of z <= 1/256 leave 1e-11 over 1e5 ticks of 1 ms at 30 rad/s.
///
/// **Friction** at rest withstands c. A sub-step ends at the instant at which the motion along its initial
/// direction ends, found by secants. The body moves again if friction cannot hold it. The remaining speed
/// across that direction is dropped: at most `|tau| / I` times the shortest sub-step, a 4096th of a tick.
///
/// **Events.** A sub-step ends at a kink of the hand's path or release. It also ends where the grip begins or ceases to
/// slip, where the spring of the hand changes side at pi, and where friction no longer holds the body. Halving locates
/// the last three to 1e-6 of the sub-step.
///
/// Source: Munthe-Kaas 1998, section 4; Hairer, Lubich and Wanner 2006, IV.8 and XI.3 (drift of reversible systems).
#[derive(Clone, Debug, PartialEq)]
pub struct SimulatedRotation {
    device: RotationParameters,
    hand: RotationHand,
    springs: Vec<TorsionSpring>,
    held_torque: Axes<3>,
    /// Time of the hand in s; its path begins at 0.
    time: f64,
    /// Time of the hand at the last tick in ns: a sum of ticks in s would accumulate rounding.
    hand_ns: u64,
    waits: bool,
    now_ns: u64,
    state: State,
    /// Rate in rad/s of springs and dampers on the lightest axis.
    rate: f64,
}

impl SimulatedRotation {
    /// A handle at rest at the start of the hand's path, at time `now_ns`.
    pub fn new(device: RotationParameters, hand: RotationHand, now_ns: u64) -> Result<Self, ModelError> {
        device.check()?;
        let state = State { orientation: hand.target_at(f64::NEG_INFINITY), momentum: Axes::zeros() };
        let one = Self {
            device,
            hand,
            springs: Vec::new(),
            held_torque: Axes::zeros(),
            time: 0.0,
            hand_ns: 0,
            waits: false,
            now_ns,
            state,
            rate: 0.0,
        };
        one.with_rate()
    }

    /// The same handle with springs that act at every instant.
    pub fn with_springs(self, springs: Vec<TorsionSpring>) -> Result<Self, ModelError> {
        Self { springs, ..self }.with_rate()
    }

    fn with_rate(self) -> Result<Self, ModelError> {
        let lightest = self.device.inertia_kg_m2.min();
        let gains = self.springs.iter().map(TorsionSpring::gains).chain([self.hand.gains()]);
        let [stiffness, damping] =
            gains.fold([0.0, self.device.viscous], |[k, b], [more_k, more_b]| [k + more_k, b + more_b]);
        let rate = (stiffness / lightest).sqrt().max(damping / lightest);
        let allowed = "at most 32768 1/s: less stiffness or damping in [operator.rotation], less viscous or more \
                       inertia_kg_m2 in [master.rotation]";
        require("rate sqrt(K / I) or B / I", rate, rate <= RotationParameters::MAX_RATE, allowed)?;
        Ok(Self { rate, ..self })
    }

    /// Set whether the hand waits at the start of its path; its time runs while it does not wait.
    pub fn set_waiting(&mut self, waits: bool) {
        self.waits = waits;
    }

    /// Place the handle at R with w in rad/s in the base frame.
    pub fn place(&mut self, quat_wxyz: [f64; 4], angular_velocity: &Axes<3>) -> Result<(), ModelError> {
        let orientation = hand::unit("orientation", quat_wxyz)?;
        for w in angular_velocity {
            require("angular velocity", *w, true, "finite")?;
        }
        let body = orientation.inverse_transform_vector(angular_velocity);
        self.state =
            State { orientation, momentum: orientation * self.device.inertia_kg_m2.component_mul(&body) };
        Ok(())
    }

    /// Set the clock to `now_ns` without advancing the state.
    pub fn begin(&mut self, now_ns: u64) {
        self.now_ns = now_ns;
    }

    /// Advances to `now_ns` (monotonic) and returns the measurement.
    pub fn read(&mut self, now_ns: u64) -> RotationSample {
        if now_ns > self.now_ns {
            let past_ns = now_ns - self.now_ns;
            self.advance(past_ns as f64 * 1e-9);
            if !self.waits {
                self.hand_ns += past_ns;
                self.time = self.hand_ns as f64 / 1e9;
            }
            self.now_ns = now_ns;
        }
        self.measured()
    }

    /// Measurement of the current state.
    pub fn measured(&self) -> RotationSample {
        RotationSample {
            orientation: self.state.orientation,
            angular_velocity: self.device.measures_angular_velocity.then(|| self.angular_velocity()),
        }
    }

    /// Hold this torque in N m, in the base frame, within the motors' bound; a non-finite torque becomes
    /// zero.
    pub fn write(&mut self, torque: &Axes<3>) {
        let commanded = if torque.iter().all(|t| t.is_finite()) { *torque } else { Axes::zeros() };
        self.held_torque = match self.device.max_torque_n_m {
            Some(bound) => exerted(&commanded, bound, 0.0, true),
            None => commanded,
        };
    }

    /// R, `base_from_body`.
    pub fn orientation(&self) -> &UnitQuaternion<f64> {
        &self.state.orientation
    }

    /// True w in rad/s in the base frame.
    pub fn angular_velocity(&self) -> Axes<3> {
        self.state.orientation * self.body_angular_velocity()
    }

    /// True w in rad/s in the body frame.
    pub fn body_angular_velocity(&self) -> Axes<3> {
        self.body_velocity(&self.state)
    }

    /// L in N m s in the base frame.
    pub fn angular_momentum(&self) -> &Axes<3> {
        &self.state.momentum
    }

    /// `w' I w / 2` in J.
    pub fn kinetic_energy_j(&self) -> f64 {
        let w = self.body_angular_velocity();
        0.5 * self.device.inertia_kg_m2.component_mul(&w).dot(&w)
    }

    /// Energy of the springs in J.
    pub fn spring_energy_j(&self) -> f64 {
        self.springs.iter().map(|spring| spring.energy_j(&self.state.orientation)).sum()
    }

    /// True torque of the hand on the handle in N m, in the base frame.
    pub fn hand_torque(&self) -> Axes<3> {
        let orientation = &self.state.orientation;
        orientation * self.hand.torque(self.hand_time(self.time), orientation, &self.body_angular_velocity())
    }

    /// True torque of the springs on the handle in N m, in the base frame.
    pub fn spring_torque(&self) -> Axes<3> {
        let (orientation, w) = (&self.state.orientation, self.body_angular_velocity());
        self.springs.iter().map(|spring| orientation * spring.torque(orientation, &w)).sum()
    }

    /// Torque of the motors since the last write in N m, in the base frame.
    pub fn motor_torque(&self) -> &Axes<3> {
        &self.held_torque
    }

    /// Time of the hand; a waiting hand is before its path and its release.
    fn hand_time(&self, t: f64) -> f64 {
        if self.waits { f64::NEG_INFINITY } else { t }
    }

    fn body_velocity(&self, state: &State) -> Axes<3> {
        state.orientation.inverse_transform_vector(&state.momentum).component_div(&self.device.inertia_kg_m2)
    }

    fn advance(&mut self, duration: f64) {
        let mut done = 0.0;
        while done < duration {
            let left = duration - done;
            let kink = if self.waits { None } else { self.hand.next_kink(self.time) };
            let to_kink = kink.map_or(f64::INFINITY, |kink| kink - self.time);
            let smooth = left.min(to_kink);
            let step = (smooth / self.sub_steps(smooth)).max(duration / MAX_SUB_STEPS).min(smooth);
            let taken = self.sub_step(step);
            let reached_kink = taken == to_kink;
            done = if taken == left { duration } else { done + taken };
            // Rounding of many small additions must not shift the clock.
            match kink {
                _ if self.waits => {}
                Some(kink) if reached_kink => self.time = kink,
                _ => self.time += taken,
            }
        }
    }

    /// Number of sub-steps for `duration` in s.
    fn sub_steps(&self, duration: f64) -> f64 {
        let turning = self.body_angular_velocity().norm();
        let lightest = self.device.inertia_kg_m2.min();
        // A torque turns the body by tau t² / (2 I), a rate of sqrt(tau / I).
        let pushed = (self.held_torque.norm() / lightest).sqrt();
        let mut rate = (turning / STEP_ANGLE).max(self.rate.max(pushed) / STEP_PHASE);
        if self.device.coulomb > 0.0 && turning > 0.0 {
            // A push across a slow motion turns its direction, and so the direction of friction.
            let direction = self.body_angular_velocity() / turning;
            let (push, _) = self.smooth_torque(self.time, &self.state);
            let across = (push - direction * push.dot(&direction)).norm();
            rate = rate.max(across / (lightest * turning * STEP_SWERVE));
            if push.dot(&direction) > 0.0 && across > ALIGNED * push.norm() {
                rate = rate.max(push.norm() / (lightest * turning));
            }
        }
        (duration * rate).ceil().max(1.0)
    }

    /// Advances by at most `duration` in s; returns the advance.
    fn sub_step(&mut self, duration: f64) -> f64 {
        let coulomb = self.device.coulomb;
        if coulomb == 0.0 {
            let (taken, step) = self.until_change(duration, Friction::None);
            self.state = step.state;
            return taken;
        }
        let w = self.body_angular_velocity();
        let speed = w.norm();
        let (push, _) = self.smooth_torque(self.time, &self.state);
        if speed == 0.0 && push.norm() <= coulomb {
            self.state.momentum = Axes::zeros();
            return if self.waits || self.hand.is_still(self.time) {
                duration
            } else {
                first_change(duration, |t| {
                    self.smooth_torque(self.time + t, &self.state).0.norm() > coulomb * (1.0 + CLEAR)
                })
                .map_or(duration, |(_, after)| after)
            };
        }
        // A push in the direction of a slow motion soon has it in its own: sooner than a sub-step can follow. From rest, at once.
        let stiffness = push.norm() * duration / (self.device.inertia_kg_m2.min() * speed);
        let is_aligned = push.cross(&w).norm() <= ALIGNED * push.norm() * speed;
        let follows =
            speed == 0.0 || (push.dot(&w) > 0.0 && (stiffness > 2.0 || (stiffness > 1.0 && is_aligned)));
        let direction = if follows { push / push.norm() } else { w / speed };
        if follows {
            let turned = direction * speed;
            self.state.momentum = self.state.orientation * self.device.inertia_kg_m2.component_mul(&turned);
        }
        let inertia = self.device.inertia_kg_m2;
        let along = |state: &State| {
            state
                .orientation
                .inverse_transform_vector(&state.momentum)
                .component_div(&inertia)
                .dot(&direction)
        };
        let friction = if follows { Friction::AlongPush(direction) } else { Friction::Along(direction) };
        let (mut duration, mut full) = self.until_change(duration, friction);
        let halts = |step: &Step| step.reverses || along(&step.state) <= 0.0;
        if speed == 0.0 {
            // It sets off and halts within one sub-step: the next begins before the halt, and ends there.
            let least = MIN_SHARE * duration;
            while halts(&full) && duration > least {
                duration *= 0.5;
                full = self.stepped(duration, friction);
            }
        }
        if speed == 0.0 || !halts(&full) {
            self.state = full.state;
            return duration;
        }
        let mut at = (duration, full.state);
        if along(&full.state) > 0.0 {
            // It halts and sets off again.
            if let Some((_, t)) = first_change(duration, |t| along(&self.stepped(t, friction).state) <= 0.0) {
                at = (t, self.stepped(t, friction).state);
            } else {
                self.state = full.state;
                return duration;
            }
        }
        // Secants with the sign kept on both sides (Illinois; Dowell and Jarratt 1971).
        let (mut low, mut high) = ((0.0, speed), (at.0, along(&at.1)));
        for _ in 0..16 {
            let t = (low.0 * high.1 - high.0 * low.1) / (high.1 - low.1);
            let state = self.stepped(t, friction).state;
            let v = along(&state);
            at = (t, state);
            if v.abs() <= 1e-15 * speed {
                break;
            }
            if v > 0.0 {
                low = (t, v);
                high.1 *= 0.5;
            } else {
                high = (t, v);
                low.1 *= 0.5;
            }
        }
        let (taken, mut state) = at;
        // The body moves again if friction cannot hold the push.
        state.momentum = Axes::zeros();
        self.state = state;
        taken.max(duration * MIN_SHARE)
    }

    /// How far in s it goes within `duration` before the law of the hand changes, and the state there.
    fn until_change(&self, duration: f64, friction: Friction) -> (f64, Step) {
        let full = self.stepped(duration, friction);
        if !full.changes {
            return (duration, full);
        }
        let pull = |t: f64, state: &State| self.smooth_torque(self.time + t, state).1;
        let begun = pull(0.0, &self.state);
        let changed = |t: f64| pull(t, &self.stepped(t, friction).state).differs(&begun);
        match first_change(duration, changed) {
            // First to just before it, so that no stage sees the law that follows; the next sub-step crosses it.
            Some((before, after)) => {
                let taken = if before > 0.0 { before } else { after };
                (taken, self.stepped(taken, friction))
            }
            None => (duration, full),
        }
    }

    /// Torque in N m in the frame of the body, without Coulomb friction; and what of it is the hand's.
    fn smooth_torque(&self, t: f64, state: &State) -> (Axes<3>, Pull) {
        let State { orientation, .. } = state;
        let w = self.body_velocity(state);
        let pull = self.hand.pull(self.hand_time(self.time), self.hand_time(t), orientation, &w);
        let springs: Axes<3> = self.springs.iter().map(|spring| spring.torque(orientation, &w)).sum();
        let held = orientation.inverse_transform_vector(&self.held_torque);
        (held + pull.torque + springs - w * self.device.viscous, pull)
    }

    /// A step of `duration` in s.
    fn stepped(&self, duration: f64, friction: Friction) -> Step {
        let State { orientation, momentum } = self.state;
        let (mut begun, mut changes, mut reverses) = (None, false, false);
        let mut slope = |share: f64, turn: &Axes<3>, momentum: Axes<3>| {
            let turned = orientation * UnitQuaternion::from_scaled_axis(*turn);
            let state = State { orientation: turned, momentum };
            let w = self.body_velocity(&state);
            let (mut torque, pull) = self.smooth_torque(self.time + share * duration, &state);
            changes |= pull.differs(begun.get_or_insert(pull));
            if let Friction::Along(direction) | Friction::AlongPush(direction) = friction {
                reverses |= w.dot(&direction) < 0.0;
                let of = if let Friction::Along(_) = friction { w } else { torque };
                let coulomb = self.device.coulomb;
                torque -=
                    if of.dot(&direction) > 0.0 { of * (coulomb / of.norm()) } else { direction * coulomb };
            }
            let twist = turn.cross(&w);
            (w + twist / 2.0 + turn.cross(&twist) / 12.0, turned * torque)
        };
        let half = duration / 2.0;
        let (turn_1, gain_1) = slope(0.0, &Axes::zeros(), momentum);
        let (turn_2, gain_2) = slope(0.5, &(turn_1 * half), momentum + gain_1 * half);
        let (turn_3, gain_3) = slope(0.5, &(turn_2 * half), momentum + gain_2 * half);
        let (turn_4, gain_4) = slope(1.0, &(turn_3 * duration), momentum + gain_3 * duration);
        let turn = (turn_1 + turn_4 + (turn_2 + turn_3) * 2.0) * (duration / 6.0);
        let gain = (gain_1 + gain_4 + (gain_2 + gain_3) * 2.0) * (duration / 6.0);
        let turned = orientation * UnitQuaternion::from_scaled_axis(turn);
        let orientation = UnitQuaternion::new_normalize(turned.into_inner());
        Step { state: State { orientation, momentum: momentum + gain }, changes, reverses }
    }
}

/// Times in s just before and just after the first change within `duration`, at most [`MIN_SHARE`] of it apart. Quarters
/// of it find the change, halves locate it.
fn first_change(duration: f64, changed: impl Fn(f64) -> bool) -> Option<(f64, f64)> {
    let quarter = 0.25 * duration;
    let mut after = [quarter, 2.0 * quarter, 3.0 * quarter, duration].into_iter().find(|&t| changed(t))?;
    let mut before = after - quarter;
    while after - before > MIN_SHARE * duration {
        let middle = 0.5 * (before + after);
        if changed(middle) { after = middle } else { before = middle }
    }
    Some((before, after))
}
