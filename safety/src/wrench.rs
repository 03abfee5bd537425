//! The safety of a hand that moves and turns: a translation and a rotation that trip together.

use nalgebra::UnitQuaternion;

use crate::{
    Axes, Excess, Fault, Guard, LayerSettings, ParameterError, SafetyLayer, SafetyTick, Sample,
    controller::{Judged, NOT_FELT, UNDECIDED},
    layer::DEFAULT_LEVER_M,
    plausible::{self, SampleBounds, Turned},
    rotation::{RotationLayer, RotationSettings, check, in_base},
};

#[cfg(test)]
mod tests;

/// How the safety layer of a pose is built.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WrenchSettings<const N: usize = 3> {
    /// The layer of forces.
    pub translation: LayerSettings<N>,
    /// The layer of torques, with thresholds of its own.
    pub rotation: RotationSettings,
    /// Whether a trip of one acts on both.
    pub shares_trips: bool,
}

/// What a device measures of its pose at one tick, in the base frame about the tool point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PoseSample<const N: usize = 3> {
    /// x in m.
    pub position: Axes<N>,
    /// R, `base_from_body`.
    pub orientation: UnitQuaternion<f64>,
    /// V in m/s, if the device measures it (at every tick or at none).
    pub velocity: Option<Axes<N>>,
    /// w in rad/s, if the device measures it (at every tick or at none).
    pub angular_velocity: Option<Axes<3>>,
}

impl<const N: usize> From<&PoseSample<N>> for Sample<N> {
    fn from(pose: &PoseSample<N>) -> Self {
        let PoseSample { position, orientation, velocity, angular_velocity } = *pose;
        Self { position, velocity, rotation: Some(Turned { orientation, angular_velocity }) }
    }
}

/// What the safety layer saw and decided of force and torque at one tick, in the base frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WrenchTick<const N: usize = 3> {
    /// Of the force, in N, m/s and m/s².
    pub translation: SafetyTick<N>,
    /// Of the torque, in N m, rad/s and rad/s².
    pub rotation: SafetyTick<3>,
}

/// A layer of forces and a layer of torques on one hand; a hand that turns moves along N = 3 axes.
///
/// Each watches, answers and bounds in its own unit. While trips are shared, a tick that one calls unsafe is unsafe for
/// both, so that both cancel, hold off and fade together, by times that must be the same; the one that did not trip
/// says [`Tripped::HELD`](crate::controller::Tripped::HELD). The force of PC is no intervention and stays with its layer.
/// A fault of one stops both, whatever is shared.
#[derive(Clone, Debug)]
pub struct WrenchLayer<const N: usize = 3> {
    translation: SafetyLayer<N>,
    rotation: RotationLayer,
    shares_trips: bool,
    /// Whether the hand was felt, or nothing has tripped, while trips are shared.
    is_felt: bool,
    period_s: f64,
}

impl<const N: usize> WrenchLayer<N> {
    /// A layer for a device at rest, without force.
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

    /// The layer before its first tick, whose samples are held against other bounds, of the position and of the rotation.
    #[must_use]
    pub fn with_samples(mut self, bounds: SampleBounds, rotation: SampleBounds) -> Self {
        self.translation = self.translation.guarded(bounds, rotation, self.period_s);
        self
    }

    /// One tick: the pose, and the force in N and torque in N m that the remote side requests.
    ///
    /// A pose that leaves its path is held, and its prediction stands for it: [`Guard`]. Numbers that either layer refuses, and a
    /// step beyond a speed bound of the device, return no force and no torque at this tick and a fault in both that stays until
    /// [`reset`](Self::reset).
    pub fn tick(&mut self, sample: &PoseSample<N>, force: &Axes<N>, torque: &Axes<3>) -> WrenchTick<N> {
        self.tick_after(0, sample, force, torque, 1.0)
    }

    /// The same after `missed` ticks that were left out, with the controllers' damping in the share `authority` (0 to 1) only.
    pub fn tick_after(
        &mut self,
        missed: u64,
        sample: &PoseSample<N>,
        force: &Axes<N>,
        torque: &Axes<3>,
        authority: f64,
    ) -> WrenchTick<N> {
        let PoseSample { position, orientation, velocity, angular_velocity } = sample;
        let checked = self
            .translation
            .check(position, velocity.as_ref(), force)
            .and_then(|()| self.rotation.check(orientation, angular_velocity.as_ref(), torque))
            .and_then(|()| self.translation.judge(missed, &sample.into()));
        match checked {
            Err(fault) => return self.stop(fault),
            Ok(plausible::Judged::Held(at)) => {
                let translation = self.translation.hold(at, force, authority);
                return WrenchTick { translation, rotation: self.rotation.hold(at, torque, authority) };
            }
            Ok(plausible::Judged::Settled) => self.catch_up(),
            Ok(_) => {}
        }
        let moves =
            self.translation.checked(position, velocity.as_ref(), force, &mut crate::layer::PointMass);
        let turns = self.rotation.checked(orientation, angular_velocity.as_ref(), torque);
        let (moves, turns) = match (moves, turns) {
            (Ok(moves), Ok(turns)) => (moves, turns),
            (Err(fault), _) | (_, Err(fault)) => return self.stop(fault),
        };
        let (translation, rotation) = (&mut self.translation, self.rotation.layer());
        let (translation, rotation) = if self.shares_trips {
            let of_force = translation.controller().judge(&moves.seen);
            let of_torque = rotation.controller().judge(&turns.seen);
            let is_unsafe = of_force.is_unsafe() | of_torque.is_unsafe();
            let by_force = translation.controller().feel(&moves.seen, authority, is_unsafe);
            let by_torque = rotation.controller().feel(&turns.seen, authority, is_unsafe);
            let ease = together(by_force, by_torque, self.is_felt);
            if let Some(ease) = ease {
                self.is_felt = ease != NOT_FELT;
                translation.controller().agree(self.is_felt);
                rotation.controller().agree(self.is_felt);
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

    /// The ticks since the last sample that was taken.
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

    /// The sample that stands for the newest one: itself, or its prediction.
    pub fn taken(&self) -> &Sample<N> {
        self.translation.taken()
    }

    /// What samples are held against.
    pub fn guard(&self) -> &Guard<N> {
        self.translation.guard()
    }

    /// The speed beyond the bound of the device that led to the fault.
    pub fn excess(&self) -> Option<Excess> {
        self.translation.excess()
    }

    /// A tick that was missed.
    pub(crate) fn missed(&mut self, sample: &PoseSample<N>) {
        let PoseSample { position, orientation, velocity, angular_velocity } = sample;
        let mut point = crate::layer::PointMass;
        let moves = self.translation.missed_observation(position, velocity.as_ref(), &mut point);
        let turns = self.rotation.missed_observation(orientation, angular_velocity.as_ref());
        // A bad number would be met again at the tick, which stops both.
        let (Some(moves), Some(turns)) = (moves, turns) else { return };
        let (translation, rotation) = (self.translation.controller(), self.rotation.layer().controller());
        if self.shares_trips {
            let (of_force, of_torque) = (translation.judge(&moves), rotation.judge(&turns));
            let is_unsafe = of_force.is_unsafe() | of_torque.is_unsafe();
            let ease = together(
                translation.feel(&moves, UNDECIDED, is_unsafe),
                rotation.feel(&turns, UNDECIDED, is_unsafe),
                self.is_felt,
            );
            let judged = Judged { is_unsafe, ease };
            translation.answer(&moves, 1.0, &of_force, judged);
            rotation.answer(&turns, 1.0, &of_torque, judged);
        } else {
            translation.carry(&moves);
            rotation.carry(&turns);
        }
    }

    /// Renders nothing from now on, until [`reset`](Self::reset): a fault that only others can see.
    pub fn fail(&mut self, fault: Fault) {
        self.translation.fail(fault);
        self.rotation.fail(fault);
    }

    fn stop(&mut self, fault: Fault) -> WrenchTick<N> {
        WrenchTick { translation: self.translation.stop(fault), rotation: self.rotation.stop(fault) }
    }

    /// Clears the past as [`reset`](Self::reset) does, but keeps a fault.
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

    /// Clears a fault and the past: the device rests at this pose, and force and torque rise from zero again.
    pub fn reset(&mut self, position: &Axes<N>, orientation: &UnitQuaternion<f64>) -> Result<(), Fault> {
        check(orientation)?;
        self.translation.reset(position)?;
        self.rotation.reset(orientation)?;
        self.enter_at(position, orientation);
        Ok(())
    }
}

/// How fast the force may come back to a hand that either probe is to feel, and that both are to feel bear it from then on;
/// where only one is there, that one decides.
fn together(of_force: Option<f64>, of_torque: Option<f64>, is_felt: bool) -> Option<f64> {
    match (of_force, of_torque) {
        (Some(force), Some(torque)) if is_felt => Some(force.min(torque)),
        (Some(force), Some(torque)) if force == NOT_FELT || torque == NOT_FELT => Some(force.max(torque)),
        (Some(force), Some(torque)) => Some(force.min(torque)),
        (one, other) => one.or(other),
    }
}

/// Refuses a number of the rotation that must be that of the translation.
fn same(name: &'static str, symbol: &'static str, [expected, seen]: [f64; 2]) -> Result<(), ParameterError> {
    if expected == seen {
        return Ok(());
    }
    Err(ParameterError {
        name,
        symbol,
        seen,
        allowed: "that of the translation, with which the rotation acts",
    })
}
