//! Input of a ladder at one tick: from the button, and from the state and echo in the peer's newest frame.

use super::table::LadderState;

/// Report in the newest frame of the peer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PeerReport {
    /// State of the peer.
    pub state: LadderState,
    /// True if the peer hears this run of this side.
    pub hears: bool,
    /// True if the peer sent this frame after it heard of the event for which this side last required a
    /// release: a hold, a fault, an ended peer or an unanswered press. An earlier report cannot confirm a
    /// later press or release.
    pub answers: bool,
    /// True if the report is recent enough to let this side engage. At the master, the peer knew of the last
    /// press; at the slave, the report is at most `LadderSettings::align_ns` old.
    pub is_current: bool,
}

/// Orientation of a slave relative to its master before the two engage.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum AlignmentState {
    /// Any orientation: the side engages as it is, like every master.
    #[default]
    Any,
    /// Not aligned yet: the arm has to turn.
    Remaining,
    /// Aligned with the master.
    Reached,
    /// Farther from the master than the arm may turn.
    TooFar,
}

/// Input of a ladder at one tick.
#[allow(clippy::struct_excessive_bools)] // facts of a tick
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LadderInput {
    /// Age in ns of the newest frame of the peer; none before the first.
    pub age_ns: Option<u64>,
    /// Age in ns of the newest frame on a good link. Only age beyond this counts as silence.
    pub expected_age_ns: u64,
    /// Upper bound in ns on the age of the newest frame, less the link's baseline age; none until the
    /// baseline is known.
    pub over_baseline_ns: Option<u64>,
    /// Round trip in ns on this side's clock, from the newest echo; 0 before the first echo.
    pub round_trip_ns: u64,
    /// Report in the newest frame.
    pub peer: Option<PeerReport>,
    /// True if the clutch is closed: at the master its button, at the slave the clutch in the master's frame.
    /// The clutch of a disengaged master counts as open.
    pub clutch: bool,
    /// True to require, outside HOLD and STOP too, that the peer knows the cause before an open clutch counts
    /// as a release. True for a slave after its first such event, because its newest frame may be old.
    pub needs_answer: bool,
    /// True if a press begins at this tick: at the master the edge of the button, at the slave a master that
    /// aligns.
    pub is_press: bool,
    /// True if the peer has ended in an orderly way.
    pub ended: bool,
    /// Alignment of a slave that aligns before it engages.
    pub alignment: AlignmentState,
}

/// Fields of the peer's newest frame that the ladder reads.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PeerFrame {
    /// State of the peer's ladder.
    pub state: LadderState,
    /// True if the peer's clutch is closed.
    pub clutch: bool,
    /// True if the peer hears this run of this side.
    pub hears: bool,
    /// Sequence of the frame of this run that the peer echoes.
    pub echo: Option<u64>,
    /// Time in ns since that frame was sent, on this side's clock. The peer's frame is younger than this, so
    /// this bounds its age.
    pub echo_age_ns: Option<u64>,
}

/// Link as of a tick.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LinkView {
    /// See [`LadderInput::age_ns`].
    pub age_ns: Option<u64>,
    /// See [`LadderInput::expected_age_ns`].
    pub expected_age_ns: u64,
    /// See [`LadderInput::over_baseline_ns`].
    pub over_baseline_ns: Option<u64>,
    /// See [`LadderInput::round_trip_ns`].
    pub round_trip_ns: u64,
    /// Newest frame of the peer.
    pub newest: Option<PeerFrame>,
    /// Sequence of the frame that this tick sends.
    pub next_sequence: u64,
    /// See [`LadderInput::ended`].
    pub ended: bool,
}
