//! A side whose operator gives commands at given times.

use crate::{
    FaultText, FlightRecorder, LadderState, OperatorCommand, PathReport, RejectReason, Side, SideCounts,
    TickTime, coupling::CouplingError, wire::MAX_FRAME,
};

/// A side and the commands of its operator, each with its time in ns since the start, in order.
#[derive(Clone, Debug)]
pub struct Timed<S> {
    /// The side.
    pub side: S,
    commands: Vec<(u64, OperatorCommand)>,
    done: usize,
}

impl<S> Timed<S> {
    /// `commands` in the order of their times.
    pub(crate) fn new(side: S, commands: Vec<(u64, OperatorCommand)>) -> Self {
        Self { side, commands, done: 0 }
    }
}

impl<S: Side> Side for Timed<S> {
    type Record = S::Record;
    const FRAME_LENGTH: usize = S::FRAME_LENGTH;

    fn begin(&mut self, now_ns: u64) {
        self.side.begin(now_ns);
    }

    fn late(&mut self, late_ns: u64) {
        self.side.late(late_ns);
    }

    fn receive(&mut self, now_ns: u64, datagram: &[u8]) -> Result<(), RejectReason> {
        self.side.receive(now_ns, datagram)
    }

    fn tick(&mut self, time: TickTime) -> S::Record {
        while let Some((_, command)) =
            self.commands.get(self.done).filter(|(at, _)| *at <= time.now_ns - time.start_ns)
        {
            // They were checked when the scene was built.
            let _ = self.side.act(time.clock_ns, *command);
            self.done += 1;
        }
        self.side.tick(time)
    }

    fn send<'a>(&mut self, now_ns: u64, buffer: &'a mut [u8; MAX_FRAME]) -> &'a [u8] {
        self.side.send(now_ns, buffer)
    }

    fn stalled(&mut self, now_ns: u64) {
        self.side.stalled(now_ns);
    }

    fn device_failed(&mut self) {
        self.side.device_failed();
    }

    fn describe_failure(&mut self, text: &FaultText) {
        self.side.describe_failure(text);
    }

    fn end(&mut self) {
        self.side.end();
    }

    fn peer_ended(&mut self) {
        self.side.peer_ended();
    }

    fn rest(&mut self) {
        self.side.rest();
    }

    fn state(&self) -> LadderState {
        self.side.state()
    }

    fn counts(&self) -> SideCounts {
        self.side.counts()
    }

    fn path(&self, now_ns: u64) -> PathReport {
        self.side.path(now_ns)
    }

    fn flight(&self) -> &FlightRecorder {
        self.side.flight()
    }

    fn press_again(&mut self) {
        self.side.press_again();
    }

    fn has_button(&self) -> bool {
        self.side.has_button()
    }

    fn release_clutch(&mut self) -> bool {
        self.side.release_clutch()
    }

    fn act(&mut self, now_ns: u64, act: OperatorCommand) -> Result<(), CouplingError> {
        self.side.act(now_ns, act)
    }
}
