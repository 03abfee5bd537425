//! What the safety layer saw and decided at one tick.

use nalgebra::SimdValue as _;

use crate::{
    Axes, Fault, Observation, Real,
    controller::{Intervention, Response},
    estimator::Motion,
    limiter::{Acted, Bounded},
};

/// What the safety layer saw and decided at one tick.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SafetyTick<const N: usize> {
    /// V and A.
    pub motion: Motion<N>,
    /// `F_v` in N as far as the device can render it: what the observers saw.
    pub rendered_force: Axes<N>,
    /// `F_h` in N; zero when no controller reads it.
    pub grasp_force: Axes<N>,
    /// `F_device` in N: what the device is to exert until the next tick.
    pub device_force: Axes<N>,
    /// `F_c` and the observers' values.
    pub intervention: Intervention<N>,
    /// Which bounds acted.
    pub acted: Acted,
    /// Energy in J that PC asked for and the bounds kept it from dissipating.
    pub owed_energy_j: f64,
    /// Why the force is zero, if it is so because of a bad number. Stays until
    /// [`SafetyLayer::reset`](crate::SafetyLayer::reset).
    pub fault: Option<Fault>,
}

/// What the safety layer saw and decided at one tick, in each lane.
#[derive(Clone, Copy, Debug)]
pub struct Advance<const N: usize, S: Real = f64> {
    /// V and A.
    pub motion: Motion<N, S>,
    /// `F_v` in N as far as the device can render it: what the observers saw.
    pub rendered_force: Axes<N, S>,
    /// `F_h` in N; zero when no controller reads it.
    pub grasp_force: Axes<N, S>,
    /// `F_v` in N as late as `F_h`.
    pub aligned_rendered_force: Axes<N, S>,
    /// `F_device` in N: what the device is to exert until the next tick.
    pub device_force: Axes<N, S>,
    /// `F_c` and the observers' values.
    pub response: Response<N, S>,
    /// `F_v` and where it was bounded.
    pub rendering: Bounded<N, S>,
    /// `F_device` and where it was bounded.
    pub limited: Bounded<N, S>,
    /// Energy in J that PC asked for and the bounds kept it from dissipating.
    pub owed_energy_j: S,
}

impl<const N: usize, S: Real> Advance<N, S> {
    /// What the observers saw.
    #[inline(always)]
    pub fn seen(&self) -> Observation<N, S> {
        Observation {
            velocity: self.motion.velocity,
            rendered_force: self.rendered_force,
            grasp_force: self.grasp_force,
            aligned_rendered_force: self.aligned_rendered_force,
        }
    }

    /// The tick of one lane.
    #[inline(always)]
    pub fn lane(&self, lane: usize) -> SafetyTick<N> {
        SafetyTick {
            motion: Motion {
                velocity: self.motion.velocity.extract(lane),
                acceleration: self.motion.acceleration.extract(lane),
            },
            rendered_force: self.rendered_force.extract(lane),
            grasp_force: self.grasp_force.extract(lane),
            device_force: self.device_force.extract(lane),
            intervention: self.response.lane(lane),
            acted: self.rendering.acted(lane).and(self.limited.acted(lane)),
            owed_energy_j: self.owed_energy_j.extract(lane),
            fault: None,
        }
    }
}
