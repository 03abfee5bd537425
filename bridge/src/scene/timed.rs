//! A side whose operator gives commands at fixed times.

use crate::{
    Exchange, MasterPlant, MasterRotation, MasterSide, OperatorCommand, Side, SlavePlant, SlaveRotation,
    SlaveSide, TickTime, WithTriggerFeedback,
    coupling::{CouplingError, ScaleRanges},
};

/// Commands of an operator with their times in ns since the start, in order of time.
#[derive(Clone, Debug)]
pub(super) struct Commands {
    list: Vec<(u64, OperatorCommand)>,
    done: usize,
}

impl Commands {
    /// Build from a `list` in order of time.
    pub(super) fn new(list: Vec<(u64, OperatorCommand)>) -> Self {
        Self { list, done: 0 }
    }

    /// Return the next command that is due at `since_start_ns`.
    #[inline]
    pub(super) fn due(&mut self, since_start_ns: u64) -> Option<OperatorCommand> {
        let (_, command) = self.list.get(self.done).filter(|(at, _)| *at <= since_start_ns)?;
        self.done += 1;
        Some(*command)
    }
}

/// A side, and the commands of its operator.
#[derive(Clone, Debug)]
pub struct Timed<S> {
    /// The side.
    pub side: S,
    commands: Commands,
    /// True for an aimed model, which takes aims and pushes of a person.
    is_aimed: bool,
}

impl<S> Timed<S> {
    /// Build from a side and `commands` in order of time.
    pub(crate) fn new(side: S, commands: Vec<(u64, OperatorCommand)>) -> Self {
        Self { side, commands: Commands::new(commands), is_aimed: false }
    }

    /// Return the side with aims and pushes of a person, if `is_aimed`.
    pub(crate) fn aimed(self, is_aimed: bool) -> Self {
        Self { is_aimed, ..self }
    }
}

impl<P, const N: usize> Timed<MasterSide<P, N>> {
    /// Return the side with records of a hand that turns.
    #[must_use]
    pub fn recording_rotation(self) -> Timed<MasterSide<P, N, MasterRotation>>
    where
        P: MasterPlant<N>,
    {
        let Self { side, commands, is_aimed } = self;
        Timed { side: side.recording_rotation(), commands, is_aimed }
    }
}

impl<P: MasterPlant<N>, const N: usize, R> Timed<MasterSide<P, N, R>> {
    /// Return the side with records of the force on the finger at the trigger.
    #[must_use]
    pub fn recording_trigger(self) -> Timed<MasterSide<P, N, WithTriggerFeedback<R>>> {
        let Self { side, commands, is_aimed } = self;
        Timed { side: side.recording_trigger(), commands, is_aimed }
    }
}

impl<P, const N: usize> Timed<SlaveSide<P, N>> {
    /// Return the side with records of an arm that turns.
    #[must_use]
    pub fn recording_rotation(self) -> Timed<SlaveSide<P, N, SlaveRotation>>
    where
        P: SlavePlant<N>,
    {
        let Self { side, commands, is_aimed } = self;
        Timed { side: side.recording_rotation(), commands, is_aimed }
    }
}

impl<S: Side> Side for Timed<S> {
    type Record = S::Record;

    fn begin(&mut self, now_ns: u64) {
        self.side.begin(now_ns);
    }

    #[inline(always)] // once a tick, from few places
    fn tick_into(&mut self, time: TickTime, record: &mut S::Record) {
        while let Some(command) = self.commands.due(time.now_ns - time.start_ns) {
            // The commands were checked when the scene was built.
            let _ = self.side.command(time.clock_ns, command);
        }
        self.side.tick_into(time, record);
    }

    fn command(&mut self, now_ns: u64, command: OperatorCommand) -> Result<bool, CouplingError> {
        if matches!(command, OperatorCommand::Aim(_) | OperatorCommand::Push(_)) && !self.is_aimed {
            return Ok(false);
        }
        self.side.command(now_ns, command)
    }

    fn is_aimed(&self) -> bool {
        self.is_aimed
    }

    fn ranges(&self) -> ScaleRanges {
        self.side.ranges()
    }

    #[inline(always)]
    fn axes(&self) -> usize {
        self.side.axes()
    }

    fn has_button(&self) -> bool {
        self.side.has_button()
    }

    fn rest(&mut self) {
        self.side.rest();
    }

    fn exchange(&self) -> &Exchange {
        self.side.exchange()
    }

    fn exchange_mut(&mut self) -> &mut Exchange {
        self.side.exchange_mut()
    }
}
