//! The slave's endpoint: one tick of the side of the robot.

use haptether_safety::{Axes, Fault, Signal, norm};

use nalgebra::UnitQuaternion;

use super::{
    EndpointError, Exchange, check_period, period_s,
    rotation::{SlaveRotation, SlaveRotationSettings, check_orientation},
};
use crate::{
    SideKind,
    command::OperatorCommand,
    coupling::{
        AlignmentStep, CommandBounds, CouplingError, FrameMap, Limited, PositionForce, RotationState,
        bounded, decayed,
    },
    ladder::{AlignmentState, LAYERS, LadderSettings, LadderState, Observed},
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

/// What an arm measures at one tick.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SlaveReading<const N: usize> {
    /// Of the tool, in m.
    pub position: Axes<N>,
    /// In m/s.
    pub velocity: Axes<N>,
    /// `F_e` in N.
    pub environment_force: Axes<N>,
    /// Of an arm that turns; about the tool point, in its base frame.
    pub rotation: Option<RotationState>,
}

impl<const N: usize> SlaveReading<N> {
    /// Of a point: position in m, velocity in m/s, `F_e` in N.
    pub fn point([position, velocity, environment_force]: [Axes<N>; 3]) -> Self {
        Self { position, velocity, environment_force, rotation: None }
    }
}

/// What one tick of the slave did.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SlaveTick<const N: usize> {
    /// Position in m that the arm is to take; none before the first engagement.
    pub command: Option<Axes<N>>,
    /// Velocity in m/s of that position; zero unless engaged.
    pub command_velocity: Axes<N>,
    /// Orientation that the tool is to take; none of a point, and before the first engagement.
    pub orientation: Option<UnitQuaternion<f64>>,
    /// Angular velocity in rad/s of that orientation; zero unless engaged or turned to the master.
    pub angular_velocity: Axes<3>,
    /// Whether the arm is led: engaged, or before that turned to the master.
    pub is_led: bool,
    /// Where the ladder stands.
    pub state: LadderState,
    /// Silence of the peer in ns.
    pub age_ns: Option<u64>,
    /// Which bounds acted on the command.
    pub limited: Limited,
    /// Why it stands in FAULT.
    pub fault: Option<Fault>,
}

/// Takes force and torque out of what the next frame says.
fn without_wrench<const N: usize>(outgoing: &mut PortState<N>) {
    outgoing.force = Axes::zeros();
    if let Some(rotation) = &mut outgoing.rotation {
        rotation.torque = Axes::zeros();
    }
}

/// The slave's side as a state machine: `(sample, frames, time) -> (command, frame)`.
#[derive(Clone, Debug)]
pub struct SlaveEndpoint<const N: usize> {
    coupling: PositionForce<N>,
    /// Of an arm that turns.
    rotation: Option<Box<SlaveRotation>>,
    /// What talks to the peer.
    pub exchange: Exchange<N>,
    bounds: CommandBounds,
    /// Speed in m/s with which the arm still brakes besides.
    braking: f64,
    /// Where the slave stood at its first tick.
    home: Option<Axes<N>>,
    command: Option<Axes<N>>,
    /// When the last command was made, in ns.
    commanded_ns: u64,
    fault: Option<Fault>,
    /// When in ns the arm was where, at the last sample that can be.
    last: Option<(u64, Axes<N>, Option<UnitQuaternion<f64>>)>,
    /// The period of its loop, in s.
    period_s: f64,
    /// The longest time in s that one step of an alignment makes up for: two periods.
    max_step_s: f64,
}

impl<const N: usize> SlaveEndpoint<N> {
    /// An endpoint that waits for its peer.
    pub fn new(settings: &SlaveSettings) -> Result<Self, EndpointError> {
        check_period(settings.period_ns)?;
        settings.bounds.check()?;
        Ok(Self {
            coupling: PositionForce::new(settings.position_scale, 1.0)?,
            rotation: None,
            exchange: Exchange::new(Role::Slave, settings.run_id, settings.period_ns, settings.ladder)?,
            bounds: settings.bounds,
            braking: 0.0,
            home: None,
            command: None,
            commanded_ns: 0,
            fault: None,
            last: None,
            period_s: period_s(settings.period_ns),
            max_step_s: 2.0 * period_s(settings.period_ns),
        })
    }

    /// The same of a pose, with `rotation` and three axes.
    pub fn of_pose(
        settings: &SlaveSettings,
        rotation: &SlaveRotationSettings,
    ) -> Result<Self, EndpointError> {
        let mut endpoint = Self::new(settings)?;
        let align_s = period_s(settings.ladder.align_ns);
        endpoint.rotation = Some(Box::new(SlaveRotation::new(rotation, align_s)?));
        endpoint.exchange.set_kind(SideKind::Pose);
        Ok(endpoint)
    }

    /// The arm still brakes with `speed` in m/s and `angular_speed` in rad/s: the bounds on both leave that much less for
    /// commands, until this is said anew.
    pub fn set_braking(&mut self, [speed, angular_speed]: [f64; 2]) {
        self.braking = speed;
        if let Some(rotation) = &mut self.rotation {
            rotation.set_braking(angular_speed);
        }
    }

    /// One tick of what the arm measures.
    pub fn tick(&mut self, now_ns: u64, reading: &SlaveReading<N>) -> SlaveTick<N> {
        let SlaveReading { position, velocity, environment_force, .. } = reading;
        if self.exchange.events.peer_began {
            self.disengage();
        }
        let checked = if self.exchange.events.device_failed { Err(Fault::Device) } else { Ok(()) }
            .and_then(|()| Signal::Position.check(position))
            .and_then(|()| Signal::Velocity.check(velocity))
            .and_then(|()| Signal::EnvironmentForce.check(environment_force))
            .and_then(|()| match &self.rotation {
                None => Ok(()),
                Some(_) => SlaveRotation::check(reading.rotation.as_ref()),
            })
            .and_then(|()| self.check_jump(now_ns, reading));
        if let Err(fault) = checked {
            self.fault.get_or_insert(fault);
            self.exchange.fault(now_ns, fault);
        }
        let elapsed_s = now_ns.saturating_sub(self.commanded_ns) as f64 * 1e-9;
        if let (Some(rotation), Some(measured), Ok(())) = (&mut self.rotation, &reading.rotation, checked) {
            rotation.begin(measured);
        }
        let step = self.toward(reading.rotation.as_ref(), elapsed_s);
        let (state, age_ns) = self.exchange.advance(now_ns, false);
        let turns = self.exchange.ladder.turns();
        // From the first sample that can be: bounds hang on it.
        let home = if checked.is_ok() { *self.home.get_or_insert(*position) } else { *position };
        let (mut command_velocity, mut angular_velocity) = (Axes::zeros(), Axes::zeros());
        let mut limited = Limited::default();
        if let (Some(rotation), Some(step), true) = (&mut self.rotation, &step, turns || state.is_coupled()) {
            // The two engage where it has just reached the master.
            rotation.command = Some(step.orientation);
        }
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
                let bounds =
                    CommandBounds { speed: (self.bounds.speed - self.braking).max(0.0), ..self.bounds };
                let (command, over) = bounded(&bounds, elapsed_s, &home, &from, &wanted);
                limited = over;
                command_velocity = velocity * share;
                let speed = norm(&command_velocity);
                if speed > bounds.speed {
                    command_velocity *= bounds.speed / speed;
                    limited.speed = true;
                }
                self.command = Some(command);
                if let (Some(rotation), Some(master), Some(measured)) =
                    (&mut self.rotation, &frame.rotation, &reading.rotation)
                {
                    angular_velocity =
                        rotation.follow(master, measured, elapsed_s, (ahead_s, share), &mut limited);
                }
            }
            // Holds the last command; when it engages again it does so from where both are then.
            _ => self.disengage(),
        }
        let power_w = environment_force.dot(&command_velocity);
        let mut turning = angular_velocity;
        if let (true, Some(step)) = (turns, step) {
            self.command.get_or_insert(*position);
            // What it does to what it touches does not go over the link.
            (angular_velocity, turning) = (step.angular_velocity, Axes::zeros());
        }
        self.commanded_ns = now_ns;
        self.exchange.limited_ticks += u64::from(limited.any());
        self.report(reading, power_w, &turning, elapsed_s, turns);
        let command = self.command.unwrap_or(*position);
        self.exchange
            .end_tick(now_ns, [position, &command, environment_force], || [Observed::NOTHING; LAYERS.len()]);
        SlaveTick {
            command: self.command,
            command_velocity,
            orientation: self.last_orientation(),
            angular_velocity,
            is_led: state.is_coupled() || turns,
            state,
            age_ns,
            limited,
            fault: self.fault,
        }
    }

    /// Refuses a sample that is further from the last than any arm moves in the time between, and begins anew from there:
    /// `|x - x_last| / t` and `|log(R R_last^T)| / t`, with a period at least for two ticks that follow closely.
    fn check_jump(&mut self, now_ns: u64, reading: &SlaveReading<N>) -> Result<(), Fault> {
        let orientation = reading.rotation.as_ref().map(|rotation| rotation.orientation);
        let last = self.last.replace((now_ns, reading.position, orientation));
        let Some((last_ns, position, before)) = last else { return Ok(()) };
        let elapsed_s = (now_ns.saturating_sub(last_ns) as f64 * 1e-9).max(self.period_s);
        Signal::Velocity.check(&((reading.position - position) / elapsed_s))?;
        let angle = before.zip(orientation).map_or(0.0, |(before, now)| before.angle_to(&now));
        Signal::AngularVelocity.check(&Axes::<1>::repeat(angle / elapsed_s))
    }

    /// The next step towards the master's newest orientation, of an arm that is turned there before the two engage.
    fn toward(&mut self, measured: Option<&RotationState>, elapsed_s: f64) -> Option<AlignmentStep> {
        let rotation = self.rotation.as_mut()?;
        let alignment = rotation.alignment?;
        let (is_coupled, turns) = (self.exchange.state().is_coupled(), self.exchange.ladder.turns());
        let master = self.exchange.link().newest().and_then(|frame| frame.rotation.as_ref());
        let elapsed_s = elapsed_s.min(self.max_step_s);
        let (state, step) = match master.zip(measured).filter(|_| !is_coupled) {
            Some(both) => rotation.toward(&alignment, both, elapsed_s, turns),
            None => (AlignmentState::Remaining, None),
        };
        self.exchange.set_alignment(state);
        step
    }

    /// Leaves what the next frame says of the arm; the energy is that of the whole wrench, `f·v + tau·w`. While it turns to
    /// the master (`turns`) there is no wrench: what fades on the hand from before must have nothing of that motion.
    fn report(
        &mut self,
        reading: &SlaveReading<N>,
        power_w: f64,
        angular_velocity: &Axes<3>,
        elapsed_s: f64,
        turns: bool,
    ) {
        let outgoing = &mut self.exchange.outgoing;
        if self.fault.is_some() {
            without_wrench(outgoing);
            return;
        }
        let SlaveReading { position, velocity, environment_force: force, rotation } = *reading;
        let turning = rotation.map_or(0.0, |measured| measured.torque.dot(angular_velocity));
        outgoing.energy.add(power_w + turning, elapsed_s);
        outgoing.report(&position, &velocity, &force, rotation);
        if turns {
            without_wrench(outgoing);
        }
    }

    fn disengage(&mut self) {
        self.coupling.disengage();
        if let Some(rotation) = &mut self.rotation {
            rotation.coupling.disengage();
        }
    }

    /// The arm no longer follows and comes to rest at `rest` in m, and of a pose so turned: when the two engage again, it
    /// goes on from there.
    pub fn rests(&mut self, rest: &Axes<N>, orientation: Option<&UnitQuaternion<f64>>) {
        // Where it does not know where it is, nothing is commanded until the two engage anew.
        self.command = self.command.and(Signal::Position.check(rest).is_ok().then_some(*rest));
        if let Some(rotation) = &mut self.rotation {
            let known = orientation.filter(|orientation| check_orientation(orientation).is_ok());
            rotation.command = rotation.command.and(known.copied());
        }
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
                self.rotation.as_mut().map_or(Ok(()), |rotation| rotation.set_frame(quat_wxyz))?;
            }
            OperatorCommand::RotationScale(scale) => {
                return self
                    .rotation
                    .as_mut()
                    .map_or(Ok(false), |rotation| rotation.set_rotation_scale(scale).map(|()| true));
            }
            _ => return Ok(false),
        }
        Ok(true)
    }

    /// The last commanded position in m; none before the first engagement.
    pub fn last_command(&self) -> Option<Axes<N>> {
        self.command
    }

    /// The last commanded orientation; none of a point, and before the first engagement.
    pub fn last_orientation(&self) -> Option<UnitQuaternion<f64>> {
        self.rotation.as_ref().and_then(|rotation| rotation.command)
    }
}
