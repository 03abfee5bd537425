//! The live loop of one side, whoever waits for its ticks: take commands and what has arrived, tick, send, record.

use std::{any::Any, ops::ControlFlow, sync::atomic::Ordering};

use super::{
    channel::{LiveChannel, RELEASES},
    handle::{Ineffective, LoopChannels, MAX_COMMANDS, RecordSinks, Shared},
    handshakes::SecurityEvent,
    socket::PeerSocket,
    system::{self, RealtimeReport, RealtimeSettings},
};
use crate::{
    command::OperatorCommand,
    ladder::{Diagnosis, DiagnosisReport, FlightRecorder, LadderState, PRESS_NS},
    link::{LinkStatistics, LinkTime},
    pace::{TickTime, Wake},
    path::PathReport,
    recorder::RecordingReport,
    session::{MAX_DATAGRAM, Rejections},
    side::{Side, sealed_frame},
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
    /// When the operator started this side, in ns of the system's monotonic clock; when it is made, where nobody says.
    pub started_ns: Option<u64>,
    /// What to request of the system.
    pub realtime: RealtimeSettings,
}

/// How a live loop went.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct LoopReport {
    /// Ticks done.
    pub ticks: u64,
    /// Ticks left out because the loop woke too late.
    pub skipped: u64,
    /// Records that newer ones have replaced.
    pub dropped_records: u64,
    /// Frames that the system refused to send.
    pub unsent: u64,
    /// Datagrams from other addresses than a known peer's; refused in `link`, too.
    pub elsewhere: u64,
    /// Counts of the link.
    pub link: LinkStatistics,
    /// What the path did to the peer's frames, and what is known of its clock.
    pub path: PathReport,
    /// How often the ladder went to HOLD.
    pub holds: u64,
    /// Ticks at which a bound acted on the remote command.
    pub limited: u64,
    /// Samples that left the path of the others and were replaced.
    pub outliers: u64,
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

/// Part of the period that may be spent on what has arrived; more would let a flood stretch the tick.
const RECEIVE_SHARE: u64 = 4;
/// After each of the last frames and releases, the time in ns to the next: 20 ms in all, since losses occur in bursts.
const END_NS: [u64; 9] =
    [1_000_000, 1_000_000, 2_000_000, 4_000_000, 1_000_000, 1_000_000, 2_000_000, 8_000_000, 0];
/// Greatest age in ns of a command when the loop takes it, and for how long after a stall it takes no press: a signal
/// that was sent while the process stood still arrives when it goes on.
pub(super) const PROMPT_NS: u64 = 250_000_000;

/// Whether a command that was given at `at_ns` still counts at `now_ns`; `stalled_ns` is the end of the loop's last
/// stall, `failed_ns` when the side went to the fault in which it stands.
fn is_prompt(
    command: OperatorCommand,
    at_ns: u64,
    now_ns: u64,
    stalled_ns: Option<u64>,
    failed_ns: Option<u64>,
) -> bool {
    let is_young = now_ns.saturating_sub(at_ns) <= PROMPT_NS;
    match command {
        // A time that has not been yet would never grow old.
        OperatorCommand::Start => now_ns.checked_sub(at_ns).is_some_and(|age_ns| age_ns <= PRESS_NS),
        OperatorCommand::Press | OperatorCommand::Takeover => {
            is_young && stalled_ns.is_none_or(|stalled| at_ns > stalled + PROMPT_NS)
        }
        // It is of the fault that was there then, and of no later one.
        OperatorCommand::Acknowledge => is_young && failed_ns.is_none_or(|failed| failed <= at_ns),
        _ => true,
    }
}

/// A side with the sinks of its records. The loop steps it through this trait, so that it is compiled once for all sides.
pub(super) trait LoopSide {
    /// The side.
    fn side(&self) -> &dyn Side;

    /// The side, to change.
    fn side_mut(&mut self) -> &mut dyn Side;

    /// The side as its own type, for its driver.
    fn side_any(&mut self) -> &mut dyn Any;

    /// The loop's time 0 on the monotonic clock. The plant is left at rest from here on.
    fn begin(&mut self, now_ns: u64);

    /// Does one tick.
    fn tick(&mut self, time: TickTime);

    /// Hands the record of the last tick to the sinks; returns whether all records before it are still kept.
    fn record(&mut self) -> bool;

    /// No force and no motion from here on, once.
    fn rest(&mut self);

    /// Hands the link's counts to the sinks.
    fn count_link(&self, link: &LinkStatistics);

    /// Hands a diagnosis to the sinks, as [`RecordSinks::note`].
    fn note(&mut self, time_ns: u64, diagnosis: Option<&Diagnosis>);

    /// Ends the sinks.
    fn end_records(&mut self) -> Option<RecordingReport>;

    /// Closes the sinks where no loop began.
    fn abandon(&mut self) -> Option<RecordingReport>;
}

/// A side with the sinks of its records. Once it has begun, it leaves the plant at rest when it is dropped.
pub(super) struct RecordedSide<S: Side> {
    side: S,
    sinks: Option<RecordSinks<S::Record>>,
    record: S::Record,
    is_at_rest: bool,
}

impl<S: Side> RecordedSide<S> {
    pub(super) fn new(side: S, sinks: RecordSinks<S::Record>) -> Self {
        Self { side, sinks: Some(sinks), record: S::Record::default(), is_at_rest: true }
    }

    /// Once: an arm that is stopped again and again lets go of what it leans on.
    fn leave_at_rest(&mut self) {
        if !std::mem::replace(&mut self.is_at_rest, true) {
            self.side.rest();
        }
    }
}

impl<S: Side + 'static> LoopSide for RecordedSide<S> {
    fn side(&self) -> &dyn Side {
        &self.side
    }

    fn side_mut(&mut self) -> &mut dyn Side {
        &mut self.side
    }

    fn side_any(&mut self) -> &mut dyn Any {
        &mut self.side
    }

    fn begin(&mut self, now_ns: u64) {
        self.is_at_rest = false;
        self.side.begin(now_ns);
        self.sinks.iter().for_each(|sinks| sinks.start(now_ns));
    }

    fn tick(&mut self, time: TickTime) {
        self.side.tick_into(time, &mut self.record);
    }

    fn record(&mut self) -> bool {
        let Self { sinks, record, .. } = self;
        sinks.as_mut().is_none_or(|sinks| sinks.push(*record))
    }

    fn rest(&mut self) {
        self.leave_at_rest();
    }

    fn count_link(&self, link: &LinkStatistics) {
        self.sinks.iter().for_each(|sinks| sinks.count_link(link));
    }

    fn note(&mut self, time_ns: u64, diagnosis: Option<&Diagnosis>) {
        self.sinks.iter_mut().for_each(|sinks| sinks.note(time_ns, diagnosis));
    }

    fn end_records(&mut self) -> Option<RecordingReport> {
        self.sinks.take().and_then(RecordSinks::end)
    }

    fn abandon(&mut self) -> Option<RecordingReport> {
        self.sinks.take().and_then(RecordSinks::abandon)
    }
}

impl<S: Side> Drop for RecordedSide<S> {
    fn drop(&mut self) {
        self.leave_at_rest();
    }
}

/// One side, live.
pub(super) struct LiveLoop {
    socket: PeerSocket,
    channel: LiveChannel,
    settings: LiveSettings,
    channels: LoopChannels,
    report: LoopReport,
    start_ns: u64,
    /// Time of the last tick in ns.
    now_ns: u64,
    /// State that was last shown with its flight recorder.
    shown: LadderState,
    diagnosis: DiagnosisReport,
    has_announced_end: bool,
    /// When this loop last found itself stalled, in ns.
    stalled_ns: Option<u64>,
    buffer: [u8; MAX_DATAGRAM],
}

impl LiveLoop {
    /// Time begins.
    pub(super) fn begin(
        plant: &mut dyn LoopSide,
        socket: PeerSocket,
        channel: LiveChannel,
        settings: LiveSettings,
        channels: LoopChannels,
        start_ns: u64,
    ) -> Self {
        let secure = channel.session.is_secure();
        plant.begin(start_ns);
        Self {
            socket,
            channel,
            settings,
            channels,
            report: LoopReport { engaged_ns: u64::MAX, secure, ..LoopReport::default() },
            start_ns,
            now_ns: start_ns,
            shown: LadderState::Disengaged,
            diagnosis: DiagnosisReport::new(start_ns),
            has_announced_end: false,
            stalled_ns: None,
            buffer: [0; MAX_DATAGRAM],
        }
    }

    /// One tick; breaks where the run is over.
    pub(super) fn step(&mut self, plant: &mut dyn LoopSide, wake: Wake, shared: &Shared) -> ControlFlow<()> {
        let Wake { deadline_ns, overshoot_ns, missed } = wake;
        // The tick's time is its deadline, or that of the device's sample: the pure part sees a steady clock, as in
        // virtual time.
        let (now_ns, start_ns) = (deadline_ns, self.start_ns);
        self.now_ns = now_ns;
        self.report.skipped += missed;
        if wake.is_stalled() {
            self.stalled_ns = Some(system::now_ns());
            plant.side_mut().exchange_mut().stalled(now_ns);
            // Late already: another period for this is not much.
            self.socket.discard(system::now_ns() + self.settings.period_ns);
        }
        self.take_commands(plant.side_mut(), shared);
        let Self { socket, channel, settings, channels, .. } = self;
        let side = plant.side_mut();
        let late = || LinkTime::late(now_ns, system::now_ns().saturating_sub(now_ns));
        socket.drain(now_ns, now_ns + settings.period_ns / RECEIVE_SHARE, |asker, datagram| {
            // It may have arrived while this loop was still asleep beyond its time.
            channel.receive(late(), asker, datagram, side)
        });
        channel.advance(
            now_ns,
            |to, datagram| socket.send(to, datagram),
            |event| {
                let _ = channels.events.push(event);
            },
        );
        let found = socket.take_found().map(SecurityEvent::Found);
        let strangers = socket.take_strangers().map(SecurityEvent::Strangers);
        for event in found.into_iter().chain(strangers) {
            let _ = channels.events.push(event);
        }
        let time = TickTime { start_ns, now_ns, clock_ns: now_ns, overshoot_ns, missed };
        plant.tick(time);
        if let Some(datagram) = sealed_frame(&mut channel.session, late(), plant.side_mut(), &mut self.buffer)
        {
            socket.send(None, datagram);
        }
        self.report(plant, shared);
        let limit_ns = match self.report.engaged_ns {
            u64::MAX => self.settings.patience_ns,
            engaged_ns => self.settings.duration_ns.map(|duration_ns| engaged_ns.saturating_add(duration_ns)),
        };
        if limit_ns.is_some_and(|limit_ns| now_ns - start_ns >= limit_ns) {
            ControlFlow::Break(())
        } else {
            ControlFlow::Continue(())
        }
    }

    /// Carries out what the operator has commanded since the last tick, as far as it still counts.
    fn take_commands(&mut self, side: &mut dyn Side, shared: &Shared) {
        let Self { channel, channels, now_ns, stalled_ns, .. } = self;
        let now_ns = *now_ns;
        // As many as may wait at once: whoever commands without end does not hold the tick.
        for _ in 0..MAX_COMMANDS {
            let Some((at_ns, command)) = channels.commands.next(shared) else { break };
            let failed_ns = side.exchange().flight().failed_ns();
            let counts = is_prompt(command, at_ns, system::now_ns(), *stalled_ns, failed_ns);
            match command {
                #[allow(clippy::collapsible_match)] // a guard has no effects
                OperatorCommand::Start => {
                    if !counts && side.command(now_ns, OperatorCommand::Release) == Ok(true) {
                        shared.reject_press(Ineffective::OldStart);
                        shared.is_start_void.store(!side.has_button(), Ordering::Relaxed);
                    }
                }
                // A press that is said to do nothing must not couple once its obstacle is gone.
                OperatorCommand::Press if !counts => shared.reject_press(Ineffective::Late),
                OperatorCommand::Press if side.has_button() => shared.reject_press(Ineffective::HasButton),
                OperatorCommand::Press
                    if side.exchange().flight().diagnosis().is_some_and(Diagnosis::is_before_press) =>
                {
                    shared.reject_press(Ineffective::NotYet);
                }
                OperatorCommand::Takeover if counts => {
                    if let Err(still) = channel.session.allow_takeover(now_ns) {
                        let _ = channels.events.push(SecurityEvent::StillHeard(still));
                    }
                }
                _ if counts => {
                    // Refused before, unless the clutch has closed since.
                    if let Err(error) = side.command(now_ns, command) {
                        let _ = channels.events.push(SecurityEvent::Refused(error));
                    }
                }
                _ => {}
            }
        }
    }

    /// Hands out what a tick has left; nobody is waited for.
    fn report(&mut self, plant: &mut dyn LoopSide, shared: &Shared) {
        let Self { channels, report, now_ns, start_ns, .. } = self;
        let elapsed_ns = *now_ns - *start_ns;
        report.ticks += 1;
        report.dropped_records += u64::from(!plant.record());
        let exchange = plant.side().exchange();
        let (state, is_open) = (exchange.state(), exchange.is_open());
        if state.is_coupled() && report.engaged_ns == u64::MAX {
            report.engaged_ns = elapsed_ns;
        }
        // Until there was room: nobody may have looked at the one before.
        if state == self.shown
            || !matches!(state, LadderState::Stop | LadderState::Fault)
            || channels.flights.push(*exchange.flight()).is_ok()
        {
            self.shown = state;
        }
        if self.diagnosis.is_due(*now_ns, shared.diagnosis(exchange.flight()).as_ref()) {
            self.diagnosis.report(
                |newest| channels.diagnoses.push(newest).is_ok(),
                |newest| plant.note(elapsed_ns, newest),
            );
        }
        shared.state.store(state.code(), Ordering::Relaxed);
        shared.is_open.store(is_open, Ordering::Relaxed);
        shared.ticks.store(report.ticks, Ordering::Relaxed);
        // A round trip is known from the first answer on.
        let link = plant.side().exchange().link().statistics();
        plant.count_link(&link);
        shared.answered.store(link.round_trip_ns != 0, Ordering::Relaxed);
    }

    /// Leaves the plant at rest and announces the end of this side to the peer; nothing a second time.
    pub(super) fn announce_end(&mut self, plant: &mut dyn LoopSide, shared: &Shared) {
        if std::mem::replace(&mut self.has_announced_end, true) {
            return;
        }
        // First of all: what follows takes its time.
        plant.rest();
        let side = plant.side_mut();
        let Self { socket, channel, buffer, .. } = self;
        side.exchange_mut().end();
        for (sent, wait_ns) in END_NS.into_iter().enumerate() {
            let now_ns = system::now_ns();
            // A release ends the keys of the peer, so the frames that say why are sent first. In the clear there is
            // none.
            let datagram = if channel.session.is_secure() && sent + RELEASES >= END_NS.len() {
                channel.session.release(now_ns, buffer).ok()
            } else {
                sealed_frame(&mut channel.session, LinkTime::at(now_ns), side, buffer)
            };
            let Some(datagram) = datagram else { break };
            socket.send(None, datagram);
            system::sleep_until(now_ns + wait_ns);
        }
        // What follows takes memory.
        shared.at_rest.store(true, Ordering::Relaxed);
    }

    /// Leaves the plant at rest, announces the end to the peer, and closes what is open.
    pub(super) fn end(
        mut self,
        plant: &mut dyn LoopSide,
        shared: &Shared,
    ) -> (LoopReport, Box<FlightRecorder>) {
        self.announce_end(plant, shared);
        let exchange = plant.side().exchange();
        let (counts, flight) = (exchange.counts(), Box::new(*exchange.flight()));
        self.report.path = exchange.link().path().report(self.now_ns);
        let Self { socket, mut channel, mut channels, mut report, now_ns, start_ns, .. } = self;
        let mut diagnosis = self.diagnosis;
        if diagnosis.is_unreported(shared.diagnosis(&flight).as_ref()) {
            diagnosis.report(
                |newest| channels.diagnoses.push(newest).is_ok(),
                |newest| plant.note(now_ns - start_ns, newest),
            );
        }
        report.out_of_memory = system::is_exhausted();
        report.rejections = channel.end();
        report.link = counts.link.with(&report.rejections);
        (report.holds, report.limited, report.outliers) = (counts.holds, counts.limited, counts.outliers);
        report.unsent = socket.unsent;
        report.elsewhere = socket.elsewhere();
        report.link.refused += report.elsewhere;
        report.recording = plant.end_records();
        (report, flight)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use OperatorCommand::{Acknowledge, ForceScale, Press, Start, Takeover};

    const MS: u64 = 1_000_000;

    /// A command of 10 s, when it still counts.
    #[test]
    fn commands_count_for_a_time_of_their_own() {
        let at = 10_000 * MS;
        for (command, later_ms, stalled, failed, counts) in [
            (Start, 5000, None, None, true),
            (Start, 5001, None, None, false),
            (Press, 250, None, None, true),
            (Press, 251, None, None, false),
            (Press, 0, Some(at - 250 * MS), None, false),
            (Press, 0, Some(at - 251 * MS), None, true),
            (Takeover, 251, None, None, false),
            (Takeover, 0, Some(at - 250 * MS), None, false),
            (Acknowledge, 250, Some(at), Some(at), true),
            (Acknowledge, 251, None, None, false),
            (Acknowledge, 0, None, Some(at + 1), false),
            (ForceScale(1.0), 60_000, Some(at), Some(at + 1), true),
        ] {
            let seen = is_prompt(command, at, at + later_ms * MS, stalled, failed);
            assert_eq!(seen, counts, "{command:?} {later_ms} {stalled:?} {failed:?}");
        }
        assert!(!is_prompt(Start, at, at - 1, None, None), "a start that is still to come");
    }
}
