//! What both endpoints have: a link, a ladder, and what goes out next.

use haptether_safety::Axes;

use crate::{
    ladder::{
        FlightEntry, FlightRecorder, FlightValues, Ladder, LadderError, LadderInput, LadderSettings,
        LadderState, Observed, PeerReport, Transition,
    },
    link::{FrameLink, LinkStatistics, PortState, Refusal, Status},
    path::PathReport,
    wire::{Frame, MAX_FRAME, Role},
};

/// The part of an endpoint that talks to the peer.
#[derive(Clone, Debug)]
pub struct Exchange<const N: usize> {
    pub(super) ladder: Ladder,
    role: Role,
    link: FrameLink<N>,
    /// What the next frame says of the plant.
    pub(super) outgoing: PortState<N>,
    /// Least time in ns between two frames of the peer, as it sends them, over [`COUNTED`] of them.
    interval_ns: Option<u64>,
    /// The same over those that came until there were as many.
    first_interval_ns: Option<u64>,
    /// Sequence and sending time of the frame that the next count begins with.
    counted: (u64, u64),
    /// Its own, which stands for the peer's until that is known.
    period_ns: u64,
    /// The clutch as of the last tick.
    clutch: bool,
    /// Holds that were seen, and the sequence of a frame of this side that tells of the last one.
    told: (u64, u64),
    flight: Box<FlightRecorder>,
}

/// Longest period of a loop in ns: a peer cannot ask for more patience.
const LONGEST_INTERVAL_NS: u64 = 20_000_000;
/// Frames whose mean interval is taken: one loop that wakes late shortens the next interval by its lateness.
const COUNTED: u64 = 16;

impl<const N: usize> Exchange<N> {
    pub(super) fn new(
        role: Role,
        session: u64,
        period_ns: u64,
        settings: LadderSettings,
    ) -> Result<Self, LadderError> {
        Ok(Self {
            ladder: Ladder::new(settings)?,
            role,
            link: FrameLink::new(role, session, settings.stop_after_ns),
            outgoing: PortState::default(),
            interval_ns: None,
            first_interval_ns: None,
            counted: (0, 0),
            period_ns,
            clutch: false,
            told: (0, 0),
            flight: Box::new(FlightRecorder::new(match role {
                Role::Master => "master",
                Role::Slave => "slave",
            })),
        })
    }

    /// See [`FrameLink::late`].
    pub(super) fn late(&mut self, late_ns: u64) {
        self.link.late(late_ns);
    }

    /// Takes a datagram that arrived by `now_ns`; says whether it began a session.
    pub(super) fn receive(&mut self, now_ns: u64, datagram: &[u8]) -> Result<bool, Refusal> {
        let begins = self.link.receive(now_ns, datagram)?;
        let Some((sequence, sent_ns)) = self.newest().map(|frame| (frame.sequence, frame.sent_ns)) else {
            return Ok(begins);
        };
        if begins {
            (self.interval_ns, self.first_interval_ns) = (None, None);
            self.counted = (sequence, sent_ns);
            // Whoever starts a master means to engage, so a slave may follow a new one. A hand is never coupled again
            // by what arrives from the network.
            self.ladder.new_session(now_ns, self.role == Role::Slave);
        } else if sequence > self.counted.0 {
            // By the peer's own clock and count: neither jitter nor loss is in it.
            let frames = sequence - self.counted.0;
            let interval_ns = (sent_ns.saturating_sub(self.counted.1) / frames).min(LONGEST_INTERVAL_NS);
            if frames >= COUNTED {
                self.interval_ns = Some(self.interval_ns.map_or(interval_ns, |least| least.min(interval_ns)));
                self.counted = (sequence, sent_ns);
            } else if self.interval_ns.is_none() {
                self.first_interval_ns = Some(interval_ns);
            }
        }
        Ok(begins)
    }

    /// Steps the ladder; `clutch` is the master's button. Gives the state and the silence of the peer in ns.
    pub(super) fn advance(&mut self, now_ns: u64, clutch: bool) -> (LadderState, Option<u64>) {
        if self.told.0 != self.ladder.holds() {
            self.told = (self.ladder.holds(), self.link.next_sequence());
        }
        let age_ns = self.link.age_ns(now_ns);
        let expected_age_ns = self.interval_ns.or(self.first_interval_ns).unwrap_or(self.period_ns);
        let newest = self.newest();
        let peer = newest.map(|frame| PeerReport {
            // A state that this version does not know is none to be coupled with.
            state: LadderState::from_code(frame.state).unwrap_or(LadderState::Fault),
            hears: self.link.is_heard(),
            answers: self.link.is_heard() && frame.echo.is_some_and(|echo| echo.sequence >= self.told.1),
        });
        let (clutch, asks) = match self.role {
            Role::Master => (clutch, clutch && !self.clutch),
            Role::Slave => {
                let closed = newest.is_some_and(|frame| frame.clutch);
                let aligns =
                    peer.is_some_and(|peer| peer.state.is_coupled() || peer.state == LadderState::Aligning);
                let most_ns = self.ladder.settings().hold_after_ns + expected_age_ns;
                (closed, closed && aligns && age_ns.is_some_and(|age| age <= most_ns))
            }
        };
        self.clutch = clutch;
        // On arrival an age is what the link is used to; until the next frame it grows by what silence may.
        let over = self.link.path().over_usual_ns(now_ns);
        let over_usual_ns = over.map(|over| over.saturating_sub(expected_age_ns));
        let input = LadderInput { age_ns, expected_age_ns, over_usual_ns, peer, clutch, asks };
        let before = self.ladder.state();
        let state = self.ladder.step(now_ns, &input);
        if state.is_coupled() && !before.is_coupled() {
            self.link.anchor();
        }
        (state, age_ns)
    }

    /// Keeps this tick in the flight recorder: measured position, command and force, and what controllers saw.
    pub(super) fn keep(&mut self, now_ns: u64, values: [&Axes<N>; 3], observed: Observed) {
        let entry = FlightEntry {
            time_ns: now_ns,
            state: self.ladder.state(),
            peer: self.newest().and_then(|frame| LadderState::from_code(frame.state)),
            age_ns: self.link.age_ns(now_ns),
            clutch: self.clutch,
            gain: self.ladder.gain(),
            observed,
            values: FlightValues::new(values),
        };
        self.flight.take(entry, self.ladder.history());
    }

    /// What the observers of this side are held against.
    pub(super) fn hold_against(&mut self, thresholds: [f64; 4]) {
        self.flight.hold_against(thresholds);
    }

    /// The newest frame of the peer.
    pub(super) fn newest(&self) -> Option<&Frame<N>> {
        self.link.newest()
    }

    /// Writes the frame of this tick.
    pub fn send<'a>(&mut self, now_ns: u64, buffer: &'a mut [u8; MAX_FRAME]) -> &'a [u8] {
        let status = Status {
            state: self.ladder.state().code(),
            hears_peer: self.ladder.hears_peer(),
            clutch: self.clutch && self.role == Role::Master,
        };
        self.link.send(now_ns, status, self.outgoing, buffer)
    }

    /// The loop was late by more than the ladder allows, until `now_ns`.
    pub(super) fn stalled(&mut self, now_ns: u64) {
        self.ladder.stalled(now_ns);
    }

    /// A person at this side says that its fault is mended.
    pub(super) fn acknowledge(&mut self, now_ns: u64) {
        self.ladder.acknowledge(now_ns);
    }

    /// Where the ladder stands.
    pub fn state(&self) -> LadderState {
        self.ladder.state()
    }

    /// Share of the force that may be rendered, 0 to 1.
    pub fn gain(&self) -> f64 {
        self.ladder.gain()
    }

    /// Whether a press of the clutch would count, were it open.
    pub fn is_ready(&self) -> bool {
        self.ladder.is_ready()
    }

    /// Whether the clutch was closed at the last tick.
    pub fn clutch(&self) -> bool {
        self.clutch
    }

    /// The last step of the ladder.
    pub fn last_transition(&self) -> Option<Transition> {
        self.ladder.history().last()
    }

    /// Counts of the link, and how often the ladder went to HOLD.
    pub fn counts(&self) -> (LinkStatistics, u64) {
        (self.link.statistics(), self.ladder.holds())
    }

    /// What is known of the way to the peer at `now_ns`.
    pub fn path_report(&self, now_ns: u64) -> PathReport {
        self.link.path_report(now_ns)
    }

    /// The last states and commands.
    pub fn flight(&self) -> &FlightRecorder {
        &self.flight
    }
}
