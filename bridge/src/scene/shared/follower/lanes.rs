//! Runs of one connection in lanes. A run that has a fault, withholds its force or diverges leaves its lane and runs
//! by itself.

use haptether_master::{MasterLanes, MasterLanesSample};
use haptether_numeric::{Lanes, WIDTH, lanes_of};
use haptether_safety::{Axes, Signal, is_within};
use haptether_slave::{SlaveLanes, SlaveLanesSample};
use nalgebra::SimdBool as _;

use super::{
    Follower, Tick,
    history::{History, Sent},
};
use crate::{
    Truth,
    coupling::Mapping,
    endpoint::{HandLanes, SlaveTranslation, TranslationInput},
    scene::{
        measures::Outcome,
        shared::connection::Step,
        timed::Commands,
        watched::{MasterLaneTick, WatchedLanes},
    },
    side::{LeadTransition, is_stopped},
};

/// Both sides of runs in lanes, which follow shared link and ladders.
pub(super) struct LaneFollowers<const N: usize> {
    /// Row of each lane.
    rows: Vec<usize>,
    /// Bit masks of running lanes, and of lanes whose run has left.
    running: u64,
    left: u64,
    master: MasterPart<N>,
    slave: SlavePart<N>,
    watched: WatchedLanes<N, Lanes>,
    /// Outcomes of settled lanes.
    settled: Vec<Option<Outcome>>,
}

/// Sides of the hands.
struct MasterPart<const N: usize> {
    plants: MasterLanes<N, Lanes>,
    hands: HandLanes<N, Lanes>,
    coupling: Mapping<N, Lanes>,
    commands: Commands,
    sent: History<N, Lanes>,
    /// Newest received tick of the slave.
    heard: u64,
}

/// Sides of the robots.
struct SlavePart<const N: usize> {
    plants: SlaveLanes<N, Lanes>,
    translation: SlaveTranslation<N, Lanes>,
    led: LeadTransition,
    commands: Commands,
    sent: History<N, Lanes>,
    /// Newest received tick of the master.
    heard: u64,
}

/// Safety layers, couplings and measures.
struct Deciding<const N: usize> {
    hands: HandLanes<N, Lanes>,
    coupling: Mapping<N, Lanes>,
    translation: SlaveTranslation<N, Lanes>,
    watched: WatchedLanes<N, Lanes>,
}

impl<const N: usize> Deciding<N> {
    /// Gather followers before their first tick; None if they differ in more than numbers.
    fn gather(of: &[&Follower<N>]) -> Option<Self> {
        let hands: Vec<_> = of.iter().map(|one| &one.master.hand).collect();
        let couplings: Vec<_> = of.iter().map(|one| &one.master.coupling).collect();
        let arms: Vec<_> = of.iter().map(|one| &one.slave.arm).collect();
        let watched: Vec<_> = of.iter().map(|one| &one.watched).collect();
        Some(Self {
            hands: HandLanes::gather(&hands)?,
            coupling: Mapping::gather(&couplings)?,
            translation: SlaveTranslation::gather(&arms)?,
            watched: WatchedLanes::gather(&watched)?,
        })
    }
}

impl<const N: usize> LaneFollowers<N> {
    /// Gather followers before their first tick. None if there are more followers than lanes, or if they differ in
    /// more than numbers.
    pub(super) fn gather(of: &[&Follower<N>]) -> Option<Self> {
        let count = of.len();
        if count > WIDTH {
            return None;
        }
        let Deciding { hands, coupling, translation, watched } = Deciding::gather(of)?;
        let commands = of.first()?.master.commands.clone();
        Some(Self {
            rows: of.iter().map(|one| one.row).collect(),
            running: (1 << count) - 1,
            left: 0,
            master: MasterPart {
                plants: MasterLanes::new(of.iter().map(|one| one.master.plant.clone()).collect())?,
                hands,
                coupling,
                commands: commands.clone(),
                sent: History::new(),
                heard: 0,
            },
            slave: SlavePart {
                plants: SlaveLanes::new(of.iter().map(|one| one.slave.plant.clone()).collect())?,
                translation,
                led: LeadTransition::default(),
                commands,
                sent: History::new(),
                heard: 0,
            },
            watched,
            settled: vec![None; count],
        })
    }

    /// Return whether two followers fit into lanes: they differ only in numbers.
    pub(super) fn fit(one: &Follower<N>, other: &Follower<N>) -> bool {
        Deciding::<N>::gather(&[one, other]).is_some()
    }

    /// Return whether any lane runs.
    pub(super) fn is_running(&self) -> bool {
        self.running != 0
    }

    /// Return the outcome of each run; None for a run that has left.
    pub(super) fn outcomes(self) -> impl Iterator<Item = (usize, Option<Outcome>)> {
        let Self { rows, watched, left, settled, .. } = self;
        rows.into_iter().zip(settled).enumerate().map(move |(lane, (row, settled))| {
            let has_left = left >> lane & 1 == 1;
            (row, (!has_left).then(|| settled.unwrap_or_else(|| watched.outcome(lane, false))))
        })
    }

    /// Take a block of ticks, inlined into the vector instructions of the caller.
    #[inline(always)]
    pub(super) fn take(&mut self, ticks: &[Tick]) {
        for tick in ticks {
            if self.running == 0 {
                return;
            }
            match tick {
                Tick::Master(step) => self.tick_master(step),
                Tick::Slave(step) => self.tick_slave(step),
            }
        }
    }

    /// Let the running ones of these lanes leave.
    #[inline(always)]
    fn leave(&mut self, lanes: u64) {
        self.left |= self.running & lanes;
        self.running &= !lanes;
    }

    /// Step a tick of the master as [`super::MasterPart`] does.
    #[inline(always)]
    fn tick_master(&mut self, step: &Step) {
        if step.missed != 0 || step.has_stalled || step.withholds {
            return self.leave(u64::MAX);
        }
        let running = self.running;
        let MasterPart { plants, hands, coupling, commands, sent, heard } = &mut self.master;
        while let Some(command) = commands.due(step.now_ns) {
            // The commands were checked when the scene was built, and apply at its start.
            let _ = coupling.command_at_master(command, 0);
        }
        let MasterLanesSample { position, velocity } = plants.read(running, step.now_ns);
        let requested = match step.newest() {
            Some(tick) => coupling.rendered_force(&self.slave.sent.of(tick).force),
            None => Axes::zeros(),
        };
        *heard = step.newest().unwrap_or(0);
        let (decided, mut stays) = hands.tick(&position, velocity.as_ref(), &requested, step.gain);
        stays = stays & !decided.response.withheld;
        let (velocity, force) = (decided.motion.velocity, decided.device_force);
        stays =
            stays & sent.push(Sent { position, velocity, force }, Signal::RenderedForce, self.slave.heard);
        let truth = Truth {
            position: *plants.position(),
            velocity: *plants.velocity(),
            hand_force: *plants.hand_force(),
        };
        plants.write(running, &force);
        if step.state.is_coupled() {
            plants.set_waiting(false);
        }
        let tick =
            MasterLaneTick { now_ns: step.now_ns, state: step.state, truth: &truth, decided: &decided };
        let [still, settled] = self.watched.take_master(&tick);
        stays = stays & still;
        if !stays.all() {
            self.leave(!stays.bitmask());
        }
        if settled.any() {
            for lane in lanes_of(self.running & settled.bitmask(), self.rows.len()) {
                self.settled[lane] = Some(self.watched.outcome(lane, true));
                self.running &= !(1 << lane);
            }
        }
    }

    /// Step a tick of the slave as [`super::SlavePart`] does.
    #[inline(always)]
    fn tick_slave(&mut self, step: &Step) {
        let running = self.running;
        let SlavePart { plants, translation, led, commands, sent, heard } = &mut self.slave;
        while let Some(command) = commands.due(step.now_ns) {
            // Checked like those of the master.
            let _ = translation.coupling().command_at_slave(command, 0);
        }
        let SlaveLanesSample { position, velocity, environment_force: force } =
            *plants.read(running, step.now_ns);
        if step.peer_began {
            translation.disengage();
        }
        let mut stays = translation.passes(step.clock_ns, [&position, &velocity, &force]);
        let newest = step.newest().map(|tick| self.master.sent.of(tick));
        *heard = step.newest().unwrap_or(0);
        let newest = newest.map(|Sent { position, velocity, .. }| [position, velocity]);
        let input = TranslationInput { state: step.state, stale_ns: step.stale_ns, newest };
        let command_velocity = match translation.follow(step.clock_ns, &position, &input) {
            Some(led) => led.velocity,
            None => Axes::zeros(),
        };
        if led.step(step.state, step.state.is_coupled()).is_some() {
            // The stop of a model is a hold.
            let rests = plants.stop(running);
            stays = stays & is_within(&rests, Signal::Position.bound());
            translation.set_rest(Some(rests));
        }
        if let Some(command) = translation.last_command().filter(|_| !is_stopped(step.state)) {
            plants.write(running, &command, &command_velocity);
        }
        if step.state.is_coupled() {
            plants.start(step.now_ns);
        }
        stays = stays
            & sent.push(Sent { position, velocity, force }, Signal::EnvironmentForce, self.master.heard);
        stays = stays & self.watched.take_slave(step.now_ns, step.state, [&position, &force]);
        if !stays.all() {
            self.leave(!stays.bitmask());
        }
    }
}
