//! Everything that acts on the tool: objects in contact and pushers.

use haptether_numeric::norm;

use crate::{
    Axes, Object, Push, Pusher, amax,
    contact::law::{Mode, Reaction},
    solver::state::Solver,
};

/// Objects and pushers.
///
/// Time is in s. The time of the pushers starts at 0 unless [`Environment::push_from`] changes it. Position and
/// velocity are those of the tool, in m and m/s; force acts on the tool, in N.
#[derive(Clone, Debug, PartialEq)]
pub struct Environment<const N: usize> {
    pub(crate) objects: Vec<Object<N>>,
    pub(crate) pushers: Vec<Pusher<N>>,
    /// Origin of the time of the pushers; infinity for never.
    push_from: f64,
    stretch: Stretch<N>,
    pub(crate) reach: Reach<N>,
    /// Piece of the contact law that each object is on; `Apart` if it is not near.
    pub(crate) modes: Vec<Mode>,
    /// Slots of the near free bodies in the state of the solver.
    pub(crate) slots: Vec<usize>,
    pub(crate) solver: Solver<N>,
    /// Indices of the objects with a prescribed motion.
    movers: Vec<usize>,
    /// Number of free bodies.
    pub(crate) bodies: usize,
    /// True if every push is linear in time between its kinks.
    pub(crate) is_push_linear: bool,
    /// Index of the pusher for pushes during the run.
    asked: Option<usize>,
    touches: bool,
}

impl<const N: usize> Environment<N> {
    /// Objects, indexed in this order, and pushers.
    pub fn new(objects: Vec<Object<N>>, pushers: Vec<Pusher<N>>) -> Self {
        let bodies = objects.iter().filter(|object| object.body().is_some()).count();
        // Near or not: an object may come near between two kinks.
        let movers = (0..objects.len()).filter(|&index| objects[index].moves()).collect();
        Self {
            push_from: 0.0,
            stretch: Stretch::NONE,
            reach: Reach::new(objects.len()),
            modes: vec![Mode::Apart; objects.len()],
            slots: vec![usize::MAX; objects.len()],
            solver: Solver::new(bodies),
            bodies,
            is_push_linear: pushers.iter().all(Pusher::is_piecewise_linear),
            movers,
            asked: None,
            touches: false,
            objects,
            pushers,
        }
    }

    /// An environment without objects and pushers.
    pub fn empty() -> Self {
        Self::new(Vec::new(), Vec::new())
    }

    /// The same environment with a place for a push during the run.
    #[must_use]
    pub fn to_be_pushed(mut self) -> Self {
        self.asked = Some(self.pushers.len());
        self.pushers.push(Pusher::asked(&Push { force_n: Axes::zeros(), duration_s: 0.0 }, 0.0));
        self
    }

    /// Push the tool from `time_s` on, instead of the last such push. False if the environment takes no pushes, the
    /// time of the pushers has not begun, or the push is invalid.
    pub fn ask(&mut self, push: &Push<N>, time_s: f64) -> bool {
        let since_s = time_s - self.push_from;
        let Some(index) = self.asked.filter(|_| push.check().is_ok() && since_s.is_finite()) else {
            return false;
        };
        self.pushers[index] = Pusher::asked(push, since_s);
        self.stretch = Stretch::NONE;
        true
    }

    /// Start the time of the pushers at `time_s`; infinity means never.
    pub fn push_from(&mut self, time_s: f64) {
        let push_from = if time_s.is_nan() { f64::INFINITY } else { time_s };
        if push_from != self.push_from {
            (self.push_from, self.stretch) = (push_from, Stretch::NONE);
        }
    }

    /// Force of objects and pushers on the tool in N at one instant, with free bodies in their present state.
    pub fn force(&mut self, position: &Axes<N>, velocity: &Axes<N>, time_s: f64) -> Axes<N> {
        self.keep_near(position, velocity, time_s);
        let near = self.reach.near.iter().copied();
        let push = self.push_at(time_s);
        let (force, touches) = self.force_of(push, near, position, velocity, time_s);
        self.touches = touches;
        force
    }

    /// Force of the pushers on the tool in N at one instant.
    #[inline]
    pub(crate) fn push_at(&self, time_s: f64) -> Axes<N> {
        match self.stretch.steady {
            Some(push) if self.stretch.holds(time_s) => push,
            _ => self.push(time_s, time_s),
        }
    }

    /// Push in N at the start of a step of `step` in s within a stretch, and its growth in N/s. `inside` is any time
    /// strictly within the step.
    #[inline]
    pub(crate) fn linear_push(
        &self,
        stretch: &Stretch<N>,
        inside: f64,
        [begin, end]: [f64; 2],
        step: f64,
    ) -> (Axes<N>, Axes<N>) {
        if let Some(push) = stretch.steady {
            return (push, Axes::zeros());
        }
        let push = self.push(inside, begin);
        (push, (self.push(inside, end) - push) / step)
    }

    /// True if the tool was inside an object at the last computation of the force; a spring has no inside.
    pub fn touches(&self) -> bool {
        self.touches
    }

    /// The same force, computed over all objects, near or not: the reference for [`Environment::force`].
    pub fn force_of_all(&self, position: &Axes<N>, velocity: &Axes<N>, time_s: f64) -> Axes<N> {
        let push = self.push(time_s, time_s);
        self.force_of(push, 0..self.objects.len(), position, velocity, time_s).0
    }

    /// Position in m of object `index` if it is a free body: the point of its plane, its centre or its anchor.
    pub fn body_position(&self, index: usize) -> Option<Axes<N>> {
        let object = self.objects.get(index)?;
        Some(object.shape().reference() + object.body()?.displacement)
    }

    /// V in m/s of object `index`, if it is a free body.
    pub fn body_velocity(&self, index: usize) -> Option<Axes<N>> {
        Some(self.objects.get(index)?.body()?.velocity)
    }

    /// Number of steps so far that were too stiff for full accuracy and used a stable method of order 1.
    pub fn coarse_steps(&self) -> u64 {
        self.solver.coarse_steps
    }

    /// Ensure that all objects within reach at this position are among the near ones.
    pub(crate) fn keep_near(&mut self, position: &Axes<N>, velocity: &Axes<N>, time_s: f64) {
        if !self.reach.covers(position, time_s, 0.0) {
            self.look(position, velocity, time_s);
        }
    }

    pub(crate) fn look(&mut self, position: &Axes<N>, velocity: &Axes<N>, time_s: f64) {
        for &index in &self.reach.near {
            self.modes[index] = Mode::Apart;
            self.slots[index] = usize::MAX;
        }
        // A wide radius saves a fast tool a new search in each of the next steps.
        self.reach.look(&self.objects, position, time_s, 16e-3 * norm(velocity));
        let mut slot = 0;
        for &index in &self.reach.near {
            if self.objects[index].body().is_some() {
                self.slots[index] = slot;
                slot += 1;
            }
        }
    }

    /// Distance in m that the tool may move within `span` in s before it touches a near object of the mask `apart`.
    ///
    /// Infinity without such an object; 0 if an object that is not near could be touched at up to twice the tool's
    /// speed.
    pub(crate) fn room(
        &mut self,
        apart: &[bool],
        (position, velocity): (&Axes<N>, &Axes<N>),
        time_s: f64,
        span: f64,
    ) -> f64 {
        let margin = 2.0 * span * norm(velocity);
        if !self.reach.covers(position, time_s + span, margin) {
            self.look(position, velocity, time_s);
            if !self.reach.covers(position, time_s + span, margin) {
                return 0.0;
            }
        }
        let near = self.reach.near.iter().filter(|&&index| apart[index]);
        near.fold(f64::INFINITY, |room, &index| {
            let object = &self.objects[index];
            let (displacement, _) = object.place(time_s, time_s);
            let (distance, _) = object.shape().surface(&(position - displacement));
            // Distances carry the rounding of positions.
            let rounding = 1e-12 * (amax(position) + object.shape().extent());
            room.min(distance - object.top_speed() * span - rounding)
        })
    }

    pub(crate) fn push_time(&self, time_s: f64) -> f64 {
        if self.push_from.is_finite() { time_s - self.push_from } else { f64::NEG_INFINITY }
    }

    pub(crate) fn push(&self, piece: f64, time_s: f64) -> Axes<N> {
        let (piece, t) = (self.push_time(piece), self.push_time(time_s));
        self.pushers.iter().map(|pusher| pusher.on(piece, t)).sum()
    }

    /// Stretch without a kink of the push that contains `time_s`; computed once per stretch.
    #[inline]
    pub(crate) fn push_stretch(&mut self, time_s: f64) -> Stretch<N> {
        if !self.stretch.holds(time_s) {
            self.stretch = self.stretch_from(time_s);
        }
        self.stretch
    }

    fn stretch_from(&self, time_s: f64) -> Stretch<N> {
        let until = self.next_push_kink(time_s);
        // Any time strictly within; times count in whole ns.
        let inside = 0.5 * (time_s + until.min(time_s + 1.0));
        let level = |pusher: &Pusher<N>| pusher.level_on(self.push_time(inside));
        let is_clear = until - time_s > 4.0 * ROUNDING;
        let steady = if is_clear { self.pushers.iter().map(level).sum() } else { None };
        // A kink less than 1 ns ahead counts as passed.
        Stretch { from: time_s + ROUNDING, until, steady }
    }

    /// First time after `time_s` at which a push has a kink.
    pub(crate) fn next_push_kink(&self, time_s: f64) -> f64 {
        let mut next = f64::INFINITY;
        if self.push_from.is_finite() {
            let t = self.push_time(time_s);
            for pusher in &self.pushers {
                next = next.min(pusher.next_kink(t) + self.push_from);
            }
        }
        next
    }

    /// First kink after `time_s` of a force or motion that depends on time only.
    pub(crate) fn next_kink(&self, time_s: f64) -> f64 {
        let mut next = self.next_push_kink(time_s);
        for &index in &self.movers {
            next = next.min(self.objects[index].next_kink(time_s));
        }
        next
    }

    /// Sum of `push`, the force of the pushers, and the forces of `objects`; true if the tool is inside one of them.
    fn force_of(
        &self,
        push: Axes<N>,
        objects: impl Iterator<Item = usize>,
        position: &Axes<N>,
        velocity: &Axes<N>,
        time_s: f64,
    ) -> (Axes<N>, bool) {
        let mut force = push;
        let mut touches = false;
        for index in objects {
            let object = &self.objects[index];
            let (displacement, moving) = object.place(time_s, time_s);
            let (place, slip) = (position - displacement, velocity - moving);
            if object.shape().is_spring() {
                force += self.pull(index, &place, &slip);
                continue;
            }
            let (distance, normal) = object.shape().surface(&place);
            let mode = object.contact().mode(-distance, -normal.dot(&slip));
            touches |= mode != Mode::Apart;
            if mode == Mode::Touching {
                force += object.contact().force(mode, distance, &normal, &slip);
            }
        }
        (force, touches)
    }

    /// Force of object `index`, a spring.
    fn pull(&self, index: usize, place: &Axes<N>, velocity: &Axes<N>) -> Axes<N> {
        let object = &self.objects[index];
        let (stiffness, damping) = object.contact().linear();
        (object.shape().reference() - place) * stiffness - velocity * damping
    }

    /// Force of object `index` on its present smooth piece of the contact law.
    pub(crate) fn smooth(&self, index: usize, place: &Axes<N>, velocity: &Axes<N>) -> Axes<N> {
        let object = &self.objects[index];
        if object.shape().is_spring() {
            return self.pull(index, place, velocity);
        }
        let (distance, normal) = object.shape().surface(place);
        object.contact().force(self.modes[index], distance, &normal, velocity)
    }

    /// Piece of its contact law that object `index` is on, and the distance to it in m.
    pub(crate) fn mode(&self, index: usize, place: &Axes<N>, velocity: &Axes<N>) -> (Mode, f64) {
        let object = &self.objects[index];
        if object.shape().is_spring() {
            return (Mode::Touching, f64::NEG_INFINITY);
        }
        let (distance, normal) = object.shape().surface(place);
        (object.contact().mode(-distance, -normal.dot(velocity)), distance)
    }

    /// Force of object `index` and its slopes. A spring acts along all axes alike, so it has `drag` too.
    pub(crate) fn linearised(
        &self,
        index: usize,
        place: &Axes<N>,
        velocity: &Axes<N>,
    ) -> Option<Reaction<N>> {
        let object = &self.objects[index];
        if object.shape().is_spring() {
            let (stiffness, damping) = object.contact().linear();
            let force = self.pull(index, place, velocity);
            return Some(Reaction { force, normal: Axes::zeros(), stiffness, damping, drag: damping });
        }
        let (distance, normal) = object.shape().surface(place);
        object.contact().reaction(distance, &normal, velocity)
    }
}

/// Times in s that are closer than this may be the same tick: windows count in whole ns.
const ROUNDING: f64 = 1e-9;

/// Interval of time without a kink of the push.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Stretch<const N: usize> {
    from: f64,
    /// Time of the next kink.
    pub(crate) until: f64,
    /// Push in N, if it is constant in the interval.
    pub(crate) steady: Option<Axes<N>>,
}

impl<const N: usize> Stretch<N> {
    /// An empty stretch.
    const NONE: Self = Self { from: f64::INFINITY, until: f64::NEG_INFINITY, steady: None };

    /// True if the time lies in the stretch, clear of its ends.
    #[inline]
    fn holds(&self, time_s: f64) -> bool {
        self.from <= time_s && time_s < self.until - ROUNDING
    }
}

impl<const N: usize> PartialEq for Stretch<N> {
    /// Always equal: a stretch follows from pushers and time and is not part of the state.
    fn eq(&self, _: &Self) -> bool {
        true
    }
}

/// Distance in m within which an object is checked in every step.
const NEAR: f64 = 0.01;

/// The objects near a position, and the distance to all others.
///
/// An object at distance d cannot be touched before tool and object together have moved by d. All others are skipped
/// until the path of the tool plus that of the fastest object reaches the smallest distance. A skipped object would
/// exert no force.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Reach<const N: usize> {
    /// In the order of the objects, so that the order of summation does not depend on which are skipped.
    pub(crate) near: Vec<usize>,
    place: Axes<N>,
    time: f64,
    /// Smallest distance in m to an object that is not near; negative before the first search.
    clearance: f64,
    /// Top speed in m/s of the objects that are not near.
    speed: f64,
}

impl<const N: usize> Reach<N> {
    pub(crate) fn new(objects: usize) -> Self {
        let near = Vec::with_capacity(objects);
        Self { near, place: Axes::zeros(), time: 0.0, clearance: -1.0, speed: 0.0 }
    }

    /// True if only near objects can be touched within `margin` in m of `place` in m, at `time` in s.
    pub(crate) fn covers(&self, place: &Axes<N>, time: f64, margin: f64) -> bool {
        norm(&(place - self.place)) + self.speed * (time - self.time).abs() + margin < self.clearance
    }

    /// Search all objects again; objects within about `radius` in m become near.
    pub(crate) fn look(&mut self, objects: &[Object<N>], place: &Axes<N>, time: f64, radius: f64) {
        let radius = radius.max(NEAR);
        self.near.clear();
        self.place = *place;
        self.time = time;
        self.clearance = f64::INFINITY;
        self.speed = 0.0;
        for (index, object) in objects.iter().enumerate() {
            let (displacement, _) = object.place(time, time);
            let clearance = object.shape().clearance(&(place - displacement));
            if clearance < radius {
                self.near.push(index);
            } else {
                self.clearance = self.clearance.min(clearance);
                self.speed = self.speed.max(object.top_speed());
            }
        }
        if self.clearance.is_finite() {
            // Distances carry rounding; a few more near objects cost little.
            self.clearance -= 1e-9 * self.clearance + 1e-14 * place.norm();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::contact::pusher::{PushShape, Series};
    use proptest::prelude::*;

    fn pusher(kind: u8, at_s: f64, duration_s: f64, rise_s: f64) -> Pusher<1> {
        let force = Axes::<1>::new(-3.0);
        let shape = match kind {
            0 => PushShape::Step,
            1 => PushShape::Ramp { rise_s },
            2 => PushShape::HalfSine,
            _ => {
                let rows = [0.0, 7.3, 7.3, -0.1].map(Axes::<1>::new).to_vec();
                let series = Series::new(vec![0.0, 0.5 * rise_s, rise_s, 2.0 * rise_s], rows).unwrap();
                return Pusher::recorded(series, at_s, duration_s).unwrap();
            }
        };
        Pusher::shaped(shape, at_s, duration_s, force).unwrap()
    }

    proptest! {
        /// The push of a stretch equals the push computed at each instant, for any origin of its time.
        #[test]
        fn a_push_that_stands_is_the_push_of_each_instant(
            pushers in prop::collection::vec((0_u8..4, 0_u32..400, 0_u32..400, 1_u32..100), 0..4),
            begins_ms in prop::option::of(-50_i32..50),
            // Half of the cases at whole ms, like kinks.
            (unit_us, steps) in (prop::sample::select(vec![7, 1000]), prop::collection::vec(1_u32..30, 1..200)),
            off_ns in prop::sample::select(vec![0.0, 0.4, -0.4, 10.0, -10.0]),
        ) {
            let ms = |ms: u32| f64::from(ms) * 1e-3;
            let of = pushers.iter().map(|&(kind, at, lasts, rise)| pusher(kind, ms(at), ms(lasts), ms(rise)));
            let mut environment = Environment::new(Vec::new(), of.collect());
            environment.push_from(begins_ms.map_or(f64::INFINITY, |begins| f64::from(begins) * 1e-3));
            let mut now = 0.0;
            for step in steps {
                now += f64::from(step * unit_us) * 1e-6;
                let at = now + off_ns * 1e-9;
                let stretch = environment.push_stretch(at);
                prop_assert_eq!(stretch.until, environment.next_push_kink(at));
                let [x, v] = [Axes::<1>::zeros(); 2];
                prop_assert_eq!(environment.force(&x, &v, at), environment.push(at, at));
                if let Some(push) = stretch.steady {
                    let inside = 0.5 * (at + stretch.until.min(at + 1e-3));
                    prop_assert_eq!(push, environment.push(inside, at));
                }
            }
        }
    }

    #[test]
    fn push_asked_for_acts_from_its_time_and_replaces_the_last() {
        let mut environment = Environment::new(Vec::new(), vec![pusher(0, 0.1, 0.2, 0.0)]).to_be_pushed();
        let [x, v] = [Axes::<1>::zeros(); 2];
        let push = |force: f64| Push { force_n: Axes::<1>::new(force), duration_s: 0.5 };
        environment.push_from(f64::INFINITY);
        assert!(!environment.ask(&push(2.0), 0.5), "the time of the pushers has not begun");
        environment.push_from(1.0);
        assert!(environment.ask(&push(2.0), 2.0) && environment.is_push_linear);
        for (at, force) in [(1.15, -3.0), (1.999, 0.0), (2.0, 2.0), (2.499, 2.0), (2.5, 0.0)] {
            assert_eq!(environment.force(&x, &v, at)[0], force, "{at}");
        }
        assert!(environment.ask(&push(5.0), 2.1) && environment.ask(&push(7.0), 2.3));
        for (at, force) in [(2.2, 0.0), (2.3, 7.0), (2.79, 7.0), (2.8, 0.0)] {
            assert_eq!(environment.force(&x, &v, at)[0], force, "{at}");
        }
        for invalid in [push(30.1), push(f64::NAN), Push { duration_s: 0.009, ..push(1.0) }] {
            assert!(!environment.ask(&invalid, 3.0));
        }
        assert!(!Environment::empty().ask(&push(1.0), 3.0), "an environment that takes no pushes");
    }

    #[test]
    fn stretch_is_kept_until_its_origin_changes() {
        let mut environment = Environment::new(Vec::new(), vec![pusher(0, 0.1, 0.2, 0.0)]);
        environment.push_from(1.0);
        for (at, until, push) in
            [(0.5, 1.1, 0.0), (1.0, 1.1, 0.0), (1.2, 1.3, -3.0), (1.4, f64::INFINITY, 0.0)]
        {
            let stretch = environment.push_stretch(at);
            assert_eq!((stretch.until, stretch.steady.map(|push| push[0])), (until, Some(push)), "{at}");
        }
        assert_eq!(environment.push_stretch(9.0).from, 1.4 + ROUNDING);
        environment.push_from(1.0);
        assert_eq!(environment.push_stretch(9.0).from, 1.4 + ROUNDING);
        environment.push_from(8.8);
        assert_eq!(environment.push_stretch(9.0).steady, Some(Axes::<1>::new(-3.0)));
    }
}
