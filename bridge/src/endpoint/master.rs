//! The master's endpoint: one tick of the side of the hand.

use haptether_safety::{
    Axes, DeviceModel, Fault, LayerSettings, LimiterSettings, SafetyTick, SampleBounds, Turned,
    controller::{ResearchController, SafetySettings},
    estimator::EstimatorKind,
};

use super::{
    EndpointError, Exchange, MasterReading, MasterRotationSettings, TriggerSettings, check_period,
    hand::{Hand, HandInput, Past},
    layer::Layer,
    period_s,
    trigger::TriggerFeedback,
};
use crate::{
    SideKind,
    command::OperatorCommand,
    coupling::{
        CHANGE_FACTOR, CouplingError, PositionForce, RotationCoupling, RotationLock, RotationState,
        ScaleRange, ScaleRanges,
    },
    ladder::{LAYERS, LadderSettings, LadderState, Observed, ROTATION, TRANSLATION, TRIGGER},
    wire::{Role, unpadded},
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
    /// What it went by beside the sample of the device.
    pub input: HandInput<N>,
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
    hand: Hand<N>,
    coupling: PositionForce<N>,
    /// Of a hand that turns.
    rotation: Option<RotationCoupling>,
    /// Of a trigger that the finger feels.
    trigger: Option<Box<TriggerFeedback>>,
    /// What talks to the peer.
    pub exchange: Exchange,
    /// Bounds of `lambda_f` and `lambda_tau` while it runs.
    ranges: ScaleRanges,
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
        endpoint.ranges.rotation = Some(ScaleRange::torque(rotation.torque_scale, CHANGE_FACTOR, []));
        endpoint.exchange.set_kind(SideKind::Pose);
        Ok(endpoint)
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

    /// The same with a trigger that the finger feels.
    pub fn with_trigger(mut self, settings: &TriggerSettings) -> Result<Self, EndpointError> {
        self.exchange.hold_against(TRIGGER, &settings.safety);
        let fade_in_s = period_s(self.exchange.ladder.settings().fade_in_ns);
        self.trigger = Some(Box::new(TriggerFeedback::new(settings, self.period_s, fade_in_s)?));
        Ok(self)
    }

    /// The same with a controller of the caller's own behind the others, in a simulated run and before its first tick;
    /// None of a pose.
    pub(crate) fn with_research(mut self, controller: Box<dyn ResearchController>) -> Option<Self> {
        self.hand = self.hand.with_research(controller)?;
        Some(self)
    }

    /// What decides over the force of an endpoint of a point, by itself.
    pub(crate) fn hand_of(settings: &MasterSettings<N>) -> Result<Hand<N>, EndpointError> {
        Self::with_layer(settings, None)
    }

    fn with_layer(
        settings: &MasterSettings<N>,
        rotation: Option<&MasterRotationSettings>,
    ) -> Result<Hand<N>, EndpointError> {
        check_period(settings.period_ns)?;
        let translation = LayerSettings {
            device: settings.device,
            period_s: period_s(settings.period_ns),
            estimator: settings.estimator,
            safety: settings.safety,
            limiter: LimiterSettings { ramp_in_s: 0.0, ..settings.limiter },
        };
        Ok(Hand::new(Layer::new(translation, rotation)?))
    }

    /// The same before its first tick, whose samples are held against other bounds than [`SampleBounds::of_axes`] and those at
    /// a lever of 0.05 m: of position and rotation.
    #[must_use]
    pub fn with_samples(self, bounds: [SampleBounds; 2]) -> Self {
        Self { hand: self.hand.with_samples(bounds), ..self }
    }

    /// dT in s.
    pub(crate) fn period_s(&self) -> f64 {
        self.period_s
    }

    /// What decides over its force.
    pub(crate) fn hand(&self) -> &Hand<N> {
        &self.hand
    }

    /// Lets another decide over its force from now on, in a simulated run: what it has seen so far must be what this one
    /// has.
    pub(crate) fn set_hand(&mut self, hand: Hand<N>) {
        self.hand = hand;
    }

    fn with_rotation(
        settings: &MasterSettings<N>,
        rotation: Option<&MasterRotationSettings>,
    ) -> Result<Self, EndpointError> {
        let hand = Self::with_layer(settings, rotation)?;
        let mut exchange =
            Exchange::new(Role::Master, N, settings.run_id, settings.period_ns, settings.ladder)?;
        exchange.hold_against(TRANSLATION, &settings.safety);
        if let Some(rotation) = rotation {
            exchange.hold_against(ROTATION, &rotation.safety);
        }
        Ok(Self {
            hand,
            coupling: PositionForce::new(1.0, settings.force_scale)?,
            rotation: None,
            trigger: None,
            exchange,
            ranges: ScaleRanges {
                translation: Some(ScaleRange::force(settings.force_scale, CHANGE_FACTOR, [])),
                rotation: None,
            },
            period_s: period_s(settings.period_ns),
            acknowledged: false,
        })
    }

    /// One tick of what the device measures; `missed` ticks were left out since the last. `clutch` is whether the clutch
    /// is pressed.
    #[inline(always)] // what it returns is large, and mostly none
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
        let received_force = newest.map_or(Axes::zeros(), |frame| unpadded(&frame.force));
        let received_torque =
            newest.and_then(|frame| frame.rotation.as_ref()).map_or(Axes::zeros(), |slave| slave.torque);
        let is_heard = newest.is_some();
        let (gain, state) = (self.exchange.ladder.gain(), self.exchange.ladder.state());
        let past = if std::mem::take(&mut self.acknowledged) {
            self.trigger.iter_mut().for_each(|trigger| trigger.reset());
            Past::Acknowledged
        } else if self.exchange.has_stalled() {
            self.trigger.iter_mut().for_each(|trigger| trigger.restart());
            Past::Stalled
        } else {
            Past::Kept
        };
        let mut trigger = self.trigger.as_mut().map(|trigger| {
            let jaws = self.exchange.peer_gripper();
            trigger.tick(reading.trigger, jaws, state.is_coupled(), gain, missed)
        });
        // One person holds both: a fault of either stops both.
        let fault = device_failed.then_some(Fault::Device).or(trigger.and_then(|tick| tick.fault));
        let input =
            HandInput { received_force, received_torque, gain, missed, past, fault, ..HandInput::idle() };
        let input = if is_heard { self.requested(&input) } else { input };
        let (safety, rotation) = self.hand.tick(reading, &input);
        let of_trigger = self.trigger.as_ref().map(|trigger| (trigger.outliers(), trigger.excess()));
        let (outliers, excess) = of_trigger.unwrap_or_default();
        self.exchange.outliers = self.hand.guard().outliers() + outliers;
        if let Some(fault) = safety.fault {
            self.exchange.fault_of(now_ns, fault, self.hand.excess().or(excess));
            trigger = self.trigger.as_mut().map(|trigger| trigger.fail(fault));
        } else {
            self.report(&safety, rotation.as_ref(), missed);
            let turned = rotation.as_ref().map(|tick| tick.intervention);
            if safety.intervention.withheld || turned.is_some_and(|one| one.withheld) {
                let yields = safety.intervention.yields || turned.is_some_and(|one| one.yields);
                self.exchange.withhold(now_ns, yields);
            }
        }
        let values = [&reading.position, &safety.device_force, &safety.rendered_force];
        self.exchange.end_tick(now_ns, values, || {
            let mut observed = [Observed::NOTHING; LAYERS.len()];
            observed[TRANSLATION] = Observed::of(&safety.intervention);
            if let Some(tick) = &rotation {
                observed[ROTATION] = Observed::of(&tick.intervention);
            }
            if let Some(tick) = &trigger {
                observed[TRIGGER] = Observed::of(&tick.intervention);
            }
            observed
        });
        MasterTick { input, safety, rotation, trigger, state: self.exchange.ladder.state(), age_ns }
    }

    /// The same with what the coupling requests of what was received. Each call is a tick of what is being changed.
    #[inline(always)] // what it is given and returns is large
    pub(crate) fn requested(&mut self, input: &HandInput<N>) -> HandInput<N> {
        let requested_force = self.coupling.rendered_force(&input.received_force);
        self.coupling.advance();
        let requested_torque = self.rotation.as_mut().map_or(Axes::zeros(), |coupling| {
            let torque = coupling.rendered_torque(&input.received_torque);
            coupling.advance();
            torque
        });
        HandInput { requested_force, requested_torque, ..*input }
    }

    /// A tick that was recorded, again: no peer, no ladder, no trigger.
    pub(crate) fn replay(
        &mut self,
        reading: &MasterReading<N>,
        input: &HandInput<N>,
    ) -> (SafetyTick<N>, Option<SafetyTick<3>>) {
        self.hand.tick(reading, input)
    }

    /// Leaves what the next frame says of the device; the energy is that of the whole wrench, `f·v + tau·w`.
    fn report(&mut self, safety: &SafetyTick<N>, rotation: Option<&SafetyTick<3>>, missed: u64) {
        let velocity = safety.motion.velocity;
        let turning = rotation.map_or(0.0, |tick| tick.rendered_force.dot(&tick.motion.velocity));
        let power_w = safety.rendered_force.dot(&velocity) + turning;
        let taken = self.hand.taken();
        let rotation = taken.rotation.zip(rotation).map(|(Turned { orientation, .. }, tick)| RotationState {
            orientation,
            angular_velocity: tick.motion.velocity,
            torque: tick.device_force,
        });
        let outgoing = &mut self.exchange.outgoing;
        outgoing.energy.add(-power_w, self.period_s * (missed + 1) as f64);
        outgoing.report(&taken.position, &velocity, &safety.device_force, rotation);
    }

    /// Carries out a command of the operator; returns whether it changed anything. What it changes of the coupling fades in
    /// within the ladder's fade-in, and stays within its bounds.
    pub fn command(&mut self, now_ns: u64, command: OperatorCommand) -> Result<bool, CouplingError> {
        if command == OperatorCommand::Acknowledge {
            self.acknowledged = self.exchange.state() == LadderState::Fault;
            self.exchange.acknowledge(now_ns);
            return Ok(true);
        }
        self.ranges.check(Role::Master, &command, self.exchange.is_open())?;
        self.change(command, self.exchange.fade_ticks())
    }

    /// Changes the coupling over so many ticks; returns whether the command is one that does.
    pub(crate) fn change(&mut self, command: OperatorCommand, ticks: u32) -> Result<bool, CouplingError> {
        match (command, &mut self.rotation) {
            (OperatorCommand::TorqueScale(scale), Some(rotation)) => {
                return rotation.set_torque_scale(scale, ticks).map(|()| true);
            }
            (OperatorCommand::Frame { quat_wxyz, .. }, Some(rotation)) => {
                rotation.set_frame(quat_wxyz, ticks)?;
            }
            _ => {}
        }
        self.coupling.command_at_master(command, ticks)
    }
}
