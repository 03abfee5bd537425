//! Scenes: a whole experiment as one value, run in virtual time alone or by the thousand.

mod assemble;
mod bilateral;
mod coupled;
mod events;
mod live;
mod local;
mod measures;
mod run;
mod signals;
mod spec;
mod sweep;
mod timed;

pub use assemble::{SceneError, scene_environment};
pub use events::SceneEvent;
pub use live::{driven_master, driven_slave, simulated_master, simulated_slave};
pub use measures::{Divergence, DivergenceCause, Ending, Outcome};
pub use run::{SceneRun, simulate};
pub use signals::Signal;
pub use spec::SceneSpec;
pub use sweep::{Progress, Refused, SweepError, SweepSettings, Variation, sweep};
pub use timed::Timed;
