//! How an object moves on its own.

use crate::{Axes, ModelError, axes::require_axes, contact::window::Window, require};

/// Constant velocity for a while, and a sine on top.
///
/// `p(t) = p_0 + V (min(t, until) - from)+ + a sin(2 pi f t)`
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ObjectMotion<const N: usize> {
    velocity: Axes<N>,
    window: Window,
    amplitude: Axes<N>,
    /// 2 pi f in rad/s.
    rate: f64,
}

impl<const N: usize> ObjectMotion<N> {
    /// V in m/s between two times in s, a in m, f in Hz (>= 0).
    pub fn new(
        velocity: Axes<N>,
        begin_s: f64,
        until_s: f64,
        amplitude: Axes<N>,
        frequency_hz: f64,
    ) -> Result<Self, ModelError> {
        require_axes("motion velocity", &velocity, |_| true, "finite")?;
        require("motion begin", begin_s, true, "finite")?;
        require("motion end", until_s, until_s >= begin_s, "finite and not before its begin")?;
        require_axes("motion amplitude", &amplitude, |_| true, "finite")?;
        require("motion frequency", frequency_hz, frequency_hz >= 0.0, "finite and 0 or more")?;
        let window = Window::between(begin_s, until_s);
        Ok(Self { velocity, window, amplitude, rate: std::f64::consts::TAU * frequency_hz })
    }

    /// Displacement in m and velocity in m/s at t in s.
    pub fn at(&self, t: f64) -> (Axes<N>, Axes<N>) {
        self.on(t, t)
    }

    /// The same, on the smooth piece that holds at time `piece`.
    pub(crate) fn on(&self, piece: f64, t: f64) -> (Axes<N>, Axes<N>) {
        let (begin_s, until_s) = (self.window.begin_s(), self.window.until_s());
        let (mut displacement, mut velocity) = if self.window.contains(piece) {
            (self.velocity * (t - begin_s), self.velocity)
        } else if self.window.begins_after(piece) {
            (Axes::zeros(), Axes::zeros())
        } else {
            (self.velocity * (until_s - begin_s), Axes::zeros())
        };
        if self.rate > 0.0 {
            let (sin, cos) = (self.rate * t).sin_cos();
            displacement += self.amplitude * sin;
            velocity += self.amplitude * (self.rate * cos);
        }
        (displacement, velocity)
    }

    /// First time after t at which the velocity jumps.
    pub(crate) fn next_kink(&self, t: f64) -> f64 {
        self.window.next_bound(t)
    }

    /// No point of it is ever faster, in m/s.
    pub(crate) fn top_speed(&self) -> f64 {
        self.velocity.norm() + self.rate * self.amplitude.norm()
    }
}
