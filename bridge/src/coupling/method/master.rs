//! Half of a coupling at the master, between the frame map and the safety layer.

use haptether_safety::Axes;

use super::{Half, Local, MethodSettings, Peer, Sends, Space};
use crate::{
    coupling::{CouplingKind, Mapping},
    port::CouplingMessage,
    wire::{Frame, Role, padded, unpadded},
};

/// State of the hand at a tick: x is a position or an orientation.
#[derive(Clone, Copy, Debug)]
pub(crate) struct HandMotion<'a, X, const N: usize> {
    /// Position in m, or orientation.
    pub(crate) at: &'a X,
    /// Velocity in m/s (rad/s).
    pub(crate) velocity: &'a Axes<N>,
    /// Force in N (N m) of the coupling that the device has exerted since the last tick.
    pub(crate) exerted: &'a Axes<N>,
    /// Force in N (N m) of the hand on the device at the last tick; zero unless the coupling needs it.
    pub(crate) grasp: &'a Axes<N>,
    /// Gain of the ladder.
    pub(crate) gain: f64,
    /// Time in s since the last tick.
    pub(crate) dt: f64,
}

/// Engagements of a half at the master.
#[derive(Clone, Copy, Debug)]
pub(super) struct Engagements {
    kind: CouplingKind,
    /// Engagement of the slave to which the newest of this half belongs.
    peer: u16,
    /// Count of the engagements of this half, which frames carry.
    pub(super) own: u16,
}

impl Engagements {
    pub(super) fn new(kind: CouplingKind) -> Self {
        Self { kind, peer: 0, own: 0 }
    }

    /// Return whether an engaged half goes on with the slave's engagement `peer`.
    pub(super) fn goes_on(self, peer: u16) -> bool {
        peer == self.peer
    }

    /// Begin an engagement with the slave's engagement `peer`; return false if that has ended. Energy of an engagement must
    /// not count twice.
    pub(super) fn begin(&mut self, peer: u16) -> bool {
        if self.kind.sends_energy() && peer == self.peer {
            return false;
        }
        (self.peer, self.own) = (peer, self.own.checked_add(1).unwrap_or(1));
        true
    }
}

/// Half of a coupling at the master, with its state since the engagement.
///
/// Both sides send motions since the engagement, in the master's frame: `p = x_m - x_m0` and the slave's `s`. The
/// master engages once the slave has, at `p = s'`, so that `F_v` is 0 at that tick.
#[derive(Clone, Copy, Debug)]
pub(crate) struct CoupledMaster<const N: usize> {
    half: Half<N>,
    /// The half before any tick.
    fresh: Half<N>,
    engagements: Engagements,
    /// Sequence of the frame at the last tick.
    sequence: u64,
    /// `lambda_p` of the scene.
    position_scale: f64,
    /// Position in m of the hand at which its motion is zero; None while not engaged.
    origin: Option<Axes<N>>,
    /// Position in m at the last tick.
    last: Axes<N>,
    /// Force in N of the last engaged tick, which fades with the ladder's gain.
    force: Axes<N>,
}

impl<const N: usize> CoupledMaster<N> {
    /// Build the half. None for position-force, whose force follows from the newest frame alone.
    pub(crate) fn new(settings: &MethodSettings) -> Option<Self> {
        let MethodSettings { kind, gains, position_scale, .. } = *settings;
        let half = Half::new(kind, gains, Space::Translation)?;
        let [last, force] = [Axes::zeros(); 2];
        let engagements = Engagements::new(kind);
        Some(Self { half, fresh: half, engagements, sequence: 0, position_scale, origin: None, last, force })
    }

    /// End the engagement, without force.
    pub(crate) fn clear(&mut self) {
        (self.origin, self.force) = (None, Axes::zeros());
    }

    /// Count of the engagements of this half.
    pub(crate) fn count(&self) -> u16 {
        self.engagements.own
    }

    /// Begin in place of another coupling, whose engagements count too: a slave takes only newer ones.
    pub(crate) fn begin_after(&mut self, count: u16) {
        self.clear();
        self.engagements.own = count;
    }

    /// Return `F_v` in N before the ladder's gain.
    ///
    /// The half is stepped while the sides are coupled. Otherwise the last force stays, and the gain fades it.
    #[inline(never)]
    pub(crate) fn request(
        &mut self,
        map: &Mapping<N>,
        hand: &HandMotion<'_, Axes<N>, N>,
        is_coupled: bool,
        (peer, newest_epoch): (&Frame, u16),
    ) -> Axes<N> {
        let CouplingMessage { epoch, ref vector, sums, .. } = peer.message;
        if !is_coupled {
            // The springs lose their energy.
            self.origin = None;
            return self.force;
        }
        if epoch == 0 || epoch != newest_epoch {
            // The gain may rise before the slave has engaged: no force of an earlier engagement may rise with it.
            self.clear();
            return self.force;
        }
        let HandMotion { at: position, velocity, exerted, grasp, gain, dt } = *hand;
        let sent: Axes<N> = unpadded(vector);
        let is_new = std::mem::replace(&mut self.sequence, peer.sequence) != peer.sequence;
        let sends_motion = peer.sends_motion();
        let of_slave = if sends_motion { sent } else { Axes::zeros() };
        let last = std::mem::replace(&mut self.last, *position);
        let origin = match self.origin {
            Some(origin) if self.engagements.goes_on(epoch) => origin,
            _ => {
                // Each engagement begins without force.
                self.origin = self.engagements.begin(epoch).then(|| position - of_slave);
                (self.half, self.force) = (self.fresh, Axes::zeros());
                return self.force;
            }
        };
        let frame = map.map();
        let to_slave = |of_master: &Axes<N>| frame.to_slave(of_master) * self.position_scale;
        let of_peer: Axes<N> = unpadded(&peer.velocity);
        let own = Local {
            position: &to_slave(&(position - origin)),
            velocity: &to_slave(velocity),
            moved: &to_slave(&(position - last)),
            exerted: &-map.coupled_force(exerted),
            force: &map.coupled_force(grasp),
            gain,
            dt,
        };
        let peer = Peer {
            position: &to_slave(&of_slave),
            velocity: &of_peer,
            force: &unpadded(&peer.force),
            vector: &if sends_motion { Axes::zeros() } else { sent },
            sum: sums[0],
            is_new,
            rests: false,
        };
        self.force = -map.rendered_force(&self.half.master(&own, &peer));
        self.force
    }

    /// Numbers for the next frame; zeros while not engaged.
    pub(crate) fn message(&self, is_coupled: bool, position: &Axes<N>) -> CouplingMessage {
        let Some(origin) = self.origin.filter(|_| is_coupled) else { return CouplingMessage::ZERO };
        let Engagements { kind, own: epoch, .. } = self.engagements;
        let (wave, energy_j) = self.half.sent();
        let vector = if kind.sends(Role::Master) == Some(Sends::Wave) { wave } else { position - origin };
        CouplingMessage { epoch, vector: padded(&vector), sums: [energy_j, 0.0], ..CouplingMessage::ZERO }
    }

    /// Energy in J that the half may still give; NaN for a half that counts none.
    pub(crate) fn left_j(&self) -> f64 {
        self.half.left_j()
    }
}
