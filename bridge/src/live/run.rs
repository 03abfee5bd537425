//! Who waits for the ticks of a live loop: a thread of its own, or a driver whose device paces it.

use std::{
    io,
    marker::PhantomData,
    mem::MaybeUninit,
    ops::ControlFlow,
    sync::{Arc, atomic::Ordering, mpsc},
};

use super::{
    channel::{LiveChannel, Security},
    handle::{LiveHandle, LiveWatch, LoopChannels, RecordOutputs, RecordReader, Shared, channels},
    handshakes::StartError,
    live_loop::{LiveLoop, LiveSettings, LoopReport, LoopSide, RecordedSide},
    own_thread::OwnThread,
    socket::PeerSocket,
    system::{self, Kept, LaterMemory, RealtimeReport},
};
use crate::{
    fault_text::{FaultText, PIECES},
    ladder::FlightRecorder,
    pace::{DevicePace, Wake},
    side::Side,
};

/// How a loop went, and its last states and commands, for [`LiveWatch::ended`].
pub type Ended = (LoopReport, Option<Box<FlightRecorder>>);

/// A live loop on its own thread.
#[derive(Debug)]
pub struct LiveRun {
    thread: OwnThread<Ended>,
    handle: LiveHandle,
    realtime: RealtimeReport,
}

/// A side in its loop. The plant comes first: it is at rest before anything else is dropped.
struct Running {
    plant: Box<dyn LoopSide + Send>,
    live_loop: LiveLoop,
}

impl Running {
    fn begin(
        mut plant: Box<dyn LoopSide + Send>,
        socket: PeerSocket,
        channel: LiveChannel,
        settings: LiveSettings,
        channels: LoopChannels,
        start_ns: u64,
    ) -> Self {
        let live_loop = LiveLoop::begin(&mut *plant, socket, channel, settings, channels, start_ns);
        Self { plant, live_loop }
    }

    fn step(&mut self, wake: Wake, shared: &Shared) -> ControlFlow<()> {
        self.live_loop.step(&mut *self.plant, wake, shared)
    }

    fn announce_end(&mut self, shared: &Shared) {
        self.live_loop.announce_end(&mut *self.plant, shared);
    }

    fn end(self, shared: &Shared) -> (LoopReport, Box<FlightRecorder>) {
        let Self { mut plant, live_loop } = self;
        live_loop.end(&mut *plant, shared)
    }
}

/// Starts the loop of one side on a thread of its own; `outputs` get every record, too.
///
/// Fails where real-time scheduling is required and not all of it was granted.
pub fn run_live<S: Side + Send + 'static>(
    side: S,
    socket: PeerSocket,
    settings: LiveSettings,
    security: Security,
    outputs: RecordOutputs<S::Record>,
) -> Result<(LiveRun, LiveWatch, RecordReader<S::Record>), StartError> {
    let (parts, watch, records) = prepared(side, socket, settings, security, outputs)?;
    Ok((spawned(parts, &watch)?, watch, records))
}

/// The parts of a loop that has not begun.
struct Parts {
    plant: Box<dyn LoopSide + Send>,
    socket: PeerSocket,
    channel: LiveChannel,
    channels: LoopChannels,
    settings: LiveSettings,
    shared: Arc<Shared>,
}

fn prepared<S: Side + Send + 'static>(
    side: S,
    socket: PeerSocket,
    settings: LiveSettings,
    security: Security,
    outputs: RecordOutputs<S::Record>,
) -> Result<(Parts, LiveWatch, RecordReader<S::Record>), StartError> {
    let layout = side.exchange().link().layout();
    let channel = LiveChannel::start(settings.role, layout, settings.period_ns, security)?;
    let started_ns = settings.started_ns.unwrap_or_else(system::now_ns);
    let shared = Arc::new(Shared::new(settings.role, side.ranges()));
    let (channels, sinks, watch, records) =
        channels(started_ns, socket.local_address()?, outputs, Arc::clone(&shared));
    let plant = Box::new(RecordedSide::new(side, sinks));
    Ok((Parts { plant, socket, channel, channels, settings, shared }, watch, records))
}

/// Starts a loop on a thread of its own; compiled once for all sides.
fn spawned(parts: Parts, watch: &LiveWatch) -> Result<LiveRun, StartError> {
    let Parts { mut plant, socket, channel, channels, settings, shared } = parts;
    let (to_starter, granted) = mpsc::sync_channel(1);
    let thread = std::thread::Builder::new().name("haptether-loop".into()).spawn(move || {
        let (realtime, _kept) = system::prepare(settings.realtime, LaterMemory::Free);
        let _ = to_starter.send(realtime);
        if realtime.check(settings.realtime.demand).is_err() {
            let recording = plant.abandon();
            return (LoopReport { realtime, recording, ..LoopReport::default() }, None);
        }
        let mut deadline_ns = system::now_ns();
        let mut running = Running::begin(plant, socket, channel, settings, channels, deadline_ns);
        while !shared.must_end() {
            system::sleep_until(deadline_ns);
            let wake = Wake::new(deadline_ns, system::now_ns(), settings.period_ns);
            if running.step(wake, &shared).is_break() {
                break;
            }
            deadline_ns = wake.deadline_ns + settings.period_ns;
        }
        let (report, flight) = running.end(&shared);
        (LoopReport { realtime, ..report }, Some(flight))
    })?;
    let realtime = granted.recv().map_err(io::Error::other)?;
    realtime.check(settings.realtime.demand)?;
    Ok(LiveRun { thread: OwnThread::new(thread), handle: watch.handle().clone(), realtime })
}

impl LiveRun {
    /// What the loop's thread got of the system.
    pub fn realtime(&self) -> RealtimeReport {
        self.realtime
    }

    /// Whether the loop has ended.
    pub fn is_finished(&self) -> bool {
        self.thread.is_finished()
    }

    /// Ends the loop and returns how it went; none if it was joined before or the loop panicked.
    pub fn join(&mut self) -> Option<Ended> {
        self.handle.stop();
        self.thread.join()
    }
}

impl Drop for LiveRun {
    fn drop(&mut self) {
        self.join();
    }
}

/// Ticks after a device has failed in which the peer is sent that: frames get lost, and the driver's text is sent in
/// pieces.
const FAILED_TICKS: u32 = 3 * PIECES as u32;

/// How far the loop is.
enum Stage {
    Ready(Box<(Box<dyn LoopSide + Send>, PeerSocket, LiveChannel, LoopChannels)>),
    Running(Box<Running>),
    Over,
}

/// The loop of one side, a tick at a time: `begin`, then at every sample of the device `step`, at last `end`.
///
/// A driver that does not wait for its device calls `wait` after each tick. All of it on one thread.
pub struct PacedLoop<S> {
    paced: Pacing,
    side: PhantomData<S>,
}

/// The same for sides of any type: it is compiled once.
struct Pacing {
    stage: Stage,
    settings: LiveSettings,
    shared: Arc<Shared>,
    pace: DevicePace,
    /// The last tick was waited for here, and not by the device.
    waited: bool,
    realtime: RealtimeReport,
    kept: Option<Kept>,
}

/// A loop that is not begun, its watch and its records.
pub type Paced<S> = (PacedLoop<S>, LiveWatch, RecordReader<<S as Side>::Record>);

/// Prepares the loop of one side; `outputs` get every record, too.
pub fn paced_by_device<S: Side + Send + 'static>(
    side: S,
    socket: PeerSocket,
    settings: LiveSettings,
    security: Security,
    outputs: RecordOutputs<S::Record>,
) -> Result<Paced<S>, StartError> {
    let (parts, watch, records) = prepared(side, socket, settings, security, outputs)?;
    let Parts { plant, socket, channel, channels, settings, shared } = parts;
    let paced = Pacing {
        stage: Stage::Ready(Box::new((plant, socket, channel, channels))),
        settings,
        shared,
        pace: DevicePace::new(settings.period_ns),
        waited: false,
        realtime: RealtimeReport::default(),
        kept: None,
    };
    Ok((PacedLoop { paced, side: PhantomData }, watch, records))
}

impl<S: Side + 'static> PacedLoop<S> {
    /// One tick: `before` hands the side its sample, `after` takes what it decided. None where the run is over.
    pub fn step<T>(&mut self, before: impl FnOnce(&mut S), after: impl FnOnce(&mut S) -> T) -> Option<T> {
        let wake = self.paced.wake()?;
        before(self.side()?);
        self.paced.tick(wake).is_continue().then(|| self.side().map(after))?
    }

    fn side(&mut self) -> Option<&mut S> {
        let Stage::Running(running) = &mut self.paced.stage else { return None };
        running.plant.side_any().downcast_mut()
    }
}

impl Pacing {
    /// When the next tick is; none where the run is over.
    fn wake(&mut self) -> Option<Wake> {
        if !matches!(self.stage, Stage::Running(_)) {
            return None;
        }
        if self.shared.must_end() {
            self.shared.stop.store(true, Ordering::Relaxed);
            return None;
        }
        Some(if std::mem::take(&mut self.waited) {
            self.pace.waited(system::now_ns())
        } else {
            if system::now_ns() < self.pace.earliest_ns() {
                system::sleep_until(self.pace.earliest_ns());
            }
            self.pace.sampled(system::now_ns())
        })
    }

    fn tick(&mut self, wake: Wake) -> ControlFlow<()> {
        let flow = match &mut self.stage {
            Stage::Running(running) => running.step(wake, &self.shared),
            Stage::Ready(_) | Stage::Over => ControlFlow::Break(()),
        };
        if flow.is_break() {
            self.shared.stop.store(true, Ordering::Relaxed);
        }
        flow
    }
}

/// What a driver does with its loop, of whatever side, but a tick: that is [`PacedLoop::step`].
pub trait DriverLoop {
    /// Time begins; requests real time of the system for this thread. Nothing if it has begun.
    ///
    /// Fails, and is over, where real-time scheduling is required and not all of it was granted.
    fn begin(&mut self) -> Result<RealtimeReport, StartError>;

    /// Sleeps until the next tick is due.
    fn wait(&mut self);

    /// The device is gone: zero force and no motion, and the peer is sent that, with the driver's text where there is
    /// one.
    fn fail(&mut self, text: &FaultText);

    /// One tick in place of a driver that does not return: zero force and no motion, with `text` as the fault. Returns
    /// when the next is due in ns; none where the run is over, whose end it has then announced.
    fn turn_blocked(&mut self, text: &FaultText) -> Option<u64>;

    /// The device is at rest: announces the end of this side to the peer, before whoever waits for the report does.
    fn announce_end(&mut self);

    /// Ends the loop and returns how it went; none if it was ended before.
    fn end(&mut self) -> Option<Ended>;
}

impl<S: Side + 'static> DriverLoop for PacedLoop<S> {
    fn begin(&mut self) -> Result<RealtimeReport, StartError> {
        self.paced.begin()
    }

    fn wait(&mut self) {
        self.paced.wait();
    }

    fn fail(&mut self, text: &FaultText) {
        self.paced.fail(text);
    }

    fn turn_blocked(&mut self, text: &FaultText) -> Option<u64> {
        self.paced.turn_blocked(text)
    }

    fn announce_end(&mut self) {
        self.paced.announce_end();
    }

    fn end(&mut self) -> Option<Ended> {
        self.paced.end()
    }
}

impl DriverLoop for Pacing {
    fn begin(&mut self) -> Result<RealtimeReport, StartError> {
        match std::mem::replace(&mut self.stage, Stage::Over) {
            Stage::Ready(parts) => {
                // There before the memory is locked.
                let room = Box::new(MaybeUninit::zeroed());
                let (realtime, kept) = system::prepare(self.settings.realtime, LaterMemory::Locked);
                realtime.check(self.settings.realtime.demand)?;
                (self.realtime, self.kept) = (realtime, Some(kept));
                let (plant, socket, channel, channels) = *parts;
                let now_ns = system::now_ns();
                self.pace.begin(now_ns);
                let running = Running::begin(plant, socket, channel, self.settings, channels, now_ns);
                self.stage = Stage::Running(Box::write(room, running));
            }
            stage => self.stage = stage,
        }
        Ok(self.realtime)
    }

    fn wait(&mut self) {
        system::sleep_until(self.pace.next_ns());
        self.waited = true;
    }

    fn fail(&mut self, text: &FaultText) {
        let Stage::Running(running) = &mut self.stage else { return };
        self.shared.ends.store(true, Ordering::Relaxed);
        for _ in 0..FAILED_TICKS {
            // Anew at each: nobody can mend what is gone.
            running.plant.side_mut().exchange_mut().device_failed(Some(text));
            // Now, and not when the next sample would have been due: what is reported must not be of the future.
            let wake = self.pace.sampled(system::now_ns());
            let wake = Wake { overshoot_ns: 0, missed: 0, ..wake };
            if running.step(wake, &self.shared).is_break() {
                break;
            }
            system::sleep_until(self.pace.next_ns());
        }
        self.shared.stop.store(true, Ordering::Relaxed);
        running.announce_end(&self.shared);
    }

    fn turn_blocked(&mut self, text: &FaultText) -> Option<u64> {
        let wake = self.wake();
        if let (Some(wake), Stage::Running(running)) = (wake, &mut self.stage) {
            running.plant.side_mut().exchange_mut().device_failed(Some(text));
            if self.tick(wake).is_continue() {
                return Some(self.pace.next_ns());
            }
        }
        self.announce_end();
        None
    }

    fn announce_end(&mut self) {
        if let Stage::Running(running) = &mut self.stage {
            self.shared.stop.store(true, Ordering::Relaxed);
            running.announce_end(&self.shared);
        }
    }

    fn end(&mut self) -> Option<Ended> {
        self.shared.stop.store(true, Ordering::Relaxed);
        let realtime = self.realtime;
        match std::mem::replace(&mut self.stage, Stage::Over) {
            Stage::Running(running) => {
                let (report, flight) = running.end(&self.shared);
                // Locked memory is the process's: it is given back with the run, not with the last who holds the loop.
                self.kept = None;
                Some((LoopReport { realtime, ..report }, Some(flight)))
            }
            Stage::Ready(mut parts) => {
                let recording = parts.0.abandon();
                Some((
                    LoopReport { recording, realtime, engaged_ns: u64::MAX, ..LoopReport::default() },
                    None,
                ))
            }
            Stage::Over => None,
        }
    }
}

impl Drop for Pacing {
    fn drop(&mut self) {
        self.end();
    }
}
