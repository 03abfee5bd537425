//! An object that turns about one axis while a tool holds it.

use nalgebra::{Unit, UnitQuaternion};

use super::{
    hold::{Frame, Stiffness},
    settings::{HandleSettings, direction, finite, non_negative, positive},
};
use crate::{Axes, ModelError, require};

/// Speed in rad/s below which the dry friction of a handle is linear in it, like [`FULL_SLIP`] of a surface.
pub(super) const FULL_TURN: f64 = 1e-2;
/// Stiffness of the stops of a handle, in N m/rad.
pub(super) const STOP_STIFFNESS: f64 = 500.0;

/// An object that turns about one axis.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Handle {
    pub(super) point: Axes<3>,
    pub(super) axis: Unit<Axes<3>>,
    pub(super) lever: Axes<3>,
    pub(super) reach: f64,
    pub(super) width: f64,
    pub(super) inertia: f64,
    pub(super) viscous: f64,
    pub(super) coulomb: f64,
    pub(super) stiffness: f64,
    pub(super) stops: [f64; 2],
    pub(super) hold: Stiffness,
}

impl Handle {
    pub(super) fn new(settings: &HandleSettings, mass_kg: f64, moment: f64) -> Result<Self, ModelError> {
        let (point, grip) = (finite("handle point", settings.point)?, finite("handle grip", settings.grip)?);
        let [lower, upper] = settings.stops_rad;
        require("handle stops_rad", lower, upper > lower, "finite and below the upper stop")?;
        require("handle stops_rad", upper, true, "finite")?;
        let linear = positive("handle hold_stiffness", settings.hold_stiffness)?;
        let angular = non_negative("handle hold_rotational_stiffness", settings.hold_rotational_stiffness)?;
        Ok(Self {
            point,
            axis: direction("handle axis", settings.axis)?,
            lever: grip - point,
            reach: positive("handle reach_m", settings.reach_m)?,
            width: non_negative("handle width_m", settings.width_m)?,
            inertia: positive("handle inertia_kg_m2", settings.inertia_kg_m2)?,
            viscous: non_negative("handle viscous", settings.viscous)?,
            coulomb: non_negative("handle coulomb", settings.coulomb)?,
            stiffness: non_negative("handle stiffness", settings.stiffness)?,
            stops: [lower, upper],
            // Critically damped with the mass and inertia of the tool.
            hold: Stiffness {
                linear: (linear, 2.0 * (linear * mass_kg).sqrt()),
                angular: (angular, 2.0 * (angular * moment).sqrt()),
            },
        })
    }

    /// Frame of its grip point.
    pub(super) fn frame(&self, [angle, rate]: [f64; 2]) -> Frame {
        let orientation = UnitQuaternion::from_axis_angle(&self.axis, angle);
        let lever = orientation * self.lever;
        let angular_velocity = self.axis.into_inner() * rate;
        Frame {
            position: self.point + lever,
            velocity: angular_velocity.cross(&lever),
            orientation,
            angular_velocity,
        }
    }

    /// Its own torque in N m about its axis: friction, spring, stops.
    pub(super) fn own_torque(&self, [angle, rate]: [f64; 2]) -> f64 {
        let beyond = angle - angle.clamp(self.stops[0], self.stops[1]);
        let stop = if beyond == 0.0 {
            0.0
        } else {
            let pressed = STOP_STIFFNESS * beyond + 2.0 * (STOP_STIFFNESS * self.inertia).sqrt() * rate;
            // A stop only pushes.
            if pressed * beyond > 0.0 { pressed } else { 0.0 }
        };
        -self.viscous * rate - self.coulomb * rate / rate.abs().max(FULL_TURN) - self.stiffness * angle - stop
    }
}
