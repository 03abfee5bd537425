//! The set position of one axis, limited in speed and acceleration.

use crate::arm::model::Limits;

/// Distance in m that counts as none: far above rounding at a metre, far below what a controller shows.
const THERE: f64 = 1e-13;

/// A set position that goes to its target as fast as its limits allow.
///
/// With a limit on the acceleration it accelerates, cruises and brakes to rest at the target: the time-optimal motion.
/// Each phase has a constant acceleration, so it is exact.
///
/// Source: the double integrator, e.g. A. E. Bryson, Y.-C. Ho, "Applied optimal control", 1975, section 3.9.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct SetPoint {
    pub(crate) position: f64,
    pub(crate) velocity: f64,
    pub(crate) acceleration: f64,
    /// What is left of the present phase, in s.
    pub(crate) phase: f64,
    /// Whether the target is reached when the phase ends.
    arrives: bool,
}

impl SetPoint {
    pub(crate) fn at_rest(position: f64) -> Self {
        Self { position, velocity: 0.0, acceleration: 0.0, phase: f64::INFINITY, arrives: false }
    }

    /// Chooses the phase that begins now.
    pub(crate) fn plan(&mut self, target: f64, limits: &Limits) {
        let away = target - self.position;
        self.arrives = true;
        if limits.acceleration.is_finite() {
            self.plan_smooth(away, limits);
        } else {
            self.acceleration = 0.0;
            if away == 0.0 || limits.speed.is_infinite() {
                self.velocity = 0.0;
                self.position = target;
                self.phase = f64::INFINITY;
            } else {
                self.velocity = limits.speed.copysign(away);
                self.phase = away.abs() / limits.speed;
            }
        }
    }

    fn plan_smooth(&mut self, away: f64, limits: &Limits) {
        let Limits { speed, acceleration } = *limits;
        // What is left of the way when it brakes at once.
        let spare = away - self.velocity * self.velocity.abs() / (2.0 * acceleration);
        if spare.abs() <= THERE {
            if self.velocity == 0.0 {
                self.position += away;
                self.acceleration = 0.0;
                self.phase = f64::INFINITY;
            } else {
                self.acceleration = -acceleration.copysign(self.velocity);
                self.phase = self.velocity.abs() / acceleration;
            }
            return;
        }
        self.arrives = false;
        let towards = 1_f64.copysign(spare);
        let (present, spare) = (self.velocity * towards, spare.abs());
        if present >= speed * (1.0 - 1e-12) {
            self.acceleration = 0.0;
            self.phase = spare / present;
        } else {
            // It would be as fast as this where it has to brake.
            let way = away * towards;
            let peak = (acceleration * way + 0.5 * present * present).max(0.0).sqrt().min(speed);
            self.acceleration = acceleration * towards;
            // A phase that rounding has made empty must end nevertheless.
            self.phase = ((peak - present) / acceleration).max(1e-12);
        }
    }

    /// Moves on by `step` in s, no further than the phase lasts.
    pub(crate) fn advance(&mut self, step: f64, target: f64, limits: &Limits) {
        if self.phase.is_infinite() {
            return;
        }
        let whole = step >= self.phase * (1.0 - 1e-12);
        if whole && self.arrives {
            *self = Self::at_rest(target);
            return;
        }
        self.position += step * (self.velocity + 0.5 * step * self.acceleration);
        self.velocity = (self.velocity + step * self.acceleration).clamp(-limits.speed, limits.speed);
        self.phase -= step;
    }

    /// Where it comes to rest if it brakes at once.
    pub(crate) fn nearest_rest(&self, limits: &Limits) -> f64 {
        if limits.acceleration.is_finite() {
            self.position + self.velocity * self.velocity.abs() / (2.0 * limits.acceleration)
        } else {
            self.position
        }
    }
}
