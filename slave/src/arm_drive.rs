//! An arm under way: its command, its set position and what its controller makes of both.

use crate::{
    ArmControl, ArmModel, Axes,
    arm::{Command, Limits},
    set_point::SetPoint,
    solve::Tool,
};

/// How much faster than the velocity control its limited set velocity is.
const FOLLOWS: f64 = 10.0;

/// An arm and what it is told.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct ArmDrive<const N: usize> {
    model: ArmModel,
    command: Command<N>,
    set_points: [SetPoint; N],
}

impl<const N: usize> ArmDrive<N> {
    pub(crate) fn new(model: ArmModel, position: &Axes<N>) -> Self {
        Self {
            model,
            command: Command { position: Some(*position), velocity: Axes::zeros() },
            set_points: std::array::from_fn(|axis| SetPoint::at_rest(position[axis])),
        }
    }

    pub(crate) fn model(&self) -> &ArmModel {
        &self.model
    }

    pub(crate) fn set_points(&self) -> &[SetPoint; N] {
        &self.set_points
    }

    pub(crate) fn command(&mut self, position: Option<Axes<N>>, velocity: Axes<N>) {
        self.command = Command { position, velocity };
    }

    /// Stays: brakes the set position, or the tool of a velocity control. Gives where it comes to rest, in m.
    ///
    /// A set position that rests stays as it is: one that went to where the tool is would let an arm that leans on
    /// something, or carries something, give way. A velocity control has none. With a pole p and the command x* its
    /// position obeys `x'' + p x' + p²/4 (x - x*) = 0`, which from V at x comes to rest without a swing for
    /// `x* >= x + 2 V / p`.
    pub(crate) fn stop(&mut self, tool: &Tool<N>) -> Axes<N> {
        let limits = self.model.limits();
        let rest = if self.is_velocity_control() {
            let (_, damping, _) = self.model.impedance();
            let coasts = tool.velocity * (2.0 * self.model.mass_kg() / damping);
            let brakes = tool.set_velocity.map(|v| v * v.abs() / (2.0 * limits.acceleration));
            tool.position + coasts + brakes
        } else {
            Axes::from_fn(|axis, _| self.set_points[axis].nearest_rest(&limits))
        };
        self.command(Some(rest), Axes::zeros());
        rest
    }

    /// Whether it takes a velocity.
    pub(crate) fn is_velocity_control(&self) -> bool {
        matches!(self.model.control(), ArmControl::Velocity { .. })
    }

    /// Chooses the phases of the set position that begin now.
    pub(crate) fn plan(&mut self) {
        if let (Some(target), false) = (self.command.position, self.is_velocity_control()) {
            let limits = self.model.limits();
            for (axis, set_point) in self.set_points.iter_mut().enumerate() {
                set_point.plan(target[axis], &limits);
            }
        }
    }

    /// How long the present phases last, in s.
    pub(crate) fn phase(&self) -> f64 {
        self.set_points.iter().fold(f64::INFINITY, |least, set_point| least.min(set_point.phase))
    }

    /// Moves the set position on by `step` in s, no further than the present phases last.
    pub(crate) fn advance(&mut self, step: f64) {
        if let Some(target) = self.command.position {
            let limits = self.model.limits();
            for (axis, set_point) in self.set_points.iter_mut().enumerate() {
                set_point.advance(step, target[axis], &limits);
            }
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
        let (stiffness, damping, feed_forward) = self.model.impedance();
        if !self.is_velocity_control() {
            let set = Axes::from_fn(|axis, _| {
                let SetPoint { position, velocity, acceleration, .. } = self.set_points[axis];
                position + since * (velocity + 0.5 * since * acceleration)
            });
            let wanted = if feed_forward { self.command_velocity() } else { Axes::zeros() };
            let pull = (set - tool.position) * stiffness + (wanted - tool.velocity) * damping;
            return ((pull + force) / mass, Axes::zeros());
        }
        let pole = damping / mass;
        let target =
            self.command.position.map_or_else(Axes::zeros, |at| (at - tool.position) * (0.25 * pole));
        let target = self.within_speed(&(target + self.command.velocity));
        let most = self.model.limits().acceleration;
        let (set, change) = if most.is_finite() {
            let change = (target - tool.set_velocity) * (FOLLOWS * pole);
            (tool.set_velocity, change.map(|a| a.clamp(-most, most)))
        } else {
            (target, Axes::zeros())
        };
        ((set - tool.velocity) * pole + force / mass, change)
    }

    /// M in kg, K in N/m and B in N s/m that an implicit step has to count with.
    pub(crate) fn inertia(&self) -> (f64, f64, f64) {
        let (stiffness, damping, _) = self.model.impedance();
        (self.model.mass_kg(), stiffness, damping)
    }
}
