//! From the numbers of a scene to its parts.

mod axes;
mod environment;
mod error;
mod judging;
mod master;
mod operator;
mod safety;
mod slave;
mod times;
mod walls;

pub(crate) use axes::axes;
pub(crate) use environment::environment;
pub use environment::scene_environment;
pub use error::SceneError;
pub(crate) use judging::measures;
pub(crate) use master::{device_model, exact_master, stepped_master, stepping};
pub(crate) use operator::{clutch, driven_clutch, live_clutch};
pub(crate) use safety::{estimator, limiter, safety_settings, watch};
pub(crate) use slave::{arm, force_sensor};
pub(crate) use times::{late, period_ns, ticks};
pub(crate) use walls::{is_continuous, is_plain, rendered_walls};
