//! Safety layer of a rotation: [`SafetyLayer`], applied to orientation increments in the body frame.

use nalgebra::UnitQuaternion;

use crate::{
    Axes, Coupled, DeviceModel, Fault, LayerSettings, LimiterSettings, Observation, ParameterError,
    SafetyLayer, SafetyTick, Signal,
    controller::SafetySettings,
    estimator::{EstimatorKind, Motion},
    layer::{DEFAULT_LEVER_M, Inertia, Perceived},
    parameter::{finite, non_negative, positive},
    plausible::{Excess, Judged, Sample, SampleBounds, Turned},
};

#[cfg(test)]
mod tests;

/// Dynamics of a turning haptic device: a rigid body in the frame of its principal axes.
///
/// `I a + w x I w + b_r w + c_r w / |w| = tau_device + tau_h`
///
/// Source: Euler's equations, Goldstein, Poole and Safko 2002, Eq. 5.39; friction as paper Eq. 3.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RotationModel {
    /// The same equation without `w x I w`. This is Eq. 3, whose friction is along V as well.
    axes: DeviceModel<3>,
}

impl RotationModel {
    /// Create a body with inertia I in kg m² about each axis (> 0).
    ///
    /// Viscous friction `b_r` is in N m s/rad (any sign), Coulomb friction `c_r` in N m (>= 0).
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

    /// Return `w x I w` in N m.
    #[inline]
    pub fn gyroscopic_torque(&self, angular_velocity: &Axes<3>) -> Axes<3> {
        angular_velocity.cross(&self.inertia_kg_m2().component_mul(angular_velocity))
    }

    /// Return the hand torque in N m in the body frame, from exact signals.
    ///
    /// `tau_h = I a + w x I w + b_r w + c_r w / |w| - tau_device`
    ///
    /// Source: paper Eq. 4, with the gyroscopic torque of Euler's equations.
    pub fn grasp_torque(&self, motion: &Motion<3>, device_torque: &Axes<3>) -> Axes<3> {
        self.axes.grasp_force(motion, &(device_torque - self.gyroscopic_torque(&motion.velocity)))
    }

    /// Return the kinetic energy `w' I w / 2` in J.
    pub fn kinetic_energy_j(&self, angular_velocity: &Axes<3>) -> f64 {
        self.axes.kinetic_energy_j(angular_velocity)
    }
}

/// Settings of the safety layer of a rotation: torques in N m, velocities in rad/s, positions in rad.
///
/// [`SafetySettings::at_lever`] and [`LimiterSettings::at_lever`] convert the thresholds of a point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RotationSettings {
    /// Dynamics of the device.
    pub device: RotationModel,
    /// dT in s.
    pub period_s: f64,
    /// Estimator of w and a from orientations, for a device that does not measure its angular velocity.
    pub estimator: EstimatorKind,
    /// Observers and controllers.
    pub safety: SafetySettings,
    /// Bounds on the device torque.
    pub limiter: LimiterSettings,
}

/// Bound in rad on each component of x. Beyond it, that component and the estimators' positions are moved by 8 rad
/// towards zero. A power of two, so that the subtraction is exact.
const REBASE: f64 = 8.0;

/// Largest turn in rad between two samples. Near pi the sense of rotation is ambiguous.
const MAX_TURN: f64 = 3.0;

/// The safety layer of a rotation: [`SafetyLayer`] on body increments.
///
/// `x_k = x_(k-1) + log(R_(k-1)^T R_k)`
///
/// V is then the angular velocity and A the angular acceleration of the body, in the body frame. A full turn of 2 pi
/// needs no special case. An increment is the integral of w over the tick except for `dT³ w x a / 12`, the second
/// term of the Magnus expansion. The layer keeps x within 8 rad by moving the origin of the estimators with it.
///
/// Orientations R are `base_from_body`. Angular velocities and torques enter and leave **in the base frame**; R of
/// the tick converts them. A held torque keeps its direction in the base frame. Eq. 4 uses the held torque in the
/// body frame at mid-tick. The limiter measures its growth in the body frame at the end of the tick.
///
/// **Gyroscopic torque.** `w x I w` must have the lag of A, and is evaluated at the mean of two successive V. If V
/// belongs to the newest sample, `w x I w` passes through the kernel of A together with the device torque, as the
/// mean over the tick. If V is filtered too, A is the difference of two successive V, and `w x I w` is evaluated at
/// their mean, without the kernel.
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

/// Guard the rotation of a layer.
fn guarded(layer: SafetyLayer<3>, bounds: SampleBounds, period_s: f64) -> SafetyLayer<3> {
    let bounds = layer.reachable(bounds);
    layer.guarded(SampleBounds::UNBOUNDED, bounds, period_s)
}

/// State of a tick that a coupling computes its torque from, in the base frame, as [`Coupled`].
#[derive(Clone, Copy, Debug)]
pub struct CoupledTurn<'a> {
    /// R: the sample, or the last accepted one while the sample is held.
    pub orientation: &'a UnitQuaternion<f64>,
    /// w in rad/s.
    pub angular_velocity: Axes<3>,
    coupled: &'a Coupled<'a, 3>,
}

impl CoupledTurn<'_> {
    /// Scale a torque by `gain`, see [`Coupled::faded`].
    #[inline(always)]
    pub fn faded(&self, requested_torque: &Axes<3>, gain: f64) -> Axes<3> {
        self.coupled.faded(requested_torque, gain)
    }

    /// Return `couple` for a layer whose vectors are in the body frame.
    fn in_body<'a>(
        orientation: &'a UnitQuaternion<f64>,
        couple: &'a mut dyn FnMut(&CoupledTurn<'_>) -> Axes<3>,
    ) -> impl FnOnce(&Coupled<'_, 3>) -> Axes<3> + 'a {
        move |at| {
            let angular_velocity = orientation * at.velocity;
            let torque = couple(&CoupledTurn { orientation, angular_velocity, coupled: at });
            orientation.inverse_transform_vector(&torque)
        }
    }
}

impl RotationLayer {
    /// Create a layer for a device at rest, without torque.
    pub fn new(settings: &RotationSettings) -> Result<Self, ParameterError> {
        let RotationSettings { device, period_s, estimator, safety, limiter } = *settings;
        let layer =
            SafetyLayer::new(&LayerSettings { device: device.axes, period_s, estimator, safety, limiter })?;
        let bounds = SampleBounds::LINEAR.at_lever(DEFAULT_LEVER_M);
        Ok(Self {
            layer: guarded(layer, bounds, period_s),
            period_s,
            gyroscope: Gyroscope { device, last: None },
            max_turn: MAX_TURN.min(Signal::AngularVelocity.bound() * period_s),
            orientation: None,
            turned: Axes::zeros(),
        })
    }

    /// Replace the default sample bounds, those of a point at a lever of 0.05 m. Call this before the first tick.
    #[must_use]
    pub fn with_samples(self, bounds: SampleBounds) -> Self {
        let layer = guarded(self.layer, bounds, self.period_s);
        Self { layer, ..self }
    }

    /// Estimate `tau_h` at every tick, see [`SafetyLayer::with_grasp_force`].
    #[must_use]
    pub fn with_grasp_torque(self) -> Self {
        Self { layer: self.layer.with_grasp_force(), ..self }
    }

    /// Return `tau_h` in N m of the last tick in the base frame, see [`SafetyLayer::grasp_force`].
    pub(crate) fn grasp_torque(&self) -> Axes<3> {
        self.orientation.unwrap_or_default() * self.layer.grasp_force()
    }

    /// Bounds that the motors of this device cannot exceed by themselves.
    pub(crate) fn reachable(&self, bounds: SampleBounds) -> SampleBounds {
        self.layer.reachable(bounds)
    }

    /// Compute one tick from orientation R, angular velocity w in rad/s and the requested torque in N m.
    ///
    /// Arguments and results are in the base frame. Pass w at every tick if the device measures it, else never.
    ///
    /// [`Guard`](crate::Guard) holds a sample that leaves the path of the others and replaces it by its prediction. A
    /// fault gives zero torque at this tick and stays until [`reset`](Self::reset). Causes of a fault:
    ///
    /// - a quaternion that is not finite, or whose norm differs from 1 by more than 1e-9;
    /// - a step beyond the speed bound of the device;
    /// - a turn of more than 3 rad, or faster than 1000 rad/s, between two samples;
    /// - another value that is not finite or out of range.
    pub fn tick(
        &mut self,
        orientation: &UnitQuaternion<f64>,
        angular_velocity: Option<&Axes<3>>,
        requested_torque: &Axes<3>,
    ) -> SafetyTick<3> {
        self.tick_after(0, orientation, angular_velocity, requested_torque, 1.0)
    }

    /// Compute the tick that follows `missed` skipped ticks, with the controllers' damping scaled by `authority` (0
    /// to 1).
    pub fn tick_after(
        &mut self,
        missed: u64,
        orientation: &UnitQuaternion<f64>,
        angular_velocity: Option<&Axes<3>>,
        requested_torque: &Axes<3>,
        authority: f64,
    ) -> SafetyTick<3> {
        let mut couple = |_: &CoupledTurn<'_>| *requested_torque;
        let entered = self.check(orientation, angular_velocity).and_then(|()| {
            match self.layer.judge(missed, sample_of(orientation, angular_velocity).parts())? {
                Judged::Held(at) => return Ok(Err(at)),
                Judged::Settled => self.catch_up(),
                _ => {}
            }
            self.checked(orientation, angular_velocity, &mut couple).map(Ok)
        });
        match entered {
            Ok(Ok(perceived)) => {
                let advance = self.layer.decide(&perceived, authority);
                in_base(orientation, &self.layer.keep(&advance, authority))
            }
            Ok(Err(at)) => self.hold_coupled(at, &mut couple, authority),
            Err(fault) => self.stop(fault),
        }
    }

    /// Compute a tick whose sample is held, as [`SafetyLayer::hold_coupled`], with the last accepted orientation. `at`:
    /// ticks since that sample.
    pub(crate) fn hold_coupled(
        &mut self,
        at: f64,
        couple: &mut dyn FnMut(&CoupledTurn<'_>) -> Axes<3>,
        authority: f64,
    ) -> SafetyTick<3> {
        let orientation = self.orientation.unwrap_or_default();
        let tick = self.layer.hold_coupled(at, CoupledTurn::in_body(&orientation, couple), authority);
        match tick.fault {
            Some(fault) => self.stop(fault.of_rotation()),
            None => in_base(&orientation, &tick),
        }
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

    /// Apply a step of the orientation without adding velocity: the next increment starts at the stepped orientation.
    ///
    /// Stored torques keep their direction in the base frame.
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

    /// Return the speed that exceeded the device's bound and caused the fault, if any.
    pub fn excess(&self) -> Option<Excess> {
        self.layer.excess()
    }

    /// Return the stored fault, or a fault for a value that is not finite or out of range.
    pub(crate) fn check(
        &self,
        orientation: &UnitQuaternion<f64>,
        angular_velocity: Option<&Axes<3>>,
    ) -> Result<(), Fault> {
        if let Some(fault) = self.layer.fault() {
            return Err(fault);
        }
        // Check before the state changes, and in the base frame: a vector with a NaN has no direction.
        check(orientation)?;
        angular_velocity.map_or(Ok(()), |w| Signal::AngularVelocity.check(w))
    }

    /// Check the values and observe one tick in the body frame; the sample must be on its path.
    pub(crate) fn checked(
        &mut self,
        orientation: &UnitQuaternion<f64>,
        angular_velocity: Option<&Axes<3>>,
        couple: &mut dyn FnMut(&CoupledTurn<'_>) -> Axes<3>,
    ) -> Result<Perceived<3, f64>, Fault> {
        self.check(orientation, angular_velocity)?;
        self.turn_to(orientation)?;
        let w = angular_velocity.map(|w| orientation.inverse_transform_vector(w));
        let couple = CoupledTurn::in_body(orientation, couple);
        self.layer.checked(&self.turned, w.as_ref(), couple, &mut self.gyroscope).map_err(Fault::of_rotation)
    }

    /// Add the increment to this orientation, and turn the stored torques.
    fn turn_to(&mut self, orientation: &UnitQuaternion<f64>) -> Result<(), Fault> {
        let last = self.orientation.unwrap_or(*orientation);
        let step = last.inverse() * orientation;
        let increment = step.scaled_axis();
        if increment.norm() > self.max_turn {
            return Err(Fault::OutOfRange(Signal::AngularVelocity));
        }
        self.orientation = Some(*orientation);
        // Compute exp(log(step) / 2) without an angle; q and -q are the same rotation.
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

    /// Carry the controllers over a missed tick, as [`SafetyLayer::missed`].
    ///
    /// The device kept its torque, and `orientation` lies between two samples.
    pub(crate) fn missed(&mut self, orientation: &UnitQuaternion<f64>, angular_velocity: Option<&Axes<3>>) {
        if let Some(seen) = self.missed_observation(orientation, angular_velocity) {
            self.layer.controller().skip_tick(&seen);
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

    /// Set a fault that the layer cannot detect itself: no torque until [`reset`](Self::reset).
    pub fn fail(&mut self, fault: Fault) {
        self.layer.fail(fault);
    }

    pub(crate) fn stop(&mut self, fault: Fault) -> SafetyTick<3> {
        self.layer.stop(fault)
    }

    /// Return the torque in N m of the coupling that the device has exerted since the last tick, in the base frame.
    pub(crate) fn exerted(&self) -> Axes<3> {
        self.orientation.unwrap_or_default() * self.layer.exerted()
    }

    pub(crate) fn layer(&mut self) -> &mut SafetyLayer<3> {
        &mut self.layer
    }

    /// Clear the past as [`reset`](Self::reset) does, but keep the fault.
    pub fn restart(&mut self, orientation: &UnitQuaternion<f64>) -> Result<(), Fault> {
        check(orientation)?;
        self.layer.restart(&Axes::zeros())?;
        self.rest_at(orientation);
        Ok(())
    }

    /// Clear fault and past: the device rests at `orientation`, and its torque rises from zero.
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

/// Create the sample of a pure rotation.
fn sample_of(orientation: &UnitQuaternion<f64>, angular_velocity: Option<&Axes<3>>) -> Sample<3> {
    let turned = Turned { orientation: *orientation, angular_velocity: angular_velocity.copied() };
    Sample { position: Axes::zeros(), velocity: None, rotation: Some(turned) }
}

/// Return a fault if the quaternion is not a unit quaternion.
pub(crate) fn check(orientation: &UnitQuaternion<f64>) -> Result<(), Fault> {
    let norm = orientation.quaternion().norm();
    if (norm - 1.0).abs() <= Signal::Orientation.bound() {
        return Ok(());
    }
    // The norm of finite components may be infinite.
    Err(if orientation.coords.iter().all(|x| x.is_finite()) {
        Fault::OutOfRange(Signal::Orientation)
    } else {
        Fault::NotFinite(Signal::Orientation)
    })
}

/// Convert the vectors of a tick to the base frame.
pub(crate) fn in_base(orientation: &UnitQuaternion<f64>, tick: &SafetyTick<3>) -> SafetyTick<3> {
    let mut intervention = tick.intervention;
    intervention.safety_force = orientation * intervention.safety_force;
    SafetyTick {
        motion: Motion {
            velocity: orientation * tick.motion.velocity,
            // w x w = 0, so this is also the derivative of w in the base frame.
            acceleration: orientation * tick.motion.acceleration,
        },
        rendered_force: orientation * tick.rendered_force,
        grasp_force: orientation * tick.grasp_force,
        device_force: orientation * tick.device_force,
        intervention,
        ..*tick
    }
}

/// Gyroscopic torque `w x I w` with the lag of A.
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
