//! Virtual tool: turns the force of a coupling into a motion for an arm that takes positions.

use haptether_safety::Axes;

use super::super::{CouplingError, mapping::check};

/// Settings of a virtual tool.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct VirtualToolSettings {
    /// `M_v` in kg (kg m²).
    pub mass: f64,
    /// `B_v` in N s/m (N m s/rad).
    pub damping: f64,
    /// Time in s by which the arm lags behind its command.
    pub lead_s: f64,
}

/// Damping of a tool per mass, in 1/s, of a scene that states none.
const DAMPING_PER_MASS: f64 = 10.0;

impl VirtualToolSettings {
    /// Check the numbers; without a damping it is `10 M_v` per second.
    pub fn new(mass: f64, damping: Option<f64>, lead_s: f64) -> Result<Self, CouplingError> {
        check("tool_mass_kg", "M_v", mass)?;
        let damping = damping.unwrap_or(DAMPING_PER_MASS * mass);
        for (name, symbol, seen) in [("tool_damping", "B_v", damping), ("tool_lead_s", "tau", lead_s)] {
            if !(seen >= 0.0 && seen.is_finite()) {
                return Err(CouplingError::Negative { name, symbol, seen });
            }
        }
        Ok(Self { mass, damping, lead_s })
    }
}

/// Mass that the coupling and the environment push; the arm follows its position.
///
/// `M_v a = F_c + F_e - B_v v`, by semi-implicit Euler with an implicit damper, so that no damping makes it unstable. The
/// command is `x_v + tau v_v`: an arm that lags by tau is then where the tool is. Without this lead, a wall of stiffness
/// `K_e` would act on the tool like a damping of `-K_e tau`.
///
/// Source: Hogan 1985 (admittance control); Siciliano and Villani 1999. The lead is derived here: [decision
/// 096](../../../../docs/decisions/096-couplings.md).
#[derive(Clone, Copy, Debug)]
pub(crate) struct VirtualTool<const N: usize> {
    settings: VirtualToolSettings,
    position: Axes<N>,
    velocity: Axes<N>,
}

/// Return a velocity of at most `max_speed`.
pub(crate) fn capped<const N: usize>(velocity: &Axes<N>, max_speed: f64) -> Axes<N> {
    let speed = velocity.norm();
    if speed > max_speed { velocity * (max_speed / speed) } else { *velocity }
}

impl<const N: usize> VirtualTool<N> {
    pub(crate) fn new(settings: VirtualToolSettings) -> Self {
        Self { settings, position: Axes::zeros(), velocity: Axes::zeros() }
    }

    /// Position in m.
    pub(crate) fn position(&self) -> &Axes<N> {
        &self.position
    }

    /// Velocity in m/s.
    pub(crate) fn velocity(&self) -> &Axes<N> {
        &self.velocity
    }

    /// Rest at `position` in m.
    pub(crate) fn rest_at(&mut self, position: &Axes<N>) {
        (self.position, self.velocity) = (*position, Axes::zeros());
    }

    /// Take the state of an arm that takes forces, which has no virtual tool.
    pub(crate) fn measured(&mut self, [position, velocity]: [&Axes<N>; 2]) {
        (self.position, self.velocity) = (*position, *velocity);
    }

    /// Follow what bounds left of the command, in m: at most at `max_speed` in m/s, and not outwards where `leaves` is true.
    pub(crate) fn limit(&mut self, [wanted, command]: [&Axes<N>; 2], max_speed: f64, leaves: bool) {
        let moved = command - wanted;
        let inwards = moved.norm();
        if leaves && inwards > 0.0 {
            let direction = moved / inwards;
            self.velocity -= direction * self.velocity.dot(&direction).min(0.0);
        }
        self.velocity = capped(&self.velocity, max_speed);
        self.position = command - self.velocity * self.settings.lead_s;
    }

    /// Step over `dt` s with the forces `F_c` and `F_e` in N; return the command in m.
    pub(crate) fn step(&mut self, force: &Axes<N>, environment_force: &Axes<N>, dt: f64) -> Axes<N> {
        let VirtualToolSettings { mass, damping, lead_s } = self.settings;
        let push = (force + environment_force) * (dt / mass);
        self.velocity = (self.velocity + push) / (1.0 + dt * damping / mass);
        self.position += self.velocity * dt;
        self.position + self.velocity * lead_s
    }
}
