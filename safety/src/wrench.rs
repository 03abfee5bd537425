//! Safety layer of a pose: a translation and a rotation, which may share their trips.

use nalgebra::UnitQuaternion;

use crate::{
    Axes, Coupled, Excess, Fault, Guard, LayerSettings, ParameterError, SafetyLayer, SafetyTick, Sample,
    controller::{Judged, NOT_FELT, UNDECIDED},
    layer::DEFAULT_LEVER_M,
    plausible::{self, SampleBounds, Turned},
    rotation::{CoupledTurn, RotationLayer, RotationSettings, check, in_base},
};

#[cfg(test)]
mod tests;

/// Settings of the safety layer of a pose.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WrenchSettings<const N: usize = 3> {
    /// Settings of the force layer.
    pub translation: LayerSettings<N>,
    /// Settings of the torque layer, with its own thresholds.
    pub rotation: RotationSettings,
    /// If true, a trip of one layer acts on both.
    pub shares_trips: bool,
}

/// Pose measured at one tick, in the base frame about the tool point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PoseSample<const N: usize = 3> {
    /// x in m.
    pub position: Axes<N>,
    /// R, `base_from_body`.
    pub orientation: UnitQuaternion<f64>,
    /// V in m/s if the device measures it; given at every tick or at none.
    pub velocity: Option<Axes<N>>,
    /// w in rad/s if the device measures it; given at every tick or at none.
    pub angular_velocity: Option<Axes<3>>,
}

impl<const N: usize> From<&PoseSample<N>> for Sample<N> {
    fn from(pose: &PoseSample<N>) -> Self {
        let PoseSample { position, orientation, velocity, angular_velocity } = *pose;
        Self { position, velocity, rotation: Some(Turned { orientation, angular_velocity }) }
    }
}

/// Observations and decisions on force and torque at one tick, in the base frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WrenchTick<const N: usize = 3> {
    /// Tick of the force layer, in N, m/s and m/s².
    pub translation: SafetyTick<N>,
    /// Tick of the torque layer, in N m, rad/s and rad/s².
    pub rotation: SafetyTick<3>,
}

/// A force layer and a torque layer on one hand. Scenes of kind `pose` have N = 3.
///
/// Each layer observes, responds and limits in its own unit. With shared trips, a tick that one layer calls unsafe is
/// unsafe for both. Both then cancel, hold off and fade together, so their times must be equal. The layer that did
/// not trip reports [`Tripped::HELD`](crate::controller::Tripped::HELD). The force of PC is not an intervention and
/// stays in its layer. A fault of one layer always stops both.
#[derive(Clone, Debug)]
pub struct WrenchLayer<const N: usize = 3> {
    translation: SafetyLayer<N>,
    rotation: RotationLayer,
    shares_trips: bool,
    /// With shared trips: true if a hand was felt or nothing has tripped.
    is_felt: bool,
    period_s: f64,
}

impl<const N: usize> WrenchLayer<N> {
    /// Create a layer for a device at rest, without force.
    pub fn new(settings: &WrenchSettings<N>) -> Result<Self, ParameterError> {
        let WrenchSettings { translation, rotation, shares_trips } = settings;
        same("period_s", "dT", [translation.period_s, rotation.period_s])?;
        if *shares_trips {
            let [of, from] = [rotation.safety, translation.safety];
            same("hold_off_s", "time", [from.hold_off_s, of.hold_off_s])?;
            same("release_ramp_s", "time", [from.release_ramp_s, of.release_ramp_s])?;
        }
        let bounds = SampleBounds::of_axes(N);
        let layer = Self {
            translation: SafetyLayer::new(translation)?,
            rotation: RotationLayer::new(rotation)?,
            shares_trips: *shares_trips,
            is_felt: true,
            period_s: translation.period_s,
        };
        Ok(layer.with_samples(bounds, bounds.at_lever(DEFAULT_LEVER_M)))
    }

    /// Replace the sample bounds of position and rotation. Call this before the first tick.
    #[must_use]
    pub fn with_samples(mut self, bounds: SampleBounds, rotation: SampleBounds) -> Self {
        self.translation = self.translation.guarded(bounds, self.rotation.reachable(rotation), self.period_s);
        self
    }

    /// Estimate force and torque of the hand at every tick, see [`SafetyLayer::with_grasp_force`].
    #[must_use]
    pub fn with_grasp_wrench(mut self) -> Self {
        self.translation = self.translation.with_grasp_force();
        self.rotation = self.rotation.with_grasp_torque();
        self
    }

    /// Return force in N and torque in N m of the hand at the last tick, see [`SafetyLayer::grasp_force`].
    pub fn grasp_wrench(&self) -> (Axes<N>, Axes<3>) {
        (self.translation.grasp_force(), self.rotation.grasp_torque())
    }

    /// Compute one tick from the pose and the requested force in N and torque in N m.
    ///
    /// [`Guard`] holds a pose that leaves its path and replaces it by its prediction. A value that either layer
    /// refuses, and a step beyond a speed bound of the device, are faults of both layers. A fault gives zero force
    /// and torque at this tick and stays until [`reset`](Self::reset).
    pub fn tick(&mut self, sample: &PoseSample<N>, force: &Axes<N>, torque: &Axes<3>) -> WrenchTick<N> {
        self.tick_after(0, sample, force, torque, 1.0)
    }

    /// Compute the tick that follows `missed` skipped ticks, with the controllers' damping scaled by `authority` (0
    /// to 1).
    pub fn tick_after(
        &mut self,
        missed: u64,
        sample: &PoseSample<N>,
        force: &Axes<N>,
        torque: &Axes<3>,
        authority: f64,
    ) -> WrenchTick<N> {
        self.tick_coupled(missed, sample, &mut |_| *force, &mut |_| *torque, authority)
    }

    /// Compute a tick as [`tick_after`](Self::tick_after), with `F_v` from `couple` and the torque from `couple_torque`,
    /// see [`SafetyLayer::tick_coupled`].
    pub fn tick_coupled(
        &mut self,
        missed: u64,
        sample: &PoseSample<N>,
        couple: &mut dyn FnMut(&Coupled<'_, N>) -> Axes<N>,
        couple_torque: &mut dyn FnMut(&CoupledTurn<'_>) -> Axes<3>,
        authority: f64,
    ) -> WrenchTick<N> {
        let PoseSample { position, orientation, velocity, angular_velocity } = sample;
        let checked = self
            .translation
            .check(position, velocity.as_ref())
            .and_then(|()| self.rotation.check(orientation, angular_velocity.as_ref()))
            .and_then(|()| self.translation.judge(missed, Sample::from(sample).parts()));
        match checked {
            Err(fault) => return self.stop(fault),
            Ok(plausible::Judged::Held(at)) => {
                let translation = self.translation.hold_coupled(at, couple, authority);
                let rotation = self.rotation.hold_coupled(at, couple_torque, authority);
                return match translation.fault.or(rotation.fault) {
                    Some(fault) => self.stop(fault),
                    None => WrenchTick { translation, rotation },
                };
            }
            Ok(plausible::Judged::Settled) => self.catch_up(),
            Ok(_) => {}
        }
        let moves =
            self.translation.checked(position, velocity.as_ref(), couple, &mut crate::layer::PointMass);
        let turns = self.rotation.checked(orientation, angular_velocity.as_ref(), couple_torque);
        let (moves, turns) = match (moves, turns) {
            (Ok(moves), Ok(turns)) => (moves, turns),
            (Err(fault), _) | (_, Err(fault)) => return self.stop(fault),
        };
        let (translation, rotation) = (&mut self.translation, self.rotation.layer());
        let (translation, rotation) = if self.shares_trips {
            let of_force = translation.controller().judge(&moves.seen);
            let of_torque = rotation.controller().judge(&turns.seen);
            let is_unsafe = of_force.is_unsafe() | of_torque.is_unsafe();
            let by_force = translation.controller().step_probe(&moves.seen, authority, is_unsafe);
            let by_torque = rotation.controller().step_probe(&turns.seen, authority, is_unsafe);
            let ease = together(by_force, by_torque, self.is_felt);
            if let Some(ease) = ease {
                self.is_felt = ease != NOT_FELT;
                translation.controller().adopt_result(self.is_felt);
                rotation.controller().adopt_result(self.is_felt);
            }
            let judged = Judged { is_unsafe, ease };
            let response = translation.controller().answer(&moves.seen, authority, &of_force, judged);
            let translation = translation.bound(&moves, response);
            let response = rotation.controller().answer(&turns.seen, authority, &of_torque, judged);
            (translation, rotation.bound(&turns, response))
        } else {
            (translation.decide(&moves, authority), rotation.decide(&turns, authority))
        };
        let translation = self.translation.keep(&translation, authority);
        WrenchTick {
            translation,
            rotation: in_base(orientation, &self.rotation.layer().keep(&rotation, authority)),
        }
    }

    /// Advance over the ticks since the last accepted sample.
    fn catch_up(&mut self) {
        let Some(between) = self.translation.begin_to_catch_up() else { return };
        self.rotation.layer().hold_until(between.ticks);
        self.rotation.shift(between.shift.as_ref());
        for tick in 1..between.ticks {
            self.recall(tick);
            let Sample { position, velocity, rotation } = between.at(tick);
            if let Some(Turned { orientation, angular_velocity }) = rotation {
                self.missed(&PoseSample { position, orientation, velocity, angular_velocity });
            }
        }
        self.recall(between.ticks);
    }

    fn recall(&mut self, tick: u64) {
        self.translation.recall(tick);
        self.rotation.layer().recall(tick);
    }

    /// Return force and torque of the coupling that the device has exerted since the last tick, see
    /// [`SafetyLayer::exerted`].
    pub fn exerted(&self) -> (Axes<N>, Axes<3>) {
        (self.translation.exerted(), self.rotation.exerted())
    }

    /// Return the accepted sample, or the prediction while the newest sample is held.
    pub fn sample_in_use(&self) -> &Sample<N> {
        self.translation.sample_in_use()
    }

    /// Return the guard of the samples.
    pub fn guard(&self) -> &Guard<N> {
        self.translation.guard()
    }

    /// Return the speed beyond the bound of the device that caused the fault.
    pub fn excess(&self) -> Option<Excess> {
        self.translation.excess()
    }

    /// Carry both layers over a missed tick.
    pub(crate) fn missed(&mut self, sample: &PoseSample<N>) {
        let PoseSample { position, orientation, velocity, angular_velocity } = sample;
        let mut point = crate::layer::PointMass;
        let moves = self.translation.missed_observation(position, velocity.as_ref(), &mut point);
        let turns = self.rotation.missed_observation(orientation, angular_velocity.as_ref());
        // The tick itself meets an invalid value again and stops both layers.
        let (Some(moves), Some(turns)) = (moves, turns) else { return };
        let (translation, rotation) = (self.translation.controller(), self.rotation.layer().controller());
        if self.shares_trips {
            let (of_force, of_torque) = (translation.judge(&moves), rotation.judge(&turns));
            let is_unsafe = of_force.is_unsafe() | of_torque.is_unsafe();
            let ease = together(
                translation.step_probe(&moves, UNDECIDED, is_unsafe),
                rotation.step_probe(&turns, UNDECIDED, is_unsafe),
                self.is_felt,
            );
            let judged = Judged { is_unsafe, ease };
            translation.answer(&moves, 1.0, &of_force, judged);
            rotation.answer(&turns, 1.0, &of_torque, judged);
        } else {
            translation.skip_tick(&moves);
            rotation.skip_tick(&turns);
        }
    }

    /// Set a fault that the layers cannot detect themselves: no force until [`reset`](Self::reset).
    pub fn fail(&mut self, fault: Fault) {
        self.translation.fail(fault);
        self.rotation.fail(fault);
    }

    fn stop(&mut self, fault: Fault) -> WrenchTick<N> {
        WrenchTick { translation: self.translation.stop(fault), rotation: self.rotation.stop(fault) }
    }

    /// Clear the past as [`reset`](Self::reset) does, but keep the fault.
    pub fn restart(&mut self, position: &Axes<N>, orientation: &UnitQuaternion<f64>) -> Result<(), Fault> {
        check(orientation)?;
        self.translation.restart(position)?;
        self.rotation.restart(orientation)?;
        self.enter_at(position, orientation);
        Ok(())
    }

    fn enter_at(&mut self, position: &Axes<N>, orientation: &UnitQuaternion<f64>) {
        let turned = Turned { orientation: *orientation, angular_velocity: None };
        self.translation.enter_at(&Sample { position: *position, velocity: None, rotation: Some(turned) });
    }

    /// Clear fault and past: the device rests at this pose, and force and torque rise from zero.
    pub fn reset(&mut self, position: &Axes<N>, orientation: &UnitQuaternion<f64>) -> Result<(), Fault> {
        check(orientation)?;
        self.translation.reset(position)?;
        self.rotation.reset(orientation)?;
        self.enter_at(position, orientation);
        Ok(())
    }
}

/// Combine the eases of both probes: how fast force and torque may return.
///
/// A hand counts as felt once either probe feels it. From then on it must bear both, so the smaller ease applies.
/// With one probe only, its ease applies.
fn together(of_force: Option<f64>, of_torque: Option<f64>, is_felt: bool) -> Option<f64> {
    match (of_force, of_torque) {
        (Some(force), Some(torque)) if is_felt => Some(force.min(torque)),
        (Some(force), Some(torque)) if force == NOT_FELT || torque == NOT_FELT => Some(force.max(torque)),
        (Some(force), Some(torque)) => Some(force.min(torque)),
        (one, other) => one.or(other),
    }
}

/// Refuse a setting of the rotation that differs from that of the translation.
fn same(name: &'static str, symbol: &'static str, [expected, seen]: [f64; 2]) -> Result<(), ParameterError> {
    if expected == seen {
        return Ok(());
    }
    Err(ParameterError { name, symbol, seen, allowed: "equal to that of the translation" })
}
