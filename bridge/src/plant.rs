//! What a runner drives: a device on one side, an arm on the other, each along N axes.

use haptether_master::SimulatedMaster;
use haptether_safety::Axes;
use haptether_slave::SimulatedSlave;

/// A master device as a runner sees it; time is an argument.
pub trait MasterPlant<const N: usize> {
    /// Time begins at `now_ns`; called once, before the first read.
    fn begin(&mut self, _now_ns: u64) {}

    /// Position in m at `now_ns` and, if the device measures it, velocity in m/s.
    fn read(&mut self, now_ns: u64) -> (Axes<N>, Option<Axes<N>>);

    /// Exerts `force` in N from now on.
    fn write(&mut self, force: &Axes<N>);

    /// The two sides have engaged.
    fn engaged(&mut self) {}

    /// What no sensor tells, where the plant is a model: true velocity in m/s and true force of the hand in N.
    fn truth(&self) -> Option<(Axes<N>, Axes<N>)> {
        None
    }
}

/// A slave arm as a runner sees it; time is an argument.
pub trait SlavePlant<const N: usize> {
    /// Time begins at `now_ns`; called once, before the first read.
    fn begin(&mut self, _now_ns: u64) {}

    /// Position in m, velocity in m/s and `F_e` in N at `now_ns`.
    fn read(&mut self, now_ns: u64) -> [Axes<N>; 3];

    /// Takes the tool to `position` in m.
    fn write(&mut self, position: &Axes<N>);

    /// Stays where it is.
    fn stop(&mut self);

    /// The two sides have engaged.
    fn engaged(&mut self, _now_ns: u64) {}
}

impl MasterPlant<1> for SimulatedMaster {
    fn begin(&mut self, now_ns: u64) {
        SimulatedMaster::begin(self, now_ns);
    }

    fn read(&mut self, now_ns: u64) -> (Axes<1>, Option<Axes<1>>) {
        let sample = SimulatedMaster::read(self, now_ns);
        (Axes::<1>::new(sample.position), sample.velocity.map(Axes::<1>::new))
    }

    fn write(&mut self, force: &Axes<1>) {
        SimulatedMaster::write(self, force[0]);
    }

    fn engaged(&mut self) {
        self.set_waiting(false);
    }

    fn truth(&self) -> Option<(Axes<1>, Axes<1>)> {
        Some((Axes::<1>::new(self.velocity()), Axes::<1>::new(self.hand_force())))
    }
}

impl SlavePlant<1> for SimulatedSlave {
    fn begin(&mut self, now_ns: u64) {
        SimulatedSlave::begin(self, now_ns);
    }

    fn read(&mut self, now_ns: u64) -> [Axes<1>; 3] {
        let sample = SimulatedSlave::read(self, now_ns);
        [sample.position, sample.velocity, sample.environment_force].map(Axes::<1>::new)
    }

    fn write(&mut self, position: &Axes<1>) {
        SimulatedSlave::write(self, position[0]);
    }

    fn stop(&mut self) {
        SimulatedSlave::stop(self);
    }

    fn engaged(&mut self, now_ns: u64) {
        self.start(now_ns);
    }
}
