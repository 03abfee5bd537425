//! States and transitions of the ladder: the table, and the diagram drawn from it.

use std::fmt::Write as _;

use LadderState::{Aligning, Disengaged, Engaged, Fault, Hold, Stale, Stop};
use Reason::{
    Acknowledged, AlignTimedOut, BadNumber, BothAligned, ClutchPressed, ClutchReleased, FramesBack,
    FramesLate, HandGone, HandYields, MasterStartedAnew, NewsOld, OwnDelay, PeerDeaf, PeerDisengaged,
    PeerEnded, PeerFaulted, PeerHolds, PeerRestarted, PeerSilent, PeerStopped, SilentTooLong, TurnCut,
    TurnRefused,
};

/// State of an endpoint, in increasing order of severity.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum LadderState {
    /// Not coupled: the master moves freely and the slave holds. Initial state, and the state
    /// after:
    ///
    /// - a release while coupled or aligning;
    /// - an unanswered press;
    /// - the end of the peer while coupled;
    /// - an acknowledged fault;
    /// - at a slave in HOLD or STOP, a restart of the master.
    Disengaged,
    /// The clutch is pressed. The side waits until the other side is aligned too, for at most
    /// `LadderSettings::align_ns`. Meanwhile an arm that aligns rotates to the master's orientation.
    Aligning,
    /// Coupled.
    Engaged,
    /// Coupled, but the peer's frames are late: the slave continues with a velocity that decays to zero.
    Stale,
    /// Uncoupled for a reason in [`TABLE`], for example a silent peer: the slave holds, the master's force
    /// fades to zero. Ends with a new press of the clutch, in STOP or in FAULT; at a slave also when the
    /// master is restarted.
    Hold,
    /// The peer is silent for too long. Latched: ends with a new press of the clutch or in FAULT; at a slave
    /// also when the master is restarted.
    Stop,
    /// An invalid number, or a failed device. Latched: ends with an acknowledgement at this side only.
    Fault,
}

impl LadderState {
    /// All states, in the order of their codes.
    pub const ALL: [Self; 7] =
        [Self::Disengaged, Self::Aligning, Self::Engaged, Self::Stale, Self::Hold, Self::Stop, Self::Fault];

    /// Byte of the state on the wire and in records.
    pub const fn code(self) -> u8 {
        self as u8
    }

    /// Name of the state in tables.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Disengaged => "disengaged",
            Self::Aligning => "aligning",
            Self::Engaged => "engaged",
            Self::Stale => "stale",
            Self::Hold => "hold",
            Self::Stop => "stop",
            Self::Fault => "fault",
        }
    }

    /// State with this code, if there is one.
    pub fn from_code(code: u8) -> Option<Self> {
        Self::ALL.get(usize::from(code)).copied()
    }

    /// Return whether the slave follows and the master renders.
    pub const fn is_coupled(self) -> bool {
        matches!(self, Self::Engaged | Self::Stale)
    }

    /// Return whether the press of the clutch is in effect: the side is coupled or about to be.
    pub const fn is_aligned(self) -> bool {
        matches!(self, Self::Aligning | Self::Engaged | Self::Stale)
    }

    /// Return whether something is wrong, so that only a deliberate act couples again.
    pub const fn is_held(self) -> bool {
        matches!(self, Self::Hold | Self::Stop | Self::Fault)
    }
}

/// Reason of a transition.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Reason {
    /// A number is not finite or out of range, or the device reports a failure.
    BadNumber = 1,
    /// This side's own loop was late, so its knowledge is old.
    OwnDelay,
    /// The peer began a new run.
    PeerRestarted,
    /// No new frame of the peer for longer than `hold_after`.
    PeerSilent,
    /// The peer does not hear this side.
    PeerDeaf,
    /// The peer is in HOLD.
    PeerHolds,
    /// The peer is in STOP.
    PeerStopped,
    /// The peer is in FAULT.
    PeerFaulted,
    /// The clutch was released.
    ClutchReleased,
    /// The clutch was pressed, after an observed release if one was necessary.
    ClutchPressed,
    /// Both sides hear each other, and both know of the press.
    BothAligned,
    /// No new frame of the peer for longer than `stale_after`.
    FramesLate,
    /// The peer's frames are in time again.
    FramesBack,
    /// For longer than `stop_after`, the peer was silent, did not hear this side, or was in STOP or FAULT. In
    /// ALIGNING only silence counts.
    SilentTooLong,
    /// A person restarted the master.
    MasterStartedAnew,
    /// The operator at this side has acknowledged the fault.
    Acknowledged,
    /// The peer's newest state may be older than the baseline of the link by more than `hold_after`.
    NewsOld,
    /// The peer has ended in an orderly way.
    PeerEnded,
    /// The two sides did not align within `align` after the press.
    AlignTimedOut,
    /// The peer is disengaged while this side is coupled and its clutch closed.
    PeerDisengaged,
    /// The slave's orientation differs from the master's by more than the alignment allows.
    TurnRefused,
    /// While the slave rotated to the master's orientation, one side no longer heard the other, or the master
    /// stopped waiting.
    TurnCut,
    /// After a trip, no hand answered a probe or moved the device in any try.
    HandGone,
    /// After a trip, a hand was felt, but it yielded to the returning force in every try.
    HandYields,
}

impl Reason {
    /// All reasons, in the order of their codes.
    pub const ALL: [Self; 24] = [
        BadNumber,
        OwnDelay,
        PeerRestarted,
        PeerSilent,
        PeerDeaf,
        PeerHolds,
        PeerStopped,
        PeerFaulted,
        ClutchReleased,
        ClutchPressed,
        BothAligned,
        FramesLate,
        FramesBack,
        SilentTooLong,
        MasterStartedAnew,
        Acknowledged,
        NewsOld,
        PeerEnded,
        AlignTimedOut,
        PeerDisengaged,
        TurnRefused,
        TurnCut,
        HandGone,
        HandYields,
    ];

    /// Number of the reason in records, from 1; 0 stands for none.
    pub const fn code(self) -> u8 {
        self as u8
    }

    /// Reason with this number, if there is one.
    pub fn from_code(code: u8) -> Option<Self> {
        Self::ALL.get(usize::from(code).checked_sub(1)?).copied()
    }

    /// Text for the operator.
    pub const fn text(self) -> &'static str {
        match self {
            BadNumber => "an invalid number, or the device failed",
            OwnDelay => "own loop was late",
            PeerRestarted => "peer was restarted",
            PeerSilent => "peer is silent",
            PeerDeaf => "peer does not hear this side",
            PeerHolds => "peer holds",
            PeerStopped => "peer has stopped",
            PeerFaulted => "peer has a fault",
            ClutchReleased => "clutch released",
            ClutchPressed => "clutch pressed after a release",
            BothAligned => "both sides aligned",
            FramesLate => "frames are late",
            FramesBack => "frames are back",
            SilentTooLong => "no working peer for too long",
            MasterStartedAnew => "master was restarted",
            Acknowledged => "fault acknowledged at this side",
            NewsOld => "peer's newest state is old",
            PeerEnded => "peer has ended",
            AlignTimedOut => "press not answered in time",
            PeerDisengaged => "peer is disengaged",
            TurnRefused => "arm is turned too far from the master",
            TurnCut => "arm's turn to the master was cut off",
            HandGone => "no hand was felt on the device after a push",
            HandYields => "the hand on the device yields to the push",
        }
    }
}

/// Row of the table: in state `from`, `reason` leads to state `to`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Row {
    /// State before.
    pub from: LadderState,
    /// Reason of the transition.
    pub reason: Reason,
    /// State after.
    pub to: LadderState,
}

const fn row(from: LadderState, reason: Reason, to: LadderState) -> Row {
    Row { from, reason, to }
}

/// Transitions of the ladder. The first row of a state whose reason applies decides, so severe reasons come
/// first.
///
/// In HOLD and STOP a press counts only while both sides hear each other and the peer knows of the hold. A
/// press into a dead link must not couple when the link returns.
///
/// A press in DISENGAGED leads to ALIGNING. It expires, back to DISENGAGED, if the peer is silent for
/// `stop_after`, restarts, faults, ends, or does not align within `align`. It also expires if the peer
/// refuses it: a peer that has heard this side reports STOP or deafness for two round trips. A release and
/// another press start again.
///
/// If the slave rotates to the master's orientation before it engages, three more events end the press. These
/// are a late loop, silence for the time that leads to HOLD elsewhere, and too large an angle. A moving arm
/// must not depend on a press that can no longer be revoked.
///
/// The end of a peer only reduces the force, so a false end cannot add force. A fault of an ending
/// peer takes precedence over its end, and its end over the silence that follows.
pub const TABLE: &[Row] = &[
    row(Disengaged, BadNumber, Fault),
    row(Disengaged, ClutchPressed, Aligning),
    row(Aligning, BadNumber, Fault),
    row(Aligning, ClutchReleased, Disengaged),
    row(Aligning, OwnDelay, Disengaged),
    row(Aligning, PeerRestarted, Disengaged),
    row(Aligning, PeerFaulted, Disengaged),
    row(Aligning, PeerEnded, Disengaged),
    row(Aligning, SilentTooLong, Disengaged),
    row(Aligning, PeerStopped, Disengaged),
    row(Aligning, PeerDeaf, Disengaged),
    row(Aligning, AlignTimedOut, Disengaged),
    row(Aligning, TurnRefused, Disengaged),
    row(Aligning, TurnCut, Disengaged),
    row(Aligning, BothAligned, Engaged),
    row(Engaged, BadNumber, Fault),
    row(Engaged, OwnDelay, Hold),
    row(Engaged, HandGone, Hold),
    row(Engaged, HandYields, Hold),
    row(Engaged, PeerRestarted, Hold),
    row(Engaged, PeerFaulted, Hold),
    row(Engaged, PeerEnded, Disengaged),
    row(Engaged, PeerSilent, Hold),
    row(Engaged, PeerStopped, Hold),
    row(Engaged, PeerHolds, Hold),
    row(Engaged, PeerDeaf, Hold),
    row(Engaged, NewsOld, Hold),
    row(Engaged, PeerDisengaged, Hold),
    row(Engaged, ClutchReleased, Disengaged),
    row(Engaged, FramesLate, Stale),
    row(Stale, BadNumber, Fault),
    row(Stale, OwnDelay, Hold),
    row(Stale, HandGone, Hold),
    row(Stale, HandYields, Hold),
    row(Stale, PeerRestarted, Hold),
    row(Stale, PeerFaulted, Hold),
    row(Stale, PeerEnded, Disengaged),
    row(Stale, PeerSilent, Hold),
    row(Stale, PeerStopped, Hold),
    row(Stale, PeerHolds, Hold),
    row(Stale, PeerDeaf, Hold),
    row(Stale, NewsOld, Hold),
    row(Stale, PeerDisengaged, Hold),
    row(Stale, ClutchReleased, Disengaged),
    row(Stale, FramesBack, Engaged),
    row(Hold, BadNumber, Fault),
    row(Hold, MasterStartedAnew, Disengaged),
    row(Hold, SilentTooLong, Stop),
    row(Hold, ClutchPressed, Aligning),
    row(Stop, BadNumber, Fault),
    row(Stop, MasterStartedAnew, Disengaged),
    row(Stop, ClutchPressed, Aligning),
    row(Fault, Acknowledged, Disengaged),
];

/// Set of reasons that apply at the same time.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Facts(u32);

impl Facts {
    /// Add `reason` if `holds` is true.
    #[must_use]
    pub const fn with(self, reason: Reason, holds: bool) -> Self {
        Self(self.0 | (holds as u32) << reason.code())
    }

    /// Remove `reason`.
    #[must_use]
    pub const fn without(self, reason: Reason) -> Self {
        Self(self.0 & !(1 << reason.code()))
    }

    /// Facts that follow from the state of the peer.
    pub(super) const fn of_peer(state: LadderState) -> Self {
        let nothing = Self(0);
        match state {
            Disengaged => nothing.with(PeerDisengaged, true),
            Hold => nothing.with(PeerHolds, true),
            Stop => nothing.with(PeerStopped, true),
            Fault => nothing.with(PeerFaulted, true),
            Aligning | Engaged | Stale => nothing,
        }
    }

    /// Return whether `reason` applies.
    pub const fn has(self, reason: Reason) -> bool {
        self.0 & 1 << reason.code() != 0
    }
}

/// For each state, the set of reasons with a row. In most ticks none of them applies.
const LEAVING: [Facts; LadderState::ALL.len()] = {
    let mut leaving = [Facts(0); LadderState::ALL.len()];
    let mut index = 0;
    while index < TABLE.len() {
        let Row { from, reason, .. } = TABLE[index];
        leaving[from as usize] = leaving[from as usize].with(reason, true);
        index += 1;
    }
    leaving
};

/// [`Ladder::stays_engaged`](super::Ladder) tests the opposite of the first ten reasons itself. No tick
/// raises the last five: calls outside a tick raise them. A new row of ENGAGED must be tested there too.
const _: () = {
    let reasons = [
        PeerFaulted,
        PeerEnded,
        PeerSilent,
        PeerStopped,
        PeerHolds,
        PeerDeaf,
        NewsOld,
        PeerDisengaged,
        ClutchReleased,
        FramesLate,
        BadNumber,
        OwnDelay,
        HandGone,
        HandYields,
        PeerRestarted,
    ];
    let mut known = Facts(0);
    let mut index = 0;
    while index < reasons.len() {
        known = known.with(reasons[index], true);
        index += 1;
    }
    assert!(LEAVING[Engaged as usize].0 == known.0);
};

/// First row of `state` whose reason is in `facts`.
#[inline]
pub fn next(state: LadderState, facts: Facts) -> Option<Row> {
    if LEAVING[state as usize].0 & facts.0 == 0 {
        return None;
    }
    TABLE.iter().find(|row| row.from == state && facts.has(row.reason)).copied()
}

/// Draw the table as a Mermaid state diagram.
pub fn diagram() -> String {
    let mut text = String::from("stateDiagram-v2\n    [*] --> DISENGAGED\n");
    let upper = |state: LadderState| state.name().to_uppercase();
    // Rows with the same states share an arrow, at the position of the first of them.
    for (index, row) in TABLE.iter().enumerate() {
        let same = |other: &&Row| (other.from, other.to) == (row.from, row.to);
        if row.from == row.to || TABLE[..index].iter().any(|before| same(&before)) {
            continue;
        }
        let reasons: Vec<_> = TABLE.iter().filter(same).map(|row| row.reason.text()).collect();
        let _ = writeln!(text, "    {} --> {}: {}", upper(row.from), upper(row.to), reasons.join(" / "));
    }
    text
}

#[cfg(test)]
mod state_tests {
    use super::*;

    #[test]
    fn codes_are_reversible() {
        for (code, state) in (0_u8..).zip(LadderState::ALL) {
            assert_eq!((state.code(), LadderState::from_code(code)), (code, Some(state)));
        }
        assert_eq!(LadderState::from_code(7), None);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Reasons that end a waiting press.
    const ENDS: [Reason; 10] = [
        OwnDelay,
        PeerRestarted,
        PeerFaulted,
        PeerEnded,
        SilentTooLong,
        PeerStopped,
        PeerDeaf,
        AlignTimedOut,
        TurnRefused,
        TurnCut,
    ];

    fn all_facts() -> impl Iterator<Item = Facts> {
        (0..1_u32 << 24).map(|bits| Facts(bits << 1))
    }

    #[test]
    fn facts_are_independent() {
        let all = Reason::ALL.iter().fold(Facts::default(), |facts, reason| facts.with(*reason, true));
        for reason in Reason::ALL {
            for facts in [Facts::default(), all] {
                let (there, gone) = (facts.with(reason, true), facts.without(reason));
                assert!(there.has(reason) && !gone.has(reason), "{reason:?}");
                assert_eq!((there.without(reason), gone.with(reason, true)), (gone, there), "{reason:?}");
                assert_eq!((facts.with(reason, false), gone.without(reason)), (facts, gone), "{reason:?}");
                for other in Reason::ALL.iter().filter(|other| **other != reason) {
                    let had = facts.has(*other);
                    assert!(there.has(*other) == had && gone.has(*other) == had, "{reason:?} {other:?}");
                }
            }
        }
    }

    /// Every state with every set of reasons: 7 times 16777216 cases.
    #[test]
    fn every_state_with_every_set_of_reasons() {
        for state in LadderState::ALL {
            for facts in all_facts() {
                let Some(row) = next(state, facts) else {
                    // Reasons that must never be ignored.
                    assert!(!facts.has(BadNumber) || state == Fault, "{state:?} {facts:?}");
                    let worse =
                        [OwnDelay, HandGone, HandYields, PeerSilent, PeerRestarted, NewsOld, PeerDisengaged];
                    assert!(!state.is_coupled() || !worse.iter().any(|reason| facts.has(*reason)));
                    assert!(state != Aligning || !ENDS.iter().any(|reason| facts.has(*reason)));
                    continue;
                };
                if facts.has(BadNumber) && state != Fault {
                    assert_eq!(row.to, Fault);
                }
                match row.to {
                    // A side is coupled only out of ALIGNING, while its press is valid, or out of STALE.
                    Engaged => assert!(
                        (row.from, row.reason) == (Aligning, BothAligned)
                            && !ENDS.iter().any(|reason| facts.has(*reason))
                            || (row.from, row.reason) == (Stale, FramesBack)
                    ),
                    // Only a press starts ALIGNING.
                    Aligning => assert_eq!(row.reason, ClutchPressed),
                    Stale => assert_eq!(row.from, Engaged),
                    Hold => assert!(row.from.is_coupled()),
                    Stop => assert_eq!((row.from, row.reason), (Hold, SilentTooLong)),
                    Fault => assert_eq!(row.reason, BadNumber),
                    Disengaged => match row.from {
                        Fault => assert_eq!(row.reason, Acknowledged),
                        Hold | Stop => assert_eq!(row.reason, MasterStartedAnew),
                        Aligning => assert!(row.reason == ClutchReleased || ENDS.contains(&row.reason)),
                        _ => assert!(matches!(row.reason, ClutchReleased | PeerEnded)),
                    },
                }
            }
        }
    }

    /// Each reason by itself against a table written by hand: the state's rows and nothing else.
    #[test]
    fn each_state_with_each_single_reason() {
        let coupled: &[(Reason, LadderState)] = &[
            (BadNumber, Fault),
            (OwnDelay, Hold),
            (HandGone, Hold),
            (HandYields, Hold),
            (PeerRestarted, Hold),
            (PeerSilent, Hold),
            (PeerDeaf, Hold),
            (NewsOld, Hold),
            (PeerDisengaged, Hold),
            (PeerHolds, Hold),
            (PeerStopped, Hold),
            (PeerFaulted, Hold),
            (ClutchReleased, Disengaged),
            (PeerEnded, Disengaged),
        ];
        let mut engaged = coupled.to_vec();
        engaged.push((FramesLate, Stale));
        let mut stale = coupled.to_vec();
        stale.push((FramesBack, Engaged));
        for (state, expected) in [
            (Disengaged, vec![(BadNumber, Fault), (ClutchPressed, Aligning)]),
            (
                Aligning,
                vec![
                    (BadNumber, Fault),
                    (ClutchReleased, Disengaged),
                    (BothAligned, Engaged),
                    (PeerRestarted, Disengaged),
                    (PeerFaulted, Disengaged),
                    (PeerEnded, Disengaged),
                    (OwnDelay, Disengaged),
                    (SilentTooLong, Disengaged),
                    (PeerStopped, Disengaged),
                    (PeerDeaf, Disengaged),
                    (AlignTimedOut, Disengaged),
                    (TurnRefused, Disengaged),
                    (TurnCut, Disengaged),
                ],
            ),
            (Engaged, engaged),
            (Stale, stale),
            (
                Hold,
                vec![
                    (BadNumber, Fault),
                    (ClutchPressed, Aligning),
                    (SilentTooLong, Stop),
                    (MasterStartedAnew, Disengaged),
                ],
            ),
            (Stop, vec![(BadNumber, Fault), (ClutchPressed, Aligning), (MasterStartedAnew, Disengaged)]),
            (Fault, vec![(Acknowledged, Disengaged)]),
        ] {
            for reason in Reason::ALL {
                let to = next(state, Facts::default().with(reason, true)).map(|row| row.to);
                let wanted = expected.iter().find(|(one, _)| *one == reason).map(|(_, to)| *to);
                assert_eq!(to, wanted, "{state:?} {reason:?}");
            }
        }
    }

    #[test]
    fn reasons_have_unique_numbers_and_texts() {
        for (index, reason) in Reason::ALL.into_iter().enumerate() {
            assert_eq!(Reason::from_code(reason.code()), Some(reason));
            assert_eq!(usize::from(reason.code()), index + 1);
            assert!(!Reason::ALL[..index].iter().any(|other| other.text() == reason.text()));
        }
        assert_eq!((Reason::from_code(0), Reason::from_code(25)), (None, None));
    }

    /// The diagram in the documentation equals that of the table.
    #[test]
    fn the_documentation_shows_this_table() {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../docs/ladder.md");
        let page = std::fs::read_to_string(path).unwrap();
        let drawn = format!("```mermaid\n{}```", diagram());
        assert!(page.contains(&drawn), "docs/ladder.md must contain:\n{drawn}");
    }
}
