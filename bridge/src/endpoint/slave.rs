//! The slave's endpoint: one tick of the side of the robot.

use haptether_safety::{Axes, Fault, Signal};

use super::{EndpointError, Exchange, check_period};
use crate::{
    command::OperatorCommand,
    coupling::{CommandBounds, CouplingError, FrameMap, Limited, PositionForce, bounded, decayed},
    ladder::{LadderSettings, LadderState, Observed},
    link::PortState,
    wire::Role,
};

/// How a slave endpoint is built.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SlaveSettings {
    /// Period of the loop in ns.
    pub period_ns: u64,
    /// Drawn anew at every start.
    pub run_id: u64,
    /// `lambda_p`, of the position-force coupling.
    pub position_scale: f64,
    /// What it takes of a remote command.
    pub bounds: CommandBounds,
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
    /// Which bounds acted on the command.
    pub limited: Limited,
    /// Why it stands in FAULT.
    pub fault: Option<Fault>,
}

/// The slave's side as a state machine: `(sample, frames, time) -> (command, frame)`.
#[derive(Clone, Debug)]
pub struct SlaveEndpoint<const N: usize> {
    coupling: PositionForce<N>,
    /// What talks to the peer.
    pub exchange: Exchange<N>,
    bounds: CommandBounds,
    /// Where the slave stood at its first tick.
    home: Option<Axes<N>>,
    command: Option<Axes<N>>,
    /// When the last command was made, in ns.
    commanded_ns: u64,
    fault: Option<Fault>,
}

impl<const N: usize> SlaveEndpoint<N> {
    /// An endpoint that waits for its peer.
    pub fn new(settings: &SlaveSettings) -> Result<Self, EndpointError> {
        check_period(settings.period_ns)?;
        settings.bounds.check()?;
        Ok(Self {
            coupling: PositionForce::new(settings.position_scale, 1.0)?,
            exchange: Exchange::new(Role::Slave, settings.run_id, settings.period_ns, settings.ladder)?,
            bounds: settings.bounds,
            home: None,
            command: None,
            commanded_ns: 0,
            fault: None,
        })
    }

    /// One tick: tool position in m and velocity in m/s, `F_e` in N.
    pub fn tick(
        &mut self,
        now_ns: u64,
        position: &Axes<N>,
        velocity: &Axes<N>,
        environment_force: &Axes<N>,
    ) -> SlaveTick<N> {
        if self.exchange.events.peer_began {
            self.coupling.disengage();
        }
        let checked = if self.exchange.events.device_failed { Err(Fault::Device) } else { Ok(()) }
            .and_then(|()| Signal::Position.check(position))
            .and_then(|()| Signal::Velocity.check(velocity))
            .and_then(|()| Signal::EnvironmentForce.check(environment_force));
        if let Err(fault) = checked {
            self.fault.get_or_insert(fault);
            self.exchange.fault(now_ns, fault);
        }
        let (state, age_ns) = self.exchange.advance(now_ns, false);
        let home = *self.home.get_or_insert(*position);
        let mut command_velocity = Axes::zeros();
        let mut limited = Limited::default();
        let elapsed_s = now_ns.saturating_sub(self.commanded_ns) as f64 * 1e-9;
        match (state, self.exchange.link().newest()) {
            (LadderState::Engaged | LadderState::Stale, Some(frame)) => {
                // From the last command, not from where contact has bent the arm to.
                let from = self.command.unwrap_or(*position);
                let decay_ns = self.exchange.ladder.settings().extrapolate_ns;
                let (ahead_s, share) = decayed(self.exchange.ladder.stale_ns(), decay_ns);
                let velocity = self.coupling.commanded_velocity(&frame.velocity);
                // Where the two are taken to be coupled anew while frames are late, it has gone ahead already.
                let ahead = velocity * ahead_s;
                let wanted = self.coupling.commanded_position(&frame.position, &(from - ahead)) + ahead;
                let (command, over) = bounded(&self.bounds, elapsed_s, &home, &from, &wanted);
                limited = over;
                command_velocity = velocity * share;
                let speed = command_velocity.norm();
                if speed > self.bounds.speed {
                    command_velocity *= self.bounds.speed / speed;
                    limited.speed = true;
                }
                self.command = Some(command);
            }
            // Holds the last command; when it engages again it does so from where both are then.
            _ => self.coupling.disengage(),
        }
        self.commanded_ns = now_ns;
        self.exchange.limited_ticks += u64::from(limited.any());
        if self.fault.is_none() {
            let energy = &mut self.exchange.outgoing.energy;
            energy.add(environment_force.dot(&command_velocity), elapsed_s);
            let energy = *energy;
            let [position, velocity, force] = [*position, *velocity, *environment_force];
            let gripper = self.exchange.outgoing.gripper;
            self.exchange.outgoing = PortState { position, velocity, force, energy, gripper };
        } else {
            self.exchange.outgoing.force = Axes::zeros();
        }
        let command = self.command.unwrap_or(*position);
        self.exchange.end_tick(now_ns, [position, &command, environment_force], Observed::NOTHING);
        SlaveTick { command: self.command, command_velocity, state, age_ns, limited, fault: self.fault }
    }

    /// The arm no longer follows and comes to rest at `rest` in m: when the two engage again, it goes on from there.
    pub fn rests(&mut self, rest: &Axes<N>) {
        // Where it does not know where it is, nothing is commanded until the two engage anew.
        self.command = self.command.and(Signal::Position.check(rest).is_ok().then_some(*rest));
    }

    /// Carries out a command of the operator; returns whether it changed anything. The slave goes on from where it is.
    pub fn command(&mut self, now_ns: u64, command: OperatorCommand) -> Result<bool, CouplingError> {
        match command {
            OperatorCommand::Acknowledge => {
                self.fault = None;
                self.exchange.acknowledge(now_ns);
            }
            OperatorCommand::PositionScale(scale) => self.coupling.set_position_scale(scale)?,
            OperatorCommand::Frame { quat_wxyz, locked } => {
                self.coupling.set_map(FrameMap::rotated(quat_wxyz, &locked)?);
            }
            _ => return Ok(false),
        }
        Ok(true)
    }

    /// The last commanded position in m; none before the first engagement.
    pub fn last_command(&self) -> Option<Axes<N>> {
        self.command
    }
}
