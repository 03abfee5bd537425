//! A rigid body in space: its state, and its rates under a wrench.

use nalgebra::{Unit, UnitQuaternion};

use crate::Axes;

/// Mass, and moments of inertia about the axes of the body frame through its centre of mass.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Inertia {
    pub(super) mass_kg: f64,
    pub(super) moments: Axes<3>,
}

/// A rigid body in the base frame: centre of mass, orientation, momenta.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Rigid {
    pub(super) position: Axes<3>,
    pub(super) velocity: Axes<3>,
    /// R, `base_from_body`.
    pub(super) orientation: UnitQuaternion<f64>,
    /// `L = R I w` in N m s, in the base frame.
    pub(super) momentum: Axes<3>,
}

/// A force, and its torque about the centre of mass, in the base frame.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Load {
    pub(super) force: Axes<3>,
    pub(super) torque: Axes<3>,
}

impl Load {
    /// Add a force that acts `lever` from the centre of mass.
    pub(super) fn add(&mut self, force: &Axes<3>, lever: &Axes<3>) {
        self.force += force;
        self.torque += lever.cross(force);
    }
}

/// Rates of a body: `x'`, `v'`, that of its rotation vector since the start of the step, `L'`.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Rate {
    position: Axes<3>,
    velocity: Axes<3>,
    turn: Axes<3>,
    momentum: Axes<3>,
}

impl Rigid {
    /// w in rad/s, in the base frame.
    pub(super) fn angular_velocity(&self, inertia: &Inertia) -> Axes<3> {
        self.orientation * self.body_velocity(inertia)
    }

    fn body_velocity(&self, inertia: &Inertia) -> Axes<3> {
        (self.orientation.inverse() * self.momentum).component_div(&inertia.moments)
    }

    pub(super) fn kinetic_energy_j(&self, inertia: &Inertia) -> f64 {
        0.5 * inertia.mass_kg * self.velocity.norm_squared()
            + 0.5 * self.momentum.dot(&self.angular_velocity(inertia))
    }

    /// Rates under a load, after a rotation by `turn` since the start of the step.
    ///
    /// `Theta' = w + Theta x w / 2 + Theta x (Theta x w) / 12`, for `R exp(Theta)`, with w in the body frame.
    ///
    /// Source: Munthe-Kaas 1998, section 4, the terms of `dexp^-1` that order 4 needs.
    pub(super) fn rate(&self, inertia: &Inertia, load: &Load, turn: &Axes<3>) -> Rate {
        let w = self.body_velocity(inertia);
        let once = turn.cross(&w);
        Rate {
            position: self.velocity,
            velocity: load.force / inertia.mass_kg,
            turn: w + once / 2.0 + turn.cross(&once) / 12.0,
            momentum: load.torque,
        }
    }

    /// State `step` s after this one at constant rates, and the rotation of the body until then.
    pub(super) fn after(&self, rate: &Rate, step: f64) -> (Self, Axes<3>) {
        let turn = rate.turn * step;
        let orientation = self.orientation * UnitQuaternion::from_scaled_axis(turn);
        let after = Self {
            position: self.position + rate.position * step,
            velocity: self.velocity + rate.velocity * step,
            orientation: Unit::new_normalize(orientation.into_inner()),
            momentum: self.momentum + rate.momentum * step,
        };
        (after, turn)
    }
}

/// Weighted mean of the four Runge-Kutta rates.
pub(super) fn mean(rates: &[Rate; 4]) -> Rate {
    let of = |part: fn(&Rate) -> Axes<3>| {
        let [a, b, c, d] = rates.each_ref().map(part);
        (a + (b + c) * 2.0 + d) / 6.0
    };
    Rate {
        position: of(|rate| rate.position),
        velocity: of(|rate| rate.velocity),
        turn: of(|rate| rate.turn),
        momentum: of(|rate| rate.momentum),
    }
}
