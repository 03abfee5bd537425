//! Model of an arm: its control, mass and limits.

use std::f64::consts::TAU;

use crate::{Axes, ModelError, require};

/// Control of an arm, the same on every axis; w = 2 pi bandwidth.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum ArmControl {
    /// A position: `M x'' = M w² (x_set - x) - 2 M w V + F_e`.
    Position {
        /// In Hz (> 0).
        bandwidth_hz: f64,
    },
    /// A velocity: `M V' = M w (V_set - V) + F_e`; a force acts as through an admittance.
    ///
    /// For position commands, `V_set = (w / 4) (x_cmd - x) + V_cmd`: a quarter of w makes the position critically
    /// damped. With a limit on the acceleration, `V_set` follows within its limits as a first-order system of 10 w.
    Velocity {
        /// In Hz (> 0).
        bandwidth_hz: f64,
    },
    /// `M x'' = K_s (x_set - x) + B_s (V_cmd - V) + F_e`.
    Pd {
        /// `K_s` in N/m (>= 0).
        stiffness: f64,
        /// `B_s` in N s/m (>= 0).
        damping: f64,
    },
}

/// An arm, the same on every axis.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ArmModel {
    control: ArmControl,
    mass_kg: f64,
    limits: Limits,
    /// b in N s/m of an arm that takes forces; None for an arm that takes motions only.
    viscous: Option<f64>,
    /// Derived from control and mass; stored because every step uses it.
    impedance: (f64, f64, bool),
}

/// Limits of a set value along each axis; infinite without a limit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Limits {
    pub(crate) speed: f64,
    pub(crate) acceleration: f64,
}

impl ArmModel {
    /// Control, M in kg (> 0: the moved mass as seen at the tool), and the optional limits of the set value along each
    /// axis: speed in m/s and acceleration in m/s².
    pub fn new(
        control: ArmControl,
        mass_kg: f64,
        max_speed: Option<f64>,
        max_acceleration: Option<f64>,
    ) -> Result<Self, ModelError> {
        match control {
            ArmControl::Position { bandwidth_hz } | ArmControl::Velocity { bandwidth_hz } => {
                require("arm bandwidth", bandwidth_hz, bandwidth_hz > 0.0, "finite and above 0")?;
            }
            ArmControl::Pd { stiffness, damping } => {
                require("arm stiffness", stiffness, stiffness >= 0.0, "finite and 0 or more")?;
                require("arm damping", damping, damping >= 0.0, "finite and 0 or more")?;
            }
        }
        require("arm mass", mass_kg, mass_kg > 0.0, "finite and above 0")?;
        let bound = |name, limit: Option<f64>| match limit {
            Some(limit) => require(name, limit, limit > 0.0, "finite and above 0").map(|()| limit),
            None => Ok(f64::INFINITY),
        };
        let limits = Limits {
            speed: bound("arm speed", max_speed)?,
            acceleration: bound("arm acceleration", max_acceleration)?,
        };
        Ok(Self { control, mass_kg, limits, viscous: None, impedance: control.impedance(mass_kg) })
    }

    /// Let the arm take forces, `M x'' = F_c - b V + F_e`, with b in N s/m (>= 0). Between them it takes motions.
    pub fn taking_forces(self, viscous: f64) -> Result<Self, ModelError> {
        require("arm friction", viscous, viscous >= 0.0, "finite and 0 or more")?;
        if matches!(self.control, ArmControl::Velocity { .. }) {
            let allowed = "\"position\" or \"pd\" for an arm that takes forces";
            return Err(ModelError { name: "slave control", seen: f64::NAN, allowed });
        }
        Ok(Self { viscous: Some(viscous), ..self })
    }

    pub(crate) fn viscous(&self) -> Option<f64> {
        self.viscous
    }

    /// Its control.
    pub fn control(&self) -> ArmControl {
        self.control
    }

    /// M in kg.
    pub fn mass_kg(&self) -> f64 {
        self.mass_kg
    }

    pub(crate) fn limits(&self) -> Limits {
        self.limits
    }

    /// K and B of `M x'' = K (x_set - x) + B (V_cmd - V) + F_e`, and true if the control uses `V_cmd`.
    ///
    /// For velocity control they hold under position commands while the set velocity is within its limits.
    pub(crate) fn impedance(&self) -> (f64, f64, bool) {
        self.impedance
    }
}

impl ArmControl {
    fn impedance(self, mass_kg: f64) -> (f64, f64, bool) {
        match self {
            Self::Position { bandwidth_hz } => {
                let pole = TAU * bandwidth_hz;
                (mass_kg * pole * pole, 2.0 * mass_kg * pole, false)
            }
            Self::Velocity { bandwidth_hz } => {
                let pole = TAU * bandwidth_hz;
                (0.25 * mass_kg * pole * pole, mass_kg * pole, true)
            }
            Self::Pd { stiffness, damping } => (stiffness, damping, true),
        }
    }
}

/// A command: target position, and the velocity there.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Command<const N: usize> {
    pub(crate) position: Axes<N>,
    pub(crate) velocity: Axes<N>,
}
