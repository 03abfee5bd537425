//! Degradation ladder: reactions to a silent peer, an open clutch and an invalid number.
//!
//! [`table`] lists the transitions; `docs/ladder.md` shows it as a diagram, which a test compares with the
//! table. [`Ladder`] finds the facts of a tick and looks them up there. [`ClutchOperator`] works the
//! clutch of runs without a button. [`FlightRecorder`] keeps the last ticks before a hold or fault.

mod diagnosis;
mod flight;
mod input;
mod inputs;
mod machine;
mod operator;
mod report;
pub mod table;

pub use diagnosis::{Diagnosis, Explanation, PeerCause, Remedy, Step};
pub use flight::{FlightEntry, FlightRecorder, FlightValues, LAYERS, Observed, thresholds};
pub(crate) use flight::{ROTATION, TRANSLATION, TRIGGER};
pub use input::{AlignmentState, LadderInput, LinkView, PeerFrame, PeerReport};
pub use inputs::LadderInputs;
pub use machine::{History, Ladder, LadderError, LadderSettings, Transition};
pub(crate) use operator::Button;
pub use operator::{Clutch, ClutchError, ClutchOperator, PRESS_NS};
pub(crate) use report::DiagnosisReport;
pub use table::{LadderState, Reason};
