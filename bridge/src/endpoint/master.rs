//! The master's endpoint: one tick of the side of the hand.

use haptether_safety::{
    Axes, DeviceModel, Fault, LayerSettings, LimiterSettings, SafetyTick, Signal, controller::SafetySettings,
    estimator::EstimatorKind,
};

use super::{
    EndpointError, Exchange, MasterReading, MasterRotationSettings, TriggerSettings, check_period,
    layer::Layer, period_s, trigger::TriggerFeedback,
};
use crate::{
    SideKind,
    command::OperatorCommand,
    coupling::{CouplingError, FrameMap, PositionForce, RotationCoupling, RotationLock, RotationState},
    ladder::{LAYERS, LadderSettings, LadderState, Observed, ROTATION, TRANSLATION, TRIGGER, thresholds},
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
    /// The same of the torque, of a hand that turns.
    pub rotation: Option<SafetyTick<3>>,
    /// The same of the finger, of a trigger with force feedback; positive closes.
    pub trigger: Option<SafetyTick<1>>,
    /// Where the ladder stands.
    pub state: LadderState,
    /// Silence of the peer in ns.
    pub age_ns: Option<u64>,
}

/// The master's side as a state machine: `(sample, frames, time) -> (device force, frame)`.
#[derive(Clone, Debug)]
pub struct MasterEndpoint<const N: usize> {
    layer: Layer<N>,
    coupling: PositionForce<N>,
    /// Of a hand that turns.
    rotation: Option<RotationCoupling>,
    /// Of a trigger that the finger feels.
    trigger: Option<Box<TriggerFeedback>>,
    /// What talks to the peer.
    pub exchange: Exchange<N>,
    /// Of the last tick.
    last: Option<MasterReading<N>>,
    period_s: f64,
    /// The fault of the safety layer is mended, as the operator says.
    acknowledged: bool,
}

impl<const N: usize> MasterEndpoint<N> {
    /// An endpoint of a point that waits for its peer.
    pub fn new(settings: &MasterSettings<N>) -> Result<Self, EndpointError> {
        Self::with_rotation(settings, None)
    }

    /// The same of a pose, with `rotation` and three axes; `lock` is as at the slave.
    pub fn of_pose(
        settings: &MasterSettings<N>,
        rotation: &MasterRotationSettings,
        lock: RotationLock,
    ) -> Result<Self, EndpointError> {
        let mut endpoint = Self::with_rotation(settings, Some(rotation))?;
        let mut coupling = RotationCoupling::new(1.0, rotation.torque_scale)?;
        coupling.set_lock(lock);
        endpoint.rotation = Some(coupling);
        endpoint.exchange.set_kind(SideKind::Pose);
        Ok(endpoint)
    }

    /// The same with a trigger that the finger feels.
    pub fn with_trigger(mut self, settings: &TriggerSettings) -> Result<Self, EndpointError> {
        self.exchange.flight.hold_against(TRIGGER, thresholds(&settings.safety));
        let fade_in_s = period_s(self.exchange.ladder.settings().fade_in_ns);
        self.trigger = Some(Box::new(TriggerFeedback::new(settings, self.period_s, fade_in_s)?));
        Ok(self)
    }

    fn with_rotation(
        settings: &MasterSettings<N>,
        rotation: Option<&MasterRotationSettings>,
    ) -> Result<Self, EndpointError> {
        check_period(settings.period_ns)?;
        let translation = LayerSettings {
            device: settings.device,
            period_s: period_s(settings.period_ns),
            estimator: settings.estimator,
            safety: settings.safety,
            limiter: LimiterSettings { ramp_in_s: 0.0, ..settings.limiter },
        };
        let layer = Layer::new(translation, rotation)?;
        let mut exchange = Exchange::new(Role::Master, settings.run_id, settings.period_ns, settings.ladder)?;
        exchange.flight.hold_against(TRANSLATION, thresholds(&settings.safety));
        if let Some(rotation) = rotation {
            exchange.flight.hold_against(ROTATION, thresholds(&rotation.safety));
        }
        Ok(Self {
            layer,
            coupling: PositionForce::new(1.0, settings.force_scale)?,
            rotation: None,
            trigger: None,
            exchange,
            last: None,
            period_s: period_s(settings.period_ns),
            acknowledged: false,
        })
    }

    /// One tick of what the device measures; `missed` ticks were left out since the last. `clutch` is whether the clutch
    /// is pressed.
    pub fn tick(
        &mut self,
        now_ns: u64,
        missed: u64,
        reading: &MasterReading<N>,
        clutch: bool,
    ) -> MasterTick<N> {
        let device_failed = self.exchange.events.device_failed;
        if device_failed {
            self.exchange.fault(now_ns, Fault::Device);
        }
        let (_, age_ns) = self.exchange.advance(now_ns, clutch);
        let newest = self.exchange.link().newest();
        let requested_force =
            newest.map_or(Axes::zeros(), |frame| self.coupling.rendered_force(&frame.force));
        let requested_torque = match (&self.rotation, newest.and_then(|frame| frame.rotation.as_ref())) {
            (Some(coupling), Some(slave)) => coupling.rendered_torque(&slave.torque),
            _ => Axes::zeros(),
        };
        let jaws = newest.and_then(|frame| frame.gripper);
        let (gain, state) = (self.exchange.ladder.gain(), self.exchange.ladder.state());
        if std::mem::take(&mut self.acknowledged) {
            // Where the position still is none that can be, the layer keeps its fault, and meets it again below.
            let _ = self.layer.reset(reading);
            self.trigger.iter_mut().for_each(|trigger| trigger.reset());
        } else if self.exchange.has_stalled() {
            // What lies before the gap says nothing of what follows it. A position that cannot be is met below.
            let _ = self.layer.restart(reading);
            self.trigger.iter_mut().for_each(|trigger| trigger.restart());
        } else {
            // Before the estimators spread it over their window: no force answers a jump that no device makes.
            if let Err(fault) = self.check_jump(missed, reading) {
                self.layer.fail(fault);
            }
            self.carry_over(missed, reading);
        }
        if device_failed {
            // After the reset above: nobody can have acknowledged what shows at this tick only.
            self.layer.fail(Fault::Device);
        }
        self.last = Some(*reading);
        let mut trigger = self
            .trigger
            .as_mut()
            .map(|trigger| trigger.tick(reading.trigger, jaws, state.is_coupled(), gain, missed));
        // One person holds both: a fault of either stops both.
        if let Some(fault) = trigger.and_then(|tick| tick.fault) {
            self.layer.fail(fault);
        }
        let (safety, rotation) =
            self.layer.tick(reading, &(requested_force * gain), &(requested_torque * gain), gain);
        if let Some(fault) = safety.fault {
            self.exchange.fault(now_ns, fault);
            trigger = self.trigger.as_mut().map(|trigger| trigger.fail(fault));
        } else {
            self.report(reading, &safety, rotation.as_ref(), missed);
        }
        let mut observed = [Observed::NOTHING; LAYERS.len()];
        observed[TRANSLATION] = Observed::of(&safety.intervention);
        if let Some(tick) = &rotation {
            observed[ROTATION] = Observed::of(&tick.intervention);
        }
        if let Some(tick) = &trigger {
            observed[TRIGGER] = Observed::of(&tick.intervention);
        }
        let values = [&reading.position, &safety.device_force, &safety.rendered_force];
        self.exchange.end_tick(now_ns, values, observed);
        MasterTick { safety, rotation, trigger, state: self.exchange.ladder.state(), age_ns }
    }

    /// Refuses a position that is further from the last than any device moves in the time between.
    fn check_jump(&self, missed: u64, reading: &MasterReading<N>) -> Result<(), Fault> {
        let Some(last) = self.last else { return Ok(()) };
        Signal::Position.check(&reading.position)?;
        let elapsed_s = self.period_s * (missed + 1) as f64;
        Signal::Velocity.check(&((reading.position - last.position) / elapsed_s))
    }

    /// Leaves what the next frame says of the device; the energy is that of the whole wrench, `f·v + tau·w`.
    fn report(
        &mut self,
        reading: &MasterReading<N>,
        safety: &SafetyTick<N>,
        rotation: Option<&SafetyTick<3>>,
        missed: u64,
    ) {
        let velocity = safety.motion.velocity;
        let turning = rotation.map_or(0.0, |tick| tick.rendered_force.dot(&tick.motion.velocity));
        let power_w = safety.rendered_force.dot(&velocity) + turning;
        let rotation = reading.rotation.zip(rotation).map(|(read, tick)| RotationState {
            orientation: read.orientation,
            angular_velocity: tick.motion.velocity,
            torque: tick.device_force,
        });
        let outgoing = &mut self.exchange.outgoing;
        outgoing.energy.add(-power_w, self.period_s * (missed + 1) as f64);
        let (position, force) = (reading.position, safety.device_force);
        *outgoing = PortState { position, velocity, force, rotation, ..*outgoing };
    }

    /// Carries estimator and observers over missed ticks, along a straight line.
    fn carry_over(&mut self, missed: u64, reading: &MasterReading<N>) {
        if missed == 0 {
            return;
        }
        if let Some(before) = self.last {
            for tick in 1..=missed {
                self.layer.missed(&before.towards(reading, tick as f64 / (missed + 1) as f64));
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
                self.rotation.as_mut().map_or(Ok(()), |coupling| coupling.set_frame(quat_wxyz))?;
            }
            OperatorCommand::TorqueScale(scale) => {
                return self
                    .rotation
                    .as_mut()
                    .map_or(Ok(false), |coupling| coupling.set_torque_scale(scale).map(|()| true));
            }
            _ => return Ok(false),
        }
        Ok(true)
    }
}
