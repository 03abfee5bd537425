//! Half of a coupling at the slave, between the frame map and the bounds on the command.

use haptether_safety::Axes;

use super::{Half, Local, MethodSettings, Peer, SlaveSends, VirtualTool};
use crate::{coupling::Mapping, port::CouplingMessage, wire::unpadded};

/// Half of a coupling at the slave, with its state since the engagement.
///
/// The command of the arm is the position of a [`VirtualTool`], on which `F_c` and `F_e` act. The half sees the tool as
/// the slave.
#[derive(Clone, Copy, Debug)]
pub(crate) struct CoupledSlave<const N: usize> {
    half: Half,
    sends: SlaveSends,
    tool: VirtualTool<N>,
    /// True while engaged.
    engaged: bool,
    /// Motion in m of the master in its last engaged frame.
    moved: Axes<N>,
    /// Numbers for the next frame.
    sent: Axes<N>,
    /// `F_c` in N since the last tick, and the position in m of the tool before it.
    force: Axes<N>,
    before: Axes<N>,
}

impl<const N: usize> CoupledSlave<N> {
    /// Build the half. None for position-force, which commands the motion of the master itself.
    pub(crate) fn new(settings: &MethodSettings) -> Option<Self> {
        let MethodSettings { kind, gains, tool, .. } = *settings;
        let (half, sends) = (Half::new::<N>(kind, gains)?, kind.slave_sends()?);
        let tool = VirtualTool::new(tool);
        let [moved, sent, force, before] = [Axes::zeros(); 4];
        Some(Self { half, sends, tool, engaged: false, moved, sent, force, before })
    }

    /// Step an engaged tick of `dt` s at the command `from` in m; return the command that the coupling requests, in m.
    #[inline(never)]
    pub(crate) fn step(
        &mut self,
        map: &mut Mapping<N>,
        from: &Axes<N>,
        environment_force: &Axes<N>,
        peer: (&CouplingMessage, &Axes<N>),
        dt: f64,
    ) -> Axes<N> {
        if !self.engaged {
            // Each engagement begins at rest and without force: the anchor couples this position with zero motion.
            self.tool.rest_at(from);
            map.disengage();
            map.commanded_position(&Axes::zeros(), from);
            [self.moved, self.sent, self.force] = [Axes::zeros(); 3];
            (self.engaged, self.before) = (true, *from);
            return *from;
        }
        let (message, velocity) = peer;
        // A master that is not engaged rests where it was, at first at zero.
        let is_engaged = message.epoch != 0;
        if is_engaged {
            self.moved = unpadded(&message.vector);
        }
        let velocity = if is_engaged { map.commanded_velocity(velocity) } else { Axes::zeros() };
        let target = map.commanded_position(&self.moved, from);
        let own = Local { position: self.tool.position(), velocity: self.tool.velocity(), gain: 1.0 };
        let peer = Peer { position: &target, velocity: &velocity, force: &Axes::zeros() };
        self.force = self.half.slave(&own, &peer);
        self.sent = match self.sends {
            SlaveSends::Motion => self.moved + map.back(&(self.tool.position() - target)),
            SlaveSends::Force => self.force,
        };
        self.before = *self.tool.position();
        self.tool.step(&self.force, environment_force, dt)
    }

    /// The tool, for the bounds on its command.
    pub(crate) fn tool(&mut self) -> &mut VirtualTool<N> {
        &mut self.tool
    }

    /// Work in J of `F_c` on the tool at the last tick.
    pub(crate) fn work_j(&self) -> f64 {
        self.force.dot(&(self.tool.position() - self.before))
    }

    /// Numbers for the next frame; None while not engaged.
    pub(crate) fn sent(&self) -> Option<&Axes<N>> {
        self.engaged.then_some(&self.sent)
    }

    /// End the engagement; the springs lose their energy.
    pub(crate) fn disengage(&mut self) {
        self.engaged = false;
    }
}
