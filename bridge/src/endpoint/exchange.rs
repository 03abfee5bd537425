//! Exchange: the parts that both endpoints share, namely link, ladder and outgoing state.

use std::sync::Arc;

use haptether_safety::{Axes, Excess, Fault, controller::SafetySettings};

use crate::{
    SideKind,
    coupling::{CouplingKind, GripperState},
    fault_text::{FaultText, ReceivedText, SentText},
    ladder::{
        AlignmentState, Diagnosis, FlightEntry, FlightRecorder, FlightValues, LAYERS, Ladder, LadderError,
        LadderInputs, LadderSettings, LadderState, LinkView, Observed, PeerCause, PeerFrame, Reason,
        thresholds,
    },
    link::{FrameHead, FrameLink, LinkStatistics, LinkTime, RejectReason, Status},
    playout::{PlayOut, PlayoutError},
    port::{CouplingMessage, PortEnergy, PortState},
    wire::{Frame, FrameLayout, MAX_FRAME, Role},
};

/// Counters of a side.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SideCounts {
    /// Counters of the link.
    pub link: LinkStatistics,
    /// Number of transitions to HOLD.
    pub holds: u64,
    /// Ticks at which a bound limited the remote command; 0 at a master.
    pub limited: u64,
    /// Samples that the guard rejected as implausible and replaced by predictions.
    pub outliers: u64,
}

/// Events since the last tick, in any combination. Their detectors set them, the endpoint's tick reads them,
/// and [`Exchange::end_tick`] clears them, so each event counts at one tick only.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct TickEvents {
    /// A run of the peer began: the first or a later one.
    pub(super) peer_began: bool,
    /// The loop was late by more than the ladder allows.
    stalled: bool,
    /// The device has failed or reports a failure.
    pub(super) device_failed: bool,
}

#[derive(Clone, Debug)]
enum Flight {
    /// Active recorder.
    Active(Box<FlightRecorder>),
    /// Recorder without updates, because nobody reads it; copies of the side share it.
    Frozen(Arc<FlightRecorder>),
}

/// Part of an endpoint that exchanges frames with the peer.
#[derive(Clone, Debug)]
pub struct Exchange {
    pub(super) ladder: Ladder,
    role: Role,
    pub(super) link: FrameLink,
    /// State of the plant for the next frame.
    pub(super) outgoing: PortState,
    /// Shortest mean interval in ns between the peer's frames, by its sending times over [`COUNTED`] frames.
    interval_ns: Option<u64>,
    /// Mean interval in ns over the first frames, until [`COUNTED`] have arrived.
    first_interval_ns: Option<u64>,
    /// Sequence and sending time in ns of the frame at which the present count begins.
    counted: (u64, u64),
    /// Period in ns of this side's loop; it stands for the peer's until that is known.
    pub(super) period_ns: u64,
    inputs: LadderInputs,
    flight: Flight,
    /// Ticks at which a bound limited the remote command.
    pub(super) limited_ticks: u64,
    /// Samples that the guard rejected as implausible and replaced by predictions.
    pub(crate) outliers: u64,
    /// Share of the ticks with a new sample of the device; none before it is measured, and of a simulated device.
    pub(crate) renewal: Option<f64>,
    /// Energy in J that the coupling may still give; NaN for a coupling that counts none.
    pub(super) left_j: f64,
    pub(super) events: TickEvents,
    /// Count of the engagements.
    epoch: u16,
    /// True while this side waits to switch to another coupling.
    switches: bool,
    /// Code of this side's fault (0 without one), and the driver's text on it.
    fault: u8,
    sent_text: SentText,
    /// Driver's text on a failure that the next tick will record.
    failing: Option<FaultText>,
    /// Peer's text on its fault.
    received_text: ReceivedText,
    /// Code of the reason for the peer's last hold.
    peer_held: u8,
    /// True if this side ends; its frames say so.
    ending: bool,
    /// True if the peer has ended, by its last frames or by releasing its session.
    peer_ended: bool,
}

/// Longest interval in ns between frames that is expected of a peer; it bounds the patience that a peer can
/// request.
const MAX_INTERVAL_NS: u64 = 20_000_000;
/// Number of frames per mean interval. A single interval is too short after a loop that woke late.
const COUNTED: u64 = 16;

impl Exchange {
    /// Build the exchange of role `role` before any frame of the peer. Draw a new random `run_id` at every
    /// start.
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
            flight: Flight::Active(Box::new(FlightRecorder::new(role.name()))),
            limited_ticks: 0,
            outliers: 0,
            renewal: None,
            left_j: f64::NAN,
            events: TickEvents::default(),
            epoch: 0,
            switches: false,
            fault: 0,
            sent_text: SentText::default(),
            failing: None,
            received_text: ReceivedText::default(),
            peer_held: 0,
            ending: false,
            peer_ended: false,
        })
    }

    /// Add the state of gripper or trigger to every frame. This side has one of the two, and its peer has the
    /// other.
    pub fn carry_gripper(&mut self) {
        self.link.set_layout(FrameLayout { has_gripper: true, ..self.link.layout() });
    }

    /// Add the master's buttons to the frames of both sides.
    pub fn carry_buttons(&mut self) {
        self.link.set_layout(FrameLayout { has_buttons: true, ..self.link.layout() });
    }

    /// Set the buttons for the next frame: bit n is set while button n is pressed.
    pub(crate) fn report_buttons(&mut self, pressed: u32) {
        self.outgoing.buttons = Some(pressed);
    }

    /// Buttons of the master in the peer's newest frame.
    pub fn peer_buttons(&self) -> Option<u32> {
        self.link.newest().and_then(|frame| frame.buttons)
    }

    /// Set the kind of coordinates of both sides. Every frame of a pose has a rotation.
    pub(crate) fn set_kind(&mut self, kind: SideKind) {
        self.link.set_layout(FrameLayout { kind, ..self.link.layout() });
    }

    /// Set the coupling of both sides.
    pub(super) fn set_coupling(&mut self, coupling: CouplingKind) {
        self.link.set_layout(FrameLayout { coupling, ..self.link.layout() });
    }

    /// Return a play-out in which frames wait for at most `most_ns`.
    pub(crate) fn play_out(&self, most_ns: u64) -> Result<PlayOut, PlayoutError> {
        PlayOut::new(most_ns, self.period_ns.min(1_000_000))
    }

    /// Return whether nothing couples the sides and no force is left, so that this side may switch to another coupling.
    pub(super) fn may_switch(&self) -> bool {
        !self.ladder.state().is_coupled() && self.ladder.gain() == 0.0
    }

    /// Set whether this side waits for its next [`switch`](Self::switch), and engages with nobody before.
    pub(super) fn await_switch(&mut self, waits: bool) {
        self.switches = waits;
    }

    /// Switch to another coupling, with its play-out; `play_out` gets that of the coupling before. `count` is that of the
    /// engagements in its frames. Returns the count from which the other one goes on.
    pub(super) fn switch(&mut self, coupling: CouplingKind, play_out: &mut PlayOut, count: u16) -> u16 {
        self.link.switch(coupling, play_out);
        (self.switches, self.left_j) = (false, f64::NAN);
        self.outgoing.message = CouplingMessage::ZERO;
        self.epoch = self.epoch.max(count);
        self.epoch
    }

    /// Energies through the port of this side since its engagement.
    #[inline]
    pub(crate) fn energy(&self) -> PortEnergy {
        self.outgoing.energy
    }

    /// Energy in J that the coupling may still give; NaN for a coupling that counts none.
    #[inline]
    pub(crate) fn left_j(&self) -> f64 {
        self.left_j
    }

    /// Count of the engagements of this side, from 1; 0 while it is not coupled.
    #[inline]
    pub(super) fn epoch(&self) -> u16 {
        if self.ladder.state().is_coupled() { self.epoch } else { 0 }
    }

    /// Set the state of gripper or trigger for the next frame.
    pub(crate) fn report_gripper(&mut self, state: GripperState) {
        self.outgoing.gripper = Some(state);
    }

    /// State of gripper or trigger in the peer's newest frame.
    pub fn peer_gripper(&self) -> Option<GripperState> {
        self.link.newest().and_then(|frame| frame.gripper)
    }

    /// Take a datagram. A rejected datagram changes nothing but its counter.
    pub fn receive(&mut self, time: LinkTime, datagram: &[u8]) -> Result<(), RejectReason> {
        let is_known = self.link.newest().is_some();
        let head = self.link.take_datagram(time, datagram)?;
        self.accepted(time, is_known, &head);
        Ok(())
    }

    /// Take a frame that was never encoded.
    #[inline(always)] // takes a frame: docs/decisions/060-ticks-in-a-row.md
    pub fn receive_frame(&mut self, time: LinkTime, frame: &Frame, axes: usize) -> Result<(), RejectReason> {
        let is_known = self.link.newest().is_some();
        let head = self.link.take_frame(time, frame, axes)?;
        self.accepted(time, is_known, &head);
        Ok(())
    }

    /// Update the state after the link accepted a frame. `is_known` is false for the first frame of all.
    #[inline(always)] // takes a frame: docs/decisions/060-ticks-in-a-row.md
    fn accepted(&mut self, time: LinkTime, is_known: bool, head: &FrameHead) {
        let FrameHead { begins, sequence, sent_ns, state, reason, ending, text } = *head;
        if begins {
            (self.received_text, self.peer_held) = (ReceivedText::default(), 0);
        }
        self.received_text.take(&text);
        if LadderState::from_code(state).is_some_and(LadderState::is_held) {
            self.peer_held = reason;
        }
        self.peer_ended = ending;
        if begins {
            (self.interval_ns, self.first_interval_ns) = (None, None);
            self.counted = (sequence, sent_ns);
            self.events.peer_began = true;
            if is_known {
                // A person who starts a master means to engage, so a slave may follow a new run. A master's
                // ladder never engages because of a datagram.
                self.ladder.new_run(time.tick_ns, self.role == Role::Slave);
            }
        } else if sequence > self.counted.0 {
            // The peer's own clock and count contain neither jitter nor loss.
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

    /// Step the ladder; `clutch` is the master's button. Returns the state, and the time in ns since the peer
    /// was last heard.
    #[inline(always)] // once per tick of each side
    pub(crate) fn advance(&mut self, now_ns: u64, clutch: bool) -> (LadderState, Option<u64>) {
        self.link.play(now_ns);
        let age_ns = self.link.age_ns(now_ns);
        let expected_age_ns = self.interval_ns.or(self.first_interval_ns).unwrap_or(self.period_ns);
        let newest = self.link.newest().map(|frame| self.peer_frame(now_ns, frame));
        // The baseline is an age on arrival; until the next frame the age also grows by the expected
        // interval.
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
            self.epoch = self.epoch.checked_add(1).unwrap_or(1);
            self.outgoing.energy = PortEnergy::default();
        }
        (state, age_ns)
    }

    /// Return whether both sides have the same coupling and this one keeps it, or are coupled.
    fn may_couple_with(&self, frame: &Frame) -> bool {
        let is_same = !self.switches && frame.coupling == self.link.layout().coupling;
        is_same || self.ladder.state().is_coupled()
    }

    /// Fields of the peer's newest frame that the ladder reads.
    fn peer_frame(&self, now_ns: u64, frame: &Frame) -> PeerFrame {
        // An echo of another run does not concern this run.
        let echo = frame.echo.filter(|echo| echo.run_id == self.link.run_id());
        PeerFrame {
            // A state that this version does not know must not couple.
            state: match LadderState::from_code(frame.state).unwrap_or(LadderState::Fault) {
                state if state.is_held() || self.may_couple_with(frame) => state,
                _ => LadderState::Disengaged,
            },
            clutch: frame.clutch,
            hears: self.link.is_heard(),
            echo: echo.map(|echo| echo.sequence),
            echo_age_ns: echo.map(|echo| now_ns.saturating_sub(echo.sent_ns)),
        }
    }

    /// Set how this slave is turned relative to its master, before each [`advance`](Self::advance). Only for
    /// a slave that aligns before it engages.
    pub(super) fn set_alignment(&mut self, alignment: AlignmentState) {
        self.inputs.alignment = alignment;
    }

    /// End a tick: record measured position, command, force and the controllers' observations in the flight
    /// recorder.
    #[inline]
    pub(crate) fn end_tick<const N: usize>(
        &mut self,
        now_ns: u64,
        values: [&Axes<N>; 3],
        observed: impl FnOnce() -> [Observed; LAYERS.len()],
    ) {
        self.events = TickEvents::default();
        if matches!(self.flight, Flight::Active(_)) {
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
        if let Flight::Active(flight) = &mut self.flight {
            flight.observe(now_ns, observed);
            flight.take(entry, self.ladder.history(), diagnosis.as_ref());
        }
    }

    /// Stop the flight recorder, in a virtual-time run that nobody records. The recorder affects no decision.
    pub(crate) fn leave_out_flight(&mut self) {
        self.flight = Flight::Frozen(Arc::new(*self.flight()));
    }

    /// Set the thresholds of a layer's observers, which the flight recorder shows beside the observed values.
    pub(super) fn set_thresholds(&mut self, layer: usize, settings: &SafetySettings) {
        if let Flight::Active(flight) = &mut self.flight {
            flight.set_thresholds(layer, thresholds(settings));
        }
    }

    /// Measure only those properties of the path that affect decisions, in a virtual-time run whose reports
    /// nobody reads.
    pub(crate) fn leave_out_path_reports(&mut self) {
        self.link.path.leave_out_reports();
    }

    /// Return why the two sides are not coupled; `None` if nothing is wrong.
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
            text: *self.sent_text.text(),
            peer: newest.map(|frame| PeerCause {
                state: stands(frame),
                reason: if is_refused { frame.reason } else { self.peer_held },
                fault: frame.fault,
                text: *self.received_text.text(),
            }),
            ended: self.peer_ended,
            silent: !self.ladder.hears_peer(),
            // Only the loop knows this; it sets the flag.
            ends: false,
        })
    }

    /// Return whether the slave that sent `frame` ended this master's last press because of the turn that the
    /// arm needs.
    fn is_refused_by(&self, now_ns: u64, frame: &Frame) -> bool {
        let waits = self.ladder.state() == LadderState::Aligning || self.ladder.is_unanswered();
        waits
            && self.role == Role::Master
            && matches!(Reason::from_code(frame.reason), Some(Reason::TurnRefused | Reason::TurnCut))
            && self.inputs.knows_press(&self.peer_frame(now_ns, frame))
    }

    /// Go to FAULT after an invalid number or a device failure.
    pub(super) fn fault(&mut self, now_ns: u64, fault: Fault) {
        // The first fault is the cause.
        if self.fault == 0 {
            self.fault = fault.code();
        }
        if let Some(text) = self.failing.take() {
            self.sent_text.set(&text);
        }
        self.ladder.fault(now_ns);
    }

    /// Go to FAULT because of a sample, with its speed beyond the device's bound, if that is the cause.
    pub(super) fn fault_of(&mut self, now_ns: u64, fault: Fault, excess: Option<Excess>) {
        if self.fault == 0 {
            self.failing = self.failing.or(excess.map(|excess| FaultText::of(&excess)));
        }
        self.fault(now_ns, fault);
    }

    /// Record that the device has failed, with the driver's `text`. From the next tick on the force is zero
    /// or the arm stops, and the frames tell the peer.
    ///
    /// The failure counts in the next tick, like an invalid number in its sample, so no command before that
    /// tick can undo it.
    pub fn device_failed(&mut self, text: Option<&FaultText>) {
        self.events.device_failed = true;
        self.failing = text.copied().or(self.failing);
    }

    /// End this side: its frames say so from now on and request nothing.
    pub fn end(&mut self) {
        self.ending = true;
    }

    /// Record that the peer has ended the session of its newest frame.
    pub fn peer_ended(&mut self) {
        self.peer_ended = self.link.newest().is_some();
    }

    /// Encode the frame of this tick.
    pub fn send<'a>(&mut self, time: LinkTime, buffer: &'a mut [u8; MAX_FRAME]) -> &'a [u8] {
        self.next_frame(time).encode(buffer)
    }

    /// Build the frame of this tick without encoding it.
    pub fn next_frame(&mut self, time: LinkTime) -> Frame {
        let mut frame = Frame::EMPTY;
        self.fill_frame(time, self.link.layout().axes, &mut frame);
        frame
    }

    /// Fill `frame` with the frame of this tick. `frame` must be empty or an earlier frame of this side;
    /// `axes` is its number of axes.
    #[inline(always)] // makes a frame: docs/decisions/060-ticks-in-a-row.md
    pub(crate) fn fill_frame(&mut self, time: LinkTime, axes: usize, frame: &mut Frame) {
        // A side that ends neither follows nor leads, in any state of its ladder.
        let state = match self.ladder.state() {
            state if self.ending && !state.is_held() => LadderState::Disengaged,
            // A master engages as soon as its slave aligns; so a slave that still has to turn reports
            // DISENGAGED.
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
            text: self.sent_text.next_piece(),
        };
        self.link.fill_frame(time, axes, status, &self.outgoing, frame);
    }

    /// Record that the loop was late by more than the ladder allows, until `now_ns`.
    pub fn stalled(&mut self, now_ns: u64) {
        self.events.stalled = true;
        self.ladder.stalled(now_ns);
    }

    /// Return whether the loop has stalled since the last tick.
    pub(crate) fn has_stalled(&self) -> bool {
        self.events.stalled
    }

    /// Withhold the force after a trip of the safety layer: a person must confirm that a hand is there.
    pub(crate) fn withhold(&mut self, now_ns: u64, yields: bool) {
        self.ladder.withhold(now_ns, yields);
    }

    /// Return whether a run of the peer began since the last tick.
    pub(crate) fn has_peer_begun(&self) -> bool {
        self.events.peer_began
    }

    /// Acknowledge this side's fault on behalf of the operator.
    pub(super) fn acknowledge(&mut self, now_ns: u64) {
        self.fault = 0;
        self.sent_text.set(&FaultText::EMPTY);
        self.ladder.acknowledge(now_ns);
    }

    /// State of the ladder.
    pub fn state(&self) -> LadderState {
        self.ladder.state()
    }

    /// Ticks over which an operator's change fades in: those of an engagement, or 0 (at once) without force.
    pub(crate) fn fade_ticks(&self) -> u32 {
        if self.ladder.gain() > 0.0 { self.fade_in_ticks() } else { 0 }
    }

    /// Ticks of the fade-in of an engagement.
    pub(crate) fn fade_in_ticks(&self) -> u32 {
        u32::try_from(self.ladder.settings().fade_in_ns.div_ceil(self.period_ns)).unwrap_or(u32::MAX)
    }

    /// Return whether the clutch is open and nothing of a coupling remains.
    pub fn is_open(&self) -> bool {
        !self.clutch() && self.ladder.gain() == 0.0 && !self.state().is_aligned()
    }

    /// Return whether the clutch was closed at the last tick.
    pub fn clutch(&self) -> bool {
        self.inputs.clutch()
    }

    /// State, reason and fault of the peer as [`LadderState::code`], [`Reason::code`] and [`Fault::code`];
    /// none before its first frame.
    pub fn peer_codes(&self) -> Option<[u8; 3]> {
        self.link.newest().map(|frame| [frame.state, frame.reason, frame.fault])
    }

    /// Counters so far.
    pub fn counts(&self) -> SideCounts {
        let (link, holds) = (self.link.statistics(), self.ladder.holds());
        SideCounts { link, holds, limited: self.limited_ticks, outliers: self.outliers }
    }

    /// This side's end of the link.
    pub fn link(&self) -> &FrameLink {
        &self.link
    }

    /// Ladder of this side.
    pub fn ladder(&self) -> &Ladder {
        &self.ladder
    }

    /// Flight recorder with the last states and commands.
    pub fn flight(&self) -> &FlightRecorder {
        match &self.flight {
            Flight::Active(flight) => flight,
            Flight::Frozen(flight) => flight,
        }
    }
}
