//! Endpoint of the master: one tick of the side of the hand.

use haptether_safety::{
    Axes, Coupled, CoupledTurn, DeviceModel, Fault, LayerSettings, LimiterSettings, SafetyTick, SampleBounds,
    Signal, Turned,
    controller::{ResearchController, SafetySettings},
    estimator::EstimatorKind,
};
use nalgebra::UnitQuaternion;

use super::{
    EndpointError, Exchange, MasterReading, MasterRotationSettings, TriggerSettings,
    alternative::{Alternative, check_change, kind_of, place},
    check_period,
    hand::{CarriedState, Hand, HandInput},
    layer::Layer,
    period_s,
    trigger::TriggerFeedback,
};
use crate::{
    SideKind,
    command::OperatorCommand,
    coupling::{
        CHANGE_FACTOR, CoupledMaster, CoupledMasterTurn, CouplingError, HandMotion, Mapping, MethodSettings,
        RotationCoupling, RotationLock, RotationState, ScaleRange, ScaleRanges, capped,
    },
    ladder::{LAYERS, LadderSettings, LadderState, Observed, ROTATION, TRANSLATION, TRIGGER},
    playout::PlayOut,
    port::CouplingMessage,
    wire::{Role, unpadded},
};

/// Largest force in N of a hand in a frame, and the lever in m that gives its torque: an estimate may be far off.
const MOST_GRASP_N: f64 = 100.0;
const LEVER_M: f64 = 0.1;

/// Settings of a master endpoint.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MasterSettings<const N: usize> {
    /// dT in ns.
    pub period_ns: u64,
    /// Random run id; a new one is drawn at every start.
    pub run_id: u64,
    /// Dynamics of the device.
    pub device: DeviceModel<N>,
    /// Estimator of V and A from positions.
    pub estimator: EstimatorKind,
    /// Observers and controllers.
    pub safety: SafetySettings,
    /// Bounds on the device force. The limiter's ramp-in is not used, because the ladder fades the force in.
    pub limiter: LimiterSettings,
    /// `lambda_f`.
    pub force_scale: f64,
    /// Times of the ladder.
    pub ladder: LadderSettings,
}

/// Result of one master tick.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MasterTick<const N: usize> {
    /// Inputs of the hand beside the sample of the device.
    pub input: HandInput<N>,
    /// Observations and decisions of the safety layer; its `device_force` goes to the device.
    pub safety: SafetyTick<N>,
    /// Same for the torque, if the hand turns.
    pub rotation: Option<SafetyTick<3>>,
    /// Same for the finger, if the trigger has force feedback; positive closes.
    pub trigger: Option<SafetyTick<1>>,
    /// State of the ladder.
    pub state: LadderState,
    /// Time in ns since the peer was last heard.
    pub age_ns: Option<u64>,
}

/// State machine of the master's side: `(sample, frames, time) -> (device force, frame)`.
#[derive(Clone, Debug)]
pub struct MasterEndpoint<const N: usize> {
    hand: Hand<N>,
    mapping: Mapping<N>,
    /// Settings of the coupling; None for position-force.
    method: Option<MethodSettings>,
    /// Half of the coupling. None for position-force, whose force follows from the newest frame alone.
    coupled: Option<Box<CoupledMaster<N>>>,
    /// Half of the coupling for the rotation, likewise.
    turning: Option<Box<CoupledMasterTurn>>,
    /// Position in m at the last tick of this engagement, from which the work of the next tick counts.
    last: Option<Axes<N>>,
    /// The same for the orientation.
    last_orientation: Option<UnitQuaternion<f64>>,
    /// Coupling of the rotation; none if the hand does not turn.
    rotation: Option<RotationCoupling>,
    /// Force feedback of the trigger; none without it.
    trigger: Option<Box<TriggerFeedback>>,
    /// Link and ladder towards the peer.
    pub exchange: Exchange,
    /// Bounds of `lambda_f` and `lambda_tau` during the run.
    ranges: ScaleRanges,
    period_s: f64,
    /// True if the operator has acknowledged the fault since the last tick.
    acknowledged: bool,
    /// Couplings to which an operator may switch.
    alternatives: Vec<Alternative<CoupledMaster<N>, CoupledMasterTurn>>,
    /// Place of the one to which this side switches once nothing couples it.
    switching: Option<usize>,
}

impl<const N: usize> MasterEndpoint<N> {
    /// Build the endpoint of a hand that moves but does not turn (a point); it waits for its peer.
    pub fn new(settings: &MasterSettings<N>) -> Result<Self, EndpointError> {
        Self::with_rotation(settings, None)
    }

    /// Build the endpoint of a pose (three axes, with `rotation`); `lock` is the slave's lock.
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

    /// Replace the bounds of the scales during the run; the default bounds use [`CHANGE_FACTOR`].
    #[must_use]
    pub fn with_ranges(self, ranges: ScaleRanges) -> Self {
        Self { ranges, ..self }
    }

    /// Bounds of the scales during the run.
    pub fn ranges(&self) -> &ScaleRanges {
        &self.ranges
    }

    /// Set a coupling with two halves; the default is position-force.
    #[must_use]
    pub fn with_coupling(mut self, settings: &MethodSettings) -> Self {
        self.exchange.set_coupling(settings.kind);
        self.method = Some(*settings);
        if settings.kind.needs_grasp_force() {
            self.hand = self.hand.with_grasp();
        }
        self.coupled = CoupledMaster::new(settings).map(Box::new);
        self.turning = CoupledMasterTurn::new(settings).map(Box::new);
        self
    }

    /// Set the play-out of the coupling.
    pub(crate) fn set_play_out(&mut self, play_out: PlayOut) {
        self.exchange.link.set_play_out(play_out);
    }

    /// Add a coupling to which an operator may switch; None for position-force.
    #[must_use]
    pub(crate) fn with_alternative(mut self, method: Option<MethodSettings>, play_out: PlayOut) -> Self {
        if method.is_some_and(|method| method.kind.needs_grasp_force()) {
            self.hand = self.hand.with_grasp();
        }
        self.exchange.link.allow(kind_of(method.as_ref()));
        self.alternatives.push(Alternative::new(
            method,
            play_out,
            CoupledMaster::new,
            CoupledMasterTurn::new,
        ));
        self
    }

    /// Switch to another coupling, if the operator asked for one and nothing couples the sides.
    #[inline(never)]
    fn switch(&mut self) {
        let Some(place) = self.switching.filter(|_| self.exchange.may_switch()) else { return };
        self.switching = None;
        let other = &mut self.alternatives[place];
        let count = self.coupled.as_ref().map_or(0, |coupled| coupled.count());
        let count = self.exchange.switch(other.kind(), &mut other.play_out, count);
        std::mem::swap(&mut self.method, &mut other.method);
        std::mem::swap(&mut self.coupled, &mut other.coupled);
        std::mem::swap(&mut self.turning, &mut other.turning);
        self.coupled.iter_mut().for_each(|coupled| coupled.begin_after(count));
        self.turning.iter_mut().for_each(|turning| turning.clear());
    }

    /// Add a trigger with force feedback.
    pub fn with_trigger(mut self, settings: &TriggerSettings) -> Result<Self, EndpointError> {
        self.exchange.set_thresholds(TRIGGER, &settings.safety);
        let fade_in_s = period_s(self.exchange.ladder.settings().fade_in_ns);
        self.trigger = Some(Box::new(TriggerFeedback::new(settings, self.period_s, fade_in_s)?));
        Ok(self)
    }

    /// Add the caller's own controller after the others, in a simulated run and before its first tick.
    /// Returns `None` for a pose.
    pub(crate) fn with_research(mut self, controller: Box<dyn ResearchController>) -> Option<Self> {
        self.hand = self.hand.with_research(controller)?;
        Some(self)
    }

    /// Build only the [`Hand`] of a point, which decides the force, without an endpoint.
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

    /// Replace the sample bounds of position and rotation, before the first tick. The defaults are
    /// [`SampleBounds::of_axes`] and the linear bounds at a lever of 0.05 m.
    #[must_use]
    pub fn with_samples(self, bounds: [SampleBounds; 2]) -> Self {
        Self { hand: self.hand.with_samples(bounds), ..self }
    }

    /// dT in s.
    pub(crate) fn period_s(&self) -> f64 {
        self.period_s
    }

    /// Hand of this endpoint: the part that decides the force.
    pub(crate) fn hand(&self) -> &Hand<N> {
        &self.hand
    }

    /// Replace the hand, in a simulated run. The new hand must have seen the same samples as the old one.
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
        exchange.set_thresholds(TRANSLATION, &settings.safety);
        if let Some(rotation) = rotation {
            exchange.set_thresholds(ROTATION, &rotation.safety);
        }
        Ok(Self {
            hand,
            mapping: Mapping::new(1.0, settings.force_scale)?,
            method: None,
            coupled: None,
            turning: None,
            last: None,
            last_orientation: None,
            rotation: None,
            trigger: None,
            exchange,
            ranges: ScaleRanges {
                translation: Some(ScaleRange::force(settings.force_scale, CHANGE_FACTOR, [])),
                rotation: None,
            },
            period_s: period_s(settings.period_ns),
            acknowledged: false,
            alternatives: Vec::new(),
            switching: None,
        })
    }

    /// Step one tick on the sample of the device. `missed` is the number of ticks left out since the last
    /// one; `clutch` is true while the clutch is pressed.
    #[inline(always)] // its result is large and mostly empty
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
        if self.switching.is_some() {
            self.switch();
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
            CarriedState::Nothing
        } else if self.exchange.has_stalled() {
            self.trigger.iter_mut().for_each(|trigger| trigger.restart());
            CarriedState::FaultOnly
        } else {
            CarriedState::All
        };
        let mut trigger = self.trigger.as_mut().map(|trigger| {
            let jaws = self.exchange.peer_gripper();
            trigger.tick(reading.trigger, jaws, state.is_coupled(), gain, missed)
        });
        // One person holds hand and trigger, so a fault of either stops both.
        let fault = device_failed.then_some(Fault::Device).or(trigger.and_then(|tick| tick.fault));
        let input =
            HandInput { received_force, received_torque, gain, missed, past, fault, ..HandInput::idle() };
        let mut input = if is_heard { self.requested(&input) } else { input };
        let exerted = self.last.is_some().then(|| self.hand.exerted());
        let (safety, rotation) = if self.coupled.is_some() && is_heard {
            self.tick_coupled(reading, &mut input)
        } else {
            self.hand.tick(reading, &input)
        };
        let of_trigger = self.trigger.as_ref().map(|trigger| (trigger.outliers(), trigger.excess()));
        let (outliers, excess) = of_trigger.unwrap_or_default();
        self.exchange.outliers = self.hand.guard().outliers() + outliers;
        if let Some(fault) = safety.fault {
            self.exchange.fault_of(now_ns, fault, self.hand.excess().or(excess));
            (self.exchange.outgoing.message, self.last) = (CouplingMessage::ZERO, None);
            trigger = self.trigger.as_mut().map(|trigger| trigger.fail(fault));
        } else {
            self.report(&safety, rotation.as_ref(), exerted.filter(|_| past == CarriedState::All));
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

    /// Tick the hand with the requests of a coupling with two halves, and add them to `input`. Not inline, so that a tick of
    /// position-force stays short.
    #[inline(never)]
    fn tick_coupled(
        &mut self,
        reading: &MasterReading<N>,
        input: &mut HandInput<N>,
    ) -> (SafetyTick<N>, Option<SafetyTick<3>>) {
        let Some(coupled) = &mut self.coupled else { return self.hand.tick(reading, input) };
        let Some(peer) = self.exchange.link.coupled() else {
            // A new run of the peer: no force of the run before may rise again.
            coupled.clear();
            self.turning.iter_mut().for_each(|turning| turning.clear());
            return self.hand.tick(reading, input);
        };
        let (mapping, gain) = (&self.mapping, input.gain);
        let is_coupled = self.exchange.ladder.state().is_coupled();
        // A frame that waited may be of an engagement that has ended.
        let epoch = self.exchange.link.newest().map_or(0, |newest| newest.message.epoch);
        let dt = self.period_s * (input.missed + 1) as f64;
        let (exerted, exerted_torque) = self.hand.exerted();
        let (grasp, grasp_torque) = self.hand.grasp();
        let (mut force, mut torque) = (Axes::zeros(), Axes::zeros());
        let request = |at: &Coupled<'_, N>| {
            let (at, velocity) = (at.position, at.velocity);
            let hand = HandMotion { at, velocity, exerted: &exerted, grasp: &grasp, gain, dt };
            force = coupled.request(mapping, &hand, is_coupled, (peer, epoch));
            force
        };
        let request_torque = |at: &CoupledTurn<'_>| {
            if let (Some(turning), Some(map)) = (&mut self.turning, &self.rotation) {
                let velocity = &at.angular_velocity;
                let (exerted, grasp) = (&exerted_torque, &grasp_torque);
                let hand = HandMotion { at: at.orientation, velocity, exerted, grasp, gain, dt };
                torque = turning.request(map, &hand, is_coupled, (peer, epoch));
            }
            torque
        };
        let ticks = self.hand.tick_coupled(reading, input, request, request_torque);
        (input.requested_force, input.requested_torque) = (force, torque);
        ticks
    }

    /// Add the coupling's requested force and torque to `input`. Each call advances the coupling's fades by
    /// one tick.
    #[inline(always)] // argument and result are large
    pub(crate) fn requested(&mut self, input: &HandInput<N>) -> HandInput<N> {
        let is_measured = self.coupled.is_none();
        let requested_force = if is_measured {
            self.mapping.rendered_force(&input.received_force)
        } else {
            input.requested_force
        };
        self.mapping.advance();
        let requested_torque = self.rotation.as_mut().map_or(Axes::zeros(), |coupling| {
            let torque = if is_measured {
                coupling.rendered_torque(&input.received_torque)
            } else {
                input.requested_torque
            };
            coupling.advance();
            torque
        });
        HandInput { requested_force, requested_torque, ..*input }
    }

    /// Repeat a recorded tick, without peer, ladder or trigger.
    pub(crate) fn replay(
        &mut self,
        reading: &MasterReading<N>,
        input: &HandInput<N>,
    ) -> (SafetyTick<N>, Option<SafetyTick<3>>) {
        self.hand.tick(reading, input)
    }

    /// Fill the next frame's report of the device. `exerted` is the wrench of the coupling since the last tick; its
    /// work `f·dx + tau·dphi` comes out of the link.
    #[inline(always)] // once per tick
    fn report(
        &mut self,
        safety: &SafetyTick<N>,
        rotation: Option<&SafetyTick<3>>,
        exerted: Option<(Axes<N>, Axes<3>)>,
    ) {
        let velocity = safety.motion.velocity;
        let taken = self.hand.sample_in_use();
        let position = taken.position;
        let outgoing = &mut self.exchange.outgoing;
        if let (Some((force, torque)), Some(last)) = (exerted, &self.last) {
            let turned = self
                .last_orientation
                .zip(taken.rotation)
                .map_or(0.0, |(last, now)| torque.dot(&(now.orientation * last.inverse()).scaled_axis()));
            outgoing.energy.add(-(force.dot(&(position - last)) + turned));
        }
        let mut rotation = taken.rotation.zip(rotation).map(|(Turned { orientation, .. }, tick)| {
            RotationState { orientation, angular_velocity: tick.motion.velocity, torque: tick.device_force }
        });
        let epoch = self.exchange.epoch();
        self.last = (epoch != 0).then_some(position);
        if taken.rotation.is_some() {
            self.last_orientation = taken.rotation.map(|turned| turned.orientation);
        }
        let outgoing = &mut self.exchange.outgoing;
        outgoing.message.epoch = epoch;
        if let Some(coupled) = &self.coupled {
            let turning = self.turning.as_ref().map_or(f64::NAN, |turning| turning.left_j());
            self.exchange.left_j = coupled.left_j().min(turning);
            outgoing.message = coupled.message(epoch != 0, &position);
            if let (Some(turning), Some(turned)) = (&self.turning, &taken.rotation)
                && outgoing.message.epoch != 0
                && let Some((turned, energy_j)) = turning.sent(&turned.orientation)
            {
                (outgoing.message.turned, outgoing.message.sums[1]) = (turned, energy_j);
            }
        }
        let mut force = safety.device_force;
        if self.method.is_some_and(|method| method.kind.needs_grasp_force()) {
            // Frames of this coupling have F_h instead of F_device; in the frame and scale of the slave, as F_m.
            let (grasp, grasp_torque) = self.hand.grasp();
            let bound = Signal::RenderedForce.bound();
            force = capped(&self.mapping.coupled_force(&capped(&grasp, MOST_GRASP_N)), bound);
            if let (Some(rotation), Some(map)) = (&mut rotation, &self.rotation) {
                let torque = map.coupled_torque(&capped(&grasp_torque, MOST_GRASP_N * LEVER_M));
                rotation.torque = capped(&torque, Signal::RenderedTorque.bound());
            }
        }
        outgoing.report(&position, &velocity, &force, rotation);
    }

    /// Carry out an operator command; return whether it is an acknowledgement or concerns this side's
    /// coupling. A change of the coupling must be within the bounds. A scale changes over the ladder's
    /// fade-in time, or at once while there is no force.
    pub fn command(&mut self, now_ns: u64, command: OperatorCommand) -> Result<bool, CouplingError> {
        if command == OperatorCommand::Acknowledge {
            self.acknowledged = self.exchange.state() == LadderState::Fault;
            self.exchange.acknowledge(now_ns);
            return Ok(true);
        }
        if let OperatorCommand::Coupling(kind) = command {
            let is_present = kind == kind_of(self.method.as_ref());
            self.switching = if is_present { None } else { Some(place(&self.alternatives, kind)?) };
            self.exchange.await_switch(!is_present);
            return Ok(!is_present);
        }
        command.check_scale(Role::Master, &self.ranges, self.exchange.is_open())?;
        check_change(self.method.as_ref(), &self.alternatives, &command, self.exchange.is_open())?;
        self.change(command, self.exchange.fade_ticks())
    }

    /// Change the coupling over `ticks` ticks; return whether the command changes the coupling.
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
        self.mapping.command_at_master(command, ticks)
    }
}
