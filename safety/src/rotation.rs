//! The safety of a rotation: the layer of a point, on body increments.

use nalgebra::UnitQuaternion;

use crate::{
    Axes, DeviceModel, Fault, LayerSettings, LimiterSettings, Observation, ParameterError, SafetyLayer,
    SafetyTick, Signal,
    controller::SafetySettings,
    estimator::{EstimatorKind, Motion},
    layer::{DEFAULT_LEVER_M, Inertia, Perceived},
    parameter::{finite, non_negative, positive},
    plausible::{Excess, Judged, Sample, SampleBounds, Turned},
};

#[cfg(test)]
mod tests;

/// Dynamics of the rotation of a haptic device as a rigid body, in the frame of its principal axes.
///
/// `I a + w x I w + b_r w + c_r w / |w| = tau_device + tau_h`
///
/// Source: Euler's equations, Goldstein, Poole and Safko 2002, Eq. 5.39; friction as paper Eq. 3.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RotationModel {
    /// The same equation without `w x I w`, which is Eq. 3: friction there has the direction of V too.
    axes: DeviceModel<3>,
}

impl RotationModel {
    /// A body of inertia I in kg m² about each axis (> 0), viscous friction `b_r` in N m s/rad (any sign) and Coulomb
    /// friction `c_r` in N m (>= 0).
    pub fn new(inertia_kg_m2: Axes<3>, viscous: f64, coulomb: f64) -> Result<Self, ParameterError> {
        for inertia in &inertia_kg_m2 {
            positive("inertia_kg_m2", "I", *inertia)?;
        }
        finite("viscous", "b_r", viscous)?;
        non_negative("coulomb", "c_r", coulomb)?;
        Ok(Self { axes: DeviceModel::new(inertia_kg_m2, Axes::repeat(viscous), Axes::repeat(coulomb))? })
    }

    /// I in kg m².
    pub fn inertia_kg_m2(&self) -> &Axes<3> {
        self.axes.mass_kg()
    }

    /// `w x I w` in N m.
    #[inline]
    pub fn gyroscopic_torque(&self, angular_velocity: &Axes<3>) -> Axes<3> {
        angular_velocity.cross(&self.inertia_kg_m2().component_mul(angular_velocity))
    }

    /// `tau_h = I a + w x I w + b_r w + c_r w / |w| - tau_device` in N m of exact signals, in the frame of the body.
    ///
    /// Source: paper Eq. 4, with the gyroscopic torque of Euler's equations.
    pub fn grasp_torque(&self, motion: &Motion<3>, device_torque: &Axes<3>) -> Axes<3> {
        self.axes.grasp_force(motion, &(device_torque - self.gyroscopic_torque(&motion.velocity)))
    }

    /// Kinetic energy `w' I w / 2` in J.
    pub fn kinetic_energy_j(&self, angular_velocity: &Axes<3>) -> f64 {
        self.axes.kinetic_energy_j(angular_velocity)
    }
}

/// How the safety layer of a rotation is built; forces are torques in N m, velocities in rad/s, positions in rad.
///
/// [`SafetySettings::at_lever`] and [`LimiterSettings::at_lever`] turn thresholds of a point into these.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RotationSettings {
    /// Dynamics of the device.
    pub device: RotationModel,
    /// dT in s.
    pub period_s: f64,
    /// How w and a are had from orientations, for a device that does not measure its angular velocity.
    pub estimator: EstimatorKind,
    /// Observers and controllers.
    pub safety: SafetySettings,
    /// Bounds on the device torque.
    pub limiter: LimiterSettings,
}

/// Largest angle in rad of one axis; beyond it the origin is moved by as much. A power of two, so that what is near it
/// loses no bit.
const REBASE: f64 = 8.0;

/// Largest turn in rad between two samples: nearer to pi, the way round that it went is a guess.
const MAX_TURN: f64 = 3.0;

/// The safety layer of a rotation: [`SafetyLayer`] on body increments.
///
/// `x_k = x_(k-1) + log(R_(k-1)^T R_k)`
///
/// so that its V is the angular velocity and its A the angular acceleration of the body, in the frame of the body, and a turn
/// of 2 pi is as any other. An increment is the integral of w over the tick but for `dT³ w x a / 12` (the second term of
/// the Magnus expansion). x is kept within 8 rad by moving the origin of the estimators with it.
///
/// Orientations R are `base_from_body`. Angular velocities and torques enter and leave **in the base frame**, by R of the
/// tick. A torque that is held over a tick keeps its direction in the base frame: in Eq. 4 it counts as it stood to the
/// body in the middle of the tick, and its growth is measured from where it stands at the end.
///
/// **Gyroscopic torque.** `w x I w` must be as late as A. Of an estimator whose V is of the newest sample it passes
/// through the kernel of A with the device torque, as the mean over the tick; of one whose V is late too, A is the difference
/// of V, and it is taken where that difference lies. Both at the mean of two successive V.
///
/// Source: increments, Bullo and Murray 1999, section 2; Iserles et al. 2000, section 4 (Magnus); the rest as
/// [`SafetyLayer`].
#[derive(Clone, Debug)]
pub struct RotationLayer {
    layer: SafetyLayer<3>,
    period_s: f64,
    gyroscope: Gyroscope,
    max_turn: f64,
    orientation: Option<UnitQuaternion<f64>>,
    /// x.
    turned: Axes<3>,
}

impl RotationLayer {
    /// A layer for a device at rest, without torque.
    pub fn new(settings: &RotationSettings) -> Result<Self, ParameterError> {
        let RotationSettings { device, period_s, estimator, safety, limiter } = *settings;
        let layer =
            SafetyLayer::new(&LayerSettings { device: device.axes, period_s, estimator, safety, limiter })?;
        let bounds = SampleBounds::LINEAR.at_lever(DEFAULT_LEVER_M);
        Ok(Self {
            layer: layer.guarded(SampleBounds::UNBOUNDED, bounds, period_s),
            period_s,
            gyroscope: Gyroscope { device, last: None },
            max_turn: MAX_TURN.min(Signal::AngularVelocity.bound() * period_s),
            orientation: None,
            turned: Axes::zeros(),
        })
    }

    /// The layer before its first tick, whose samples are held against other bounds than those of a point at a lever of 0.05 m.
    #[must_use]
    pub fn with_samples(self, bounds: SampleBounds) -> Self {
        let layer = self.layer.guarded(SampleBounds::UNBOUNDED, bounds, self.period_s);
        Self { layer, ..self }
    }

    /// One tick: orientation R, angular velocity w in rad/s if the device measures it (at every tick or at none), the
    /// torque in N m that the remote side requests; all in the base frame, as what is returned.
    ///
    /// A sample that leaves the path of the others is held, and its prediction stands for it: [`Guard`](crate::Guard). A
    /// quaternion that is not finite or whose norm is not 1 to 1e-9, a step beyond the speed bound of the device, a turn of more
    /// than 3 rad or 1000 rad/s between two samples, and other numbers that are not finite or absurd return zero torque at this
    /// tick and a fault that stays until [`reset`](Self::reset).
    pub fn tick(
        &mut self,
        orientation: &UnitQuaternion<f64>,
        angular_velocity: Option<&Axes<3>>,
        requested_torque: &Axes<3>,
    ) -> SafetyTick<3> {
        self.tick_after(0, orientation, angular_velocity, requested_torque, 1.0)
    }

    /// The same after `missed` ticks that were left out, with the controllers' damping in the share `authority` (0 to 1) only.
    pub fn tick_after(
        &mut self,
        missed: u64,
        orientation: &UnitQuaternion<f64>,
        angular_velocity: Option<&Axes<3>>,
        requested_torque: &Axes<3>,
        authority: f64,
    ) -> SafetyTick<3> {
        let entered = self.check(orientation, angular_velocity, requested_torque).and_then(|()| {
            match self.layer.judge(missed, &sample_of(orientation, angular_velocity))? {
                Judged::Held(at) => return Ok(Err(at)),
                Judged::Settled => self.catch_up(),
                _ => {}
            }
            self.checked(orientation, angular_velocity, requested_torque).map(Ok)
        });
        match entered {
            Ok(Ok(perceived)) => {
                let advance = self.layer.decide(&perceived, authority);
                in_base(orientation, &self.layer.keep(&advance, authority))
            }
            Ok(Err(at)) => self.hold(at, requested_torque, authority),
            Err(fault) => self.stop(fault),
        }
    }

    /// As [`SafetyLayer::hold`], at the last orientation that was taken.
    pub(crate) fn hold(&mut self, at: f64, requested_torque: &Axes<3>, authority: f64) -> SafetyTick<3> {
        let orientation = self.orientation.unwrap_or_default();
        let torque = orientation.inverse_transform_vector(requested_torque);
        in_base(&orientation, &self.layer.hold(at, &torque, authority))
    }

    fn catch_up(&mut self) {
        let Some(between) = self.layer.begin_to_catch_up() else { return };
        self.shift(between.shift.as_ref());
        for tick in 1..between.ticks {
            self.layer.recall(tick);
            if let Some(Turned { orientation, angular_velocity }) = between.at(tick).rotation {
                self.missed(&orientation, angular_velocity.as_ref());
            }
        }
        self.layer.recall(between.ticks);
    }

    /// A step of the orientation is no velocity: increments go on from beyond it, and torques keep their base frame.
    pub(crate) fn shift<const N: usize>(&mut self, by: Option<&Sample<N>>) {
        let by = by.and_then(|by| by.rotation);
        if let (Some(last), Some(by)) = (&mut self.orientation, by) {
            let beyond = by.orientation * *last;
            let step = last.inverse() * beyond;
            *last = beyond;
            let in_body = |held: &Axes<3>| step.inverse_transform_vector(held);
            self.layer.turn(in_body, in_body);
        }
    }

    /// The speed beyond the bound of the device that led to the fault.
    pub fn excess(&self) -> Option<Excess> {
        self.layer.excess()
    }

    /// Refuses numbers that are not finite or absurd, and all in a fault.
    pub(crate) fn check(
        &self,
        orientation: &UnitQuaternion<f64>,
        angular_velocity: Option<&Axes<3>>,
        requested_torque: &Axes<3>,
    ) -> Result<(), Fault> {
        if let Some(fault) = self.layer.fault() {
            return Err(fault);
        }
        // Before the state changes, and in the base frame: a NaN has no direction.
        check(orientation)?;
        angular_velocity.map_or(Ok(()), |w| Signal::AngularVelocity.check(w))?;
        Signal::RenderedTorque.check(requested_torque)
    }

    /// What a tick sees, in the frame of the body, or why it sees nothing; the sample is on its path.
    pub(crate) fn checked(
        &mut self,
        orientation: &UnitQuaternion<f64>,
        angular_velocity: Option<&Axes<3>>,
        requested_torque: &Axes<3>,
    ) -> Result<Perceived<3, f64>, Fault> {
        self.check(orientation, angular_velocity, requested_torque)?;
        self.turn_to(orientation)?;
        let in_body = |vector: &Axes<3>| orientation.inverse_transform_vector(vector);
        let (w, torque) = (angular_velocity.map(in_body), in_body(requested_torque));
        self.layer.checked(&self.turned, w.as_ref(), &torque, &mut self.gyroscope).map_err(Fault::of_rotation)
    }

    /// Adds the increment to this orientation, and turns what is held in the base frame with it.
    fn turn_to(&mut self, orientation: &UnitQuaternion<f64>) -> Result<(), Fault> {
        let last = self.orientation.unwrap_or(*orientation);
        let step = last.inverse() * orientation;
        let increment = step.scaled_axis();
        if increment.norm() > self.max_turn {
            return Err(Fault::OutOfRange(Signal::AngularVelocity));
        }
        self.orientation = Some(*orientation);
        // exp(log(step) / 2), without an angle: q and -q are the same rotation.
        let step = step.into_inner();
        let step = if step.w < 0.0 { -step } else { step };
        let half = UnitQuaternion::new_normalize(step + nalgebra::Quaternion::identity());
        let step = UnitQuaternion::new_normalize(step);
        self.layer
            .turn(|held| half.inverse_transform_vector(held), |held| step.inverse_transform_vector(held));
        self.turned += increment;
        if self.turned.amax() > REBASE {
            let by = self.turned.map(|x| if x.abs() > REBASE { -REBASE.copysign(x) } else { 0.0 });
            self.turned += by;
            self.layer.shift(&by);
        }
        Ok(())
    }

    /// A tick that was missed: the device has kept its torque, and was at `orientation` (between two samples) by then. As
    /// [`SafetyLayer::missed`].
    pub(crate) fn missed(&mut self, orientation: &UnitQuaternion<f64>, angular_velocity: Option<&Axes<3>>) {
        if let Some(seen) = self.missed_observation(orientation, angular_velocity) {
            self.layer.controller().carry(&seen);
        }
    }

    pub(crate) fn missed_observation(
        &mut self,
        orientation: &UnitQuaternion<f64>,
        angular_velocity: Option<&Axes<3>>,
    ) -> Option<Observation<3>> {
        if self.layer.fault().is_some() || check(orientation).is_err() || self.turn_to(orientation).is_err() {
            return None;
        }
        let w = angular_velocity.map(|w| orientation.inverse_transform_vector(w));
        self.layer.missed_observation(&self.turned, w.as_ref(), &mut self.gyroscope)
    }

    /// Renders no torque from now on, until [`reset`](Self::reset): a fault that only others can see.
    pub fn fail(&mut self, fault: Fault) {
        self.layer.fail(fault);
    }

    pub(crate) fn stop(&mut self, fault: Fault) -> SafetyTick<3> {
        self.layer.stop(fault)
    }

    pub(crate) fn layer(&mut self) -> &mut SafetyLayer<3> {
        &mut self.layer
    }

    /// Clears the past as [`reset`](Self::reset) does, but keeps a fault.
    pub fn restart(&mut self, orientation: &UnitQuaternion<f64>) -> Result<(), Fault> {
        check(orientation)?;
        self.layer.restart(&Axes::zeros())?;
        self.rest_at(orientation);
        Ok(())
    }

    /// Clears a fault and the past: the device rests at `orientation`, and its torque rises from zero again.
    pub fn reset(&mut self, orientation: &UnitQuaternion<f64>) -> Result<(), Fault> {
        check(orientation)?;
        self.layer.reset(&Axes::zeros())?;
        self.rest_at(orientation);
        Ok(())
    }

    fn rest_at(&mut self, orientation: &UnitQuaternion<f64>) {
        self.orientation = Some(*orientation);
        self.turned = Axes::zeros();
        self.gyroscope.last = None;
        self.layer.enter_at(&sample_of(orientation, None));
    }
}

/// A sample of a rotation alone.
fn sample_of(orientation: &UnitQuaternion<f64>, angular_velocity: Option<&Axes<3>>) -> Sample<3> {
    let turned = Turned { orientation: *orientation, angular_velocity: angular_velocity.copied() };
    Sample { position: Axes::zeros(), velocity: None, rotation: Some(turned) }
}

/// Passes a unit quaternion, or names the fault.
pub(crate) fn check(orientation: &UnitQuaternion<f64>) -> Result<(), Fault> {
    let norm = orientation.quaternion().norm();
    if (norm - 1.0).abs() <= Signal::Orientation.bound() {
        return Ok(());
    }
    // Finite numbers may have an infinite norm.
    Err(if orientation.coords.iter().all(|x| x.is_finite()) {
        Fault::OutOfRange(Signal::Orientation)
    } else {
        Fault::NotFinite(Signal::Orientation)
    })
}

/// The tick with its vectors in the base frame.
pub(crate) fn in_base(orientation: &UnitQuaternion<f64>, tick: &SafetyTick<3>) -> SafetyTick<3> {
    let mut intervention = tick.intervention;
    intervention.safety_force = orientation * intervention.safety_force;
    SafetyTick {
        motion: Motion {
            velocity: orientation * tick.motion.velocity,
            // w x w = 0, so this is the derivative of w in the base frame as well.
            acceleration: orientation * tick.motion.acceleration,
        },
        rendered_force: orientation * tick.rendered_force,
        grasp_force: orientation * tick.grasp_force,
        device_force: orientation * tick.device_force,
        intervention,
        ..*tick
    }
}

/// `w x I w` as late as A.
#[derive(Clone, Copy, Debug)]
struct Gyroscope {
    device: RotationModel,
    last: Option<Axes<3>>,
}

impl Inertia<3> for Gyroscope {
    #[inline]
    fn align(
        &mut self,
        motion: &Motion<3>,
        device_torque: &Axes<3>,
        is_late: bool,
        kernel: impl FnOnce(&Axes<3>) -> Axes<3>,
    ) -> Axes<3> {
        let last = self.last.replace(motion.velocity).unwrap_or(motion.velocity);
        let torque = self.device.gyroscopic_torque(&((motion.velocity + last) / 2.0));
        if is_late { kernel(device_torque) - torque } else { kernel(&(device_torque - torque)) }
    }
}
