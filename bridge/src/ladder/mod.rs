//! The degradation ladder: what a silent peer, an open clutch and a bad number lead to.
//!
//! [`table`] says what leads where, and `docs/ladder.md` shows it as a diagram that a test holds to the table.
//! [`Ladder`] finds out what is the case at a tick and asks the table. [`Person`] is a hand at the clutch for runs
//! without a button, [`FlightRecorder`] what is left when something went wrong.

mod button;
mod diagnosis;
mod flight;
mod history;
mod input;
mod interventions;
mod machine;
mod person;
mod settings;
mod state;
pub mod table;

pub(crate) use button::Button;
pub use diagnosis::{Diagnosis, Explanation, PeerCause, Remedy, Step};
pub use flight::{FlightEntry, FlightRecorder, FlightValues};
pub use history::{History, Transition};
pub use input::{LadderInput, LadderInputs, LinkView, PeerFrame, PeerReport};
pub use interventions::{Observed, thresholds};
pub use machine::Ladder;
pub(crate) use person::START_NS;
pub use person::{Clutch, ClutchError, SimulatedOperator};
pub use settings::{LadderError, LadderSettings};
pub use state::LadderState;
pub use table::Reason;
