//! A simulated master: device and hand, advanced exactly under the force held since the last write.

use crate::{
    Axes, ContinuousWall, DeviceParameters, Friction, Hand, ModelError,
    device::{exerted, quantised},
    polynomial::{Series, TERMS, first_negative, product},
    propagator::{Outlook, Propagator},
    require,
    stretch::{Grip, Law, Regime, Rub, Stretch},
};

/// What a device measures at one tick.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MasterSample<const N: usize> {
    /// x in m, as the encoder sees it.
    pub position: Axes<N>,
    /// V in m/s, only from a device that measures it.
    pub velocity: Option<Axes<N>>,
}

/// Progress in s below which an event counts as another at the same instant. At a tie (the grip exactly as strong as
/// the load) rounding would place the next event at no distance for ever.
const MIN_PROGRESS: f64 = 1e-9;

/// Events at one instant; beyond them the motion is taken on by [`MIN_PROGRESS`].
const MAX_STALLS: u32 = 8;

/// Stretches of one advance; beyond them it moves on in steps of this share of it, so that a tick always ends.
const MAX_STRETCHES: u32 = 4096;

/// Share of an advance below which a stretch is short, and how many of these show that the motion is too stiff to be
/// followed; the rest is then taken in as many steps. A transient under stiff damping takes 80, after which
/// [`Law::relaxed`] goes on.
const SHORT: f64 = 1.0 / 8192.0;
const MAX_SHORT: u32 = 512;

/// Share of the time wanted below which a series that reaches no further is that of a stiff motion.
const STIFF_SHARE: f64 = 1.0 / 32.0;

/// Speed in m/s below which a device that friction can hold is taken to have stopped. On several axes friction
/// rotates with the motion, and the last bit of the speed would take ever shorter stretches.
const STOPPED: f64 = 1e-10;

/// Longest stretch in s of a device that sets off: its direction is that of the force.
const SETTING_OFF: f64 = 1e-6;

/// Time in s within which a slow device rotates into the direction of the force, `m |V| / |F|`, below which it counts
/// as still setting off: where the force grows slowly past friction, the series of the direction would take ever
/// shorter stretches.
const TURNS_AT_ONCE: f64 = 1e-6;

/// Speed in m/s across the motion below which it is a straight line for friction along it, whatever the speed: even
/// where the device turns, friction then errs by no more than some of these.
const STRAIGHT: f64 = 1e-15;

/// When the device last touched a continuous wall and last left one, in s since the clock's zero.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Touch {
    /// Last contact made.
    pub made_s: Option<f64>,
    /// Last contact broken.
    pub broke_s: Option<f64>,
    /// How many contacts were made.
    pub count: u64,
}

/// Device, hand and what walls act on the device by themselves.
///
/// Between two events (an axis reverses or sets off, the grip begins or ceases to slip, the release begins or ends, a
/// stop or a wall is met or left) the motion is smooth and is followed by its Taylor series to rounding; the events
/// themselves are located to rounding.
#[derive(Clone, Debug, PartialEq)]
pub struct SimulatedMaster<const N: usize> {
    device: DeviceParameters<N>,
    hand: Hand<N>,
    walls: Vec<ContinuousWall<N>>,
    held_force: Axes<N>,
    /// Time in s of the hand: 0 where its path begins.
    time: f64,
    /// The same at the last tick, in ns: a sum of ticks in s would drift by a rounding at each.
    hand_ns: u64,
    waits: bool,
    now_ns: u64,
    position: Axes<N>,
    velocity: Axes<N>,
    /// What rounding took from position and velocity: a constant force adds the same step at every tick, which
    /// would be rounded the same way each time.
    lost: [Axes<N>; 2],
    /// Which walls push, a bit for each.
    pushing: u64,
    touch: Touch,
    /// The hand from now on.
    outlook: Outlook<N>,
    propagator: Propagator<N>,
    /// Length of the last tick in ns: a map is computed for the second of the same length.
    last_ns: u64,
    #[cfg(test)]
    pub(crate) propagated: u64,
    #[cfg(test)]
    pub(crate) follows_series_only: bool,
}

impl<const N: usize> SimulatedMaster<N> {
    /// Most continuous walls.
    pub const MAX_WALLS: usize = 64;

    /// A device at rest where the hand's path starts, at time `now_ns`.
    pub fn new(device: DeviceParameters<N>, hand: Hand<N>, now_ns: u64) -> Result<Self, ModelError> {
        device.check()?;
        let position = hand.target_at(0.0);
        Ok(Self {
            outlook: Outlook::new(&hand, 0.0),
            propagator: Propagator::none(),
            last_ns: 0,
            #[cfg(test)]
            propagated: 0,
            #[cfg(test)]
            follows_series_only: false,
            device,
            hand,
            walls: Vec::new(),
            held_force: Axes::zeros(),
            time: 0.0,
            hand_ns: 0,
            waits: false,
            now_ns,
            position,
            velocity: Axes::zeros(),
            lost: [Axes::zeros(); 2],
            pushing: 0,
            touch: Touch::default(),
        })
    }

    /// The same device among walls that act at every instant.
    pub fn among(self, walls: Vec<ContinuousWall<N>>) -> Result<Self, ModelError> {
        require("walls", walls.len() as f64, walls.len() <= Self::MAX_WALLS, "at most 64")?;
        Ok(Self { walls, ..self })
    }

    /// Whether the hand waits at the start of its path; once it no longer waits, its time runs from there.
    pub fn set_waiting(&mut self, waits: bool) {
        self.waits = waits;
    }

    /// Puts the device at x in m with V in m/s.
    pub fn place(&mut self, position: Axes<N>, velocity: Axes<N>) -> Result<(), ModelError> {
        for (x, v) in position.iter().zip(&velocity) {
            require("position", *x, true, "finite")?;
            require("velocity", *v, true, "finite")?;
        }
        (self.position, self.velocity) = (position, velocity);
        self.lost = [Axes::zeros(); 2];
        Ok(())
    }

    /// Sets the clock to `now_ns` without advancing: the device rests until then.
    pub fn begin(&mut self, now_ns: u64) {
        self.now_ns = now_ns;
    }

    /// Advances to `now_ns` (monotonic) and returns what the device measures there.
    pub fn read(&mut self, now_ns: u64) -> MasterSample<N> {
        if now_ns > self.now_ns {
            let past_ns = now_ns - self.now_ns;
            let duration = past_ns as f64 * 1e-9;
            if !self.propagates(duration, past_ns) {
                self.advance(duration);
            }
            self.last_ns = past_ns;
            if !self.waits {
                self.hand_ns += past_ns;
                self.time = self.hand_ns as f64 / 1e9;
            }
            self.outlook.advance(&self.hand, self.time);
            self.now_ns = now_ns;
        }
        self.measured()
    }

    /// What the device measures where it is.
    pub fn measured(&self) -> MasterSample<N> {
        let quantum = self.device.encoder_quantum;
        MasterSample {
            position: self.position.map(|x| quantised(x, quantum, quantum == 0.0)),
            velocity: self.device.measures_velocity.then_some(self.velocity),
        }
    }

    /// Holds this force in N from now on, as far as the motors exert it; what is not finite becomes no force.
    pub fn write(&mut self, force: &Axes<N>) {
        let commanded = if force.iter().all(|f| f.is_finite()) { *force } else { Axes::zeros() };
        let quantum = self.device.force_quantum_n;
        self.held_force = exerted(&commanded, self.device.max_force_n, quantum, quantum == 0.0, false);
    }

    /// True position in m, which no encoder measures.
    pub fn position(&self) -> &Axes<N> {
        &self.position
    }

    /// True velocity in m/s.
    pub fn velocity(&self) -> &Axes<N> {
        &self.velocity
    }

    /// True force of the hand on the device in N.
    pub fn hand_force(&self) -> Axes<N> {
        let [gain, strength] = self.outlook.grip.map(|line| line[0]);
        let wish = ((self.outlook.target - self.position) * self.hand.stiffness()
            - self.velocity * self.hand.damping())
            * gain;
        let norm = wish.norm();
        if norm <= strength { wish } else { wish * (strength / norm) }
    }

    /// Force in N that the motors exert since the last write.
    pub fn motor_force(&self) -> &Axes<N> {
        &self.held_force
    }

    /// True force of the continuous walls on the device in N.
    pub fn wall_force(&self) -> Axes<N> {
        self.walls.iter().map(|wall| wall.force(&self.position, &self.velocity)).sum()
    }

    /// Contacts with continuous walls.
    pub fn touch(&self) -> &Touch {
        &self.touch
    }

    /// Moves over a tick of `duration` in one step, if bounds on the motion say that no event falls into it and all
    /// laws are linear; else leaves everything as it is. A bound too many costs time, none costs accuracy.
    #[inline]
    fn propagates(&mut self, duration: f64, past_ns: u64) -> bool {
        #[cfg(test)]
        if self.follows_series_only {
            return false;
        }
        let outlook = &self.outlook;
        let [gain, strength] = outlook.grip;
        if gain[1] != 0.0
            || strength[1] != 0.0
            || self.pushing != 0
            || past_ns != self.last_ns
            || duration > outlook.until - outlook.time
        {
            return false;
        }
        let (x, v) = (self.position, self.velocity);
        let Some(StandingGrip { force: wish, impedance, has_let_go }) =
            self.standing_grip(gain[0], strength[0])
        else {
            return false;
        };
        if !self.propagator.is_of(duration, impedance) {
            self.propagator = Propagator::new(&self.device, &self.hand, impedance, duration);
        }
        let map = &self.propagator;
        if !map.reaches {
            return false;
        }
        let trembles = !self.waits && map.shakes[1] > 0.0;
        let moves = !self.waits && outlook.moves;
        let shakes = if trembles {
            outlook.wave[0].abs() * map.shakes[0] + outlook.wave[1].abs() * map.shakes[1]
        } else {
            0.0
        };
        let mut shift = Axes::<N>::repeat(shakes);
        if moves {
            shift += outlook.most_moved(duration);
        }
        let push = self.held_force + wish;
        let rubs_along = self.device.rubs_along_motion();
        let most_pulled = shift * (impedance[0] * (1.0 + 1e-12));
        let Some(StandingFriction { force: friction, stuck, along }) =
            self.standing_friction(&push, &most_pulled)
        else {
            return false;
        };
        let inverse_mass = Axes::<N>::from_fn(|axis, _| self.propagator.axes[axis].inverse_mass);
        let acceleration =
            (push - friction - self.device.viscous.component_mul(&v)).component_mul(&inverse_mass);
        if let Some(speed) = along
            && !self.goes_straight(&acceleration, speed, shakes, duration)
        {
            return false;
        }
        let (lower, upper) = &self.device.stops;
        let (mut moved, mut gained) = (Axes::<N>::zeros(), Axes::<N>::zeros());
        let (mut most_moved, mut most_gained) = (Axes::<N>::zeros(), Axes::<N>::zeros());
        for axis in 0..N {
            if stuck[axis] {
                if x[axis] <= lower[axis] || x[axis] >= upper[axis] {
                    return false;
                }
                continue;
            }
            let (map, a, v, x) = (&map.axes[axis], acceleration[axis], v[axis], x[axis]);
            let path = moves.then(|| outlook.path_of(axis));
            let e = map.change(a, v, path, trembles.then_some(outlook.wave));
            let target = map.pull * shift[axis];
            let [farther, faster] = map.bounds(a, v, target, duration);
            if friction[axis] != 0.0 && !rubs_along && v.abs() <= faster {
                let bends = map.damping.abs() * faster + map.pull * farther + target;
                let is_monotone = a.abs() * (1.0 - 1e-12) > bends;
                if !is_monotone || (v + e[1]) * v.signum() <= 1e-12 * faster {
                    return false;
                }
            }
            if !(x - farther > lower[axis] && x + farther < upper[axis]) {
                return false;
            }
            (moved[axis], gained[axis]) = (v * duration + e[0], e[1]);
            (most_moved[axis], most_gained[axis]) = (farther, faster);
        }
        if !has_let_go && strength[0].is_finite() {
            let change = impedance[0] * (shift + most_moved).norm() + impedance[1] * most_gained.norm();
            if (wish.norm() + change) * (1.0 + 1e-12) >= strength[0] {
                return false;
            }
        }
        if !self.stays_clear(&most_moved) {
            return false;
        }
        self.move_by(&moved, &gained, &stuck);
        #[cfg(test)]
        {
            self.propagated += 1;
        }
        true
    }

    /// Changes position and velocity, without what rounding loses, and holds the axes that stick.
    #[inline]
    fn move_by(&mut self, moved: &Axes<N>, gained: &Axes<N>, stuck: &[bool; N]) {
        add(&mut self.position, &mut self.lost[0], moved);
        add(&mut self.velocity, &mut self.lost[1], gained);
        for (axis, is_stuck) in stuck.iter().enumerate() {
            if *is_stuck {
                self.halt(axis);
            }
        }
    }

    /// Whether no wall that acts at each instant is within reach of a motion of at most so much along each axis.
    #[inline]
    fn stays_clear(&self, most_moved: &Axes<N>) -> bool {
        self.walls.iter().all(|wall| {
            let room = -wall.depth(&self.position) - 1e-15 * (1.0 + wall.surface.abs());
            !wall.is_two_sided && most_moved.norm() * (1.0 + 1e-12) < room
        })
    }

    /// The force of a hand that holds or has let go; None where it lets go with nothing to hold, so that the series decides.
    #[inline]
    fn standing_grip(&self, gain: f64, strength: f64) -> Option<StandingGrip<N>> {
        let (x, v) = (self.position, self.velocity);
        let force = ((self.outlook.target - x) * self.hand.stiffness() - v * self.hand.damping()) * gain;
        if strength != 0.0 {
            let impedance = [gain * self.hand.stiffness(), gain * self.hand.damping()];
            return Some(StandingGrip { force, impedance, has_let_go: false });
        }
        let is_free = self.hand.stiffness() + self.hand.damping() == 0.0 || force != Axes::<N>::zeros();
        is_free.then_some(StandingGrip { force: Axes::zeros(), impedance: [0.0; 2], has_let_go: true })
    }

    /// The friction of a tick in which no axis that sticks is torn loose: `push` in N as it is now, `most_pulled` by how much
    /// the hand's target may add to it; None where that cannot be said.
    #[inline]
    fn standing_friction(&self, push: &Axes<N>, most_pulled: &Axes<N>) -> Option<StandingFriction<N>> {
        let mut found = StandingFriction { force: Axes::zeros(), stuck: [false; N], along: None };
        let v = &self.velocity;
        if self.device.rubs_along_motion() {
            let coulomb = self.device.coulomb[0];
            let speed = v.norm();
            if speed == 0.0 {
                found.stuck = [true; N];
                return (push.norm() + most_pulled.norm() <= coulomb * (1.0 - 1e-12)).then_some(found);
            }
            found.force = v * (coulomb / speed);
            found.along = Some(speed);
            return (speed >= STOPPED && self.propagator.is_isotropic).then_some(found);
        }
        for axis in 0..N {
            let coulomb = self.device.coulomb[axis];
            if coulomb == 0.0 {
                continue;
            }
            if v[axis] != 0.0 {
                found.force[axis] = coulomb * v[axis].signum();
            } else if push[axis].abs() + most_pulled[axis] <= coulomb * (1.0 - 1e-12) {
                found.stuck[axis] = true;
            } else {
                return None;
            }
        }
        Some(found)
    }

    /// Whether friction along the motion keeps its direction over a tick, so far that rounding hides the rest.
    ///
    /// Across the motion the speed grows to at most P; friction turns by `P / |V|`, which moves V by `c dT P / (m |V|)`.
    fn goes_straight(&self, acceleration: &Axes<N>, speed: f64, shakes: f64, duration: f64) -> bool {
        let (map, one) = (&self.propagator, &self.propagator.axes[0]);
        let direction = self.velocity / speed;
        let aside = |along: &Axes<N>| across(&direction, along);
        let (mut moved, mut moved_aside) = (0.0, 0.0);
        if shakes > 0.0 {
            let all = Axes::<N>::repeat(1.0);
            moved += shakes * (N as f64).sqrt();
            moved_aside += shakes * aside(&all);
        }
        if !self.waits && self.outlook.moves {
            let mut power = 1.0;
            for term in &self.outlook.path[1..] {
                power *= duration;
                moved += term.norm() * power;
                moved_aside += aside(term) * power;
            }
        }
        debug_assert!(map.is_isotropic);
        let faster = one.most * (acceleration.norm() + one.pull * (duration * speed + moved)) * (1.0 + 1e-12);
        let least = speed - faster;
        let across = one.most * (aside(acceleration) + one.pull * moved_aside);
        let slip = self.device.coulomb[0] * one.inverse_mass * duration * across;
        least > STOPPED && slip <= f64::EPSILON / 16.0 * least
    }

    fn advance(&mut self, duration: f64) {
        let begun = self.time;
        let clock = self.now_ns as f64 * 1e-9;
        let mut done = 0.0;
        let (mut stretches, mut stalls, mut short) = (0, 0, 0);
        while done < duration {
            stretches += 1;
            let least = if short > MAX_SHORT {
                duration / f64::from(MAX_SHORT)
            } else if stretches > MAX_STRETCHES {
                duration / f64::from(MAX_STRETCHES)
            } else if stalls > MAX_STALLS {
                MIN_PROGRESS
            } else {
                0.0
            };
            let kink = if self.waits { None } else { self.hand.next_kink(self.time) };
            let wanted = (duration - done).min(kink.map_or(f64::INFINITY, |kink| kink - self.time));
            let (taken, to_its_reach) = self.stretch(wanted, least, clock + done);
            // A direction that rotates fast is followed in short stretches, which are progress.
            let moves_on = taken >= MIN_PROGRESS || (to_its_reach && taken > 0.0);
            stalls = if moves_on { 0 } else { stalls + 1 };
            short += u32::from(taken < duration * SHORT);
            let reached_kink = taken == wanted && kink.is_some_and(|kink| kink - self.time == wanted);
            done = if taken == duration - done { duration } else { done + taken };
            // Rounding of many small additions must not shift the clock.
            self.time = match kink {
                _ if self.waits => begun,
                Some(kink) if reached_kink => kink,
                // Nor may it fall back behind a kink that is over.
                _ => self.time.max(begun + done),
            };
        }
    }

    /// Follows one stretch for `wanted` s or until the next event, whichever is first, but at least `least` s;
    /// says how long it was, and whether its series reached no further.
    fn stretch(&mut self, wanted: f64, least: f64, clock: f64) -> (f64, bool) {
        let mut target = self.hand.target_series(self.time);
        let (mut gain, mut strength) = self.hand.grip_line(self.time);
        if self.waits {
            target[1..].fill(Axes::zeros());
            (gain[1], strength[1]) = (0.0, 0.0);
        }
        self.meet_walls(clock);
        let law = Law {
            device: &self.device,
            hand: &self.hand,
            walls: &self.walls,
            held: self.held_force,
            target,
            gain,
            strength,
        };
        let wish = ((target[0] - self.position) * self.hand.stiffness()
            - self.velocity * self.hand.damping())
            * gain[0];
        let norm = wish.norm();
        let mut grip = if norm <= strength[0] { Grip::Holds } else { Grip::Slips };
        let (mut regime, mut stretch, mut duration, mut setting_off);
        loop {
            let hand = match grip {
                Grip::Slips if norm > 0.0 => wish * (strength[0] / norm),
                _ => wish,
            };
            (regime, setting_off) = self.regime(grip, &hand);
            if self.device.rubs_along_motion()
                && regime.stuck == [false; N]
                && let Some(direction) = self.straight_line(&law, grip, &hand, wanted)
            {
                regime.rub = Rub::Constant(direction * self.device.coulomb[0]);
                regime.straight = Some(direction);
                setting_off = false;
            }
            stretch = law.follow(&regime, self.position, self.velocity);
            if stretch.reach < STIFF_SHARE * wanted {
                stretch = law.relaxed(&regime, self.position, self.velocity, wanted).unwrap_or(stretch);
            }
            duration = wanted.min(stretch.reach);
            if setting_off {
                duration = duration.min(SETTING_OFF);
            }
            let slips_at = self.grip_changes(&stretch, grip, strength, duration);
            if grip == Grip::Holds && slips_at == Some(0.0) && norm > 0.0 {
                // Exactly as strong as the load, and weaker at once.
                grip = Grip::Slips;
                continue;
            }
            duration = slips_at.unwrap_or(duration).max(least).min(wanted);
            break;
        }
        let (event, moved, gained);
        if duration > stretch.reach {
            // Beyond their reach only the first terms of the series say something; events are met where they are.
            event = None;
            (moved, gained) = law.coarse_step(&regime, &stretch, duration);
        } else {
            event = self.first_event(&stretch, &regime, duration);
            duration = event.map_or(duration, |event| event.at).max(least).min(wanted);
            (moved, gained) = (stretch.displacement(duration), stretch.speed_gained(duration));
        }
        add(&mut self.position, &mut self.lost[0], &moved);
        add(&mut self.velocity, &mut self.lost[1], &gained);
        for axis in 0..N {
            if regime.stuck[axis] {
                self.halt(axis);
            }
        }
        if let Some(event) = event {
            self.settle(event.kind, clock + duration);
        }
        if let Rub::AlongMotion(coulomb) = regime.rub
            && self.velocity.norm() < STOPPED
            && !setting_off
            && stretch.push[0].norm() <= coulomb
        {
            (0..N).for_each(|axis| self.halt(axis));
        }
        self.meet_stops();
        (duration, event.is_none() && duration == stretch.reach)
    }

    /// The direction of a device that rubs along its motion, if it moves on a straight line for `wanted` s or sets off
    /// on one: its friction is then constant until it stops.
    fn straight_line(&self, law: &Law<N>, grip: Grip, hand: &Axes<N>, wanted: f64) -> Option<Axes<N>> {
        let same = |values: &Axes<N>| values.iter().all(|value| *value == values[0]);
        let holds_on = grip == Grip::Holds && law.gain[1] == 0.0;
        let has_let_go = grip == Grip::Slips && law.strength == [0.0; 2];
        if self.pushing != 0
            || !(holds_on || has_let_go)
            || !same(&self.device.mass_kg)
            || !same(&self.device.viscous)
        {
            return None;
        }
        let push = self.held_force + hand;
        let speed = self.velocity.norm();
        let direction = if speed >= STOPPED { self.velocity / speed } else { push / push.norm() };
        let aside = |along: &Axes<N>| across(&direction, along);
        let (mut across, mut power) = (aside(&push), 1.0);
        if holds_on {
            for term in &law.target[1..] {
                power *= wanted;
                across += law.gain[0] * self.hand.stiffness() * aside(term) * power;
            }
        }
        // A series reaches so far that no speed grows to more than twice what its force alone would lead to.
        let grown = 2.0 * wanted * across / self.device.mass_kg[0];
        (aside(&self.velocity) + grown <= STRAIGHT && self.velocity.dot(&direction) >= 0.0)
            .then_some(direction)
    }

    fn halt(&mut self, axis: usize) {
        (self.velocity[axis], self.lost[1][axis]) = (0.0, 0.0);
    }

    /// Which laws act, given the hand's force; and whether a device under friction along its motion sets off now.
    fn regime(&self, grip: Grip, hand: &Axes<N>) -> (Regime<N>, bool) {
        let push = self.held_force + hand + self.pushing_force();
        let mut regime = Regime {
            grip,
            rub: Rub::Constant(Axes::zeros()),
            stuck: [false; N],
            pushing: self.pushing,
            straight: None,
        };
        let (lower, upper) = self.device.stops;
        for axis in 0..N {
            let (x, f) = (self.position[axis], push[axis]);
            regime.stuck[axis] = self.velocity[axis] == 0.0
                && ((x <= lower[axis] && f < 0.0) || (x >= upper[axis] && f > 0.0));
        }
        if self.device.rubs_along_motion() {
            let coulomb = self.device.coulomb[0];
            let momentum = self.device.mass_kg.max() * self.velocity.norm();
            let turns_at_once = push.norm() > coulomb
                && momentum < TURNS_AT_ONCE * push.norm()
                && self.velocity.dot(&push) > 0.0;
            if self.velocity.norm() >= STOPPED && !turns_at_once {
                regime.rub = Rub::AlongMotion(coulomb);
                return (regime, false);
            }
            if push.norm() <= coulomb {
                regime.stuck = [true; N];
                return (regime, false);
            }
            regime.rub = Rub::Constant(push * (coulomb / push.norm()));
            return (regime, true);
        }
        let mut friction = Axes::zeros();
        for axis in 0..N {
            let (coulomb, v, f) = (self.device.coulomb[axis], self.velocity[axis], push[axis]);
            if coulomb == 0.0 || regime.stuck[axis] {
                continue;
            }
            if v != 0.0 {
                friction[axis] = coulomb * v.signum();
            } else if f.abs() > coulomb {
                friction[axis] = coulomb * f.signum();
            } else {
                regime.stuck[axis] = true;
            }
        }
        regime.rub = Rub::Constant(friction);
        (regime, false)
    }

    fn pushing_force(&self) -> Axes<N> {
        let mut force = Axes::zeros();
        for (index, wall) in self.walls.iter().enumerate() {
            if self.pushing & (1 << index) != 0 {
                force += wall.normal * wall.push(&self.position, &self.velocity);
            }
        }
        force
    }

    /// When the grip begins or ceases to slip within `duration`.
    fn grip_changes(
        &self,
        stretch: &Stretch<N>,
        grip: Grip,
        strength: [f64; 2],
        duration: f64,
    ) -> Option<f64> {
        if strength[0].is_infinite() || (self.hand.stiffness() == 0.0 && self.hand.damping() == 0.0) {
            return None;
        }
        // Most of the time the grip is far stronger than all that can be wished for within the stretch.
        if grip == Grip::Holds {
            let mut power = 1.0;
            let mut most = 0.0;
            for wish in &stretch.wish {
                most += wish.norm() * power;
                power *= duration;
            }
            if most < strength[0].min(strength[0] + strength[1] * duration) {
                return None;
            }
        }
        let limit = crate::hand::line(strength);
        let margins: [Series; 2] = if N == 1 {
            let wish = stretch.wish.map(|wish| wish[0]);
            [std::array::from_fn(|n| limit[n] - wish[n]), std::array::from_fn(|n| limit[n] + wish[n])]
        } else {
            let (squared, limit) = (squared_norm(&stretch.wish), product(&limit, &limit));
            let margin: Series = std::array::from_fn(|n| limit[n] - squared[n]);
            [margin, margin]
        };
        match grip {
            Grip::Holds => {
                let [a, b] = margins.map(|margin| first_negative(&margin, duration));
                a.into_iter().chain(b).min_by(f64::total_cmp)
            }
            Grip::Slips => {
                // It slips on the side of the wish; there the margin is negative.
                let side = usize::from(N == 1 && stretch.wish[0][0] < 0.0);
                first_negative(&margins[side].map(|term| -term), duration)
            }
        }
    }

    /// The first of the events that end a stretch of `duration`, apart from the grip's.
    fn first_event(&self, stretch: &Stretch<N>, regime: &Regime<N>, duration: f64) -> Option<Event> {
        let mut first: Option<Event> = None;
        let mut consider = |kind: EventKind, margin: &Series| {
            let within = first.map_or(duration, |event| event.at);
            if let Some(at) = first_negative(margin, within)
                && at < within
            {
                first = Some(Event { at, kind });
            }
        };
        let (lower, upper) = self.device.stops;
        for axis in 0..N {
            let push = || stretch.push.map(|push| push[axis]);
            let (x, coulomb) = (self.position[axis], self.device.coulomb[axis]);
            if regime.stuck[axis] && x <= lower[axis] && stretch.push[0][axis] < 0.0 {
                consider(EventKind::SetsOff, &push().map(|term| -term));
            } else if regime.stuck[axis] && x >= upper[axis] && stretch.push[0][axis] > 0.0 {
                consider(EventKind::SetsOff, &push());
            } else if regime.stuck[axis] && (N == 1 || self.device.friction == Friction::Axis) {
                let push = push();
                for sign in [1.0, -1.0] {
                    let mut margin = push.map(|term| sign * term);
                    margin[0] += coulomb;
                    consider(EventKind::SetsOff, &margin);
                }
            } else if let Rub::Constant(friction) = regime.rub
                && friction[axis] != 0.0
                && !self.device.rubs_along_motion()
            {
                let sign = friction[axis].signum();
                consider(EventKind::Turns(axis), &stretch.velocity_along(axis).map(|term| sign * term));
            }
            if lower[axis].is_finite() && !regime.stuck[axis] {
                let mut ahead = stretch.position_along(axis);
                ahead[0] -= lower[axis];
                consider(EventKind::Stop(axis), &ahead);
            }
            if upper[axis].is_finite() && !regime.stuck[axis] {
                let mut ahead = stretch.position_along(axis).map(|term| -term);
                ahead[0] += upper[axis];
                consider(EventKind::Stop(axis), &ahead);
            }
        }
        if let Some(direction) = regime.straight {
            let along = std::array::from_fn(|n| {
                stretch.position.get(n + 1).map_or(0.0, |x| (n + 1) as f64 * direction.dot(x))
            });
            consider(EventKind::Rests, &along);
        }
        if self.device.rubs_along_motion() && regime.stuck == [true; N] {
            let mut margin = squared_norm(&stretch.push).map(|term| -term);
            margin[0] += self.device.coulomb[0] * self.device.coulomb[0];
            consider(EventKind::SetsOff, &margin);
        }
        for (index, wall) in self.walls.iter().enumerate() {
            if wall.is_two_sided {
                continue;
            }
            let (depth, push) = wall.along(&stretch.position);
            if regime.pushing & (1 << index) != 0 {
                consider(EventKind::Leaves(index), &depth);
                if wall.damping > 0.0 {
                    consider(EventKind::Leaves(index), &push);
                }
            } else if depth[0] > 0.0 {
                // Inside a wall that would have to pull. Where it ceased to push, what is left is rounding.
                let mut pulls = push.map(|term| -term);
                pulls[0] += wall.slight(depth[0], &self.velocity);
                consider(EventKind::Meets(index), &pulls);
                consider(EventKind::Leaves(index), &depth);
            } else {
                consider(EventKind::Meets(index), &depth.map(|term| -term));
            }
        }
        first
    }

    /// What an event leaves exactly.
    fn settle(&mut self, kind: EventKind, clock: f64) {
        match kind {
            EventKind::SetsOff => {}
            EventKind::Turns(axis) => self.halt(axis),
            EventKind::Rests => (0..N).for_each(|axis| self.halt(axis)),
            EventKind::Stop(axis) => {
                let (lower, upper) = (self.device.stops.0[axis], self.device.stops.1[axis]);
                let is_lower = self.position[axis] - lower < upper - self.position[axis];
                self.position[axis] = if is_lower { lower } else { upper };
                self.lost[0][axis] = 0.0;
            }
            EventKind::Meets(index) | EventKind::Leaves(index) => {
                let wall = self.walls[index];
                let depth = wall.depth(&self.position);
                if depth.abs() <= 1e-12 * (1.0 + wall.surface.abs()) {
                    // On the surface, exactly.
                    self.position += wall.normal * depth;
                    self.lost[0] = Axes::zeros();
                }
                self.set_pushing(index, matches!(kind, EventKind::Meets(_)), clock);
            }
        }
    }

    fn set_pushing(&mut self, index: usize, pushes: bool, clock: f64) {
        let bit = 1_u64 << index;
        if pushes && self.pushing & bit == 0 {
            self.pushing |= bit;
            self.touch.made_s = Some(clock);
            self.touch.count += 1;
        } else if !pushes && self.pushing & bit != 0 {
            self.pushing &= !bit;
            self.touch.broke_s = Some(clock);
        }
    }

    /// Says of each wall whether it pushes where the device is now, away from its edges.
    fn meet_walls(&mut self, clock: f64) {
        for index in 0..self.walls.len() {
            let wall = self.walls[index];
            if wall.is_two_sided {
                self.pushing |= 1 << index;
                continue;
            }
            let (depth, push) = (wall.depth(&self.position), wall.push(&self.position, &self.velocity));
            // Within rounding of an edge, the event that led there has decided.
            let edge = 1e-15 * (1.0 + wall.surface.abs());
            let slight = wall.slight(depth, &self.velocity);
            if depth > edge && push > slight {
                self.set_pushing(index, true, clock);
            } else if depth < -edge || (depth > edge && push < -slight) {
                self.set_pushing(index, false, clock);
            }
        }
    }

    /// A stop takes the speed that leads into it.
    fn meet_stops(&mut self) {
        let (lower, upper) = self.device.stops;
        for axis in 0..N {
            if self.position[axis] <= lower[axis] {
                self.position[axis] = lower[axis];
                self.velocity[axis] = self.velocity[axis].max(0.0);
            } else if self.position[axis] >= upper[axis] {
                self.position[axis] = upper[axis];
                self.velocity[axis] = self.velocity[axis].min(0.0);
            }
        }
    }
}

/// What ends a stretch.
#[derive(Clone, Copy, Debug, PartialEq)]
enum EventKind {
    /// Friction or a stop no longer holds an axis.
    SetsOff,
    /// The velocity of an axis passes zero.
    Turns(usize),
    /// A device that rubs along its straight motion comes to rest.
    Rests,
    /// An axis meets a stop.
    Stop(usize),
    /// A wall begins to push.
    Meets(usize),
    /// A wall ceases to push.
    Leaves(usize),
}

#[derive(Clone, Copy, Debug, PartialEq)]
struct Event {
    at: f64,
    kind: EventKind,
}

/// What a hand does over a tick in which its grip neither changes nor begins to slip.
struct StandingGrip<const N: usize> {
    /// In N, at the begin of the tick.
    force: Axes<N>,
    /// Stiffness and damping by which that changes with the motion.
    impedance: [f64; 2],
    has_let_go: bool,
}

/// Friction of a tick over which it stands.
struct StandingFriction<const N: usize> {
    /// In N, against the motion.
    force: Axes<N>,
    /// Axes that stick throughout.
    stuck: [bool; N],
    /// The speed in m/s, where the friction is along the motion, which must then stay straight.
    along: Option<f64>,
}

/// What of `along` lies across a direction, a unit vector.
fn across<const N: usize>(direction: &Axes<N>, along: &Axes<N>) -> f64 {
    (along - direction * direction.dot(along)).norm()
}

/// Adds a small step and what earlier steps lost.
///
/// Source: Kahan 1965; the exact error of a sum, Knuth 1969, section 4.2.2.
fn add<const N: usize>(sum: &mut Axes<N>, lost: &mut Axes<N>, step: &Axes<N>) {
    for axis in 0..N {
        let (before, step) = (sum[axis], step[axis] + lost[axis]);
        let after = before + step;
        let taken = after - before;
        lost[axis] = (before - (after - taken)) + (step - taken);
        sum[axis] = after;
    }
}

/// The series of `|w|²`.
fn squared_norm<const N: usize>(w: &[Axes<N>; TERMS]) -> Series {
    std::array::from_fn(|n| (0..=n).map(|i| w[i].dot(&w[n - i])).sum())
}
