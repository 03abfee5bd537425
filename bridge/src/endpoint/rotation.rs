//! The rotation of a slave's endpoint: from the master's orientation to the one that the arm is to take.

use haptether_safety::{Axes, Fault, Signal};
use nalgebra::UnitQuaternion;

use crate::coupling::{
    CouplingError, Limited, RotationBounds, RotationCoupling, RotationLock, RotationState, turned_within,
};

/// How the rotation of a slave's endpoint is built.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SlaveRotationSettings {
    /// `lambda_r`.
    pub rotation_scale: f64,
    /// What of the rotation follows.
    pub lock: RotationLock,
    /// What it takes of a remote command.
    pub bounds: RotationBounds,
}

/// The rotation part of a slave's endpoint.
#[derive(Clone, Debug)]
pub(super) struct SlaveRotation {
    pub(super) coupling: RotationCoupling,
    bounds: RotationBounds,
    /// How the arm stood at its first tick.
    home: Option<UnitQuaternion<f64>>,
    /// The last command; none before the first engagement.
    pub(super) command: Option<UnitQuaternion<f64>>,
}

impl SlaveRotation {
    pub(super) fn new(settings: &SlaveRotationSettings) -> Result<Self, CouplingError> {
        settings.bounds.check()?;
        let mut coupling = RotationCoupling::new(settings.rotation_scale, 1.0)?;
        coupling.set_lock(settings.lock);
        Ok(Self { coupling, bounds: settings.bounds, home: None, command: None })
    }

    /// Refuses what no arm can measure.
    pub(super) fn check(measured: Option<&RotationState>) -> Result<(), Fault> {
        let Some(RotationState { orientation, angular_velocity, torque }) = measured else {
            return Err(Fault::NotFinite(Signal::Orientation));
        };
        check_orientation(orientation)?;
        Signal::AngularVelocity.check(angular_velocity)?;
        Signal::EnvironmentTorque.check(torque)
    }

    /// Begins at the first tick where the arm is.
    pub(super) fn begin(&mut self, measured: &RotationState) {
        self.home.get_or_insert(measured.orientation);
    }

    /// Follows the master's newest rotation, `ahead_s` beyond it; `share` of its angular velocity is left.
    ///
    /// Returns the angular velocity in rad/s that goes with the command.
    pub(super) fn follow(
        &mut self,
        master: &RotationState,
        measured: &RotationState,
        elapsed_s: f64,
        (ahead_s, share): (f64, f64),
        limited: &mut Limited,
    ) -> Axes<3> {
        let home = self.home.unwrap_or(measured.orientation);
        let from = self.command.unwrap_or(measured.orientation);
        // Where the two are taken to be coupled anew while frames are late, it has gone ahead already.
        let ahead = |velocity: Axes<3>| UnitQuaternion::from_scaled_axis(velocity * ahead_s);
        let before = ahead(self.coupling.commanded_velocity(&master.angular_velocity));
        let followed = self.coupling.commanded_orientation(&master.orientation, &(before.inverse() * from));
        let velocity = self.coupling.commanded_velocity(&master.angular_velocity);
        let wanted = ahead(velocity) * followed;
        self.command = Some(turned_within(&self.bounds, elapsed_s, [&home, &from, &wanted], limited));
        let speed = velocity.norm() * share;
        if speed > self.bounds.speed {
            limited.angular_speed = true;
            return velocity * (share * self.bounds.speed / speed);
        }
        velocity * share
    }
}

/// Passes a unit quaternion, or names the fault.
pub(super) fn check_orientation(orientation: &UnitQuaternion<f64>) -> Result<(), Fault> {
    let norm = orientation.quaternion().norm();
    if (norm - 1.0).abs() <= Signal::Orientation.bound() {
        return Ok(());
    }
    Err(if norm.is_finite() {
        Fault::OutOfRange(Signal::Orientation)
    } else {
        Fault::NotFinite(Signal::Orientation)
    })
}
