//! What a local loop drives.

use haptether_master::{SimulatedMaster, SteppedMaster};
use haptether_safety::{Axes, Real};

/// Device and hand, for one scenario or several side by side; time is an argument.
pub trait LocalPlant<const N: usize, S: Real> {
    /// Advances to `now_ns`.
    fn advance(&mut self, now_ns: u64);

    /// x in m, as the encoder sees it.
    fn measured_position(&self) -> Axes<N, S>;

    /// V in m/s, only from a device that measures it.
    fn measured_velocity(&self) -> Option<Axes<N, S>>;

    /// True position in m.
    fn position(&self) -> Axes<N, S>;

    /// True velocity in m/s.
    fn velocity(&self) -> Axes<N, S>;

    /// True force of the hand in N.
    fn hand_force(&self) -> Axes<N, S>;

    /// True force in N of walls that act on the device by themselves.
    fn wall_force(&self) -> Axes<N, S>;

    /// Exerts `force` in N from now on.
    fn write(&mut self, force: &Axes<N, S>);
}

impl<const N: usize> LocalPlant<N, f64> for SimulatedMaster<N> {
    fn advance(&mut self, now_ns: u64) {
        self.read(now_ns);
    }

    fn measured_position(&self) -> Axes<N> {
        self.measured().position
    }

    fn measured_velocity(&self) -> Option<Axes<N>> {
        self.measured().velocity
    }

    fn position(&self) -> Axes<N> {
        *SimulatedMaster::position(self)
    }

    fn velocity(&self) -> Axes<N> {
        *SimulatedMaster::velocity(self)
    }

    fn hand_force(&self) -> Axes<N> {
        SimulatedMaster::hand_force(self)
    }

    fn wall_force(&self) -> Axes<N> {
        SimulatedMaster::wall_force(self)
    }

    fn write(&mut self, force: &Axes<N>) {
        SimulatedMaster::write(self, force);
    }
}

impl<const N: usize, S: Real + haptether_master::Real> LocalPlant<N, S> for SteppedMaster<N, S> {
    #[inline(always)]
    fn advance(&mut self, now_ns: u64) {
        SteppedMaster::advance(self, now_ns);
    }

    #[inline(always)]
    fn measured_position(&self) -> Axes<N, S> {
        SteppedMaster::measured_position(self)
    }

    #[inline(always)]
    fn measured_velocity(&self) -> Option<Axes<N, S>> {
        SteppedMaster::measured_velocity(self)
    }

    #[inline(always)]
    fn position(&self) -> Axes<N, S> {
        *SteppedMaster::position(self)
    }

    #[inline(always)]
    fn velocity(&self) -> Axes<N, S> {
        *SteppedMaster::velocity(self)
    }

    #[inline(always)]
    fn hand_force(&self) -> Axes<N, S> {
        *SteppedMaster::hand_force(self)
    }

    #[inline(always)]
    fn wall_force(&self) -> Axes<N, S> {
        SteppedMaster::wall_force(self)
    }

    #[inline(always)]
    fn write(&mut self, force: &Axes<N, S>) {
        SteppedMaster::write(self, force);
    }
}
