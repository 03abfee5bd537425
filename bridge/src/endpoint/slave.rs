//! The slave's endpoint: one tick of the side of the robot.

use haptether_safety::{Axes, Fault, Signal};

use super::{EndpointError, check_period, is_ready};
use crate::{
    coupling::PositionForce,
    ladder::{Ladder, LadderSettings, LadderState},
    link::{FrameLink, LinkStatistics, Refusal},
    wire::{MAX_FRAME, Role},
};

/// How a slave endpoint is built.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SlaveSettings {
    /// Period of the loop in ns.
    pub period_ns: u64,
    /// Drawn anew at every start.
    pub session: u64,
    /// `lambda_p`, of the position-force coupling.
    pub position_scale: f64,
    /// Times of the ladder.
    pub ladder: LadderSettings,
}

/// What one tick of the slave did.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SlaveTick<const N: usize> {
    /// Position in m that the arm is to take; none before the first engagement.
    pub command: Option<Axes<N>>,
    /// Where the ladder stands.
    pub state: LadderState,
    /// Silence of the peer in ns.
    pub age_ns: Option<u64>,
    /// Why it stands in FAULT.
    pub fault: Option<Fault>,
}

/// The slave's side as a state machine: `(sample, frames, time) -> (command, frame)`.
#[derive(Clone, Debug)]
pub struct SlaveEndpoint<const N: usize> {
    coupling: PositionForce<N>,
    ladder: Ladder,
    link: FrameLink<N>,
    command: Option<Axes<N>>,
    fault: Option<Fault>,
    outgoing: [Axes<N>; 3],
}

impl<const N: usize> SlaveEndpoint<N> {
    /// An endpoint that waits for its peer.
    pub fn new(settings: &SlaveSettings) -> Result<Self, EndpointError> {
        check_period(settings.period_ns)?;
        Ok(Self {
            coupling: PositionForce::new(settings.position_scale, 1.0)?,
            ladder: Ladder::new(settings.ladder),
            link: FrameLink::new(Role::Slave, settings.session, settings.ladder.stop_after_ns),
            command: None,
            fault: None,
            outgoing: [Axes::zeros(); 3],
        })
    }

    /// Takes a datagram that arrived by `now_ns`.
    pub fn receive(&mut self, now_ns: u64, datagram: &[u8]) -> Result<(), Refusal> {
        if self.link.receive(now_ns, datagram)? {
            self.ladder.new_session();
            self.coupling.disengage();
        }
        Ok(())
    }

    /// One tick: tool position in m and velocity in m/s, `F_e` in N.
    pub fn tick(
        &mut self,
        now_ns: u64,
        position: &Axes<N>,
        velocity: &Axes<N>,
        environment_force: &Axes<N>,
    ) -> SlaveTick<N> {
        let door = Signal::Position
            .check(position)
            .and_then(|()| Signal::Velocity.check(velocity))
            .and_then(|()| Signal::RenderedForce.check(environment_force));
        if let Err(fault) = door {
            self.fault.get_or_insert(fault);
            self.ladder.fault();
        }
        let age_ns = self.link.age_ns(now_ns);
        let ready = self.link.newest().is_some_and(is_ready);
        let state = self.ladder.step(now_ns, age_ns, ready);
        match (state, self.link.newest()) {
            (LadderState::Engaged, Some(frame)) => {
                self.command = Some(self.coupling.commanded_position(&frame.position, position));
            }
            // Holds the last command; when it engages again it does so from where both are then.
            _ => self.coupling.disengage(),
        }
        if self.fault.is_none() {
            self.outgoing = [*position, *velocity, *environment_force];
        } else {
            self.outgoing[2] = Axes::zeros();
        }
        SlaveTick { command: self.command, state, age_ns, fault: self.fault }
    }

    /// Writes the frame of this tick.
    pub fn send<'a>(&mut self, now_ns: u64, buffer: &'a mut [u8; MAX_FRAME]) -> &'a [u8] {
        let status = (self.ladder.state().code(), self.ladder.hears_peer());
        self.link.send(now_ns, status, self.outgoing, buffer)
    }

    /// The loop was late by more than the ladder allows.
    pub fn stalled(&mut self) {
        self.ladder.stalled();
    }

    /// Where the ladder stands.
    pub fn state(&self) -> LadderState {
        self.ladder.state()
    }

    /// How often the ladder went to HOLD.
    pub fn holds(&self) -> u64 {
        self.ladder.holds()
    }

    /// Counts of the link.
    pub fn link(&self) -> LinkStatistics {
        self.link.statistics()
    }
}
