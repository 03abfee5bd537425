//! Half of a coupling at the slave, for the rotation.

use haptether_safety::Axes;
use nalgebra::{Unit, UnitQuaternion};

use super::{
    super::{Half, Local, MethodSettings, Peer, SlaveSends, VirtualToolSettings},
    stretch,
};
use crate::{coupling::RotationCoupling, port::CouplingMessage};

/// Half of a coupling at the slave for the rotation, as [`CoupledSlave`](super::super::CoupledSlave).
///
/// The virtual tool is a ball: `I_v w' = tau_c + tau_e - b_v w`.
#[derive(Clone, Copy, Debug)]
pub(crate) struct CoupledSlaveTurn {
    half: Half,
    sends: SlaveSends,
    tool: VirtualToolSettings,
    /// Orientation and angular velocity in rad/s of the tool.
    orientation: UnitQuaternion<f64>,
    velocity: Axes<3>,
    engaged: bool,
    sent: Axes<3>,
    /// Work in J of `tau_c` on the tool at the last tick.
    work_j: f64,
}

fn product(left: &UnitQuaternion<f64>, right: &UnitQuaternion<f64>) -> UnitQuaternion<f64> {
    Unit::new_normalize((left * right).into_inner())
}

impl CoupledSlaveTurn {
    /// Build the half; none of measured position-force, and of a scene that does not turn.
    pub(crate) fn new(settings: &MethodSettings) -> Option<Self> {
        let (gains, tool) = settings.rotation?;
        let (half, sends) = (Half::new::<3>(settings.kind, gains)?, settings.kind.slave_sends()?);
        let (orientation, velocity, sent) = (UnitQuaternion::identity(), Axes::zeros(), Axes::zeros());
        Some(Self { half, sends, tool, orientation, velocity, engaged: false, sent, work_j: 0.0 })
    }

    /// Step an engaged tick of `dt` s at the command `from`; return the command that the coupling requests.
    ///
    /// `peer` has the master's numbers and its angular velocity in rad/s, `torque` is `tau_e` in N m.
    #[inline(never)]
    pub(crate) fn step(
        &mut self,
        map: &mut RotationCoupling,
        from: &UnitQuaternion<f64>,
        torque: &Axes<3>,
        peer: (&CouplingMessage, &Axes<3>),
        dt: f64,
    ) -> UnitQuaternion<f64> {
        if !self.engaged {
            (self.orientation, self.velocity) = (*from, Axes::zeros());
            map.clear_anchor();
            map.commanded_orientation(&UnitQuaternion::identity(), from);
            (self.engaged, self.sent, self.work_j) = (true, Axes::zeros(), 0.0);
            return *from;
        }
        let (message, velocity) = peer;
        let is_engaged = message.epoch != 0;
        let moved = if is_engaged { message.turned } else { Axes::zeros() };
        let turned = UnitQuaternion::from_scaled_axis(moved);
        let target = map.commanded_orientation(&turned, from);
        let velocity = if is_engaged { map.commanded_velocity(velocity) } else { Axes::zeros() };
        let own = Local { position: &Axes::zeros(), velocity: &self.velocity, gain: 1.0 };
        let phi = stretch(&self.orientation, &target);
        let peer = Peer { position: &phi, velocity: &velocity, force: &Axes::zeros() };
        let coupled = self.half.slave(&own, &peer);
        self.sent = match self.sends {
            // The turn beyond the target, in the frame of the master.
            SlaveSends::Motion => {
                let beyond = map.frame().inverse() * (self.orientation * target.inverse()) * map.frame();
                (beyond * turned).scaled_axis()
            }
            SlaveSends::Force => coupled,
        };
        let VirtualToolSettings { mass, damping, lead_s } = self.tool;
        self.velocity = (self.velocity + (coupled + torque) * (dt / mass)) / (1.0 + dt * damping / mass);
        let turn = self.velocity * dt;
        self.work_j = coupled.dot(&turn);
        self.orientation = product(&UnitQuaternion::from_scaled_axis(turn), &self.orientation);
        product(&UnitQuaternion::from_scaled_axis(self.velocity * lead_s), &self.orientation)
    }

    /// Take over what bounds left of the command, reached with `velocity` in rad/s.
    pub(crate) fn limit(&mut self, command: &UnitQuaternion<f64>, velocity: &Axes<3>) {
        self.velocity = *velocity;
        self.orientation = product(&UnitQuaternion::from_scaled_axis(velocity * -self.tool.lead_s), command);
    }

    /// Angular velocity in rad/s of the tool.
    pub(crate) fn velocity(&self) -> &Axes<3> {
        &self.velocity
    }

    /// Work in J of `tau_c` on the tool at the last tick.
    pub(crate) fn work_j(&self) -> f64 {
        self.work_j
    }

    /// Numbers for the next frame; none while not engaged.
    pub(crate) fn sent(&self) -> Option<&Axes<3>> {
        self.engaged.then_some(&self.sent)
    }

    /// End the engagement; the spring loses its energy.
    pub(crate) fn disengage(&mut self) {
        self.engaged = false;
    }
}
