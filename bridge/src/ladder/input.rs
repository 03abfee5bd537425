//! The input of a ladder at one tick: from the button, and from what the peer's newest frame says and echoes.

use super::{machine::Ladder, table::LadderState};
use crate::wire::Role;

/// What the newest frame of the peer says.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PeerReport {
    /// Where the peer stands.
    pub state: LadderState,
    /// Whether it hears this very side.
    pub hears: bool,
    /// Whether it knew, when it sent that frame, of what made this side's last release necessary: a hold, a fault or a
    /// press that ended unanswered. What it said before says nothing of a press or release after that.
    pub answers: bool,
    /// Whether it may align this side: at the master the peer knew of the last press, at the slave it is at most
    /// `LadderSettings::align_ns` old.
    pub is_current: bool,
}

/// How a slave is turned as against its master before the two engage.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum AlignmentState {
    /// However it is: it engages there. So does every master.
    #[default]
    Any,
    /// Not yet as the master is: it is to be turned.
    Remaining,
    /// As the master is.
    Reached,
    /// Further from the master than it may be turned.
    TooFar,
}

/// The input of a ladder at one tick.
#[allow(clippy::struct_excessive_bools)] // what is the case at a tick
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LadderInput {
    /// Age in ns of the newest that is known of the peer; none before its first frame.
    pub age_ns: Option<u64>,
    /// Age in ns that the link has when nothing is wrong: silence counts from there.
    pub expected_age_ns: u64,
    /// By how much in ns the newest may be older than the link is used to; none until that is known.
    pub over_baseline_ns: Option<u64>,
    /// Round trip in ns as the newest echo measures it, on this side's clock; 0 until one does.
    pub round_trip_ns: u64,
    /// What the newest frame says.
    pub peer: Option<PeerReport>,
    /// Whether the clutch is closed: at the master the button, at the slave what the master's frame says of it. A
    /// disengaged master has none that is.
    pub clutch: bool,
    /// Whether an open clutch is a release only where the peer knew of what made one necessary. So it is in HOLD and
    /// STOP; at the slave, whose newest frame may be old, in DISENGAGED, too.
    pub needs_answer: bool,
    /// Whether it was pressed at this tick: at the master the edge of the button, at the slave a master that aligns.
    pub is_press: bool,
    /// Whether the peer has ended in good order.
    pub ended: bool,
    /// Of a slave that aligns before it engages.
    pub alignment: AlignmentState,
}

/// The newest frame of the peer, as far as a ladder goes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PeerFrame {
    /// State of its ladder.
    pub state: LadderState,
    /// Whether its clutch is closed.
    pub clutch: bool,
    /// Whether it hears this very run.
    pub hears: bool,
    /// Sequence of the frame of this very run that it echoes.
    pub echo: Option<u64>,
    /// Time in ns since that frame was sent, by this side's clock: the peer's frame was sent after it.
    pub echo_age_ns: Option<u64>,
}

/// The link as of a tick.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LinkView {
    /// As [`LadderInput::age_ns`].
    pub age_ns: Option<u64>,
    /// As [`LadderInput::expected_age_ns`].
    pub expected_age_ns: u64,
    /// As [`LadderInput::over_baseline_ns`].
    pub over_baseline_ns: Option<u64>,
    /// As [`LadderInput::round_trip_ns`].
    pub round_trip_ns: u64,
    /// The newest frame of the peer.
    pub newest: Option<PeerFrame>,
    /// Sequence of the frame that this tick sends.
    pub next_sequence: u64,
    /// As [`LadderInput::ended`].
    pub ended: bool,
}

/// Makes a ladder's inputs: keeps which frames of this side were the first after what made the last release
/// necessary, and of the last press.
#[derive(Clone, Debug, PartialEq)]
pub struct LadderInputs {
    role: Role,
    /// As of this tick, of a slave that aligns before it engages.
    pub(crate) alignment: AlignmentState,
    /// As of the last tick.
    pub(super) clutch: bool,
    pub(super) closings: u64,
    pub(super) closed_sequence: u64,
    pub(super) pressed_sequence: u64,
}

impl LadderInputs {
    /// Of a side that has sent nothing yet.
    pub fn new(role: Role) -> Self {
        Self {
            role,
            alignment: AlignmentState::Any,
            clutch: false,
            closings: 0,
            closed_sequence: 0,
            pressed_sequence: 0,
        }
    }

    /// Steps the ladder; `button` is the master's.
    #[inline(always)] // else what it makes goes through memory
    pub fn step(&mut self, ladder: &mut Ladder, now_ns: u64, button: bool, link: &LinkView) -> LadderState {
        let input = self.read(ladder, button, link);
        let before = ladder.state();
        let state = ladder.step(now_ns, &input);
        if state == LadderState::Aligning && before != state {
            self.pressed_sequence = link.next_sequence;
        }
        state
    }

    /// The input at a tick.
    #[inline(always)] // else what it makes goes through memory
    fn read(&mut self, ladder: &Ladder, button: bool, link: &LinkView) -> LadderInput {
        if self.closings != ladder.closings() {
            (self.closings, self.closed_sequence) = (ladder.closings(), link.next_sequence);
        }
        let settings = ladder.settings();
        let newest = link.newest;
        let (clutch, is_press, is_current) = match self.role {
            Role::Master => {
                let is_press = button && !self.clutch;
                // Nobody can know of a press at the tick of it.
                let knows =
                    newest.and_then(|frame| frame.echo).is_some_and(|echo| echo >= self.pressed_sequence);
                (button, is_press, knows && !is_press)
            }
            Role::Slave => {
                // Whoever is disengaged with a closed clutch has let a press expire: it is none any more.
                let closed =
                    newest.is_some_and(|frame| frame.clutch && frame.state != LadderState::Disengaged);
                let max_ns = settings.hold_after_ns + link.expected_age_ns;
                let heard = link.age_ns.is_some_and(|age| age <= max_ns);
                let age_ns = newest.and_then(|frame| frame.echo_age_ns);
                // Without an echo it aligns, so that the master hears of it, but does not engage.
                let is_press = newest.is_some_and(|frame| frame.state == LadderState::Aligning)
                    && age_ns.is_none_or(|age| age <= settings.align_ns);
                (closed, closed && heard && is_press, age_ns.is_some_and(|age| age <= settings.align_ns))
            }
        };
        self.clutch = clutch;
        let peer = newest.map(|PeerFrame { state, hears, echo, .. }| PeerReport {
            state,
            hears,
            answers: hears && echo.is_some_and(|echo| echo >= self.closed_sequence),
            is_current,
        });
        let &LinkView { age_ns, expected_age_ns, over_baseline_ns, round_trip_ns, ended, .. } = link;
        let needs_answer = self.role == Role::Slave && self.closings > 0;
        let alignment = self.alignment;
        LadderInput {
            age_ns,
            expected_age_ns,
            over_baseline_ns,
            round_trip_ns,
            peer,
            clutch,
            needs_answer,
            is_press,
            ended,
            alignment,
        }
    }

    /// The clutch as of the last tick.
    pub fn clutch(&self) -> bool {
        self.clutch
    }

    /// Whether `frame` is of a peer that knew of the last press.
    pub(crate) fn knows_press(&self, frame: &PeerFrame) -> bool {
        frame.hears && frame.echo.is_some_and(|echo| echo >= self.pressed_sequence)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ladder::LadderSettings;

    const MS: u64 = 1_000_000;

    fn frame(state: LadderState, clutch: bool, echo: Option<u64>, echo_age_ns: Option<u64>) -> PeerFrame {
        PeerFrame { state, clutch, hears: true, echo, echo_age_ns }
    }

    fn link(newest: Option<PeerFrame>, next_sequence: u64) -> LinkView {
        LinkView {
            age_ns: Some(2 * MS),
            expected_age_ns: MS,
            over_baseline_ns: Some(0),
            round_trip_ns: 2 * MS,
            newest,
            next_sequence,
            ended: false,
        }
    }

    fn ladder() -> Ladder {
        Ladder::new(LadderSettings::default()).unwrap()
    }

    /// One that has held once: a release is necessary.
    fn held() -> Ladder {
        let peer = PeerReport { state: LadderState::Engaged, hears: true, answers: true, is_current: true };
        let sound = LadderInput { age_ns: Some(0), peer: Some(peer), clutch: true, ..LadderInput::default() };
        let mut ladder = ladder();
        ladder.step(0, &LadderInput { is_press: true, ..sound });
        assert_eq!(ladder.step(MS, &sound), LadderState::Engaged);
        assert_eq!(ladder.step(2 * MS, &LadderInput { age_ns: Some(100 * MS), ..sound }), LadderState::Hold);
        assert_eq!(ladder.closings(), 1);
        ladder
    }

    #[test]
    fn a_press_of_the_master_is_the_edge_of_its_button_and_known_by_a_later_echo() {
        for (before, button, is_press) in
            [(false, false, false), (false, true, true), (true, true, false), (true, false, false)]
        {
            for (echo, pressed_sequence, knows) in
                [(None, 0, false), (Some(7), 7, true), (Some(8), 7, true), (Some(6), 7, false)]
            {
                let mut inputs =
                    LadderInputs { clutch: before, pressed_sequence, ..LadderInputs::new(Role::Master) };
                let newest = frame(LadderState::Engaged, false, echo, None);
                let input = inputs.read(&ladder(), button, &link(Some(newest), 9));
                assert_eq!((input.clutch, input.is_press, inputs.clutch()), (button, is_press, button));
                let current = input.peer.unwrap().is_current;
                assert_eq!(current, knows && !is_press, "{before} {button} {echo:?}");
                assert!(!input.needs_answer);
            }
        }
        let input = LadderInputs::new(Role::Master).read(&ladder(), true, &link(None, 0));
        assert_eq!((input.peer, input.is_press), (None, true));
    }

    #[test]
    fn a_press_of_the_slave_is_a_master_that_aligns_now() {
        use LadderState::{Aligning, Disengaged, Engaged};
        let align_ns = LadderSettings::default().align_ns;
        let hold_ns = LadderSettings::default().hold_after_ns;
        for state in [Aligning, Disengaged, Engaged] {
            for clutch in [false, true] {
                for (echo_age_ns, is_fresh, is_current) in
                    [(None, true, false), (Some(align_ns), true, true), (Some(align_ns + 1), false, false)]
                {
                    for (age_ns, heard) in
                        [(None, false), (Some(hold_ns + MS), true), (Some(hold_ns + MS + 1), false)]
                    {
                        let newest = frame(state, clutch, Some(3), echo_age_ns);
                        let view = LinkView { age_ns, ..link(Some(newest), 9) };
                        let mut inputs = LadderInputs::new(Role::Slave);
                        // The button is the master's.
                        let input = inputs.read(&ladder(), !clutch, &view);
                        let closed = clutch && state != Disengaged;
                        assert_eq!((input.clutch, inputs.clutch()), (closed, closed));
                        assert_eq!(
                            input.is_press,
                            closed && heard && is_fresh && state == Aligning,
                            "{view:?}"
                        );
                        assert_eq!(input.peer.unwrap().is_current, is_current);
                    }
                }
            }
        }
        let input = LadderInputs::new(Role::Slave).read(&ladder(), true, &link(None, 0));
        assert_eq!((input.peer, input.is_press, input.clutch), (None, false, false));
    }

    #[test]
    fn a_release_counts_where_the_peer_knew_of_what_made_it_necessary() {
        for role in [Role::Master, Role::Slave] {
            for (hears, echo, answers) in [
                (true, Some(20), true),
                (true, Some(21), true),
                (true, Some(19), false),
                (true, None, false),
                (false, Some(20), false),
            ] {
                let newest = PeerFrame { hears, ..frame(LadderState::Hold, false, echo, Some(0)) };
                let mut inputs = LadderInputs::new(role);
                assert!(!inputs.read(&ladder(), false, &link(Some(newest), 5)).needs_answer);
                let ladder = held();
                for next_sequence in 20..25 {
                    let input = inputs.read(&ladder, false, &link(Some(newest), next_sequence));
                    let peer = input.peer.unwrap();
                    assert_eq!((peer.answers, peer.hears), (answers, hears), "{role:?} {echo:?}");
                    assert_eq!(input.needs_answer, role == Role::Slave);
                }
            }
        }
    }

    #[test]
    fn the_first_frame_with_a_press_is_that_of_its_tick() {
        let mut inputs = LadderInputs::new(Role::Master);
        let mut ladder = ladder();
        let newest = frame(LadderState::Disengaged, false, Some(39), None);
        let mut step = |now: u64, button: bool| {
            let state = inputs.step(&mut ladder, now * MS, button, &link(Some(newest), 40 + now));
            (state, inputs.pressed_sequence)
        };
        assert_eq!(step(0, false), (LadderState::Disengaged, 0));
        assert_eq!(step(1, true), (LadderState::Aligning, 41));
        assert_eq!(step(2, true), (LadderState::Aligning, 41));
        assert_eq!(step(3, false), (LadderState::Disengaged, 41));
        assert_eq!(step(4, true), (LadderState::Aligning, 44));
    }
}
