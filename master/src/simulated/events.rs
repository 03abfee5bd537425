//! Motion of device and hand from event to event; each stretch follows its Taylor series.

use super::{STOPPED, SimulatedMaster, across};
use crate::{
    Axes, Friction,
    direction::squared,
    polynomial::{Series, TERMS, first_negative, product},
    stretch::{Grip, Law, Regime, Rub, Stretch},
};

/// Progress in s below which the next event counts as simultaneous. At a tie (grip strength equal to the
/// load) rounding could return the next event at zero distance forever.
const MIN_PROGRESS: f64 = 1e-9;

/// Simultaneous events allowed; beyond them the motion advances by [`MIN_PROGRESS`].
const MAX_STALLS: u32 = 8;

/// Stretches allowed per advance; beyond them it proceeds in this many equal steps, so that a tick always ends.
const MAX_STRETCHES: u32 = 4096;

/// Fraction of an advance below which a stretch is short, and number of short stretches that mark the motion
/// as stiff. The rest is then taken in as many steps. A transient under stiff damping takes 80, after which
/// [`Law::relaxed`] continues.
const SHORT: f64 = 1.0 / 8192.0;
const MAX_SHORT: u32 = 512;

/// A series with a reach below this fraction of the wanted time marks a stiff motion.
const STIFF_SHARE: f64 = 1.0 / 32.0;

/// Longest stretch in s of a device that starts to move; its direction is that of the force.
const SETTING_OFF: f64 = 1e-6;

/// A slow device turns into the direction of the force within `m |V| / |F|`. Below this time in s it still
/// counts as starting to move: if the force slowly grows past friction, the series of the direction would
/// need ever shorter stretches.
const TURNS_AT_ONCE: f64 = 1e-6;

/// Speed in m/s across the motion below which the motion counts as straight for friction. Even if the device
/// then turns, friction errs by no more than a few times this.
const STRAIGHT: f64 = 1e-15;

impl<const N: usize> SimulatedMaster<N> {
    /// Advances over `duration` in s, stretch by stretch.
    pub(super) fn advance(&mut self, duration: f64) {
        let begun = self.clock.time;
        let clock = self.clock.now_ns as f64 * 1e-9;
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
            let kink = if self.clock.waits { None } else { self.hand.next_kink(self.clock.time) };
            let wanted = (duration - done).min(kink.map_or(f64::INFINITY, |kink| kink - self.clock.time));
            let (taken, to_its_reach) = self.stretch(wanted, least, clock + done);
            // A fast-rotating direction takes short stretches; they count as progress.
            let moves_on = taken >= MIN_PROGRESS || (to_its_reach && taken > 0.0);
            stalls = if moves_on { 0 } else { stalls + 1 };
            short += u32::from(taken < duration * SHORT);
            let reached_kink = taken == wanted && kink.is_some_and(|kink| kink - self.clock.time == wanted);
            done = if taken == duration - done { duration } else { done + taken };
            // Rounding of many small additions must not shift the clock.
            self.clock.time = match kink {
                _ if self.clock.waits => begun,
                Some(kink) if reached_kink => kink,
                // The clock must not fall back behind a past kink.
                _ => self.clock.time.max(begun + done),
            };
        }
    }

    /// Follow one stretch for `wanted` s or until the next event, but at least `least` s. Returns its
    /// length, and whether the reach of its series ended it.
    fn stretch(&mut self, wanted: f64, least: f64, clock: f64) -> (f64, bool) {
        let mut target = self.hand.target_series(self.clock.time);
        let (mut gain, mut strength) = self.hand.grip_line(self.clock.time);
        if self.clock.waits {
            target[1..].fill(Axes::zeros());
            (gain[1], strength[1]) = (0.0, 0.0);
        }
        self.meet_walls(clock);
        let law = Law {
            device: &self.device,
            hand: &self.hand,
            walls: &self.walls,
            held: self.held_force,
            target: &target,
            gain,
            strength,
            wanted,
        };
        let wish = ((target[0] - self.motion.position) * self.hand.stiffness()
            - self.motion.velocity * self.hand.damping())
            * gain[0];
        let norm = wish.norm();
        let mut grip = if norm <= strength[0] { Grip::Holds } else { Grip::Slips };
        let mut stretch = Stretch::new();
        let (mut regime, mut duration, mut setting_off);
        loop {
            let hand = match grip {
                Grip::Slips if norm > 0.0 => wish * (strength[0] / norm),
                _ => wish,
            };
            (regime, setting_off) = self.regime(grip, &hand);
            if self.device.rubs_along_motion()
                && regime.stuck == [false; N]
                && let Some(direction) = self.straight_line(&law, grip, &hand)
            {
                regime.rub = Rub::Constant(direction * self.device.coulomb[0]);
                regime.straight = Some(direction);
                setting_off = false;
            }
            law.follow(&regime, self.motion.position, self.motion.velocity, &mut stretch);
            if stretch.reach < STIFF_SHARE * wanted
                && let Some(relaxed) = law.relaxed(&regime, self.motion.position, self.motion.velocity)
            {
                stretch = relaxed;
            }
            duration = wanted.min(stretch.reach);
            if setting_off {
                duration = duration.min(SETTING_OFF);
            }
            let slips_at = self.grip_changes(&stretch, grip, strength, duration);
            if grip == Grip::Holds && slips_at == Some(0.0) && norm > 0.0 {
                // The strength equals the load and falls at once.
                grip = Grip::Slips;
                continue;
            }
            duration = slips_at.unwrap_or(duration).max(least).min(wanted);
            break;
        }
        let (event, moved, gained);
        if duration > stretch.reach {
            // Beyond the reach only the first terms are meaningful; events are handled where the step ends.
            event = None;
            (moved, gained) = law.coarse_step(&regime, &stretch, duration);
        } else {
            event = self.first_event(&stretch, &regime, duration);
            duration = event.map_or(duration, |event| event.at).max(least).min(wanted);
            (moved, gained) = (stretch.displacement(duration), stretch.speed_gained(duration));
        }
        self.motion.add(&moved, &gained);
        for axis in 0..N {
            if regime.stuck[axis] {
                self.halt(axis);
            }
        }
        if let Some(event) = event {
            self.settle(event.kind, clock + duration);
        }
        if let Rub::AlongMotion(coulomb) = regime.rub
            && self.motion.velocity.norm() < STOPPED
            && !setting_off
            && stretch.push[0].norm() <= coulomb
        {
            (0..N).for_each(|axis| self.halt(axis));
        }
        self.meet_stops();
        (duration, event.is_none() && duration == stretch.reach)
    }

    /// Direction of a device with friction along its motion, if it moves or starts to move on a straight line
    /// for `wanted` s. Its friction is then constant until it stops.
    fn straight_line(&self, law: &Law<N>, grip: Grip, hand: &Axes<N>) -> Option<Axes<N>> {
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
        let speed = self.motion.velocity.norm();
        let direction = if speed >= STOPPED { self.motion.velocity / speed } else { push / push.norm() };
        let aside = |along: &Axes<N>| across(&direction, along);
        let (mut across, mut power) = (aside(&push), 1.0);
        if holds_on {
            for term in &law.target[1..] {
                power *= law.wanted;
                across += law.gain[0] * self.hand.stiffness() * aside(term) * power;
            }
        }
        // Within the reach of a series, no speed exceeds twice what its force alone would give.
        let grown = 2.0 * law.wanted * across / self.device.mass_kg[0];
        (aside(&self.motion.velocity) + grown <= STRAIGHT && self.motion.velocity.dot(&direction) >= 0.0)
            .then_some(direction)
    }

    /// Laws that act, given the hand's force; and whether a device with friction along its motion starts to
    /// move now.
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
            let (x, f) = (self.motion.position[axis], push[axis]);
            regime.stuck[axis] = self.motion.velocity[axis] == 0.0
                && ((x <= lower[axis] && f < 0.0) || (x >= upper[axis] && f > 0.0));
        }
        if self.device.rubs_along_motion() {
            let coulomb = self.device.coulomb[0];
            let momentum = self.device.mass_kg.max() * self.motion.velocity.norm();
            let turns_at_once = push.norm() > coulomb
                && momentum < TURNS_AT_ONCE * push.norm()
                && self.motion.velocity.dot(&push) > 0.0;
            if self.motion.velocity.norm() >= STOPPED && !turns_at_once {
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
            let (coulomb, v, f) = (self.device.coulomb[axis], self.motion.velocity[axis], push[axis]);
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
                force += wall.normal * wall.push(&self.motion.position, &self.motion.velocity);
            }
        }
        force
    }

    /// Time within `duration` at which the grip begins or ceases to slip.
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
        if grip == Grip::Slips && strength == [0.0; 2] {
            // A released hand exerts no force, whatever its wish.
            return None;
        }
        // Usually the grip is far stronger than any wish within the stretch.
        if grip == Grip::Holds {
            let mut power = 1.0;
            let mut most = 0.0;
            for wish in &stretch.wish {
                // Upper bound of the norm, without a root.
                most += wish.iter().map(|wish| wish.abs()).sum::<f64>() * power;
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
                // It slips on the side of the wish, where the margin is negative.
                let side = usize::from(N == 1 && stretch.wish[0][0] < 0.0);
                first_negative(&margins[side].map(|term| -term), duration)
            }
        }
    }

    /// First event that ends a stretch of `duration`, other than a change of the grip.
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
            let (x, coulomb) = (self.motion.position[axis], self.device.coulomb[axis]);
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
                // Inside a wall that would have to pull. A remainder after it ceased to push is rounding.
                let mut pulls = push.map(|term| -term);
                pulls[0] += wall.slight(depth[0], &self.motion.velocity);
                consider(EventKind::Meets(index), &pulls);
                consider(EventKind::Leaves(index), &depth);
            } else {
                consider(EventKind::Meets(index), &depth.map(|term| -term));
            }
        }
        first
    }

    /// Set the exact state after an event.
    fn settle(&mut self, kind: EventKind, clock: f64) {
        match kind {
            EventKind::SetsOff => {}
            EventKind::Turns(axis) => self.halt(axis),
            EventKind::Rests => (0..N).for_each(|axis| self.halt(axis)),
            EventKind::Stop(axis) => {
                let (lower, upper) = (self.device.stops.0[axis], self.device.stops.1[axis]);
                let is_lower = self.motion.position[axis] - lower < upper - self.motion.position[axis];
                self.motion.position[axis] = if is_lower { lower } else { upper };
                self.motion.lost[0][axis] = 0.0;
            }
            EventKind::Meets(index) | EventKind::Leaves(index) => {
                let wall = self.walls[index];
                let depth = wall.depth(&self.motion.position);
                if depth.abs() <= 1e-12 * (1.0 + wall.surface.abs()) {
                    // Exactly on the surface.
                    self.motion.position += wall.normal * depth;
                    self.motion.lost[0] = Axes::zeros();
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

    /// Updates for each wall whether it pushes at the current position, away from its edges.
    fn meet_walls(&mut self, clock: f64) {
        for index in 0..self.walls.len() {
            let wall = self.walls[index];
            if wall.is_two_sided {
                self.pushing |= 1 << index;
                continue;
            }
            let (depth, push) =
                (wall.depth(&self.motion.position), wall.push(&self.motion.position, &self.motion.velocity));
            // Within rounding of an edge, the preceding event has decided.
            let edge = 1e-15 * (1.0 + wall.surface.abs());
            let slight = wall.slight(depth, &self.motion.velocity);
            if depth > edge && push > slight {
                self.set_pushing(index, true, clock);
            } else if depth < -edge || (depth > edge && push < -slight) {
                self.set_pushing(index, false, clock);
            }
        }
    }

    /// A stop absorbs the speed directed into it.
    fn meet_stops(&mut self) {
        let (lower, upper) = self.device.stops;
        for axis in 0..N {
            if self.motion.position[axis] <= lower[axis] {
                self.motion.position[axis] = lower[axis];
                self.motion.velocity[axis] = self.motion.velocity[axis].max(0.0);
            } else if self.motion.position[axis] >= upper[axis] {
                self.motion.position[axis] = upper[axis];
                self.motion.velocity[axis] = self.motion.velocity[axis].min(0.0);
            }
        }
    }
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum EventKind {
    /// Friction or a stop no longer holds an axis.
    SetsOff,
    /// The velocity of an axis passes zero.
    Turns(usize),
    /// A device with friction along its straight motion comes to rest.
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

fn squared_norm<const N: usize>(w: &[Axes<N>; TERMS]) -> Series {
    std::array::from_fn(|n| squared(w, n))
}
