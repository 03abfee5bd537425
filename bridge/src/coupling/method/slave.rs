//! Half of a coupling at the slave, between the frame map and the bounds on the command.

use haptether_safety::Axes;

use super::{ForceArm, Half, Local, MethodSettings, Peer, Room, Sends, Space, VirtualTool};
use crate::{
    coupling::{CouplingKind, Mapping},
    port::CouplingMessage,
    wire::{Padded, Role, unpadded},
};

/// Time in s without a new frame over which a half that keeps a ledger goes on in STALE, and a force of the hand stays.
pub(super) const GAP_S: f64 = 0.01;

/// Engagement of the master, as the half at the slave sees it.
#[derive(Clone, Copy, Debug)]
pub(super) struct MasterEngagement {
    kind: CouplingKind,
    /// Newest count of the master's engagements when this one of the slave began, or 0.
    stale: u16,
    /// Engagement of the master that belongs to this one of the slave; 0 before it begins.
    present: u16,
}

impl MasterEngagement {
    pub(super) fn new(kind: CouplingKind) -> Self {
        Self { kind, stale: 0, present: 0 }
    }

    /// Begin an engagement of the slave; `epoch` is the newest of the master in any frame.
    pub(super) fn begin(&mut self, epoch: u16) {
        (self.stale, self.present) = (epoch, 0);
    }

    /// Return whether a frame with `epoch` belongs to this engagement. If frames carry energies, only one engagement of the
    /// master does.
    pub(super) fn takes(&mut self, epoch: u16) -> bool {
        if !self.kind.sends_energy() || epoch == 0 {
            return epoch != 0;
        }
        if self.present == 0 && epoch.wrapping_sub(self.stale).cast_signed() > 0 {
            self.present = epoch;
        }
        epoch == self.present
    }
}

/// State of the master in a frame.
#[derive(Clone, Copy, Debug)]
pub(crate) struct OfMaster<'a, X, const N: usize> {
    /// Position in m, or orientation.
    pub(crate) at: &'a X,
    /// Velocity in m/s (rad/s).
    pub(crate) velocity: &'a Axes<N>,
    /// Force in N (N m) in the frame: `F_h` in the slave's frame if the coupling sends it.
    pub(crate) force: &'a Axes<N>,
    /// The rest of the frame.
    pub(crate) half: OfHalf<'a>,
}

/// Half of the master in a frame.
#[derive(Clone, Copy, Debug)]
pub(crate) struct OfHalf<'a> {
    /// Its numbers.
    pub(crate) message: &'a CouplingMessage,
    /// Force of the frame in N.
    pub(crate) force: &'a Padded,
    /// Its newest epoch in any frame.
    pub(crate) epoch: u16,
    /// Sequence of the frame.
    pub(crate) sequence: u64,
    /// True while the newest frame is old.
    pub(crate) is_stale: bool,
}

impl OfHalf<'_> {
    /// Half that has not been heard.
    pub(crate) const NONE: Self = Self {
        message: &CouplingMessage::ZERO,
        force: &CouplingMessage::ZERO.vector,
        epoch: 0,
        sequence: 0,
        is_stale: false,
    };
}

/// Half of a coupling at the slave, with its state since the engagement.
///
/// The command of the arm is the position of a [`VirtualTool`], on which `F_c` and `F_e` act. The half sees the tool as
/// the slave. An arm that takes forces is its own tool.
#[derive(Clone, Copy, Debug)]
pub(crate) struct CoupledSlave<const N: usize> {
    half: Half<N>,
    /// The half before any tick.
    fresh: Half<N>,
    kind: CouplingKind,
    tool: VirtualTool<N>,
    /// Arm that takes forces; None for one that takes motions.
    arm: Option<ForceArm>,
    /// True while engaged.
    engaged: bool,
    master: MasterEngagement,
    /// Sequence of the frame at the last tick, and the time in s since it changed.
    sequence: u64,
    silent_s: f64,
    /// Position in m of the master at which its motion is zero, if it sends waves.
    origin: Option<Axes<N>>,
    /// Motion in m of the master in its last engaged frame.
    moved: Axes<N>,
    /// Integral of a wave, and energy in J, in that frame.
    wave: Axes<N>,
    energy_j: f64,
    /// Numbers for the next frame.
    sent: Axes<N>,
    /// `F_c` in N since the last tick, and the position in m of the tool before it.
    force: Axes<N>,
    before: Axes<N>,
    /// Work in J of `F_c` on a virtual tool at the last tick.
    work_j: f64,
    /// Bounds on speed and reach that acted on `F_c`.
    limited: [bool; 2],
}

impl<const N: usize> CoupledSlave<N> {
    /// Build the half. None for position-force, which commands the motion of the master itself.
    pub(crate) fn new(settings: &MethodSettings) -> Option<Self> {
        let MethodSettings { kind, gains, tool, forces, .. } = *settings;
        let half = Half::new(kind, gains, Space::Translation)?;
        let tool = VirtualTool::new(tool);
        let [moved, wave, sent, force, before] = [Axes::zeros(); 5];
        let (engaged, master) = (false, MasterEngagement::new(kind));
        let (origin, energy_j, fresh) = (None, 0.0, half);
        Some(Self {
            half,
            fresh,
            kind,
            tool,
            arm: forces.map(|[arm, _]| arm),
            engaged,
            master,
            sequence: 0,
            silent_s: 0.0,
            origin,
            moved,
            wave,
            energy_j,
            sent,
            force,
            before,
            work_j: 0.0,
            limited: [false; 2],
        })
    }

    /// True if `F_c` moves the arm itself.
    pub(crate) fn takes_force(&self) -> bool {
        self.arm.is_some()
    }

    /// Return the work in J of `F_c` since the last tick, for an engaged arm that takes forces at `position` in m; else 0.
    pub(crate) fn worked_j(&self, position: &Axes<N>) -> f64 {
        if self.engaged && self.takes_force() { self.force.dot(&(position - self.before)) } else { 0.0 }
    }

    /// Step an engaged tick of `dt` s at the command `from` in m; return the command that the coupling requests, in m. For
    /// an arm that takes forces, `from` is its position and stays the command.
    #[inline(never)]
    pub(crate) fn step(
        &mut self,
        map: &mut Mapping<N>,
        from: &Axes<N>,
        (room, environment_force): (&Room<'_, N>, &Axes<N>),
        master: &OfMaster<'_, Axes<N>, N>,
        dt: f64,
    ) -> Axes<N> {
        let OfMaster { at, velocity: of_master, force, half } = *master;
        let OfHalf { message, epoch, sequence, is_stale, .. } = half;
        (self.work_j, self.limited) = (0.0, [false; 2]);
        if !self.engaged {
            // Each engagement begins at rest and without force: the anchor couples this position with zero motion.
            self.tool.rest_at(from);
            map.disengage();
            map.commanded_position(&Axes::zeros(), from);
            [self.moved, self.wave, self.sent, self.force] = [Axes::zeros(); 4];
            (self.half, self.origin, self.energy_j) = (self.fresh, None, 0.0);
            self.master.begin(epoch);
            (self.engaged, self.before) = (true, *from);
            return *from;
        }
        // A master that is not engaged rests where it was, at first at zero.
        let is_engaged = self.master.takes(message.epoch);
        let sends_wave = self.kind.sends(Role::Master) == Some(Sends::Wave);
        let is_new = std::mem::replace(&mut self.sequence, sequence) != sequence;
        if is_engaged {
            let numbers = unpadded(&message.vector);
            if sends_wave {
                self.moved = at - *self.origin.get_or_insert(*at);
                self.wave = numbers;
            } else {
                self.moved = numbers;
            }
            self.energy_j = self.energy_j.max(message.sums[0]);
        }
        // A half that keeps a ledger does not extrapolate beyond a short gap.
        self.silent_s = if is_new { 0.0 } else { self.silent_s + dt };
        let is_silent = is_stale && self.silent_s > GAP_S;
        let moves = is_engaged && !(is_silent && self.kind.sends_energy());
        let of_master = if moves { map.commanded_velocity(of_master) } else { Axes::zeros() };
        let target = map.commanded_position(&self.moved, from);
        if self.takes_force() {
            self.tool.measured([from, room.velocity]);
        }
        let own = Local {
            position: self.tool.position(),
            velocity: self.tool.velocity(),
            moved: &(self.tool.position() - self.before),
            exerted: &self.force,
            force: environment_force,
            gain: 1.0,
            dt,
        };
        let peer = Peer {
            position: &target,
            velocity: &of_master,
            force: &if is_engaged && !is_silent { *force } else { Axes::zeros() },
            vector: &self.wave,
            sum: self.energy_j,
            is_new,
            rests: !moves,
        };
        self.force = self.half.slave(&own, &peer);
        if let Some(arm) = &self.arm {
            (self.force, self.limited) = arm.bounded(&self.force, room);
        }
        self.sent = match self.kind.sends(Role::Slave) {
            Some(Sends::Motion) => self.moved + map.back(&(self.tool.position() - target)),
            Some(Sends::Force) => self.force,
            Some(Sends::Wave) | None => self.half.sent().0,
        };
        self.before = *self.tool.position();
        if self.takes_force() {
            return *from;
        }
        let command = self.tool.step(&self.force, environment_force, dt);
        self.work_j = self.force.dot(&(self.tool.position() - self.before));
        command
    }

    /// `F_c` in N, and whether the bounds on speed and reach acted. None unless the arm takes forces.
    pub(crate) fn exerted(&self) -> Option<(&Axes<N>, [bool; 2])> {
        self.arm.map(|_| (&self.force, self.limited))
    }

    /// The tool, for the bounds on its command.
    pub(crate) fn tool(&mut self) -> &mut VirtualTool<N> {
        &mut self.tool
    }

    /// Work in J of `F_c` on a virtual tool over the tick that begins; 0 for an arm that takes forces.
    pub(crate) fn work_j(&self) -> f64 {
        self.work_j
    }

    /// Numbers and energy in J for the next frame; None while not engaged.
    pub(crate) fn sent(&self) -> Option<(&Axes<N>, f64)> {
        self.engaged.then(|| (&self.sent, self.half.sent().1))
    }

    /// End the engagement; the springs lose their energy.
    pub(crate) fn disengage(&mut self) {
        self.engaged = false;
    }

    /// Energy in J that the half may still give; NaN for a half that counts none.
    pub(crate) fn left_j(&self) -> f64 {
        self.half.left_j()
    }
}
