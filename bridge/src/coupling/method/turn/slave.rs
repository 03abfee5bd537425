//! Half of a coupling at the slave, for the rotation.

use haptether_safety::Axes;
use nalgebra::{Unit, UnitQuaternion};

use super::{
    super::{Half, Local, MethodSettings, Peer, SlaveSends, VirtualToolSettings, capped},
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
    /// Turn in rad of the master in its last engaged frame.
    moved: Axes<3>,
    sent: Axes<3>,
    /// `tau_c` in N m since the last tick, and the orientation of the tool before it.
    torque: Axes<3>,
    before: UnitQuaternion<f64>,
}

fn product(left: &UnitQuaternion<f64>, right: &UnitQuaternion<f64>) -> UnitQuaternion<f64> {
    Unit::new_normalize((left * right).into_inner())
}

impl CoupledSlaveTurn {
    /// Build the half. None for position-force, and for a scene that does not turn.
    pub(crate) fn new(settings: &MethodSettings) -> Option<Self> {
        let (gains, tool) = settings.rotation?;
        let (half, sends) = (Half::new::<3>(settings.kind, gains)?, settings.kind.slave_sends()?);
        let orientation = UnitQuaternion::identity();
        let [velocity, moved, sent, torque] = [Axes::zeros(); 4];
        let (engaged, before) = (false, orientation);
        Some(Self { half, sends, tool, orientation, velocity, engaged, moved, sent, torque, before })
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
            [self.moved, self.sent, self.torque] = [Axes::zeros(); 3];
            (self.engaged, self.before) = (true, *from);
            return *from;
        }
        let (message, velocity) = peer;
        let is_engaged = message.epoch != 0;
        if is_engaged {
            self.moved = message.turned;
        }
        let turned = UnitQuaternion::from_scaled_axis(self.moved);
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
        (self.torque, self.before) = (coupled, self.orientation);
        self.orientation = product(&UnitQuaternion::from_scaled_axis(self.velocity * dt), &self.orientation);
        product(&UnitQuaternion::from_scaled_axis(self.velocity * lead_s), &self.orientation)
    }

    /// Follow the command that bounds have turned from `wanted` to `command`, at most at `max_speed` in rad/s, and not
    /// outwards where `leaves` is true.
    pub(crate) fn limit(
        &mut self,
        [wanted, command]: [&UnitQuaternion<f64>; 2],
        max_speed: f64,
        leaves: bool,
    ) {
        let moved = (command * wanted.inverse()).scaled_axis();
        if leaves && moved.norm() > 0.0 {
            let direction = moved.normalize();
            self.velocity -= direction * self.velocity.dot(&direction).min(0.0);
        }
        self.velocity = capped(&self.velocity, max_speed);
        let lead = self.velocity * self.tool.lead_s;
        self.orientation = product(&UnitQuaternion::from_scaled_axis(-lead), command);
    }

    /// Angular velocity in rad/s of the tool.
    pub(crate) fn velocity(&self) -> &Axes<3> {
        &self.velocity
    }

    /// Work in J of `tau_c` on the tool at the last tick.
    pub(crate) fn work_j(&self) -> f64 {
        self.torque.dot(&(self.orientation * self.before.inverse()).scaled_axis())
    }

    /// Numbers for the next frame; None while not engaged.
    pub(crate) fn sent(&self) -> Option<&Axes<3>> {
        self.engaged.then_some(&self.sent)
    }

    /// End the engagement; the spring loses its energy.
    pub(crate) fn disengage(&mut self) {
        self.engaged = false;
    }
}
