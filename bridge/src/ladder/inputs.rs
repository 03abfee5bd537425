//! Source of a ladder's inputs at each tick: the button, and the state and echo in the peer's newest frame.

use super::{
    input::{AlignmentState, LadderInput, LinkView, PeerFrame, PeerReport},
    machine::Ladder,
    table::LadderState,
};
use crate::wire::Role;

/// Source of a ladder's inputs.
///
/// It stores the sequences of two frames of this side: the first after the last press, and the
/// first after the last event that made a release necessary.
#[derive(Clone, Debug, PartialEq)]
pub struct LadderInputs {
    role: Role,
    /// Alignment at this tick, for a slave that aligns before it engages.
    pub(crate) alignment: AlignmentState,
    /// Clutch as of the last tick.
    pub(super) clutch: bool,
    pub(super) closings: u64,
    pub(super) closed_sequence: u64,
    pub(super) pressed_sequence: u64,
}

impl LadderInputs {
    /// Build the inputs of a side that has not sent a frame yet.
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

    /// Step the ladder; `button` is the master's button.
    #[inline(always)] // otherwise its intermediate values go through memory
    pub fn step(&mut self, ladder: &mut Ladder, now_ns: u64, button: bool, link: &LinkView) -> LadderState {
        let input = self.read(ladder, button, link);
        let before = ladder.state();
        let state = ladder.step(now_ns, &input);
        if state == LadderState::Aligning && before != state {
            self.pressed_sequence = link.next_sequence;
        }
        state
    }

    /// Read the input of a tick.
    #[inline(always)] // otherwise its result goes through memory
    fn read(&mut self, ladder: &Ladder, button: bool, link: &LinkView) -> LadderInput {
        if self.closings != ladder.closings() {
            (self.closings, self.closed_sequence) = (ladder.closings(), link.next_sequence);
        }
        let settings = ladder.settings();
        let newest = link.newest;
        let (clutch, is_press, is_current) = match self.role {
            Role::Master => {
                let is_press = button && !self.clutch;
                // The peer cannot know of a press in the tick of the press.
                let knows =
                    newest.and_then(|frame| frame.echo).is_some_and(|echo| echo >= self.pressed_sequence);
                (button, is_press, knows && !is_press)
            }
            Role::Slave => {
                // A disengaged master with a closed clutch has let its press expire, so the clutch counts as
                // open.
                let closed =
                    newest.is_some_and(|frame| frame.clutch && frame.state != LadderState::Disengaged);
                let max_ns = settings.hold_after_ns + link.expected_age_ns;
                let heard = link.age_ns.is_some_and(|age| age <= max_ns);
                let age_ns = newest.and_then(|frame| frame.echo_age_ns);
                // Without an echo the slave aligns, to inform the master, but does not engage.
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

    /// Clutch as of the last tick.
    pub fn clutch(&self) -> bool {
        self.clutch
    }

    /// Return whether the sender of `frame` knew of the last press.
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

    /// Ladder that has held once: a release is necessary.
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
    fn master_press_is_button_edge_confirmed_by_later_echo() {
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
    fn slave_press_is_an_aligning_master() {
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
                        // The button belongs to the master.
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
    fn release_counts_once_the_peer_knows_its_cause() {
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
    fn press_is_in_the_frame_of_its_tick() {
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
