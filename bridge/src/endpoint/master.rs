//! The master's endpoint: one tick of the side of the hand.

use haptether_safety::{
    Axes, DeviceModel, Fault, LayerSettings, LimiterSettings, SafetyLayer, SafetyTick,
    controller::SafetySettings, estimator::EstimatorKind,
};

use super::{EndpointError, Exchange, check_period, period_s};
use crate::{
    command::OperatorCommand,
    coupling::{CouplingError, FrameMap, PositionForce},
    ladder::{LadderSettings, LadderState, Observed, thresholds},
    link::PortState,
    wire::Role,
};

/// How a master endpoint is built.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MasterSettings<const N: usize> {
    /// dT in ns.
    pub period_ns: u64,
    /// Drawn anew at every start.
    pub run_id: u64,
    /// Dynamics of the device.
    pub device: DeviceModel<N>,
    /// How V and A are had from positions.
    pub estimator: EstimatorKind,
    /// Observers and controllers.
    pub safety: SafetySettings,
    /// Bounds on the device force; the ladder fades the force in, so the limiter's ramp-in is not used.
    pub limiter: LimiterSettings,
    /// `lambda_f`, of the position-force coupling.
    pub force_scale: f64,
    /// Times of the ladder.
    pub ladder: LadderSettings,
}

/// What one tick of the master did.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MasterTick<const N: usize> {
    /// All that the safety layer saw and decided; `device_force` in it goes to the device.
    pub safety: SafetyTick<N>,
    /// Where the ladder stands.
    pub state: LadderState,
    /// Silence of the peer in ns.
    pub age_ns: Option<u64>,
}

/// The master's side as a state machine: `(sample, frames, time) -> (device force, frame)`.
#[derive(Clone, Debug)]
pub struct MasterEndpoint<const N: usize> {
    layer: SafetyLayer<N>,
    coupling: PositionForce<N>,
    /// What talks to the peer.
    pub exchange: Exchange<N>,
    /// Position and velocity of the last tick.
    last: Option<(Axes<N>, Option<Axes<N>>)>,
    period_s: f64,
    /// The fault of the safety layer is mended, as the operator says.
    acknowledged: bool,
}

impl<const N: usize> MasterEndpoint<N> {
    /// An endpoint that waits for its peer.
    pub fn new(settings: &MasterSettings<N>) -> Result<Self, EndpointError> {
        check_period(settings.period_ns)?;
        let layer = SafetyLayer::new(&LayerSettings {
            device: settings.device,
            period_s: period_s(settings.period_ns),
            estimator: settings.estimator,
            safety: settings.safety,
            limiter: LimiterSettings { ramp_in_s: 0.0, ..settings.limiter },
        })?;
        let mut exchange = Exchange::new(Role::Master, settings.run_id, settings.period_ns, settings.ladder)?;
        exchange.flight.hold_against(thresholds(&settings.safety));
        Ok(Self {
            layer,
            coupling: PositionForce::new(1.0, settings.force_scale)?,
            exchange,
            last: None,
            period_s: period_s(settings.period_ns),
            acknowledged: false,
        })
    }

    /// One tick: x in m and, from a device that measures it, V in m/s; `missed` ticks were left out since the last.
    /// `clutch` is whether the clutch is pressed.
    pub fn tick(
        &mut self,
        now_ns: u64,
        missed: u64,
        position: &Axes<N>,
        velocity: Option<&Axes<N>>,
        clutch: bool,
    ) -> MasterTick<N> {
        let device_failed = self.exchange.events.device_failed;
        if device_failed {
            self.exchange.fault(now_ns, Fault::Device);
        }
        let (_, age_ns) = self.exchange.advance(now_ns, clutch);
        let requested_force = self
            .exchange
            .link()
            .newest()
            .map_or(Axes::zeros(), |frame| self.coupling.rendered_force(&frame.force));
        let gain = self.exchange.ladder.gain();
        if std::mem::take(&mut self.acknowledged) {
            // Where the position still is none that can be, the layer keeps its fault, and meets it again below.
            let _ = self.layer.reset(position);
        } else if self.exchange.has_stalled() {
            // What lies before the gap says nothing of what follows it. A position that cannot be is met below.
            let _ = self.layer.restart(position);
        } else {
            self.carry_over(missed, position, velocity);
        }
        if device_failed {
            // After the reset above: nobody can have acknowledged what shows at this tick only.
            self.layer.fail(Fault::Device);
        }
        self.last = Some((*position, velocity.copied()));
        let safety = self.layer.tick_with_authority(position, velocity, &(requested_force * gain), gain);
        if let Some(fault) = safety.fault {
            self.exchange.fault(now_ns, fault);
        } else {
            let velocity = safety.motion.velocity;
            let energy = &mut self.exchange.outgoing.energy;
            energy.add(-safety.rendered_force.dot(&velocity), self.period_s * (missed + 1) as f64);
            let energy = *energy;
            let gripper = self.exchange.outgoing.gripper;
            self.exchange.outgoing =
                PortState { position: *position, velocity, force: safety.device_force, energy, gripper };
        }
        let observed = Observed::of(&safety.intervention);
        self.exchange.end_tick(now_ns, [position, &safety.device_force, &safety.rendered_force], observed);
        MasterTick { safety, state: self.exchange.ladder.state(), age_ns }
    }

    /// Carries estimator and observers over missed ticks, along a straight line.
    fn carry_over(&mut self, missed: u64, position: &Axes<N>, velocity: Option<&Axes<N>>) {
        if missed == 0 {
            return;
        }
        if let Some((before, moving)) = self.last {
            for tick in 1..=missed {
                let share = tick as f64 / (missed + 1) as f64;
                let between = moving.zip(velocity).map(|(then, now)| then + (now - then) * share);
                self.layer.missed(&(before + (position - before) * share), between.as_ref());
            }
        }
    }

    /// Carries out a command of the operator; returns whether it changed anything.
    pub fn command(&mut self, now_ns: u64, command: OperatorCommand) -> Result<bool, CouplingError> {
        match command {
            OperatorCommand::Acknowledge => {
                self.acknowledged = self.exchange.state() == LadderState::Fault;
                self.exchange.acknowledge(now_ns);
            }
            OperatorCommand::ForceScale(scale) => self.coupling.set_force_scale(scale)?,
            OperatorCommand::Frame { quat_wxyz, locked } => {
                self.coupling.set_map(FrameMap::rotated(quat_wxyz, &locked)?);
            }
            _ => return Ok(false),
        }
        Ok(true)
    }
}
