//! A controller of the caller's own, for research: it sees what the others see and adds a force.

use std::fmt::{self, Debug, Formatter};

use nalgebra::SimdValue as _;

use super::Response;
use crate::{Axes, Observation, Real, Signal, lanes::nowhere};

/// A controller that is not of the registry.
///
/// It stands after those that are and is the caller's alone: it may allocate, lock and be slow, so that it belongs into
/// simulated runs and not into a loop that a hand holds.
pub trait ResearchController: Send + Sync {
    /// One tick: writes `F_c` in N, which is zero before; returns whether it could.
    fn step(&mut self, seen: &ResearchObservation<'_>, safety_force: &mut [f64]) -> bool;

    /// Clears what it remembers of past ticks: the device rests.
    fn reset(&mut self);

    /// Another one in the same state, for a layer that is cloned.
    fn boxed_clone(&self) -> Box<dyn ResearchController>;
}

/// What a research controller sees of one tick, one value per axis.
#[derive(Clone, Copy, Debug)]
pub struct ResearchObservation<'a> {
    /// V in m/s.
    pub velocity: &'a [f64],
    /// `F_v` in N.
    pub rendered_force: &'a [f64],
    /// `F_h` in N.
    pub grasp_force: &'a [f64],
    /// `F_v` in N as late as `F_h` is, to compare the two.
    pub aligned_rendered_force: &'a [f64],
}

/// A research controller in its place behind the others.
pub(crate) struct Research(Box<dyn ResearchController>);

impl Clone for Research {
    fn clone(&self) -> Self {
        Self(self.0.boxed_clone())
    }
}

impl Debug for Research {
    fn fmt(&self, formatter: &mut Formatter<'_>) -> fmt::Result {
        formatter.write_str("Research")
    }
}

impl Research {
    pub(crate) fn new(controller: Box<dyn ResearchController>) -> Self {
        Self(controller)
    }

    /// Adds its force in the share `let_through` that the intervention of the others leaves, as PC adds its own, and what of
    /// it does not cancel `F_v` in the share `authority`. Where it fails, or gives a number that is no force, the device
    /// renders none.
    ///
    /// Only of one scenario: lanes have no research controller.
    pub(crate) fn add<const N: usize, S: Real>(
        &mut self,
        seen: &Observation<N, S>,
        let_through: S,
        authority: S,
        response: &mut Response<N, S>,
    ) {
        let one = Observation {
            velocity: seen.velocity.extract(0),
            rendered_force: seen.rendered_force.extract(0),
            grasp_force: seen.grasp_force.extract(0),
            aligned_rendered_force: seen.aligned_rendered_force.extract(0),
        };
        let mut force = Axes::<N>::zeros();
        let observation = ResearchObservation {
            velocity: one.velocity.as_slice(),
            rendered_force: one.rendered_force.as_slice(),
            grasp_force: one.grasp_force.as_slice(),
            aligned_rendered_force: one.aligned_rendered_force.as_slice(),
        };
        let could = self.0.step(&observation, force.as_mut_slice());
        if !could || Signal::RenderedForce.check(&force).is_err() {
            response.safety_force = -seen.rendered_force;
        } else if force.iter().any(|value| *value != 0.0) && let_through.extract(0) > 0.0 {
            let force = with_authority(&force, &one.rendered_force, authority.extract(0));
            response.safety_force += force.map(S::splat) * let_through;
        } else {
            return;
        }
        response.research = !nowhere::<S>();
        (response.may_act, response.acts) = (true, !nowhere::<S>());
    }

    pub(crate) fn reset(&mut self) {
        self.0.reset();
    }
}

/// A safety force of which only what goes beyond `-F_v` needs authority: cancelling takes a force away, which has faded
/// with the authority already.
fn with_authority<const N: usize>(force: &Axes<N>, rendered: &Axes<N>, authority: f64) -> Axes<N> {
    let squared = rendered.norm_squared();
    if authority == 1.0 || squared == 0.0 {
        return force * authority;
    }
    let cancelling = rendered * -(-force.dot(rendered) / squared).clamp(0.0, 1.0);
    cancelling + (force - cancelling) * authority
}
