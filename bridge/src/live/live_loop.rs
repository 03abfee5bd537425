//! Live loop of one side: take commands and datagrams, tick, send, record.

use std::{any::Any, ops::ControlFlow, sync::atomic::Ordering};

use super::{
    channel::{LiveChannel, RELEASES},
    handle::{Ineffective, LoopChannels, MAX_COMMANDS, PROMPT_NS, RecordSinks, Shared},
    handshakes::SecurityEvent,
    slow_device::{SlowDevice, SlowWatch},
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

/// Settings of a live loop.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LiveSettings {
    /// Role of this side.
    pub role: Role,
    /// Period in ns.
    pub period_ns: u64,
    /// Time in ns after the sides engaged at which the loop ends.
    pub duration_ns: Option<u64>,
    /// Time in ns after which the loop ends unless engaged.
    pub patience_ns: Option<u64>,
    /// Start by the operator, in ns of the monotonic clock; `None` for the loop's creation.
    pub started_ns: Option<u64>,
    /// Real-time requests to the system.
    pub realtime: RealtimeSettings,
}

/// Report of a live loop.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct LoopReport {
    /// Ticks done.
    pub ticks: u64,
    /// Ticks skipped because the loop woke too late.
    pub skipped: u64,
    /// Records replaced by newer ones.
    pub dropped_records: u64,
    /// Frames that the system refused to send.
    pub unsent: u64,
    /// Datagrams from other addresses than a known peer's; included in `link`.
    pub elsewhere: u64,
    /// Counts of the link.
    pub link: LinkStatistics,
    /// Path of the peer's frames, and estimate of its clock.
    pub path: PathReport,
    /// Number of transitions of the ladder to HOLD.
    pub holds: u64,
    /// Ticks at which a bound acted on the remote command.
    pub limited: u64,
    /// Outlier samples that were replaced.
    pub outliers: u64,
    /// Share of the ticks with a new sample of the device, as last measured; none of a simulated device.
    pub renewal: Option<f64>,
    /// True if frames were encrypted and authenticated.
    pub secure: bool,
    /// Datagrams rejected by the session, by cause; included in `link`.
    pub rejections: Rejections,
    /// First engagement of the sides, in ns since the start; `u64::MAX` if never.
    pub engaged_ns: u64,
    /// Real-time scheduling granted to the loop's thread.
    pub realtime: RealtimeReport,
    /// Report of the recording, if any.
    pub recording: Option<RecordingReport>,
    /// True if the loop ended because memory ran out.
    pub out_of_memory: bool,
}

/// Inverse share of the period for receiving, so that a flood cannot stretch the tick.
const RECEIVE_SHARE: u64 = 4;
/// Waits in ns after each of the last frames and releases: 20 ms in all, since losses occur in bursts.
const END_NS: [u64; 9] =
    [1_000_000, 1_000_000, 2_000_000, 4_000_000, 1_000_000, 1_000_000, 2_000_000, 8_000_000, 0];

/// Return whether a command of `at_ns` is still valid at `now_ns`. `stalled_ns` is the end of the last stall,
/// `failed_ns` the time of the present fault.
fn is_prompt(
    command: OperatorCommand,
    at_ns: u64,
    now_ns: u64,
    stalled_ns: Option<u64>,
    failed_ns: Option<u64>,
) -> bool {
    let is_young = now_ns.saturating_sub(at_ns) <= PROMPT_NS;
    match command {
        // A future time would never expire.
        OperatorCommand::Start => now_ns.checked_sub(at_ns).is_some_and(|age_ns| age_ns <= PRESS_NS),
        OperatorCommand::Press | OperatorCommand::Takeover => {
            is_young && stalled_ns.is_none_or(|stalled| at_ns > stalled + PROMPT_NS)
        }
        // A hand or tool must not move for what a person did long ago.
        OperatorCommand::Aim(_) | OperatorCommand::Push(_) => is_young,
        // It is for the fault of that time, not a later one.
        OperatorCommand::Acknowledge => is_young && failed_ns.is_none_or(|failed| failed <= at_ns),
        _ => true,
    }
}

/// A side with its sinks. The loop steps this trait, so that it is compiled once.
pub(super) trait LoopSide {
    fn side(&self) -> &dyn Side;

    fn side_mut(&mut self) -> &mut dyn Side;

    /// The concrete side, for its driver.
    fn side_any(&mut self) -> &mut dyn Any;

    /// Set time 0 of the loop on the monotonic clock.
    fn begin(&mut self, now_ns: u64);

    fn tick(&mut self, time: TickTime);

    /// Pass the last record to the sinks. Returns whether all earlier ones are kept.
    fn record(&mut self) -> bool;

    /// Remove force and motion, once.
    fn rest(&mut self);

    fn count_link(&self, link: &LinkStatistics);

    /// Pass a diagnosis to the sinks, as [`RecordSinks::note`].
    fn note(&mut self, time_ns: u64, diagnosis: Option<&Diagnosis>);

    fn end_records(&mut self) -> Option<RecordingReport>;

    /// Close the sinks if no loop began.
    fn abandon(&mut self) -> Option<RecordingReport>;
}

/// A side with its sinks. Once begun, a drop leaves the plant at rest.
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

    /// Once: repeated stops give up a contact.
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

pub(super) struct LiveLoop {
    socket: PeerSocket,
    channel: LiveChannel,
    settings: LiveSettings,
    channels: LoopChannels,
    report: LoopReport,
    start_ns: u64,
    /// Time of the last tick in ns.
    now_ns: u64,
    /// Last state whose flight recorder was handed out.
    shown: LadderState,
    diagnosis: DiagnosisReport,
    has_announced_end: bool,
    /// End of the last stall in ns.
    stalled_ns: Option<u64>,
    slow: SlowWatch,
    buffer: [u8; MAX_DATAGRAM],
}

impl LiveLoop {
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
            slow: SlowWatch::default(),
            buffer: [0; MAX_DATAGRAM],
        }
    }

    pub(super) fn step(&mut self, plant: &mut dyn LoopSide, wake: Wake, shared: &Shared) -> ControlFlow<()> {
        let Wake { deadline_ns, overshoot_ns, missed } = wake;
        // The pure part sees a steady clock, as in virtual time: the deadline, or the time of the device's sample.
        let (now_ns, start_ns) = (deadline_ns, self.start_ns);
        self.now_ns = now_ns;
        self.report.skipped += missed;
        if wake.is_stalled() {
            self.stalled_ns = Some(system::now_ns());
            plant.side_mut().exchange_mut().stalled(now_ns);
            // The loop is late already: one more period hardly matters.
            self.socket.discard(system::now_ns() + self.settings.period_ns);
        }
        self.take_commands(plant.side_mut(), shared);
        let Self { socket, channel, settings, channels, .. } = self;
        let side = plant.side_mut();
        let late = || LinkTime::late(now_ns, system::now_ns().saturating_sub(now_ns));
        socket.drain(now_ns, now_ns + settings.period_ns / RECEIVE_SHARE, |reply_address, datagram| {
            // It may have arrived while this loop overslept.
            channel.receive(late(), reply_address, datagram, side)
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

    /// Carry out the valid commands since the last tick.
    fn take_commands(&mut self, side: &mut dyn Side, shared: &Shared) {
        let Self { channel, channels, now_ns, stalled_ns, .. } = self;
        let now_ns = *now_ns;
        // Bounded, so that endless commands cannot hold the tick.
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
                // A press reported as ineffective must not couple once its obstacle is gone.
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
                    // Checked when queued: fails only if the clutch has closed since.
                    if let Err(error) = side.command(now_ns, command) {
                        let _ = channels.events.push(SecurityEvent::Refused(error));
                    }
                }
                _ => {}
            }
        }
    }

    /// Hand out the results of a tick, without waiting.
    fn report(&mut self, plant: &mut dyn LoopSide, shared: &Shared) {
        let Self { channels, report, now_ns, start_ns, .. } = self;
        let elapsed_ns = *now_ns - *start_ns;
        report.ticks += 1;
        report.dropped_records += u64::from(!plant.record());
        let exchange = plant.side().exchange();
        let (state, is_open) = (exchange.state(), exchange.is_open());
        if let Some(share) = self.slow.poll(exchange.renewal) {
            let LiveSettings { role, period_ns, .. } = self.settings;
            let _ = channels.events.push(SecurityEvent::SlowDevice(SlowDevice { role, period_ns, share }));
        }
        if state.is_coupled() && report.engaged_ns == u64::MAX {
            report.engaged_ns = elapsed_ns;
        }
        // Retried until there is room: the previous recorder may not have been read.
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
        shared.next_period.store(elapsed_ns / self.settings.period_ns + 1, Ordering::Relaxed);
        // The round trip is known from the first answer on.
        let link = plant.side().exchange().link().statistics();
        plant.count_link(&link);
        shared.answered.store(link.round_trip_ns != 0, Ordering::Relaxed);
    }

    /// Leave the plant at rest and announce the end to the peer, once.
    pub(super) fn announce_end(&mut self, plant: &mut dyn LoopSide, shared: &Shared) {
        if std::mem::replace(&mut self.has_announced_end, true) {
            return;
        }
        // First: the rest takes time.
        plant.rest();
        let side = plant.side_mut();
        let Self { socket, channel, buffer, .. } = self;
        side.exchange_mut().end();
        for (sent, wait_ns) in END_NS.into_iter().enumerate() {
            let now_ns = system::now_ns();
            // A release ends the peer's keys, so the frames with the reason go first.
            let datagram = if channel.session.is_secure() && sent + RELEASES >= END_NS.len() {
                channel.session.release(now_ns, buffer).ok()
            } else {
                sealed_frame(&mut channel.session, LinkTime::at(now_ns), side, buffer)
            };
            let Some(datagram) = datagram else { break };
            socket.send(None, datagram);
            system::sleep_until(now_ns + wait_ns);
        }
        // Memory is needed from here on.
        shared.at_rest.store(true, Ordering::Relaxed);
    }

    /// Announce the end and close sinks and session.
    pub(super) fn end(
        mut self,
        plant: &mut dyn LoopSide,
        shared: &Shared,
    ) -> (LoopReport, Box<FlightRecorder>) {
        self.announce_end(plant, shared);
        let exchange = plant.side().exchange();
        let (counts, flight) = (exchange.counts(), Box::new(*exchange.flight()));
        self.report.renewal = exchange.renewal;
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

    /// Validity of a command given at 10 s.
    #[test]
    fn commands_expire() {
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
        assert!(!is_prompt(Start, at, at - 1, None, None), "a start in the future");
    }
}
