//! Safety observers: one number per tick that says how safe the hand is.

mod hand_grasp;
mod passivity;
mod safety;
mod velocity_force;
mod windowed;

pub use hand_grasp::HandGraspObserver;
pub use passivity::PassivityObserver;
pub use safety::SafetyObserver;
pub use velocity_force::{VelocityForceForm, VelocityForceObserver};
pub use windowed::WindowedSafetyObserver;
