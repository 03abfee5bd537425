//! One end of the frame exchange: sequence numbers, strictly newest wins, statistics, round trip.

use crate::{
    SideKind,
    coupling::CouplingKind,
    fault_text::TextPiece,
    path::PeerPath,
    playout::PlayOut,
    port::PortState,
    session::{Arrival, Rejection, Rejections, ReplayWindow},
    wire::{Echo, Frame, FrameLayout, MAX_FRAME, Role, WireError, coupling_code},
};

/// Counts of one end since it started.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LinkStatistics {
    /// Frames sent.
    pub sent: u64,
    /// Frames newer than all before them on arrival.
    pub fresh: u64,
    /// Frames that arrived after a newer one; not used.
    pub late: u64,
    /// Repeated frames.
    pub duplicate: u64,
    /// Datagrams that are no frame of the peer.
    pub refused: u64,
    /// Missing frames up to the newest, including earlier runs of the peer.
    pub missing: u64,
    /// Newest round trip in ns, without the peer's hold time; 0 before the first.
    pub round_trip_ns: u64,
    /// Smallest round trip in ns; 0 before the first.
    pub min_round_trip_ns: u64,
    /// Wait in ns of the frames with the least delay in the play-out; 0 without one.
    pub play_out_ns: u64,
    /// Coupling of the frames to send; an operator may switch it.
    pub coupling: CouplingKind,
}

impl LinkStatistics {
    /// Add the session's rejections: replays as duplicate or late, others as refused.
    #[must_use]
    pub fn with(mut self, rejections: &Rejections) -> Self {
        let (repeated, too_old) = (rejections.of(Rejection::Repeated), rejections.of(Rejection::TooOld));
        self.duplicate += repeated;
        self.late += too_old;
        self.refused += rejections.total() - repeated - too_old;
        self
    }
}

/// Receive or send time of a frame, in ns on the endpoint's clock.
///
/// Silence counts by tick time. Frames and clock estimates need the true time: a late loop would otherwise take
/// frames before they were sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LinkTime {
    /// Time of the tick.
    pub tick_ns: u64,
    /// Latest arrival time, or send time: the tick's time, or later in a late loop.
    pub by_ns: u64,
}

impl LinkTime {
    /// Punctual tick.
    pub const fn at(tick_ns: u64) -> Self {
        Self { tick_ns, by_ns: tick_ns }
    }

    /// Tick that is `late_ns` late.
    pub const fn late(tick_ns: u64, late_ns: u64) -> Self {
        Self { tick_ns, by_ns: tick_ns.saturating_add(late_ns) }
    }
}

/// Sender state in a frame.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Status {
    /// Ladder state, [`crate::LadderState::code`].
    pub state: u8,
    /// True if the sender hears the peer.
    pub hears_peer: bool,
    /// True if the clutch is closed.
    pub clutch: bool,
    /// True if the sender ends.
    pub ending: bool,
    /// Reason, [`crate::Reason::code`]; 0 initially.
    pub reason: u8,
    /// Fault, [`haptether_safety::Fault::code`]; 0 without.
    pub fault: u8,
    /// Piece of the fault's text.
    pub text: TextPiece,
}

/// Reason why a datagram is not used.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum RejectReason {
    /// No frame of the peer.
    #[error(transparent)]
    Wire(#[from] WireError),
    /// After a newer frame.
    #[error("frame {0} arrived after a newer one")]
    Late(u64),
    /// Repeated frame.
    #[error("frame {0} arrived twice")]
    Duplicate(u64),
    /// Frame of another run while this run lives.
    #[error("frame of session {0:#x} while another session lives")]
    OtherRun(u64),
    /// Further ahead than its sender can be, while the run lives.
    #[error("frame {seen} after {newest}: further ahead than any sender comes in this time")]
    Ahead {
        /// Received sequence.
        seen: u64,
        /// Newest sequence before it.
        newest: u64,
    },
}

/// Tracked sequences before the newest: two seconds at 1 kHz.
const WINDOW: u32 = 2048;
/// Half the shortest frame period of any sender, in ns. A jump beyond the window must take this long per frame.
const MIN_PERIOD_NS: u64 = 50_000;

#[derive(Clone, Copy, Debug, PartialEq)]
struct Newest {
    frame: Frame,
    /// Tick that took it, from which silence and age count.
    arrived_ns: u64,
    /// Latest arrival time.
    by_ns: u64,
}

impl Newest {
    /// Return whether a sequence of this run is plausible at `by_ns`.
    fn is_near(&self, sequence: u64, by_ns: u64) -> bool {
        let newest = self.frame.sequence;
        if sequence > newest && sequence - newest == 1 {
            // Nearly all frames.
            return true;
        }
        let sent = by_ns.saturating_sub(self.by_ns) / MIN_PERIOD_NS;
        let ahead = sequence.saturating_sub(newest) <= sent.saturating_add(WINDOW.into());
        ahead && newest.saturating_sub(sequence) < WINDOW.into()
    }
}

/// Header of an accepted frame, read from the original: reading the copy would wait for it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct FrameHead {
    /// True if the frame began a run.
    pub(crate) begins: bool,
    pub(crate) sequence: u64,
    pub(crate) sent_ns: u64,
    /// Ladder state and reason of the sender.
    pub(crate) state: u8,
    pub(crate) reason: u8,
    pub(crate) ending: bool,
    pub(crate) text: TextPiece,
}

/// One end: numbers its frames and keeps the newest received.
#[derive(Clone, Debug)]
pub struct FrameLink {
    role: Role,
    run_id: u64,
    next_sequence: u64,
    newest: Option<Newest>,
    first_sequence: u64,
    arrived: u64,
    /// Missing frames of earlier runs.
    missing_before: u64,
    layout: FrameLayout,
    arrivals: ReplayWindow,
    statistics: LinkStatistics,
    pub(crate) path: PeerPath,
    /// Silence in ns after which another run is accepted.
    lease_ns: u64,
    /// Newest epoch of the peer's half of the coupling that is not 0.
    epoch: u16,
    /// Couplings that frames of the peer may have beside that of the layout: bit n for the code n.
    alternatives: u16,
    /// Frames for a coupling that needs a constant delay; None for all others.
    play_out: PlayOut,
}

impl FrameLink {
    /// Create an end of `role`. A new `run_id` at every start shows a restart to the peer.
    pub fn new(role: Role, axes: usize, run_id: u64, lease_ns: u64) -> Self {
        Self {
            role,
            run_id,
            next_sequence: 0,
            newest: None,
            first_sequence: 0,
            arrived: 0,
            missing_before: 0,
            layout: FrameLayout::of(axes),
            arrivals: ReplayWindow::new(WINDOW),
            statistics: LinkStatistics::default(),
            path: PeerPath::default(),
            lease_ns,
            epoch: 0,
            alternatives: 0,
            play_out: PlayOut::default(),
        }
    }

    /// Take frames of another coupling, too: either side may be the first to switch.
    pub(crate) fn allow(&mut self, coupling: CouplingKind) {
        self.alternatives |= 1 << self.layout.coupling.code() | 1 << coupling.code();
    }

    /// Couplings that frames may have: bit n for the code n.
    pub(crate) fn couplings(&self) -> u16 {
        self.alternatives | 1 << self.layout.coupling.code()
    }

    /// Layout of a received frame with the code of a coupling.
    fn layout_for(&self, code: u16) -> FrameLayout {
        let allowed = CouplingKind::from_code(code).filter(|_| self.alternatives >> code & 1 == 1);
        FrameLayout { coupling: allowed.unwrap_or(self.layout.coupling), ..self.layout }
    }

    /// Switch to another coupling, with its play-out; `play_out` gets that of the coupling before.
    pub(crate) fn switch(&mut self, coupling: CouplingKind, play_out: &mut PlayOut) {
        self.layout.coupling = coupling;
        std::mem::swap(&mut self.play_out, play_out);
        self.play_out.clear();
    }

    /// Let frames for the coupling pass a play-out.
    pub(crate) fn set_play_out(&mut self, play_out: PlayOut) {
        self.play_out = play_out;
    }

    /// Take the frames from the play-out that are due at `now_ns`.
    #[inline]
    pub(crate) fn play(&mut self, now_ns: u64) {
        if let Some(frames) = self.play_out.frames() {
            frames.play(now_ns);
            self.statistics.play_out_ns = frames.wait_ns();
        }
    }

    /// Frame for the coupling: the one whose time is now, or the newest without a play-out.
    #[inline]
    pub(crate) fn coupled(&self) -> Option<&Frame> {
        self.play_out.now(self.newest())
    }

    /// Newest epoch of the peer's half of the coupling that is not 0; 0 before the first.
    #[inline]
    pub(crate) fn epoch(&self) -> u16 {
        self.epoch
    }

    /// Take a datagram; strictly newer frames replace the newest.
    ///
    /// Returns whether the frame began a run. A refused datagram changes only its counter.
    ///
    /// Without encryption anybody may write any sequence. One that no sender can reach is refused while the run
    /// lives. After a silence of the lease it begins a new run, so a forged frame takes the link for at most the
    /// lease.
    pub fn receive(&mut self, time: LinkTime, datagram: &[u8]) -> Result<bool, RejectReason> {
        self.take_datagram(time, datagram).map(|head| head.begins)
    }

    /// Take a frame that was not encoded: [`Frame::received`].
    pub fn receive_frame(&mut self, time: LinkTime, frame: &Frame) -> Result<bool, RejectReason> {
        self.take_frame(time, frame, self.layout.axes).map(|head| head.begins)
    }

    /// As [`receive`](Self::receive), but returns the header.
    pub(crate) fn take_datagram(
        &mut self,
        time: LinkTime,
        datagram: &[u8],
    ) -> Result<FrameHead, RejectReason> {
        let decoded = Frame::decode(datagram, self.role.peer(), self.layout_for(coupling_code(datagram)));
        self.take(time, self.layout.axes, decoded.as_ref().map_err(|error| *error))
    }

    /// As [`receive_frame`](Self::receive_frame), but returns the header.
    #[inline(always)] // takes a frame: docs/decisions/060-ticks-in-a-row.md
    pub(crate) fn take_frame(
        &mut self,
        time: LinkTime,
        frame: &Frame,
        axes: usize,
    ) -> Result<FrameHead, RejectReason> {
        if frame.is_plain() && frame.role == self.role.peer() && frame.layout() == self.layout {
            return self.take(time, axes, frame.check_plain(axes).map(|()| frame));
        }
        self.take_other_frame(time, frame)
    }

    #[inline(never)] // rare, and copies its frame
    fn take_other_frame(&mut self, time: LinkTime, frame: &Frame) -> Result<FrameHead, RejectReason> {
        let received = frame.received(self.role.peer(), self.layout_for(frame.coupling.code()));
        self.take(time, self.layout.axes, received.as_deref().map_err(|error| *error))
    }

    #[inline(always)] // takes a frame: docs/decisions/060-ticks-in-a-row.md
    fn take(
        &mut self,
        time: LinkTime,
        axes: usize,
        frame: Result<&Frame, WireError>,
    ) -> Result<FrameHead, RejectReason> {
        let LinkTime { tick_ns: now_ns, by_ns } = time;
        let frame = frame.inspect_err(|_| self.statistics.refused += 1)?;
        let begins = match &self.newest {
            Some(newest) if newest.frame.run_id == frame.run_id && newest.is_near(frame.sequence, by_ns) => {
                self.path.arrived(frame.sequence, frame.sent_ns, by_ns);
                let placed = self.place(frame.sequence);
                if let (Some(frames), Ok(()) | Err(RejectReason::Late(_))) = (self.play_out.frames(), &placed)
                {
                    frames.take(now_ns, frame);
                }
                placed?;
                false
            }
            Some(newest) if now_ns.saturating_sub(newest.arrived_ns) < self.lease_ns => {
                let (seen, of_newest) = (frame.sequence, newest.frame.sequence);
                if newest.frame.run_id == frame.run_id && seen < of_newest {
                    self.statistics.late += 1;
                    return Err(RejectReason::Late(seen));
                }
                self.statistics.refused += 1;
                return Err(if newest.frame.run_id == frame.run_id {
                    RejectReason::Ahead { seen, newest: of_newest }
                } else {
                    RejectReason::OtherRun(frame.run_id)
                });
            }
            _ => {
                self.first_sequence = frame.sequence;
                self.missing_before = self.statistics.missing;
                self.arrived = 0;
                self.arrivals.clear();
                self.arrivals.mark(frame.sequence);
                self.path.begin();
                self.path.arrived(frame.sequence, frame.sent_ns, by_ns);
                self.epoch = 0;
                if let Some(frames) = self.play_out.frames() {
                    frames.clear();
                    frames.take(now_ns, frame);
                }
                true
            }
        };
        self.arrived += 1;
        self.statistics.fresh += 1;
        match &mut self.newest {
            // In place: a frame is large.
            Some(newest) => {
                newest.frame.replace(frame, axes);
                (newest.arrived_ns, newest.by_ns) = (now_ns, by_ns);
            }
            None => self.newest = Some(Newest { frame: *frame, arrived_ns: now_ns, by_ns }),
        }
        self.count_missing(frame.sequence);
        if frame.message.epoch != 0 {
            self.epoch = frame.message.epoch;
        }
        let echo = frame.echo.filter(|echo| echo.run_id == self.run_id);
        self.path.newest(frame.sent_ns, echo.as_ref(), now_ns, by_ns);
        if let Some(echo) = echo {
            let round_trip = by_ns.saturating_sub(echo.sent_ns).saturating_sub(echo.held_ns);
            self.statistics.round_trip_ns = round_trip;
            let min = self.statistics.min_round_trip_ns;
            self.statistics.min_round_trip_ns = if min == 0 { round_trip } else { min.min(round_trip) };
        }
        let Frame { sequence, sent_ns, state, reason, ending, text, .. } = *frame;
        Ok(FrameHead { begins, sequence, sent_ns, state, reason, ending, text })
    }

    /// Layout of sent and received frames.
    pub fn layout(&self) -> FrameLayout {
        self.layout
    }

    /// Set the layout, before the first frame.
    pub fn set_layout(&mut self, layout: FrameLayout) {
        self.layout = layout;
    }

    /// Bytes of each frame.
    pub fn frame_length(&self) -> usize {
        self.layout.length()
    }

    /// Classifies a sequence of the living run.
    #[inline]
    fn place(&mut self, sequence: u64) -> Result<(), RejectReason> {
        // Frames before the first of this run are not counted.
        let arrival =
            if sequence < self.first_sequence { Arrival::TooOld } else { self.arrivals.mark(sequence) };
        match arrival {
            Arrival::Newer => return Ok(()),
            Arrival::Duplicate => {
                self.statistics.duplicate += 1;
                return Err(RejectReason::Duplicate(sequence));
            }
            Arrival::Late => {
                self.statistics.late += 1;
                self.arrived += 1;
                if let Some(newest) = &self.newest {
                    self.count_missing(newest.frame.sequence);
                }
            }
            Arrival::TooOld => self.statistics.late += 1,
        }
        Err(RejectReason::Late(sequence))
    }

    fn count_missing(&mut self, newest: u64) {
        let expected = newest.saturating_sub(self.first_sequence).saturating_add(1);
        self.statistics.missing = self.missing_before + expected.saturating_sub(self.arrived);
    }

    /// Encode the next frame.
    pub fn send<'a>(
        &mut self,
        time: LinkTime,
        status: Status,
        port: PortState,
        buffer: &'a mut [u8; MAX_FRAME],
    ) -> &'a [u8] {
        self.next_frame(time, status, &port).encode(buffer)
    }

    /// Return the next frame, not encoded.
    pub fn next_frame(&mut self, time: LinkTime, status: Status, port: &PortState) -> Frame {
        let mut frame = Frame::EMPTY;
        self.fill_frame(time, self.layout.axes, status, port, &mut frame);
        frame
    }

    /// Fills in the next frame of `axes` axes. `frame` must be empty or from this link.
    #[inline(always)] // makes a frame: docs/decisions/060-ticks-in-a-row.md
    pub(crate) fn fill_frame(
        &mut self,
        time: LinkTime,
        axes: usize,
        status: Status,
        port: &PortState,
        frame: &mut Frame,
    ) {
        let sent_ns = time.by_ns;
        let FrameLayout { kind, has_gripper, has_buttons, coupling, .. } = self.layout;
        frame.change_coupling(coupling);
        (frame.role, frame.kind, frame.axes) = (self.role, kind, axes);
        let Status { state, hears_peer, clutch, ending, reason, fault, text } = status;
        (frame.state, frame.hears_peer, frame.clutch, frame.ending) = (state, hears_peer, clutch, ending);
        (frame.reason, frame.fault, frame.text) = (reason, fault, text);
        (frame.run_id, frame.sequence, frame.sent_ns) = (self.run_id, self.next_sequence, sent_ns);
        frame.echo = self.newest.as_ref().map(|newest| Echo {
            run_id: newest.frame.run_id,
            sequence: newest.frame.sequence,
            sent_ns: newest.frame.sent_ns,
            held_ns: sent_ns.saturating_sub(newest.by_ns),
        });
        frame.take_port(port, axes);
        frame.rotation = if kind == SideKind::Pose { port.rotation } else { None };
        frame.gripper = has_gripper.then(|| port.gripper.unwrap_or_default());
        frame.buttons = has_buttons.then(|| port.buttons.unwrap_or_default());
        self.path.sent(self.next_sequence, sent_ns);
        self.next_sequence += 1;
        self.statistics.sent += 1;
    }

    /// Return whether the newest frame confirms that the peer hears this run.
    pub fn is_heard(&self) -> bool {
        self.newest().is_some_and(|frame| {
            frame.hears_peer && frame.echo.is_some_and(|echo| echo.run_id == self.run_id)
        })
    }

    /// Id of its own run.
    pub fn run_id(&self) -> u64 {
        self.run_id
    }

    /// Sequence of the next frame to be sent.
    pub fn next_sequence(&self) -> u64 {
        self.next_sequence
    }

    /// Newest frame of the peer.
    pub fn newest(&self) -> Option<&Frame> {
        self.newest.as_ref().map(|newest| &newest.frame)
    }

    /// Time in ns since the newest frame arrived.
    pub fn age_ns(&self, now_ns: u64) -> Option<u64> {
        self.newest.as_ref().map(|newest| now_ns.saturating_sub(newest.arrived_ns))
    }

    /// Peer clock, frame age and path counts.
    pub fn path(&self) -> &PeerPath {
        &self.path
    }

    /// [`LinkStatistics::round_trip_ns`].
    #[inline]
    pub(crate) fn round_trip_ns(&self) -> u64 {
        self.statistics.round_trip_ns
    }

    /// Count so far.
    pub fn statistics(&self) -> LinkStatistics {
        LinkStatistics { coupling: self.layout.coupling, ..self.statistics }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::padded;
    use proptest::prelude::*;

    const MS: u64 = 1_000_000;
    const HEARD: Status = Status {
        state: 0,
        hears_peer: true,
        clutch: false,
        ending: false,
        reason: 0,
        fault: 0,
        text: TextPiece { number: 0, index: 0, bytes: [0; 12] },
    };

    fn frames(count: usize, run_id: u64) -> Vec<Vec<u8>> {
        let mut slave = FrameLink::new(Role::Slave, 1, run_id, 200 * MS);
        let mut buffer = [0; MAX_FRAME];
        (0..count as u64)
            .map(|n| {
                slave
                    .send(
                        LinkTime::at(n * MS),
                        HEARD,
                        PortState {
                            position: padded(&haptether_safety::Axes::<1>::repeat(n as f64 * 1e-3)),
                            ..PortState::default()
                        },
                        &mut buffer,
                    )
                    .to_vec()
            })
            .collect()
    }

    #[test]
    fn losses_sum_over_all_runs() {
        let (first, second) = (frames(5, 1), frames(4, 2));
        let mut master = FrameLink::new(Role::Master, 1, 7, 200 * MS);
        for (now_ns, frame) in [(0, &first[0]), (3 * MS, &first[3])] {
            master.receive(LinkTime::at(now_ns), frame).unwrap();
        }
        assert_eq!(master.statistics().missing, 2);
        for (now_ns, frame) in [(300 * MS, &second[1]), (302 * MS, &second[3])] {
            master.receive(LinkTime::at(now_ns), frame).unwrap();
        }
        // The first frame heard of the second run is 1: only 2 is missing.
        assert_eq!(master.statistics().missing, 3);
    }

    #[test]
    fn strictly_newest_wins() {
        let frames = frames(5, 1);
        let mut master = FrameLink::new(Role::Master, 1, 7, 200 * MS);
        assert_eq!(master.receive(LinkTime::at(0), &frames[1]), Ok(true));
        assert_eq!(master.receive(LinkTime::at(MS), &frames[3]), Ok(false));
        assert_eq!(master.receive(LinkTime::at(MS), &frames[2]), Err(RejectReason::Late(2)));
        assert_eq!(master.receive(LinkTime::at(MS), &frames[2]), Err(RejectReason::Duplicate(2)));
        assert_eq!(master.receive(LinkTime::at(MS), &frames[3]), Err(RejectReason::Duplicate(3)));
        assert_eq!(master.receive(LinkTime::at(MS), &frames[0]), Err(RejectReason::Late(0)));
        assert_eq!(master.newest().unwrap().sequence, 3);
        assert_eq!(master.age_ns(5 * MS), Some(4 * MS));
        let counts = master.statistics();
        assert_eq!((counts.fresh, counts.late, counts.duplicate, counts.missing), (2, 2, 2, 0));
    }

    #[test]
    fn a_gap_is_missing_until_it_arrives_late() {
        let frames = frames(10, 1);
        let mut master = FrameLink::new(Role::Master, 1, 7, 200 * MS);
        for n in [0, 1, 5, 9] {
            master.receive(LinkTime::at(0), &frames[n]).unwrap();
        }
        assert_eq!(master.statistics().missing, 6);
        master.receive(LinkTime::at(0), &frames[4]).unwrap_err();
        assert_eq!(master.statistics().missing, 5);
    }

    #[test]
    fn another_run_waits_for_silence() {
        let (first, second) = (frames(3, 1), frames(3, 2));
        let mut master = FrameLink::new(Role::Master, 1, 7, 200 * MS);
        master.receive(LinkTime::at(0), &first[2]).unwrap();
        assert_eq!(master.receive(LinkTime::at(199 * MS), &second[0]), Err(RejectReason::OtherRun(2)));
        assert_eq!(master.receive(LinkTime::at(201 * MS), &second[0]), Ok(true));
        assert_eq!(master.receive(LinkTime::at(202 * MS), &first[2]), Err(RejectReason::OtherRun(1)));
        assert_eq!(master.newest().unwrap().run_id, 2);
    }

    #[test]
    fn round_trip_excludes_peer_hold_time() {
        let mut master = FrameLink::new(Role::Master, 1, 7, 200 * MS);
        let mut slave = FrameLink::new(Role::Slave, 1, 8, 200 * MS);
        let mut buffer = [0; MAX_FRAME];
        let request = master.send(LinkTime::at(10 * MS), HEARD, PortState::default(), &mut buffer).to_vec();
        // The slave's clock is off by hours; it holds the frame for 3 ms.
        let off = 3_600_000 * MS;
        slave.receive(LinkTime::at(off), &request).unwrap();
        let answer =
            slave.send(LinkTime::at(off + 3 * MS), HEARD, PortState::default(), &mut buffer).to_vec();
        master.receive(LinkTime::at(113 * MS), &answer).unwrap();
        assert_eq!(master.statistics().round_trip_ns, 100 * MS);
    }

    /// Changes 8 bytes of a frame and corrects its checksum.
    fn changed(frame: &[u8], at: usize, value: u64) -> Vec<u8> {
        let mut bytes = frame[..frame.len() - 4].to_vec();
        bytes[at..at + 8].copy_from_slice(&value.to_le_bytes());
        bytes.extend_from_slice(&crc32fast::hash(&bytes).to_le_bytes());
        bytes
    }

    const RUN_ID: usize = 8;
    const SEQUENCE: usize = 16;
    const SENT: usize = 32;
    const HELD: usize = 48;

    /// Forges one frame with any value in any field, in a living run and in a pause. Within the lease the peer's
    /// frames are taken again, at unchanged age.
    #[test]
    fn forged_frame_takes_link_for_at_most_the_lease() {
        let mut values: Vec<u64> = [0, 1, 1500, 1 << 32, 1 << 63, u64::MAX / 2].to_vec();
        values.extend((0..3).map(|n| u64::MAX - n));
        for (field, pause_ms) in
            [RUN_ID, SEQUENCE, SENT, HELD].into_iter().flat_map(|at| [(at, 1), (at, 300)])
        {
            for &value in &values {
                let mut master = FrameLink::new(Role::Master, 1, 7, 200 * MS);
                let mut slave = FrameLink::new(Role::Slave, 1, 8, 200 * MS);
                let (mut buffer, mut last_ms, mut lost_ms) = ([0; MAX_FRAME], 0, 0);
                for ms in 0..4000_u64 {
                    let now_ns = 10_000 * MS + ms * MS;
                    let _ = slave.receive(
                        LinkTime::at(now_ns),
                        master.send(LinkTime::at(now_ns), HEARD, PortState::default(), &mut buffer),
                    );
                    let frame =
                        slave.send(LinkTime::at(now_ns), HEARD, PortState::default(), &mut buffer).to_vec();
                    if (1000..1000 + pause_ms).contains(&ms) {
                        last_ms = ms;
                        continue;
                    }
                    if ms == 1000 + pause_ms {
                        let of_next =
                            if field == SEQUENCE { frame.clone() } else { changed(&frame, SEQUENCE, ms) };
                        let _ = master.receive(LinkTime::at(now_ns), &changed(&of_next, field, value));
                    }
                    if master.receive(LinkTime::at(now_ns), &frame).is_ok() {
                        last_ms = ms;
                    }
                    lost_ms = lost_ms.max(ms - last_ms);
                }
                let what = format!("byte {field} = {value} after {pause_ms} ms: {lost_ms} ms");
                // The peer can reach a sequence within the window.
                let within = field == SEQUENCE && value.abs_diff(1000) <= 4048;
                assert!(lost_ms <= if within { 2048 } else { 200 }, "{what}");
                let over_ns = master.path().over_baseline_ns(14_000 * MS);
                assert!(over_ns.is_some_and(|over_ns| over_ns < 5 * MS), "{what}, {over_ns:?} older");
            }
        }
    }

    /// A plausible jump: the delay drops by a second, as from a draining queue.
    #[test]
    fn frames_after_drop_of_delay_are_fresh() {
        let frames = frames(2000, 1);
        let mut master = FrameLink::new(Role::Master, 1, 7, 200 * MS);
        master.receive(LinkTime::at(1000 * MS), &frames[0]).unwrap();
        assert_eq!(master.receive(LinkTime::at(1001 * MS), &frames[1000]), Ok(false));
        assert_eq!(master.receive(LinkTime::at(1002 * MS), &frames[999]), Err(RejectReason::Late(999)));
    }

    /// Age in ms of the frame for the coupling at each tick, over a path with a transit in ms for each frame.
    fn played_ages(most_ms: u64, transits_ms: &[u64]) -> Vec<u64> {
        let frames = frames(transits_ms.len(), 1);
        let mut master = FrameLink::new(Role::Master, 1, 7, 10_000 * MS);
        master.set_play_out(PlayOut::new(most_ms * MS, MS).unwrap());
        (0..transits_ms.len())
            .map(|now| {
                let time = LinkTime::at(now as u64 * MS);
                for sent in 0..=now {
                    if sent as u64 + transits_ms[sent] == now as u64 {
                        let _ = master.receive(time, &frames[sent]);
                    }
                }
                master.play(time.tick_ns);
                master.coupled().map_or(0, |frame| now as u64 - frame.sent_ns / MS)
            })
            .collect()
    }

    #[test]
    fn frames_for_the_coupling_have_a_constant_age() {
        let jumps = |n: u64| if n.is_multiple_of(2) { 0 } else { 20 };
        let ages = played_ages(60, &(0..3000).map(|n| 5 + jumps(n)).collect::<Vec<_>>());
        // 20 ms of jitter, with a quarter and 1 ms more.
        assert!(ages[2000..].iter().all(|age| (31..=32).contains(age)), "{:?}", &ages[2000..2010]);
        // All of the frames find room.
        let ages = played_ages(300, &(0..3000).map(|n| 5 + 12 * jumps(n)).collect::<Vec<_>>());
        assert!(ages[2000..].iter().all(|age| (305..=307).contains(age)), "{:?}", &ages[2000..2010]);
    }

    /// A path that becomes slower by more than the wait: each frame is late, and its time is when it arrives.
    #[test]
    fn a_slower_path_leaves_no_old_frame_to_the_coupling() {
        let ages = played_ages(10, &(0..4000).map(|n| if n < 2000 { 20 } else { 50 }).collect::<Vec<_>>());
        assert!(ages[1500..2000].iter().all(|age| (20..=22).contains(age)), "{:?}", &ages[1500..1510]);
        assert!(ages[2051..].iter().all(|age| (50..=60).contains(age)), "{:?}", ages[2051..].iter().max());
    }

    proptest! {
        /// For any order, every arrival is counted once and no older frame is used.
        #[test]
        fn counts_balance(order in prop::collection::vec(0usize..300, 1..600)) {
            let frames = frames(300, 1);
            let mut master = FrameLink::new(Role::Master, 1, 7, 200 * MS);
            let mut used = None;
            for &n in &order {
                let fresh = master.receive(LinkTime::at(0), &frames[n]).is_ok();
                prop_assert_eq!(fresh, used.is_none_or(|used| n > used));
                if fresh { used = Some(n); }
            }
            let counts = master.statistics();
            prop_assert_eq!(counts.fresh + counts.late + counts.duplicate, order.len() as u64);
            let first = order[0];
            let distinct: std::collections::BTreeSet<_> =
                order.iter().filter(|&&n| n >= first).collect();
            let span = used.unwrap() - first + 1;
            prop_assert_eq!(counts.missing, (span - distinct.len()) as u64);
        }
    }
}
