//! The checked tick of one layer: a bad number stops it at the door, and it stays stopped.

use super::{SafetyLayer, SafetyTick};
use crate::{
    Axes, Fault, controller::Intervention, estimator::Motion, fault::Signal, is_within, limiter::Acted,
};

impl<const N: usize> SafetyLayer<N> {
    /// One tick: position x in m, velocity V in m/s if the device measures it (at every tick or at none), `F_v`
    /// in N.
    ///
    /// A number that is not finite or absurd gives zero force at this tick and a fault that stays until
    /// [`reset`](Self::reset).
    pub fn tick(
        &mut self,
        position: &Axes<N>,
        velocity: Option<&Axes<N>>,
        rendered_force: &Axes<N>,
    ) -> SafetyTick<N> {
        self.tick_with_authority(position, velocity, rendered_force, 1.0)
    }

    /// As [`tick`](Self::tick), with the controllers' damping in the share `authority` (0 to 1) only.
    pub fn tick_with_authority(
        &mut self,
        position: &Axes<N>,
        velocity: Option<&Axes<N>>,
        rendered_force: &Axes<N>,
        authority: f64,
    ) -> SafetyTick<N> {
        let door = match self.fault {
            Some(fault) => Err(fault),
            None => Signal::Position
                .check(position)
                .and_then(|()| velocity.map_or(Ok(()), |v| Signal::Velocity.check(v)))
                .and_then(|()| Signal::RenderedForce.check(rendered_force)),
        };
        let perceived = door.and_then(|()| {
            let perceived = self.perceive(position, velocity, rendered_force);
            perceived.seen.check().map(|()| perceived)
        });
        match perceived {
            Ok(perceived) => self.act(&perceived, authority).lane(0),
            Err(fault) => self.stop(fault),
        }
    }

    /// A tick that was missed: the device has kept its force, and was at `position` (between two samples) by then.
    ///
    /// Estimator and observers are carried along, so that a late loop does not read several ticks of motion as one;
    /// nothing is decided. The next [`tick`](Self::tick) refuses what is not finite.
    pub fn missed(&mut self, position: &Axes<N>, velocity: Option<&Axes<N>>) {
        if self.fault.is_none() && is_within(position, Signal::Position.bound()) {
            let rendered_force = self.last_rendered;
            let (_, seen) = self.observe(position, velocity, &rendered_force);
            // A bad number would be met again at the tick, which names it.
            let _ = self.controller.step(&seen);
        }
    }

    /// Renders no force from now on, until [`reset`](Self::reset): a fault that only others can see.
    pub fn fail(&mut self, fault: Fault) {
        self.fault.get_or_insert(fault);
    }

    fn stop(&mut self, fault: Fault) -> SafetyTick<N> {
        self.fault = Some(fault);
        self.device_force = Axes::zeros();
        self.rendering.reset();
        self.limiter.reset();
        SafetyTick {
            motion: Motion { velocity: Axes::zeros(), acceleration: Axes::zeros() },
            rendered_force: Axes::zeros(),
            grasp_force: Axes::zeros(),
            device_force: Axes::zeros(),
            intervention: Intervention::none(),
            acted: Acted::default(),
            owed_energy_j: 0.0,
            fault: Some(fault),
        }
    }

    /// Forgets the past as [`reset`](Self::reset) does, but keeps a fault.
    pub fn restart(&mut self, position: &Axes<N>) -> Result<(), Fault> {
        let fault = self.fault;
        let restarted = self.reset(position);
        self.fault = fault;
        restarted
    }

    /// Clears a fault and the past: the device rests at `position`, and its force rises from zero again.
    pub fn reset(&mut self, position: &Axes<N>) -> Result<(), Fault> {
        Signal::Position.check(position)?;
        self.rest_at(position);
        self.fault = None;
        Ok(())
    }
}
