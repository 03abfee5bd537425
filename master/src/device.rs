//! A haptic device along one axis.

use crate::{ModelError, require};

/// Mechanics and encoder of a device along one axis.
///
/// Source: paper Eq. 3.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DeviceParameters {
    /// m in kg (> 0).
    pub mass_kg: f64,
    /// b in N s/m; may be negative.
    pub viscous: f64,
    /// c in N (>= 0): friction while moving, and the largest force that friction withstands at rest.
    pub coulomb: f64,
    /// Resolution of the position measurement in m; 0 measures position and velocity exactly.
    pub encoder_quantum: f64,
    /// Positions in m of the mechanical stops, which take all speed; infinite without stops.
    pub stops: (f64, f64),
}

impl DeviceParameters {
    /// PHANTOM Desktop: m, b, c from the paper, section 4.1; 0.023 mm is the vendor's nominal resolution.
    ///
    /// Its stops are left out: the paper throws the stylus over 0.14 m and plots no stop.
    pub const PHANTOM_DESKTOP: Self = Self {
        mass_kg: 0.157,
        viscous: -0.005,
        coulomb: 0.038,
        encoder_quantum: 2.3e-5,
        stops: (f64::NEG_INFINITY, f64::INFINITY),
    };

    pub(crate) fn check(&self) -> Result<(), ModelError> {
        require("mass_kg", self.mass_kg, self.mass_kg > 0.0, "finite and above 0")?;
        require("viscous", self.viscous, true, "finite")?;
        require("coulomb", self.coulomb, self.coulomb >= 0.0, "finite and 0 or more")?;
        let quantum = self.encoder_quantum;
        require("encoder_quantum", quantum, quantum >= 0.0, "finite and 0 or more")?;
        // Infinite stops are allowed, so this is not `require`.
        if self.stops.0 < self.stops.1 {
            Ok(())
        } else {
            Err(ModelError { name: "lower stop", seen: self.stops.0, allowed: "below the upper stop" })
        }
    }

    /// What the encoder says of a position in m.
    pub fn encode(&self, position: f64) -> f64 {
        if self.encoder_quantum > 0.0 {
            (position / self.encoder_quantum).round() * self.encoder_quantum
        } else {
            position
        }
    }
}
