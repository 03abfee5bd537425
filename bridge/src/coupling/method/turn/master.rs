//! Half of a coupling at the master, for the rotation.

use haptether_safety::Axes;
use nalgebra::UnitQuaternion;

use super::{
    super::{Half, HandMotion, Local, MethodSettings, Peer, Sends, Space, master::Engagements},
    stretch,
};
use crate::{
    coupling::RotationCoupling,
    port::CouplingMessage,
    wire::{Frame, Role},
};

/// Half of a coupling at the master for the rotation, as [`CoupledMaster`](super::super::CoupledMaster).
#[derive(Clone, Copy, Debug)]
pub(crate) struct CoupledMasterTurn {
    half: Half<3>,
    /// The half before any tick.
    fresh: Half<3>,
    engagements: Engagements,
    /// Sequence of the frame at the last tick.
    sequence: u64,
    /// True if this half sends a wave instead of its turn.
    sends_wave: bool,
    /// Orientation of the hand at which its turn is zero; None while not engaged.
    origin: Option<UnitQuaternion<f64>>,
    /// Orientation at the last tick.
    last: UnitQuaternion<f64>,
    /// Torque in N m of the last engaged tick, which fades with the ladder's gain.
    torque: Axes<3>,
}

impl CoupledMasterTurn {
    /// Build the half. None for position-force, and for a scene that does not turn.
    pub(crate) fn new(settings: &MethodSettings) -> Option<Self> {
        let (gains, _) = settings.rotation?;
        let half = Half::new(settings.kind, gains, Space::Rotation)?;
        let sends_wave = settings.kind.sends(Role::Master) == Some(Sends::Wave);
        let (engagements, last) = (Engagements::new(settings.kind), UnitQuaternion::identity());
        Some(Self {
            half,
            fresh: half,
            engagements,
            sequence: 0,
            sends_wave,
            origin: None,
            last,
            torque: Axes::zeros(),
        })
    }

    /// End the engagement, without force.
    pub(crate) fn clear(&mut self) {
        (self.origin, self.torque) = (None, Axes::zeros());
    }

    /// Return `tau_m` in N m before the ladder's gain, as [`CoupledMaster::request`](super::super::CoupledMaster::request).
    #[inline(never)]
    pub(crate) fn request(
        &mut self,
        map: &RotationCoupling,
        hand: &HandMotion<'_, UnitQuaternion<f64>, 3>,
        is_coupled: bool,
        (peer, newest_epoch): (&Frame, u16),
    ) -> Axes<3> {
        let CouplingMessage { epoch, turned: sent, sums, .. } = peer.message;
        if !is_coupled {
            self.origin = None;
            return self.torque;
        }
        if epoch == 0 || epoch != newest_epoch {
            self.clear();
            return self.torque;
        }
        let HandMotion { at: orientation, velocity, exerted, grasp, gain, dt } = *hand;
        let is_new = std::mem::replace(&mut self.sequence, peer.sequence) != peer.sequence;
        let sends_motion = peer.sends_motion();
        let of_slave =
            if sends_motion { UnitQuaternion::from_scaled_axis(sent) } else { UnitQuaternion::identity() };
        let last = std::mem::replace(&mut self.last, *orientation);
        let origin = match self.origin {
            Some(origin) if self.engagements.goes_on(epoch) => origin,
            _ => {
                self.origin = self.engagements.begin(epoch).then(|| of_slave.inverse() * orientation);
                (self.half, self.torque) = (self.fresh, Axes::zeros());
                return self.torque;
            }
        };
        let turned = orientation * origin.inverse();
        let frame = map.frame();
        let (of_peer, torque) = peer
            .rotation
            .map_or((Axes::zeros(), Axes::zeros()), |slave| (slave.angular_velocity, slave.torque));
        let own = Local {
            position: &Axes::zeros(),
            velocity: &(frame * velocity),
            moved: &(frame * (orientation * last.inverse()).scaled_axis()),
            exerted: &-map.coupled_torque(exerted),
            force: &map.coupled_torque(grasp),
            gain,
            dt,
        };
        let peer = Peer {
            position: &(frame * stretch(&turned, &of_slave)),
            velocity: &of_peer,
            force: &torque,
            vector: &if sends_motion { Axes::zeros() } else { sent },
            sum: sums[1],
            is_new,
            rests: false,
        };
        self.torque = -map.rendered_torque(&self.half.master(&own, &peer));
        self.torque
    }

    /// Numbers and energy in J for the next frame: the turn in rad since the engagement, or a wave. None while not engaged.
    pub(crate) fn sent(&self, orientation: &UnitQuaternion<f64>) -> Option<(Axes<3>, f64)> {
        let origin = self.origin?;
        let (wave, energy_j) = self.half.sent();
        Some((if self.sends_wave { wave } else { (orientation * origin.inverse()).scaled_axis() }, energy_j))
    }

    /// Energy in J that the half may still give; NaN for a half that counts none.
    pub(crate) fn left_j(&self) -> f64 {
        self.half.left_j()
    }
}
