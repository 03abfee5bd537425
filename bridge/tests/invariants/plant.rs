//! A device or an arm whose sensor may be out of order.

use haptether_bridge::{MasterPlant, SlavePlant, Truth};
use haptether_safety::Axes;

use crate::drawn::Broken;

/// A plant whose sensor may be out of order, and what was written to it at the last tick.
#[derive(Clone, Debug)]
pub(crate) struct Plant<P, const N: usize> {
    pub(crate) model: P,
    pub(crate) broken: Option<Broken>,
    pub(crate) written: Option<[Axes<N>; 2]>,
    pub(crate) stops: u64,
}

impl<P, const N: usize> Plant<P, N> {
    pub(crate) fn new(model: P, broken: Option<Broken>) -> Self {
        Self { model, broken, written: None, stops: 0 }
    }
}

impl<P: MasterPlant<N>, const N: usize> MasterPlant<N> for Plant<P, N> {
    fn begin(&mut self, now_ns: u64) {
        self.model.begin(now_ns);
    }

    fn read(&mut self, now_ns: u64) -> (Axes<N>, Option<Axes<N>>) {
        let (mut position, velocity) = self.model.read(now_ns);
        if let Some(value) = Broken::at(self.broken, now_ns) {
            position[N - 1] = value;
        }
        (position, velocity)
    }

    fn write(&mut self, force: &Axes<N>) {
        self.written = Some([*force, Axes::zeros()]);
        self.model.write(force);
    }

    fn engaged(&mut self) {
        self.model.engaged();
    }

    fn truth(&self) -> Option<Truth<N>> {
        self.model.truth()
    }
}

impl<P: SlavePlant<N>, const N: usize> SlavePlant<N> for Plant<P, N> {
    fn begin(&mut self, now_ns: u64) {
        self.model.begin(now_ns);
    }

    fn read(&mut self, now_ns: u64) -> [Axes<N>; 3] {
        let mut sample = self.model.read(now_ns);
        if let Some(value) = Broken::at(self.broken, now_ns) {
            sample[(now_ns % 3) as usize][N - 1] = value;
        }
        sample
    }

    fn write(&mut self, position: &Axes<N>, velocity: &Axes<N>) {
        self.written = Some([*position, *velocity]);
        self.model.write(position, velocity);
    }

    fn stop(&mut self) -> Axes<N> {
        self.stops += 1;
        self.model.stop()
    }

    fn hold(&mut self) -> Axes<N> {
        self.stops += 1;
        self.model.hold()
    }

    fn engaged(&mut self, now_ns: u64) {
        self.model.engaged(now_ns);
    }
}
