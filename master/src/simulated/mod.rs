//! A simulated master: device and hand, advanced exactly under a force held since the last write.

mod aimed;
mod bend;
mod events;
mod lanes;
mod one_step;
#[cfg(test)]
mod one_step_tests;
#[cfg(test)]
mod tests;

pub use lanes::{MasterLanes, MasterLanesSample};

use self::aimed::Aims;
use crate::{
    Axes, ContinuousWall, DeviceParameters, Hand, ModelError, Real,
    device::{exerted, quantised_axes},
    hand::gripped,
    propagator::{HandForecast, Propagator},
    require,
};

/// Measurements of a device at one tick.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MasterSample<const N: usize> {
    /// x in m, as encoded.
    pub position: Axes<N>,
    /// V in m/s, if the device measures it.
    pub velocity: Option<Axes<N>>,
}

/// Speed in m/s below which a device that friction can hold counts as stopped. On several axes friction
/// rotates with the motion, and the last bit of the speed would take ever shorter stretches.
const STOPPED: f64 = 1e-10;

/// Last contact with and last separation from a continuous wall, in s since the clock's zero.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Touch {
    /// Last contact made.
    pub made_s: Option<f64>,
    /// Last contact broken.
    pub broke_s: Option<f64>,
    /// Number of contacts made.
    pub count: u64,
}

/// x in m and V in m/s of one device, or of one per lane.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Motion<const N: usize, S: Real = f64> {
    position: Axes<N, S>,
    velocity: Axes<N, S>,
    /// Rounding errors of position and velocity. A constant force adds the same step at every tick, and its
    /// rounding would accumulate.
    lost: [Axes<N, S>; 2],
}

impl<const N: usize, S: Real> Motion<N, S> {
    fn at_rest(position: Axes<N, S>) -> Self {
        Self { position, velocity: Axes::zeros(), lost: [Axes::zeros(); 2] }
    }
}

impl<const N: usize> Motion<N> {
    /// Add small steps of x in m and V in m/s, with compensated rounding.
    fn add(&mut self, moved: &Axes<N>, gained: &Axes<N>) {
        let [of_position, of_velocity] = &mut self.lost;
        for axis in 0..N {
            add_one(&mut self.position[axis], &mut of_position[axis], moved[axis]);
            add_one(&mut self.velocity[axis], &mut of_velocity[axis], gained[axis]);
        }
    }
}

/// Time, and the hand's intent from then on.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Clock<const N: usize> {
    /// Time of the hand in s; its path begins at 0.
    time: f64,
    /// The same at the last tick in ns: a sum of ticks in s would accumulate rounding.
    hand_ns: u64,
    waits: bool,
    now_ns: u64,
    /// Length of the last tick in ns; the second tick of equal length computes a map.
    last_ns: u64,
    forecast: HandForecast<N>,
}

impl<const N: usize> Clock<N> {
    fn new(hand: &Hand<N>, now_ns: u64, waits: bool) -> Self {
        Self { time: 0.0, hand_ns: 0, waits, now_ns, last_ns: 0, forecast: HandForecast::new(hand, 0.0) }
    }

    /// True if path and grip stay smooth over a tick that is as long as the last.
    #[inline(always)] // once per tick
    fn is_smooth(&self, past_ns: u64) -> bool {
        let HandForecast { grip: [gain, strength], until, time, .. } = self.forecast;
        gain[1] == 0.0
            && strength[1] == 0.0
            && past_ns == self.last_ns
            && past_ns as f64 * 1e-9 <= until - time
    }

    /// Advance by `past_ns` > 0.
    #[inline(always)] // once per tick
    fn advance(&mut self, hand: &Hand<N>, past_ns: u64) {
        self.last_ns = past_ns;
        if !self.waits {
            self.hand_ns += past_ns;
            self.time = self.hand_ns as f64 / 1e9;
        }
        self.forecast.advance(hand, self.time, past_ns);
        self.now_ns += past_ns;
    }
}

/// Device, hand, and walls that act on the device at every instant.
///
/// The motion is smooth between events and follows its Taylor series to rounding. Events are located to
/// rounding: an axis reverses or starts, the grip begins or ceases to slip, the release begins or ends, a
/// stop or a wall is met or left.
#[derive(Clone, Debug, PartialEq)]
pub struct SimulatedMaster<const N: usize> {
    device: DeviceParameters<N>,
    hand: Hand<N>,
    /// Aims of the hand; none follows its path.
    aims: Option<Box<Aims<N>>>,
    walls: Vec<ContinuousWall<N>>,
    held_force: Axes<N>,
    clock: Clock<N>,
    motion: Motion<N>,
    /// Mask of the walls that push.
    pushing: u64,
    touch: Touch,
    propagator: Propagator<N>,
    #[cfg(test)]
    pub(crate) propagated: u64,
    #[cfg(test)]
    pub(crate) follows_series_only: bool,
}

impl<const N: usize> SimulatedMaster<N> {
    /// Most continuous walls.
    pub const MAX_WALLS: usize = 64;

    /// A device at rest at the start of the hand's path, at time `now_ns`.
    pub fn new(device: DeviceParameters<N>, hand: Hand<N>, now_ns: u64) -> Result<Self, ModelError> {
        device.check()?;
        Ok(Self {
            clock: Clock::new(&hand, now_ns, false),
            motion: Motion::at_rest(hand.target_at(0.0)),
            propagator: Propagator::none(),
            #[cfg(test)]
            propagated: 0,
            #[cfg(test)]
            follows_series_only: false,
            device,
            hand,
            aims: None,
            walls: Vec::new(),
            held_force: Axes::zeros(),
            pushing: 0,
            touch: Touch::default(),
        })
    }

    /// The same device with walls that act at every instant.
    pub fn with_walls(self, walls: Vec<ContinuousWall<N>>) -> Result<Self, ModelError> {
        require("walls", walls.len() as f64, walls.len() <= Self::MAX_WALLS, "at most 64")?;
        Ok(Self { walls, ..self })
    }

    /// Set whether the hand waits at the start of its path; its time runs while it does not wait.
    pub fn set_waiting(&mut self, waits: bool) {
        self.clock.waits = waits;
    }

    /// Place the device at x in m with V in m/s.
    pub fn place(&mut self, position: Axes<N>, velocity: Axes<N>) -> Result<(), ModelError> {
        for (x, v) in position.iter().zip(&velocity) {
            require("position", *x, true, "finite")?;
            require("velocity", *v, true, "finite")?;
        }
        self.motion = Motion { velocity, ..Motion::at_rest(position) };
        Ok(())
    }

    /// Set the clock to `now_ns` without advancing the state.
    pub fn begin(&mut self, now_ns: u64) {
        self.clock.now_ns = now_ns;
    }

    /// Advances to `now_ns` (monotonic) and returns the measurement.
    #[inline]
    pub fn read(&mut self, now_ns: u64) -> MasterSample<N> {
        self.advance_to(now_ns);
        if self.aims.is_some() {
            self.take_aim();
        }
        self.measured()
    }

    #[inline(never)]
    fn advance_to(&mut self, now_ns: u64) {
        let past_ns = now_ns.saturating_sub(self.clock.now_ns);
        if past_ns > 0 {
            let duration = past_ns as f64 * 1e-9;
            if !self.propagates(duration, past_ns) {
                self.advance(duration);
            }
            self.clock.advance(&self.hand, past_ns);
        }
    }

    /// Measurement of the current state.
    #[inline]
    pub fn measured(&self) -> MasterSample<N> {
        let (quantum, Motion { position, velocity, .. }) = (self.device.encoder_quantum, self.motion);
        MasterSample {
            position: quantised_axes(&position, quantum, quantum == 0.0),
            velocity: self.device.measures_velocity.then_some(velocity),
        }
    }

    /// Hold this force in N within the motors' bound; a non-finite force becomes zero.
    pub fn write(&mut self, force: &Axes<N>) {
        let quantum = self.device.force_quantum_n;
        self.held_force = exerted(force, self.device.max_force_n, quantum, quantum == 0.0);
    }

    /// True position in m, before the encoder.
    pub fn position(&self) -> &Axes<N> {
        &self.motion.position
    }

    /// True velocity in m/s.
    pub fn velocity(&self) -> &Axes<N> {
        &self.motion.velocity
    }

    /// True force of the hand on the device in N.
    pub fn hand_force(&self) -> Axes<N> {
        let step = self.one_step(0.0);
        gripped(&step.wish(), step.strength)
    }

    /// Force of the motors since the last write in N.
    pub fn motor_force(&self) -> &Axes<N> {
        &self.held_force
    }

    /// True force of the continuous walls on the device in N.
    pub fn wall_force(&self) -> Axes<N> {
        self.walls.iter().map(|wall| wall.force(&self.motion.position, &self.motion.velocity)).sum()
    }

    /// Contacts with continuous walls.
    pub fn touch(&self) -> &Touch {
        &self.touch
    }

    /// Set the time of the hand to 0; its path and grip may have changed.
    fn restart_hand(&mut self) {
        let (now_ns, last_ns, waits) = (self.clock.now_ns, self.clock.last_ns, self.clock.waits);
        self.clock = Clock { last_ns, ..Clock::new(&self.hand, now_ns, waits) };
    }

    fn halt(&mut self, axis: usize) {
        (self.motion.velocity[axis], self.motion.lost[1][axis]) = (0.0, 0.0);
    }
}

/// Magnitude of `along` perpendicular to `direction`, a unit vector.
fn across<const N: usize>(direction: &Axes<N>, along: &Axes<N>) -> f64 {
    (along - direction * direction.dot(along)).norm()
}

/// Add a small step with compensated rounding.
///
/// Source: Kahan 1965; the exact error of a sum, Knuth 1969, section 4.2.2.
#[inline(always)] // a few operations, several times per tick
fn add_one<S: Real>(sum: &mut S, lost: &mut S, step: S) {
    let (before, step) = (*sum, step + *lost);
    let after = before + step;
    let taken = after - before;
    *lost = (before - (after - taken)) + (step - taken);
    *sum = after;
}
