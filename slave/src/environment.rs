//! What the remote arm meets along one axis: a wall, and something that shoves it.

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

    /// Force on the tool in N at x in m.
    pub fn force(&self, position: f64) -> f64 {
        self.stiffness * (self.surface - position).max(0.0)
    }

    /// K in N/m.
    pub fn stiffness(&self) -> f64 {
        self.stiffness
    }

    /// `x_w` in m.
    pub fn surface(&self) -> f64 {
        self.surface
    }
}

/// Something that shoves the tool: a force that rises, stays and ends.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pusher {
    at_s: f64,
    rise_s: f64,
    duration_s: f64,
    force_n: f64,
}

impl Pusher {
    /// Begins at `at_s`, rises linearly over `rise_s` to `force_n` (N, positive along +x) and ends at
    /// `at_s + duration_s`.
    pub fn new(at_s: f64, rise_s: f64, duration_s: f64, force_n: f64) -> Result<Self, ModelError> {
        require("push time", at_s, true, "finite")?;
        require("push rise", rise_s, rise_s >= 0.0, "finite and 0 or more")?;
        require("push duration", duration_s, duration_s >= 0.0, "finite and 0 or more")?;
        require("push force", force_n, true, "finite")?;
        Ok(Self { at_s, rise_s, duration_s, force_n })
    }

    /// Force on the tool in N at time t in s.
    pub fn force(&self, t: f64) -> f64 {
        let since = t - self.at_s;
        if since < 0.0 || since >= self.duration_s {
            0.0
        } else if since < self.rise_s {
            self.force_n * since / self.rise_s
        } else {
            self.force_n
        }
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

    #[test]
    fn a_push_rises_stays_and_ends() {
        let pusher = Pusher::new(2.0, 0.1, 1.0, -4.0).unwrap();
        for (t, f) in [(1.9, 0.0), (2.0, 0.0), (2.05, -2.0), (2.5, -4.0), (3.0, 0.0)] {
            assert!((pusher.force(t) - f).abs() < 1e-12, "{t}");
        }
    }
}
