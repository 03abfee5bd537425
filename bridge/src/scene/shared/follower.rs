//! Runs whose link and ladders do the same: that is found once, and each run is hand, device and arm alone.

use std::{
    collections::VecDeque,
    ops::ControlFlow,
    rc::Rc,
    sync::atomic::{AtomicBool, Ordering},
};

use haptether_safety::{Axes, Fault, SafetyTick, Signal};
use haptether_slave::{SimulatedSlave, SlaveSample};

use super::{
    Outcomes,
    connection::{Connection, LinkSide, Step},
};
use crate::{
    Event, MasterRecord, ModelPlant, SlaveReading, SlaveRecord,
    coupling::PositionForce,
    endpoint::{Arm, ArmInput, Hand, HandInput, MasterReading, MasterState, Past},
    link::PortState,
    scene::{
        assemble::{SceneError, exact_master, stepped_master},
        bilateral::waiting,
        coupling::commands,
        sides::{arm_alone, coupled, hand_alone, simulated_arm},
        spec::{Integrator, SceneSpec},
        timed::Commands,
        watched::Watched,
    },
    side::{LeadTransition, is_stopped},
    virtual_time::{Ahead, Snapshot},
};

/// The outcomes of scenes of one connection, each as if it were run alone; none of one that is not run here.
///
/// # Errors
///
/// [`SceneError::Stopped`].
pub(super) fn outcomes<const N: usize>(
    connection: &Connection,
    scenes: &[&SceneSpec<N>],
    stop: &AtomicBool,
) -> Result<Outcomes, SceneError> {
    let mut outcomes = vec![None; scenes.len()];
    let (mut exact, mut stepped) = (Vec::new(), Vec::new());
    for (row, scene) in scenes.iter().enumerate() {
        // What cannot be built is refused, as alone.
        match scene.run.integrator {
            Integrator::Exact => {
                let plant = exact_master(scene).map(waiting);
                exact.extend(plant.and_then(|plant| Follower::new(connection, row, scene, plant)).ok());
            }
            Integrator::Stepped(stepping) => {
                let plant = stepped_master::<N>(scene, stepping).map(|mut plant| {
                    plant.set_waiting(true);
                    plant
                });
                stepped.extend(plant.and_then(|plant| Follower::new(connection, row, scene, plant)).ok());
            }
        }
    }
    follow(connection, scenes, exact, stop, &mut outcomes)?;
    follow(connection, scenes, stepped, stop, &mut outcomes)?;
    Ok(outcomes)
}

/// Least ticks of the master between two checkpoints: so few that little is done twice, so many that what is in flight is seldom
/// copied.
const TICKS_BETWEEN_CHECKPOINTS: usize = 1000;

/// Where link and ladders stand, and how many ticks of the master and the slave were observed by then.
type Checkpoint<const N: usize> = ([u64; 2], Rc<Snapshot<LinkSide<N>, LinkSide<N>, N>>);

/// A run whose link and ladders have gone another way since its master's tick `tick`.
struct Branch<P, const N: usize> {
    checkpoint: Checkpoint<N>,
    tick: u64,
    follower: Follower<P, N>,
}

/// Runs all to their ends; of one whose link and ladders would have done something else there is no outcome.
fn follow<P: ModelPlant<N>, const N: usize>(
    connection: &Connection,
    scenes: &[&SceneSpec<N>],
    followers: Vec<Follower<P, N>>,
    stop: &AtomicBool,
    outcomes: &mut Outcomes,
) -> Result<(), SceneError> {
    let Some(first) = followers.first() else { return Ok(()) };
    let settings = &connection.settings;
    // It was built from the same parts before.
    let Ok([mut master, mut slave]) = LinkSide::both(connection, scenes[first.row]) else { return Ok(()) };
    // A network that cannot be is refused by each row, and one that changes what it carries is not shared.
    let ahead = Ahead::new(settings, &mut master, &mut slave);
    let Some(ahead) = ahead.ok().filter(|ahead| ahead.snapshot().is_some()) else { return Ok(()) };
    let mut branches = Vec::new();
    follow_together(ahead, [0, 0], followers, stop, outcomes, &mut branches)?;
    while let Some(Branch { checkpoint: (first, snapshot), tick, follower }) = branches.pop() {
        let (mut master, mut slave) = (snapshot.master.clone(), snapshot.slave.clone());
        master.withhold_from(tick);
        let Ok(ahead) = Ahead::resume(settings, &snapshot, &mut master, &mut slave) else { continue };
        follow_together(ahead, first, vec![follower], stop, outcomes, &mut branches)?;
    }
    Ok(())
}

/// Lets all follow link and ladders from where these stand, after so many ticks of the master and the slave, until each has
/// ended or goes another way.
fn follow_together<P: ModelPlant<N>, const N: usize>(
    mut ahead: Ahead<'_, LinkSide<N>, LinkSide<N>, N>,
    mut first: [u64; 2],
    mut followers: Vec<Follower<P, N>>,
    stop: &AtomicBool,
    outcomes: &mut Outcomes,
    branches: &mut Vec<Branch<P, N>>,
) -> Result<(), SceneError> {
    let mut checkpoints = VecDeque::<Checkpoint<N>>::new();
    let mut block = Vec::new();
    let mut goes_on = true;
    while goes_on && !followers.is_empty() {
        if stop.load(Ordering::Relaxed) {
            return Err(SceneError::Stopped);
        }
        if checkpoints.back().is_none_or(|(at, _)| first[0] - at[0] >= TICKS_BETWEEN_CHECKPOINTS as u64)
            && followers.iter().any(|follower| follower.may_withhold)
            && let Some(snapshot) = ahead.snapshot()
        {
            checkpoints.push_back((first, Rc::new(snapshot)));
            // What is withheld is seen at the latest a block after the master has ticked.
            if checkpoints.len() > 2 {
                checkpoints.pop_front();
            }
        }
        block.clear();
        goes_on = ahead
            .advance(&mut |event, _| {
                block.push(match event {
                    Event::Master(step) => Tick::Near(*step),
                    Event::Slave(step) => Tick::Far(*step),
                });
                ControlFlow::Continue(())
            })
            .is_continue();
        let mut kept = Vec::with_capacity(followers.len());
        for mut follower in followers {
            match follower.take(first, &block) {
                Progress::GoesOn if goes_on => kept.push(follower),
                Progress::GoesOn | Progress::Ended => {
                    outcomes[follower.row] = Some(follower.watched.outcome());
                }
                Progress::Withholds(tick) => {
                    let before = checkpoints.iter().rfind(|(_, snapshot)| snapshot.master.ticks() <= tick);
                    #[cfg(test)]
                    tests::count_withheld();
                    if let Some(before) = before {
                        branches.push(Branch { checkpoint: before.clone(), tick, follower });
                    }
                }
                Progress::Departs => {}
            }
        }
        followers = kept;
        for tick in &block {
            first[usize::from(matches!(tick, Tick::Far(_)))] += 1;
        }
    }
    Ok(())
}

/// What a tick of either side has of link and ladders.
enum Tick {
    /// Of the master.
    Near(Step),
    /// Of the slave.
    Far(Step),
}

/// How a follower has come out of some ticks.
enum Progress {
    GoesOn,
    /// Its run ended before the last of them.
    Ended,
    /// At this tick of the master it begins to withhold its force, which link and ladders do not know.
    Withholds(u64),
    /// Link and ladders would do something else.
    Departs,
}

/// What a frame says of a tick.
#[derive(Clone, Copy, Debug)]
struct Sent<const N: usize> {
    position: Axes<N>,
    velocity: Axes<N>,
    force: Axes<N>,
}

impl<const N: usize> Sent<N> {
    fn nothing() -> Self {
        Self { position: Axes::zeros(), velocity: Axes::zeros(), force: Axes::zeros() }
    }
}

/// Most ticks of a side that are kept for a peer that hears nothing.
const MAX_HISTORY: usize = 8192;

/// The ticks of a side since the newest that its peer has heard of.
struct History<const N: usize> {
    sent: Vec<Sent<N>>,
    next: u64,
}

impl<const N: usize> History<N> {
    fn new() -> Self {
        Self { sent: vec![Sent::nothing(); 64], next: 0 }
    }

    /// Keeps that of the next tick; none of what the peer would refuse, or has not heard of for too long. `force` is the signal
    /// that its force is, `heard` the newest tick that the peer has heard of.
    #[inline(always)]
    fn push(&mut self, sent: Sent<N>, force: Signal, heard: u64) -> Option<()> {
        let Sent { position, velocity, force: newest } = &sent;
        for (signal, value) in [(Signal::Position, position), (Signal::Velocity, velocity), (force, newest)] {
            signal.check(value).ok()?;
        }
        if self.next - heard >= self.sent.len() as u64 {
            self.grow()?;
        }
        let slot = self.slot(self.next);
        self.sent[slot] = sent;
        self.next += 1;
        Some(())
    }

    /// Where that of a tick is kept: its last bits, for there is room for a power of two.
    #[inline(always)]
    #[allow(clippy::cast_possible_truncation)] // of bits that are masked
    fn slot(&self, tick: u64) -> usize {
        tick as usize & (self.sent.len() - 1)
    }

    /// Room for twice as many; none beyond [`MAX_HISTORY`].
    #[inline(never)]
    fn grow(&mut self) -> Option<()> {
        if self.sent.len() >= MAX_HISTORY {
            return None;
        }
        let kept = self.sent.len() as u64;
        let mut grown = Self { sent: vec![Sent::nothing(); 2 * self.sent.len()], next: self.next };
        for tick in self.next.saturating_sub(kept)..self.next {
            let slot = grown.slot(tick);
            grown.sent[slot] = *self.of(tick);
        }
        *self = grown;
        Some(())
    }

    #[inline(always)]
    fn of(&self, tick: u64) -> &Sent<N> {
        debug_assert!(
            tick < self.next && self.next - tick <= self.sent.len() as u64,
            "{tick} of {}",
            self.next
        );
        &self.sent[self.slot(tick)]
    }
}

/// Both sides of a run without link and ladders, which do what these say.
struct Follower<P, const N: usize> {
    row: usize,
    near: Near<P, N>,
    far: Far<N>,
    watched: Watched<N>,
    /// How many ticks of the master and the slave it has done.
    done: [u64; 2],
    /// What the master has decided at the next of them, where that waits for what link and ladders make of it.
    pending: Option<Box<Decided<N>>>,
    /// Whether its layer may withhold the force.
    may_withhold: bool,
}

/// The side of the hand.
struct Near<P, const N: usize> {
    plant: P,
    hand: Hand<N>,
    coupling: PositionForce<N>,
    commands: Commands,
    sent: History<N>,
    /// The newest tick of the slave that it has heard of.
    heard: u64,
}

/// The side of the robot.
struct Far<const N: usize> {
    plant: SimulatedSlave<N>,
    arm: Arm<N>,
    led: LeadTransition,
    commands: Commands,
    outgoing: PortState<N>,
    sent: History<N>,
    /// The newest tick of the master that it has heard of.
    heard: u64,
}

impl<P: ModelPlant<N>, const N: usize> Follower<P, N> {
    /// Both sides before their first tick.
    fn new(
        Connection { settings, .. }: &Connection,
        row: usize,
        scene: &SceneSpec<N>,
        mut plant: P,
    ) -> Result<Self, SceneError> {
        let list = commands::<N>(coupled(scene)?.1)?;
        let start = plant.state().position;
        let mut arm = simulated_arm(scene)?;
        let (hand, coupling) = hand_alone(scene)?;
        plant.begin(0);
        arm.begin(0);
        let near = Near {
            plant,
            hand,
            coupling,
            commands: Commands::new(list.clone()),
            sent: History::new(),
            heard: 0,
        };
        let far = Far {
            plant: arm,
            arm: arm_alone(scene)?,
            led: LeadTransition::default(),
            commands: Commands::new(list.clone()),
            outgoing: PortState::default(),
            sent: History::new(),
            heard: 0,
        };
        let watched = Watched::new(scene, settings, list, &start, false)?;
        let may_withhold = scene.safety.settings.release_tries > 0;
        Ok(Self { row, near, far, watched, done: [0, 0], pending: None, may_withhold })
    }

    /// Takes some ticks, of which the first are of these numbers; those that it has done it passes over.
    fn take(&mut self, first: [u64; 2], ticks: &[Tick]) -> Progress {
        let [mut near, mut far] = first;
        for tick in ticks {
            let flow = match tick {
                Tick::Near(step) => {
                    near += 1;
                    if near <= self.done[0] {
                        continue;
                    }
                    let waited = self.pending.take();
                    let has_waited = waited.is_some();
                    let decided =
                        waited.map_or_else(|| self.near.decide(step, &self.far.sent), |decided| *decided);
                    // Where link and ladders know it by now, or never will, that is seen as it acts.
                    if decided.safety.intervention.withheld && !step.withholds && !has_waited {
                        self.pending = Some(Box::new(decided));
                        return Progress::Withholds(self.done[0]);
                    }
                    self.done[0] = near;
                    self.near.act(step, &decided, self.far.heard, &mut self.watched)
                }
                Tick::Far(step) => {
                    far += 1;
                    if far <= self.done[1] {
                        continue;
                    }
                    self.done[1] = far;
                    self.far.tick(step, &self.near.sent, self.near.heard, &mut self.watched)
                }
            };
            match flow {
                Some(ControlFlow::Continue(())) => {}
                Some(ControlFlow::Break(())) => return Progress::Ended,
                None => return Progress::Departs,
            }
        }
        Progress::GoesOn
    }
}

/// What a tick of the master has decided.
struct Decided<const N: usize> {
    position: Axes<N>,
    safety: SafetyTick<N>,
}

impl<P: ModelPlant<N>, const N: usize> Near<P, N> {
    /// Reads the device and decides, as [`MasterSide`](crate::MasterSide) does.
    #[inline(always)]
    fn decide(&mut self, step: &Step, far: &History<N>) -> Decided<N> {
        while let Some(command) = self.commands.due(step.now_ns) {
            // They were checked when the scene was built.
            let _ = self.coupling.command_at_master(command);
        }
        let (position, velocity) = self.plant.read(step.now_ns);
        let received = step.newest().map(|tick| far.of(tick).force);
        self.heard = step.newest().unwrap_or(0);
        let input = HandInput {
            received_force: received.unwrap_or(Axes::zeros()),
            requested_force: received.map_or(Axes::zeros(), |force| self.coupling.rendered_force(&force)),
            gain: step.gain,
            missed: step.missed,
            past: if step.has_stalled { Past::Stalled } else { Past::Kept },
            ..HandInput::idle()
        };
        let (safety, _) = self.hand.tick(&MasterReading::point(position, velocity), &input);
        Decided { position, safety }
    }

    /// Writes the device and measures; none of what would change link and ladders in another way than `step` says.
    #[inline(always)]
    fn act(
        &mut self,
        step: &Step,
        decided: &Decided<N>,
        peer_heard: u64,
        watched: &mut Watched<N>,
    ) -> Option<ControlFlow<()>> {
        let Decided { position, safety } = decided;
        let force = safety.device_force;
        let fault = safety.fault.map_or(0, Fault::code);
        // A fault ends the run.
        if fault == 0 {
            if safety.intervention.withheld != step.withholds {
                return None;
            }
            let velocity = safety.motion.velocity;
            self.sent.push(
                Sent { position: *position, velocity, force },
                Signal::RenderedForce,
                peer_heard,
            )?;
        }
        let truth = self.plant.state();
        self.plant.write(&force);
        if step.state.is_coupled() {
            self.plant.engaged();
        }
        // What is measured of it, and nothing else.
        Some(watched.measure_near(&MasterRecord::<N> {
            time_ns: step.now_ns,
            true_position: truth.position,
            velocity: truth.velocity,
            hand_force: truth.hand_force,
            rendered_force: safety.rendered_force,
            device_force: force,
            tripped: safety.intervention.tripped.bits(),
            state: step.state,
            reason: step.reason,
            fault,
            ..MasterRecord::default()
        }))
    }
}

impl<const N: usize> Far<N> {
    /// A tick, as [`SlaveSide`](crate::SlaveSide) does it; none where it would change its ladder.
    #[inline(always)]
    fn tick(
        &mut self,
        step: &Step,
        near: &History<N>,
        peer_heard: u64,
        watched: &mut Watched<N>,
    ) -> Option<ControlFlow<()>> {
        while let Some(command) = self.commands.due(step.now_ns) {
            // As of the master.
            let _ = self.arm.command(command);
        }
        let SlaveSample { position, velocity, environment_force, .. } = self.plant.read(step.now_ns);
        let reading = SlaveReading::point([position, velocity, environment_force]);
        if step.peer_began {
            self.arm.disengage();
        }
        let fault = self.arm.check(step.clock_ns, &reading, false).map_or_else(Fault::code, |()| 0);
        let newest = step.newest().map(|tick| near.of(tick));
        self.heard = step.newest().unwrap_or(0);
        let newest =
            newest.map(|Sent { position, velocity, .. }| MasterState { position, velocity, rotation: None });
        let input = ArmInput { state: step.state, turns: false, stale_ns: step.stale_ns, newest };
        let tick = self.arm.tick(step.clock_ns, &reading, fault == 0, None, &input, &mut self.outgoing);
        if let Some(rest) = self.led.rest(&mut self.plant, step.state, step.state.is_coupled()) {
            self.arm.rests(&rest, None);
        }
        if let Some(command) = self.arm.last_command().filter(|_| !is_stopped(step.state)) {
            self.plant.write(&command, &tick.command_velocity);
        }
        if step.state.is_coupled() {
            self.plant.start(step.now_ns);
        }
        let PortState { position: x, velocity, force, .. } = self.outgoing;
        // A fault ends the run.
        if fault == 0 {
            self.sent.push(Sent { position: x, velocity, force }, Signal::EnvironmentForce, peer_heard)?;
        }
        // What is measured of it, and nothing else.
        Some(watched.measure_far(&SlaveRecord::<N> {
            time_ns: step.now_ns,
            position,
            environment_force,
            touches: self.plant.touches(),
            state: step.state,
            reason: step.reason,
            fault,
            ..SlaveRecord::default()
        }))
    }
}

#[cfg(test)]
mod tests;
