//! Replay of a recorded master: the force it would have exerted with other settings.

mod columns;

use haptether_safety::{Axes, SafetyTick};

use super::{assemble::SceneError, coupling::commands, sides::master_endpoint, spec::SceneSpec};
use crate::{
    OperatorCommand,
    endpoint::{HandInput, MasterEndpoint, MasterReading},
};

pub use columns::{RecordedColumns, ReplayError, ReplayedColumn, ReplayedColumns, replay_columns};

/// Run number of the replay; it has no peer.
const RUN_ID: u64 = 1;

/// One tick of a recording.
#[derive(Clone, Copy, Debug)]
pub struct RecordedTick<const N: usize> {
    /// Time since the run began.
    pub time_ns: u64,
    /// Measurements of the device.
    pub reading: MasterReading<N>,
    /// Inputs of the decision.
    pub input: HandInput<N>,
    /// `F_device` in N that was exerted.
    pub device_force: Axes<N>,
    /// Grip: 1 if the hand holds the device, 0 if not; for a modelled hand only.
    pub grip: f64,
}

/// Impedance that a hand adds to a device it holds: `M x'' + B x' + K x = -F_hand`, with x relative to the recorded
/// path.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HandImpedance {
    /// M in kg.
    pub mass_kg: f64,
    /// B in N s/m.
    pub damping: f64,
    /// K in N/m.
    pub stiffness: f64,
}

/// Result of one replayed tick.
#[derive(Clone, Copy, Debug)]
pub struct ReplayedTick<const N: usize> {
    /// Observations and decision of the safety layer.
    pub safety: SafetyTick<N>,
    /// Same for the torque, if the hand turns.
    pub rotation: Option<SafetyTick<3>>,
    /// Displacement in m of a modelled hand from its recorded position; zero without a modelled hand.
    pub displacement: Axes<N>,
    /// Rate of the displacement in m/s.
    pub displacement_rate: Axes<N>,
}

/// Replay of a master from its recorded inputs.
#[derive(Clone, Debug)]
pub struct Replay<const N: usize> {
    endpoint: MasterEndpoint<N>,
    /// Operator commands with their times; the first `done` of them have been applied.
    commands: Vec<(u64, OperatorCommand)>,
    done: usize,
    /// True if the gain of the ladder was above 0 at the last tick.
    had_force: bool,
    /// True if the coupling recomputes the request from the received force.
    recouples: bool,
    hand: Option<HandImpedance>,
    mass_kg: Axes<N>,
    viscous: Axes<N>,
    /// Mechanical stops of the device, lower and upper, in m.
    stops: (Axes<N>, Axes<N>),
    period_s: f64,
    /// Time of the last tick in ns, and its force in N beyond the recorded force.
    last: Option<(u64, Axes<N>)>,
    displacement: [Axes<N>; 2],
}

impl<const N: usize> Replay<N> {
    /// Build the master from the settings of `scene`; `recouples` is true if its coupling differs from the recorded
    /// one.
    ///
    /// # Errors
    ///
    /// A number or combination of settings is invalid.
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

    /// Replay the next tick.
    pub fn step(&mut self, tick: &RecordedTick<N>) -> ReplayedTick<N> {
        while let Some((_, command)) = self.commands.get(self.done).filter(|(at, _)| *at <= tick.time_ns) {
            // The commands were checked when the scene was built. A change fades only if there was a force.
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

    /// Move device and hand by the difference of replayed and recorded force at the last tick.
    ///
    /// Uses the trapezoidal rule, which is stable for any stiffness:
    /// `M (v' - v) = dt (F - B (v + v')/2 - K (x + x')/2)`, `x' = x + dt (v + v')/2`.
    fn displace(&mut self, hand: &HandImpedance, tick: &RecordedTick<N>) {
        let Some((before_ns, force)) = self.last else { return };
        let elapsed_s = tick.time_ns.saturating_sub(before_ns) as f64 * 1e-9;
        // The force in a gap of the recording is unknown, so only the missed ticks are counted.
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
            // If the recorded position is at or beyond a mechanical stop, the stop carries the force here too.
            let at = tick.reading.position[axis];
            let (lower, upper) = ((self.stops.0[axis] - at).min(0.0), (self.stops.1[axis] - at).max(0.0));
            let free = x + 0.5 * dt * (v + next);
            way[axis] = free.clamp(lower, upper);
            rate[axis] = if way[axis] == free { next } else { (way[axis] - x) / dt };
        }
    }
}
