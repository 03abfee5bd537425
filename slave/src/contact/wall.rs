//! A spring wall along one axis.

use crate::{ModelError, require};

/// A spring wall that fills x below its surface and pushes along +x.
///
/// `F = K (x_w - x)` inside, 0 outside.
///
/// Source: paper Eq. 15 with B = 0, which section 4 uses throughout.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Wall {
    surface: f64,
    stiffness: f64,
}

impl Wall {
    /// Surface `x_w` in m, stiffness K in N/m (>= 0).
    pub fn new(surface: f64, stiffness: f64) -> Result<Self, ModelError> {
        require("wall position", surface, true, "finite")?;
        require("wall stiffness", stiffness, stiffness >= 0.0, "finite and 0 or more")?;
        Ok(Self { surface, stiffness })
    }

    /// K in N/m.
    pub fn stiffness(&self) -> f64 {
        self.stiffness
    }

    /// `x_w` in m.
    pub fn surface(&self) -> f64 {
        self.surface
    }

    /// Force on the tool in N at x in m.
    pub fn force(&self, position: f64) -> f64 {
        self.stiffness * (self.surface - position).max(0.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_wall_pushes_out_and_never_pulls() {
        let wall = Wall::new(0.1, 200.0).unwrap();
        for (x, f) in [(0.2, 0.0), (0.1, 0.0), (0.06, 8.0)] {
            assert!((wall.force(x) - f).abs() < 1e-12, "{x}");
        }
    }
}
