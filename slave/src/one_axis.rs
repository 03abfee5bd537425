//! Arm, wall and pusher along one axis, advanced exactly under a held command and a held push.

use nalgebra::{Matrix2, Vector2};

use crate::{ArmParameters, ModelError, Pusher, require};

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

/// Arm, wall and pusher along one axis.
///
/// Between contact and release of the wall the motion is linear and time-invariant, `s' = A (s - s_rest)` with
/// `s = (x, V)`. A step is therefore `s_rest + e^{A h} (s - s_rest)`, which is exact. Contact is located inside a step.
/// Set position and push are held over a step of at most one millisecond.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct HeldArm {
    arm: ArmParameters,
    wall: Wall,
    pusher: Option<Pusher>,
    free: Regime,
    touching: Regime,
    state: Vector2<f64>,
    commanded: f64,
    set_position: f64,
    now_ns: u64,
    /// Origin of the pusher's time, once started.
    started_ns: Option<u64>,
}

/// Longest step in s: a push or a set position is sampled at least this often.
const LONGEST_STEP: f64 = 1e-3;

/// One of the two linear motions, with a stored `e^{A h}` for the longest step.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Regime {
    stiffness: f64,
    system: Matrix2<f64>,
    longest: Matrix2<f64>,
}

impl Regime {
    fn new(arm: &ArmParameters, wall_stiffness: f64) -> Self {
        let stiffness = arm.stiffness() + wall_stiffness;
        let system = Matrix2::new(0.0, 1.0, -stiffness / arm.mass_kg, -2.0 * arm.pole());
        Self { stiffness, system, longest: (system * LONGEST_STEP).exp() }
    }

    fn advanced(&self, state: Vector2<f64>, rest: Vector2<f64>, h: f64) -> Vector2<f64> {
        let transition = if h == LONGEST_STEP { self.longest } else { (self.system * h).exp() };
        rest + transition * (state - rest)
    }
}

impl HeldArm {
    /// An arm at rest at `position` in m, at time `now_ns`.
    pub(crate) fn new(
        arm: ArmParameters,
        wall: Wall,
        pusher: Option<Pusher>,
        position: f64,
        now_ns: u64,
    ) -> Result<Self, ModelError> {
        arm.check()?;
        require("arm position", position, true, "finite")?;
        Ok(Self {
            arm,
            wall,
            pusher,
            free: Regime::new(&arm, 0.0),
            touching: Regime::new(&arm, wall.stiffness()),
            state: Vector2::new(position, 0.0),
            commanded: position,
            set_position: position,
            now_ns,
            started_ns: None,
        })
    }

    /// Start the pusher's time; later calls have no effect.
    pub(crate) fn start(&mut self, now_ns: u64) {
        self.started_ns.get_or_insert(now_ns);
    }

    /// Command a position in m; the set position moves there within the arm's speed limit. Values that are not finite
    /// are ignored.
    pub(crate) fn write(&mut self, position: f64) {
        if position.is_finite() {
            self.commanded = position;
        }
    }

    /// Set the clock to `now_ns` without advancing: the arm rests until then.
    pub(crate) fn begin(&mut self, now_ns: u64) {
        self.now_ns = now_ns;
    }

    /// Command the present set position and return it in m: the arm stays.
    pub(crate) fn stop(&mut self) -> f64 {
        self.commanded = self.set_position;
        self.commanded
    }

    /// Advance to `now_ns` (monotonic) and return x in m, V in m/s and `F_e` in N there.
    pub(crate) fn read(&mut self, now_ns: u64) -> [f64; 3] {
        let mut left = now_ns.saturating_sub(self.now_ns) as f64 * 1e-9;
        let mut time = self.pusher_time(self.now_ns);
        self.now_ns = self.now_ns.max(now_ns);
        while left > LONGEST_STEP * (1.0 + 1e-9) {
            self.advance(time, LONGEST_STEP);
            time += LONGEST_STEP;
            left -= LONGEST_STEP;
        }
        if left > 0.0 {
            // A tick of one millisecond arrives here with rounding: use the stored transition.
            let step = if (left - LONGEST_STEP).abs() < 1e-12 { LONGEST_STEP } else { left };
            self.advance(time, step);
        }
        let push = self.push(self.pusher_time(self.now_ns));
        [self.state.x, self.state.y, self.wall.force(self.state.x) + push]
    }

    /// True if the tool is inside the wall.
    pub(crate) fn touches(&self) -> bool {
        self.wall.force(self.state.x) != 0.0
    }

    fn pusher_time(&self, now_ns: u64) -> f64 {
        match self.started_ns {
            Some(started) if now_ns >= started => (now_ns - started) as f64 * 1e-9,
            _ => f64::NEG_INFINITY,
        }
    }

    fn push(&self, time: f64) -> f64 {
        if time.is_finite() { self.pusher.as_ref().map_or(0.0, |pusher| pusher.force(time)[0]) } else { 0.0 }
    }

    fn advance(&mut self, time: f64, step: f64) {
        let limit = self.arm.max_speed * step;
        self.set_position += (self.commanded - self.set_position).clamp(-limit, limit);
        let pull = self.arm.stiffness() * self.set_position + self.push(time);
        let mut left = step;
        // Entry and exit of a wall within one step are two crossings; more would need a pole above the step rate.
        for _ in 0..4 {
            let inside = self.state.x < self.wall.surface()
                || (self.state.x == self.wall.surface() && self.state.y < 0.0);
            let (regime, force) = if inside {
                (&self.touching, pull + self.wall.stiffness() * self.wall.surface())
            } else {
                (&self.free, pull)
            };
            let rest = Vector2::new(force / regime.stiffness, 0.0);
            let next = regime.advanced(self.state, rest, left);
            let crossed = (next.x < self.wall.surface()) != inside;
            if !crossed || self.wall.stiffness() == 0.0 {
                self.state = next;
                return;
            }
            let (mut before, mut after) = (0.0, left);
            for _ in 0..52 {
                let middle = 0.5 * (before + after);
                let there = regime.advanced(self.state, rest, middle);
                if (there.x < self.wall.surface()) == inside { before = middle } else { after = middle }
            }
            self.state = regime.advanced(self.state, rest, after);
            self.state.x = self.wall.surface();
            left -= after;
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
}
