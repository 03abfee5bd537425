//! The slave's endpoint: one tick of the side of the robot.

use haptether_safety::{Axes, Fault, Signal};

use super::{EndpointError, Exchange, check_period};
use crate::{
    coupling::PositionForce,
    ladder::{LadderSettings, LadderState},
    link::Refusal,
    wire::Role,
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
    /// Velocity in m/s of that position; zero unless engaged.
    pub command_velocity: Axes<N>,
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
    exchange: Exchange<N>,
    command: Option<Axes<N>>,
    fault: Option<Fault>,
}

impl<const N: usize> SlaveEndpoint<N> {
    /// An endpoint that waits for its peer.
    pub fn new(settings: &SlaveSettings) -> Result<Self, EndpointError> {
        check_period(settings.period_ns)?;
        Ok(Self {
            coupling: PositionForce::new(settings.position_scale, 1.0)?,
            exchange: Exchange::new(Role::Slave, settings.session, settings.ladder),
            command: None,
            fault: None,
        })
    }

    /// Takes a datagram that arrived by `now_ns`.
    pub fn receive(&mut self, now_ns: u64, datagram: &[u8]) -> Result<(), Refusal> {
        if self.exchange.receive(now_ns, datagram)? {
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
            .and_then(|()| Signal::EnvironmentForce.check(environment_force));
        if let Err(fault) = door {
            self.fault.get_or_insert(fault);
            self.exchange.ladder.fault();
        }
        let (state, age_ns) = self.exchange.advance(now_ns);
        let mut command_velocity = Axes::zeros();
        match (state, self.exchange.newest()) {
            (LadderState::Engaged, Some(frame)) => {
                // From the last command, not from where contact has bent the arm to.
                let from = self.command.unwrap_or(*position);
                self.command = Some(self.coupling.commanded_position(&frame.position, &from));
                command_velocity = self.coupling.commanded_velocity(&frame.velocity);
            }
            // Holds the last command; when it engages again it does so from where both are then.
            _ => self.coupling.disengage(),
        }
        if self.fault.is_none() {
            self.exchange.outgoing = [*position, *velocity, *environment_force];
        } else {
            self.exchange.outgoing[2] = Axes::zeros();
        }
        SlaveTick { command: self.command, command_velocity, state, age_ns, fault: self.fault }
    }

    /// The loop was late by more than the ladder allows, until `now_ns`.
    pub fn stalled(&mut self, now_ns: u64) {
        self.exchange.stalled(now_ns);
    }

    /// What talks to the peer.
    pub fn exchange(&self) -> &Exchange<N> {
        &self.exchange
    }

    /// What talks to the peer.
    pub fn exchange_mut(&mut self) -> &mut Exchange<N> {
        &mut self.exchange
    }
}
