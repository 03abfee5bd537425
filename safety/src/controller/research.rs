//! Research controller: a controller supplied by the caller. It sees the signals of the built-in controllers and adds
//! a force.

use std::fmt::{self, Debug, Formatter};

use nalgebra::SimdValue as _;

use super::Response;
use crate::{Axes, Observation, Real, Signal};
use haptether_numeric::no_lanes;

/// Controller outside the registry.
///
/// It runs after the registered controllers. It may allocate, lock and be slow, so use it in simulated runs only, not
/// in a loop that a hand holds.
pub trait ResearchController: Send + Sync {
    /// Compute one tick: write `F_c` in N into `safety_force`, which is zero on entry. Return false on failure.
    fn step(&mut self, seen: &ResearchObservation<'_>, safety_force: &mut [f64]) -> bool;

    /// Clear the memory of past ticks; the device rests.
    fn reset(&mut self);

    /// Clone the controller with its state, for a layer that is cloned.
    fn boxed_clone(&self) -> Box<dyn ResearchController>;
}

/// Signals of one tick for a research controller, one value per axis.
#[derive(Clone, Copy, Debug)]
pub struct ResearchObservation<'a> {
    /// V in m/s.
    pub velocity: &'a [f64],
    /// `F_v` in N.
    pub rendered_force: &'a [f64],
    /// `F_h` in N.
    pub grasp_force: &'a [f64],
    /// `F_v` in N with the lag of `F_h`, for comparison with it.
    pub aligned_rendered_force: &'a [f64],
}

/// Research controller that runs after the others.
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

    /// Add the controller's force, scaled by `let_through`: the share of `F_v` that the built-in controllers let
    /// through. PC is scaled in the same way.
    ///
    /// `authority` scales the part that does not cancel `F_v`. If the controller fails or returns an invalid force,
    /// the device renders no force.
    ///
    /// Scalar layers only; a layer with several lanes has no research controller.
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
        response.research = !no_lanes::<S>();
        (response.may_act, response.acts) = (true, !no_lanes::<S>());
    }

    pub(crate) fn reset(&mut self) {
        self.0.reset();
    }
}

/// Scale the part of a safety force beyond `-F_v` by `authority`.
///
/// The part that cancels `F_v` is not scaled, because `F_v` is already scaled by `authority`.
fn with_authority<const N: usize>(force: &Axes<N>, rendered: &Axes<N>, authority: f64) -> Axes<N> {
    let squared = rendered.norm_squared();
    if authority == 1.0 || squared == 0.0 {
        return force * authority;
    }
    let cancelling = rendered * -(-force.dot(rendered) / squared).clamp(0.0, 1.0);
    cancelling + (force - cancelling) * authority
}
