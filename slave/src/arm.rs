//! A position-controlled arm along one axis.

use crate::{ModelError, require};

/// An arm whose controller pulls the tool to the set position like a critically damped spring.
///
/// `M x'' = M w² (x_set - x) - 2 M w x' + F_e`, with w = 2 pi bandwidth.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ArmParameters {
    /// M in kg (> 0): what the controller moves, seen at the tool.
    pub mass_kg: f64,
    /// Bandwidth of the position control in Hz (> 0).
    pub bandwidth_hz: f64,
    /// Fastest that the set position moves, in m/s (> 0).
    pub max_speed: f64,
}

impl Default for ArmParameters {
    /// A light arm under a fast position loop: 4 kg at 15 Hz is a compliance of 0.03 mm/N; a UR's 1 m/s.
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
        std::f64::consts::TAU * self.bandwidth_hz
    }

    /// Stiffness of the position control in N/m.
    pub fn stiffness(&self) -> f64 {
        self.mass_kg * self.pole() * self.pole()
    }
}
