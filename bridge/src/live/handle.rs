//! What leads to and from a live loop: commands, what it shares with those who watch it, and where its records go.

use std::{
    net::SocketAddr,
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU8, AtomicU64, Ordering},
        mpsc,
    },
};

use super::{handshakes::SecurityEvent, live_loop::PROMPT_NS, newest::Newest, system};
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

/// Commands and shows a loop from any thread, without a lock.
#[derive(Clone, Debug)]
pub struct LiveHandle(Arc<Shared>);

impl LiveHandle {
    /// Ends the loop after its current tick.
    pub fn stop(&self) {
        self.0.stop.store(true, Ordering::Relaxed);
    }

    /// Whether the loop was stopped, or has ended by itself where a driver steps it.
    pub fn is_stopped(&self) -> bool {
        self.0.stop.load(Ordering::Relaxed)
    }

    /// Whether the loop has ended: no force, no motion, and the peer has been sent the end.
    pub fn is_at_rest(&self) -> bool {
        self.0.at_rest.load(Ordering::Relaxed)
    }

    /// Releases the clutch for a moment and presses it again, on command of the operator at this side only. Void if the
    /// loop does not read it within 0.25 s, or was late within 0.25 s before: its time is not known then.
    pub fn press_clutch(&self) {
        self.0.press_ns.store(system::now_ns().max(1), Ordering::Relaxed);
    }

    /// Lets another master begin, if the one before has been silent for 2 s; on command of the operator at the slave
    /// only. Void as [`Self::press_clutch`].
    pub fn allow_takeover(&self) {
        self.0.takeover_ns.store(system::now_ns().max(1), Ordering::Relaxed);
    }

    /// The operator says that the fault of a device that a driver steps is mended: the driver takes it, by
    /// [`Self::take_acknowledgement`].
    pub fn acknowledge_device(&self) {
        self.0.acknowledged_ns.store(system::now_ns().max(1), Ordering::Relaxed);
    }

    /// Whether [`Self::acknowledge_device`] was called since the last time, and within 0.25 s.
    pub fn take_acknowledgement(&self) -> bool {
        // Of each tick: the swap is for those in which there is one.
        if self.0.acknowledged_ns.load(Ordering::Relaxed) == 0 {
            return false;
        }
        let at_ns = self.0.acknowledged_ns.swap(0, Ordering::Relaxed);
        system::now_ns().saturating_sub(at_ns) <= PROMPT_NS
    }

    /// How often a press did nothing, and why the last one did not: [`Self::press_clutch`], or a start that was too
    /// old.
    pub fn ineffective_presses(&self) -> (u64, Option<Ineffective>) {
        let count = self.0.ineffective_presses.load(Ordering::Acquire);
        (count, Ineffective::from_code(self.0.ineffective.load(Ordering::Relaxed)))
    }

    /// True if the start was to press the clutch, was too long ago, and no button of the device can press instead.
    pub fn is_start_void(&self) -> bool {
        self.0.is_start_void.load(Ordering::Relaxed)
    }

    /// Where the ladder stands.
    pub fn state(&self) -> LadderState {
        LadderState::from_code(self.0.state.load(Ordering::Relaxed)).unwrap_or(LadderState::Disengaged)
    }

    /// Whether the peer has answered a frame of this side.
    pub fn is_answered(&self) -> bool {
        self.0.answered.load(Ordering::Relaxed)
    }

    /// Ticks done so far.
    pub fn ticks(&self) -> u64 {
        self.0.ticks.load(Ordering::Relaxed)
    }
}

/// The outer ends of a loop's rings but that of its records; the loop never waits for them.
#[derive(Debug)]
pub struct LiveWatch {
    handle: LiveHandle,
    events: rtrb::Consumer<SecurityEvent>,
    flights: rtrb::Consumer<FlightRecorder>,
    /// The newest that was taken.
    flight: Option<Box<FlightRecorder>>,
    diagnoses: rtrb::Consumer<Option<Diagnosis>>,
    /// The newest that was taken.
    diagnosis: Option<Diagnosis>,
    commands: rtrb::Producer<(u64, OperatorCommand)>,
    /// Until [`Self::port`] has handed it out.
    port: Option<ControlPort>,
    address: SocketAddr,
    recording: Option<Recording>,
}

impl LiveWatch {
    /// For threads that must not wait for whoever reads the rings.
    pub fn handle(&self) -> &LiveHandle {
        &self.handle
    }

    /// Takes what happened to the session.
    pub fn drain_events(&mut self, mut take: impl FnMut(SecurityEvent)) {
        while let Ok(event) = self.events.pop() {
            take(event);
        }
    }

    /// The way in for a thread that serves others; none a second time.
    pub fn port(&mut self) -> Option<ControlPort> {
        self.port.take()
    }

    /// Where the socket listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// How the recording stands; none if there is none.
    pub fn recording(&self) -> Option<RecordingReport> {
        self.recording.as_ref().map(Recording::report)
    }

    /// Hands a command to the loop, which carries it out at its next tick. An acknowledgement is void if the loop does not
    /// read it within 0.25 s.
    ///
    /// # Errors
    ///
    /// A scale out of its bounds, as the clutch was at the last tick, and too many commands that wait.
    pub fn command(&mut self, command: OperatorCommand) -> Result<(), CommandError> {
        self.handle.0.give(&mut self.commands, command)
    }

    /// The last states and commands as JSON, as of the last STOP or FAULT, or of the end; none before.
    pub fn flight(&mut self) -> Option<String> {
        while let Ok(flight) = self.flights.pop() {
            self.flight = Some(Box::new(flight));
        }
        self.flight.as_ref().map(|flight| flight.to_json())
    }

    /// Why the two sides are not coupled, where it happened and what to do; none where nothing is wrong.
    pub fn diagnosis(&mut self) -> Option<&Diagnosis> {
        while let Ok(diagnosis) = self.diagnoses.pop() {
            self.diagnosis = diagnosis;
        }
        self.diagnosis.as_ref()
    }

    /// The loop is over: what it reported last counts.
    pub fn ended(&mut self, flight: Option<Box<FlightRecorder>>) {
        while self.flights.pop().is_ok() {}
        self.flight = flight.or(self.flight.take());
        while self.diagnoses.pop().is_ok() {}
        if let Some(flight) = &self.flight {
            self.diagnosis = self.handle.0.diagnosis(flight);
        }
    }
}

/// Commands a loop from one thread, beside a [`LiveWatch`] on another; the loop never waits for it.
#[derive(Debug)]
pub struct ControlPort {
    handle: LiveHandle,
    commands: rtrb::Producer<(u64, OperatorCommand)>,
}

impl ControlPort {
    /// Stops, presses, and says where the loop stands.
    pub fn handle(&self) -> &LiveHandle {
        &self.handle
    }

    /// As [`LiveWatch::command`].
    pub fn command(&mut self, command: OperatorCommand) -> Result<(), CommandError> {
        self.handle.0.give(&mut self.commands, command)
    }
}

/// Why a command was not handed to a loop.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum CommandError {
    /// A scale that may not be had now.
    #[error(transparent)]
    Refused(#[from] CouplingError),
    /// Too many commands wait.
    #[error("the loop has not done what it was told before: is it running?")]
    Full,
}

/// Gets the records that a loop has kept, once it has ended.
#[derive(Debug)]
pub struct RecordReader<R> {
    records: mpsc::Receiver<Newest<R>>,
    room: usize,
    handle: LiveHandle,
}

impl<R> RecordReader<R> {
    /// How many records the loop keeps by now.
    pub fn kept(&self) -> usize {
        usize::try_from(self.handle.ticks()).map_or(self.room, |ticks| ticks.min(self.room))
    }

    /// The newest records, the oldest of them first; none before the loop has ended, and none a second time.
    pub fn take(&self) -> Vec<R> {
        self.records.try_recv().unwrap_or_default().into_records()
    }
}

/// Why a press of the clutch did nothing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Ineffective {
    /// Something else must be done before; the diagnosis says what.
    NotYet = 1,
    /// The loop was late: nobody knows when it was done.
    Late,
    /// The device has a button of its own.
    HasButton,
    /// The start, which is a press, was too long ago when the loop began.
    OldStart,
}

impl Ineffective {
    /// As the operator reads it; none where the diagnosis has a text.
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

/// What the loop and those who watch it both see.
#[derive(Debug)]
pub(super) struct Shared {
    role: Role,
    /// Bounds of the scales of the side.
    ranges: ScaleRanges,
    /// Whether its clutch is open, and nothing is left of a coupling.
    pub(super) is_open: AtomicBool,
    pub(super) stop: AtomicBool,
    pub(super) state: AtomicU8,
    pub(super) ticks: AtomicU64,
    /// The peer has answered a frame.
    pub(super) answered: AtomicBool,
    /// When a press and a takeover were commanded last, in ns; 0 where not since the loop looked.
    press_ns: AtomicU64,
    takeover_ns: AtomicU64,
    /// When the fault of a driver's device was acknowledged, in ns; 0 where it was taken.
    acknowledged_ns: AtomicU64,
    /// Presses that did nothing, and why the last of them did not.
    ineffective_presses: AtomicU64,
    ineffective: AtomicU8,
    /// The start was too old, and no button of the device can press instead.
    pub(super) is_start_void: AtomicBool,
    /// The device has failed, and the loop ends by that.
    pub(super) ends: AtomicBool,
    /// No force, no motion, and the peer has been sent the end.
    pub(super) at_rest: AtomicBool,
}

impl Shared {
    pub(super) fn new(role: Role, ranges: ScaleRanges) -> Self {
        Self {
            role,
            ranges,
            is_open: AtomicBool::new(true),
            stop: AtomicBool::default(),
            state: AtomicU8::default(),
            ticks: AtomicU64::default(),
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

    /// Hands a command to the loop. Whoever commands is answered here; the side checks it once more when it takes it.
    fn give(
        &self,
        commands: &mut rtrb::Producer<(u64, OperatorCommand)>,
        command: OperatorCommand,
    ) -> Result<(), CommandError> {
        self.ranges.check(self.role, &command, self.is_open.load(Ordering::Relaxed))?;
        commands.push((system::now_ns(), command)).map_err(|_| CommandError::Full)
    }

    /// Whether the loop must end: it was stopped, or the process has no memory left.
    pub(super) fn must_end(&self) -> bool {
        self.stop.load(Ordering::Relaxed) || system::is_exhausted()
    }

    /// Why the two sides are not coupled, as the recorder of a side has it.
    pub(super) fn diagnosis(&self, flight: &FlightRecorder) -> Option<Diagnosis> {
        let ends = self.ends.load(Ordering::Relaxed);
        flight.diagnosis().map(|diagnosis| Diagnosis { ends, ..*diagnosis })
    }

    /// A press did nothing.
    pub(super) fn reject_press(&self, why: Ineffective) {
        self.ineffective.store(why as u8, Ordering::Relaxed);
        self.ineffective_presses.fetch_add(1, Ordering::Release);
    }
}

/// The commands that wait for the loop, each with the time in ns at which it was given.
pub(super) struct CommandQueue {
    started_ns: Option<u64>,
    given: rtrb::Consumer<(u64, OperatorCommand)>,
    /// Of the control port.
    controlled: rtrb::Consumer<(u64, OperatorCommand)>,
}

impl CommandQueue {
    /// The next one: the start, what any thread has commanded through its handle, then those of the watch and of
    /// the control port, each in their order.
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

/// Who gets every record of a loop; nobody by default.
#[derive(Debug)]
pub struct RecordOutputs<R> {
    /// Its [`RecordReader`], at the end.
    pub newest: Newest<R>,
    /// A file.
    pub recorder: Option<Recorder<R>>,
    /// Whoever looks on.
    pub telemetry: Option<Telemetry<R>>,
}

impl<R> Default for RecordOutputs<R> {
    fn default() -> Self {
        Self { newest: Newest::default(), recorder: None, telemetry: None }
    }
}

/// Where the records of a loop go; nobody there is ever waited for.
#[derive(Debug)]
pub(super) struct RecordSinks<R> {
    to_reader: mpsc::SyncSender<Newest<R>>,
    outputs: RecordOutputs<R>,
}

impl<R: Copy> RecordSinks<R> {
    /// The loop's time 0, on the monotonic clock.
    pub(super) fn start(&self, now_ns: u64) {
        if let Some(recorder) = &self.outputs.recorder {
            recorder.start(now_ns);
        }
    }

    /// Hands a record to all; returns whether all before it are still kept.
    pub(super) fn push(&mut self, record: R) -> bool {
        if let Some(recorder) = &mut self.outputs.recorder {
            recorder.take(record);
        }
        if let Some(telemetry) = &mut self.outputs.telemetry {
            telemetry.take(record);
        }
        self.outputs.newest.push(record)
    }

    /// Hands on what the link has counted.
    pub(super) fn count_link(&self, link: &LinkStatistics) {
        if let Some(telemetry) = &self.outputs.telemetry {
            telemetry.count_link(link);
        }
    }

    /// Hands on why the two sides are not coupled, since `time_ns` after the start or shortly before; none where that
    /// is over, which a recording does not say.
    pub(super) fn note(&mut self, time_ns: u64, diagnosis: Option<&Diagnosis>) {
        if let (Some(recorder), Some(diagnosis)) = (&mut self.outputs.recorder, diagnosis) {
            recorder.note(time_ns, diagnosis);
        }
        if let Some(telemetry) = &mut self.outputs.telemetry {
            telemetry.note(time_ns, diagnosis);
        }
    }

    /// Ends the telemetry and the recording of a loop.
    pub(super) fn end(mut self) -> Option<RecordingReport> {
        if let Some(telemetry) = self.outputs.telemetry.take() {
            telemetry.end();
        }
        self.abandon()
    }

    /// Closes both where no loop began.
    pub(super) fn abandon(self) -> Option<RecordingReport> {
        let RecordOutputs { newest, recorder, telemetry } = self.outputs;
        drop(telemetry);
        // Nobody may be there any more.
        let _ = self.to_reader.try_send(newest);
        recorder.map(Recorder::end)
    }
}

/// The loop's ends of what leads to and from it.
pub(super) struct LoopChannels {
    pub(super) events: rtrb::Producer<SecurityEvent>,
    pub(super) flights: rtrb::Producer<FlightRecorder>,
    pub(super) diagnoses: rtrb::Producer<Option<Diagnosis>>,
    pub(super) commands: CommandQueue,
}

/// Events that wait for a reader; further ones are dropped.
const MAX_EVENTS: usize = 64;
/// States and commands as of a STOP or FAULT that wait for a reader.
const MAX_FLIGHTS: usize = 2;
/// Diagnoses that wait for a reader; the loop keeps the newest until there is room.
const MAX_DIAGNOSES: usize = 16;
/// Commands that may wait for the loop, and that one tick takes.
pub(super) const MAX_COMMANDS: usize = 16;

/// Makes the rings of a loop that the operator started at `started_ns`.
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

/// The same without the records; compiled once for all types of records.
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
