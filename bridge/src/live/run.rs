//! Runners of a live loop: a thread of its own, or a driver whose device paces the ticks.

use std::{
    io,
    marker::PhantomData,
    mem::MaybeUninit,
    ops::ControlFlow,
    sync::{Arc, atomic::Ordering, mpsc},
};

use haptether_safety::{Renewal, Stamped};

use super::{
    channel::{LiveChannel, Security},
    handle::{LiveHandle, LiveWatch, LoopChannels, RecordOutputs, RecordReader, Shared, channels},
    handshakes::StartError,
    live_loop::{LiveLoop, LiveSettings, LoopReport, LoopSide, RecordedSide},
    own_thread::OwnThread,
    socket::PeerSocket,
    system::{self, LaterMemory, RealtimeGrants, RealtimeReport},
};
use crate::{
    fault_text::{FaultText, PIECES},
    ladder::FlightRecorder,
    pace::{DevicePace, Wake},
    side::Side,
};

/// Report of a loop, and its flight recorder, for [`LiveWatch::ended`].
pub type Ended = (LoopReport, Option<Box<FlightRecorder>>);

/// A live loop on its own thread.
#[derive(Debug)]
pub struct LiveRun {
    thread: OwnThread<Ended>,
    handle: LiveHandle,
    realtime: RealtimeReport,
}

/// A side in its loop. The plant is the first field, so that it is dropped, and at rest, first.
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

/// Start the loop of one side on its own thread; `outputs` receive every record.
///
/// Fails if real-time scheduling is required and not fully granted.
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
    let couplings = side.exchange().link().couplings();
    let aimed_axes = side.is_aimed().then(|| side.axes());
    let shared = Arc::new(Shared::new(settings.role, side.ranges(), couplings, aimed_axes));
    let (channels, sinks, watch, records) =
        channels(started_ns, socket.local_address()?, outputs, Arc::clone(&shared));
    let plant = Box::new(RecordedSide::new(side, sinks));
    Ok((Parts { plant, socket, channel, channels, settings, shared }, watch, records))
}

/// Start a loop on its own thread; compiled once for all sides.
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
    /// Real-time scheduling granted to the loop's thread.
    pub fn realtime(&self) -> RealtimeReport {
        self.realtime
    }

    /// Return whether the loop has ended.
    pub fn is_finished(&self) -> bool {
        self.thread.is_finished()
    }

    /// End the loop. Returns its report; `None` if joined before or panicked.
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

/// Ticks that report a device failure: frames get lost, and the text needs several.
const FAILED_TICKS: u32 = 3 * PIECES as u32;

enum Stage {
    Ready(Box<(Box<dyn LoopSide + Send>, PeerSocket, LiveChannel, LoopChannels)>),
    Running(Box<Running>),
    Over,
}

/// The loop of one side, tick by tick: `begin`, `step` at every sample, `end`, all on one thread.
///
/// A driver that does not wait for its device calls `wait` after each tick.
pub struct PacedLoop<S> {
    paced: Pacing,
    renewal: Renewal,
    side: PhantomData<S>,
}

/// Part of a paced loop independent of the side's type, compiled once.
struct Pacing {
    stage: Stage,
    settings: LiveSettings,
    shared: Arc<Shared>,
    pace: DevicePace,
    /// The last tick was awaited here, not by the device.
    waited: bool,
    realtime: RealtimeReport,
    grants: Option<RealtimeGrants>,
}

/// A prepared loop, its watch and its records.
pub type Paced<S> = (PacedLoop<S>, LiveWatch, RecordReader<<S as Side>::Record>);

/// Prepare the loop of one side; `outputs` receive every record.
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
        grants: None,
    };
    Ok((PacedLoop { paced, renewal: Renewal::default(), side: PhantomData }, watch, records))
}

impl<S: Side + 'static> PacedLoop<S> {
    /// Do one tick: `before` sets the sample, `after` takes the decision. Return `None` once the run is over.
    ///
    /// `sample` measures how often the device renews its samples; it is `None` if the device has failed.
    pub fn step<T>(
        &mut self,
        sample: Option<Stamped<'_>>,
        before: impl FnOnce(&mut S),
        after: impl FnOnce(&mut S) -> T,
    ) -> Option<T> {
        let wake = self.paced.wake()?;
        self.renewal.step(sample, 2 * wake.overshoot_ns >= self.paced.settings.period_ns);
        let share = self.renewal.share();
        let side = self.side()?;
        side.exchange_mut().renewal = share;
        before(side);
        self.paced.tick(wake).is_continue().then(|| self.side().map(after))?
    }

    fn side(&mut self) -> Option<&mut S> {
        let Stage::Running(running) = &mut self.paced.stage else { return None };
        running.plant.side_any().downcast_mut()
    }
}

impl Pacing {
    /// Time of the next tick; `None` once the run is over.
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

/// Operations of a driver on any side's loop, except [`PacedLoop::step`].
pub trait DriverLoop {
    /// Start time, and requests real-time scheduling for this thread. Does nothing if already begun.
    ///
    /// Fails, and ends the run, if real-time scheduling is required and not fully granted.
    fn begin(&mut self) -> Result<RealtimeReport, StartError>;

    /// Sleeps until the next tick is due.
    fn wait(&mut self);

    /// Handles a lost device: zero force, no motion, and the driver's text to the peer.
    fn fail(&mut self, text: &FaultText);

    /// Does one tick for a driver that does not return: zero force, no motion, fault `text`. Returns the next due
    /// time in ns. Once the run is over, announces its end and returns `None`.
    fn turn_blocked(&mut self, text: &FaultText) -> Option<u64>;

    /// Announce the end to the peer, once the device is at rest and before anything waits for the report.
    fn announce_end(&mut self);

    /// End the loop. Returns its report; `None` if ended before.
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
                // Allocated before the memory is locked.
                let room = Box::new(MaybeUninit::zeroed());
                let (realtime, grants) = system::prepare(self.settings.realtime, LaterMemory::Locked);
                self.realtime = realtime;
                if let Err(refused) = realtime.check(self.settings.realtime.demand) {
                    // The end closes the recording.
                    self.stage = Stage::Ready(parts);
                    return Err(refused.into());
                }
                self.grants = Some(grants);
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
            // Repeated at each tick: a lost device does not recover.
            running.plant.side_mut().exchange_mut().device_failed(Some(text));
            // Now, not when the next sample is due: a report must not lie in the future.
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
                // Memory is locked per process: unlock at the end of the run, not on drop.
                self.grants = None;
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
