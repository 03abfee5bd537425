//! A live loop that somebody else turns: a driver outside of this crate, whose device paces it.

use std::{
    ops::ControlFlow,
    sync::{Arc, atomic::Ordering},
};

use super::{
    channel::{LiveChannel, Security},
    clock,
    handshakes::StartError,
    realtime::{self, Kept, RealtimeReport},
    run::{LiveSettings, LoopReport, Shared, assemble},
    socket::PeerSocket,
    turning::{LiveLoop, LoopChannels},
    watch::LiveWatch,
};
use crate::{
    fault_text::{FaultText, PIECES},
    ladder::FlightRecorder,
    pace::{DevicePace, Wake},
    recorder::Recorder,
    side::Side,
};

/// Ticks after a device has failed in which the peer is told so: frames get lost, and the driver's words come in pieces.
const FAILED_TICKS: u32 = 3 * PIECES as u32;

/// How far the loop is.
enum Stage<S: Side> {
    Ready(Box<(S, PeerSocket, LiveChannel, LoopChannels<S::Record>)>),
    LiveLoop(Box<LiveLoop<S>>),
    Over,
}

/// The loop of one side, a tick at a time: `begin`, then at every sample of the device `turn`, at last `end`.
///
/// A driver that does not wait for its device calls `wait` after each tick. All of it on one thread.
pub struct PacedLoop<S: Side> {
    stage: Stage<S>,
    settings: LiveSettings,
    shared: Arc<Shared>,
    pace: DevicePace,
    /// The last tick was waited for here, and not by the device.
    waited: bool,
    realtime: RealtimeReport,
    kept: Option<Kept>,
}

/// Prepares the loop of one side; `recorder` gets every record, too.
pub fn paced_by_device<S: Side>(
    side: S,
    socket: PeerSocket,
    settings: LiveSettings,
    security: Security,
    recorder: Option<Recorder<S::Record>>,
) -> Result<(PacedLoop<S>, LiveWatch<S::Record>), StartError> {
    let (channel, ways, watch) = assemble::<S>(&socket, &settings, security, recorder)?;
    let paced = PacedLoop {
        stage: Stage::Ready(Box::new((side, socket, channel, ways))),
        settings,
        shared: Arc::clone(&watch.shared),
        pace: DevicePace::new(settings.period_ns),
        waited: false,
        realtime: RealtimeReport::default(),
        kept: None,
    };
    Ok((paced, watch))
}

impl<S: Side> PacedLoop<S> {
    /// Time begins; asks the system for real time for this thread. Nothing if it has begun.
    ///
    /// Fails, and is over, where real-time scheduling is required and not all of it was granted.
    pub fn begin(&mut self) -> Result<RealtimeReport, StartError> {
        match std::mem::replace(&mut self.stage, Stage::Over) {
            Stage::Ready(parts) => {
                let (realtime, kept) = realtime::prepare(self.settings.realtime);
                realtime.check(self.settings.realtime.demand)?;
                (self.realtime, self.kept) = (realtime, Some(kept));
                let (side, socket, channel, ways) = *parts;
                let now_ns = clock::now_ns();
                self.pace.begin(now_ns);
                let turning = LiveLoop::begin(side, socket, channel, self.settings, ways, now_ns);
                self.stage = Stage::LiveLoop(Box::new(turning));
            }
            stage => self.stage = stage,
        }
        Ok(self.realtime)
    }

    /// One tick: `before` hands the side its sample, `after` takes what it decided. None where the run is over.
    pub fn turn<T>(&mut self, before: impl FnOnce(&mut S), after: impl FnOnce(&mut S) -> T) -> Option<T> {
        let Stage::LiveLoop(turning) = &mut self.stage else { return None };
        if self.shared.must_end() {
            self.shared.stop.store(true, Ordering::Relaxed);
            return None;
        }
        let wake = if std::mem::take(&mut self.waited) {
            self.pace.waited(clock::now_ns())
        } else {
            if clock::now_ns() < self.pace.least_ns() {
                clock::sleep_until(self.pace.least_ns());
            }
            self.pace.sampled(clock::now_ns())
        };
        before(turning.side());
        match turning.turn(wake, &self.shared) {
            ControlFlow::Continue(()) => Some(after(turning.side())),
            ControlFlow::Break(()) => {
                self.shared.stop.store(true, Ordering::Relaxed);
                None
            }
        }
    }

    /// Sleeps until the next tick is due.
    pub fn wait(&mut self) {
        clock::sleep_until(self.pace.next_ns());
        self.waited = true;
    }

    /// The device is gone: zero force and no motion, and the peer is told, in the driver's words where there are any.
    pub fn fail(&mut self, text: &FaultText) {
        let Stage::LiveLoop(turning) = &mut self.stage else { return };
        self.shared.ends.store(true, Ordering::Relaxed);
        for _ in 0..FAILED_TICKS {
            // Anew at each: nobody can mend what is gone.
            turning.side().device_failed();
            turning.side().describe_failure(text);
            // Now, and not when the next sample would have been due: what is told must not come from the future.
            let wake = self.pace.sampled(clock::now_ns());
            let wake = Wake { overshoot_ns: 0, missed: 0, ..wake };
            if turning.turn(wake, &self.shared).is_break() {
                break;
            }
            clock::sleep_until(self.pace.next_ns());
        }
        self.shared.stop.store(true, Ordering::Relaxed);
        turning.announce_end(&self.shared);
    }

    /// The device is at rest: tells the peer that this side ends, before whoever waits for the report does.
    pub fn announce_end(&mut self) {
        if let Stage::LiveLoop(turning) = &mut self.stage {
            self.shared.stop.store(true, Ordering::Relaxed);
            turning.announce_end(&self.shared);
        }
    }

    /// Ends the loop and gives its report, for [`LiveWatch::ended`]; none if it was given before.
    pub fn end(&mut self) -> Option<(LoopReport, Option<Box<FlightRecorder>>)> {
        self.shared.stop.store(true, Ordering::Relaxed);
        let realtime = self.realtime;
        match std::mem::replace(&mut self.stage, Stage::Over) {
            Stage::LiveLoop(turning) => {
                let (report, flight) = turning.end(&self.shared);
                // Locked memory is the process's: it is given back with the run, not with the last who holds the loop.
                self.kept = None;
                Some((LoopReport { realtime, ..report }, Some(flight)))
            }
            Stage::Ready(parts) => {
                let recording = parts.3.records.end();
                Some((
                    LoopReport { recording, realtime, engaged_ns: u64::MAX, ..LoopReport::default() },
                    None,
                ))
            }
            Stage::Over => None,
        }
    }
}

impl<S: Side> Drop for PacedLoop<S> {
    fn drop(&mut self) {
        self.end();
    }
}
