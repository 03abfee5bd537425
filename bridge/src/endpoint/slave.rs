//! The slave's endpoint: one tick of the side of the robot.

use haptether_safety::{Axes, Fault, SampleBounds};
use nalgebra::UnitQuaternion;

use super::{Arm, ArmInput, EndpointError, Exchange, MasterState, SlaveRotationSettings, period_s};
use crate::{
    SideKind,
    command::OperatorCommand,
    coupling::{
        CHANGE_FACTOR, CommandBounds, CouplingError, Limited, RotationState, ScaleRange, ScaleRanges,
    },
    ladder::{LAYERS, LadderSettings, LadderState, Observed},
    wire::{Role, unpadded},
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

/// The slave's side as a state machine: `(sample, frames, time) -> (command, frame)`.
#[derive(Clone, Debug)]
pub struct SlaveEndpoint<const N: usize> {
    arm: Arm<N>,
    /// Bounds of `lambda_p` and `lambda_r` while it runs.
    ranges: ScaleRanges,
    /// What talks to the peer.
    pub exchange: Exchange,
}

impl<const N: usize> SlaveEndpoint<N> {
    /// An endpoint that waits for its peer.
    pub fn new(settings: &SlaveSettings) -> Result<Self, EndpointError> {
        let arm = Arm::new(settings)?;
        let exchange = Exchange::new(Role::Slave, N, settings.run_id, settings.period_ns, settings.ladder)?;
        let ranges = ScaleRanges {
            translation: Some(ScaleRange::position(settings.position_scale, CHANGE_FACTOR, [])),
            rotation: None,
        };
        Ok(Self { arm, ranges, exchange })
    }

    /// The same of a pose, with `rotation` and three axes.
    pub fn of_pose(
        settings: &SlaveSettings,
        rotation: &SlaveRotationSettings,
    ) -> Result<Self, EndpointError> {
        let Self { arm, mut ranges, mut exchange } = Self::new(settings)?;
        let arm = arm.turning(rotation, period_s(settings.ladder.align_ns))?;
        ranges.rotation = Some(ScaleRange::rotation(rotation.rotation_scale, CHANGE_FACTOR, []));
        exchange.set_kind(SideKind::Pose);
        Ok(Self { arm, ranges, exchange })
    }

    /// The same with other bounds of its scales while it runs; those of [`CHANGE_FACTOR`] else.
    #[must_use]
    pub fn with_ranges(self, ranges: ScaleRanges) -> Self {
        Self { ranges, ..self }
    }

    /// Bounds of its scales while it runs.
    pub fn ranges(&self) -> &ScaleRanges {
        &self.ranges
    }

    /// The same before its first tick, whose samples are held against other bounds than [`SampleBounds::of_axes`] and those at a
    /// lever of 0.1 m: of position and rotation.
    #[must_use]
    pub fn with_samples(self, bounds: [SampleBounds; 2]) -> Self {
        let arm = self.arm.with_samples(bounds, period_s(self.exchange.period_ns));
        Self { arm, ..self }
    }

    /// True while the newest sample is held: the arm is then led by predictions.
    pub fn holds_sample(&self) -> bool {
        self.arm.guard().holds()
    }

    /// The arm still brakes with `speed` in m/s and `angular_speed` in rad/s: the bounds on both leave that much less for
    /// commands, until this is said anew.
    pub fn set_braking(&mut self, [speed, angular_speed]: [f64; 2]) {
        self.arm.set_braking([speed, angular_speed]);
    }

    /// One tick of what the arm measures.
    #[inline(always)] // once a tick, from few places
    pub fn tick(&mut self, now_ns: u64, reading: &SlaveReading<N>) -> SlaveTick<N> {
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
        let alignment = arm.align(now_ns, reading.rotation.as_ref(), checked.is_ok(), before);
        if let Some((state, _)) = &alignment {
            exchange.set_alignment(*state);
        }
        let step = alignment.and_then(|(_, step)| step);
        let (state, age_ns) = exchange.advance(now_ns, false);
        let newest = exchange.link.newest().map(|frame| MasterState {
            position: unpadded(&frame.position),
            velocity: unpadded(&frame.velocity),
            rotation: frame.rotation.as_ref(),
        });
        let turns = exchange.ladder.turns();
        let input = ArmInput { state, turns, stale_ns: exchange.ladder.stale_ns(), newest };
        let outgoing = &mut exchange.outgoing;
        let tick = arm.tick(now_ns, reading, checked.is_ok(), step.as_ref(), &input, outgoing);
        exchange.limited_ticks += u64::from(tick.limited.any());
        let command = arm.last_command().unwrap_or(reading.position);
        let values = [&reading.position, &command, &reading.environment_force];
        exchange.end_tick(now_ns, values, || [Observed::NOTHING; LAYERS.len()]);
        SlaveTick {
            command: arm.last_command(),
            command_velocity: tick.command_velocity,
            orientation: arm.last_orientation(),
            angular_velocity: tick.angular_velocity,
            is_led: state.is_coupled() || turns,
            state,
            age_ns,
            limited: tick.limited,
            fault: arm.fault(),
        }
    }

    /// The arm no longer follows and comes to rest at `rest` in m, and of a pose so turned: when the two engage again, it
    /// goes on from there.
    pub fn rests(&mut self, rest: &Axes<N>, orientation: Option<&UnitQuaternion<f64>>) {
        self.arm.rests(rest, orientation);
    }

    /// Carries out a command of the operator; returns whether it changed anything. What it changes of the coupling fades in
    /// within the ladder's fade-in, and stays within its bounds; the slave goes on from where it is.
    pub fn command(&mut self, now_ns: u64, command: OperatorCommand) -> Result<bool, CouplingError> {
        if command == OperatorCommand::Acknowledge {
            self.exchange.acknowledge(now_ns);
        }
        self.ranges.check(Role::Slave, &command, self.exchange.is_open())?;
        self.arm.command(command, self.exchange.fade_ticks())
    }

    /// The last commanded position in m; none before the first engagement.
    pub fn last_command(&self) -> Option<Axes<N>> {
        self.arm.last_command()
    }

    /// The last commanded orientation; none of a point, and before the first engagement.
    pub fn last_orientation(&self) -> Option<UnitQuaternion<f64>> {
        self.arm.last_orientation()
    }
}
