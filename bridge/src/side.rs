//! One side of the bridge, plant and endpoint together: what both runners call at each tick.

use crate::{
    act::OperatorCommand,
    coupling::{CouplingError, FrameMap},
    endpoint::{MasterEndpoint, SlaveEndpoint},
    fault_text::FaultText,
    ladder::{Button, Clutch, ClutchError, FlightRecorder, LadderState, SimulatedOperator},
    link::{LinkStatistics, RejectReason},
    path::PathReport,
    plant::{MasterPlant, SlavePlant},
    record::{LadderSnapshot, MasterRecord, SlaveRecord},
    wire::{MAX_FRAME, frame_length},
};

/// When a tick is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct TickTime {
    /// When the run began, in ns.
    pub start_ns: u64,
    /// True time of the tick in ns, which the plant lives by.
    pub now_ns: u64,
    /// The tick's deadline in ns on the endpoint's own clock; live, both are the same.
    pub clock_ns: u64,
    /// How late the loop woke, in ns; in virtual time only where the endpoint's clock is set.
    pub overshoot_ns: u64,
    /// Ticks left out since the last one.
    pub missed: u64,
}

impl TickTime {
    /// A tick on time, on a clock that is right.
    pub fn at(now_ns: u64) -> Self {
        Self { now_ns, clock_ns: now_ns, ..Self::default() }
    }
}

/// What a side has counted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SideCounts {
    /// Of the link.
    pub link: LinkStatistics,
    /// How often the ladder went to HOLD.
    pub holds: u64,
    /// Ticks at which a bound acted on the remote command; a master has none.
    pub limited: u64,
}

/// One side: `receive` what has arrived, `tick`, `send`; times are on the endpoint's own clock where not said.
pub trait Side {
    /// What a tick leaves behind.
    type Record: Copy + Send + 'static;

    /// Bytes of each frame, its own and the peer's.
    const FRAME_LENGTH: usize;

    /// True time begins at `now_ns`; called once, before the first tick.
    fn begin(&mut self, now_ns: u64);

    /// Until the next call it is `late_ns` later than the tick's time when datagrams are received and sent: the loop
    /// woke late.
    fn late(&mut self, late_ns: u64);

    /// Takes a datagram that arrived by `now_ns`; a refused one is counted and otherwise forgotten.
    fn receive(&mut self, now_ns: u64, datagram: &[u8]) -> Result<(), RejectReason>;

    /// Reads the plant, decides, writes the plant.
    fn tick(&mut self, time: TickTime) -> Self::Record;

    /// Writes the frame of this tick.
    fn send<'a>(&mut self, now_ns: u64, buffer: &'a mut [u8; MAX_FRAME]) -> &'a [u8];

    /// The loop was late by more than the ladder allows, until `now_ns`.
    fn stalled(&mut self, now_ns: u64);

    /// The plant has failed, or says so, since the last tick; a model does not. The next tick counts it, after all acts.
    fn device_failed(&mut self) {}

    /// The driver's words on a failure that the next tick counts.
    fn describe_failure(&mut self, _text: &FaultText) {}

    /// This side ends: from here on its frames say so.
    fn end(&mut self) {}

    /// The peer has ended its session.
    fn peer_ended(&mut self) {}

    /// Leaves the plant without force or motion.
    fn rest(&mut self);

    /// Where the ladder stands.
    fn state(&self) -> LadderState;

    /// Counts of the run.
    fn counts(&self) -> SideCounts;

    /// What is known of the way to the peer at `now_ns`: for the end of a run, as it walks the last 2048 sequences. Empty
    /// of a side that measures none.
    fn path(&self, _now_ns: u64) -> PathReport {
        PathReport::default()
    }

    /// The last states and commands.
    fn flight(&self) -> &FlightRecorder;

    /// Whether the device has shown a button.
    fn has_button(&self) -> bool {
        false
    }

    /// A person lets go of the clutch and presses it again; nothing at a side without one, or whose device has a button.
    fn press_again(&mut self) {}

    /// The start was too long ago to be a press of the clutch; whether it would have been one. After `begin`.
    fn release_clutch(&mut self) -> bool {
        false
    }

    /// A person at this side acts, at `now_ns`. What the other side has is passed over; numbers that cannot be change
    /// nothing.
    fn act(&mut self, _now_ns: u64, _act: OperatorCommand) -> Result<(), CouplingError> {
        Ok(())
    }
}

/// The side of the hand.
#[derive(Clone, Debug)]
pub struct MasterSide<P, const N: usize> {
    /// The device.
    pub plant: P,
    /// What decides.
    pub endpoint: MasterEndpoint<N>,
    /// Who presses the clutch of a device that has no button.
    pub person: SimulatedOperator,
    button: Button,
}

impl<P: MasterPlant<N>, const N: usize> MasterSide<P, N> {
    /// A side whose clutch is worked by a person.
    pub fn new(plant: P, endpoint: MasterEndpoint<N>, clutch: Clutch) -> Result<Self, ClutchError> {
        Ok(Self { plant, endpoint, person: SimulatedOperator::new(clutch)?, button: Button::default() })
    }
}

impl<P: MasterPlant<N>, const N: usize> Side for MasterSide<P, N> {
    type Record = MasterRecord<N>;
    const FRAME_LENGTH: usize = frame_length(N);

    fn begin(&mut self, now_ns: u64) {
        self.plant.begin(now_ns);
        self.person.begin(now_ns);
    }

    fn late(&mut self, late_ns: u64) {
        self.endpoint.late(late_ns);
    }

    fn receive(&mut self, now_ns: u64, datagram: &[u8]) -> Result<(), RejectReason> {
        self.endpoint.receive(now_ns, datagram)
    }

    fn tick(&mut self, time: TickTime) -> MasterRecord<N> {
        let (position, velocity) = self.plant.read(time.now_ns);
        let exchange = self.endpoint.exchange();
        let clutch = match self.button.at(time.now_ns, self.plant.clutch()) {
            Some(button) => {
                self.person.forget();
                button
            }
            None => self.person.at(time.now_ns, exchange.state(), exchange.is_ready()),
        };
        let tick = self.endpoint.tick(time.clock_ns, time.missed, &position, velocity.as_ref(), clutch);
        let truth = self.plant.truth();
        self.plant.write(&tick.safety.device_force);
        if tick.state.is_coupled() {
            self.plant.engaged();
        }
        let told = LadderSnapshot::of(self.endpoint.exchange());
        MasterRecord::new(time, &position, truth, &tick, told)
    }

    fn send<'a>(&mut self, now_ns: u64, buffer: &'a mut [u8; MAX_FRAME]) -> &'a [u8] {
        self.endpoint.exchange_mut().send(now_ns, buffer)
    }

    fn stalled(&mut self, now_ns: u64) {
        self.endpoint.stalled(now_ns);
        self.person.forget();
        self.button.stalled();
    }

    fn device_failed(&mut self) {
        self.endpoint.device_failed();
    }

    fn describe_failure(&mut self, text: &FaultText) {
        self.endpoint.describe_failure(text);
    }

    fn end(&mut self) {
        self.endpoint.end();
    }

    fn peer_ended(&mut self) {
        self.endpoint.peer_ended();
    }

    fn rest(&mut self) {
        self.plant.write(&haptether_safety::Axes::zeros());
    }

    fn state(&self) -> LadderState {
        self.endpoint.exchange().state()
    }

    fn counts(&self) -> SideCounts {
        let (link, holds) = self.endpoint.exchange().counts();
        SideCounts { link, holds, limited: 0 }
    }

    fn path(&self, now_ns: u64) -> PathReport {
        self.endpoint.exchange().path_report(now_ns)
    }

    fn flight(&self) -> &FlightRecorder {
        self.endpoint.exchange().flight()
    }

    fn press_again(&mut self) {
        self.person.press_again();
    }

    fn has_button(&self) -> bool {
        // Before the first tick the plant alone knows.
        self.button.is_there() || self.plant.clutch().is_some()
    }

    fn release_clutch(&mut self) -> bool {
        self.button.must_be_released();
        let was_pressed = self.person.release_clutch();
        self.plant.clutch().unwrap_or(was_pressed)
    }

    fn act(&mut self, now_ns: u64, act: OperatorCommand) -> Result<(), CouplingError> {
        match act {
            OperatorCommand::Acknowledge => self.endpoint.acknowledge(now_ns),
            OperatorCommand::ForceScale(scale) => self.endpoint.set_force_scale(scale)?,
            OperatorCommand::Frame { quat_wxyz, locked } => {
                self.endpoint.set_map(FrameMap::turned(quat_wxyz, &locked)?)
            }
            OperatorCommand::PositionScale(_) => {}
        }
        Ok(())
    }
}

/// The side of the robot.
#[derive(Clone, Debug)]
pub struct SlaveSide<P, const N: usize> {
    /// The arm.
    pub plant: P,
    /// What decides.
    pub endpoint: SlaveEndpoint<N>,
    /// Where the ladder stood at the last tick.
    stood: LadderState,
}

impl<P: SlavePlant<N>, const N: usize> SlaveSide<P, N> {
    /// A side whose arm has not been commanded yet.
    pub fn new(plant: P, endpoint: SlaveEndpoint<N>) -> Self {
        Self { plant, endpoint, stood: LadderState::Disengaged }
    }
}

impl<P: SlavePlant<N>, const N: usize> Side for SlaveSide<P, N> {
    type Record = SlaveRecord<N>;
    const FRAME_LENGTH: usize = frame_length(N);

    fn begin(&mut self, now_ns: u64) {
        self.plant.begin(now_ns);
    }

    fn late(&mut self, late_ns: u64) {
        self.endpoint.late(late_ns);
    }

    fn receive(&mut self, now_ns: u64, datagram: &[u8]) -> Result<(), RejectReason> {
        self.endpoint.receive(now_ns, datagram)
    }

    fn tick(&mut self, time: TickTime) -> SlaveRecord<N> {
        let sample = self.plant.read(time.now_ns);
        let mut tick = self.endpoint.tick(time.clock_ns, &sample[0], &sample[1], &sample[2]);
        let stood = std::mem::replace(&mut self.stood, tick.state);
        let is_stopped = |state| matches!(state, LadderState::Stop | LadderState::Fault);
        // Once each: whoever brakes again and again would let go of what the arm leans on, bit by bit.
        let rest = if is_stopped(tick.state) && !is_stopped(stood) {
            Some(self.plant.stop())
        } else if stood.is_coupled() && !tick.state.is_coupled() {
            Some(self.plant.hold())
        } else {
            None
        };
        if let Some(rest) = rest {
            self.endpoint.rests(&rest);
            tick.command = self.endpoint.command();
        }
        if let Some(command) = tick.command.filter(|_| !is_stopped(tick.state)) {
            self.plant.write(&command, &tick.command_velocity);
        }
        if tick.state.is_coupled() {
            self.plant.engaged(time.now_ns);
        }
        SlaveRecord::new(time, &sample, &tick, LadderSnapshot::of(self.endpoint.exchange()))
    }

    fn send<'a>(&mut self, now_ns: u64, buffer: &'a mut [u8; MAX_FRAME]) -> &'a [u8] {
        self.endpoint.exchange_mut().send(now_ns, buffer)
    }

    fn stalled(&mut self, now_ns: u64) {
        self.endpoint.stalled(now_ns);
    }

    fn device_failed(&mut self) {
        self.endpoint.device_failed();
    }

    fn describe_failure(&mut self, text: &FaultText) {
        self.endpoint.describe_failure(text);
    }

    fn end(&mut self) {
        self.endpoint.end();
    }

    fn peer_ended(&mut self) {
        self.endpoint.peer_ended();
    }

    fn rest(&mut self) {
        self.plant.stop();
    }

    fn state(&self) -> LadderState {
        self.endpoint.exchange().state()
    }

    fn counts(&self) -> SideCounts {
        let (link, holds) = self.endpoint.exchange().counts();
        SideCounts { link, holds, limited: self.endpoint.limited_ticks() }
    }

    fn path(&self, now_ns: u64) -> PathReport {
        self.endpoint.exchange().path_report(now_ns)
    }

    fn flight(&self) -> &FlightRecorder {
        self.endpoint.exchange().flight()
    }

    fn act(&mut self, now_ns: u64, act: OperatorCommand) -> Result<(), CouplingError> {
        match act {
            OperatorCommand::Acknowledge => self.endpoint.acknowledge(now_ns),
            OperatorCommand::PositionScale(scale) => self.endpoint.set_position_scale(scale)?,
            OperatorCommand::Frame { quat_wxyz, locked } => {
                self.endpoint.set_map(FrameMap::turned(quat_wxyz, &locked)?)
            }
            OperatorCommand::ForceScale(_) => {}
        }
        Ok(())
    }
}
