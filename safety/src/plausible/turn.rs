//! Path of a rotation, from its last samples.

use nalgebra::UnitQuaternion;

use super::{
    bounds::{PerTick, SampleBounds},
    sample::Turned,
    track::{Change, MAX_EVERY, is_gap},
};
use crate::Axes;

/// Path of a rotation on SO(3), `R(k) = exp(w k) R_a`; as [`Track`](super::Track), with angles for lengths.
///
/// [`is_small`] compares the sine of half the angle, instead of half the angle, with half of the limit. Below 0.5 rad
/// the two differ by about 1 % at most.
#[derive(Clone, Copy, Debug)]
pub(super) struct TurnTrack {
    pub(super) bounds: PerTick,
    anchor: Option<UnitQuaternion<f64>>,
    /// `exp(w)`, w in rad per tick.
    rate: Option<UnitQuaternion<f64>>,
    since: f64,
    pub(super) same_for: f64,
    pub(super) every: f64,
}

/// Return whether the angle of a rotation is at most `angle` in rad.
#[inline]
pub(super) fn is_small(turn: &UnitQuaternion<f64>, angle: f64) -> bool {
    turn.imag().norm_squared() <= 0.25 * angle * angle
}

impl TurnTrack {
    pub(super) fn new(bounds: SampleBounds, period_s: f64) -> Self {
        Self::of(bounds.per_tick(period_s))
    }

    fn of(bounds: PerTick) -> Self {
        Self { bounds, anchor: None, rate: None, since: 0.0, same_for: 0.0, every: 1.0 }
    }

    pub(super) fn at(&self, ticks: f64) -> Option<UnitQuaternion<f64>> {
        let anchor = self.anchor?;
        let Some(rate) = self.rate else { return Some(anchor) };
        let k = self.since + ticks;
        Some(if k == 1.0 { rate } else { rate.powf(k) } * anchor)
    }

    /// Angular velocity in rad per tick; None before the second sample.
    pub(super) fn rate(&self) -> Option<Axes<3>> {
        self.rate.map(|rate| rate.scaled_axis())
    }

    fn contains(&self, orientation: &UnitQuaternion<f64>, ticks: f64, share: f64) -> bool {
        let (Some(anchor), Some(expected)) = (self.anchor, self.at(ticks)) else { return true };
        let PerTick { speed, change, quantum, .. } = self.bounds;
        let k = self.since + ticks;
        is_small(&anchor.rotation_to(orientation), speed * k + 2.0 * quantum)
            && (self.rate.is_none()
                || is_small(&expected.rotation_to(orientation), change * share + quantum * (k + 1.0)))
    }

    pub(super) fn accept(&mut self, orientation: &UnitQuaternion<f64>, ticks: f64, samples: f64) {
        let Some(anchor) = self.anchor.replace(*orientation) else { return };
        let (k, mut same_for) = (self.since + ticks, self.same_for + ticks);
        if is_gap(ticks, samples) {
            same_for += MAX_EVERY;
        }
        let is_same = *orientation == anchor;
        self.same_for = if is_same { same_for } else { 0.0 };
        if same_for <= MAX_EVERY && !is_small(&anchor.rotation_to(orientation), 2.0 * self.bounds.quantum) {
            self.every = same_for;
        }
        if self.rate.is_some() && is_same && k < self.every {
            self.since = k;
            return;
        }
        let turn = orientation * anchor.inverse();
        self.rate = Some(if k == 1.0 { turn } else { turn.powf(1.0 / k) });
        self.since = 0.0;
    }

    /// Forget the path, as [`Track::restart`](super::Track::restart).
    pub(super) fn restart(&mut self) {
        *self = Self { every: self.every, ..Self::of(self.bounds) };
    }

    /// Continue from a new orientation at the same rate, as [`Track::step_to`](super::Track::step_to).
    pub(super) fn step_to(&mut self, orientation: Option<UnitQuaternion<f64>>) {
        (self.anchor, self.since) = (orientation, 0.0);
    }

    /// Continue after a change of the path, as [`Track::resume`](super::Track::resume).
    pub(super) fn resume(&mut self, change: &Change<UnitQuaternion<f64>>, newest_at: f64, is_step: bool) {
        self.same_for = newest_at - change.at;
        let moved = change.to * change.from.inverse();
        let is_still = is_small(&moved, 2.0 * self.bounds.quantum);
        if !is_step && change.is_of_slow_device() && !is_still {
            (self.anchor, self.rate) = (Some(change.to), Some(moved.powf(1.0 / change.interval)));
            (self.since, self.every) = (newest_at - change.at, change.interval);
        }
    }

    /// Return whether a sample is on the path, and its measured angular velocity is within the bounds on speed and
    /// change.
    #[inline(never)]
    pub(super) fn contains_turned(&self, from: &Turned, to: &Turned, ticks: f64, share: f64) -> bool {
        let is_steady = match (&from.angular_velocity, &to.angular_velocity) {
            (Some(from), Some(to)) => self.bounds.is_steady(from, to, share),
            _ => true,
        };
        is_steady && self.contains(&to.orientation, ticks, share)
    }
}
