//! Link and ladders of a run. They do not depend on hand and arm while no force is withheld and no number is refused.

use std::collections::VecDeque;

use haptether_safety::Axes;

use super::super::{
    assemble::{SceneError, clutch},
    bilateral::{self, SESSIONS},
    sides::{master_endpoint, slave_endpoint},
    spec::SceneSpec,
};
use crate::{
    Exchange, LadderSettings, LadderState, OperatorCommand, Side, SideKind, TickTime, VirtualSettings,
    buttons::Buttons,
    coupling::CouplingError,
    ladder::{Clutch, ClutchOperator, LAYERS, Observed},
};

/// Settings of link and ladders.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Connection {
    pub(super) settings: VirtualSettings,
    ladder: LadderSettings,
    clutch: Clutch,
    kind: SideKind,
    has_buttons: bool,
}

impl Connection {
    /// Read the settings of a scene that can share.
    pub(super) fn of<const N: usize>(scene: &SceneSpec<N>) -> Result<Self, SceneError> {
        bilateral::check(scene)?;
        // Refused here as by a side with buttons.
        let buttons = scene.master.buttons.map(Buttons::new).transpose()?;
        Ok(Self {
            settings: bilateral::settings(scene)?,
            ladder: scene.safety.ladder.unwrap_or_default(),
            clutch: clutch(scene),
            kind: scene.master.kind,
            has_buttons: buttons.is_some(),
        })
    }
}

/// Link and ladder at a tick of a side.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Step {
    /// True time in ns.
    pub(super) now_ns: u64,
    /// Time in ns on the clock of the side.
    pub(super) clock_ns: u64,
    /// Tick of the peer that sent the newest frame; [`NONE`](Self::NONE) before the first frame.
    newest: u64,
    /// Ticks skipped since the last tick.
    pub(super) missed: u64,
    /// Share of the requested force that the ladder leaves, 0 to 1.
    pub(super) gain: f64,
    /// True if the safety layer withholds its force.
    pub(super) withholds: bool,
    /// Time in ns in STALE.
    pub(super) stale_ns: u64,
    pub(super) state: LadderState,
    /// Code of the reason of the state.
    pub(super) reason: u8,
    /// True if the loop had stalled.
    pub(super) has_stalled: bool,
    /// True if a run of the peer began.
    pub(super) peer_began: bool,
}

impl Default for Step {
    fn default() -> Self {
        Self {
            now_ns: 0,
            clock_ns: 0,
            newest: Self::NONE,
            missed: 0,
            gain: 0.0,
            withholds: false,
            stale_ns: 0,
            state: LadderState::Disengaged,
            reason: 0,
            has_stalled: false,
            peer_began: false,
        }
    }
}

impl Step {
    const NONE: u64 = u64::MAX;

    /// Return the tick of the peer that sent the newest frame.
    pub(super) fn newest(&self) -> Option<u64> {
        (self.newest != Self::NONE).then_some(self.newest)
    }
}

/// Side without hand or arm: its link, its ladder and, of a master, the operator of the clutch.
#[derive(Clone)]
pub(super) struct LinkSide {
    exchange: Exchange,
    /// None for a slave.
    operator: Option<ClutchOperator>,
    /// Sequence number of the first frame, the same for both sides.
    first: u64,
    ticks: u64,
    /// Later ticks at which the safety layer begins to withhold its force. It withholds while the ladder leaves it a
    /// share.
    withholds_from: VecDeque<u64>,
    is_withholding: bool,
}

impl LinkSide {
    /// Build the sides of a master and a slave; `scene` is any scene with this connection.
    pub(super) fn both<const N: usize>(
        connection: &Connection,
        scene: &SceneSpec<N>,
    ) -> Result<[Self; 2], SceneError> {
        let mut master = master_endpoint(scene, SESSIONS.0, None)?.exchange;
        if connection.has_buttons {
            master.carry_buttons();
        }
        let operator = ClutchOperator::new(connection.clutch.clone())?;
        let slave = slave_endpoint(scene, SESSIONS.1)?.exchange;
        Ok([Self::new(master, Some(operator)), Self::new(slave, None)])
    }

    fn new(mut exchange: Exchange, operator: Option<ClutchOperator>) -> Self {
        exchange.leave_out_flight();
        exchange.leave_out_path_reports();
        let first = exchange.link().next_sequence();
        Self { exchange, operator, first, ticks: 0, withholds_from: VecDeque::new(), is_withholding: false }
    }

    /// Return the number of ticks so far.
    pub(super) fn ticks(&self) -> u64 {
        self.ticks
    }

    /// Withhold the force of the safety layer from `tick` on, while the ladder leaves it a share. Ticks must rise.
    pub(super) fn withhold_from(&mut self, tick: u64) {
        self.withholds_from.push_back(tick);
    }

    /// Return whether the safety layer withholds its force at this tick; `gain` is the share that the ladder leaves.
    fn withholds(&mut self, gain: f64) -> bool {
        self.is_withholding &= gain > 0.0;
        if self.withholds_from.front() == Some(&self.ticks) {
            self.withholds_from.pop_front();
            self.is_withholding = true;
        }
        self.is_withholding
    }
}

impl Side for LinkSide {
    type Record = Step;

    fn begin(&mut self, now_ns: u64) {
        if let Some(operator) = &mut self.operator {
            operator.begin(now_ns);
        }
    }

    /// Step link and ladder as [`MasterSide`](crate::MasterSide) and [`SlaveSide`](crate::SlaveSide) do with models.
    fn tick_into(&mut self, time: TickTime, step: &mut Step) {
        let (has_stalled, peer_began) = (self.exchange.has_stalled(), self.exchange.has_peer_begun());
        let ladder = self.exchange.ladder();
        let (state, is_ready) = (ladder.state(), ladder.is_ready());
        let clutch = self.operator.as_mut().is_some_and(|operator| operator.at(time.now_ns, state, is_ready));
        self.exchange.advance(time.clock_ns, clutch);
        let gain = self.exchange.ladder().gain();
        let withholds = self.withholds(gain);
        if withholds {
            // The reason does not affect an outcome.
            self.exchange.withhold(time.clock_ns, false);
        }
        let zeros = Axes::<1>::zeros();
        self.exchange.end_tick(time.clock_ns, [&zeros; 3], || [Observed::NOTHING; LAYERS.len()]);
        self.ticks += 1;
        let (ladder, newest) = (self.exchange.ladder(), self.exchange.link().newest());
        *step = Step {
            now_ns: time.now_ns,
            clock_ns: time.clock_ns,
            // Each tick sends one frame.
            newest: newest.map_or(Step::NONE, |frame| frame.sequence - self.first),
            missed: time.missed,
            gain,
            withholds,
            stale_ns: ladder.stale_ns(),
            state: ladder.state(),
            reason: ladder.history().last().map_or(0, |last| last.reason.code()),
            has_stalled,
            peer_began,
        };
    }

    fn command(&mut self, _: u64, _: OperatorCommand) -> Result<bool, CouplingError> {
        Ok(false)
    }

    fn rest(&mut self) {}

    fn exchange(&self) -> &Exchange {
        &self.exchange
    }

    fn exchange_mut(&mut self) -> &mut Exchange {
        &mut self.exchange
    }
}
