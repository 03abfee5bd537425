//! One live tick, whoever waits for its time: take what has arrived, tick, send, record.

use std::{
    ops::ControlFlow,
    sync::atomic::{AtomicU64, Ordering},
};

use super::{
    channel::{LiveChannel, RELEASES},
    clock,
    handshakes::SecurityEvent,
    memory,
    outlets::RecordSinks,
    run::{Ineffective, LiveSettings, LoopReport, Shared},
    socket::PeerSocket,
};
use crate::{
    act::OperatorCommand,
    ladder::{Diagnosis, FlightRecorder, LadderState, START_NS},
    pace::Wake,
    session::MAX_DATAGRAM,
    side::{Side, TickTime},
};

/// Part of the period that may be spent on what has arrived; more would let a flood stretch the tick.
const MAX_TAKING: u64 = 4;
/// After each of the last frames and releases, the time in ns to the next: 20 ms in all, since losses come in bursts.
const END_NS: [u64; 9] =
    [1_000_000, 1_000_000, 2_000_000, 4_000_000, 1_000_000, 1_000_000, 2_000_000, 8_000_000, 0];
/// A diagnosis is told once it has stood for this long in ns: the words of a peer come in pieces.
const SETTLED_NS: u64 = 50_000_000;
/// Longest age in ns of what a person did when the loop takes it, and for how long after a stall it takes no press: a
/// signal that was sent while the process stood still comes when it goes on.
const PROMPT_NS: u64 = 250_000_000;

/// A side that is left without force or motion however its loop ends.
struct Resting<S: Side>(S, bool);

impl<S: Side> Resting<S> {
    /// Once: an arm that is stopped again and again lets go of what it leans on.
    fn rest(&mut self) {
        if !std::mem::replace(&mut self.1, true) {
            self.0.rest();
        }
    }
}

impl<S: Side> Drop for Resting<S> {
    fn drop(&mut self) {
        self.rest();
    }
}

/// Why the two are not coupled, and whether that was told.
struct Diagnosed {
    now: Option<Diagnosis>,
    since_ns: u64,
    is_told: bool,
}

impl Diagnosed {
    /// Whether `newest` was not told yet.
    fn is_told_not(&mut self, newest: Option<&Diagnosis>) -> bool {
        if self.now.as_ref() != newest {
            (self.now, self.is_told) = (newest.copied(), false);
        }
        !self.is_told
    }

    /// Whether it has stood for long enough, and was not told yet.
    fn is_due(&mut self, now_ns: u64, newest: Option<&Diagnosis>) -> bool {
        // More words on the same case, or a link that comes and goes, do not put off what was not told yet.
        let is_same_case = |now: &Diagnosis| newest.is_some_and(|newest| now.is_same_case(newest));
        if self.now.as_ref() != newest && (self.is_told || !self.now.as_ref().is_some_and(is_same_case)) {
            self.since_ns = now_ns;
        }
        self.is_told_not(newest) && now_ns.saturating_sub(self.since_ns) >= SETTLED_NS
    }

    /// Tells it, `time_ns` after the start; again at the next tick where nobody has taken those before.
    fn tell<R: Copy>(
        &mut self,
        time_ns: u64,
        records: &mut RecordSinks<R>,
        diagnoses: &mut rtrb::Producer<Option<Diagnosis>>,
    ) {
        self.is_told = diagnoses.push(self.now).is_ok();
        if let Some(diagnosis) = self.now.filter(|_| self.is_told) {
            records.note(time_ns, &diagnosis);
        }
    }
}

/// The loop's ends of what leads to and from it; none of them is ever waited for.
pub(super) struct LoopChannels<R> {
    pub(super) records: RecordSinks<R>,
    pub(super) events: rtrb::Producer<SecurityEvent>,
    pub(super) flights: rtrb::Producer<FlightRecorder>,
    pub(super) diagnoses: rtrb::Producer<Option<Diagnosis>>,
    pub(super) acts: rtrb::Consumer<(u64, OperatorCommand)>,
    /// When a person started this side, in ns, until the first tick.
    pub(super) started_ns: Option<u64>,
}

/// A side in its loop.
pub(super) struct LiveLoop<S: Side> {
    side: Resting<S>,
    socket: PeerSocket,
    channel: LiveChannel,
    settings: LiveSettings,
    ways: LoopChannels<S::Record>,
    report: LoopReport,
    start_ns: u64,
    /// Of the last tick.
    now_ns: u64,
    shown: LadderState,
    diagnosed: Diagnosed,
    has_announced_end: bool,
    /// End of the last stall, in ns.
    stalled_ns: Option<u64>,
    buffer: [u8; MAX_DATAGRAM],
}

impl<S: Side> LiveLoop<S> {
    /// Time begins at `start_ns`.
    pub(super) fn begin(
        mut side: S,
        socket: PeerSocket,
        channel: LiveChannel,
        settings: LiveSettings,
        ways: LoopChannels<S::Record>,
        start_ns: u64,
    ) -> Self {
        let report =
            LoopReport { engaged_ns: u64::MAX, secure: channel.is_secure(), ..LoopReport::default() };
        side.begin(start_ns);
        Self {
            side: Resting(side, false),
            socket,
            channel,
            settings,
            ways,
            report,
            start_ns,
            now_ns: start_ns,
            shown: LadderState::Disengaged,
            diagnosed: Diagnosed { now: None, since_ns: start_ns, is_told: true },
            has_announced_end: false,
            stalled_ns: None,
            buffer: [0; MAX_DATAGRAM],
        }
    }

    /// What is driven.
    pub(super) fn side(&mut self) -> &mut S {
        &mut self.side.0
    }

    /// One tick; breaks where the run is over.
    pub(super) fn turn(&mut self, wake: Wake, shared: &Shared) -> ControlFlow<()> {
        let Self { side: Resting(side, _), socket, channel, settings, ways, report, .. } = self;
        let LoopChannels { records, events, flights, diagnoses, acts, started_ns } = ways;
        let mut tell = |event| {
            let _ = events.push(event);
        };
        let Wake { deadline_ns, overshoot_ns, missed } = wake;
        report.skipped += missed;
        if wake.is_stalled() {
            self.stalled_ns = Some(clock::now_ns());
            side.stalled(deadline_ns);
            // Late already: another period for this is not much.
            socket.discard(clock::now_ns() + settings.period_ns);
        }
        // The tick's time is its deadline, or that of the device's sample: the pure part sees a steady clock, as in
        // virtual time.
        let now_ns = deadline_ns;
        self.now_ns = now_ns;
        let stalled_ns = self.stalled_ns;
        // Of a side that opened late, or whose first sample was late, the start is no press any more; nor is one of a
        // time that has not been yet, which would never grow old.
        if let Some(started_ns) = started_ns.take()
            && clock::now_ns().checked_sub(started_ns).is_none_or(|age_ns| age_ns > START_NS)
            && side.release_clutch()
        {
            shared.reject_press(Ineffective::OldStart);
        }
        let is_prompt = |at_ns: u64| clock::now_ns().saturating_sub(at_ns) <= PROMPT_NS;
        // None where nobody asked, else whether it counts.
        let asked = |at_ns: &AtomicU64| match at_ns.swap(0, Ordering::Relaxed) {
            0 => None,
            at_ns => Some(is_prompt(at_ns) && stalled_ns.is_none_or(|stalled| at_ns > stalled + PROMPT_NS)),
        };
        if let Some(counts) = asked(&shared.press_ns) {
            // A press that is said to do nothing must not couple once its obstacle is gone.
            if !counts {
                shared.reject_press(Ineffective::Late);
            } else if side.has_button() {
                shared.reject_press(Ineffective::HasButton);
            } else if side.flight().diagnosis().is_some_and(Diagnosis::is_before_press) {
                shared.reject_press(Ineffective::NotYet);
            } else {
                side.press_again();
            }
        }
        if asked(&shared.takeover_ns) == Some(true) {
            channel.allow_takeover(now_ns, &mut tell);
        }
        while let Ok((at_ns, act)) = acts.pop() {
            // It is of the fault that was there then, and of no later one.
            let is_of_this_fault = || side.flight().failed_ns().is_none_or(|failed_ns| failed_ns <= at_ns);
            if act != OperatorCommand::Acknowledge || is_prompt(at_ns) && is_of_this_fault() {
                // `LiveRun::act` has refused what cannot be.
                let _ = side.act(now_ns, act);
            }
        }
        let until_ns = deadline_ns + settings.period_ns / MAX_TAKING;
        socket.drain(now_ns, until_ns, |from, datagram| {
            // It may have come while this loop was still asleep beyond its time.
            side.late(clock::now_ns().saturating_sub(now_ns));
            channel.receive(now_ns, from, datagram, side)
        });
        channel.advance(now_ns, |to, datagram| socket.send(to, datagram), &mut tell);
        let start_ns = self.start_ns;
        let record = side.tick(TickTime { start_ns, now_ns, clock_ns: now_ns, overshoot_ns, missed });
        side.late(clock::now_ns().saturating_sub(now_ns));
        if let Some(datagram) = channel.send(now_ns, side, &mut self.buffer) {
            socket.send(None, datagram);
        }
        report.ticks += 1;
        if records.push(record).is_err() {
            report.dropped_records += 1;
        }
        let state = side.state();
        if state.is_coupled() && report.engaged_ns == u64::MAX {
            report.engaged_ns = now_ns - start_ns;
        }
        // Until there was room: nobody may have looked at the one before.
        if state == self.shown
            || !matches!(state, LadderState::Stop | LadderState::Fault)
            || flights.push(*side.flight()).is_ok()
        {
            self.shown = state;
        }
        if self.diagnosed.is_due(now_ns, shared.diagnosis(side.flight()).as_ref()) {
            self.diagnosed.tell(now_ns - start_ns, records, diagnoses);
        }
        shared.state.store(state.code(), Ordering::Relaxed);
        shared.ticks.store(report.ticks, Ordering::Relaxed);
        // A round trip is known from the first answer on.
        shared.answered.store(side.counts().link.round_trip_ns != 0, Ordering::Relaxed);
        let elapsed_ns = now_ns - start_ns;
        let limit_ns = match report.engaged_ns {
            u64::MAX => settings.patience_ns,
            engaged_ns => settings.duration_ns.map(|duration_ns| engaged_ns.saturating_add(duration_ns)),
        };
        if limit_ns.is_some_and(|limit_ns| elapsed_ns >= limit_ns) {
            ControlFlow::Break(())
        } else {
            ControlFlow::Continue(())
        }
    }

    /// Leaves the plant at rest and tells the peer that this side ends; nothing a second time.
    pub(super) fn announce_end(&mut self, shared: &Shared) {
        if std::mem::replace(&mut self.has_announced_end, true) {
            return;
        }
        // First of all: what follows takes its time.
        self.side.rest();
        let Self { side: Resting(side, _), socket, channel, buffer, .. } = self;
        side.end();
        side.late(0);
        for (sent, wait_ns) in END_NS.into_iter().enumerate() {
            let now_ns = clock::now_ns();
            // A release ends the keys of the peer, so the frames that say why come first. In the clear there is none.
            let datagram = if channel.is_secure() && sent + RELEASES >= END_NS.len() {
                channel.release(now_ns, buffer).ok()
            } else {
                channel.send(now_ns, side, buffer)
            };
            let Some(datagram) = datagram else { break };
            socket.send(None, datagram);
            clock::sleep_until(now_ns + wait_ns);
        }
        // What follows takes memory.
        shared.at_rest.store(true, Ordering::Relaxed);
    }

    /// Leaves the plant at rest, tells the peer, and closes what is open.
    pub(super) fn end(mut self, shared: &Shared) -> (LoopReport, Box<FlightRecorder>) {
        self.announce_end(shared);
        let (counts, flight) = (self.side.0.counts(), Box::new(*self.side.0.flight()));
        self.report.path = self.side.0.path(self.now_ns);
        let Self { side, socket, mut channel, mut ways, mut report, now_ns, start_ns, mut diagnosed, .. } =
            self;
        drop(side);
        if diagnosed.is_told_not(shared.diagnosis(&flight).as_ref()) {
            diagnosed.tell(now_ns - start_ns, &mut ways.records, &mut ways.diagnoses);
        }
        report.out_of_memory = memory::is_exhausted();
        report.rejections = channel.end();
        report.link = counts.link.with(&report.rejections);
        (report.holds, report.limited) = (counts.holds, counts.limited);
        report.unsent = socket.unsent;
        report.recording = ways.records.end();
        (report, flight)
    }
}
