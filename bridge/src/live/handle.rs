//! Inputs and outputs of a live loop: commands, shared state, sinks of records.

use std::{
    net::SocketAddr,
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU8, AtomicU64, Ordering},
        mpsc,
    },
};

use super::{handshakes::SecurityEvent, newest::Newest, system};
use crate::{
    LinkStatistics,
    command::OperatorCommand,
    coupling::{CouplingError, ScaleRanges},
    ladder::{Diagnosis, FlightRecorder, LadderState},
    recorder::{Recorder, Recording, RecordingReport},
    ring::ring,
    telemetry::Telemetry,
    wire::Role,
};

/// Maximum age in ns of a command, and time after a stall without presses. Signals sent during a suspend arrive after
/// it.
pub(super) const PROMPT_NS: u64 = 250_000_000;

/// Lock-free handle to a loop, for any thread.
#[derive(Clone, Debug)]
pub struct LiveHandle(Arc<Shared>);

impl LiveHandle {
    /// End the loop after its current tick.
    pub fn stop(&self) {
        self.0.stop.store(true, Ordering::Relaxed);
    }

    /// Return whether the loop was stopped, or ended by itself under a driver.
    pub fn is_stopped(&self) -> bool {
        self.0.stop.load(Ordering::Relaxed)
    }

    /// Return whether the loop has ended: no force, no motion, peer notified.
    pub fn is_at_rest(&self) -> bool {
        self.0.at_rest.load(Ordering::Relaxed)
    }

    /// Release the clutch briefly and press it again, for the operator at this side only. Void if not read within
    /// 0.25 s, or within 0.25 s after a stall, when its time is unknown.
    pub fn press_clutch(&self) {
        self.0.press_ns.store(system::now_ns().max(1), Ordering::Relaxed);
    }

    /// Let another master begin after 2 s of silence, for the operator at the slave only. Void as
    /// [`Self::press_clutch`].
    pub fn allow_takeover(&self) {
        self.0.takeover_ns.store(system::now_ns().max(1), Ordering::Relaxed);
    }

    /// Acknowledge a device fault. The driver takes it by [`Self::take_acknowledgement`].
    pub fn acknowledge_device(&self) {
        self.0.acknowledged_ns.store(system::now_ns().max(1), Ordering::Relaxed);
    }

    /// Take an acknowledgement of the last 0.25 s.
    pub fn take_acknowledgement(&self) -> bool {
        // Called each tick: swap only if needed.
        if self.0.acknowledged_ns.load(Ordering::Relaxed) == 0 {
            return false;
        }
        let at_ns = self.0.acknowledged_ns.swap(0, Ordering::Relaxed);
        system::now_ns().saturating_sub(at_ns) <= PROMPT_NS
    }

    /// Number of ineffective presses and reason of the last: [`Self::press_clutch`], or an expired start.
    pub fn ineffective_presses(&self) -> (u64, Option<Ineffective>) {
        let count = self.0.ineffective_presses.load(Ordering::Acquire);
        (count, Ineffective::from_code(self.0.ineffective.load(Ordering::Relaxed)))
    }

    /// True if the start expired as a press and no button can press instead.
    pub fn is_start_void(&self) -> bool {
        self.0.is_start_void.load(Ordering::Relaxed)
    }

    /// State of the ladder.
    pub fn state(&self) -> LadderState {
        LadderState::from_code(self.0.state.load(Ordering::Relaxed)).unwrap_or(LadderState::Disengaged)
    }

    /// Return whether the peer has answered a frame of this side.
    pub fn is_answered(&self) -> bool {
        self.0.answered.load(Ordering::Relaxed)
    }

    /// Periods from the start of the loop to its next tick, skipped ones included.
    pub fn next_period(&self) -> u64 {
        self.0.next_period.load(Ordering::Relaxed)
    }

    /// Number of axes of an aimed model; `None` for any other side.
    pub fn aimed_axes(&self) -> Option<usize> {
        self.0.aimed_axes
    }

    /// Ticks done so far.
    pub fn ticks(&self) -> u64 {
        self.0.ticks.load(Ordering::Relaxed)
    }
}

/// Reading ends of a loop's rings, except records. The loop never waits for them.
#[derive(Debug)]
pub struct LiveWatch {
    handle: LiveHandle,
    events: rtrb::Consumer<SecurityEvent>,
    flights: rtrb::Consumer<FlightRecorder>,
    /// Newest taken.
    flight: Option<Box<FlightRecorder>>,
    diagnoses: rtrb::Consumer<Option<Diagnosis>>,
    /// Newest taken.
    diagnosis: Option<Diagnosis>,
    commands: rtrb::Producer<(u64, OperatorCommand)>,
    /// Until [`Self::port`] hands it out.
    port: Option<ControlPort>,
    address: SocketAddr,
    recording: Option<Recording>,
}

impl LiveWatch {
    /// Handle for threads independent of the rings' reader.
    pub fn handle(&self) -> &LiveHandle {
        &self.handle
    }

    /// Take the events of the session.
    pub fn drain_events(&mut self, mut take: impl FnMut(SecurityEvent)) {
        while let Ok(event) = self.events.pop() {
            take(event);
        }
    }

    /// Take the port for a thread that serves clients; once.
    pub fn port(&mut self) -> Option<ControlPort> {
        self.port.take()
    }

    /// Local address of the socket.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// State of the recording, if any.
    pub fn recording(&self) -> Option<RecordingReport> {
        self.recording.as_ref().map(Recording::report)
    }

    /// Queues a command for the next tick. An acknowledgement is void if not read within 0.25 s.
    ///
    /// # Errors
    ///
    /// A scale out of bounds, given the last known clutch, or a full queue.
    pub fn command(&mut self, command: OperatorCommand) -> Result<(), CommandError> {
        self.handle.0.give(&mut self.commands, command)
    }

    /// Flight recorder as JSON, of the last STOP or FAULT or the end; `None` before.
    pub fn flight(&mut self) -> Option<String> {
        while let Ok(flight) = self.flights.pop() {
            self.flight = Some(Box::new(flight));
        }
        self.flight.as_ref().map(|flight| flight.to_json())
    }

    /// Cause, location and remedy of the sides not being coupled; `None` if nothing is wrong.
    pub fn diagnosis(&mut self) -> Option<&Diagnosis> {
        while let Ok(diagnosis) = self.diagnoses.pop() {
            self.diagnosis = diagnosis;
        }
        self.diagnosis.as_ref()
    }

    /// Take the last report of a finished loop.
    pub fn ended(&mut self, flight: Option<Box<FlightRecorder>>) {
        while self.flights.pop().is_ok() {}
        self.flight = flight.or(self.flight.take());
        while self.diagnoses.pop().is_ok() {}
        if let Some(flight) = &self.flight {
            self.diagnosis = self.handle.0.diagnosis(flight);
        }
    }
}

/// Command port for another thread than that of [`LiveWatch`]. The loop never waits for it.
#[derive(Debug)]
pub struct ControlPort {
    handle: LiveHandle,
    commands: rtrb::Producer<(u64, OperatorCommand)>,
}

impl ControlPort {
    /// Return the handle for requests of other threads.
    pub fn handle(&self) -> &LiveHandle {
        &self.handle
    }

    /// As [`LiveWatch::command`].
    pub fn command(&mut self, command: OperatorCommand) -> Result<(), CommandError> {
        self.handle.0.give(&mut self.commands, command)
    }
}

/// Reason why a command was not queued.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum CommandError {
    /// A scale that is not allowed now.
    #[error(transparent)]
    Refused(#[from] CouplingError),
    /// An aim or a push at a side that is not an aimed model.
    #[error(
        "this side has no aimed hand: it must be a model, of a scene with [operator.aims] that names no file"
    )]
    NotAimed,
    /// An invalid aim.
    #[error(transparent)]
    Aim(#[from] haptether_master::ModelError),
    /// An invalid push.
    #[error(transparent)]
    Push(#[from] haptether_slave::ModelError),
    /// The queue is full.
    #[error("the loop has not done what it was told before: is it running?")]
    Full,
}

/// Receives the kept records of a loop once it has ended.
#[derive(Debug)]
pub struct RecordReader<R> {
    records: mpsc::Receiver<Newest<R>>,
    room: usize,
    handle: LiveHandle,
}

impl<R> RecordReader<R> {
    /// Number of records that the loop keeps by now.
    pub fn kept(&self) -> usize {
        usize::try_from(self.handle.ticks()).map_or(self.room, |ticks| ticks.min(self.room))
    }

    /// Newest records, oldest first. Empty before the end of the loop, and after the first call.
    pub fn take(&self) -> Vec<R> {
        self.records.try_recv().unwrap_or_default().into_records()
    }
}

/// Reason why a press of the clutch did nothing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Ineffective {
    /// Something else must be done first; see the diagnosis.
    NotYet = 1,
    /// The loop was late, so the time of the press is unknown.
    Late,
    /// The device has a button of its own.
    HasButton,
    /// The start, which is a press, had expired.
    OldStart,
}

impl Ineffective {
    /// Text for the operator; `None` if the diagnosis has one.
    pub fn text(self) -> Option<&'static str> {
        match self {
            Self::NotYet => None,
            Self::Late => Some("the loop was late, and nobody knows when it was pressed: press it again"),
            Self::HasButton => Some("this device has a button: press that"),
            Self::OldStart => Some("the start was more than 5 s ago when the loop began: press the clutch"),
        }
    }

    fn from_code(code: u8) -> Option<Self> {
        [Self::NotYet, Self::Late, Self::HasButton, Self::OldStart].into_iter().find(|why| *why as u8 == code)
    }
}

/// State shared by the loop and its watchers.
#[derive(Debug)]
pub(super) struct Shared {
    role: Role,
    ranges: ScaleRanges,
    /// Couplings of the side: bit n for the code n.
    couplings: u16,
    /// Number of axes, if this is the side of an aimed model.
    aimed_axes: Option<usize>,
    /// True if the clutch is open and no coupling remains.
    pub(super) is_open: AtomicBool,
    pub(super) stop: AtomicBool,
    pub(super) state: AtomicU8,
    pub(super) ticks: AtomicU64,
    pub(super) next_period: AtomicU64,
    pub(super) answered: AtomicBool,
    /// Times of the last press and takeover in ns; 0 once taken.
    press_ns: AtomicU64,
    takeover_ns: AtomicU64,
    /// Time of the acknowledgement in ns; 0 once taken.
    acknowledged_ns: AtomicU64,
    /// Number of ineffective presses, and reason of the last.
    ineffective_presses: AtomicU64,
    ineffective: AtomicU8,
    /// The start expired as a press and the device has no button.
    pub(super) is_start_void: AtomicBool,
    /// The device has failed, which ends the loop.
    pub(super) ends: AtomicBool,
    /// No force, no motion, peer notified.
    pub(super) at_rest: AtomicBool,
}

impl Shared {
    pub(super) fn new(role: Role, ranges: ScaleRanges, couplings: u16, aimed_axes: Option<usize>) -> Self {
        Self {
            role,
            ranges,
            couplings,
            aimed_axes,
            is_open: AtomicBool::new(true),
            stop: AtomicBool::default(),
            state: AtomicU8::default(),
            ticks: AtomicU64::default(),
            next_period: AtomicU64::default(),
            answered: AtomicBool::default(),
            press_ns: AtomicU64::default(),
            takeover_ns: AtomicU64::default(),
            acknowledged_ns: AtomicU64::default(),
            ineffective_presses: AtomicU64::default(),
            ineffective: AtomicU8::default(),
            is_start_void: AtomicBool::default(),
            ends: AtomicBool::default(),
            at_rest: AtomicBool::default(),
        }
    }

    /// Queues a command. Errors go to the caller; the side checks again.
    fn give(
        &self,
        commands: &mut rtrb::Producer<(u64, OperatorCommand)>,
        command: OperatorCommand,
    ) -> Result<(), CommandError> {
        command.check_scale(self.role, &self.ranges, self.is_open.load(Ordering::Relaxed))?;
        match command {
            OperatorCommand::Aim(_) | OperatorCommand::Push(_) if self.aimed_axes.is_none() => {
                return Err(CommandError::NotAimed);
            }
            OperatorCommand::Coupling(kind) if self.couplings >> kind.code() & 1 == 0 => {
                return Err(CouplingError::NoAlternative(kind.name()).into());
            }
            OperatorCommand::Aim(aim) => aim.check()?,
            OperatorCommand::Push(push) => push.check()?,
            _ => {}
        }
        commands.push((system::now_ns(), command)).map_err(|_| CommandError::Full)
    }

    /// Return whether the loop was stopped or memory is exhausted.
    pub(super) fn must_end(&self) -> bool {
        self.stop.load(Ordering::Relaxed) || system::is_exhausted()
    }

    /// Diagnosis of a recorder, marked if it ends the loop.
    pub(super) fn diagnosis(&self, flight: &FlightRecorder) -> Option<Diagnosis> {
        let ends = self.ends.load(Ordering::Relaxed);
        flight.diagnosis().map(|diagnosis| Diagnosis { ends, ..*diagnosis })
    }

    pub(super) fn reject_press(&self, why: Ineffective) {
        self.ineffective.store(why as u8, Ordering::Relaxed);
        self.ineffective_presses.fetch_add(1, Ordering::Release);
    }
}

/// Commands that wait for the loop, each with its time in ns.
pub(super) struct CommandQueue {
    started_ns: Option<u64>,
    given: rtrb::Consumer<(u64, OperatorCommand)>,
    /// From the control port.
    controlled: rtrb::Consumer<(u64, OperatorCommand)>,
}

impl CommandQueue {
    /// The next command: the start, those of handles, of the watch, of the control port.
    pub(super) fn next(&mut self, shared: &Shared) -> Option<(u64, OperatorCommand)> {
        if let Some(started_ns) = self.started_ns.take() {
            return Some((started_ns, OperatorCommand::Start));
        }
        for (at_ns, command) in
            [(&shared.press_ns, OperatorCommand::Press), (&shared.takeover_ns, OperatorCommand::Takeover)]
        {
            let at_ns = at_ns.swap(0, Ordering::Relaxed);
            if at_ns != 0 {
                return Some((at_ns, command));
            }
        }
        self.given.pop().or_else(|_| self.controlled.pop()).ok()
    }
}

/// Receivers of every record of a loop; none by default.
#[derive(Debug)]
pub struct RecordOutputs<R> {
    /// For its [`RecordReader`], at the end.
    pub newest: Newest<R>,
    /// Recording to a file.
    pub recorder: Option<Recorder<R>>,
    /// Telemetry to readers.
    pub telemetry: Option<Telemetry<R>>,
}

impl<R> Default for RecordOutputs<R> {
    fn default() -> Self {
        Self { newest: Newest::default(), recorder: None, telemetry: None }
    }
}

/// Sinks of records; the loop never waits for them.
#[derive(Debug)]
pub(super) struct RecordSinks<R> {
    to_reader: mpsc::SyncSender<Newest<R>>,
    outputs: RecordOutputs<R>,
}

impl<R: Copy> RecordSinks<R> {
    /// Starts at the loop's time 0, on the monotonic clock.
    pub(super) fn start(&self, now_ns: u64) {
        if let Some(recorder) = &self.outputs.recorder {
            recorder.start(now_ns);
        }
    }

    /// Pass a record to all sinks. Returns whether all earlier ones are kept.
    pub(super) fn push(&mut self, record: R) -> bool {
        if let Some(recorder) = &mut self.outputs.recorder {
            recorder.take(record);
        }
        if let Some(telemetry) = &mut self.outputs.telemetry {
            telemetry.take(record);
        }
        self.outputs.newest.push(record)
    }

    pub(super) fn count_link(&self, link: &LinkStatistics) {
        if let Some(telemetry) = &self.outputs.telemetry {
            telemetry.count_link(link);
        }
    }

    /// Passes on why the sides are not coupled, since `time_ns` after the start or shortly before. `None` ends a
    /// cause, which is not recorded.
    pub(super) fn note(&mut self, time_ns: u64, diagnosis: Option<&Diagnosis>) {
        if let (Some(recorder), Some(diagnosis)) = (&mut self.outputs.recorder, diagnosis) {
            recorder.note(time_ns, diagnosis);
        }
        if let Some(telemetry) = &mut self.outputs.telemetry {
            telemetry.note(time_ns, diagnosis);
        }
    }

    /// End telemetry and recording.
    pub(super) fn end(mut self) -> Option<RecordingReport> {
        if let Some(telemetry) = self.outputs.telemetry.take() {
            telemetry.end();
        }
        self.abandon()
    }

    /// Close both if no loop began.
    pub(super) fn abandon(self) -> Option<RecordingReport> {
        let RecordOutputs { newest, recorder, telemetry } = self.outputs;
        drop(telemetry);
        // The reader may be gone.
        let _ = self.to_reader.try_send(newest);
        recorder.map(Recorder::end)
    }
}

/// The loop's ends of its rings.
pub(super) struct LoopChannels {
    pub(super) events: rtrb::Producer<SecurityEvent>,
    pub(super) flights: rtrb::Producer<FlightRecorder>,
    pub(super) diagnoses: rtrb::Producer<Option<Diagnosis>>,
    pub(super) commands: CommandQueue,
}

/// Maximum number of unread events; further ones are dropped.
const MAX_EVENTS: usize = 64;
/// Maximum number of unread flight recorders.
const MAX_FLIGHTS: usize = 2;
/// Maximum number of unread diagnoses; the loop retries with the newest.
const MAX_DIAGNOSES: usize = 16;
/// Maximum number of queued commands, and of commands per tick.
pub(super) const MAX_COMMANDS: usize = 16;

/// Create the rings of a loop started by the operator at `started_ns`.
pub(super) fn channels<R>(
    started_ns: u64,
    address: SocketAddr,
    outputs: RecordOutputs<R>,
    shared: Arc<Shared>,
) -> (LoopChannels, RecordSinks<R>, LiveWatch, RecordReader<R>) {
    let recording = outputs.recorder.as_ref().map(Recorder::recording);
    let (channels, watch) = rings(started_ns, address, recording, shared);
    let (to_reader, records) = mpsc::sync_channel(1);
    let reader = RecordReader { records, room: outputs.newest.room(), handle: watch.handle().clone() };
    (channels, RecordSinks { to_reader, outputs }, watch, reader)
}

/// Create the rings except records; compiled once.
fn rings(
    started_ns: u64,
    address: SocketAddr,
    recording: Option<Recording>,
    shared: Arc<Shared>,
) -> (LoopChannels, LiveWatch) {
    let (to_events, events) = ring(MAX_EVENTS);
    let (to_flights, flights) = ring(MAX_FLIGHTS);
    let (to_diagnoses, diagnoses) = ring(MAX_DIAGNOSES);
    let (commands, given) = rtrb::RingBuffer::new(MAX_COMMANDS);
    let (from_port, controlled) = rtrb::RingBuffer::new(MAX_COMMANDS);
    let handle = LiveHandle(shared);
    let watch = LiveWatch {
        port: Some(ControlPort { handle: handle.clone(), commands: from_port }),
        handle,
        events,
        flights,
        flight: None,
        diagnoses,
        diagnosis: None,
        commands,
        address,
        recording,
    };
    let channels = LoopChannels {
        events: to_events,
        flights: to_flights,
        diagnoses: to_diagnoses,
        commands: CommandQueue { started_ns: Some(started_ns), given, controlled },
    };
    (channels, watch)
}
