//! Loop without a network: device, hand and a locally rendered force.

use haptether_safety::{
    Axes, Limiter, Observation, SafetyLayer,
    controller::{Response, SafetyController},
};
use haptether_slave::{Environment, RenderedWalls};

use crate::plant::{ModelPlant, Truth};

/// One tick of the loop.
#[derive(Clone, Copy, Debug)]
pub struct LocalTick<const N: usize> {
    /// True position in m.
    pub position: Axes<N>,
    /// True velocity in m/s.
    pub velocity: Axes<N>,
    /// True force of the hand in N.
    pub hand_force: Axes<N>,
    /// Force in N of walls that act on the device at every instant.
    pub wall_force: Axes<N>,
    /// Requested `F_v` in N.
    pub requested_force: Axes<N>,
    /// `F_v` in N within the limits of the device.
    pub rendered_force: Axes<N>,
    /// `F_h` in N, as the observers see it.
    pub grasp_force: Axes<N>,
    /// `F_device` in N.
    pub device_force: Axes<N>,
    /// `F_c` and the observers' values.
    pub response: Response<N>,
}

/// Device and hand under a force rendered at the servo rate, held over each tick, and watched by the safety layer.
#[derive(Clone, Debug)]
pub struct LocalLoop<P, R, const N: usize> {
    plant: P,
    rendering: R,
    delay: DelayLine<N>,
    watch: Watch<N>,
    period_ns: u64,
    period_s: f64,
    tick: u64,
    last_position: Axes<N>,
}

impl<P, R, const N: usize> LocalLoop<P, R, N>
where
    P: ModelPlant<N>,
    R: Rendering<N>,
{
    /// Create a loop at time 0; the force acts `delay` ticks late.
    pub fn new(mut plant: P, rendering: R, delay: DelayLine<N>, watch: Watch<N>, period_ns: u64) -> Self {
        let (last_position, _) = plant.read(0);
        let period_s = period_ns as f64 * 1e-9;
        Self { plant, rendering, delay, watch, period_ns, period_s, tick: 0, last_position }
    }

    /// Device and hand.
    pub fn plant(&self) -> &P {
        &self.plant
    }

    /// Rendered force field.
    pub fn rendering(&self) -> &R {
        &self.rendering
    }

    /// Time of the next tick in s.
    pub fn time_s(&self) -> f64 {
        // Nearest to the true time: a product of seconds is a rounding off a scene's times.
        (self.tick * self.period_ns) as f64 / 1e9
    }

    /// Does one tick.
    #[inline(always)] // in the loop of a run
    pub fn step(&mut self) -> LocalTick<N> {
        let time_s = self.time_s();
        let (position, measured_velocity) = self.plant.read(self.tick * self.period_ns);
        self.tick += 1;
        let mut velocity = Axes::zeros();
        if self.rendering.needs_velocity() {
            // Velocity estimate of a servo loop that renders damping.
            velocity = (position - self.last_position) / self.period_s;
            self.last_position = position;
        }
        let now = self.rendering.force(time_s, self.period_s, &position, &velocity);
        let requested_force = self.delay.pass(now);
        let watched = self.watch.step(&self.plant, &position, measured_velocity.as_ref(), &requested_force);
        self.plant.write(&watched.device_force);
        let Truth { position, velocity, hand_force } = self.plant.state();
        LocalTick {
            position,
            velocity,
            hand_force,
            wall_force: self.plant.wall_force(),
            requested_force,
            rendered_force: watched.rendered_force,
            grasp_force: watched.grasp_force,
            device_force: watched.device_force,
            response: watched.response,
        }
    }
}

/// A force field that a servo loop samples.
pub trait Rendering<const N: usize> {
    /// Return whether the force depends on the velocity.
    fn needs_velocity(&self) -> bool;

    /// Force in N at `time_s`, for position in m and velocity in m/s as the loop knows them. It acts for `period_s`.
    fn force(&mut self, time_s: f64, period_s: f64, position: &Axes<N>, velocity: &Axes<N>) -> Axes<N>;

    /// Steps of free bodies that were too stiff for full accuracy.
    fn coarse_steps(&self) -> u64 {
        0
    }
}

pub(crate) trait Surfaces<const N: usize> {
    /// Return whether `position` in m, at which the force was last computed, is inside an object.
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

impl<const N: usize> Rendering<N> for RenderedWalls<N> {
    fn needs_velocity(&self) -> bool {
        self.is_damped()
    }

    #[inline(always)] // in the loop of a run
    fn force(&mut self, time_s: f64, _: f64, position: &Axes<N>, velocity: &Axes<N>) -> Axes<N> {
        RenderedWalls::force(self, time_s, position, velocity)
    }
}

/// Any environment, for one scenario.
#[derive(Clone, Debug)]
pub struct SceneRendering<const N: usize>(pub Environment<N>);

impl<const N: usize> Rendering<N> for SceneRendering<N> {
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

/// Observers and controllers with the inputs that the scene chooses.
#[derive(Clone, Debug)]
pub enum Watch<const N: usize> {
    /// Estimates from the measured positions, as live.
    Estimated(Box<SafetyLayer<N>>),
    /// True values.
    True(Box<TrueWatch<N>>),
}

/// Observers and controllers on true velocity and hand force, for studies without estimation.
#[derive(Clone, Debug)]
pub struct TrueWatch<const N: usize> {
    /// Observers and controllers.
    pub controller: SafetyController<N>,
    /// Limiters before observers and after controllers, as in the layer; `None` if switched off.
    pub limiters: Option<[Limiter<N>; 2]>,
}

/// Inputs and decisions of one tick.
#[derive(Clone, Copy, Debug)]
pub struct Watched<const N: usize> {
    /// `F_v` in N within the limits of rendering.
    pub rendered_force: Axes<N>,
    /// `F_h` in N, as the observers see it.
    pub grasp_force: Axes<N>,
    /// `F_device` in N.
    pub device_force: Axes<N>,
    /// `F_c` and the observers' values.
    pub response: Response<N>,
}

impl<const N: usize> Watch<N> {
    /// Does one tick: position in m, velocity in m/s if measured, force in N.
    #[inline(always)] // in the loop of a run
    fn step(
        &mut self,
        plant: &impl ModelPlant<N>,
        position: &Axes<N>,
        velocity: Option<&Axes<N>>,
        requested_force: &Axes<N>,
    ) -> Watched<N> {
        match self {
            Self::Estimated(layer) => {
                let tick = layer.advance(position, velocity, requested_force, 1.0);
                Watched {
                    rendered_force: tick.rendered_force,
                    grasp_force: tick.grasp_force,
                    device_force: tick.device_force,
                    response: tick.response,
                }
            }
            Self::True(watch) => watch.step(&plant.state(), requested_force),
        }
    }
}

impl<const N: usize> TrueWatch<N> {
    #[inline(always)] // in the loop of a run
    fn step(&mut self, truth: &Truth<N>, requested_force: &Axes<N>) -> Watched<N> {
        let Truth { velocity, hand_force: grasp_force, .. } = *truth;
        let rendered_force = match &mut self.limiters {
            Some([rendering, _]) => rendering.limit(requested_force, &Axes::zeros()).force,
            None => *requested_force,
        };
        let seen = Observation::exact(velocity, rendered_force, grasp_force);
        let response = self.controller.respond(&seen, 1.0);
        let sum = rendered_force + response.safety_force;
        let device_force = match &mut self.limiters {
            Some([_, limiter]) => limiter.limit(&sum, &velocity).force,
            None => sum,
        };
        Watched { rendered_force, grasp_force, device_force, response }
    }
}

/// Delay line: returns each value `ticks` ticks later, and zeros before.
#[derive(Clone, Debug, PartialEq)]
pub struct DelayLine<const N: usize> {
    under_way: Box<[Axes<N>]>,
    next: usize,
}

impl<const N: usize> DelayLine<N> {
    /// Create a line of `ticks` ticks; 0 passes values at once.
    pub fn new(ticks: usize) -> Self {
        Self { under_way: vec![Axes::zeros(); ticks].into_boxed_slice(), next: 0 }
    }

    /// Add a value and remove the oldest.
    #[inline(always)] // in the loop of a run
    pub fn pass(&mut self, force: Axes<N>) -> Axes<N> {
        let Some(slot) = self.under_way.get_mut(self.next) else { return force };
        let out = std::mem::replace(slot, force);
        self.next = if self.next + 1 == self.under_way.len() { 0 } else { self.next + 1 };
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn delay_line_delays_by_its_ticks() {
        for ticks in [0_usize, 1, 3, 50] {
            let mut line = DelayLine::<1>::new(ticks);
            for n in 0..200_usize {
                let out = line.pass(Axes::<1>::new(n as f64 + 1.0))[0];
                let expected = if n < ticks { 0.0 } else { (n - ticks) as f64 + 1.0 };
                assert_eq!(out, expected);
            }
        }
    }
}
