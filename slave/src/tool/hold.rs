//! Coupling of a tool and a held object: a stiff spring between two frames that slips where friction is exceeded.

use nalgebra::UnitQuaternion;

use super::rigid::Load;
use crate::Axes;

/// Pose and velocity of a frame, in the base frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Frame {
    pub(super) position: Axes<3>,
    pub(super) velocity: Axes<3>,
    pub(super) orientation: UnitQuaternion<f64>,
    pub(super) angular_velocity: Axes<3>,
}

/// Stiffness and damping of a hold.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Stiffness {
    /// N/m and N s/m.
    pub(super) linear: (f64, f64),
    /// N m/rad and N m s/rad.
    pub(super) angular: (f64, f64),
}

/// Limits of friction at the jaws: force in N across the closing direction, moment in N m.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Grip {
    pub(super) force: f64,
    pub(super) moment: f64,
}

/// A hold: pose of the held object in the tool frame at which the spring is unloaded.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Hold {
    position: Axes<3>,
    orientation: UnitQuaternion<f64>,
}

impl Hold {
    /// A hold at the present poses, without force.
    pub(super) fn at(tool: &Frame, held: &Frame) -> Self {
        let back = tool.orientation.inverse();
        Self { position: back * (held.position - tool.position), orientation: back * held.orientation }
    }

    /// Load of the tool on the held object, about its point, without slip: the part of the spring, then the sum with
    /// the damper.
    ///
    /// `f = k (x_t + R_t p - x_h) + b (v_p - v_h)`, `tau = k_r log(R_t Q R_h') + b_r (w_t - w_h)`; the moment of the
    /// force about the tool point is not included.
    fn wish(&self, tool: &Frame, held: &Frame, stiffness: &Stiffness) -> (Load, Load) {
        let lever = tool.orientation * self.position;
        let at = tool.position + lever;
        let velocity = tool.velocity + tool.angular_velocity.cross(&lever);
        let way = (tool.orientation * self.orientation * held.orientation.inverse()).scaled_axis();
        let spring =
            Load { force: (at - held.position) * stiffness.linear.0, torque: way * stiffness.angular.0 };
        let damper = Load {
            force: (velocity - held.velocity) * stiffness.linear.1,
            torque: (tool.angular_velocity - held.angular_velocity) * stiffness.angular.1,
        };
        (spring, Load { force: spring.force + damper.force, torque: spring.torque + damper.torque })
    }

    /// Load of the tool on the held object, about its point, within the limits of the grip.
    pub(super) fn load(
        &self,
        tool: &Frame,
        held: &Frame,
        stiffness: &Stiffness,
        grip: Option<&Grip>,
    ) -> Load {
        let (_, wish) = self.wish(tool, held, stiffness);
        let Some(grip) = grip else { return wish };
        let closing = tool.orientation * Axes::<3>::x();
        let along = closing * closing.dot(&wish.force);
        Load {
            force: along + at_most(wish.force - along, grip.force),
            torque: at_most(wish.torque, grip.moment),
        }
    }

    /// Slip until the spring force equals the limit of the grip, if it exceeds it.
    pub(super) fn slip(&mut self, tool: &Frame, held: &Frame, stiffness: &Stiffness, grip: &Grip) {
        let (spring, _) = self.wish(tool, held, stiffness);
        let closing = tool.orientation * Axes::<3>::x();
        let across = spring.force - closing * closing.dot(&spring.force);
        let back = tool.orientation.inverse();
        if across.norm() > grip.force {
            let over = across - at_most(across, grip.force);
            self.position -= back * over / stiffness.linear.0;
        }
        if spring.torque.norm() > grip.moment && stiffness.angular.0 > 0.0 {
            let kept = at_most(spring.torque, grip.moment) / stiffness.angular.0;
            self.orientation = back * UnitQuaternion::from_scaled_axis(kept) * held.orientation;
        }
    }
}

fn at_most(vector: Axes<3>, most: f64) -> Axes<3> {
    let length = vector.norm();
    if length > most { vector * (most / length) } else { vector }
}
