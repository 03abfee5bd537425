//! The safety layer of a hand that moves, or that moves and turns.

use haptether_master::RotationSample;
use haptether_safety::{
    Axes, Excess, Fault, Guard, LayerSettings, LimiterSettings, ParameterError, PoseSample, RotationModel,
    RotationSettings, SafetyLayer, SafetyTick, Sample, SampleBounds, WrenchLayer, WrenchSettings, WrenchTick,
    controller::{ResearchController, SafetySettings},
    estimator::EstimatorKind,
};
use nalgebra::{Quaternion, Unit};

/// How the rotation of a master's endpoint is built.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MasterRotationSettings {
    /// Dynamics of the device.
    pub device: RotationModel,
    /// How w and its derivative are had from orientations.
    pub estimator: EstimatorKind,
    /// Observers and controllers, in rad/s and N m.
    pub safety: SafetySettings,
    /// Bounds on the device torque; as of the force, its ramp-in is not used.
    pub limiter: LimiterSettings,
    /// `lambda_tau`.
    pub torque_scale: f64,
    /// Whether a trip of force or torque acts on both.
    pub shares_trips: bool,
}

/// What a device measures at one tick.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MasterReading<const N: usize> {
    /// x in m.
    pub position: Axes<N>,
    /// V in m/s, from a device that measures it.
    pub velocity: Option<Axes<N>>,
    /// R and w, of a device that turns.
    pub rotation: Option<RotationSample>,
    /// The trigger that the finger holds, 0 open to 1 closed, where it leads the gripper and is known.
    pub trigger: Option<f64>,
}

impl<const N: usize> MasterReading<N> {
    /// Of a point.
    pub fn point(position: Axes<N>, velocity: Option<Axes<N>>) -> Self {
        Self { position, velocity, rotation: None, trigger: None }
    }

    /// The same of a device that stands as `quat_wxyz`, a unit quaternion that was recorded, and turns at `rate` in rad/s.
    #[must_use]
    pub fn turned(self, quat_wxyz: [f64; 4], rate: Option<Axes<3>>) -> Self {
        let [w, x, y, z] = quat_wxyz;
        // To normalise it once more would change its last bits.
        let orientation = Unit::new_unchecked(Quaternion::new(w, x, y, z));
        Self { rotation: Some(RotationSample { orientation, angular_velocity: rate }), ..self }
    }

    fn pose(&self) -> PoseSample<N> {
        // Where an endpoint of poses is told no orientation, it has none: a fault.
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

/// What stands between the remote side and a hand.
#[derive(Clone, Debug)]
pub(super) enum Layer<const N: usize> {
    /// Of one that moves.
    Force(Box<SafetyLayer<N>>),
    /// Of one that turns as well.
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

    /// The same before its first tick, whose samples are held against other bounds, of position and rotation.
    pub(super) fn with_samples(self, [bounds, rotation]: [SampleBounds; 2]) -> Self {
        match self {
            Self::Force(layer) => Self::Force(Box::new(layer.with_samples(bounds))),
            Self::Wrench(layer) => Self::Wrench(Box::new(layer.with_samples(bounds, rotation))),
        }
    }

    /// The sample that stands for the newest one.
    #[inline]
    pub(super) fn taken(&self) -> &Sample<N> {
        self.guard().taken()
    }

    /// What samples are held against.
    #[inline]
    pub(super) fn guard(&self) -> &Guard<N> {
        match self {
            Self::Force(layer) => layer.guard(),
            Self::Wrench(layer) => layer.guard(),
        }
    }

    /// The speed beyond the bound of the device that led to the fault.
    pub(super) fn excess(&self) -> Option<Excess> {
        match self {
            Self::Force(layer) => layer.excess(),
            Self::Wrench(layer) => layer.excess(),
        }
    }

    /// That of a hand that does not turn.
    pub(super) fn of_point(&self) -> Option<&SafetyLayer<N>> {
        match self {
            Self::Force(layer) => Some(layer),
            Self::Wrench(_) => None,
        }
    }

    /// With a controller of the caller's own, of a hand that does not turn; None for one that does.
    pub(super) fn with_research(self, controller: Box<dyn ResearchController>) -> Option<Self> {
        match self {
            Self::Force(layer) => Some(Self::Force(Box::new(layer.with_research(controller)))),
            Self::Wrench(_) => None,
        }
    }

    /// One tick after `missed` that were left out: the force in N, the torque in N m that the remote side requests.
    #[inline(always)] // what it returns is large, and mostly none
    pub(super) fn tick(
        &mut self,
        missed: u64,
        reading: &MasterReading<N>,
        force: &Axes<N>,
        torque: &Axes<3>,
        gain: f64,
    ) -> (SafetyTick<N>, Option<SafetyTick<3>>) {
        match self {
            Self::Force(layer) => {
                let MasterReading { position, velocity, .. } = reading;
                (layer.tick_after(missed, position, velocity.as_ref(), force, gain), None)
            }
            Self::Wrench(layer) => {
                let WrenchTick { translation, rotation } =
                    layer.tick_after(missed, &reading.pose(), force, torque, gain);
                (translation, Some(rotation))
            }
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
