//! Model of an arm: its control, mass and limits.

use std::f64::consts::TAU;

use crate::{Axes, ModelError, require};

/// An arm along one axis whose controller pulls the tool to the set position like a critically damped spring.
///
/// `M x'' = M w² (x_set - x) - 2 M w x' + F_e`, with w = 2 pi bandwidth.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ArmParameters {
    /// M in kg (> 0): the mass that the controller moves, as seen at the tool.
    pub mass_kg: f64,
    /// Bandwidth of the position control in Hz (> 0).
    pub bandwidth_hz: f64,
    /// Speed limit of the set position in m/s (> 0).
    pub max_speed: f64,
}

impl Default for ArmParameters {
    /// A light arm with a fast position loop: 4 kg at 15 Hz is a compliance of 0.03 mm/N, and a UR moves at 1 m/s.
    fn default() -> Self {
        Self { mass_kg: 4.0, bandwidth_hz: 15.0, max_speed: 1.0 }
    }
}

impl ArmParameters {
    pub(crate) fn check(&self) -> Result<(), ModelError> {
        require("arm mass", self.mass_kg, self.mass_kg > 0.0, "finite and above 0")?;
        require("arm bandwidth", self.bandwidth_hz, self.bandwidth_hz > 0.0, "finite and above 0")?;
        require("arm speed", self.max_speed, self.max_speed > 0.0, "finite and above 0")
    }

    /// w in rad/s.
    pub(crate) fn pole(&self) -> f64 {
        TAU * self.bandwidth_hz
    }

    /// Stiffness of the position control in N/m.
    pub fn stiffness(&self) -> f64 {
        self.mass_kg * self.pole() * self.pole()
    }
}

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
        Ok(Self { control, mass_kg, limits, impedance: control.impedance(mass_kg) })
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

/// A command: target position, if any, and the velocity there.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Command<const N: usize> {
    pub(crate) position: Option<Axes<N>>,
    pub(crate) velocity: Axes<N>,
}
