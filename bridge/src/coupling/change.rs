//! What an operator changes of a coupling while it runs: how far it may go, and how it fades.

use haptether_safety::Real;

use super::CouplingError;
use crate::{command::OperatorCommand, wire::Role};

/// Largest factor, up and down, by which a scale may be changed while the clutch is closed, unless the scene states another.
pub const CHANGE_FACTOR: f64 = 2.0;

/// The same with an open clutch: what goes further is a slip of the hand, or another scene.
pub const OPEN_FACTOR: f64 = 100.0;

/// Bounds of a scale while a side runs. They hang on the scene and not on the last change, so that no number of changes
/// leads out of them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ScaleRange {
    name: &'static str,
    symbol: &'static str,
    /// Least and largest while the clutch is closed.
    closed: [f64; 2],
    /// The same with an open clutch.
    open: [f64; 2],
}

impl ScaleRange {
    /// From `scene / factor` to `scene factor`, and as far as the scene itself changes it (`stated`).
    fn new(
        [name, symbol]: [&'static str; 2],
        scene: f64,
        factor: f64,
        stated: impl IntoIterator<Item = f64>,
    ) -> Self {
        let about = |factor: f64| [scene / factor, scene * factor];
        let [least, most] = stated
            .into_iter()
            .fold(about(factor), |[least, most], value| [least.min(value), most.max(value)]);
        let [lower, upper] = about(OPEN_FACTOR);
        Self { name, symbol, closed: [least, most], open: [lower.min(least), upper.max(most)] }
    }

    /// Of `lambda_p`: from `scene / factor` to `scene factor`, and as far as the scene itself changes it (`stated`).
    pub fn position(scene: f64, factor: f64, stated: impl IntoIterator<Item = f64>) -> Self {
        Self::new(["position_scale", "lambda_p"], scene, factor, stated)
    }

    /// The same of `lambda_f`.
    pub fn force(scene: f64, factor: f64, stated: impl IntoIterator<Item = f64>) -> Self {
        Self::new(["force_scale", "lambda_f"], scene, factor, stated)
    }

    /// The same of `lambda_r`.
    pub fn rotation(scene: f64, factor: f64, stated: impl IntoIterator<Item = f64>) -> Self {
        Self::new(["rotation_scale", "lambda_r"], scene, factor, stated)
    }

    /// The same of `lambda_tau`.
    pub fn torque(scene: f64, factor: f64, stated: impl IntoIterator<Item = f64>) -> Self {
        Self::new(["torque_scale", "lambda_tau"], scene, factor, stated)
    }

    /// Passes a scale within the bounds; `is_open`: the clutch is open, and no force is left.
    ///
    /// # Errors
    ///
    /// [`CouplingError::Change`], of what is no number, too.
    pub fn check(&self, seen: f64, is_open: bool) -> Result<f64, CouplingError> {
        let Self { name, symbol, closed, open } = *self;
        let [least, most] = if is_open { open } else { closed };
        if (least..=most).contains(&seen) {
            Ok(seen)
        } else {
            Err(CouplingError::Change { name, symbol, seen, closed, open })
        }
    }
}

/// The bounds of the scales that a side has.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ScaleRanges {
    /// Of `lambda_p` at a slave, of `lambda_f` at a master.
    pub translation: Option<ScaleRange>,
    /// Of `lambda_r` and `lambda_tau`, of a side that turns.
    pub rotation: Option<ScaleRange>,
}

impl ScaleRanges {
    /// Passes a command of the operator at the side `role`; scales of the other side are not this one's matter.
    ///
    /// # Errors
    ///
    /// [`CouplingError::Change`] and [`CouplingError::NoScale`].
    pub fn check(&self, role: Role, command: &OperatorCommand, is_open: bool) -> Result<(), CouplingError> {
        let (range, name, scale) = match (role, *command) {
            (Role::Master, OperatorCommand::ForceScale(scale)) => (&self.translation, "force_scale", scale),
            (Role::Slave, OperatorCommand::PositionScale(scale)) => {
                (&self.translation, "position_scale", scale)
            }
            (Role::Master, OperatorCommand::TorqueScale(scale)) => (&self.rotation, "torque_scale", scale),
            (Role::Slave, OperatorCommand::RotationScale(scale)) => (&self.rotation, "rotation_scale", scale),
            _ => return Ok(()),
        };
        range.as_ref().ok_or(CouplingError::NoScale(name))?.check(scale, is_open).map(|_| ())
    }
}

/// To six digits, for messages: what a factor leaves of a decimal number is none.
pub(super) fn rounded(number: f64) -> f64 {
    format!("{number:.5e}").parse().unwrap_or(number)
}

/// What to do about a scale that was refused.
pub(super) fn remedy(name: &str, seen: f64, [least, most]: [f64; 2]) -> String {
    if (least..=most).contains(&seen) {
        "release the clutch first, or state a larger coupling.change_factor in the scene".to_owned()
    } else {
        format!("set coupling.{name} in the scene")
    }
}

/// A number on its way to another, one step a tick along a straight line.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Ramp<S> {
    now: S,
    to: S,
    ticks: u32,
}

impl<S: Real> Ramp<S> {
    const fn at(now: S) -> Self {
        Self { now, to: now, ticks: 0 }
    }

    /// Sets out from where it is, to arrive after so many ticks.
    fn set(&mut self, to: S, ticks: u32) {
        (self.to, self.ticks) = (to, ticks);
        if ticks == 0 {
            self.now = to;
        }
    }

    /// One tick.
    fn step(&mut self) {
        if self.ticks > 1 {
            self.now += (self.to - self.now) / S::splat(f64::from(self.ticks));
            self.ticks -= 1;
        } else {
            self.set(self.to, 0);
        }
    }
}

/// The two scales of a coupling and the map between its sides, M, which an operator changes.
///
/// A scale goes along a straight line from what it is to what it is changed to. A map is exchanged where nothing passes:
/// both scales fade to zero, and from there rise with the new one. Time is ticks, so that a late loop makes up for nothing.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Changing<M, S = f64> {
    /// As they are at this tick.
    pub(super) motion: S,
    pub(super) force: S,
    pub(super) map: M,
    ramps: [Ramp<S>; 2],
    /// What of both scales passes.
    share: Ramp<f64>,
    /// The map that takes the place of this one, and for how many ticks the share then rises.
    next: Option<(M, u32)>,
    /// Whether anything is on its way.
    pub(super) moves: bool,
}

impl<M: Copy + PartialEq, S: Real> Changing<M, S> {
    pub(super) const fn new(motion: S, force: S, map: M) -> Self {
        let ramps = [Ramp::at(motion), Ramp::at(force)];
        Self { motion, force, map, ramps, share: Ramp::at(1.0), next: None, moves: false }
    }

    /// Changes the scale of the motion over so many ticks; 0: at once.
    pub(super) fn set_motion(&mut self, scale: S, ticks: u32) {
        self.ramps[0].set(scale, ticks);
        self.arrive();
    }

    /// Changes the scale of the force over so many ticks; 0: at once.
    pub(super) fn set_force(&mut self, scale: S, ticks: u32) {
        self.ramps[1].set(scale, ticks);
        self.arrive();
    }

    /// Changes the map: the scales fade out and in over so many ticks each; 0: at once.
    pub(super) fn set_map(&mut self, map: M, ticks: u32) {
        if ticks == 0 {
            (self.map, self.next) = (map, None);
            self.share.set(1.0, 0);
        } else if map != self.map || self.next.is_some() {
            self.next = Some((map, ticks));
            self.share.set(0.0, ticks);
        }
        self.arrive();
    }

    /// One tick of what is on its way. Returns whether the map was exchanged.
    pub(super) fn step(&mut self) -> bool {
        self.ramps.iter_mut().for_each(Ramp::step);
        self.share.step();
        let next = self.next.take_if(|_| self.share.ticks == 0);
        if let Some((map, ticks)) = next {
            self.map = map;
            self.share.set(1.0, ticks);
        }
        self.arrive();
        next.is_some()
    }

    /// All that is on its way arrives: nothing is coupled any more.
    pub(super) fn settle(&mut self) {
        let map = self.next.map_or(self.map, |(map, _)| map);
        *self = Self::new(self.ramps[0].to, self.ramps[1].to, map);
    }

    fn arrive(&mut self) {
        let share = S::splat(self.share.now);
        [self.motion, self.force] = self.ramps.map(|ramp| ramp.now * share);
        self.moves = self.share.ticks > 0 || self.ramps.iter().any(|ramp| ramp.ticks > 0);
    }
}
