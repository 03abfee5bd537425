//! What one tick tells a ladder: from the button, and from what the peer's newest frame says and echoes.

use super::{machine::Ladder, state::LadderState};
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

/// What one tick tells the ladder.
#[allow(clippy::struct_excessive_bools)] // what is the case at a tick
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LadderInput {
    /// Age in ns of the newest that is known of the peer; none before its first frame.
    pub age_ns: Option<u64>,
    /// Age in ns that the link has when nothing is wrong: silence counts from there.
    pub expected_age_ns: u64,
    /// By how much in ns the newest may be older than the link is used to; none until that is known.
    pub over_usual_ns: Option<u64>,
    /// What the newest frame says.
    pub peer: Option<PeerReport>,
    /// Whether the clutch is closed: at the master the button, at the slave what the master's frame says of it. A
    /// disengaged master has none that is.
    pub clutch: bool,
    /// Whether an open clutch is a release only where the peer knew of what made one necessary. So it is in HOLD and
    /// STOP; at the slave, whose news may be old, in DISENGAGED, too.
    pub needs_answer: bool,
    /// Whether that is an act at this tick: at the master the edge of the button, at the slave a master that aligns.
    pub asks: bool,
    /// Whether the peer has ended in good order.
    pub ended: bool,
}

/// The newest frame of the peer, as far as a ladder goes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PeerFrame {
    /// State of its ladder.
    pub state: LadderState,
    /// Whether its clutch is closed.
    pub clutch: bool,
    /// Whether it hears this very session.
    pub hears: bool,
    /// Sequence of the frame of this very session that it echoes.
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
    /// As [`LadderInput::over_usual_ns`].
    pub over_usual_ns: Option<u64>,
    /// The newest frame of the peer.
    pub newest: Option<PeerFrame>,
    /// Sequence of the frame that this tick sends.
    pub next_sequence: u64,
    /// As [`LadderInput::ended`].
    pub ended: bool,
}

/// Makes a ladder's inputs: keeps which frames of this side were the first to tell of what made the last release
/// necessary, and of the last press.
#[derive(Clone, Debug, PartialEq)]
pub struct LadderInputs {
    role: Role,
    /// As of the last tick.
    pub(super) clutch: bool,
    pub(super) closings: u64,
    pub(super) closed_sequence: u64,
    pub(super) pressed_sequence: u64,
}

impl LadderInputs {
    /// Of a side that has sent nothing yet.
    pub fn new(role: Role) -> Self {
        Self { role, clutch: false, closings: 0, closed_sequence: 0, pressed_sequence: 0 }
    }

    /// Steps the ladder; `button` is the master's.
    pub fn step(&mut self, ladder: &mut Ladder, now_ns: u64, button: bool, link: &LinkView) -> LadderState {
        if self.closings != ladder.closings() {
            (self.closings, self.closed_sequence) = (ladder.closings(), link.next_sequence);
        }
        let settings = *ladder.settings();
        let newest = link.newest;
        let (clutch, asks, is_current) = match self.role {
            Role::Master => {
                let asks = button && !self.clutch;
                // Nobody can know of a press at the tick of it.
                let knows =
                    newest.and_then(|frame| frame.echo).is_some_and(|echo| echo >= self.pressed_sequence);
                (button, asks, knows && !asks)
            }
            Role::Slave => {
                // Whoever is disengaged with a closed clutch has let a press expire: it is none any more.
                let closed =
                    newest.is_some_and(|frame| frame.clutch && frame.state != LadderState::Disengaged);
                let most_ns = settings.hold_after_ns + link.expected_age_ns;
                let heard = link.age_ns.is_some_and(|age| age <= most_ns);
                let age_ns = newest.and_then(|frame| frame.echo_age_ns);
                // Without an echo it aligns, so that the master hears of it, but does not engage.
                let asks = newest.is_some_and(|frame| frame.state == LadderState::Aligning)
                    && age_ns.is_none_or(|age| age <= settings.align_ns);
                (closed, closed && heard && asks, age_ns.is_some_and(|age| age <= settings.align_ns))
            }
        };
        self.clutch = clutch;
        let peer = newest.map(|PeerFrame { state, hears, echo, .. }| PeerReport {
            state,
            hears,
            answers: hears && echo.is_some_and(|echo| echo >= self.closed_sequence),
            is_current,
        });
        let &LinkView { age_ns, expected_age_ns, over_usual_ns, ended, .. } = link;
        let needs_answer = self.role == Role::Slave && self.closings > 0;
        let input =
            LadderInput { age_ns, expected_age_ns, over_usual_ns, peer, clutch, needs_answer, asks, ended };
        let before = ladder.state();
        let state = ladder.step(now_ns, &input);
        if state == LadderState::Aligning && before != state {
            self.pressed_sequence = link.next_sequence;
        }
        state
    }

    /// The clutch as of the last tick.
    pub fn clutch(&self) -> bool {
        self.clutch
    }
}
