//! What an observer sees at one tick.

use crate::{
    Axes,
    fault::{Fault, Signal},
};

/// The signals of one tick that observers and controllers read.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Observation<const N: usize> {
    /// V in m/s.
    pub velocity: Axes<N>,
    /// `F_v` in N: what the remote side asks to be felt.
    pub rendered_force: Axes<N>,
    /// `F_h` in N: estimated force of the hand on the device (Eq. 4).
    pub grasp_force: Axes<N>,
    /// `F_v` in N as `F_h` sees it: passed through the same kernel of past ticks
    /// ([`Estimator::align`](crate::estimator::Estimator::align)), because `S_h` compares the two. With exact
    /// signals it is `F_v` itself.
    pub aligned_rendered_force: Axes<N>,
}

impl<const N: usize> Observation<N> {
    /// An observation of exact signals: `F_h` is not late, so `F_v` needs no alignment.
    pub fn exact(velocity: Axes<N>, rendered_force: Axes<N>, grasp_force: Axes<N>) -> Self {
        Self { velocity, rendered_force, grasp_force, aligned_rendered_force: rendered_force }
    }

    /// Refuses numbers that are not finite or absurd.
    pub fn check(&self) -> Result<(), Fault> {
        Signal::Velocity.check(&self.velocity)?;
        Signal::RenderedForce.check(&self.rendered_force)?;
        Signal::RenderedForce.check(&self.aligned_rendered_force)?;
        Signal::GraspForce.check(&self.grasp_force)
    }
}
