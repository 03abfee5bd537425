//! What a runner drives: a device on one side, an arm on the other, each along N axes.

use haptether_master::{SimulatedMaster, SteppedMaster};
use haptether_safety::{Axes, Real};
use haptether_slave::SimulatedSlave;

/// A master device as a runner sees it; time is an argument. With a lane type each lane is a device of its own.
pub trait MasterPlant<const N: usize, S: Real = f64> {
    /// Time begins at `now_ns`; called once, before the first read.
    fn begin(&mut self, _now_ns: u64) {}

    /// Position in m at `now_ns` and, if the device measures it, velocity in m/s.
    fn read(&mut self, now_ns: u64) -> (Axes<N, S>, Option<Axes<N, S>>);

    /// Exerts `force` in N from now on.
    fn write(&mut self, force: &Axes<N, S>);

    /// Whether the clutch of the device is pressed; none if it has no button.
    fn clutch(&self) -> Option<bool> {
        None
    }

    /// The two sides have engaged.
    fn engaged(&mut self) {}

    /// What no sensor measures, where the plant is a model.
    fn truth(&self) -> Option<Truth<N, S>> {
        None
    }
}

/// What no sensor of a device measures.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Truth<const N: usize, S: Real = f64> {
    /// True position in m.
    pub position: Axes<N, S>,
    /// True velocity in m/s.
    pub velocity: Axes<N, S>,
    /// True force of the hand in N.
    pub hand_force: Axes<N, S>,
}

/// A model of a device and its hand.
pub trait ModelPlant<const N: usize, S: Real = f64>: MasterPlant<N, S> {
    /// What no sensor measures.
    fn state(&self) -> Truth<N, S>;

    /// True force in N of walls that act on the device by themselves.
    fn wall_force(&self) -> Axes<N, S>;
}

/// A slave arm as a runner sees it; time is an argument.
pub trait SlavePlant<const N: usize> {
    /// Time begins at `now_ns`; called once, before the first read.
    fn begin(&mut self, _now_ns: u64) {}

    /// Position in m, velocity in m/s and `F_e` in N at `now_ns`.
    fn read(&mut self, now_ns: u64) -> [Axes<N>; 3];

    /// Takes the tool to `position` in m, which moves with `velocity` in m/s.
    fn write(&mut self, position: &Axes<N>, velocity: &Axes<N>);

    /// Stops softly: comes to rest within the bounds of the arm and stays there, whatever was written before. Returns
    /// where that is, in m. Nothing is written until the stop is over. Never an emergency stop: power and brakes stay
    /// as they are, so that nothing on the network can switch them.
    fn stop(&mut self) -> Axes<N>;

    /// Comes to rest softly where it is no longer led, and returns where that is, in m. That is written from now on.
    fn hold(&mut self) -> Axes<N> {
        self.stop()
    }

    /// The two sides have engaged.
    fn engaged(&mut self, _now_ns: u64) {}
}

impl<P: MasterPlant<N> + ?Sized, const N: usize> MasterPlant<N> for Box<P> {
    fn begin(&mut self, now_ns: u64) {
        (**self).begin(now_ns);
    }

    fn read(&mut self, now_ns: u64) -> (Axes<N>, Option<Axes<N>>) {
        (**self).read(now_ns)
    }

    fn write(&mut self, force: &Axes<N>) {
        (**self).write(force);
    }

    fn clutch(&self) -> Option<bool> {
        (**self).clutch()
    }

    fn engaged(&mut self) {
        (**self).engaged();
    }

    fn truth(&self) -> Option<Truth<N>> {
        (**self).truth()
    }
}

impl<const N: usize> MasterPlant<N> for SimulatedMaster<N> {
    fn begin(&mut self, now_ns: u64) {
        SimulatedMaster::begin(self, now_ns);
    }

    fn read(&mut self, now_ns: u64) -> (Axes<N>, Option<Axes<N>>) {
        let sample = SimulatedMaster::read(self, now_ns);
        (sample.position, sample.velocity)
    }

    fn write(&mut self, force: &Axes<N>) {
        SimulatedMaster::write(self, force);
    }

    fn engaged(&mut self) {
        self.set_waiting(false);
    }

    fn truth(&self) -> Option<Truth<N>> {
        Some(self.state())
    }
}

impl<const N: usize> ModelPlant<N> for SimulatedMaster<N> {
    fn state(&self) -> Truth<N> {
        Truth { position: *self.position(), velocity: *self.velocity(), hand_force: self.hand_force() }
    }

    fn wall_force(&self) -> Axes<N> {
        SimulatedMaster::wall_force(self)
    }
}

impl<const N: usize, S: Real + haptether_master::Real> MasterPlant<N, S> for SteppedMaster<N, S> {
    fn begin(&mut self, now_ns: u64) {
        SteppedMaster::begin(self, now_ns);
    }

    #[inline(always)]
    fn read(&mut self, now_ns: u64) -> (Axes<N, S>, Option<Axes<N, S>>) {
        self.advance(now_ns);
        (self.measured_position(), self.measured_velocity())
    }

    #[inline(always)]
    fn write(&mut self, force: &Axes<N, S>) {
        SteppedMaster::write(self, force);
    }

    fn engaged(&mut self) {
        self.set_waiting(false);
    }

    fn truth(&self) -> Option<Truth<N, S>> {
        Some(self.state())
    }
}

impl<const N: usize, S: Real + haptether_master::Real> ModelPlant<N, S> for SteppedMaster<N, S> {
    #[inline(always)]
    fn state(&self) -> Truth<N, S> {
        Truth { position: *self.position(), velocity: *self.velocity(), hand_force: *self.hand_force() }
    }

    #[inline(always)]
    fn wall_force(&self) -> Axes<N, S> {
        SteppedMaster::wall_force(self)
    }
}

impl<const N: usize> SlavePlant<N> for SimulatedSlave<N> {
    fn begin(&mut self, now_ns: u64) {
        SimulatedSlave::begin(self, now_ns);
    }

    fn read(&mut self, now_ns: u64) -> [Axes<N>; 3] {
        let sample = SimulatedSlave::read(self, now_ns);
        [sample.position, sample.velocity, sample.environment_force]
    }

    fn write(&mut self, position: &Axes<N>, velocity: &Axes<N>) {
        SimulatedSlave::write(self, position, velocity);
    }

    fn stop(&mut self) -> Axes<N> {
        SimulatedSlave::stop(self)
    }

    fn engaged(&mut self, now_ns: u64) {
        self.start(now_ns);
    }
}
