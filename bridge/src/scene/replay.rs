//! What a recorded side of a hand would have exerted under other settings.

mod columns;

use haptether_safety::{Axes, SafetyTick};

use super::{assemble::SceneError, coupling::commands, sides::master_endpoint, spec::SceneSpec};
use crate::{
    OperatorCommand,
    endpoint::{HandInput, MasterEndpoint, MasterReading},
};

pub use columns::{RecordedColumns, ReplayError, ReplayedColumn, ReplayedColumns, replay_columns};

/// A run of its own: nobody hears of it.
const RUN_ID: u64 = 1;

/// One tick of a recording.
#[derive(Clone, Copy, Debug)]
pub struct RecordedTick<const N: usize> {
    /// Since the run began.
    pub time_ns: u64,
    /// What the device measured.
    pub reading: MasterReading<N>,
    /// What was decided by.
    pub input: HandInput<N>,
    /// `F_device` in N that was exerted.
    pub device_force: Axes<N>,
    /// Whether the hand holds the device, 0 or 1; of a modelled hand only.
    pub grip: f64,
}

/// What a hand adds to a device that it holds: `M x'' + B x' + K x = -F_hand` about the way that it went.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HandImpedance {
    /// M in kg.
    pub mass_kg: f64,
    /// B in N s/m.
    pub damping: f64,
    /// K in N/m.
    pub stiffness: f64,
}

/// One tick, again.
#[derive(Clone, Copy, Debug)]
pub struct ReplayedTick<const N: usize> {
    /// What the safety layer saw and decided.
    pub safety: SafetyTick<N>,
    /// The same of the torque, of a hand that turns.
    pub rotation: Option<SafetyTick<3>>,
    /// How far in m a modelled hand is from where the recorded one was; zero without one.
    pub displacement: Axes<N>,
    /// By how much in m/s it is faster.
    pub displacement_rate: Axes<N>,
}

/// The side of a hand, fed with what was recorded of it.
#[derive(Clone, Debug)]
pub struct Replay<const N: usize> {
    endpoint: MasterEndpoint<N>,
    /// Of the operator with their times; done, so many.
    commands: Vec<(u64, OperatorCommand)>,
    done: usize,
    /// Whether the ladder left a share of the force at the last tick.
    had_force: bool,
    /// Whether the coupling requests anew of what was received.
    recouples: bool,
    hand: Option<HandImpedance>,
    mass_kg: Axes<N>,
    viscous: Axes<N>,
    /// Mechanical stops of the device, lower and upper, in m.
    stops: (Axes<N>, Axes<N>),
    period_s: f64,
    /// When, and what the force was more than the recorded one, at the last tick.
    last: Option<(u64, Axes<N>)>,
    displacement: [Axes<N>; 2],
}

impl<const N: usize> Replay<N> {
    /// A side of the settings of `scene`; `recouples` says that its coupling is not that of the recording.
    ///
    /// # Errors
    ///
    /// A number or a combination that no part can have.
    pub fn new(
        scene: &SceneSpec<N>,
        recouples: bool,
        hand: Option<HandImpedance>,
    ) -> Result<Self, SceneError> {
        let (_, coupling) = scene.coupled()?;
        Ok(Self {
            endpoint: master_endpoint(scene, RUN_ID, None)?,
            commands: commands::<N>(coupling)?,
            done: 0,
            had_force: false,
            recouples,
            hand,
            mass_kg: scene.master.device.mass_kg,
            viscous: scene.master.device.viscous,
            stops: scene.master.device.stops,
            period_s: scene.run.period_s,
            last: None,
            displacement: [Axes::zeros(); 2],
        })
    }

    /// The next tick.
    pub fn step(&mut self, tick: &RecordedTick<N>) -> ReplayedTick<N> {
        while let Some((_, command)) = self.commands.get(self.done).filter(|(at, _)| *at <= tick.time_ns) {
            // They were checked when the scene was built. Where there was a force, they faded.
            let ticks = if self.had_force { self.endpoint.exchange.fade_in_ticks() } else { 0 };
            let _ = self.endpoint.change(*command, ticks);
            self.done += 1;
        }
        self.had_force = tick.input.gain > 0.0;
        let input = if self.recouples { self.endpoint.requested(&tick.input) } else { tick.input };
        let mut reading = tick.reading;
        if let Some(hand) = self.hand {
            self.displace(&hand, tick);
            let [way, rate] = self.displacement;
            reading.position += way;
            reading.velocity = reading.velocity.map(|velocity| velocity + rate);
        }
        let (safety, rotation) = self.endpoint.replay(&reading, &input);
        self.last = Some((tick.time_ns, safety.device_force - tick.device_force));
        let [displacement, displacement_rate] = self.displacement;
        ReplayedTick { safety, rotation, displacement, displacement_rate }
    }

    /// Move device and hand by the force of the last tick that was not there when it was recorded.
    ///
    /// The trapezoidal rule, which is stable whatever the stiffness:
    /// `M (v' - v) = dt (F - B (v + v')/2 - K (x + x')/2)`, `x' = x + dt (v + v')/2`.
    fn displace(&mut self, hand: &HandImpedance, tick: &RecordedTick<N>) {
        let Some((before_ns, force)) = self.last else { return };
        let elapsed_s = tick.time_ns.saturating_sub(before_ns) as f64 * 1e-9;
        // A hole in the recording says nothing of what was exerted in it.
        let dt = elapsed_s.min(self.period_s * (tick.input.missed + 1) as f64);
        if dt <= 0.0 {
            return;
        }
        let [way, rate] = &mut self.displacement;
        for axis in 0..N {
            let (x, v) = (way[axis], rate[axis]);
            let mass = self.mass_kg[axis] + tick.grip * hand.mass_kg;
            let damping = self.viscous[axis] + tick.grip * hand.damping;
            let stiffness = tick.grip * hand.stiffness;
            let resistance = 0.5 * damping + 0.25 * dt * stiffness;
            let next =
                ((mass / dt - resistance) * v + force[axis] - stiffness * x) / (mass / dt + resistance);
            // What was recorded at a stop or beyond it, the stop has borne there, too.
            let at = tick.reading.position[axis];
            let (lower, upper) = ((self.stops.0[axis] - at).min(0.0), (self.stops.1[axis] - at).max(0.0));
            let free = x + 0.5 * dt * (v + next);
            way[axis] = free.clamp(lower, upper);
            rate[axis] = if way[axis] == free { next } else { (way[axis] - x) / dt };
        }
    }
}
