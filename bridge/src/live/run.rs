//! The live loop of one side.

use std::{
    io,
    ops::{Deref, DerefMut},
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU8, AtomicU64, Ordering},
        mpsc,
    },
    thread::JoinHandle,
};

use super::{
    channel::{LiveChannel, Security},
    clock,
    handshakes::StartError,
    memory,
    outlets::RecordSinks,
    realtime::{self, RealtimeReport, RealtimeSettings},
    socket::PeerSocket,
    turning::{LiveLoop, LoopChannels},
    watch::LiveWatch,
};
use crate::{
    ladder::{Diagnosis, FlightRecorder},
    link::LinkStatistics,
    pace::Wake,
    path::PathReport,
    recorder::{Recorder, RecordingReport},
    ring::ring,
    session::Rejections,
    side::Side,
    wire::Role,
};

/// How a live loop goes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LiveSettings {
    /// Which side it is.
    pub role: Role,
    /// Period in ns.
    pub period_ns: u64,
    /// Ends this long after the two sides engaged, in ns.
    pub duration_ns: Option<u64>,
    /// Ends if the two sides have not engaged after this time, in ns.
    pub patience_ns: Option<u64>,
    /// When a person started this side, in ns of the system's monotonic clock; when it is made, where nobody says.
    pub started_ns: Option<u64>,
    /// Records that wait for a reader; further ones are counted and dropped.
    pub ring: usize,
    /// What to ask of the system.
    pub realtime: RealtimeSettings,
}

/// How a live loop went.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct LoopReport {
    /// Ticks done.
    pub ticks: u64,
    /// Ticks left out because the loop woke too late.
    pub skipped: u64,
    /// Records that found the ring full.
    pub dropped_records: u64,
    /// Frames that the system refused to send.
    pub unsent: u64,
    /// Counts of the link.
    pub link: LinkStatistics,
    /// What the way did to the peer's frames, and what is known of its clock.
    pub path: PathReport,
    /// How often the ladder went to HOLD.
    pub holds: u64,
    /// Ticks at which a bound acted on the remote command.
    pub limited: u64,
    /// Whether frames were encrypted and authenticated.
    pub secure: bool,
    /// Datagrams that the session did not take, by cause; in `link`, too.
    pub rejections: Rejections,
    /// When the sides first engaged, in ns since the start; `u64::MAX` if never.
    pub engaged_ns: u64,
    /// What the loop's thread got of the system.
    pub realtime: RealtimeReport,
    /// What became of the recording; none if there was none.
    pub recording: Option<RecordingReport>,
    /// Whether the loop was ended because no memory was left.
    pub out_of_memory: bool,
}

/// Events that wait for a reader; further ones are dropped.
const MAX_EVENTS: usize = 64;

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
    /// In words; none where the diagnosis has them.
    pub fn text(self) -> Option<&'static str> {
        match self {
            Self::NotYet => None,
            Self::Late => Some("the loop was late, and nobody knows when it was pressed: press it again"),
            Self::HasButton => Some("this device has a button: press that"),
            Self::OldStart => Some("the start was more than 5 s ago when the loop began: press the clutch"),
        }
    }

    pub(super) fn from_code(code: u8) -> Option<Self> {
        [Self::NotYet, Self::Late, Self::HasButton, Self::OldStart].into_iter().find(|why| *why as u8 == code)
    }
}

/// What the loop and those who watch it both see.
#[derive(Debug, Default)]
pub(super) struct Shared {
    pub(super) stop: AtomicBool,
    pub(super) state: AtomicU8,
    pub(super) ticks: AtomicU64,
    /// The peer has answered a frame.
    pub(super) answered: AtomicBool,
    /// When the clutch, and the takeover, were asked for last, in ns; 0 where not since the loop looked.
    pub(super) press_ns: AtomicU64,
    pub(super) takeover_ns: AtomicU64,
    /// Presses that did nothing, and why the last of them did not.
    pub(super) ineffective_presses: AtomicU64,
    pub(super) ineffective: AtomicU8,
    /// The device has failed, and the loop ends by that.
    pub(super) ends: AtomicBool,
    /// No force, no motion, and the peer has been sent the end.
    pub(super) at_rest: AtomicBool,
}

impl Shared {
    /// Whether the loop must end: it was asked to, or the process has no memory left.
    pub(super) fn must_end(&self) -> bool {
        self.stop.load(Ordering::Relaxed) || memory::is_exhausted()
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

    /// As [`super::LiveWatch::press_clutch`].
    pub(super) fn press_clutch(&self) {
        self.press_ns.store(clock::now_ns().max(1), Ordering::Relaxed);
    }

    /// As [`super::LiveWatch::allow_takeover`].
    pub(super) fn allow_takeover(&self) {
        self.takeover_ns.store(clock::now_ns().max(1), Ordering::Relaxed);
    }
}

/// States and commands as of a STOP or FAULT that wait for a reader.
const MAX_FLIGHTS: usize = 2;
/// Diagnoses that wait for a reader; the loop keeps the newest until there is room.
const MAX_DIAGNOSES: usize = 16;
/// Acts that may wait for the loop: it takes all of them at its next tick.
const MAX_ACTS: usize = 16;

/// What a loop is made of before its time begins, and the other ends of its rings.
pub(super) type Assembled<R> = (LiveChannel, LoopChannels<R>, LiveWatch<R>);

/// Makes the rings, and a session without keys yet.
pub(super) fn assemble<S: Side>(
    socket: &PeerSocket,
    settings: &LiveSettings,
    security: Security,
    recorder: Option<Recorder<S::Record>>,
) -> Result<Assembled<S::Record>, StartError> {
    let (producer, records) = ring(settings.ring);
    let (told, events) = rtrb::RingBuffer::new(MAX_EVENTS);
    let (flown, flights) = ring(MAX_FLIGHTS);
    let (diagnosed, diagnoses) = ring(MAX_DIAGNOSES);
    let (acts, done) = rtrb::RingBuffer::new(MAX_ACTS);
    let channel = LiveChannel::start::<S>(settings.role, settings.period_ns, security)?;
    let watch = LiveWatch {
        records,
        events,
        flights,
        flight: None,
        diagnoses,
        diagnosis: None,
        acts,
        shared: Arc::default(),
        address: socket.local_address()?,
        recording: recorder.as_ref().map(Recorder::recording),
    };
    let ways = LoopChannels {
        records: RecordSinks::new(producer, recorder),
        events: told,
        flights: flown,
        diagnoses: diagnosed,
        acts: done,
        started_ns: Some(settings.started_ns.unwrap_or_else(clock::now_ns)),
    };
    Ok((channel, ways, watch))
}

/// A live loop on its own thread.
#[derive(Debug)]
pub struct LiveRun<R> {
    thread: Option<JoinHandle<(LoopReport, Option<Box<FlightRecorder>>)>>,
    watch: LiveWatch<R>,
    realtime: RealtimeReport,
}

/// Starts the loop of one side on a thread of its own; `recorder` gets every record, too.
///
/// Fails where real-time scheduling is required and not all of it was granted.
pub fn run_live<S: Side + Send + 'static>(
    side: S,
    socket: PeerSocket,
    settings: LiveSettings,
    security: Security,
    recorder: Option<Recorder<S::Record>>,
) -> Result<LiveRun<S::Record>, StartError> {
    let (channel, ways, watch) = assemble::<S>(&socket, &settings, security, recorder)?;
    let shared = Arc::clone(&watch.shared);
    let (say, heard) = mpsc::sync_channel(1);
    let thread = std::thread::Builder::new().name("haptether-loop".into()).spawn(move || {
        let (realtime, _kept) = realtime::prepare(settings.realtime);
        let _ = say.send(realtime);
        if realtime.check(settings.realtime.demand).is_err() {
            let recording = ways.records.end();
            return (LoopReport { realtime, recording, ..LoopReport::default() }, None);
        }
        let mut deadline_ns = clock::now_ns();
        let mut turning = LiveLoop::begin(side, socket, channel, settings, ways, deadline_ns);
        while !shared.must_end() {
            clock::sleep_until(deadline_ns);
            let wake = Wake::new(deadline_ns, clock::now_ns(), settings.period_ns);
            if turning.turn(wake, &shared).is_break() {
                break;
            }
            deadline_ns = wake.deadline_ns + settings.period_ns;
        }
        let (report, flight) = turning.end(&shared);
        (LoopReport { realtime, ..report }, Some(flight))
    })?;
    let realtime = heard.recv().map_err(io::Error::other)?;
    realtime.check(settings.realtime.demand)?;
    Ok(LiveRun { thread: Some(thread), watch, realtime })
}

impl<R> Deref for LiveRun<R> {
    type Target = LiveWatch<R>;

    fn deref(&self) -> &LiveWatch<R> {
        &self.watch
    }
}

impl<R> DerefMut for LiveRun<R> {
    fn deref_mut(&mut self) -> &mut LiveWatch<R> {
        &mut self.watch
    }
}

impl<R> LiveRun<R> {
    /// What the loop's thread got of the system.
    pub fn realtime(&self) -> RealtimeReport {
        self.realtime
    }

    /// Whether the loop has ended.
    pub fn is_finished(&self) -> bool {
        self.thread.as_ref().is_none_or(JoinHandle::is_finished)
    }

    /// Ends the loop and gives its report; none if it was given before or the loop panicked.
    pub fn join(&mut self) -> Option<LoopReport> {
        self.watch.stop();
        let (report, flight) = self.thread.take()?.join().ok()?;
        self.watch.ended(flight);
        Some(report)
    }
}

impl<R> Drop for LiveRun<R> {
    fn drop(&mut self) {
        self.join();
    }
}
