//! What link and ladders do in a run, tick by tick: the same whatever hand and arm do, as long as neither has a fault.

use std::{
    ops::ControlFlow,
    sync::atomic::{AtomicBool, Ordering},
};

use haptether_safety::{Axes, controller::Controllers};

use super::super::{
    assemble::{SceneError, clutch},
    bilateral::{self, SESSIONS},
    sides::{master_endpoint, slave_endpoint},
    spec::SceneSpec,
};
use crate::{
    Event, Exchange, LadderSettings, LadderState, MasterPlant, MasterSide, OperatorCommand, Side, SideKind,
    SlavePlant, SlaveSide, TickTime, VirtualSettings,
    coupling::CouplingError,
    ladder::Clutch,
    virtual_time::{InTurn, Snapshot},
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
        Ok(Self {
            settings: bilateral::settings(scene)?,
            ladder: scene.safety.ladder.unwrap_or_default(),
            clutch: clutch(scene),
            kind: scene.master.kind,
            has_buttons: scene.master.buttons.is_some(),
        })
    }
}

/// What a tick of one side has of link and ladder.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Step {
    /// True time in ns.
    pub(super) now_ns: u64,
    /// On the clock of the side, in ns.
    pub(super) clock_ns: u64,
    /// Which tick of the peer the newest frame is of; [`NONE`](Self::NONE) before the first.
    newest: u32,
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
    const NONE: u32 = u32::MAX;

    /// Which tick of the peer the newest frame is of.
    pub(super) fn newest(&self) -> Option<usize> {
        (self.newest != Self::NONE).then_some(self.newest as usize)
    }
}

/// Most ticks of both sides that are kept: some 120 MB.
const MAX_STEPS: u64 = 1 << 21;

/// Most snapshots that are kept of a run, and least ticks of the master between two.
const MAX_SNAPSHOTS: u64 = 16;
const MIN_BETWEEN_SNAPSHOTS: u64 = 500;

type Master<const N: usize> = Observed<MasterSide<Still, N>, N>;
type Slave<const N: usize> = Observed<SlaveSide<Still, N>, N>;

/// The ticks of both sides, from one of each on.
pub(super) struct Timeline<'a, const N: usize> {
    connection: &'a Connection,
    /// Of the master and the slave, in the order of their times.
    steps: [Vec<Step>; 2],
    /// Which tick of each is the first.
    first: [usize; 2],
    /// The run before the ticks of the master and the slave of these numbers.
    snapshots: Vec<([usize; 2], Snapshot<Master<N>, Slave<N>, N>)>,
}

impl<'a, const N: usize> Timeline<'a, N> {
    /// Of the run of a connection; none of one whose frames are changed on their way, or that is too long to be kept.
    /// `scene` is any with that connection.
    pub(super) fn new(
        connection: &'a Connection,
        scene: &SceneSpec<N>,
        stop: &AtomicBool,
    ) -> Result<Option<Self>, SceneError> {
        let settings = &connection.settings;
        let slave_ticks = (settings.ticks * settings.period_ns).div_ceil(settings.slave_period_ns);
        if settings.ticks + slave_ticks > MAX_STEPS {
            return Ok(None);
        }
        let mut scene = scene.clone();
        // Nobody feels anything.
        scene.safety.settings.controllers = Controllers::NONE;
        let master = MasterSide::new(Still, master_endpoint(&scene, SESSIONS.0, None)?, clutch(&scene))?
            .with_buttons(scene.master.buttons)?;
        let mut master = Observed::new(master);
        let mut slave = Observed::new(SlaveSide::new(Still, slave_endpoint(&scene, SESSIONS.1)?));
        for exchange in [master.exchange_mut(), slave.exchange_mut()] {
            exchange.leave_out_flight();
            exchange.leave_out_path_reports();
        }
        let run = InTurn::new(settings, &mut master, &mut slave)?;
        Self::followed(connection, run, [0, 0], stop)
    }

    /// Of a run that stands before the ticks `first`.
    fn followed(
        connection: &'a Connection,
        mut run: InTurn<'_, Master<N>, Slave<N>, N>,
        first: [usize; 2],
        stop: &AtomicBool,
    ) -> Result<Option<Self>, SceneError> {
        let mut steps = [Vec::new(), Vec::new()];
        let mut snapshots = Vec::new();
        let between = (connection.settings.ticks / MAX_SNAPSHOTS).max(MIN_BETWEEN_SNAPSHOTS);
        let mut since = between;
        loop {
            if stop.load(Ordering::Relaxed) {
                return Err(SceneError::Stopped);
            }
            if since >= between {
                let Some(snapshot) = run.snapshot() else { return Ok(None) };
                snapshots.push(([first[0] + steps[0].len(), first[1] + steps[1].len()], snapshot));
                since = 0;
            }
            let flow = run.step(&mut |event, _| {
                match event {
                    Event::Master(step) => {
                        steps[0].push(*step);
                        since += 1;
                    }
                    Event::Slave(step) => steps[1].push(*step),
                }
                ControlFlow::Continue(())
            });
            if flow.is_break() {
                return Ok(Some(Self { connection, steps, first, snapshots }));
            }
        }
    }

    /// The same run with a master whose safety layer withholds its force from its tick `tick` on, as long as the ladder leaves
    /// it a share.
    pub(super) fn withheld(&self, tick: usize, stop: &AtomicBool) -> Result<Option<Self>, SceneError> {
        let Some((first, snapshot)) = self.snapshots.iter().rfind(|(first, _)| first[0] <= tick) else {
            return Ok(None);
        };
        let (mut master, mut slave) = (snapshot.master.clone(), snapshot.slave.clone());
        master.withholds_from = Some(tick);
        let run = InTurn::resume(&self.connection.settings, snapshot, &mut master, &mut slave)?;
        Self::followed(self.connection, run, *first, stop)
    }

    /// Ticks of the master and the slave from these numbers on.
    pub(super) fn from(&self, ticks: [usize; 2]) -> [&[Step]; 2] {
        [0, 1].map(|side| self.steps[side].get(ticks[side] - self.first[side]..).unwrap_or_default())
    }

    /// How many of the newest ticks of each may still be the newest that the other has heard of.
    pub(super) fn depths(&self) -> [usize; 2] {
        let (mut done, mut depths) = (self.first, [1, 1]);
        let [mut near, mut far] = self.steps.each_ref().map(|steps| steps.as_slice());
        while let Some(is_near) = is_near_next(near.first(), far.first()) {
            let (steps, own, peer) = if is_near { (&mut near, 0, 1) } else { (&mut far, 1, 0) };
            if let Some(newest) = steps.split_off_first().and_then(Step::newest) {
                depths[peer] = depths[peer].max(done[peer] - newest);
            }
            done[own] += 1;
        }
        depths
    }
}

/// Whether the next tick in time is one of the master, of the next of both; at the same instant the master is first. None
/// where neither has one.
#[inline(always)] // once a tick
pub(super) fn is_near_next(near: Option<&Step>, far: Option<&Step>) -> Option<bool> {
    match (near, far) {
        (Some(near), Some(far)) => Some(near.now_ns <= far.now_ns),
        (Some(_), None) => Some(true),
        (None, Some(_)) => Some(false),
        (None, None) => None,
    }
}

/// A side whose record of a tick is what it had of link and ladder.
#[derive(Clone)]
struct Observed<S: Side<N>, const N: usize> {
    side: S,
    record: S::Record,
    /// Sequence of its first frame and of the peer's.
    first: u64,
    ticks: usize,
    /// From which tick on a safety layer withholds its force, none at all, as long as the ladder leaves it a share.
    withholds_from: Option<usize>,
}

impl<S: Side<N>, const N: usize> Observed<S, N> {
    fn new(side: S) -> Self {
        let first = side.exchange().link().next_sequence();
        Self { side, record: S::Record::default(), first, ticks: 0, withholds_from: None }
    }
}

impl<S: Side<N>, const N: usize> Observed<S, N> {
    /// Whether the safety layer withholds its force at this tick, of which the ladder leaves it `gain`.
    fn withholds(&mut self, gain: f64) -> bool {
        let Some(from) = self.withholds_from else { return false };
        if self.ticks > from && gain <= 0.0 {
            self.withholds_from = None;
        }
        self.withholds_from.is_some() && self.ticks >= from
    }
}

impl<S: Side<N>, const N: usize> Side<N> for Observed<S, N> {
    type Record = Step;

    fn begin(&mut self, now_ns: u64) {
        self.side.begin(now_ns);
    }

    fn tick_into(&mut self, time: TickTime, step: &mut Step) {
        let exchange = self.side.exchange();
        let (has_stalled, peer_began) = (exchange.has_stalled(), exchange.has_peer_begun());
        self.side.tick_into(time, &mut self.record);
        let gain = self.side.exchange().ladder().gain();
        let withholds = self.withholds(gain);
        if withholds {
            self.side.exchange_mut().withhold(time.clock_ns);
        }
        self.ticks += 1;
        let exchange = self.side.exchange();
        let (ladder, newest) = (exchange.ladder(), exchange.link().newest());
        // Each tick sends one frame, and there are fewer than `MAX_STEPS`.
        let newest = newest.and_then(|frame| u32::try_from(frame.sequence - self.first).ok());
        *step = Step {
            now_ns: time.now_ns,
            clock_ns: time.clock_ns,
            newest: newest.unwrap_or(Step::NONE),
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

    fn command(&mut self, now_ns: u64, command: OperatorCommand) -> Result<bool, CouplingError> {
        self.side.command(now_ns, command)
    }

    fn rest(&mut self) {
        self.side.rest();
    }

    fn exchange(&self) -> &Exchange<N> {
        self.side.exchange()
    }

    fn exchange_mut(&mut self) -> &mut Exchange<N> {
        self.side.exchange_mut()
    }
}

/// A device, or an arm, that stands still at the origin.
#[derive(Clone, Copy, Debug)]
struct Still;

impl<const N: usize> MasterPlant<N> for Still {
    fn read(&mut self, _: u64) -> (Axes<N>, Option<Axes<N>>) {
        (Axes::zeros(), Some(Axes::zeros()))
    }

    fn write(&mut self, _: &Axes<N>) {}
}

impl<const N: usize> SlavePlant<N> for Still {
    fn read(&mut self, _: u64) -> [Axes<N>; 3] {
        [Axes::zeros(); 3]
    }

    fn write(&mut self, _: &Axes<N>, _: &Axes<N>) {}

    fn stop(&mut self) -> Axes<N> {
        Axes::zeros()
    }

    fn touches(&self) -> bool {
        false
    }
}
