//! Changes of a coupling by the operator during a run: their bounds and their fades.

use haptether_safety::Real;

use super::CouplingError;

/// Largest factor, up and down, of a scale change with a closed clutch, unless the scene states another.
pub const CHANGE_FACTOR: f64 = 2.0;

/// Largest factor with an open clutch. A larger change is a mistake, or needs another scene.
pub const OPEN_FACTOR: f64 = 100.0;

/// Bounds of a scale during a run. They depend on the scene and not on the last change, so repeated changes
/// cannot exceed them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ScaleRange {
    name: &'static str,
    symbol: &'static str,
    /// Smallest and largest value while the clutch is closed.
    closed: [f64; 2],
    /// Smallest and largest value while the clutch is open.
    open: [f64; 2],
}

impl ScaleRange {
    /// Range from `scene / factor` to `scene factor`, widened by the values to which the scene itself changes
    /// it (`stated`).
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

    /// Range of `lambda_p`: from `scene / factor` to `scene factor`, widened by the values in `stated`.
    pub fn position(scene: f64, factor: f64, stated: impl IntoIterator<Item = f64>) -> Self {
        Self::new(["position_scale", "lambda_p"], scene, factor, stated)
    }

    /// Range of `lambda_f`, likewise.
    pub fn force(scene: f64, factor: f64, stated: impl IntoIterator<Item = f64>) -> Self {
        Self::new(["force_scale", "lambda_f"], scene, factor, stated)
    }

    /// Range of `lambda_r`, likewise.
    pub fn rotation(scene: f64, factor: f64, stated: impl IntoIterator<Item = f64>) -> Self {
        Self::new(["rotation_scale", "lambda_r"], scene, factor, stated)
    }

    /// Range of `lambda_tau`, likewise.
    pub fn torque(scene: f64, factor: f64, stated: impl IntoIterator<Item = f64>) -> Self {
        Self::new(["torque_scale", "lambda_tau"], scene, factor, stated)
    }

    /// Return `seen` if it is within the bounds. `is_open` is true if the clutch is open and no force is
    /// left.
    ///
    /// # Errors
    ///
    /// [`CouplingError::Change`], also for NaN.
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

/// Ranges of the scales of a side.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ScaleRanges {
    /// Range of `lambda_p` at a slave, of `lambda_f` at a master.
    pub translation: Option<ScaleRange>,
    /// Range of `lambda_r` at a slave, of `lambda_tau` at a master; none unless the side turns.
    pub rotation: Option<ScaleRange>,
}

/// Linear ramp of a number to another, one step per tick.
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

    /// Start from the present value and arrive after `ticks` ticks.
    fn set(&mut self, to: S, ticks: u32) {
        (self.to, self.ticks) = (to, ticks);
        if ticks == 0 {
            self.now = to;
        }
    }

    /// Step one tick.
    fn step(&mut self) {
        if self.ticks > 1 {
            self.now += (self.to - self.now) / S::splat(f64::from(self.ticks));
            self.ticks -= 1;
        } else {
            self.set(self.to, 0);
        }
    }
}

/// Two scales of a coupling and the map M between its sides, all changeable by an operator.
///
/// A scale moves on a straight line from the present value to the new one. A map is exchanged at zero: both
/// scales fade to zero, then rise with the new map. Time counts in ticks, so a late loop does not catch up.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Changing<M, S = f64> {
    /// Values at this tick.
    pub(super) motion: S,
    pub(super) force: S,
    pub(super) map: M,
    ramps: [Ramp<S>; 2],
    /// Share of both scales in effect, 0 to 1.
    share: Ramp<f64>,
    /// Next map, and the ticks over which the share then rises.
    next: Option<(M, u32)>,
    /// True if a change is in progress.
    pub(super) moves: bool,
}

impl<M: Copy + PartialEq, S: Real> Changing<M, S> {
    pub(super) const fn new(motion: S, force: S, map: M) -> Self {
        let ramps = [Ramp::at(motion), Ramp::at(force)];
        Self { motion, force, map, ramps, share: Ramp::at(1.0), next: None, moves: false }
    }

    /// Change the scale of the motion over `ticks` ticks; 0 means at once.
    pub(super) fn set_motion(&mut self, scale: S, ticks: u32) {
        self.ramps[0].set(scale, ticks);
        self.arrive();
    }

    /// Change the scale of the force over `ticks` ticks; 0 means at once.
    pub(super) fn set_force(&mut self, scale: S, ticks: u32) {
        self.ramps[1].set(scale, ticks);
        self.arrive();
    }

    /// Change the map: the scales fade out and in over `ticks` ticks each; 0 means at once.
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

    /// Scale of the motion at this tick, without the fade of a changing map.
    pub(super) fn unfaded_motion(&self) -> S {
        self.ramps[0].now
    }

    /// Step one tick of all changes; return whether the map was exchanged.
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

    /// Complete all changes at once, because nothing is coupled any more.
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
