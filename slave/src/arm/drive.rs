//! An arm in motion: its command, its set position and the accelerations of its controller.

use crate::{
    ArmControl, ArmModel, Axes, all_finite,
    arm::model::{Command, Limits},
};

/// Ratio of the pole of the limited set velocity to that of the velocity control.
const FOLLOWS: f64 = 10.0;

/// An arm under a command.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct ArmDrive<const N: usize> {
    model: ArmModel,
    command: Command<N>,
    /// True if the command is the rest position of a stop.
    stops: bool,
    /// `F_c` in N; None while the arm follows its set position.
    force: Option<Axes<N>>,
    set_points: [SetPoint; N],
}

impl<const N: usize> ArmDrive<N> {
    pub(crate) fn new(model: ArmModel, position: &Axes<N>) -> Self {
        Self {
            model,
            command: Command { position: *position, velocity: Axes::zeros() },
            stops: false,
            force: None,
            set_points: std::array::from_fn(|axis| SetPoint::at_rest(position[axis])),
        }
    }

    pub(crate) fn model(&self) -> &ArmModel {
        &self.model
    }

    pub(crate) fn set_points(&self) -> &[SetPoint; N] {
        &self.set_points
    }

    /// Commanded position in m, and velocity in m/s.
    pub(crate) fn commanded(&self) -> (Axes<N>, Axes<N>) {
        (self.command.position, self.command.velocity)
    }

    /// True if the command is the rest position of a stop.
    pub(crate) fn stops(&self) -> bool {
        self.stops
    }

    /// Set command and set position, and continue from there. A plan must follow. Only for drives without a bound on
    /// the acceleration.
    pub(crate) fn resume(
        &mut self,
        (position, velocity): (Axes<N>, Axes<N>),
        stops: bool,
        set_position: &Axes<N>,
    ) {
        (self.command, self.stops) = (Command { position, velocity }, stops);
        for (set_point, position) in self.set_points.iter_mut().zip(set_position) {
            set_point.position = *position;
        }
    }

    /// Exert `force` in N instead of following a set position. Only an arm that takes forces does.
    pub(crate) fn exert(&mut self, force: &Axes<N>) {
        if self.model.viscous().is_some() && all_finite(force) {
            (self.force, self.stops) = (Some(*force), false);
        }
    }

    /// `F_c` in N; None while the arm follows its set position.
    pub(crate) fn exerted(&self) -> Option<&Axes<N>> {
        self.force.as_ref()
    }

    /// Follow a set position again, from where the tool is. A set position with a bound on its acceleration begins with the
    /// velocity of the tool.
    pub(crate) fn follow(&mut self, tool: &Tool<N>) {
        if self.force.take().is_none() {
            return;
        }
        let Limits { speed, acceleration } = self.model.limits();
        let keeps = if acceleration.is_finite() { speed } else { 0.0 };
        self.set_points = std::array::from_fn(|axis| SetPoint {
            velocity: tool.velocity[axis].clamp(-keeps, keeps),
            ..SetPoint::at_rest(tool.position[axis])
        });
    }

    /// K, B and the use of `V_cmd`, as [`ArmModel::impedance`]; friction alone while the arm exerts a force.
    pub(crate) fn impedance(&self) -> (f64, f64, bool) {
        match (self.force, self.model.viscous()) {
            (Some(_), Some(viscous)) => (0.0, viscous, false),
            _ => self.model.impedance(),
        }
    }

    pub(crate) fn command(&mut self, position: Axes<N>, velocity: Axes<N>) {
        let command = Command { position, velocity };
        self.stops &= command == self.command;
        self.command = command;
    }

    /// Brake the set position, or the tool under velocity control, and stay. Returns the rest position in m.
    ///
    /// A resting set position does not move to the tool: an arm that leans on something or carries something would
    /// yield. Velocity control has no set position.
    ///
    /// A control that uses the velocity of the command loses it at the stop. The motion from V at x is then
    /// `M x'' + B x' + K (x - x*) = 0`. With critical damping or more it comes to rest without overshoot for
    /// `x* >= x + 2 M V / B`. With less damping the swing is smallest near `x + V sqrt(M / K)`. A second stop before
    /// another command changes nothing.
    pub(crate) fn stop(&mut self, tool: &Tool<N>) -> Axes<N> {
        if self.stops {
            return self.command.position;
        }
        self.follow(tool);
        let limits = self.model.limits();
        let (stiffness, damping, feed_forward) = self.model.impedance();
        let mass = self.model.mass_kg();
        // In s. Without a spring no position is held.
        let coasts = (2.0 * mass / damping).min((mass / stiffness).sqrt());
        let coasts = if feed_forward && stiffness > 0.0 { tool.velocity * coasts } else { Axes::zeros() };
        let rest = Axes::from_fn(|axis, _| {
            let (position, coast) = (tool.position[axis], coasts[axis]);
            if self.is_velocity_control() {
                let v = tool.set_velocity[axis];
                return position + coast + v * v.abs() / (2.0 * limits.acceleration);
            }
            // Beyond the set position by at most twice the coast distance, and only in its direction.
            let set = self.set_points[axis].nearest_rest(&limits);
            let (low, high) = if coast < 0.0 { (2.0 * coast, 0.0) } else { (0.0, 2.0 * coast) };
            set + (position + coast - set).max(low).min(high)
        });
        self.command(rest, Axes::zeros());
        self.stops = true;
        rest
    }

    /// True if the controller takes a velocity.
    pub(crate) fn is_velocity_control(&self) -> bool {
        matches!(self.model.control(), ArmControl::Velocity { .. })
    }

    /// Choose the phases of the set position that start now.
    pub(crate) fn plan(&mut self) {
        if !self.is_velocity_control() {
            let limits = self.model.limits();
            for (axis, set_point) in self.set_points.iter_mut().enumerate() {
                set_point.plan(self.command.position[axis], &limits);
            }
        }
    }

    /// Time in s until the first of the present phases ends.
    pub(crate) fn phase(&self) -> f64 {
        self.set_points.iter().fold(f64::INFINITY, |first, set_point| first.min(set_point.phase))
    }

    /// Time in s left of the first phase that does not end [at rest from constant speed](SetPoint::arrives_steadily).
    pub(crate) fn unsteady_phase(&self) -> f64 {
        let unsteady = self.set_points.iter().filter(|set_point| !set_point.arrives_steadily());
        unsteady.fold(f64::INFINITY, |first, set_point| first.min(set_point.phase))
    }

    /// Advance the set position by `step` in s, at most to the end of the present [unsteady
    /// phases](Self::unsteady_phase).
    pub(crate) fn advance(&mut self, step: f64) {
        let limits = self.model.limits();
        for (axis, set_point) in self.set_points.iter_mut().enumerate() {
            set_point.advance(step, self.command.position[axis], &limits);
        }
    }

    /// `V_cmd` within the largest speed, in m/s.
    pub(crate) fn command_velocity(&self) -> Axes<N> {
        self.within_speed(&self.command.velocity)
    }

    pub(crate) fn within_speed(&self, velocity: &Axes<N>) -> Axes<N> {
        let Limits { speed, .. } = self.model.limits();
        velocity.map(|v| v.clamp(-speed, speed))
    }

    /// Accelerations in m/s² of the tool and of its set velocity under `force` in N, `since` s after the plan.
    pub(crate) fn accelerations(&self, since: f64, tool: &Tool<N>, force: &Axes<N>) -> (Axes<N>, Axes<N>) {
        let mass = self.model.mass_kg();
        let (stiffness, damping, feed_forward) = self.impedance();
        if !self.is_velocity_control() {
            let set = Axes::from_fn(|axis, _| {
                let SetPoint { position, velocity, acceleration, .. } = self.set_points[axis];
                position + since * (velocity + 0.5 * since * acceleration)
            });
            let wanted = if feed_forward { self.command_velocity() } else { Axes::zeros() };
            let pull = (set - tool.position) * stiffness + (wanted - tool.velocity) * damping;
            let exerted = self.force.unwrap_or_else(Axes::zeros);
            return ((pull + exerted + force) / mass, Axes::zeros());
        }
        let pole = damping / mass;
        let target = (self.command.position - tool.position) * (0.25 * pole);
        let target = self.within_speed(&(target + self.command.velocity));
        let limit = self.model.limits().acceleration;
        let (set, change) = if limit.is_finite() {
            let change = (target - tool.set_velocity) * (FOLLOWS * pole);
            (tool.set_velocity, change.map(|a| a.clamp(-limit, limit)))
        } else {
            (target, Axes::zeros())
        };
        ((set - tool.velocity) * pole + force / mass, change)
    }

    /// M in kg, K in N/m and B in N s/m for an implicit step.
    pub(crate) fn inertia(&self) -> (f64, f64, f64) {
        let (stiffness, damping, _) = self.impedance();
        (self.model.mass_kg(), stiffness, damping)
    }
}

/// The moving tool of an arm.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Tool<const N: usize> {
    pub(crate) position: Axes<N>,
    pub(crate) velocity: Axes<N>,
    /// Set velocity in m/s; used by velocity control with a limited acceleration.
    pub(crate) set_velocity: Axes<N>,
}

/// Distance in m that counts as zero: far above rounding at a metre, far below the resolution of a controller.
const THERE: f64 = 1e-13;

/// A set position that moves to its target as fast as its limits allow.
///
/// With a limit on the acceleration it accelerates, cruises and brakes to rest at the target: the time-optimal motion.
/// Each phase has a constant acceleration, so the motion is exact.
///
/// Source: the double integrator, e.g. A. E. Bryson, Y.-C. Ho, "Applied optimal control", 1975, section 3.9.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct SetPoint {
    pub(crate) position: f64,
    pub(crate) velocity: f64,
    pub(crate) acceleration: f64,
    /// Time left of the present phase, in s.
    pub(crate) phase: f64,
    /// True if the target is reached at the end of the phase.
    arrives: bool,
}

impl SetPoint {
    pub(crate) fn at_rest(position: f64) -> Self {
        Self { position, velocity: 0.0, acceleration: 0.0, phase: f64::INFINITY, arrives: false }
    }

    /// Choose the phase that starts now.
    pub(crate) fn plan(&mut self, target: f64, limits: &Limits) {
        let away = target - self.position;
        self.arrives = true;
        if limits.acceleration.is_finite() {
            self.plan_smooth(away, limits);
        } else {
            self.acceleration = 0.0;
            if away == 0.0 || limits.speed.is_infinite() {
                self.velocity = 0.0;
                self.position = target;
                self.phase = f64::INFINITY;
            } else {
                self.velocity = limits.speed.copysign(away);
                self.phase = away.abs() / limits.speed;
            }
        }
    }

    fn plan_smooth(&mut self, away: f64, limits: &Limits) {
        let Limits { speed, acceleration } = *limits;
        // Distance to the target from the point of rest if it brakes at once.
        let spare = away - self.velocity * self.velocity.abs() / (2.0 * acceleration);
        if spare.abs() <= THERE {
            if self.velocity == 0.0 {
                self.position += away;
                self.acceleration = 0.0;
                self.phase = f64::INFINITY;
            } else {
                self.acceleration = -acceleration.copysign(self.velocity);
                self.phase = self.velocity.abs() / acceleration;
            }
            return;
        }
        self.arrives = false;
        let towards = 1_f64.copysign(spare);
        let (present, spare) = (self.velocity * towards, spare.abs());
        if present >= speed * (1.0 - 1e-12) {
            self.acceleration = 0.0;
            self.phase = spare / present;
        } else {
            // Speed at which braking has to start.
            let way = away * towards;
            let peak = (acceleration * way + 0.5 * present * present).max(0.0).sqrt().min(speed);
            self.acceleration = acceleration * towards;
            // A phase that rounding made empty must still end.
            self.phase = ((peak - present) / acceleration).max(1e-12);
        }
    }

    /// True if it moves at constant speed until it arrives, and rests from then on.
    #[inline]
    pub(crate) fn arrives_steadily(&self) -> bool {
        self.arrives && self.acceleration == 0.0
    }

    /// Advance by `step` in s, at most to the end of the phase, unless it [rests](Self::arrives_steadily) afterwards.
    pub(crate) fn advance(&mut self, step: f64, target: f64, limits: &Limits) {
        if self.phase.is_infinite() {
            return;
        }
        let whole = step >= self.phase * (1.0 - 1e-12);
        if whole && self.arrives {
            *self = Self::at_rest(target);
            return;
        }
        self.position += step * (self.velocity + 0.5 * step * self.acceleration);
        self.velocity = (self.velocity + step * self.acceleration).clamp(-limits.speed, limits.speed);
        self.phase -= step;
    }

    /// Rest position if it brakes at once.
    pub(crate) fn nearest_rest(&self, limits: &Limits) -> f64 {
        if limits.acceleration.is_finite() {
            self.position + self.velocity * self.velocity.abs() / (2.0 * limits.acceleration)
        } else {
            self.position
        }
    }
}
