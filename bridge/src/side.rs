//! One side of the bridge, plant and endpoint together: what both runners call at each tick.

use crate::{
    endpoint::{MasterEndpoint, SlaveEndpoint},
    ladder::LadderState,
    link::{LinkStatistics, Refusal},
    plant::{MasterPlant, SlavePlant},
    record::{MasterRecord, SlaveRecord},
    wire::MAX_FRAME,
};

/// One side: `receive` what has arrived, `tick`, `send`.
pub trait Side {
    /// What a tick leaves behind.
    type Record: Copy + Send + 'static;

    /// Time begins at `now_ns`; called once, before the first tick.
    fn begin(&mut self, now_ns: u64);

    /// Takes a datagram that arrived by `now_ns`; a refused one is counted and otherwise forgotten.
    fn receive(&mut self, now_ns: u64, datagram: &[u8]) -> Result<(), Refusal>;

    /// Reads the plant, decides, writes the plant. `start_ns` is when the run began; `overshoot_ns` how late.
    fn tick(&mut self, start_ns: u64, now_ns: u64, overshoot_ns: u64) -> Self::Record;

    /// Writes the frame of this tick.
    fn send<'a>(&mut self, now_ns: u64, buffer: &'a mut [u8; MAX_FRAME]) -> &'a [u8];

    /// The loop was late by more than the ladder allows.
    fn stalled(&mut self);

    /// Leaves the plant without force or motion.
    fn rest(&mut self);

    /// Where the ladder stands.
    fn state(&self) -> LadderState;

    /// Counts of the link and how often the ladder held.
    fn counts(&self) -> (LinkStatistics, u64);
}

/// The side of the hand.
#[derive(Clone, Debug)]
pub struct MasterSide<P, const N: usize> {
    /// The device.
    pub plant: P,
    /// What decides.
    pub endpoint: MasterEndpoint<N>,
}

impl<P: MasterPlant<N>, const N: usize> Side for MasterSide<P, N> {
    type Record = MasterRecord<N>;

    fn begin(&mut self, now_ns: u64) {
        self.plant.begin(now_ns);
    }

    fn receive(&mut self, now_ns: u64, datagram: &[u8]) -> Result<(), Refusal> {
        self.endpoint.receive(now_ns, datagram)
    }

    fn tick(&mut self, start_ns: u64, now_ns: u64, overshoot_ns: u64) -> MasterRecord<N> {
        let (position, velocity) = self.plant.read(now_ns);
        let tick = self.endpoint.tick(now_ns, &position, velocity.as_ref());
        let truth = self.plant.truth();
        self.plant.write(&tick.safety.device_force);
        if tick.state == LadderState::Engaged {
            self.plant.engaged();
        }
        MasterRecord::new(now_ns - start_ns, overshoot_ns, &position, truth, &tick)
    }

    fn send<'a>(&mut self, now_ns: u64, buffer: &'a mut [u8; MAX_FRAME]) -> &'a [u8] {
        self.endpoint.exchange_mut().send(now_ns, buffer)
    }

    fn stalled(&mut self) {
        self.endpoint.exchange_mut().stalled();
    }

    fn rest(&mut self) {
        self.plant.write(&haptether_safety::Axes::zeros());
    }

    fn state(&self) -> LadderState {
        self.endpoint.exchange().state()
    }

    fn counts(&self) -> (LinkStatistics, u64) {
        self.endpoint.exchange().counts()
    }
}

/// The side of the robot.
#[derive(Clone, Debug)]
pub struct SlaveSide<P, const N: usize> {
    /// The arm.
    pub plant: P,
    /// What decides.
    pub endpoint: SlaveEndpoint<N>,
}

impl<P: SlavePlant<N>, const N: usize> Side for SlaveSide<P, N> {
    type Record = SlaveRecord<N>;

    fn begin(&mut self, now_ns: u64) {
        self.plant.begin(now_ns);
    }

    fn receive(&mut self, now_ns: u64, datagram: &[u8]) -> Result<(), Refusal> {
        self.endpoint.receive(now_ns, datagram)
    }

    fn tick(&mut self, start_ns: u64, now_ns: u64, overshoot_ns: u64) -> SlaveRecord<N> {
        let sample = self.plant.read(now_ns);
        let tick = self.endpoint.tick(now_ns, &sample[0], &sample[1], &sample[2]);
        if let Some(command) = &tick.command {
            self.plant.write(command);
        }
        if tick.state == LadderState::Engaged {
            self.plant.engaged(now_ns);
        }
        SlaveRecord::new(now_ns - start_ns, overshoot_ns, &sample, &tick)
    }

    fn send<'a>(&mut self, now_ns: u64, buffer: &'a mut [u8; MAX_FRAME]) -> &'a [u8] {
        self.endpoint.exchange_mut().send(now_ns, buffer)
    }

    fn stalled(&mut self) {
        self.endpoint.exchange_mut().stalled();
    }

    fn rest(&mut self) {}

    fn state(&self) -> LadderState {
        self.endpoint.exchange().state()
    }

    fn counts(&self) -> (LinkStatistics, u64) {
        self.endpoint.exchange().counts()
    }
}
