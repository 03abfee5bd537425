//! Runs whose link and ladders do the same: that is found once, and each run is hand, device and arm alone.

use std::{
    ops::ControlFlow,
    sync::atomic::{AtomicBool, Ordering},
};

use haptether_safety::{Axes, Fault, SafetyTick, Signal};
use haptether_slave::{SimulatedSlave, SlaveSample};

use super::{
    Outcomes,
    timeline::{Connection, Step, Timeline, is_near_next},
};
use crate::{
    MasterRecord, ModelPlant, OperatorCommand, SlaveReading, SlaveRecord,
    coupling::{FrameMap, PositionForce},
    endpoint::{Arm, ArmInput, Hand, HandInput, LeadState, MasterReading, Past},
    link::PortState,
    scene::{
        assemble::{SceneError, exact_master, stepped_master},
        bilateral::{SESSIONS, waiting},
        coupling::commands,
        measures::Outcome,
        sides::{coupled, master_endpoint, simulated_arm, slave_endpoint},
        spec::{Integrator, SceneSpec},
        timed::Commands,
        watched::Watched,
    },
    side::{Led, is_stopped},
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
    let none = || Ok(vec![None; scenes.len()]);
    let Some(built) = scenes.iter().find(|scene| master_endpoint(scene, SESSIONS.0, None).is_ok()) else {
        return none();
    };
    // What cannot be built is refused once for each, as alone.
    let Ok(Some(timeline)) = Timeline::new(connection, built, stop) else { return none() };
    let depths = timeline.depths();
    let run = |scene: &&SceneSpec<N>| {
        if stop.load(Ordering::Relaxed) {
            return Err(SceneError::Stopped);
        }
        let run = match scene.run.integrator {
            Integrator::Exact => exact_master(scene)
                .and_then(|plant| Follower::new(connection, scene, waiting(plant), depths))
                .map(|follower| follower.run(&timeline, stop)),
            Integrator::Stepped(stepping) => stepped_master::<N>(scene, stepping)
                .and_then(|mut plant| {
                    plant.set_waiting(true);
                    Follower::new(connection, scene, plant, depths)
                })
                .map(|follower| follower.run(&timeline, stop)),
        };
        match run {
            Ok(Err(SceneError::Stopped)) => Err(SceneError::Stopped),
            Ok(outcome) => Ok(outcome.transpose()),
            // It is refused, as alone.
            Err(_) => Ok(None),
        }
    };
    scenes.iter().map(run).collect()
}

/// What a frame says of a tick.
#[derive(Clone, Copy, Debug)]
struct Sent<const N: usize> {
    position: Axes<N>,
    velocity: Axes<N>,
    force: Axes<N>,
}

/// The newest ticks of a side, as far back as its peer looks.
struct History<const N: usize> {
    sent: Box<[Sent<N>]>,
    next: usize,
}

impl<const N: usize> History<N> {
    fn new(depth: usize) -> Self {
        let zeros = Axes::zeros();
        let nothing = Sent { position: zeros, velocity: zeros, force: zeros };
        Self { sent: vec![nothing; depth.next_power_of_two()].into_boxed_slice(), next: 0 }
    }

    /// Keeps that of the next tick; none of what the peer would refuse. `force` is the signal that its force is.
    #[inline(always)]
    fn push(&mut self, sent: Sent<N>, force: Signal) -> Option<()> {
        let Sent { position, velocity, force: newest } = &sent;
        for (signal, value) in [(Signal::Position, position), (Signal::Velocity, velocity), (force, newest)] {
            signal.check(value).ok()?;
        }
        let mask = self.sent.len() - 1;
        self.sent[self.next & mask] = sent;
        self.next += 1;
        Some(())
    }

    #[inline(always)]
    fn of(&self, tick: usize) -> &Sent<N> {
        debug_assert!(tick < self.next && self.next - tick <= self.sent.len(), "{tick} of {}", self.next);
        &self.sent[tick & (self.sent.len() - 1)]
    }
}

/// Both sides of a run without link and ladders, which do what a timeline says.
struct Follower<P, const N: usize> {
    near: Near<P, N>,
    far: Far<N>,
    watched: Watched<N>,
}

/// The side of the hand.
struct Near<P, const N: usize> {
    plant: P,
    hand: Hand<N>,
    coupling: PositionForce<N>,
    commands: Commands,
    sent: History<N>,
}

/// The side of the robot.
struct Far<const N: usize> {
    plant: SimulatedSlave<N>,
    arm: Arm<N>,
    led: Led,
    commands: Commands,
    outgoing: PortState<N>,
    sent: History<N>,
}

impl<P: ModelPlant<N>, const N: usize> Follower<P, N> {
    /// Both sides before their first tick.
    fn new(
        Connection { settings, .. }: &Connection,
        scene: &SceneSpec<N>,
        mut plant: P,
        depths: [usize; 2],
    ) -> Result<Self, SceneError> {
        let list = commands::<N>(coupled(scene)?.1)?;
        let start = plant.state().position;
        let (hand, coupling) = master_endpoint(scene, SESSIONS.0, None)?.into_parts();
        let mut arm = simulated_arm(scene)?;
        let endpoint = slave_endpoint(scene, SESSIONS.1)?;
        plant.begin(0);
        arm.begin(0);
        let near = Near {
            plant,
            hand,
            coupling,
            commands: Commands::new(list.clone()),
            sent: History::new(depths[0]),
        };
        let far = Far {
            plant: arm,
            arm: endpoint.into_arm(),
            led: Led::default(),
            commands: Commands::new(list.clone()),
            outgoing: PortState::default(),
            sent: History::new(depths[1]),
        };
        Ok(Self { near, far, watched: Watched::new(scene, settings, list, &start, false)? })
    }

    /// Runs to the end; none where link and ladders would have done something else.
    fn run(mut self, timeline: &Timeline<'_, N>, stop: &AtomicBool) -> Result<Option<Outcome>, SceneError> {
        let mut own = None;
        let mut done = [0, 0];
        let [mut near, mut far] = timeline.from(done);
        while let Some(is_near) = is_near_next(near.first(), far.first()) {
            if stop.load(Ordering::Relaxed) {
                return Err(SceneError::Stopped);
            }
            let flow = if is_near {
                let Some(step) = near.split_off_first() else { break };
                let decided = self.near.decide(step, &self.far.sent);
                let step = if decided.withholds(step) {
                    // From here on the ladders do something else.
                    let newest = own.as_ref().unwrap_or(timeline).withheld(done[0], stop)?;
                    let Some(newest) = newest else { return Ok(None) };
                    let newest = own.insert(newest);
                    [near, far] = newest.from(done);
                    let Some(step) = near.split_off_first() else { break };
                    step
                } else {
                    step
                };
                done[0] += 1;
                self.near.act(step, &decided, &mut self.watched)
            } else {
                let Some(step) = far.split_off_first() else { break };
                done[1] += 1;
                self.far.tick(step, &self.near.sent, &mut self.watched)
            };
            match flow {
                Some(ControlFlow::Continue(())) => {}
                Some(ControlFlow::Break(())) => break,
                None => return Ok(None),
            }
        }
        self.watched.outcome().map(Some)
    }
}

/// What a tick of the master has decided.
struct Decided<const N: usize> {
    position: Axes<N>,
    safety: SafetyTick<N>,
}

impl<const N: usize> Decided<N> {
    /// Whether the force is withheld from this tick on, which its step does not say.
    #[inline(always)]
    fn withholds(&self, step: &Step) -> bool {
        self.safety.intervention.withheld && !step.withholds
    }
}

impl<P: ModelPlant<N>, const N: usize> Near<P, N> {
    /// Reads the device and decides, as [`MasterSide`](crate::MasterSide) does.
    #[inline(always)]
    fn decide(&mut self, step: &Step, far: &History<N>) -> Decided<N> {
        while let Some(command) = self.commands.due(step.now_ns) {
            // They were checked when the scene was built.
            let _ = match command {
                OperatorCommand::ForceScale(scale) => self.coupling.set_force_scale(scale),
                OperatorCommand::Frame { quat_wxyz, locked } => {
                    FrameMap::rotated(quat_wxyz, &locked).map(|map| self.coupling.set_map(map))
                }
                _ => Ok(()),
            };
        }
        let (position, velocity) = self.plant.read(step.now_ns);
        let received = step.newest().map(|tick| far.of(tick).force);
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
            self.sent.push(Sent { position: *position, velocity, force }, Signal::RenderedForce)?;
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
    fn tick(&mut self, step: &Step, near: &History<N>, watched: &mut Watched<N>) -> Option<ControlFlow<()>> {
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
        let newest =
            newest.map(|Sent { position, velocity, .. }| LeadState { position, velocity, rotation: None });
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
            self.sent.push(Sent { position: x, velocity, force }, Signal::EnvironmentForce)?;
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
