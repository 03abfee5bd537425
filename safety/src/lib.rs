//! Safety observers, controllers and limits that stand between a remote push and a hand.

mod axes;
pub mod estimator;

pub use axes::{Axes, is_within, sign};
