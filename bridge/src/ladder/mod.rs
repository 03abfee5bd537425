//! The degradation ladder: what a silent peer, an open clutch and a bad number lead to.
//!
//! [`table`] says what leads where, and `docs/ladder.md` shows it as a diagram that a test holds to the table.
//! [`Ladder`] finds out what is the case at a tick and looks it up there. [`ClutchOperator`] works the clutch of
//! runs without a button, [`FlightRecorder`] what is left when something went wrong.

mod diagnosis;
mod flight;
mod input;
mod machine;
mod operator;
mod report;
pub mod table;

pub use diagnosis::{Diagnosis, Explanation, PeerCause, Remedy, Step};
pub use flight::{FlightEntry, FlightRecorder, FlightValues, LAYERS, Observed, thresholds};
pub(crate) use flight::{ROTATION, TRANSLATION, TRIGGER};
pub use input::{AlignmentState, LadderInput, LadderInputs, LinkView, PeerFrame, PeerReport};
pub use machine::{History, Ladder, LadderError, LadderSettings, Transition};
pub(crate) use operator::Button;
pub use operator::{Clutch, ClutchError, ClutchOperator, PRESS_NS};
pub(crate) use report::DiagnosisReport;
pub use table::{LadderState, Reason};
