//! The loop without a network: device, hand and a force that is rendered on the spot.

mod delay;
mod plant;
mod rendering;
mod watch;

use haptether_master::SteppedMaster;
use haptether_safety::{Axes, Real, controller::Response};
use haptether_slave::RenderedWalls;
use nalgebra::SimdValue as _;

pub use delay::DelayLine;
pub use plant::LocalPlant;
pub(crate) use rendering::Surfaces;
pub use rendering::{Rendering, SceneRendering};
pub use watch::{Watch, Watched};

/// One tick of the loop.
#[derive(Clone, Copy, Debug)]
pub struct LocalTick<const N: usize, S: Real = f64> {
    /// True position in m.
    pub position: Axes<N, S>,
    /// True velocity in m/s.
    pub velocity: Axes<N, S>,
    /// True force of the hand in N.
    pub hand_force: Axes<N, S>,
    /// Force in N of walls that act on the device at every instant.
    pub wall_force: Axes<N, S>,
    /// `F_v` in N, as asked for.
    pub asked_force: Axes<N, S>,
    /// `F_v` in N, as far as the device can render it.
    pub rendered_force: Axes<N, S>,
    /// `F_h` in N, as the observers saw it.
    pub grasp_force: Axes<N, S>,
    /// `F_device` in N.
    pub device_force: Axes<N, S>,
    /// `F_c` and what the observers said.
    pub response: Response<N, S>,
}

/// Device and hand under a force rendered at the servo rate and held over each tick, watched by the safety layer.
///
/// Generic over the scalar: with a lane type each lane is a scenario of its own.
#[derive(Clone, Debug)]
pub struct LocalLoop<P, R, const N: usize, S: Real = f64> {
    plant: P,
    rendering: R,
    delay: DelayLine<N, S>,
    watch: Watch<N, S>,
    period_ns: u64,
    period_s: f64,
    tick: u64,
    last_position: Axes<N, S>,
}

impl<P: LocalPlant<N, S>, R: Rendering<N, S>, const N: usize, S: Real> LocalLoop<P, R, N, S> {
    /// A loop at time 0 with a period of `period_ns`; what is rendered acts `delay` ticks late.
    pub fn new(plant: P, rendering: R, delay: DelayLine<N, S>, watch: Watch<N, S>, period_ns: u64) -> Self {
        let last_position = plant.measured_position();
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
    #[inline(always)]
    pub fn time_s(&self) -> f64 {
        // The number nearest to the time: a product of seconds lies a rounding beside the times that a scene names.
        (self.tick * self.period_ns) as f64 / 1e9
    }

    /// One tick.
    #[inline(always)]
    pub fn step(&mut self) -> LocalTick<N, S> {
        let time_s = self.time_s();
        self.plant.advance(self.tick * self.period_ns);
        self.tick += 1;
        let position = self.plant.measured_position();
        let mut velocity = Axes::zeros();
        if self.rendering.needs_velocity() {
            // What a servo loop has of V when it renders damping.
            velocity = (position - self.last_position) / S::splat(self.period_s);
            self.last_position = position;
        }
        let asked = self.rendering.force(time_s, self.period_s, &position, &velocity);
        let asked_force = self.delay.pass(asked);
        let watched = self.watch.step(&self.plant, &position, &asked_force);
        self.plant.write(&watched.device_force);
        LocalTick {
            position: self.plant.position(),
            velocity: self.plant.velocity(),
            hand_force: self.plant.hand_force(),
            wall_force: self.plant.wall_force(),
            asked_force,
            rendered_force: watched.rendered_force,
            grasp_force: watched.grasp_force,
            device_force: watched.device_force,
            response: watched.response,
        }
    }
}

/// Scenarios side by side; none if they differ in what lanes must share.
pub(crate) fn gather<const N: usize, S: Real + haptether_master::Real>(
    of: &[&LocalLoop<SteppedMaster<N>, RenderedWalls<N>, N>],
) -> Option<LocalLoop<SteppedMaster<N, S>, RenderedWalls<N, S>, N, S>> {
    let first = of.first()?;
    if of.iter().any(|one| (one.period_ns, one.tick) != (first.period_ns, first.tick)) {
        return None;
    }
    let plants: Vec<_> = of.iter().map(|one| one.plant.clone()).collect();
    let renderings: Vec<_> = of.iter().map(|one| one.rendering.clone()).collect();
    let delays: Vec<_> = of.iter().map(|one| &one.delay).collect();
    let watches: Vec<_> = of.iter().map(|one| &one.watch).collect();
    let mut last_position = Axes::<N, S>::zeros();
    for (lane, one) in of.iter().enumerate() {
        last_position.replace(lane, one.last_position);
    }
    Some(LocalLoop {
        plant: SteppedMaster::gather(&plants)?,
        rendering: RenderedWalls::gather(&renderings)?,
        delay: DelayLine::gather(&delays)?,
        watch: Watch::gather(&watches)?,
        period_ns: first.period_ns,
        period_s: first.period_s,
        tick: first.tick,
        last_position,
    })
}
