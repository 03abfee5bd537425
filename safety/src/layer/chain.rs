//! The chain itself, in each lane: perceive, decide, bound.

use super::{Advance, SafetyLayer};
use crate::{
    Axes, Observation, Real,
    estimator::{Estimator, Motion},
    limiter::Bounded,
};

/// What is known before the controllers decide.
#[derive(Clone, Copy)]
pub(super) struct Perceived<const N: usize, S: Real> {
    rendering: Bounded<N, S>,
    motion: Motion<N, S>,
    pub(super) seen: Observation<N, S>,
}

impl<const N: usize, S: Real> SafetyLayer<N, S> {
    /// One tick as [`tick_with_authority`](SafetyLayer::tick_with_authority), in each lane and without its door: a bad
    /// number stops nothing. Where [`Advance::seen`] does not [pass](Observation::passes), or a number that is given
    /// here would not, the checked tick would have stopped.
    #[inline(always)]
    pub fn advance(
        &mut self,
        position: &Axes<N, S>,
        velocity: Option<&Axes<N, S>>,
        rendered_force: &Axes<N, S>,
        authority: S,
    ) -> Advance<N, S> {
        let perceived = self.perceive(position, velocity, rendered_force);
        self.act(&perceived, authority)
    }

    #[inline(always)]
    pub(super) fn perceive(
        &mut self,
        position: &Axes<N, S>,
        velocity: Option<&Axes<N, S>>,
        rendered_force: &Axes<N, S>,
    ) -> Perceived<N, S> {
        // The observers compare F_v with the hand. A force that the device cannot or must not render yet would look
        // like one that nobody holds, so F_v is bounded before it is observed. At V = 0 the power bound is idle.
        let rendering = self.rendering.limit(rendered_force, &Axes::zeros());
        let (motion, seen) = self.observe(position, velocity, &rendering.force);
        Perceived { rendering, motion, seen }
    }

    #[inline(always)]
    pub(super) fn act(&mut self, perceived: &Perceived<N, S>, authority: S) -> Advance<N, S> {
        let Perceived { rendering, motion, seen } = *perceived;
        let response = self.controller.respond(&seen, authority);
        let rendered_force = seen.rendered_force;
        let limited = self.limiter.limit(&(rendered_force + response.safety_force), &motion.velocity);
        let delivered = limited.force - rendered_force;
        let owed_energy_j = self.controller.owed_energy_j(response.energy_j, &delivered, &motion.velocity);
        self.device_force = limited.force;
        Advance {
            motion,
            rendered_force,
            grasp_force: seen.grasp_force,
            aligned_rendered_force: seen.aligned_rendered_force,
            device_force: limited.force,
            response,
            rendering,
            limited,
            owed_energy_j,
        }
    }

    /// V and A, and what the observers see of them.
    #[inline(always)]
    pub(super) fn observe(
        &mut self,
        position: &Axes<N, S>,
        velocity: Option<&Axes<N, S>>,
        rendered_force: &Axes<N, S>,
    ) -> (Motion<N, S>, Observation<N, S>) {
        let motion = match velocity {
            Some(velocity) => self.measured.step(velocity),
            None => self.estimator.step(position),
        };
        let grasp_force = if self.controller.needs_grasp_force() {
            let aligned = match velocity {
                Some(_) => self.measured.align(&self.device_force),
                None => self.estimator.align(&self.device_force),
            };
            self.device.grasp_force(&motion, &aligned)
        } else {
            Axes::zeros()
        };
        let aligned_rendered_force = self.align_rendered(position, velocity, rendered_force);
        let seen = Observation {
            velocity: motion.velocity,
            rendered_force: *rendered_force,
            grasp_force,
            aligned_rendered_force,
        };
        (motion, seen)
    }

    /// `F_v` of the past ticks through the kernel of A, only where an observer compares it with `F_h`.
    #[inline(always)]
    fn align_rendered(
        &mut self,
        position: &Axes<N, S>,
        velocity: Option<&Axes<N, S>>,
        rendered_force: &Axes<N, S>,
    ) -> Axes<N, S> {
        let last = std::mem::replace(&mut self.last_rendered, *rendered_force);
        match (&mut self.rendered, velocity) {
            // F_h is a mean over the last tick, in which the last force was rendered.
            (Some(_), Some(_)) => last,
            (Some(kernel), None) => {
                // A kernel that depends on the motion must see the same motion.
                kernel.step(position);
                kernel.align(&last)
            }
            (None, _) => *rendered_force,
        }
    }

    /// Forgets the past: the device rests at `position`, and its force rises from zero again.
    pub fn rest_at(&mut self, position: &Axes<N, S>) {
        self.estimator.reset(position);
        self.measured.reset();
        if let Some(kernel) = &mut self.rendered {
            kernel.reset(position);
        }
        self.last_rendered = Axes::zeros();
        self.controller.reset();
        self.rendering.reset();
        self.limiter.reset();
        self.device_force = Axes::zeros();
    }
}
