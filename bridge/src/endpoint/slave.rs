//! Endpoint of the slave: one tick of the side of the robot.

use haptether_safety::{Axes, Fault, SampleBounds};
use nalgebra::UnitQuaternion;

use super::{
    Arm, ArmInput, EndpointError, Exchange, MasterState, SlaveRotationSettings,
    alternative::{Alternative, check_change, kind_of, place},
    period_s,
};
use crate::{
    SideKind,
    command::OperatorCommand,
    coupling::{
        CHANGE_FACTOR, CommandBounds, CoupledSlave, CoupledSlaveTurn, CouplingError, Limited, MethodSettings,
        OfHalf, RotationState, ScaleRange, ScaleRanges,
    },
    ladder::{LAYERS, LadderSettings, LadderState, Observed},
    playout::PlayOut,
    wire::{Role, unpadded},
};

/// Settings of a slave endpoint.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SlaveSettings {
    /// Period of the loop in ns.
    pub period_ns: u64,
    /// Random run id; a new one is drawn at every start.
    pub run_id: u64,
    /// `lambda_p`.
    pub position_scale: f64,
    /// Bounds on a remote command.
    pub bounds: CommandBounds,
    /// Times of the ladder.
    pub ladder: LadderSettings,
}

/// Measurements of an arm at one tick.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SlaveReading<const N: usize> {
    /// Position of the tool in m.
    pub position: Axes<N>,
    /// Velocity in m/s.
    pub velocity: Axes<N>,
    /// `F_e` in N.
    pub environment_force: Axes<N>,
    /// Rotation of an arm that turns, about the tool point, in the arm's base frame.
    pub rotation: Option<RotationState>,
}

impl<const N: usize> SlaveReading<N> {
    /// Build the reading of a point: position in m, velocity in m/s, `F_e` in N.
    pub fn point([position, velocity, environment_force]: [Axes<N>; 3]) -> Self {
        Self { position, velocity, environment_force, rotation: None }
    }
}

/// Result of one slave tick.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SlaveTick<const N: usize> {
    /// Commanded position in m; none before the first engagement.
    pub command: Option<Axes<N>>,
    /// Velocity in m/s of the commanded position; zero unless engaged.
    pub command_velocity: Axes<N>,
    /// Commanded orientation of the tool; none for a point, and before the first engagement.
    pub orientation: Option<UnitQuaternion<f64>>,
    /// Angular velocity in rad/s of the commanded orientation; zero unless engaged or rotating to the
    /// master's orientation.
    pub angular_velocity: Axes<3>,
    /// Force in N, and torque in N m about the tool point, that the arm exerts instead of following the command; none unless
    /// it takes forces and is engaged.
    pub exerted: Option<(Axes<N>, Axes<3>)>,
    /// True if the arm follows commands: it is engaged, or rotates to the master's orientation before that.
    pub is_led: bool,
    /// State of the ladder.
    pub state: LadderState,
    /// Time in ns since the peer was last heard.
    pub age_ns: Option<u64>,
    /// Bounds that acted on the command.
    pub limited: Limited,
    /// Fault behind the state FAULT.
    pub fault: Option<Fault>,
}

/// State machine of the slave's side: `(sample, frames, time) -> (command, frame)`.
#[derive(Clone, Debug)]
pub struct SlaveEndpoint<const N: usize> {
    arm: Arm<N>,
    /// Settings of the coupling; None for position-force.
    method: Option<MethodSettings>,
    /// Couplings to which an operator may switch at the master.
    alternatives: Vec<Alternative<CoupledSlave<N>, CoupledSlaveTurn>>,
    /// Bounds of `lambda_p` and `lambda_r` during the run.
    ranges: ScaleRanges,
    /// Link and ladder towards the peer.
    pub exchange: Exchange,
}

impl<const N: usize> SlaveEndpoint<N> {
    /// Build an endpoint that waits for its peer.
    pub fn new(settings: &SlaveSettings) -> Result<Self, EndpointError> {
        let arm = Arm::new(settings)?;
        let exchange = Exchange::new(Role::Slave, N, settings.run_id, settings.period_ns, settings.ladder)?;
        let ranges = ScaleRanges {
            translation: Some(ScaleRange::position(settings.position_scale, CHANGE_FACTOR, [])),
            rotation: None,
        };
        Ok(Self { arm, method: None, alternatives: Vec::new(), ranges, exchange })
    }

    /// Build the endpoint of a pose (three axes, with `rotation`).
    pub fn of_pose(
        settings: &SlaveSettings,
        rotation: &SlaveRotationSettings,
    ) -> Result<Self, EndpointError> {
        let Self { arm, method, alternatives, mut ranges, mut exchange } = Self::new(settings)?;
        let arm = arm.turning(rotation, period_s(settings.ladder.align_ns))?;
        ranges.rotation = Some(ScaleRange::rotation(rotation.rotation_scale, CHANGE_FACTOR, []));
        exchange.set_kind(SideKind::Pose);
        Ok(Self { arm, method, alternatives, ranges, exchange })
    }

    /// Set a coupling with two halves; the default is position-force.
    #[must_use]
    pub fn with_coupling(mut self, settings: &MethodSettings) -> Self {
        self.exchange.set_coupling(settings.kind);
        self.arm.set_coupling(settings);
        self.method = Some(*settings);
        self
    }

    /// Set the play-out of the coupling.
    pub(crate) fn set_play_out(&mut self, play_out: PlayOut) {
        self.exchange.link.set_play_out(play_out);
    }

    /// Add a coupling to which an operator may switch at the master; None for position-force.
    #[must_use]
    pub(crate) fn with_alternative(mut self, method: Option<MethodSettings>, play_out: PlayOut) -> Self {
        self.exchange.link.allow(kind_of(method.as_ref()));
        self.alternatives.push(Alternative::new(method, play_out, CoupledSlave::new, CoupledSlaveTurn::new));
        self
    }

    /// Follow the master to another coupling, while nothing couples the sides. A frame engages nobody.
    #[inline(never)]
    fn switch(&mut self) {
        let Some(newest) = self.exchange.link.newest().filter(|_| self.exchange.may_switch()) else { return };
        let Ok(place) = place(&self.alternatives, newest.coupling) else { return };
        let other = &mut self.alternatives[place];
        self.exchange.switch(other.kind(), &mut other.play_out, 0);
        std::mem::swap(&mut self.method, &mut other.method);
        self.arm.switch(&mut other.coupled, &mut other.turning);
    }

    /// Replace the bounds of the scales during the run; the default bounds use [`CHANGE_FACTOR`].
    #[must_use]
    pub fn with_ranges(self, ranges: ScaleRanges) -> Self {
        Self { ranges, ..self }
    }

    /// Bounds of the scales during the run.
    pub fn ranges(&self) -> &ScaleRanges {
        &self.ranges
    }

    /// Replace the sample bounds of position and rotation, before the first tick. The defaults are
    /// [`SampleBounds::of_axes`] and the linear bounds at a lever of 0.1 m.
    #[must_use]
    pub fn with_samples(self, bounds: [SampleBounds; 2]) -> Self {
        let arm = self.arm.with_samples(bounds, period_s(self.exchange.period_ns));
        Self { arm, ..self }
    }

    /// Return true while the newest sample is held; predictions then lead the arm.
    pub fn holds_sample(&self) -> bool {
        self.arm.guard().holds()
    }

    /// Reserve speed in m/s and angular speed in rad/s for an arm that still brakes. Until the next call,
    /// commands get only the remainder of each speed bound.
    pub fn set_braking(&mut self, [speed, angular_speed]: [f64; 2]) {
        self.arm.set_braking([speed, angular_speed]);
    }

    /// Step one tick on the measurements of the arm.
    #[inline(always)] // once per tick, from few callers
    pub fn tick(&mut self, now_ns: u64, reading: &SlaveReading<N>) -> SlaveTick<N> {
        if !self.alternatives.is_empty() {
            self.switch();
        }
        let Self { arm, exchange, .. } = self;
        if exchange.events.peer_began {
            arm.disengage();
        }
        let checked = arm.check(now_ns, reading, exchange.events.device_failed);
        if let Err(fault) = checked {
            exchange.fault_of(now_ns, fault, arm.excess());
        }
        exchange.outliers = arm.guard().outliers();
        let reading = checked.as_ref().ok().and_then(Option::as_ref).unwrap_or(reading);
        let before = || {
            let master = exchange.link().newest().and_then(|frame| frame.rotation);
            (exchange.state(), exchange.ladder.turns(), master)
        };
        let alignment = arm.align(now_ns, reading.rotation.as_ref(), before);
        if let Some((state, _)) = &alignment {
            exchange.set_alignment(*state);
        }
        let step = alignment.and_then(|(_, step)| step);
        let (state, age_ns) = exchange.advance(now_ns, false);
        let newest = exchange.link.coupled().map(|frame| MasterState {
            position: unpadded(&frame.position),
            velocity: unpadded(&frame.velocity),
            rotation: frame.rotation.as_ref(),
            half: OfHalf {
                message: &frame.message,
                force: &frame.force,
                epoch: exchange.link.epoch(),
                sequence: frame.sequence,
                is_stale: state == LadderState::Stale,
            },
        });
        let turns = exchange.ladder.turns();
        let input = ArmInput { state, turns, stale_ns: exchange.ladder.stale_ns(), newest };
        let epoch = exchange.epoch();
        let outgoing = &mut exchange.outgoing;
        outgoing.message.epoch = epoch;
        let tick = arm.tick(now_ns, reading, step.as_ref(), &input, outgoing);
        exchange.left_j = arm.left_j();
        exchange.limited_ticks += u64::from(tick.limited.any());
        let command = arm.last_command().unwrap_or(reading.position);
        let values = [&reading.position, &command, &reading.environment_force];
        exchange.end_tick(now_ns, values, || [Observed::NOTHING; LAYERS.len()]);
        SlaveTick {
            command: arm.last_command(),
            command_velocity: tick.command_velocity,
            orientation: arm.last_orientation(),
            angular_velocity: tick.angular_velocity,
            exerted: tick.exerted,
            is_led: state.is_coupled() || turns,
            state,
            age_ns,
            limited: tick.limited,
            fault: arm.fault(),
        }
    }

    /// Record that the arm stops following and comes to rest at `rest` in m, and a pose at `orientation`. The
    /// next engagement continues from there.
    pub fn set_rest(&mut self, rest: &Axes<N>, orientation: Option<&UnitQuaternion<f64>>) {
        self.arm.set_rest(rest, orientation);
    }

    /// Carry out an operator command; return whether it changed anything. A change of the coupling fades in
    /// within the ladder's fade-in and must be within the bounds. The slave continues from its present
    /// position.
    pub fn command(&mut self, now_ns: u64, command: OperatorCommand) -> Result<bool, CouplingError> {
        if command == OperatorCommand::Acknowledge {
            self.exchange.acknowledge(now_ns);
        }
        command.check_scale(Role::Slave, &self.ranges, self.exchange.is_open())?;
        check_change(self.method.as_ref(), &self.alternatives, &command, self.exchange.is_open())?;
        self.arm.command(command, self.exchange.fade_ticks())
    }

    /// Last commanded position in m; none before the first engagement.
    pub fn last_command(&self) -> Option<Axes<N>> {
        self.arm.last_command()
    }

    /// Last commanded orientation; none for a point, and before the first engagement.
    pub fn last_orientation(&self) -> Option<UnitQuaternion<f64>> {
        self.arm.last_orientation()
    }
}
