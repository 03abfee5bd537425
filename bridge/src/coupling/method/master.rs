//! Half of a coupling at the master, between the frame map and the safety layer.

use haptether_safety::Axes;

use super::{Half, Local, MethodSettings, Peer};
use crate::{
    coupling::Mapping,
    port::CouplingMessage,
    wire::{Frame, padded, unpadded},
};

/// Half of a coupling at the master, with its state since the engagement.
///
/// Both sides send motions since the engagement, in the master's frame: `p = x_m - x_m0` and the slave's `s`. The
/// master engages once the slave has, at `p = s'`, so that `F_v` is 0 at that tick.
#[derive(Clone, Copy, Debug)]
pub(crate) struct CoupledMaster<const N: usize> {
    half: Half,
    /// `lambda_p` of the scene.
    position_scale: f64,
    /// Position in m of the hand at which its motion is zero; None while not engaged.
    origin: Option<Axes<N>>,
    /// Engagement of the slave to which this one belongs.
    peer_epoch: u16,
    /// Force in N of the last engaged tick, which fades with the ladder's gain.
    force: Axes<N>,
}

impl<const N: usize> CoupledMaster<N> {
    /// Build the half. None for position-force, whose force follows from the newest frame alone.
    pub(crate) fn new(settings: &MethodSettings) -> Option<Self> {
        let MethodSettings { kind, gains, position_scale, .. } = *settings;
        let half = Half::new::<N>(kind, gains)?;
        Some(Self { half, position_scale, origin: None, peer_epoch: 0, force: Axes::zeros() })
    }

    /// Return `F_v` in N before the ladder's gain, from x in m and V in m/s.
    ///
    /// The half is stepped while the sides are coupled. Otherwise the last force stays, and the gain fades it.
    #[inline(never)]
    pub(crate) fn request(
        &mut self,
        map: &Mapping<N>,
        (position, velocity): (&Axes<N>, &Axes<N>),
        gain: f64,
        is_coupled: bool,
        peer: &Frame,
    ) -> Axes<N> {
        let CouplingMessage { epoch, ref vector, .. } = peer.message;
        if !is_coupled {
            // The springs lose their energy.
            self.origin = None;
            return self.force;
        }
        if epoch == 0 {
            // The gain may rise before the slave has engaged: no force of an earlier engagement may rise with it.
            (self.origin, self.force) = (None, Axes::zeros());
            return self.force;
        }
        let sent: Axes<N> = unpadded(vector);
        let sends_motion = peer.sends_motion();
        let of_slave = if sends_motion { sent } else { Axes::zeros() };
        let origin = match self.origin {
            Some(origin) if epoch == self.peer_epoch => origin,
            _ => {
                // Each engagement begins without force.
                self.origin = Some(position - of_slave);
                (self.peer_epoch, self.force) = (epoch, Axes::zeros());
                return self.force;
            }
        };
        let frame = map.map();
        let to_slave = |of_master: &Axes<N>| frame.to_slave(of_master) * self.position_scale;
        let of_peer: Axes<N> = unpadded(&peer.velocity);
        let own = Local { position: &to_slave(&(position - origin)), velocity: &to_slave(velocity), gain };
        let peer = Peer {
            position: &to_slave(&of_slave),
            velocity: &of_peer,
            force: &if sends_motion { Axes::zeros() } else { sent },
        };
        self.force = -map.rendered_force(&self.half.master(&own, &peer));
        self.force
    }

    /// Numbers for the next frame: the motion in m since the engagement; zeros while not engaged.
    pub(crate) fn message(&self, epoch: u16, position: &Axes<N>) -> CouplingMessage {
        let Some(origin) = self.origin.filter(|_| epoch != 0) else { return CouplingMessage::ZERO };
        CouplingMessage { epoch, vector: padded(&(position - origin)), ..CouplingMessage::ZERO }
    }
}
