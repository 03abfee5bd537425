//! What is rendered on the device of a local loop.

use haptether_safety::{Axes, Real};
use haptether_slave::{Environment, RenderedWalls};

/// A force field that a servo loop samples.
pub trait Rendering<const N: usize, S: Real> {
    /// Whether any of it depends on the velocity.
    fn needs_velocity(&self) -> bool;

    /// The force in N at time t in s, for the position in m and the velocity in m/s that the loop knows; it then acts
    /// for `period_s`.
    fn force(
        &mut self,
        time_s: f64,
        period_s: f64,
        position: &Axes<N, S>,
        velocity: &Axes<N, S>,
    ) -> Axes<N, S>;

    /// Steps of free bodies that were too stiff to be followed to the usual accuracy.
    fn coarse_steps(&self) -> u64 {
        0
    }
}

/// A force field of surfaces.
pub(crate) trait Surfaces<const N: usize> {
    /// Whether a point at `position` in m, for which the force was asked for last, is inside an object.
    fn touches(&self, position: &Axes<N>) -> bool;
}

impl<const N: usize> Surfaces<N> for RenderedWalls<N> {
    fn touches(&self, position: &Axes<N>) -> bool {
        RenderedWalls::touches(self, position)
    }
}

impl<const N: usize> Surfaces<N> for SceneRendering<N> {
    fn touches(&self, _: &Axes<N>) -> bool {
        self.0.touches()
    }
}

impl<const N: usize, S: Real> Rendering<N, S> for RenderedWalls<N, S> {
    #[inline(always)]
    fn needs_velocity(&self) -> bool {
        self.is_damped()
    }

    #[inline(always)]
    fn force(&mut self, time_s: f64, _: f64, position: &Axes<N, S>, velocity: &Axes<N, S>) -> Axes<N, S> {
        RenderedWalls::force(self, time_s, position, velocity)
    }
}

/// Any environment, for one scenario.
#[derive(Clone, Debug)]
pub struct SceneRendering<const N: usize>(pub Environment<N>);

impl<const N: usize> Rendering<N, f64> for SceneRendering<N> {
    fn needs_velocity(&self) -> bool {
        true
    }

    fn force(&mut self, time_s: f64, period_s: f64, position: &Axes<N>, velocity: &Axes<N>) -> Axes<N> {
        let force = self.0.force(position, velocity, time_s);
        self.0.advance(time_s, period_s, position, velocity);
        force
    }

    fn coarse_steps(&self) -> u64 {
        self.0.coarse_steps()
    }
}
