//! A whole tick of device and hand in one step, if bounds on the motion exclude an event: the linear map of
//! [`Propagator`], or the series of a motion that friction bends (`bend.rs`).

use super::{STOPPED, SimulatedMaster, across, add, bend::MAX_CHANGE};
use crate::{Axes, axes::norm, propagator::Propagator};

impl<const N: usize> SimulatedMaster<N> {
    /// Advance a tick of `duration` in one step if bounds exclude an event and all laws are linear, except
    /// for the direction of friction. Otherwise changes nothing and returns false. An unnecessary refusal
    /// costs time, never accuracy.
    #[inline]
    pub(super) fn propagates(&mut self, duration: f64, past_ns: u64) -> bool {
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
        let (shakes, shift) = self.target_shift(moves, trembles);
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
        let shaking = trembles.then_some(shakes);
        let bend =
            along.map_or(Some(Bend::Straight), |speed| self.bend(&acceleration, speed, shaking, duration));
        let Some(bend) = bend else {
            return false;
        };
        // A turning friction changes by at most twice its magnitude.
        let turns =
            if matches!(bend, Bend::Bends(_)) { 2.0 * self.device.coulomb[0] * inverse_mass[0] } else { 0.0 };
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
            let target = map.pull * shift[axis] + turns;
            let [farther, faster] = map.bounds(a, v, target, duration);
            (moved[axis], gained[axis]) = if let Bend::Bends([moved, gained]) = &bend {
                (moved[axis], gained[axis])
            } else {
                let path = moves.then(|| outlook.path_of(axis));
                let e = map.change(a, v, path, trembles.then_some(outlook.wave));
                (v * duration + e[0], e[1])
            };
            if friction[axis] != 0.0 && !rubs_along && v.abs() <= faster {
                let bends = map.damping.abs() * faster + map.pull * farther + target;
                let is_monotone = a.abs() * (1.0 - 1e-12) > bends;
                if !is_monotone || (v + gained[axis]) * v.signum() <= 1e-12 * faster {
                    return false;
                }
            }
            if !(x - farther > lower[axis] && x + farther < upper[axis]) {
                return false;
            }
            (most_moved[axis], most_gained[axis]) = (farther, faster);
        }
        if !has_let_go && strength[0].is_finite() {
            let change = impedance[0] * norm(&(shift + most_moved)) + impedance[1] * norm(&most_gained);
            if (norm(&wish) + change) * (1.0 + 1e-12) >= strength[0] {
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

    /// Largest shift of the target within the tick by the tremor, and by tremor and path along each axis, in
    /// m.
    #[inline]
    fn target_shift(&self, moves: bool, trembles: bool) -> (f64, Axes<N>) {
        let (map, outlook) = (&self.propagator, &self.outlook);
        let shakes = if trembles {
            outlook.wave[0].abs() * map.shakes[0] + outlook.wave[1].abs() * map.shakes[1]
        } else {
            0.0
        };
        let mut shift = Axes::<N>::repeat(shakes);
        if moves {
            shift += outlook.most_moved(map.duration());
        }
        (shakes, shift)
    }

    /// Changes position and velocity with compensated rounding, and halts stuck axes.
    #[inline(always)]
    fn move_by(&mut self, moved: &Axes<N>, gained: &Axes<N>, stuck: &[bool; N]) {
        add(&mut self.position, &mut self.lost[0], moved);
        add(&mut self.velocity, &mut self.lost[1], gained);
        for (axis, is_stuck) in stuck.iter().enumerate() {
            if *is_stuck {
                self.halt(axis);
            }
        }
    }

    /// True if no continuous wall is within reach of a motion of at most `most_moved` along each axis.
    #[inline(always)]
    fn stays_clear(&self, most_moved: &Axes<N>) -> bool {
        self.walls.is_empty() || self.keeps_off_walls(most_moved)
    }

    fn keeps_off_walls(&self, most_moved: &Axes<N>) -> bool {
        self.walls.iter().all(|wall| {
            let room = -wall.depth(&self.position) - 1e-15 * (1.0 + wall.surface.abs());
            !wall.is_two_sided && norm(most_moved) * (1.0 + 1e-12) < room
        })
    }

    /// Force of a hand that holds or has released. None if the wish of a released hand is exactly
    /// zero: the series decides.
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

    /// Friction over a tick in which no stuck axis breaks loose. `push` is the present push in N,
    /// `most_pulled` the most that the hand's target may add. None if bounds cannot decide.
    #[inline]
    fn standing_friction(&self, push: &Axes<N>, most_pulled: &Axes<N>) -> Option<StandingFriction<N>> {
        let mut found = StandingFriction { force: Axes::zeros(), stuck: [false; N], along: None };
        let v = &self.velocity;
        if self.device.rubs_along_motion() {
            let coulomb = self.device.coulomb[0];
            let speed = norm(v);
            if speed == 0.0 {
                found.stuck = [true; N];
                return (norm(push) + norm(most_pulled) <= coulomb * (1.0 - 1e-12)).then_some(found);
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

    /// Course of a motion with friction along it over a tick; none if it may come to rest or turn too far.
    ///
    /// It counts as straight if rounding hides the rest. The speed across the motion grows to at most P,
    /// friction turns by `P / |V|`, and that moves V by `c dT P / (m |V|)`.
    #[inline]
    fn bend(
        &self,
        acceleration: &Axes<N>,
        speed: f64,
        shaking: Option<f64>,
        duration: f64,
    ) -> Option<Bend<N>> {
        let moves = !self.waits && self.outlook.moves;
        let shakes = shaking.unwrap_or(0.0);
        let (map, one) = (&self.propagator, &self.propagator.axes[0]);
        let direction = self.velocity / speed;
        let aside = |along: &Axes<N>| across(&direction, along);
        let (mut moved, mut moved_aside) = (0.0, 0.0);
        if shakes > 0.0 {
            let all = Axes::<N>::repeat(1.0);
            moved += shakes * (N as f64).sqrt();
            moved_aside += shakes * aside(&all);
        }
        if moves {
            let mut power = 1.0;
            for term in &self.outlook.path[1..] {
                power *= duration;
                moved += term.norm() * power;
                moved_aside += aside(term) * power;
            }
        }
        debug_assert!(map.is_isotropic);
        let friction = self.device.coulomb[0] * one.inverse_mass;
        let most = norm(acceleration) + one.pull * (duration * speed + moved);
        let faster = one.most * most * (1.0 + 1e-12);
        let least = speed - faster;
        let across = one.most * (aside(acceleration) + one.pull * moved_aside);
        let slip = friction * duration * across;
        if least > STOPPED && slip <= f64::EPSILON / 16.0 * least {
            return Some(Bend::Straight);
        }
        if one.most * (most + 2.0 * friction) >= MAX_CHANGE * speed {
            return None;
        }
        self.bent(acceleration, speed, moves, shaking.is_some()).map(Bend::Bends)
    }
}

/// Course of a motion over a tick.
enum Bend<const N: usize> {
    Straight,
    /// A bend: changes of x in m and V in m/s.
    Bends([Axes<N>; 2]),
}

/// Hand over a tick in which its grip neither changes nor begins to slip.
struct StandingGrip<const N: usize> {
    /// Force in N at the start of the tick.
    force: Axes<N>,
    /// Stiffness and damping that change this force with the motion.
    impedance: [f64; 2],
    has_let_go: bool,
}

/// Friction constant over a tick.
struct StandingFriction<const N: usize> {
    /// Friction in N, against the motion.
    force: Axes<N>,
    /// Axes stuck throughout the tick.
    stuck: [bool; N],
    /// Speed in m/s, if friction acts along the motion.
    along: Option<f64>,
}
