//! The loop without a network: device, hand and a force that is rendered on the spot.

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
    /// `F_v` in N, as requested.
    pub requested_force: Axes<N>,
    /// `F_v` in N, as far as the device can render it.
    pub rendered_force: Axes<N>,
    /// `F_h` in N, as the observers saw it.
    pub grasp_force: Axes<N>,
    /// `F_device` in N.
    pub device_force: Axes<N>,
    /// `F_c` and what the observers said.
    pub response: Response<N>,
}

/// Device and hand under a force rendered at the servo rate and held over each tick, watched by the safety layer.
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
    /// A loop at time 0 with a period of `period_ns`; what is rendered acts `delay` ticks late.
    pub fn new(mut plant: P, rendering: R, delay: DelayLine<N>, watch: Watch<N>, period_ns: u64) -> Self {
        let (last_position, _) = plant.read(0);
        let period_s = period_ns as f64 * 1e-9;
        Self { plant, rendering, delay, watch, period_ns, period_s, tick: 0, last_position }
    }

    /// The device and the hand.
    pub fn plant(&self) -> &P {
        &self.plant
    }

    /// What is rendered.
    pub fn rendering(&self) -> &R {
        &self.rendering
    }

    /// Time of the next tick in s.
    pub fn time_s(&self) -> f64 {
        // The number nearest to the time: a product of seconds lies a rounding beside the times that a scene names.
        (self.tick * self.period_ns) as f64 / 1e9
    }

    /// One tick.
    #[inline(always)] // in the loop of a run
    pub fn step(&mut self) -> LocalTick<N> {
        let time_s = self.time_s();
        let (position, measured_velocity) = self.plant.read(self.tick * self.period_ns);
        self.tick += 1;
        let mut velocity = Axes::zeros();
        if self.rendering.needs_velocity() {
            // What a servo loop has of V when it renders damping.
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
    /// Whether any of it depends on the velocity.
    fn needs_velocity(&self) -> bool;

    /// The force in N at time t in s, for the position in m and the velocity in m/s that the loop knows; it then acts
    /// for `period_s`.
    fn force(&mut self, time_s: f64, period_s: f64, position: &Axes<N>, velocity: &Axes<N>) -> Axes<N>;

    /// Steps of free bodies that were too stiff to be followed to the accuracy of the others.
    fn coarse_steps(&self) -> u64 {
        0
    }
}

/// A force field of surfaces.
pub(crate) trait Surfaces<const N: usize> {
    /// Whether a point at `position` in m, for which the force was computed last, is inside an object.
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

/// Observers and controllers that see what the scene says.
#[derive(Clone, Debug)]
pub enum Watch<const N: usize> {
    /// What the estimator makes of the measured positions, as live.
    Estimated(Box<SafetyLayer<N>>),
    /// The truth.
    True(Box<TrueWatch<N>>),
}

/// Observers and controllers that see the model's own velocity and force of the hand, for studies that leave estimation
/// out.
#[derive(Clone, Debug)]
pub struct TrueWatch<const N: usize> {
    /// Observers and controllers.
    pub controller: SafetyController<N>,
    /// Bounds on the force, before the observers and after the controllers as in the layer; none where a study switches
    /// them off.
    pub limiters: Option<[Limiter<N>; 2]>,
}

/// What was seen and decided at one tick.
#[derive(Clone, Copy, Debug)]
pub struct Watched<const N: usize> {
    /// `F_v` in N as far as it can be rendered.
    pub rendered_force: Axes<N>,
    /// `F_h` in N as the observers saw it.
    pub grasp_force: Axes<N>,
    /// `F_device` in N.
    pub device_force: Axes<N>,
    /// `F_c` and what the observers said.
    pub response: Response<N>,
}

impl<const N: usize> Watch<N> {
    /// One tick: `position` in m and, from a device that measures it, `velocity` in m/s; `requested_force` in N.
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

/// A line of `ticks` values: what goes in comes out so many ticks later; before that, nothing.
#[derive(Clone, Debug, PartialEq)]
pub struct DelayLine<const N: usize> {
    under_way: Box<[Axes<N>]>,
    next: usize,
}

impl<const N: usize> DelayLine<N> {
    /// A line of that many ticks; 0 passes at once.
    pub fn new(ticks: usize) -> Self {
        Self { under_way: vec![Axes::zeros(); ticks].into_boxed_slice(), next: 0 }
    }

    /// Puts one in and takes one out.
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
    fn what_goes_in_comes_out_so_many_ticks_later() {
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
