//! Half of a coupling at the master, for the rotation.

use haptether_safety::Axes;
use nalgebra::UnitQuaternion;

use super::{
    super::{Half, Local, MethodSettings, Peer},
    stretch,
};
use crate::{coupling::RotationCoupling, port::CouplingMessage, wire::Frame};

/// Half of a coupling at the master for the rotation, as [`CoupledMaster`](super::super::CoupledMaster).
#[derive(Clone, Copy, Debug)]
pub(crate) struct CoupledMasterTurn {
    half: Half,
    /// Orientation of the hand at which its turn is zero; None while not engaged.
    origin: Option<UnitQuaternion<f64>>,
    /// Engagement of the slave to which this one belongs.
    peer_epoch: u16,
    /// Torque in N m of the last engaged tick, which fades with the ladder's gain.
    torque: Axes<3>,
}

impl CoupledMasterTurn {
    /// Build the half. None for position-force, and for a scene that does not turn.
    pub(crate) fn new(settings: &MethodSettings) -> Option<Self> {
        let (gains, _) = settings.rotation?;
        let half = Half::new::<3>(settings.kind, gains)?;
        Some(Self { half, origin: None, peer_epoch: 0, torque: Axes::zeros() })
    }

    /// Return `tau_m` in N m before the ladder's gain from R and w in rad/s, as [`CoupledMaster::request`](super::super::CoupledMaster::request).
    #[inline(never)]
    pub(crate) fn request(
        &mut self,
        map: &RotationCoupling,
        (orientation, angular_velocity): (&UnitQuaternion<f64>, &Axes<3>),
        gain: f64,
        is_coupled: bool,
        peer: &Frame,
    ) -> Axes<3> {
        let CouplingMessage { epoch, turned: sent, .. } = peer.message;
        if !is_coupled {
            self.origin = None;
            return self.torque;
        }
        if epoch == 0 {
            (self.origin, self.torque) = (None, Axes::zeros());
            return self.torque;
        }
        let sends_motion = peer.sends_motion();
        let of_slave =
            if sends_motion { UnitQuaternion::from_scaled_axis(sent) } else { UnitQuaternion::identity() };
        let origin = match self.origin {
            Some(origin) if epoch == self.peer_epoch => origin,
            _ => {
                self.origin = Some(of_slave.inverse() * orientation);
                (self.peer_epoch, self.torque) = (epoch, Axes::zeros());
                return self.torque;
            }
        };
        let turned = orientation * origin.inverse();
        let frame = map.frame();
        let velocity = peer.rotation.map_or(Axes::zeros(), |slave| slave.angular_velocity);
        let own = Local { position: &Axes::zeros(), velocity: &(frame * angular_velocity), gain };
        let peer = Peer {
            position: &(frame * stretch(&turned, &of_slave)),
            velocity: &velocity,
            force: &if sends_motion { Axes::zeros() } else { sent },
        };
        self.torque = -map.rendered_torque(&self.half.master(&own, &peer));
        self.torque
    }

    /// Turn in rad since the engagement, for the next frame; None while not engaged.
    pub(crate) fn turned(&self, orientation: &UnitQuaternion<f64>) -> Option<Axes<3>> {
        self.origin.map(|origin| (orientation * origin.inverse()).scaled_axis())
    }
}
