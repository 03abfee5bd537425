//! What both endpoints have: a link, a ladder, and what goes out next.

use std::sync::Arc;

use haptether_safety::{Axes, Excess, Fault, controller::SafetySettings};

use crate::{
    SideKind,
    coupling::GripperState,
    fault_text::{FaultText, HeardText, SpokenText},
    ladder::{
        AlignmentState, Diagnosis, FlightEntry, FlightRecorder, FlightValues, LAYERS, Ladder, LadderError,
        LadderInputs, LadderSettings, LadderState, LinkView, Observed, PeerCause, PeerFrame, Reason,
        thresholds,
    },
    link::{FrameHead, FrameLink, LinkStatistics, LinkTime, PortState, RejectReason, Status},
    wire::{Frame, FrameLayout, MAX_FRAME, Role},
};

/// What a side has counted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SideCounts {
    /// Of the link.
    pub link: LinkStatistics,
    /// How often the ladder went to HOLD.
    pub holds: u64,
    /// Ticks at which a bound acted on the remote command; a master has none.
    pub limited: u64,
    /// Samples that left the path of the others and were replaced.
    pub outliers: u64,
}

/// What has happened since the last tick, in any combination: set by whoever sees it, read by the endpoint's tick, and
/// cleared by [`Exchange::end_tick`], so that each event counts at one tick only.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct TickEvents {
    /// A run of the peer began, its first or another.
    pub(super) peer_began: bool,
    /// The loop was late by more than the ladder allows.
    stalled: bool,
    /// The device has failed, or says so.
    pub(super) device_failed: bool,
}

/// The flight recorder of a side.
#[derive(Clone, Debug)]
enum Flight {
    /// It is kept.
    Kept(Box<FlightRecorder>),
    /// Nobody will read it, so that it stays as it was; a side that is copied does not copy it.
    LeftOut(Arc<FlightRecorder>),
}

/// The part of an endpoint that talks to the peer.
#[derive(Clone, Debug)]
pub struct Exchange {
    pub(super) ladder: Ladder,
    role: Role,
    pub(super) link: FrameLink,
    /// What the next frame says of the plant.
    pub(super) outgoing: PortState,
    /// Shortest time in ns between two frames of the peer, as it sends them, over [`COUNTED`] of them.
    interval_ns: Option<u64>,
    /// The same over those that arrived until there were as many.
    first_interval_ns: Option<u64>,
    /// Sequence and sending time of the frame that the next count begins with.
    counted: (u64, u64),
    /// Its own, which stands for the peer's until that is known.
    pub(super) period_ns: u64,
    inputs: LadderInputs,
    flight: Flight,
    /// Ticks at which a bound acted on the remote command.
    pub(super) limited_ticks: u64,
    /// Samples that left the path of the others and were replaced.
    pub(crate) outliers: u64,
    pub(super) events: TickEvents,
    /// Code of this side's fault, 0 without, and the driver's text on it.
    fault: u8,
    spoken: SpokenText,
    /// The driver's text on a failure that the next tick meets.
    failing: Option<FaultText>,
    /// What the peer says of its fault.
    heard: HeardText,
    /// Why the peer last held.
    peer_held: u8,
    /// This side ends: its frames say so.
    ending: bool,
    /// The peer has ended, by its last frames or by releasing its session.
    peer_ended: bool,
}

/// Longest period of a loop in ns: a peer cannot request more patience.
const MAX_INTERVAL_NS: u64 = 20_000_000;
/// Frames whose mean interval is taken: one loop that wakes late shortens the next interval by its lateness.
const COUNTED: u64 = 16;

impl Exchange {
    /// A part of role `role` that has not heard of its peer; `run_id` is drawn anew at every start.
    pub fn new(
        role: Role,
        axes: usize,
        run_id: u64,
        period_ns: u64,
        settings: LadderSettings,
    ) -> Result<Self, LadderError> {
        Ok(Self {
            ladder: Ladder::new(settings)?,
            role,
            link: FrameLink::new(role, axes, run_id, settings.stop_after_ns),
            outgoing: PortState::default(),
            interval_ns: None,
            first_interval_ns: None,
            counted: (0, 0),
            period_ns,
            inputs: LadderInputs::new(role),
            flight: Flight::Kept(Box::new(FlightRecorder::new(role.name()))),
            limited_ticks: 0,
            outliers: 0,
            events: TickEvents::default(),
            fault: 0,
            spoken: SpokenText::default(),
            failing: None,
            heard: HeardText::default(),
            peer_held: 0,
            ending: false,
            peer_ended: false,
        })
    }

    /// This side has a gripper or a trigger, and its peer the other: every frame says of it what is known.
    pub fn carry_gripper(&mut self) {
        self.link.set_layout(FrameLayout { has_gripper: true, ..self.link.layout() });
    }

    /// The frames of both sides have the buttons of the master.
    pub fn carry_buttons(&mut self) {
        self.link.set_layout(FrameLayout { has_buttons: true, ..self.link.layout() });
    }

    /// What the next frame says of the buttons: bit n, button n is pressed.
    pub(crate) fn report_buttons(&mut self, pressed: u32) {
        self.outgoing.buttons = Some(pressed);
    }

    /// What the peer's newest frame says of the buttons of the master.
    pub fn peer_buttons(&self) -> Option<u32> {
        self.link.newest().and_then(|frame| frame.buttons)
    }

    /// What the coordinates of this side and of its peer are; of a pose every frame has a rotation.
    pub(crate) fn set_kind(&mut self, kind: SideKind) {
        self.link.set_layout(FrameLayout { kind, ..self.link.layout() });
    }

    /// What the next frame says of gripper or trigger.
    pub(crate) fn report_gripper(&mut self, state: GripperState) {
        self.outgoing.gripper = Some(state);
    }

    /// What the peer's newest frame says of gripper or trigger.
    pub fn peer_gripper(&self) -> Option<GripperState> {
        self.link.newest().and_then(|frame| frame.gripper)
    }

    /// Takes a datagram; a refused one changes nothing but its counter.
    pub fn receive(&mut self, time: LinkTime, datagram: &[u8]) -> Result<(), RejectReason> {
        let is_known = self.link.newest().is_some();
        let head = self.link.take_datagram(time, datagram)?;
        self.accepted(time, is_known, &head);
        Ok(())
    }

    /// The same of a frame whose bytes nobody has looked at, without them.
    #[inline(always)] // takes a frame: docs/decisions/060-ticks-in-a-row.md
    pub fn receive_frame(&mut self, time: LinkTime, frame: &Frame, axes: usize) -> Result<(), RejectReason> {
        let is_known = self.link.newest().is_some();
        let head = self.link.take_frame(time, frame, axes)?;
        self.accepted(time, is_known, &head);
        Ok(())
    }

    /// The link has taken a frame; `is_known`: not its first.
    #[inline(always)] // takes a frame: docs/decisions/060-ticks-in-a-row.md
    fn accepted(&mut self, time: LinkTime, is_known: bool, head: &FrameHead) {
        let FrameHead { begins, sequence, sent_ns, state, reason, ending, text } = *head;
        if begins {
            (self.heard, self.peer_held) = (HeardText::default(), 0);
        }
        self.heard.take(&text);
        if LadderState::from_code(state).is_some_and(LadderState::is_held) {
            self.peer_held = reason;
        }
        self.peer_ended = ending;
        if begins {
            (self.interval_ns, self.first_interval_ns) = (None, None);
            self.counted = (sequence, sent_ns);
            self.events.peer_began = true;
            if is_known {
                // Whoever starts a master means to engage, so a slave may follow a new one. A hand is never coupled
                // again by what arrives from the network.
                self.ladder.new_run(time.tick_ns, self.role == Role::Slave);
            }
        } else if sequence > self.counted.0 {
            // By the peer's own clock and count: neither jitter nor loss is in it.
            let frames = sequence - self.counted.0;
            let interval_ns = || (sent_ns.saturating_sub(self.counted.1) / frames).min(MAX_INTERVAL_NS);
            if frames >= COUNTED {
                let interval_ns = interval_ns();
                self.interval_ns = Some(self.interval_ns.map_or(interval_ns, |min| min.min(interval_ns)));
                self.counted = (sequence, sent_ns);
            } else if self.interval_ns.is_none() {
                self.first_interval_ns = Some(interval_ns());
            }
        }
    }

    /// Steps the ladder; `clutch` is the master's button. Returns the state and the silence of the peer in ns.
    #[inline(always)] // once a tick of each side
    pub(crate) fn advance(&mut self, now_ns: u64, clutch: bool) -> (LadderState, Option<u64>) {
        let age_ns = self.link.age_ns(now_ns);
        let expected_age_ns = self.interval_ns.or(self.first_interval_ns).unwrap_or(self.period_ns);
        let newest = self.link.newest().map(|frame| self.peer_frame(now_ns, frame));
        // On arrival an age is what the link is used to; until the next frame it grows by what silence may.
        let over = self.link.path().over_baseline_ns(now_ns);
        let over_baseline_ns = over.map(|over| over.saturating_sub(expected_age_ns));
        let next_sequence = self.link.next_sequence();
        let ended = self.peer_ended;
        let round_trip_ns = self.link.round_trip_ns();
        let view = LinkView {
            age_ns,
            expected_age_ns,
            over_baseline_ns,
            round_trip_ns,
            newest,
            next_sequence,
            ended,
        };
        let before = self.ladder.state();
        let state = self.inputs.step(&mut self.ladder, now_ns, clutch, &view);
        if state == LadderState::Hold && self.ladder.history().cause() == Some(Reason::PeerDisengaged) {
            self.peer_held = self.link.newest().map_or(self.peer_held, |frame| frame.reason);
        }
        if state.is_coupled() && !before.is_coupled() {
            self.link.path.anchor();
        }
        (state, age_ns)
    }

    /// The newest frame of the peer, as far as a ladder goes.
    fn peer_frame(&self, now_ns: u64, frame: &Frame) -> PeerFrame {
        // An echo of another run says nothing of this one.
        let echo = frame.echo.filter(|echo| echo.run_id == self.link.run_id());
        PeerFrame {
            // A state that this version does not know is none to be coupled with.
            state: LadderState::from_code(frame.state).unwrap_or(LadderState::Fault),
            clutch: frame.clutch,
            hears: self.link.is_heard(),
            echo: echo.map(|echo| echo.sequence),
            echo_age_ns: echo.map(|echo| now_ns.saturating_sub(echo.sent_ns)),
        }
    }

    /// How this slave is turned as against its master; of one that aligns before it engages, before each
    /// [`advance`](Self::advance).
    pub(super) fn set_alignment(&mut self, alignment: AlignmentState) {
        self.inputs.alignment = alignment;
    }

    /// Ends a tick: keeps measured position, command and force, and what controllers saw, in the flight recorder.
    #[inline]
    pub(crate) fn end_tick<const N: usize>(
        &mut self,
        now_ns: u64,
        values: [&Axes<N>; 3],
        observed: impl FnOnce() -> [Observed; LAYERS.len()],
    ) {
        self.events = TickEvents::default();
        if matches!(self.flight, Flight::Kept(_)) {
            self.keep_flight(now_ns, FlightValues::new(values), &observed());
        }
    }

    #[inline(never)]
    fn keep_flight(&mut self, now_ns: u64, values: FlightValues, observed: &[Observed; LAYERS.len()]) {
        let entry = FlightEntry {
            time_ns: now_ns,
            state: self.ladder.state(),
            peer: self.link.newest().and_then(|frame| LadderState::from_code(frame.state)),
            age_ns: self.link.age_ns(now_ns),
            clutch: self.inputs.clutch(),
            gain: self.ladder.gain(),
            tripped: observed.map(|seen| seen.tripped),
            values,
        };
        let diagnosis = self.diagnosis(now_ns);
        if let Flight::Kept(flight) = &mut self.flight {
            flight.observe(now_ns, observed);
            flight.take(entry, self.ladder.history(), diagnosis.as_ref());
        }
    }

    /// Keeps nothing in the flight recorder: of a run in virtual time that nobody records, for it decides nothing.
    pub(crate) fn leave_out_flight(&mut self) {
        self.flight = Flight::LeftOut(Arc::new(*self.flight()));
    }

    /// What the observers of a layer are held against, which the flight recorder keeps beside what they see.
    pub(super) fn hold_against(&mut self, layer: usize, settings: &SafetySettings) {
        if let Flight::Kept(flight) = &mut self.flight {
            flight.hold_against(layer, thresholds(settings));
        }
    }

    /// Measures of the path to the peer only what decides: of a run in virtual time whose reports nobody reads.
    pub(crate) fn leave_out_path_reports(&mut self) {
        self.link.path.leave_out_reports();
    }

    /// Why the two sides are not coupled; none where nothing is wrong.
    fn diagnosis(&self, now_ns: u64) -> Option<Diagnosis> {
        let (state, newest) = (self.ladder.state(), self.link.newest());
        let is_refused = newest.is_some_and(|frame| self.is_refused_by(now_ns, frame));
        let stands = |frame: &Frame| LadderState::from_code(frame.state).unwrap_or(LadderState::Fault);
        let peer_failed = newest.is_some_and(|frame| stands(frame) == LadderState::Fault);
        if !(state.is_held() || peer_failed || self.peer_ended || self.ladder.is_unanswered() || is_refused) {
            return None;
        }
        Some(Diagnosis {
            role: self.role,
            state,
            reason: self.ladder.history().cause(),
            fault: self.fault,
            text: *self.spoken.text(),
            peer: newest.map(|frame| PeerCause {
                state: stands(frame),
                reason: if is_refused { frame.reason } else { self.peer_held },
                fault: frame.fault,
                text: *self.heard.text(),
            }),
            ended: self.peer_ended,
            silent: !self.ladder.hears_peer(),
            // Its loop knows.
            ends: false,
        })
    }

    /// Whether the slave that sent `frame` ended this master's last press because of the turn that it needs.
    fn is_refused_by(&self, now_ns: u64, frame: &Frame) -> bool {
        let waits = self.ladder.state() == LadderState::Aligning || self.ladder.is_unanswered();
        waits
            && self.role == Role::Master
            && matches!(Reason::from_code(frame.reason), Some(Reason::TurnRefused | Reason::TurnCut))
            && self.inputs.knows_press(&self.peer_frame(now_ns, frame))
    }

    /// A number that cannot be was met, or the device has failed.
    pub(super) fn fault(&mut self, now_ns: u64, fault: Fault) {
        // What it met first led here.
        if self.fault == 0 {
            self.fault = fault.code();
        }
        if let Some(text) = self.failing.take() {
            self.spoken.set(&text);
        }
        self.ladder.fault(now_ns);
    }

    /// The same of what a sample has led to, with the speed that was beyond the bound of the device.
    pub(super) fn fault_of(&mut self, now_ns: u64, fault: Fault, excess: Option<Excess>) {
        if self.fault == 0 {
            self.failing = self.failing.or(excess.map(|excess| FaultText::of(&excess)));
        }
        self.fault(now_ns, fault);
    }

    /// The device has failed, or says so, `text` of the driver: zero force or no motion from the next tick on, and
    /// the peer hears of it.
    ///
    /// It counts as a bad number in that tick's sample does, so that no command before the tick undoes it.
    pub fn device_failed(&mut self, text: Option<&FaultText>) {
        self.events.device_failed = true;
        self.failing = text.copied().or(self.failing);
    }

    /// This side ends: from here on its frames say so, and request nothing.
    pub fn end(&mut self) {
        self.ending = true;
    }

    /// The peer has ended the session that its newest frame is of.
    pub fn peer_ended(&mut self) {
        self.peer_ended = self.link.newest().is_some();
    }

    /// Writes the frame of this tick.
    pub fn send<'a>(&mut self, time: LinkTime, buffer: &'a mut [u8; MAX_FRAME]) -> &'a [u8] {
        self.next_frame(time).encode(buffer)
    }

    /// The frame of this tick, not written.
    pub fn next_frame(&mut self, time: LinkTime) -> Frame {
        let mut frame = Frame::EMPTY;
        self.fill_frame(time, self.link.layout().axes, &mut frame);
        frame
    }

    /// Makes the frame of this tick, of `axes` axes, of an empty one or of one that this side has made before.
    #[inline(always)] // makes a frame: docs/decisions/060-ticks-in-a-row.md
    pub(crate) fn fill_frame(&mut self, time: LinkTime, axes: usize, frame: &mut Frame) {
        // Who ends follows and leads no more, whatever its ladder says.
        let state = match self.ladder.state() {
            state if self.ending && !state.is_held() => LadderState::Disengaged,
            // A master engages by a slave that aligns: to one that is to be turned it says no more than before the press.
            LadderState::Aligning if self.inputs.alignment != AlignmentState::Any => LadderState::Disengaged,
            state => state,
        };
        let status = Status {
            state: state.code(),
            hears_peer: self.ladder.hears_peer(),
            clutch: self.inputs.clutch() && self.role == Role::Master && !self.ending,
            ending: self.ending,
            reason: self.ladder.history().cause().map_or(0, Reason::code),
            fault: self.fault,
            text: self.spoken.next_piece(),
        };
        self.link.fill_frame(time, axes, status, &self.outgoing, frame);
    }

    /// The loop was late by more than the ladder allows, until `now_ns`.
    pub fn stalled(&mut self, now_ns: u64) {
        self.events.stalled = true;
        self.ladder.stalled(now_ns);
    }

    /// Whether it was, since the last tick.
    pub(crate) fn has_stalled(&self) -> bool {
        self.events.stalled
    }

    /// The safety layer withholds its force: a person must say that there is a hand.
    pub(crate) fn withhold(&mut self, now_ns: u64, yields: bool) {
        self.ladder.withhold(now_ns, yields);
    }

    /// Whether a run of the peer began since the last tick.
    pub(crate) fn has_peer_begun(&self) -> bool {
        self.events.peer_began
    }

    /// The operator at this side says that its fault is mended.
    pub(super) fn acknowledge(&mut self, now_ns: u64) {
        self.fault = 0;
        self.spoken.set(&FaultText::EMPTY);
        self.ladder.acknowledge(now_ns);
    }

    /// Where the ladder stands.
    pub fn state(&self) -> LadderState {
        self.ladder.state()
    }

    /// Over how many ticks what an operator changes fades, as an engagement does; 0, at once, where there is no force.
    pub(crate) fn fade_ticks(&self) -> u32 {
        if self.ladder.gain() > 0.0 { self.fade_in_ticks() } else { 0 }
    }

    /// Ticks of an engagement's fade.
    pub(crate) fn fade_in_ticks(&self) -> u32 {
        u32::try_from(self.ladder.settings().fade_in_ns.div_ceil(self.period_ns)).unwrap_or(u32::MAX)
    }

    /// Whether the clutch is open, and nothing is left of a coupling.
    pub fn is_open(&self) -> bool {
        !self.clutch() && self.ladder.gain() == 0.0 && !self.state().is_aligned()
    }

    /// Whether the clutch was closed at the last tick.
    pub fn clutch(&self) -> bool {
        self.inputs.clutch()
    }

    /// Where the peer stands and why, [`LadderState::code`], [`Reason::code`] and [`Fault::code`]; none before its
    /// first frame.
    pub fn peer_codes(&self) -> Option<[u8; 3]> {
        self.link.newest().map(|frame| [frame.state, frame.reason, frame.fault])
    }

    /// What was counted so far.
    pub fn counts(&self) -> SideCounts {
        let (link, holds) = (self.link.statistics(), self.ladder.holds());
        SideCounts { link, holds, limited: self.limited_ticks, outliers: self.outliers }
    }

    /// The end of the link.
    pub fn link(&self) -> &FrameLink {
        &self.link
    }

    /// The ladder.
    pub fn ladder(&self) -> &Ladder {
        &self.ladder
    }

    /// The last states and commands.
    pub fn flight(&self) -> &FlightRecorder {
        match &self.flight {
            Flight::Kept(flight) => flight,
            Flight::LeftOut(flight) => flight,
        }
    }
}
