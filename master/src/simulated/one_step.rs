//! A whole tick of device and hand in one step, if bounds on the motion exclude an event: the linear map of
//! [`Propagator`], or the series of a motion that friction bends (`bend.rs`).

use haptether_numeric::{all_lanes, no_lanes, norm};
use nalgebra::SimdBool as _;

use super::{Clock, Motion, STOPPED, SimulatedMaster, across, add_one, bend::MAX_CHANGE};
use crate::{
    Axes, Real,
    propagator::{AxisPropagator, Propagator},
};

/// Devices and hands at the start of a tick.
pub(super) struct OneStep<'a, const N: usize, S: Real> {
    pub(super) clock: &'a Clock<N>,
    /// Tick length in s.
    pub(super) duration: f64,
    pub(super) motion: &'a Motion<N, S>,
    /// Force of the motors in N.
    pub(super) held_force: &'a Axes<N, S>,
    /// `K_h` in N/m and `B_h` in N s/m.
    pub(super) impedance: [S; 2],
    /// Grip strength in N.
    pub(super) strength: S,
    /// b in N s/m, c in N and stops in m.
    pub(super) viscous: &'a Axes<N, S>,
    pub(super) coulomb: &'a Axes<N, S>,
    pub(super) stops: [&'a Axes<N, S>; 2],
}

/// Hand over a tick in which its grip neither changes nor begins to slip.
pub(super) struct StandingGrip<const N: usize, S: Real> {
    /// Force in N at the start of the tick.
    pub(super) force: Axes<N, S>,
    /// Stiffness and damping that change this force with the motion.
    pub(super) impedance: [S; 2],
    has_let_go: bool,
}

/// Friction constant over a tick.
pub(super) struct StandingFriction<const N: usize, S: Real> {
    /// Friction in N, against the motion.
    force: Axes<N, S>,
    /// Axes stuck throughout the tick.
    stuck: [S::SimdBool; N],
    /// Speed in m/s, if friction acts along the motion.
    along: Option<S>,
}

/// Shift of the target within a tick.
pub(super) struct Shift<const N: usize> {
    /// Largest shift by path and tremor along each axis, in m.
    most: Axes<N>,
    /// Sine and cosine of the tremor at the start, if the hand trembles.
    wave: Option<[f64; 2]>,
}

/// Course of a motion over a tick.
pub(super) enum Bend<const N: usize, S: Real> {
    Straight,
    /// A bend: changes of x in m and V in m/s, and the largest change of the friction over m, in m/s².
    Bends([Axes<N, S>; 2], S),
}

impl<const N: usize> Clock<N> {
    /// True if the target moves along its path.
    pub(super) fn moves(&self) -> bool {
        !self.waits && self.forecast.moves
    }

    /// Shift of the target within `duration` in s; `shakes` in m is the part of a tremor, if the hand trembles.
    #[inline(always)]
    pub(super) fn shift(&self, duration: f64, shakes: Option<f64>) -> Shift<N> {
        let mut most = Axes::<N>::repeat(shakes.unwrap_or(0.0));
        if self.moves() {
            most += self.forecast.most_moved(duration);
        }
        Shift { most, wave: shakes.map(|_| self.forecast.wave) }
    }
}

impl<const N: usize, S: Real> OneStep<'_, N, S> {
    /// Force of the hands in N with unlimited strength.
    #[inline(always)]
    pub(super) fn wish(&self) -> Axes<N, S> {
        let Motion { position, velocity, .. } = self.motion;
        let ([stiffness, damping], [gain, _]) = (self.impedance, self.clock.forecast.grip[0]);
        let mut wish = *position;
        for axis in 0..N {
            let away = S::splat(self.clock.forecast.target[axis]) - position[axis];
            wish[axis] = (away * stiffness - velocity[axis] * damping) * S::splat(gain);
        }
        wish
    }

    /// Force of hands that hold or have released, and the mask of lanes that it stands for. It does not if the
    /// wish of a released hand is exactly zero: the series decides.
    #[inline(always)]
    pub(super) fn standing_grip(&self) -> (StandingGrip<N, S>, S::SimdBool) {
        let (zero, force) = (S::zero(), self.wish());
        let [[gain, _], [strength, _]] = self.clock.forecast.grip;
        if strength != 0.0 {
            let impedance = [S::splat(gain) * self.impedance[0], S::splat(gain) * self.impedance[1]];
            return (StandingGrip { force, impedance, has_let_go: false }, all_lanes::<S>());
        }
        let pulls = force.iter().fold(no_lanes::<S>(), |any, x| any | x.simd_ne(zero));
        let stays = (self.impedance[0] + self.impedance[1]).simd_eq(zero) | pulls;
        (StandingGrip { force: Axes::zeros(), impedance: [zero; 2], has_let_go: true }, stays)
    }

    /// Present push of motors and hands in N.
    #[inline(always)]
    pub(super) fn push(&self, grip: &StandingGrip<N, S>) -> Axes<N, S> {
        let mut push = *self.held_force;
        for axis in 0..N {
            push[axis] += grip.force[axis];
        }
        push
    }

    /// Friction on each axis over a tick in which no stuck axis breaks loose, and the mask of lanes in which
    /// bounds decide so.
    #[inline(always)]
    pub(super) fn standing_friction(
        &self,
        push: &Axes<N, S>,
        grip: &StandingGrip<N, S>,
        shift: &Shift<N>,
    ) -> (StandingFriction<N, S>, S::SimdBool) {
        let (zero, mut stays) = (S::zero(), all_lanes::<S>());
        let mut found = StandingFriction { force: Axes::zeros(), stuck: [no_lanes::<S>(); N], along: None };
        for axis in 0..N {
            let (coulomb, v) = (self.coulomb[axis], self.motion.velocity[axis]);
            let (rubs, moving) = (coulomb.simd_ne(zero), v.simd_ne(zero));
            let holds = (push[axis].magnitude() + grip.most_pulled(shift, axis))
                .simd_le(coulomb * S::splat(1.0 - 1e-12));
            found.stuck[axis] = rubs & !moving & holds;
            stays = stays & (!rubs | moving | found.stuck[axis]);
            found.force[axis] = coulomb.select(v.simd_gt(zero), -coulomb).select(rubs & moving, zero);
        }
        (found, stays)
    }

    /// Acceleration in m/s² at the start of the tick.
    #[inline(always)]
    pub(super) fn acceleration(
        &self,
        maps: &[AxisPropagator<S>; N],
        push: &Axes<N, S>,
        friction: &StandingFriction<N, S>,
    ) -> Axes<N, S> {
        let mut acceleration = *push;
        for axis in 0..N {
            let damped = self.viscous[axis] * self.motion.velocity[axis];
            acceleration[axis] = (push[axis] - friction.force[axis] - damped) * maps[axis].inverse_mass;
        }
        acceleration
    }

    /// Motion after the tick, the most that each axis has moved in m, and the mask of lanes without an event in
    /// the tick, walls aside.
    #[inline(always)]
    pub(super) fn moved(
        &self,
        maps: &[AxisPropagator<S>; N],
        grip: &StandingGrip<N, S>,
        friction: &StandingFriction<N, S>,
        shift: &Shift<N>,
        acceleration: &Axes<N, S>,
        bend: &Bend<N, S>,
    ) -> (Motion<N, S>, Axes<N, S>, S::SimdBool) {
        let (zero, above) = (S::zero(), S::splat(1.0 + 1e-12));
        let (mut after, mut stays, step) = (*self.motion, all_lanes::<S>(), S::splat(self.duration));
        let (mut most_moved, mut most_gained) = (Axes::<N, S>::zeros(), Axes::<N, S>::zeros());
        let (moves, forecast) = (self.clock.moves(), &self.clock.forecast);
        for axis in 0..N {
            let (x, v, map) = (after.position[axis], after.velocity[axis], &maps[axis]);
            let (a, rub, stuck) = (acceleration[axis], friction.force[axis], friction.stuck[axis]);
            let [lower, upper] = self.stops.map(|stops| stops[axis]);
            let rests = x.simd_gt(lower) & x.simd_lt(upper);
            let Motion { position, velocity, lost: [lost_x, lost_v] } = &mut after;
            let (x_after, v_after) = (&mut position[axis], &mut velocity[axis]);
            let (lost_x, lost_v) = (&mut lost_x[axis], &mut lost_v[axis]);
            if S::LANES == 1 && stuck.all() {
                stays = stays & rests;
                add_one(x_after, lost_x, zero);
                (*v_after, *lost_v) = (zero, zero);
                continue;
            }
            let turned = if let Bend::Bends(_, turned) = bend { *turned } else { zero };
            let target = map.pull * S::splat(shift.most[axis]) + turned;
            let [farther, faster] = map.bounds(a, v, target, step);
            let [moved, gained] = if let Bend::Bends([moved, gained], _) = bend {
                [moved[axis], gained[axis]]
            } else {
                let e = map.change(a, v, moves.then(|| forecast.path_of(axis)), shift.wave);
                [v * step + e[0], e[1]]
            };
            // Friction along an axis may change its sign here.
            let turns = rub.simd_ne(zero) & v.magnitude().simd_le(faster);
            if friction.along.is_none() && (S::LANES > 1 || turns.any()) {
                let bends = map.damping.magnitude() * faster + map.pull * farther + target;
                let is_monotone = (a.magnitude() * S::splat(1.0 - 1e-12)).simd_gt(bends);
                let forward = (v + gained).select(v.simd_gt(zero), -(v + gained));
                let goes_on = is_monotone & forward.simd_gt(S::splat(1e-12) * faster);
                stays = stays & (stuck | !turns | goes_on);
            }
            let clear = (x - farther).simd_gt(lower) & (x + farther).simd_lt(upper);
            stays = stays & ((stuck & rests) | (!stuck & clear));
            most_moved[axis] = zero.select(stuck, farther);
            most_gained[axis] = zero.select(stuck, faster);
            add_one(x_after, lost_x, zero.select(stuck, moved));
            add_one(v_after, lost_v, zero.select(stuck, gained));
            *v_after = zero.select(stuck, *v_after);
            *lost_v = zero.select(stuck, *lost_v);
        }
        let is_unlimited = S::LANES == 1 && self.strength.extract(0).is_infinite();
        if !grip.has_let_go && !is_unlimited {
            let farther = most_moved.zip_map(&shift.most, |moved, shift| S::splat(shift) + moved);
            let change = grip.impedance[0] * norm(&farther) + grip.impedance[1] * norm(&most_gained);
            let slips = ((norm(&grip.force) + change) * above).simd_ge(self.strength);
            stays = stays & !slips;
        }
        (after, most_moved, stays)
    }
}

impl<const N: usize, S: Real> StandingGrip<N, S> {
    /// The most that the target may add to the push along an axis, in N.
    #[inline(always)]
    fn most_pulled(&self, shift: &Shift<N>, axis: usize) -> S {
        S::splat(shift.most[axis]) * (self.impedance[0] * S::splat(1.0 + 1e-12))
    }
}

impl<const N: usize> SimulatedMaster<N> {
    /// Device and hand at the start of a tick of `duration` in s.
    #[inline(always)]
    pub(super) fn one_step(&self, duration: f64) -> OneStep<'_, N, f64> {
        OneStep {
            clock: &self.clock,
            duration,
            motion: &self.motion,
            held_force: &self.held_force,
            impedance: [self.hand.stiffness(), self.hand.damping()],
            strength: self.clock.forecast.grip[1][0],
            viscous: &self.device.viscous,
            coulomb: &self.device.coulomb,
            stops: [&self.device.stops.0, &self.device.stops.1],
        }
    }

    /// Advance a tick in one step if bounds exclude an event and all laws are linear, except for the direction
    /// of friction. Otherwise changes nothing and returns false. An unnecessary refusal costs time, never
    /// accuracy.
    #[inline]
    pub(super) fn propagates(&mut self, duration: f64, past_ns: u64) -> bool {
        #[cfg(test)]
        if self.follows_series_only {
            return false;
        }
        if self.pushing != 0 || !self.clock.is_smooth(past_ns) {
            return false;
        }
        let (grip, is_pulled) = self.one_step(duration).standing_grip();
        if !is_pulled {
            return false;
        }
        if !self.propagator.is_of(duration, grip.impedance) {
            self.propagator = Propagator::new(&self.device, &self.hand, grip.impedance, duration);
        }
        let (map, wave) = (&self.propagator, self.clock.forecast.wave);
        if !map.reaches {
            return false;
        }
        let trembles = !self.clock.waits && map.shakes[1] > 0.0;
        let shakes = trembles.then(|| wave[0].abs() * map.shakes[0] + wave[1].abs() * map.shakes[1]);
        let (step, shift) = (self.one_step(duration), self.clock.shift(duration, shakes));
        let push = step.push(&grip);
        let (friction, stays) = if self.device.rubs_along_motion() {
            let most_pulled = Axes::from_fn(|axis, _| grip.most_pulled(&shift, axis));
            self.friction_along_motion(&push, &most_pulled)
        } else {
            step.standing_friction(&push, &grip, &shift)
        };
        if !stays {
            return false;
        }
        let acceleration = step.acceleration(&map.axes, &push, &friction);
        let bend = match friction.along {
            Some(speed) => self.bend(&acceleration, speed, shakes, duration),
            None => Some(Bend::Straight),
        };
        let Some(bend) = bend else {
            return false;
        };
        let (motion, most_moved, stays) =
            step.moved(&map.axes, &grip, &friction, &shift, &acceleration, &bend);
        if !(stays && self.stays_clear(&most_moved)) {
            return false;
        }
        self.motion = motion;
        #[cfg(test)]
        {
            self.propagated += 1;
        }
        true
    }

    /// True if no continuous wall is within reach of a motion of at most `most_moved` along each axis.
    #[inline(always)]
    fn stays_clear(&self, most_moved: &Axes<N>) -> bool {
        self.walls.is_empty() || self.keeps_off_walls(most_moved)
    }

    fn keeps_off_walls(&self, most_moved: &Axes<N>) -> bool {
        self.walls.iter().all(|wall| {
            let room = -wall.depth(&self.motion.position) - 1e-15 * (1.0 + wall.surface.abs());
            !wall.is_two_sided && norm(most_moved) * (1.0 + 1e-12) < room
        })
    }

    /// Friction along the motion, as [`OneStep::standing_friction`]; the target may add at most `most_pulled` in
    /// N.
    #[inline]
    fn friction_along_motion(
        &self,
        push: &Axes<N>,
        most_pulled: &Axes<N>,
    ) -> (StandingFriction<N, f64>, bool) {
        let (v, coulomb) = (&self.motion.velocity, self.device.coulomb[0]);
        let speed = norm(v);
        if speed == 0.0 {
            let stuck = StandingFriction { force: Axes::zeros(), stuck: [true; N], along: None };
            return (stuck, norm(push) + norm(most_pulled) <= coulomb * (1.0 - 1e-12));
        }
        let force = v * (coulomb / speed);
        let stays = speed >= STOPPED && self.propagator.is_isotropic;
        (StandingFriction { force, stuck: [false; N], along: Some(speed) }, stays)
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
    ) -> Option<Bend<N, f64>> {
        let moves = self.clock.moves();
        let shakes = shaking.unwrap_or(0.0);
        let (map, one) = (&self.propagator, &self.propagator.axes[0]);
        let direction = self.motion.velocity / speed;
        let aside = |along: &Axes<N>| across(&direction, along);
        let (mut moved, mut moved_aside) = (0.0, 0.0);
        if shakes > 0.0 {
            let all = Axes::<N>::repeat(1.0);
            moved += shakes * (N as f64).sqrt();
            moved_aside += shakes * aside(&all);
        }
        if moves {
            let mut power = 1.0;
            for term in &self.clock.forecast.path[1..] {
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
        // A turning friction changes by at most twice its magnitude.
        let turns = 2.0 * friction;
        self.bent(acceleration, speed, moves, shaking.is_some()).map(|changes| Bend::Bends(changes, turns))
    }
}
