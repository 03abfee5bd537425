//! The live loop of one side.

use std::{
    io,
    net::SocketAddr,
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU8, AtomicU64, Ordering},
        mpsc,
    },
    thread::JoinHandle,
};

use super::{
    channel::{Came, LiveChannel, RELEASES, Security},
    clock,
    handshakes::{SecurityEvent, StartError},
    outlets::Outlets,
    realtime::{self, RealtimeDemand, RealtimeReport, RealtimeSettings},
    socket::PeerSocket,
};
use crate::{
    act::Act,
    ladder::{FlightRecorder, LadderState},
    link::LinkStatistics,
    pace::Wake,
    path::PathReport,
    recorder::{Recorder, Recording, RecordingReport},
    session::{MAX_DATAGRAM, Rejections},
    side::{Side, TickTime},
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
}

/// Part of the period that may be spent on what has arrived; more would let a flood stretch the tick.
const MOST_TAKING: u64 = 4;
/// Events that wait for a reader; further ones are dropped.
const MOST_EVENTS: usize = 64;

#[derive(Debug, Default)]
struct Shared {
    stop: AtomicBool,
    state: AtomicU8,
    ticks: AtomicU64,
    press: AtomicBool,
    takeover: AtomicBool,
}

/// Between two releases at the end of a run, in ns.
const RELEASE_NS: u64 = 1_000_000;
/// States and commands as of a STOP or FAULT that wait for a reader.
const MOST_FLIGHTS: usize = 2;
/// Acts that may wait for the loop: it takes all of them at its next tick.
const MOST_ACTS: usize = 16;

/// A live loop on its own thread.
#[derive(Debug)]
pub struct LiveRun<R> {
    thread: Option<JoinHandle<(LoopReport, Option<Box<FlightRecorder>>)>>,
    records: rtrb::Consumer<R>,
    events: rtrb::Consumer<SecurityEvent>,
    flights: rtrb::Consumer<FlightRecorder>,
    /// The newest that was taken.
    flight: Option<Box<FlightRecorder>>,
    acts: rtrb::Producer<Act>,
    shared: Arc<Shared>,
    address: SocketAddr,
    realtime: RealtimeReport,
    recording: Option<Recording>,
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
    let (producer, records) = rtrb::RingBuffer::new(settings.ring);
    let (told, events) = rtrb::RingBuffer::new(MOST_EVENTS);
    let channel = LiveChannel::start::<S>(settings.role, settings.period_ns, security)?;
    let (flown, flights) = rtrb::RingBuffer::new(MOST_FLIGHTS);
    let (acts, done) = rtrb::RingBuffer::new(MOST_ACTS);
    let shared = Arc::new(Shared::default());
    let address = socket.local_address()?;
    let seen = Arc::clone(&shared);
    let recording = recorder.as_ref().map(Recorder::recording);
    let (say, heard) = mpsc::sync_channel(1);
    let thread = std::thread::Builder::new().name("haptether-loop".into()).spawn(move || {
        let (realtime, _kept) = realtime::prepare(settings.realtime);
        let _ = say.send(realtime);
        let outlets = Outlets::new(producer, recorder);
        if settings.realtime.demand == RealtimeDemand::Require && !realtime.is_complete() {
            return (LoopReport { recording: outlets.end(), realtime, ..LoopReport::default() }, None);
        }
        let ways = Ways { records: outlets, events: told, flights: flown, acts: done };
        let (report, flight) = turn(side, socket, channel, settings, ways, &seen);
        (LoopReport { realtime, ..report }, Some(flight))
    })?;
    let realtime = heard.recv().map_err(io::Error::other)?;
    if settings.realtime.demand == RealtimeDemand::Require && !realtime.is_complete() {
        let text = format!("real time is required: {realtime}");
        return Err(io::Error::new(io::ErrorKind::PermissionDenied, text).into());
    }
    Ok(LiveRun {
        thread: Some(thread),
        records,
        events,
        flights,
        flight: None,
        acts,
        shared,
        address,
        realtime,
        recording,
    })
}

/// A side that is left without force or motion however its loop ends.
struct Resting<S: Side>(S);

impl<S: Side> Drop for Resting<S> {
    fn drop(&mut self) {
        self.0.rest();
    }
}

/// The loop's ends of what leads to and from it; none of them is ever waited for.
struct Ways<R> {
    records: Outlets<R>,
    events: rtrb::Producer<SecurityEvent>,
    flights: rtrb::Producer<FlightRecorder>,
    acts: rtrb::Consumer<Act>,
}

/// The loop: wait for the deadline, take what has arrived, tick, send, record.
fn turn<S: Side>(
    side: S,
    mut socket: PeerSocket,
    mut channel: LiveChannel,
    settings: LiveSettings,
    Ways { mut records, mut events, mut flights, mut acts }: Ways<S::Record>,
    shared: &Shared,
) -> (LoopReport, Box<FlightRecorder>) {
    let mut report =
        LoopReport { engaged_ns: u64::MAX, secure: channel.is_secure(), ..LoopReport::default() };
    let mut buffer = [0; MAX_DATAGRAM];
    let mut tell = |event| {
        let _ = events.push(event);
    };
    let mut side = Resting(side);
    let start_ns = clock::now_ns();
    side.0.begin(start_ns);
    let mut deadline_ns = start_ns;
    let mut shown = LadderState::Disengaged;
    while !shared.stop.load(Ordering::Relaxed) {
        clock::sleep_until(deadline_ns);
        let wake = Wake::new(deadline_ns, clock::now_ns(), settings.period_ns);
        let Wake { overshoot_ns, missed, .. } = wake;
        report.skipped += missed;
        deadline_ns = wake.deadline_ns;
        if wake.is_stalled() {
            side.0.stalled(deadline_ns);
            // Late already: another period for this is not much.
            socket.discard(clock::now_ns() + settings.period_ns);
        }
        // The tick's time is its deadline: the pure part sees a steady clock, as in virtual time.
        let now_ns = deadline_ns;
        if shared.press.swap(false, Ordering::Relaxed) {
            side.0.press_again();
        }
        if shared.takeover.swap(false, Ordering::Relaxed) {
            channel.allow_takeover(now_ns, &mut tell);
        }
        while let Ok(act) = acts.pop() {
            // `LiveRun::act` has refused what cannot be.
            let _ = side.0.act(now_ns, act);
        }
        let until_ns = deadline_ns + settings.period_ns / MOST_TAKING;
        socket.drain(now_ns, until_ns, |from, datagram| {
            channel.receive(now_ns, from, datagram, &mut side.0) == Came::Used
        });
        channel.advance(now_ns, |to, datagram| socket.send(to, datagram), &mut tell);
        let record = side.0.tick(TickTime { start_ns, now_ns, clock_ns: now_ns, overshoot_ns, missed });
        if let Some(datagram) = channel.send(now_ns, &mut side.0, &mut buffer) {
            socket.send(None, datagram);
        }
        report.ticks += 1;
        if records.push(record).is_err() {
            report.dropped_records += 1;
        }
        let state = side.0.state();
        if state.is_coupled() && report.engaged_ns == u64::MAX {
            report.engaged_ns = now_ns - start_ns;
        }
        // Until there was room: nobody may have looked at the one before.
        if state == shown
            || !matches!(state, LadderState::Stop | LadderState::Fault)
            || flights.push(*side.0.flight()).is_ok()
        {
            shown = state;
        }
        shared.state.store(state.code(), Ordering::Relaxed);
        shared.ticks.store(report.ticks, Ordering::Relaxed);
        let elapsed_ns = now_ns - start_ns;
        let limit_ns = match report.engaged_ns {
            u64::MAX => settings.patience_ns,
            engaged_ns => settings.duration_ns.map(|duration_ns| engaged_ns.saturating_add(duration_ns)),
        };
        if limit_ns.is_some_and(|limit_ns| elapsed_ns >= limit_ns) {
            break;
        }
        deadline_ns += settings.period_ns;
    }
    let (counts, flight) = (side.0.counts(), Box::new(*side.0.flight()));
    report.path = side.0.path(deadline_ns);
    // First of all: what follows takes its time.
    drop(side);
    for release in 0..RELEASES {
        let now_ns = clock::now_ns();
        let Ok(datagram) = channel.release(now_ns, &mut buffer) else { break };
        socket.send(None, datagram);
        if release + 1 < RELEASES {
            clock::sleep_until(now_ns + RELEASE_NS);
        }
    }
    report.rejections = channel.end();
    report.link = counts.link.with(&report.rejections);
    (report.holds, report.limited) = (counts.holds, counts.limited);
    report.unsent = socket.unsent;
    report.recording = records.end();
    (report, flight)
}

impl<R> LiveRun<R> {
    /// Takes the records that wait.
    pub fn drain(&mut self, mut take: impl FnMut(R)) {
        while let Ok(record) = self.records.pop() {
            take(record);
        }
    }

    /// Takes what happened to the session.
    pub fn drain_events(&mut self, mut take: impl FnMut(SecurityEvent)) {
        while let Ok(event) = self.events.pop() {
            take(event);
        }
    }

    /// Lets another master begin, if the one before has been silent for 2 s: the act of a person at the slave.
    pub fn allow_takeover(&self) {
        self.shared.takeover.store(true, Ordering::Relaxed);
    }

    /// Where the socket listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Where the ladder stands.
    pub fn state(&self) -> LadderState {
        LadderState::from_code(self.shared.state.load(Ordering::Relaxed)).unwrap_or(LadderState::Disengaged)
    }

    /// What the loop's thread got of the system.
    pub fn realtime(&self) -> RealtimeReport {
        self.realtime
    }

    /// How the recording stands; none if there is none.
    pub fn recording(&self) -> Option<RecordingReport> {
        self.recording.as_ref().map(Recording::report)
    }

    /// Ticks done so far.
    pub fn ticks(&self) -> u64 {
        self.shared.ticks.load(Ordering::Relaxed)
    }

    /// Whether the loop has ended.
    pub fn is_finished(&self) -> bool {
        self.thread.as_ref().is_none_or(JoinHandle::is_finished)
    }

    /// Lets go of the clutch for a moment and presses it again: the act of a person at this side.
    pub fn press_clutch(&self) {
        self.shared.press.store(true, Ordering::Relaxed);
    }

    /// Hands an act to the loop, which does it at its next tick; gives it back where too many wait.
    pub fn act(&mut self, act: Act) -> Result<(), Act> {
        self.acts.push(act).map_err(|rtrb::PushError::Full(act)| act)
    }

    /// The last states and commands as JSON, as of the last STOP or FAULT, or of the end; none before.
    pub fn flight(&mut self) -> Option<String> {
        while let Ok(flight) = self.flights.pop() {
            self.flight = Some(Box::new(flight));
        }
        self.flight.as_ref().map(|flight| flight.to_json())
    }

    /// Asks the loop to end after its current tick.
    pub fn stop(&self) {
        self.shared.stop.store(true, Ordering::Relaxed);
    }

    /// Ends the loop and gives its report; none if it was given before or the loop panicked.
    pub fn join(&mut self) -> Option<LoopReport> {
        self.stop();
        let (report, flight) = self.thread.take()?.join().ok()?;
        while self.flights.pop().is_ok() {}
        self.flight = flight.or(self.flight.take());
        Some(report)
    }
}

impl<R> Drop for LiveRun<R> {
    fn drop(&mut self) {
        self.join();
    }
}
