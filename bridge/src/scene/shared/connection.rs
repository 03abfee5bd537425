//! What link and ladders do in a run: the same whatever hand and arm do, as long as no force is withheld and no number is
//! refused.

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

/// All that decides what link and ladders do.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Connection {
    pub(super) settings: VirtualSettings,
    ladder: LadderSettings,
    clutch: Clutch,
    kind: SideKind,
    has_buttons: bool,
}

impl Connection {
    /// Of a scene that can share.
    pub(super) fn of<const N: usize>(scene: &SceneSpec<N>) -> Result<Self, SceneError> {
        bilateral::check(scene)?;
        // What a side with buttons would refuse.
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

/// What a tick of one side has of link and ladders.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Step {
    /// True time in ns.
    pub(super) now_ns: u64,
    /// On the clock of the side, in ns.
    pub(super) clock_ns: u64,
    /// Which tick of the peer the newest frame is of; [`NONE`](Self::NONE) before the first.
    newest: u64,
    /// Ticks that were left out since the last.
    pub(super) missed: u64,
    /// The ladder's share of what is requested.
    pub(super) gain: f64,
    /// Whether the safety layer withholds its force.
    pub(super) withholds: bool,
    /// For how long in ns the ladder has stood in STALE.
    pub(super) stale_ns: u64,
    pub(super) state: LadderState,
    /// Why it stands there, by its code.
    pub(super) reason: u8,
    /// Whether the loop had stalled.
    pub(super) has_stalled: bool,
    /// Whether a run of the peer began.
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

    /// Which tick of the peer the newest frame is of.
    pub(super) fn newest(&self) -> Option<u64> {
        (self.newest != Self::NONE).then_some(self.newest)
    }
}

/// A side without hand or arm: its link, its ladder, and who works the clutch of a master.
#[derive(Clone)]
pub(super) struct LinkSide {
    exchange: Exchange,
    /// None of a slave.
    operator: Option<ClutchOperator>,
    /// Sequence of its first frame and of the peer's.
    first: u64,
    ticks: u64,
    /// At which ticks to come a safety layer begins to withhold its force, and whether it does; it does as long as the ladder
    /// leaves it a share.
    withholds_from: VecDeque<u64>,
    is_withholding: bool,
}

impl LinkSide {
    /// Those of a master and a slave; `scene` is any with that connection.
    pub(super) fn both<const N: usize>(
        connection: &Connection,
        scene: &SceneSpec<N>,
    ) -> Result<[Self; 2], SceneError> {
        let mut near = master_endpoint(scene, SESSIONS.0, None)?.exchange;
        if connection.has_buttons {
            near.carry_buttons();
        }
        let operator = ClutchOperator::new(connection.clutch.clone())?;
        let far = slave_endpoint(scene, SESSIONS.1)?.exchange;
        Ok([Self::new(near, Some(operator)), Self::new(far, None)])
    }

    fn new(mut exchange: Exchange, operator: Option<ClutchOperator>) -> Self {
        exchange.leave_out_flight();
        exchange.leave_out_path_reports();
        let first = exchange.link().next_sequence();
        Self { exchange, operator, first, ticks: 0, withholds_from: VecDeque::new(), is_withholding: false }
    }

    /// How many ticks it has done.
    pub(super) fn ticks(&self) -> u64 {
        self.ticks
    }

    /// A safety layer withholds its force from its tick `tick` on, the latest so far, as long as the ladder leaves it a share.
    pub(super) fn withhold_from(&mut self, tick: u64) {
        self.withholds_from.push_back(tick);
    }

    /// Whether the safety layer withholds its force at this tick, of which the ladder leaves it `gain`.
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

    /// As [`MasterSide`](crate::MasterSide) and [`SlaveSide`](crate::SlaveSide), whose plants are models.
    fn tick_into(&mut self, time: TickTime, step: &mut Step) {
        let (has_stalled, peer_began) = (self.exchange.has_stalled(), self.exchange.has_peer_begun());
        let ladder = self.exchange.ladder();
        let (state, is_ready) = (ladder.state(), ladder.is_ready());
        let clutch = self.operator.as_mut().is_some_and(|operator| operator.at(time.now_ns, state, is_ready));
        self.exchange.advance(time.clock_ns, clutch);
        let gain = self.exchange.ladder().gain();
        let withholds = self.withholds(gain);
        if withholds {
            // Why makes no difference to what a row comes to.
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
