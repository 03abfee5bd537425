//! One side of the bridge: plant and endpoint, stepped by both runners.

use std::marker::PhantomData;

use haptether_safety::{Axes, SafetyTick};
use haptether_slave::Push;

use crate::{
    buttons::{ButtonError, ButtonSettings, Buttons},
    command::OperatorCommand,
    coupling::{CouplingError, GripperState, ReferencePoint, ScaleRanges},
    endpoint::{Exchange, MasterEndpoint, MasterReading, SlaveEndpoint, SlaveReading, SlaveTick},
    gripper::{FingerTruth, LeadingTrigger, SlaveGripper, Trigger},
    ladder::{Button, Clutch, ClutchError, ClutchOperator, LadderState},
    link::{LinkTime, RejectReason},
    pace::TickTime,
    plant::{MasterPlant, SlavePlant, ToolMotion},
    record::{
        LadderSnapshot, MasterRecord, MasterRotation, MasterTurn, SlaveRecord, SlaveRotation, SlaveTurn,
        WithTriggerFeedback,
    },
    session::{MAX_DATAGRAM, Session},
    wire::{Frame, MAX_FRAME, unpadded},
};

/// One side of N axes: per tick `receive`, `tick`, `send`. Times are on the endpoint's clock unless stated otherwise.
pub trait Side {
    /// The record of a tick.
    type Record: Copy + Default + Send + 'static
    where
        Self: Sized;

    /// Start true time at `now_ns`; called once, before the first tick.
    fn begin(&mut self, now_ns: u64);

    /// Take a datagram. A refused datagram changes only its counter.
    fn receive(&mut self, time: LinkTime, datagram: &[u8]) -> Result<(), RejectReason> {
        self.exchange_mut().receive(time, datagram)
    }

    /// Take a frame that was not encoded. A side that inspects datagrams needs
    /// [`encoded`](crate::VirtualSettings::encoded) frames.
    #[inline(always)] // takes a frame: docs/decisions/060-ticks-in-a-row.md
    fn receive_frame(&mut self, time: LinkTime, frame: &Frame) -> Result<(), RejectReason> {
        let axes = self.axes();
        self.exchange_mut().receive_frame(time, frame, axes)
    }

    /// Read the plant, decides, writes the plant.
    fn tick(&mut self, time: TickTime) -> Self::Record
    where
        Self: Sized,
    {
        let mut record = Self::Record::default();
        self.tick_into(time, &mut record);
        record
    }

    /// As [`tick`](Self::tick), overwriting all of `record`. A copy would wait for the values just written (store
    /// forwarding).
    fn tick_into(&mut self, time: TickTime, record: &mut Self::Record)
    where
        Self: Sized;

    /// Encode the frame of this tick.
    fn send<'a>(&mut self, time: LinkTime, buffer: &'a mut [u8; MAX_FRAME]) -> &'a [u8] {
        self.exchange_mut().send(time, buffer)
    }

    /// Fills in the frame of this tick, not encoded.
    #[inline(always)] // makes a frame: docs/decisions/060-ticks-in-a-row.md
    fn fill_frame(&mut self, time: LinkTime, frame: &mut Frame) {
        let axes = self.axes();
        self.exchange_mut().fill_frame(time, axes, frame);
    }

    /// Number of axes; a constant if fixed, so that frames are copied in a few instructions.
    #[inline(always)]
    fn axes(&self) -> usize {
        self.exchange().link().layout().axes
    }

    /// Carry out an operator command. Returns whether it changed anything; releasing an open clutch does not.
    /// Invalid numbers change nothing.
    fn command(&mut self, now_ns: u64, command: OperatorCommand) -> Result<bool, CouplingError>;

    /// Bounds of the scales in [`command`](Self::command).
    fn ranges(&self) -> ScaleRanges {
        ScaleRanges::default()
    }

    /// Return whether this is the side of an aimed model, whose hand and tool a person may aim and push.
    fn is_aimed(&self) -> bool {
        false
    }

    /// Return whether the device has a button of its own.
    fn has_button(&self) -> bool {
        false
    }

    /// Remove force and motion from the plant.
    fn rest(&mut self);

    /// Link, ladder and flight recorder.
    fn exchange(&self) -> &Exchange;

    /// The same, to report a stall, a device failure or the end.
    fn exchange_mut(&mut self) -> &mut Exchange;
}

/// The master side; R is the rotation part of its records.
#[derive(Clone, Debug)]
pub struct MasterSide<P, const N: usize, R = ()> {
    /// The device.
    pub plant: P,
    /// Endpoint.
    pub endpoint: MasterEndpoint<N>,
    /// Works the clutch of a device without a button.
    operator: ClutchOperator,
    button: Button,
    /// Leads the gripper; `None` if the slave has no gripper.
    pub trigger: Option<Trigger>,
    leading: LeadingTrigger,
    /// Last tick of the finger's safety layer; `None` without force feedback.
    felt: Option<SafetyTick<1>>,
    /// Mapped buttons; `None` if the scene maps none.
    buttons: Option<Buttons>,
    records: PhantomData<R>,
}

impl<P: MasterPlant<N>, const N: usize> MasterSide<P, N> {
    /// Create a side whose clutch is worked by `clutch`, unless the device has a button.
    pub fn new(plant: P, endpoint: MasterEndpoint<N>, clutch: Clutch) -> Result<Self, ClutchError> {
        let operator = ClutchOperator::new(clutch)?;
        let button = Button::default();
        let leading = LeadingTrigger::new(endpoint.period_s());
        Ok(Self {
            plant,
            endpoint,
            operator,
            button,
            trigger: None,
            leading,
            felt: None,
            buttons: None,
            records: PhantomData,
        })
    }

    /// Add buttons, as `settings` map them.
    pub fn with_buttons(mut self, settings: Option<ButtonSettings>) -> Result<Self, ButtonError> {
        let buttons = settings.map(Buttons::new).transpose()?;
        if let Some(buttons) = &buttons {
            self.endpoint.exchange.carry_buttons();
            if buttons.has_clutch() && self.plant.buttons().is_some() {
                // A mapped bit is less reliable than a device's own clutch: the start does not press it.
                self.button.must_be_released();
            }
        }
        Ok(Self { buttons, ..self })
    }

    /// Make the records contain a rotation.
    #[must_use]
    pub fn recording_rotation(self) -> MasterSide<P, N, MasterRotation> {
        self.recording()
    }

    /// Add a trigger that leads the slave's gripper.
    #[must_use]
    pub fn with_trigger(mut self, trigger: Option<Trigger>) -> Self {
        if trigger.is_some() {
            self.endpoint.exchange.carry_gripper();
        }
        Self { trigger, ..self }
    }
}

impl<P: MasterPlant<N>, const N: usize, R> MasterSide<P, N, R> {
    /// Clutch and trigger, as mapped. A clutch on a button is open while its bit is unknown.
    fn pressed(&mut self, now_ns: u64) -> (Option<bool>, Option<f64>) {
        let (Some(buttons), Some(word)) = (&mut self.buttons, self.plant.buttons()) else {
            return (self.button.at(now_ns, self.plant.clutch()), None);
        };
        let exchange = &mut self.endpoint.exchange;
        buttons.follow(now_ns, exchange.state());
        exchange.report_buttons(word.0.unwrap_or(0));
        let (clutch, trigger) = buttons.at(now_ns, word);
        let clutch = if buttons.has_clutch() {
            Some(self.button.at(now_ns, clutch).unwrap_or(false))
        } else {
            self.button.at(now_ns, self.plant.clutch())
        };
        (clutch, trigger)
    }

    /// Make the records contain force feedback at the trigger.
    #[must_use]
    pub fn recording_trigger(self) -> MasterSide<P, N, WithTriggerFeedback<R>> {
        self.recording()
    }

    fn recording<Q>(self) -> MasterSide<P, N, Q> {
        let Self { plant, endpoint, operator, button, trigger, leading, felt, buttons, .. } = self;
        MasterSide {
            plant,
            endpoint,
            operator,
            button,
            trigger,
            leading,
            felt,
            buttons,
            records: PhantomData,
        }
    }

    /// Last tick of the finger's safety layer, in m/s and N, positive closing; `None` without force feedback.
    pub fn felt(&self) -> Option<&SafetyTick<1>> {
        self.felt.as_ref()
    }

    /// Pass each force-feedback signal of the trigger, for a run in virtual time.
    pub(crate) fn finger_signals(&self, take: &mut dyn FnMut(&'static str, &[f64])) {
        let (Some(felt), Some(trigger)) = (&self.felt, &self.trigger) else { return };
        let estimated = FingerTruth { velocity: felt.motion.velocity[0], finger_force_n: 0.0 };
        let FingerTruth { velocity, finger_force_n } = trigger.truth().unwrap_or(estimated);
        for (name, value) in [
            ("trigger_velocity", velocity),
            ("finger_force", finger_force_n),
            ("trigger_rendered_force", felt.rendered_force[0]),
            ("trigger_safety_force", felt.intervention.safety_force[0]),
            ("trigger_device_force", felt.device_force[0]),
            ("trigger_tripped", f64::from(felt.intervention.tripped.bits())),
        ] {
            take(name, &[value]);
        }
    }

    fn has_mapped_clutch(&self) -> bool {
        self.plant.buttons().is_some() && self.buttons.as_ref().is_some_and(Buttons::has_clutch)
    }
}

impl<P: MasterPlant<N>, const N: usize, R: MasterTurn> Side for MasterSide<P, N, R> {
    type Record = MasterRecord<N, R>;

    fn begin(&mut self, now_ns: u64) {
        self.plant.begin(now_ns);
        self.operator.begin(now_ns);
        if let Some(trigger) = &mut self.trigger {
            trigger.begin(now_ns);
        }
    }

    fn tick_into(&mut self, time: TickTime, record: &mut MasterRecord<N, R>) {
        if self.exchange().has_stalled() {
            self.operator.reset();
            self.button.stalled();
            if let Some(buttons) = &mut self.buttons {
                buttons.stalled();
            }
        }
        let (position, velocity) = self.plant.read(time.now_ns);
        let pressed = self.pressed(time.now_ns);
        let ladder = self.endpoint.exchange.ladder();
        let clutch = match pressed.0 {
            Some(button) => {
                self.operator.reset();
                button
            }
            None => self.operator.at(time.now_ns, ladder.state(), ladder.is_ready()),
        };
        let (mut led_to, mut finger) = (None, None);
        if let Some(trigger) = &mut self.trigger {
            let at = trigger.position(time.now_ns);
            let mut state = GripperState::of_trigger(pressed.1.or(at));
            // A button that leads the gripper overrides the trigger position.
            finger = state.position.filter(|_| pressed.1.is_none());
            if let Some(at) = finger {
                state.position = Some(self.leading.filtered(at, (time.missed + 1) as f64));
            }
            led_to = state.position;
            self.endpoint.exchange.report_gripper(state);
        }
        let reading = MasterReading { position, velocity, rotation: self.plant.rotation(), trigger: finger };
        let tick = self.endpoint.tick(time.clock_ns, time.missed, &reading, clutch);
        if tick.trigger.is_none() {
            // With force feedback the trigger counts its own outliers.
            self.endpoint.exchange.outliers += self.leading.outliers();
        }
        let truth = self.plant.truth();
        let torques = [tick.input.received_torque, tick.input.requested_torque];
        let turn =
            R::of(reading.rotation.as_ref(), self.plant.rotation_truth(), tick.rotation.as_ref(), torques)
                .felt(tick.trigger.as_ref());
        if let Some(of_torque) = &tick.rotation {
            self.plant.write_torque(&of_torque.device_force);
        }
        self.plant.write(&tick.safety.device_force);
        if tick.trigger.is_some() || self.felt.is_some() {
            self.felt = tick.trigger;
        }
        if let (Some(trigger), Some(felt)) = (&mut self.trigger, &tick.trigger) {
            trigger.write(felt.device_force[0]);
        }
        if tick.state.is_coupled() {
            self.plant.engaged();
            if let Some(trigger) = &mut self.trigger {
                trigger.engaged(time.now_ns);
            }
        }
        let snapshot = LadderSnapshot::of(&self.endpoint.exchange);
        *record = MasterRecord::new(time, &reading, truth, led_to, &tick, turn, snapshot);
    }

    fn ranges(&self) -> ScaleRanges {
        *self.endpoint.ranges()
    }

    fn command(&mut self, now_ns: u64, command: OperatorCommand) -> Result<bool, CouplingError> {
        match command {
            OperatorCommand::Press => {
                self.operator.press_again();
                Ok(true)
            }
            OperatorCommand::Release => {
                self.button.must_be_released();
                if self.has_mapped_clutch() {
                    if let Some(buttons) = &mut self.buttons {
                        buttons.open();
                    }
                    return Ok(self.exchange().clutch());
                }
                let was_pressed = self.operator.release_clutch();
                Ok(self.plant.clutch().unwrap_or(was_pressed))
            }
            OperatorCommand::Coupling(_) => {
                let switches = self.endpoint.command(now_ns, command)?;
                if switches {
                    self.command(now_ns, OperatorCommand::Release)?;
                }
                Ok(switches)
            }
            OperatorCommand::Aim(aim) => Ok(self.plant.aim(&aim.with_target(unpadded(&aim.target)))),
            _ => self.endpoint.command(now_ns, command),
        }
    }

    #[inline(always)]
    fn axes(&self) -> usize {
        N
    }

    fn has_button(&self) -> bool {
        // Only the plant knows before the first tick.
        self.has_mapped_clutch() || self.button.is_there() || self.plant.clutch().is_some()
    }

    fn rest(&mut self) {
        if let Some(trigger) = &mut self.trigger {
            trigger.write(0.0);
        }
        self.plant.write_torque(&Axes::zeros());
        self.plant.write(&Axes::zeros());
    }

    fn exchange(&self) -> &Exchange {
        &self.endpoint.exchange
    }

    fn exchange_mut(&mut self) -> &mut Exchange {
        &mut self.endpoint.exchange
    }
}

/// Return whether the arm stands still whatever the command.
pub(crate) fn is_stopped(state: LadderState) -> bool {
    matches!(state, LadderState::Stop | LadderState::Fault)
}

/// Last ladder state, and whether the arm was led.
#[derive(Clone, Copy, Debug)]
pub(crate) struct LeadTransition {
    stood: LadderState,
    was_led: bool,
}

impl Default for LeadTransition {
    fn default() -> Self {
        Self { stood: LadderState::Disengaged, was_led: false }
    }
}

/// Manner in which an arm comes to rest.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Rest {
    Stop,
    Hold,
}

impl Rest {
    /// Brings the arm to rest. Returns where, in m.
    pub(crate) fn of<const N: usize>(self, plant: &mut impl SlavePlant<N>) -> Axes<N> {
        match self {
            Self::Stop => plant.stop(),
            Self::Hold => plant.hold(),
        }
    }
}

impl LeadTransition {
    /// How the arm comes to rest, at the tick at which that begins. Repeated braking would give up a contact bit by
    /// bit.
    #[inline]
    pub(crate) fn step(&mut self, state: LadderState, is_led: bool) -> Option<Rest> {
        let Self { stood, was_led } = std::mem::replace(self, Self { stood: state, was_led: is_led });
        if is_stopped(state) && !is_stopped(stood) {
            Some(Rest::Stop)
        } else if was_led && !is_led {
            Some(Rest::Hold)
        } else {
            None
        }
    }

    /// Brings the arm to rest at that tick. Returns where, in m.
    #[inline]
    pub(crate) fn rest<const N: usize>(
        &mut self,
        plant: &mut impl SlavePlant<N>,
        state: LadderState,
        is_led: bool,
    ) -> Option<Axes<N>> {
        self.step(state, is_led).map(|rest| rest.of(plant))
    }
}

/// The slave side; R is the rotation part of its records.
#[derive(Clone, Debug)]
pub struct SlaveSide<P, const N: usize, R = ()> {
    /// The arm.
    pub plant: P,
    /// Endpoint.
    pub endpoint: SlaveEndpoint<N>,
    led: LeadTransition,
    /// The gripper, if any.
    pub gripper: Option<SlaveGripper>,
    /// Coupled point of the tool; `None` couples the tool point.
    reference_point: Option<ReferencePoint>,
    records: PhantomData<R>,
}

impl<P: SlavePlant<N>, const N: usize> SlaveSide<P, N> {
    /// Create a side with an arm not commanded yet.
    pub fn new(plant: P, endpoint: SlaveEndpoint<N>) -> Self {
        let led = LeadTransition::default();
        Self { plant, endpoint, led, gripper: None, reference_point: None, records: PhantomData }
    }

    /// Make the records contain a rotation.
    #[must_use]
    pub fn recording_rotation(self) -> SlaveSide<P, N, SlaveRotation> {
        let Self { plant, endpoint, led, gripper, reference_point, .. } = self;
        SlaveSide { plant, endpoint, led, gripper, reference_point, records: PhantomData }
    }

    /// Couples another point of the tool than the tool point, for an arm that turns.
    #[must_use]
    pub fn with_reference_point(self, reference_point: Option<ReferencePoint>) -> Self {
        Self { reference_point, ..self }
    }

    /// Add a gripper.
    #[must_use]
    pub fn with_gripper(mut self, gripper: Option<SlaveGripper>) -> Self {
        if gripper.is_some() {
            self.endpoint.exchange.carry_gripper();
        }
        Self { gripper, ..self }
    }
}

impl<P: SlavePlant<N>, const N: usize, R> SlaveSide<P, N, R> {
    /// Pass the command of a tick to the arm: a force, or a motion with position and velocity in m and m/s.
    #[inline(always)] // once a tick
    fn command_plant(&mut self, tick: &SlaveTick<N>, motion: [Axes<N>; 2]) {
        let of_tool = self.reference_point.and_then(|point| point.commanded(tick));
        let [position, velocity] = of_tool.unwrap_or(motion);
        if let Some(exerted) = tick.exerted {
            let point = self.reference_point;
            let of_tool = point.map(|point| point.exerted(exerted, tick.orientation.as_ref()));
            let (force, torque) = of_tool.unwrap_or(exerted);
            let rotation = tick.orientation.map(|orientation| (orientation, tick.angular_velocity));
            return self.plant.exert((&force, &torque), &ToolMotion { position, velocity, rotation });
        }
        if let Some(orientation) = &tick.orientation {
            self.plant.write_rotation(orientation, &tick.angular_velocity);
        }
        self.plant.write(&position, &velocity);
    }
}

impl<P: SlavePlant<N>, const N: usize, R: SlaveTurn> Side for SlaveSide<P, N, R> {
    type Record = SlaveRecord<N, R>;

    fn begin(&mut self, now_ns: u64) {
        self.plant.begin(now_ns);
    }

    #[inline(always)] // once a tick, from few places
    fn tick_into(&mut self, time: TickTime, record: &mut SlaveRecord<N, R>) {
        let brakes = self.plant.braking_speeds();
        self.endpoint.set_braking(self.reference_point.map_or(brakes, |point| point.speeds(brakes)));
        let [position, velocity, environment_force] = self.plant.read(time.now_ns);
        let reading = SlaveReading { position, velocity, environment_force, rotation: self.plant.rotation() };
        let reading = match self.reference_point {
            Some(point) => point.measured(&reading),
            None => reading,
        };
        if let Some(gripper) = &mut self.gripper {
            let measured = gripper.read(time.now_ns);
            if let Some(between) = self.plant.grip(&measured) {
                gripper.set_object(between);
            }
        }
        let mut tick = self.endpoint.tick(time.clock_ns, &reading);
        if let Some(rest) = self.led.rest(&mut self.plant, tick.state, tick.is_led) {
            let orientation = self.plant.rest_orientation();
            let rest = match (self.reference_point, &orientation) {
                (Some(point), Some(orientation)) => point.of_tool(&rest, orientation),
                _ => rest,
            };
            self.endpoint.set_rest(&rest, orientation.as_ref());
            tick.command = self.endpoint.last_command();
            tick.orientation = self.endpoint.last_orientation();
        }
        if let Some(command) = tick.command.filter(|_| !is_stopped(tick.state)) {
            self.command_plant(&tick, [command, tick.command_velocity]);
        }
        if tick.state.is_coupled() {
            self.plant.engaged(time.now_ns);
        }
        if let Some(gripper) = &mut self.gripper {
            let trigger = self.endpoint.exchange.peer_gripper().and_then(|state| state.position);
            gripper.lead(time.now_ns, trigger.filter(|_| tick.state.is_coupled()));
            let state = GripperState::of_gripper(&gripper.state().0, gripper.follows());
            self.endpoint.exchange.report_gripper(state);
        }
        let snapshot = LadderSnapshot::of(&self.endpoint.exchange);
        let touches = self.plant.touches();
        *record = SlaveRecord::new(time, &reading, self.gripper.as_ref(), touches, &tick, snapshot);
    }

    fn ranges(&self) -> ScaleRanges {
        *self.endpoint.ranges()
    }

    fn command(&mut self, now_ns: u64, command: OperatorCommand) -> Result<bool, CouplingError> {
        if let OperatorCommand::Push(push) = command {
            let push = Push { force_n: unpadded(&push.force_n), duration_s: push.duration_s };
            return Ok(self.plant.push(now_ns, &push));
        }
        self.endpoint.command(now_ns, command)
    }

    fn rest(&mut self) {
        self.plant.stop();
    }

    #[inline(always)]
    fn axes(&self) -> usize {
        N
    }

    fn exchange(&self) -> &Exchange {
        &self.endpoint.exchange
    }

    fn exchange_mut(&mut self) -> &mut Exchange {
        &mut self.endpoint.exchange
    }
}

/// Seal the next frame of a side for its session. Without keys returns `None` and numbers no frame.
pub(crate) fn sealed_frame<'a>(
    session: &mut Session,
    time: LinkTime,
    side: &mut (impl Side + ?Sized),
    buffer: &'a mut [u8; MAX_DATAGRAM],
) -> Option<&'a [u8]> {
    if !session.is_open(time.tick_ns) {
        return None;
    }
    let mut frame = [0; MAX_FRAME];
    session.seal(time.tick_ns, side.send(time, &mut frame), buffer).ok()
}
