//! The slave's endpoint: one tick of the side of the robot.

use haptether_safety::{Axes, Fault, Signal};

use super::{EndpointError, Exchange, check_period};
use crate::{
    coupling::{CommandBounds, CouplingError, FrameMap, Limited, PositionForce, bounded, decayed},
    fault_text::FaultText,
    ladder::{LadderSettings, LadderState, Observed},
    link::{PortState, RejectReason},
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
    exchange: Exchange<N>,
    bounds: CommandBounds,
    /// Where the slave stood at its first tick.
    home: Option<Axes<N>>,
    command: Option<Axes<N>>,
    /// When the last command was made, in ns.
    commanded_ns: u64,
    limited_ticks: u64,
    fault: Option<Fault>,
    /// The arm has failed since the last tick.
    has_failed: bool,
}

impl<const N: usize> SlaveEndpoint<N> {
    /// An endpoint that waits for its peer.
    pub fn new(settings: &SlaveSettings) -> Result<Self, EndpointError> {
        check_period(settings.period_ns)?;
        settings.bounds.check()?;
        Ok(Self {
            coupling: PositionForce::new(settings.position_scale, 1.0)?,
            exchange: Exchange::new(Role::Slave, settings.session, settings.period_ns, settings.ladder)?,
            bounds: settings.bounds,
            home: None,
            command: None,
            commanded_ns: 0,
            limited_ticks: 0,
            fault: None,
            has_failed: false,
        })
    }

    /// Until the next call it is `late_ns` later than the tick's time when datagrams are received and sent.
    pub fn late(&mut self, late_ns: u64) {
        self.exchange.late(late_ns);
    }

    /// Takes a datagram that arrived by `now_ns`.
    pub fn receive(&mut self, now_ns: u64, datagram: &[u8]) -> Result<(), RejectReason> {
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
        let has_failed = std::mem::take(&mut self.has_failed);
        let door = if has_failed { Err(Fault::Device) } else { Ok(()) }
            .and_then(|()| Signal::Position.check(position))
            .and_then(|()| Signal::Velocity.check(velocity))
            .and_then(|()| Signal::EnvironmentForce.check(environment_force));
        if let Err(fault) = door {
            self.fault.get_or_insert(fault);
            self.exchange.fault(now_ns, fault);
        }
        let (state, age_ns) = self.exchange.advance(now_ns, false);
        let home = *self.home.get_or_insert(*position);
        let mut command_velocity = Axes::zeros();
        let mut limited = Limited::default();
        let elapsed_s = now_ns.saturating_sub(self.commanded_ns) as f64 * 1e-9;
        match (state, self.exchange.newest()) {
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
        self.limited_ticks += u64::from(limited.any());
        if self.fault.is_none() {
            let energy = &mut self.exchange.outgoing.energy;
            energy.add(environment_force.dot(&command_velocity), elapsed_s);
            let energy = *energy;
            let [position, velocity, force] = [*position, *velocity, *environment_force];
            self.exchange.outgoing = PortState { position, velocity, force, energy };
        } else {
            self.exchange.outgoing.force = Axes::zeros();
        }
        let command = self.command.unwrap_or(*position);
        self.exchange.keep(now_ns, [position, &command, environment_force], Observed::NOTHING);
        SlaveTick { command: self.command, command_velocity, state, age_ns, limited, fault: self.fault }
    }

    /// The loop was late by more than the ladder allows, until `now_ns`.
    pub fn stalled(&mut self, now_ns: u64) {
        self.exchange.stalled(now_ns);
    }

    /// The arm has failed, or says so: no motion from the next tick on, and the peer is told.
    ///
    /// It counts as a bad number in that tick's sample does, so that no act before the tick undoes it.
    pub fn device_failed(&mut self) {
        self.has_failed = true;
    }

    /// The arm no longer follows and comes to rest at `rest` in m: when the two engage again, it goes on from there.
    pub fn rests(&mut self, rest: &Axes<N>) {
        // Where it does not know where it is, nothing is commanded until the two engage anew.
        self.command = self.command.and(Signal::Position.check(rest).is_ok().then_some(*rest));
    }

    /// The driver's words on its failure, of the next tick; see [`Self::device_failed`].
    pub fn describe_failure(&mut self, text: &FaultText) {
        self.exchange.describe_failure(text);
    }

    /// This side ends: from here on its frames say so.
    pub fn end(&mut self) {
        self.exchange.end();
    }

    /// The peer has ended its session.
    pub fn peer_ended(&mut self) {
        self.exchange.peer_ended();
    }

    /// A person at this side says that its fault is mended; the master's clutch must then be released and pressed.
    pub fn acknowledge(&mut self, now_ns: u64) {
        self.fault = None;
        self.exchange.acknowledge(now_ns);
    }

    /// Changes `lambda_p`; the slave goes on from where it is.
    pub fn set_position_scale(&mut self, scale: f64) -> Result<(), CouplingError> {
        self.coupling.set_position_scale(scale)
    }

    /// Changes rotation and locks, which must be those of the master; the slave goes on from where it is.
    pub fn set_map(&mut self, map: FrameMap<N>) {
        self.coupling.set_map(map);
    }

    /// The last command in m; none before the first engagement.
    pub fn command(&self) -> Option<Axes<N>> {
        self.command
    }

    /// Ticks at which a bound acted on the command.
    pub fn limited_ticks(&self) -> u64 {
        self.limited_ticks
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
