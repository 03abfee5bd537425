//! Runs of one connection side by side, in lanes, as long as each takes the way that nearly all take: whoever meets a fault,
//! withholds its force or diverges leaves, and is run by itself.

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
    coupling::PositionForce,
    endpoint::{HandLanes, SlaveTranslation, TranslationInput},
    scene::{
        measures::Outcome,
        shared::connection::Step,
        timed::Commands,
        watched::{NearTick, WatchedLanes},
    },
    side::{LeadTransition, is_stopped},
};

/// Both sides of some runs without link and ladders, which do what these say.
pub(super) struct LaneFollowers<const N: usize> {
    /// The run of each lane.
    rows: Vec<usize>,
    /// A bit for each lane that is still run, and for each that has left.
    running: u64,
    left: u64,
    near: Near<N>,
    far: Far<N>,
    watched: WatchedLanes<N, Lanes>,
    /// Of lanes that have settled.
    settled: Vec<Option<Outcome>>,
}

/// The sides of the hands.
struct Near<const N: usize> {
    plants: MasterLanes<N, Lanes>,
    hands: HandLanes<N, Lanes>,
    coupling: PositionForce<N, Lanes>,
    commands: Commands,
    sent: History<N, Lanes>,
    /// The newest tick of the slave that they have heard of.
    heard: u64,
}

/// The sides of the robots.
struct Far<const N: usize> {
    plants: SlaveLanes<N, Lanes>,
    translation: SlaveTranslation<N, Lanes>,
    led: LeadTransition,
    commands: Commands,
    sent: History<N, Lanes>,
    /// The newest tick of the master that they have heard of.
    heard: u64,
}

/// What decides over hands and arms, and measures.
struct Deciding<const N: usize> {
    hands: HandLanes<N, Lanes>,
    coupling: PositionForce<N, Lanes>,
    translation: SlaveTranslation<N, Lanes>,
    watched: WatchedLanes<N, Lanes>,
}

impl<const N: usize> Deciding<N> {
    /// Of some followers before their first tick; None where it differs in more than numbers.
    fn gather(of: &[&Follower<N>]) -> Option<Self> {
        let hands: Vec<_> = of.iter().map(|one| &one.near.hand).collect();
        let couplings: Vec<_> = of.iter().map(|one| &one.near.coupling).collect();
        let arms: Vec<_> = of.iter().map(|one| &one.far.arm).collect();
        let watched: Vec<_> = of.iter().map(|one| &one.watched).collect();
        Some(Self {
            hands: HandLanes::gather(&hands)?,
            coupling: PositionForce::gather(&couplings)?,
            translation: SlaveTranslation::gather(&arms)?,
            watched: WatchedLanes::gather(&watched)?,
        })
    }
}

impl<const N: usize> LaneFollowers<N> {
    /// Those of some followers before their first tick, at most as many as there are lanes; None where they differ in more than
    /// numbers.
    pub(super) fn gather(of: &[&Follower<N>]) -> Option<Self> {
        let count = of.len();
        if count > WIDTH {
            return None;
        }
        let Deciding { hands, coupling, translation, watched } = Deciding::gather(of)?;
        let commands = of.first()?.near.commands.clone();
        Some(Self {
            rows: of.iter().map(|one| one.row).collect(),
            running: (1 << count) - 1,
            left: 0,
            near: Near {
                plants: MasterLanes::new(of.iter().map(|one| one.near.plant.clone()).collect())?,
                hands,
                coupling,
                commands: commands.clone(),
                sent: History::new(),
                heard: 0,
            },
            far: Far {
                plants: SlaveLanes::new(of.iter().map(|one| one.far.plant.clone()).collect())?,
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

    /// Whether two followers are decided over alike: all that it takes.
    pub(super) fn fit(one: &Follower<N>, other: &Follower<N>) -> bool {
        Deciding::<N>::gather(&[one, other]).is_some()
    }

    /// Whether any lane is still run.
    pub(super) fn is_running(&self) -> bool {
        self.running != 0
    }

    /// What each run has come to, none of one that has left.
    pub(super) fn outcomes(self) -> impl Iterator<Item = (usize, Option<Outcome>)> {
        let Self { rows, watched, left, settled, .. } = self;
        rows.into_iter().zip(settled).enumerate().map(move |(lane, (row, settled))| {
            let has_left = left >> lane & 1 == 1;
            (row, (!has_left).then(|| settled.unwrap_or_else(|| watched.outcome(lane, false))))
        })
    }

    /// Take some ticks, in the instructions of the function that it is compiled into.
    #[inline(always)]
    pub(super) fn take(&mut self, ticks: &[Tick]) {
        for tick in ticks {
            if self.running == 0 {
                return;
            }
            match tick {
                Tick::Near(step) => self.near(step),
                Tick::Far(step) => self.far(step),
            }
        }
    }

    /// Those of these lanes that are still run leave.
    #[inline(always)]
    fn leave(&mut self, lanes: u64) {
        self.left |= self.running & lanes;
        self.running &= !lanes;
    }

    /// A tick of the master, as [`super::Near`] does it.
    #[inline(always)]
    fn near(&mut self, step: &Step) {
        if step.missed != 0 || step.has_stalled || step.withholds {
            return self.leave(u64::MAX);
        }
        let running = self.running;
        let Near { plants, hands, coupling, commands, sent, heard } = &mut self.near;
        while let Some(command) = commands.due(step.now_ns) {
            // They were checked when the scene was built, and are all of its beginning.
            let _ = coupling.command_at_master(command, 0);
        }
        let MasterLanesSample { position, velocity } = plants.read(running, step.now_ns);
        let requested = match step.newest() {
            Some(tick) => coupling.rendered_force(&self.far.sent.of(tick).force),
            None => Axes::zeros(),
        };
        *heard = step.newest().unwrap_or(0);
        let (decided, mut stays) = hands.tick(&position, velocity.as_ref(), &requested, step.gain);
        stays = stays & !decided.response.withheld;
        let (velocity, force) = (decided.motion.velocity, decided.device_force);
        stays = stays & sent.push(Sent { position, velocity, force }, Signal::RenderedForce, self.far.heard);
        let truth = Truth {
            position: *plants.position(),
            velocity: *plants.velocity(),
            hand_force: *plants.hand_force(),
        };
        plants.write(running, &force);
        if step.state.is_coupled() {
            plants.set_waiting(false);
        }
        let tick = NearTick { now_ns: step.now_ns, state: step.state, truth: &truth, decided: &decided };
        let [still, settled] = self.watched.near(&tick);
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

    /// A tick of the slave, as [`super::Far`] does it.
    #[inline(always)]
    fn far(&mut self, step: &Step) {
        let running = self.running;
        let Far { plants, translation, led, commands, sent, heard } = &mut self.far;
        while let Some(command) = commands.due(step.now_ns) {
            // As of the master.
            let _ = translation.coupling().command_at_slave(command, 0);
        }
        let SlaveLanesSample { position, velocity, environment_force: force } =
            *plants.read(running, step.now_ns);
        if step.peer_began {
            translation.disengage();
        }
        let mut stays = translation.passes(step.clock_ns, [&position, &velocity, &force]);
        let newest = step.newest().map(|tick| self.near.sent.of(tick));
        *heard = step.newest().unwrap_or(0);
        let newest = newest.map(|Sent { position, velocity, .. }| [position, velocity]);
        let input = TranslationInput { state: step.state, stale_ns: step.stale_ns, newest };
        let command_velocity = match translation.follow(step.clock_ns, &position, &input) {
            Some(led) => led.velocity,
            None => Axes::zeros(),
        };
        if led.step(step.state, step.state.is_coupled()).is_some() {
            // Of a model a stop is a hold.
            let rests = plants.stop(running);
            stays = stays & is_within(&rests, Signal::Position.bound());
            translation.rests(Some(rests));
        }
        if let Some(command) = translation.last_command().filter(|_| !is_stopped(step.state)) {
            plants.write(running, &command, &command_velocity);
        }
        if step.state.is_coupled() {
            plants.start(step.now_ns);
        }
        stays =
            stays & sent.push(Sent { position, velocity, force }, Signal::EnvironmentForce, self.near.heard);
        stays = stays & self.watched.far(step.now_ns, step.state, [&position, &force]);
        if !stays.all() {
            self.leave(!stays.bitmask());
        }
    }
}
