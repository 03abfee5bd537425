//! Runs with the same link and ladders. Link and ladders are computed once; each run adds hand, device and arm.

mod history;
mod lanes;

use std::{
    collections::VecDeque,
    ops::ControlFlow,
    rc::Rc,
    sync::atomic::{AtomicBool, Ordering},
};

use haptether_master::{MasterSample, SimulatedMaster};
use haptether_numeric::WIDTH;
use haptether_safety::{Axes, Fault, SafetyTick, Signal};
use haptether_slave::{SimulatedSlave, SlaveSample};

use self::{
    history::{History, Sent},
    lanes::LaneFollowers,
};
use super::{
    Outcomes,
    connection::{Connection, LinkSide, Step},
};
use crate::{
    Event, MasterRecord, ModelPlant as _, SlaveReading, SlaveRecord,
    coupling::Mapping,
    coupling::OfHalf,
    endpoint::{Arm, ArmInput, CarriedState, Hand, HandInput, MasterReading, MasterState},
    port::PortState,
    scene::{
        assemble::{SceneError, exact_master},
        coupling::commands,
        sides::{hand_and_coupling, point_arm, simulated_arm, with_waiting_hand},
        spec::SceneSpec,
        timed::Commands,
        watched::Watched,
    },
    side::{LeadTransition, is_stopped},
    virtual_time::{BatchedRun, Snapshot},
    wire::unpadded,
};

/// Compute the outcomes of scenes of one connection, each equal to that of a separate run; None for a scene not run
/// here.
///
/// # Errors
///
/// [`SceneError::Stopped`].
pub(super) fn outcomes<const N: usize>(
    connection: &Connection,
    scenes: &[&SceneSpec<N>],
    lanes: bool,
    stop: &AtomicBool,
) -> Result<Outcomes, SceneError> {
    let mut outcomes = vec![None; scenes.len()];
    Runs { connection, scenes, lanes, stop }.follow(&mut outcomes)?;
    Ok(outcomes)
}

/// Fewest ticks of the master between two checkpoints. Few ticks are repeated, and packets in flight are rarely
/// copied.
const TICKS_BETWEEN_CHECKPOINTS: usize = 1000;

/// Observed ticks of master and slave, and the state of link and ladders after them.
type Checkpoint = ([u64; 2], Rc<Snapshot<LinkSide, LinkSide>>);

/// Run whose link and ladders differ from the master's tick `tick` on.
struct Branch<const N: usize> {
    checkpoint: Checkpoint,
    tick: u64,
    follower: Follower<N>,
}

/// Scenes that share one connection and wait to run.
struct Runs<'a, const N: usize> {
    connection: &'a Connection,
    scenes: &'a [&'a SceneSpec<N>],
    /// True if lanes may be used.
    lanes: bool,
    stop: &'a AtomicBool,
}

/// Largest number of axes for which lanes are compiled.
const MAX_AXES: usize = 3;

/// Fewest runs for which lanes are faster.
const MIN_LANES: usize = 3;

/// Processor for which lanes are compiled: with AVX2.
#[cfg(target_arch = "x86_64")]
type Processor = pulp::x86::V3;

/// Lanes are not compiled for other processors.
#[cfg(not(target_arch = "x86_64"))]
#[derive(Clone, Copy)]
enum Processor {}

/// Return this processor if lanes are compiled for it.
fn processor() -> Option<Processor> {
    #[cfg(target_arch = "x86_64")]
    return Processor::try_new();
    #[cfg(not(target_arch = "x86_64"))]
    None
}

/// Runs in lanes, from their first ticks on.
type LaneGroups<const N: usize> = (Processor, Vec<LaneFollowers<N>>);

impl<const N: usize> Runs<'_, N> {
    /// Run the scenes to their ends, in lanes if allowed. A scene that cannot be built, or whose link and ladders
    /// differ, gets no outcome.
    fn follow(&self, outcomes: &mut Outcomes) -> Result<(), SceneError> {
        let built = |row: usize| Follower::new(self.connection, row, self.scenes[row]).ok();
        let mut scalar = (0..self.scenes.len()).filter_map(built).collect();
        let in_lanes = match processor() {
            Some(processor) if self.lanes && N <= MAX_AXES => {
                Some((processor, gather_into_lanes(&mut scalar)))
            }
            _ => None,
        };
        let left_lanes = self.follow_all(in_lanes, scalar, outcomes)?;
        self.follow_all(None, left_lanes.into_iter().filter_map(built).collect(), outcomes)?;
        Ok(())
    }

    /// Run all to their ends; return the rows that left their lanes.
    fn follow_all(
        &self,
        in_lanes: Option<LaneGroups<N>>,
        scalar: Vec<Follower<N>>,
        outcomes: &mut Outcomes,
    ) -> Result<Vec<usize>, SceneError> {
        let mut left_lanes = Vec::new();
        if in_lanes.is_none() && scalar.is_empty() {
            return Ok(left_lanes);
        }
        let Some(scene) = self.scenes.first() else { return Ok(left_lanes) };
        let settings = &self.connection.settings;
        // It was built from the same settings before, so it does not fail.
        let Ok([mut master, mut slave]) = LinkSide::both(self.connection, scene) else {
            return Ok(left_lanes);
        };
        // Each row refuses an invalid network. A network that alters packets is not shared.
        let batched = BatchedRun::new(settings, &mut master, &mut slave);
        let Some(batched) = batched.ok().filter(|batched| batched.snapshot().is_some()) else {
            return Ok(left_lanes);
        };
        let mut branches = Vec::new();
        let mut group = Group { in_lanes, scalar };
        group.follow(batched, [0, 0], self.stop, outcomes, &mut branches)?;
        let in_lanes = group.in_lanes.map(|(_, in_lanes)| in_lanes).unwrap_or_default();
        for (row, outcome) in in_lanes.into_iter().flat_map(LaneFollowers::outcomes) {
            match outcome {
                Some(outcome) => {
                    #[cfg(test)]
                    tests::count_in_lanes(1);
                    outcomes[row] = Some(Ok(outcome));
                }
                None => left_lanes.push(row),
            }
        }
        while let Some(Branch { checkpoint: (first, snapshot), tick, follower }) = branches.pop() {
            let (mut master, mut slave) = (snapshot.master.clone(), snapshot.slave.clone());
            master.withhold_from(tick);
            let Ok(batched) = BatchedRun::resume(settings, &snapshot, &mut master, &mut slave) else {
                continue;
            };
            let mut group = Group { in_lanes: None, scalar: vec![follower] };
            group.follow(batched, first, self.stop, outcomes, &mut branches)?;
        }
        Ok(left_lanes)
    }
}

/// Move runs that fit into lanes out of `runs`, before their first tick.
fn gather_into_lanes<const N: usize>(runs: &mut Vec<Follower<N>>) -> Vec<LaneFollowers<N>> {
    let (mut in_lanes, mut scalar) = (Vec::new(), Vec::new());
    while !runs.is_empty() {
        let gathered = |take: &[usize]| {
            let of: Vec<_> = take.iter().map(|index| &runs[*index]).collect();
            LaneFollowers::gather(&of)
        };
        // Usually the next runs fit. Otherwise take the runs that fit the first one.
        let mut take: Vec<_> = (0..runs.len().min(WIDTH)).collect();
        let mut followers = gathered(&take);
        if followers.is_none() {
            let fits = |other: &usize| LaneFollowers::fit(&runs[0], &runs[*other]);
            take = std::iter::once(0).chain((1..runs.len()).filter(fits)).take(WIDTH).collect();
            followers = gathered(&take);
        }
        match followers.filter(|_| take.len() >= MIN_LANES) {
            Some(followers) => in_lanes.push(followers),
            None => take.truncate(1),
        }
        let mut index = 0;
        let taken = runs.extract_if(.., |_| {
            index += 1;
            take.contains(&(index - 1))
        });
        if take.len() >= MIN_LANES { drop(taken.collect::<Vec<_>>()) } else { scalar.extend(taken) }
    }
    *runs = scalar;
    in_lanes
}

/// Runs that follow the same link and ladders.
struct Group<const N: usize> {
    in_lanes: Option<LaneGroups<N>>,
    scalar: Vec<Follower<N>>,
}

impl<const N: usize> Group<N> {
    /// Follow link and ladders until each run has ended or differs. `first` has the ticks of master and slave so far.
    fn follow(
        &mut self,
        mut batched: BatchedRun<'_, LinkSide, LinkSide>,
        mut first: [u64; 2],
        stop: &AtomicBool,
        outcomes: &mut Outcomes,
        branches: &mut Vec<Branch<N>>,
    ) -> Result<(), SceneError> {
        let mut checkpoints = VecDeque::<Checkpoint>::new();
        let mut block = Vec::new();
        let mut goes_on = true;
        while goes_on && self.is_running() {
            if stop.load(Ordering::Relaxed) {
                return Err(SceneError::Stopped);
            }
            if checkpoints.back().is_none_or(|(at, _)| first[0] - at[0] >= TICKS_BETWEEN_CHECKPOINTS as u64)
                && self.scalar.iter().any(|follower| follower.may_withhold)
                && let Some(snapshot) = batched.snapshot()
            {
                checkpoints.push_back((first, Rc::new(snapshot)));
                // A withheld force is found at most one block after its tick, so two checkpoints suffice.
                if checkpoints.len() > 2 {
                    checkpoints.pop_front();
                }
            }
            block.clear();
            goes_on = batched
                .advance(&mut |event, _| {
                    block.push(match event {
                        Event::Master(step) => Tick::Master(*step),
                        Event::Slave(step) => Tick::Slave(*step),
                    });
                    ControlFlow::Continue(())
                })
                .is_continue();
            let ticks = block.as_slice();
            // Lanes are compiled up to MAX_AXES.
            if N <= MAX_AXES
                && let Some((processor, in_lanes)) = &mut self.in_lanes
            {
                for followers in in_lanes.iter_mut().filter(|followers| followers.is_running()) {
                    take(*processor, followers, ticks);
                }
            }
            let mut kept = Vec::with_capacity(self.scalar.len());
            for mut follower in self.scalar.drain(..) {
                match follower.take(first, ticks) {
                    Progress::GoesOn if goes_on => kept.push(follower),
                    Progress::GoesOn | Progress::Ended => {
                        outcomes[follower.row] = Some(follower.watched.outcome());
                    }
                    Progress::Withholds(tick) => {
                        let before =
                            checkpoints.iter().rfind(|(_, snapshot)| snapshot.master.ticks() <= tick);
                        #[cfg(test)]
                        tests::count_withheld();
                        if let Some(before) = before {
                            branches.push(Branch { checkpoint: before.clone(), tick, follower });
                        }
                    }
                    Progress::Differs => {}
                }
            }
            self.scalar = kept;
            for tick in ticks {
                first[usize::from(matches!(tick, Tick::Slave(_)))] += 1;
            }
        }
        Ok(())
    }

    fn is_running(&self) -> bool {
        let in_lanes = self.in_lanes.iter().flat_map(|(_, in_lanes)| in_lanes);
        !self.scalar.is_empty() || in_lanes.into_iter().any(LaneFollowers::is_running)
    }
}

/// Step runs in lanes with the vector instructions of the processor.
///
/// No operation mixes lanes or is fused, so each lane equals a separate run, bit for bit.
#[cfg(target_arch = "x86_64")]
fn take<const N: usize>(processor: Processor, followers: &mut LaneFollowers<N>, ticks: &[Tick]) {
    struct InLanes<'a, const N: usize>(&'a mut LaneFollowers<N>, &'a [Tick]);

    impl<const N: usize> pulp::WithSimd for InLanes<'_, N> {
        type Output = ();

        #[inline(always)]
        fn with_simd<A: pulp::Simd>(self, _: A) {
            self.0.take(self.1);
        }
    }

    pulp::Simd::vectorize(processor, InLanes(followers, ticks));
}

/// Unreachable: such a processor has no lanes.
#[cfg(not(target_arch = "x86_64"))]
fn take<const N: usize>(processor: Processor, _: &mut LaneFollowers<N>, _: &[Tick]) {
    match processor {}
}

/// Link and ladder at a tick of either side.
enum Tick {
    /// Tick of the master.
    Master(Step),
    /// Tick of the slave.
    Slave(Step),
}

/// State of a follower after a block of ticks.
enum Progress {
    GoesOn,
    /// Its run ended within the block.
    Ended,
    /// It begins to withhold its force at this tick of the master; link and ladders do not include that.
    Withholds(u64),
    /// Its link and ladders would differ.
    Differs,
}

/// Both sides of a run, which follow shared link and ladders.
struct Follower<const N: usize> {
    row: usize,
    master: MasterPart<N>,
    slave: SlavePart<N>,
    watched: Watched<N>,
    /// Ticks of master and slave so far.
    done: [u64; 2],
    /// Decision of the master's next tick while it waits for link and ladders.
    pending: Option<Box<Decided<N>>>,
    /// True if its layer may withhold the force.
    may_withhold: bool,
}

/// Side of the hand.
struct MasterPart<const N: usize> {
    plant: SimulatedMaster<N>,
    hand: Hand<N>,
    coupling: Mapping<N>,
    commands: Commands,
    sent: History<N>,
    /// Newest received tick of the slave.
    heard: u64,
}

/// Side of the robot.
struct SlavePart<const N: usize> {
    plant: SimulatedSlave<N>,
    arm: Arm<N>,
    led: LeadTransition,
    commands: Commands,
    outgoing: PortState,
    sent: History<N>,
    /// Newest received tick of the master.
    heard: u64,
}

impl<const N: usize> Follower<N> {
    /// Build both sides before their first tick.
    fn new(
        Connection { settings, .. }: &Connection,
        row: usize,
        scene: &SceneSpec<N>,
    ) -> Result<Self, SceneError> {
        let mut plant = with_waiting_hand(exact_master(scene)?);
        let list = commands::<N>(scene.coupled()?.1)?;
        let start = *plant.position();
        let mut arm = simulated_arm(scene)?;
        let (hand, coupling) = hand_and_coupling(scene)?;
        plant.begin(0);
        arm.begin(0);
        let master = MasterPart {
            plant,
            hand,
            coupling,
            commands: Commands::new(list.clone()),
            sent: History::new(),
            heard: 0,
        };
        let slave = SlavePart {
            plant: arm,
            arm: point_arm(scene)?,
            led: LeadTransition::default(),
            commands: Commands::new(list.clone()),
            outgoing: PortState::default(),
            sent: History::new(),
            heard: 0,
        };
        let watched = Watched::new(scene, settings, list, &start, false)?;
        let may_withhold = scene.safety.settings.release_tries > 0;
        Ok(Self { row, master, slave, watched, done: [0, 0], pending: None, may_withhold })
    }

    /// Take a block of ticks and skip those already done. `first` has the numbers of its first ticks.
    fn take(&mut self, first: [u64; 2], ticks: &[Tick]) -> Progress {
        let [mut master, mut slave] = first;
        for tick in ticks {
            let flow = match tick {
                Tick::Master(step) => {
                    master += 1;
                    if master <= self.done[0] {
                        continue;
                    }
                    let waited = self.pending.take();
                    let has_waited = waited.is_some();
                    let decided =
                        waited.map_or_else(|| self.master.decide(step, &self.slave.sent), |decided| *decided);
                    // `act` handles a force that link and ladders withhold already, or never will.
                    if decided.safety.intervention.withheld && !step.withholds && !has_waited {
                        self.pending = Some(Box::new(decided));
                        return Progress::Withholds(self.done[0]);
                    }
                    self.done[0] = master;
                    self.master.act(step, &decided, self.slave.heard, &mut self.watched)
                }
                Tick::Slave(step) => {
                    slave += 1;
                    if slave <= self.done[1] {
                        continue;
                    }
                    self.done[1] = slave;
                    self.slave.tick(step, &self.master.sent, self.master.heard, &mut self.watched)
                }
            };
            match flow {
                Some(ControlFlow::Continue(())) => {}
                Some(ControlFlow::Break(())) => return Progress::Ended,
                None => return Progress::Differs,
            }
        }
        Progress::GoesOn
    }
}

/// Decision of a tick of the master.
struct Decided<const N: usize> {
    position: Axes<N>,
    safety: SafetyTick<N>,
}

impl<const N: usize> MasterPart<N> {
    /// Read the device and decide as [`MasterSide`](crate::MasterSide) does.
    #[inline(always)]
    fn decide(&mut self, step: &Step, slave: &History<N>) -> Decided<N> {
        while let Some(command) = self.commands.due(step.now_ns) {
            // The commands were checked when the scene was built, and apply at its start.
            let _ = self.coupling.command_at_master(command, 0);
        }
        let MasterSample { position, velocity } = self.plant.read(step.now_ns);
        let received = step.newest().map(|tick| slave.of(tick).force);
        self.heard = step.newest().unwrap_or(0);
        let input = HandInput {
            received_force: received.unwrap_or(Axes::zeros()),
            requested_force: received.map_or(Axes::zeros(), |force| self.coupling.rendered_force(&force)),
            gain: step.gain,
            missed: step.missed,
            past: if step.has_stalled { CarriedState::FaultOnly } else { CarriedState::All },
            ..HandInput::idle()
        };
        let (safety, _) = self.hand.tick(&MasterReading::point(position, velocity), &input);
        Decided { position: self.hand.sample_in_use().position, safety }
    }

    /// Write the device and measure. Returns None if link and ladders would differ from `step`.
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
            let sent = Sent { position: *position, velocity, force };
            if !self.sent.push(sent, Signal::RenderedForce, peer_heard) {
                return None;
            }
        }
        let truth = self.plant.state();
        self.plant.write(&force);
        if step.state.is_coupled() {
            self.plant.set_waiting(false);
        }
        // Only the measured fields.
        Some(watched.measure_master(&MasterRecord::<N> {
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

impl<const N: usize> SlavePart<N> {
    /// Step a tick as [`SlaveSide`](crate::SlaveSide) does. Returns None if its ladder would differ.
    #[inline(always)]
    fn tick(
        &mut self,
        step: &Step,
        master: &History<N>,
        peer_heard: u64,
        watched: &mut Watched<N>,
    ) -> Option<ControlFlow<()>> {
        while let Some(command) = self.commands.due(step.now_ns) {
            // Checked like those of the master.
            let _ = self.arm.command(command, 0);
        }
        let SlaveSample { position, velocity, environment_force, .. } = self.plant.read(step.now_ns);
        let reading = SlaveReading::point([position, velocity, environment_force]);
        if step.peer_began {
            self.arm.disengage();
        }
        let checked = self.arm.check(step.clock_ns, &reading, false);
        let fault = checked.map_or_else(Fault::code, |_| 0);
        let reading = checked.ok().flatten().unwrap_or(reading);
        let newest = step.newest().map(|tick| master.of(tick));
        self.heard = step.newest().unwrap_or(0);
        let newest = newest.map(|Sent { position, velocity, .. }| MasterState {
            half: OfHalf::NONE,
            position: *position,
            velocity: *velocity,
            rotation: None,
        });
        let input = ArmInput { state: step.state, turns: false, stale_ns: step.stale_ns, newest };
        let tick = self.arm.tick(step.clock_ns, &reading, None, &input, &mut self.outgoing);
        if let Some(rest) = self.led.rest(&mut self.plant, step.state, step.state.is_coupled()) {
            self.arm.set_rest(&rest, None);
        }
        if let Some(command) = self.arm.last_command().filter(|_| !is_stopped(step.state)) {
            self.plant.write(&command, &tick.command_velocity);
        }
        if step.state.is_coupled() {
            self.plant.start(step.now_ns);
        }
        let outgoing = &self.outgoing;
        // A fault ends the run.
        if fault == 0 {
            let sent = Sent {
                position: unpadded(&outgoing.position),
                velocity: unpadded(&outgoing.velocity),
                force: unpadded(&outgoing.force),
            };
            if !self.sent.push(sent, Signal::EnvironmentForce, peer_heard) {
                return None;
            }
        }
        // Only the measured fields.
        Some(watched.measure_slave(&SlaveRecord::<N> {
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
