//! Safety layer of a hand that moves, or that moves and turns.

use haptether_master::RotationSample;
use haptether_safety::{
    Axes, Coupled, CoupledTurn, Excess, Fault, Guard, LayerSettings, LimiterSettings, ParameterError,
    PoseSample, RotationModel, RotationSettings, SafetyLayer, SafetyTick, Sample, SampleBounds, WrenchLayer,
    WrenchSettings, WrenchTick,
    controller::{ResearchController, SafetySettings},
    estimator::EstimatorKind,
};
use nalgebra::{Quaternion, Unit};

/// Settings of the rotation of a master's endpoint.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MasterRotationSettings {
    /// Dynamics of the device.
    pub device: RotationModel,
    /// Estimator of w and its derivative from orientations.
    pub estimator: EstimatorKind,
    /// Observers and controllers, in rad/s and N m.
    pub safety: SafetySettings,
    /// Bounds on the device torque; the ramp-in is not used, as for the force.
    pub limiter: LimiterSettings,
    /// `lambda_tau`.
    pub torque_scale: f64,
    /// True if a trip of force or torque acts on both.
    pub shares_trips: bool,
}

/// Measurements of a device at one tick.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MasterReading<const N: usize> {
    /// x in m.
    pub position: Axes<N>,
    /// V in m/s, if the device measures it.
    pub velocity: Option<Axes<N>>,
    /// R and w, if the device turns.
    pub rotation: Option<RotationSample>,
    /// Position of the trigger, 0 open to 1 closed, if it leads the gripper and is known.
    pub trigger: Option<f64>,
}

impl<const N: usize> MasterReading<N> {
    /// Build the reading of a point.
    pub fn point(position: Axes<N>, velocity: Option<Axes<N>>) -> Self {
        Self { position, velocity, rotation: None, trigger: None }
    }

    /// Add a recorded orientation `quat_wxyz`, a unit quaternion, and the angular velocity `rate` in rad/s.
    #[must_use]
    pub fn turned(self, quat_wxyz: [f64; 4], rate: Option<Axes<3>>) -> Self {
        let [w, x, y, z] = quat_wxyz;
        // Normalising it again would change its last bits.
        let orientation = Unit::new_unchecked(Quaternion::new(w, x, y, z));
        Self { rotation: Some(RotationSample { orientation, angular_velocity: rate }), ..self }
    }

    fn pose(&self) -> PoseSample<N> {
        // A missing orientation becomes NaN, which is a fault in an endpoint of poses.
        let none = Unit::new_unchecked(Quaternion::from([f64::NAN; 4]));
        let rotation = self.rotation.unwrap_or(RotationSample { orientation: none, angular_velocity: None });
        PoseSample {
            position: self.position,
            velocity: self.velocity,
            orientation: rotation.orientation,
            angular_velocity: rotation.angular_velocity,
        }
    }
}

/// Safety layer between the remote side and a hand.
#[derive(Clone, Debug)]
pub(super) enum Layer<const N: usize> {
    /// Layer of a hand that moves.
    Force(Box<SafetyLayer<N>>),
    /// Layer of a hand that moves and turns.
    Wrench(Box<WrenchLayer<N>>),
}

impl<const N: usize> Layer<N> {
    pub(super) fn new(
        translation: LayerSettings<N>,
        rotation: Option<&MasterRotationSettings>,
    ) -> Result<Self, ParameterError> {
        let Some(&MasterRotationSettings { device, estimator, safety, limiter, shares_trips, .. }) = rotation
        else {
            return Ok(Self::Force(Box::new(SafetyLayer::new(&translation)?)));
        };
        let period_s = translation.period_s;
        let limiter = LimiterSettings { ramp_in_s: 0.0, ..limiter };
        let rotation = RotationSettings { device, period_s, estimator, safety, limiter };
        Ok(Self::Wrench(Box::new(WrenchLayer::new(&WrenchSettings { translation, rotation, shares_trips })?)))
    }

    /// Replace the sample bounds of position and rotation, before the first tick.
    pub(super) fn with_samples(self, [bounds, rotation]: [SampleBounds; 2]) -> Self {
        match self {
            Self::Force(layer) => Self::Force(Box::new(layer.with_samples(bounds))),
            Self::Wrench(layer) => Self::Wrench(Box::new(layer.with_samples(bounds, rotation))),
        }
    }

    /// Estimate the wrench of the hand at every tick, for a coupling that uses it.
    pub(super) fn with_grasp(self) -> Self {
        match self {
            Self::Force(layer) => Self::Force(Box::new(layer.with_grasp_force())),
            Self::Wrench(layer) => Self::Wrench(Box::new(layer.with_grasp_wrench())),
        }
    }

    /// Force in N and torque in N m of the hand at the last tick; zero unless something needs it.
    pub(super) fn grasp(&self) -> (Axes<N>, Axes<3>) {
        match self {
            Self::Force(layer) => (layer.grasp_force(), Axes::zeros()),
            Self::Wrench(layer) => layer.grasp_wrench(),
        }
    }

    /// Sample in use at this tick: the newest one, or its prediction.
    #[inline]
    pub(super) fn sample_in_use(&self) -> &Sample<N> {
        self.guard().sample_in_use()
    }

    /// Guard that checks the samples.
    #[inline]
    pub(super) fn guard(&self) -> &Guard<N> {
        match self {
            Self::Force(layer) => layer.guard(),
            Self::Wrench(layer) => layer.guard(),
        }
    }

    /// Speed beyond the device's bound that caused the fault.
    pub(super) fn excess(&self) -> Option<Excess> {
        match self {
            Self::Force(layer) => layer.excess(),
            Self::Wrench(layer) => layer.excess(),
        }
    }

    /// Layer of a hand that does not turn; `None` for one that turns.
    pub(super) fn of_point(&self) -> Option<&SafetyLayer<N>> {
        match self {
            Self::Force(layer) => Some(layer),
            Self::Wrench(_) => None,
        }
    }

    /// Add the caller's own controller. Returns `None` for a hand that turns.
    pub(super) fn with_research(self, controller: Box<dyn ResearchController>) -> Option<Self> {
        match self {
            Self::Force(layer) => Some(Self::Force(Box::new(layer.with_research(controller)))),
            Self::Wrench(_) => None,
        }
    }

    /// Step one tick after `missed` missed ticks; `couple` returns the request of the remote side in N, and
    /// `couple_torque` that in N m.
    #[inline(always)] // its result is large and mostly empty
    pub(super) fn tick(
        &mut self,
        missed: u64,
        reading: &MasterReading<N>,
        couple: impl FnOnce(&Coupled<'_, N>) -> Axes<N>,
        couple_torque: impl FnOnce(&CoupledTurn<'_>) -> Axes<3>,
        gain: f64,
    ) -> (SafetyTick<N>, Option<SafetyTick<3>>) {
        let couple = |at: &Coupled<'_, N>| at.faded(&couple(at), gain);
        match self {
            Self::Force(layer) => {
                let MasterReading { position, velocity, .. } = reading;
                (layer.tick_coupled(missed, position, velocity.as_ref(), couple, gain), None)
            }
            Self::Wrench(layer) => {
                // A pose is compiled once for all couplings.
                let (mut couple, mut couple_torque) = (Some(couple), Some(couple_torque));
                let mut force =
                    |at: &Coupled<'_, N>| couple.take().map_or(Axes::zeros(), |couple| couple(at));
                let mut torque = |at: &CoupledTurn<'_>| {
                    couple_torque.take().map_or(Axes::zeros(), |couple| at.faded(&couple(at), gain))
                };
                let WrenchTick { translation, rotation } =
                    layer.tick_coupled(missed, &reading.pose(), &mut force, &mut torque, gain);
                (translation, Some(rotation))
            }
        }
    }

    /// Force in N and torque in N m of the coupling that the device has exerted since the last tick.
    pub(super) fn exerted(&self) -> (Axes<N>, Axes<3>) {
        match self {
            Self::Force(layer) => (layer.exerted(), Axes::zeros()),
            Self::Wrench(layer) => layer.exerted(),
        }
    }

    pub(super) fn fail(&mut self, fault: Fault) {
        match self {
            Self::Force(layer) => layer.fail(fault),
            Self::Wrench(layer) => layer.fail(fault),
        }
    }

    pub(super) fn restart(&mut self, reading: &MasterReading<N>) -> Result<(), Fault> {
        match self {
            Self::Force(layer) => layer.restart(&reading.position),
            Self::Wrench(layer) => layer.restart(&reading.position, &reading.pose().orientation),
        }
    }

    pub(super) fn reset(&mut self, reading: &MasterReading<N>) -> Result<(), Fault> {
        match self {
            Self::Force(layer) => layer.reset(&reading.position),
            Self::Wrench(layer) => layer.reset(&reading.position, &reading.pose().orientation),
        }
    }
}
