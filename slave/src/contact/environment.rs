//! Everything that acts on the tool: objects that are touched and pushers.

use crate::{
    Axes, Object, Pusher, amax,
    contact::law::{Mode, Reaction},
    norm,
    solver::state::Solver,
};

/// Objects and pushers.
///
/// Time is in s; that of the pushers begins at 0 too, unless [`Environment::push_from`] says otherwise. A position and
/// a velocity are those of the tool, in m and m/s; a force is that on the tool, in N.
#[derive(Clone, Debug, PartialEq)]
pub struct Environment<const N: usize> {
    pub(crate) objects: Vec<Object<N>>,
    pub(crate) pushers: Vec<Pusher<N>>,
    /// When the time of the pushers begins; never, if infinite.
    push_from: f64,
    stretch: Stretch<N>,
    pub(crate) reach: Reach<N>,
    /// On which piece of its law each object is; apart, if it is not near.
    pub(crate) modes: Vec<Mode>,
    /// Where the free bodies that are near stand in the state of the solver.
    pub(crate) slots: Vec<usize>,
    pub(crate) solver: Solver<N>,
    /// The objects that move on their own.
    movers: Vec<usize>,
    /// How many objects are free bodies.
    pub(crate) bodies: usize,
    /// Whether every push is linear in time between its kinks.
    pub(crate) is_push_linear: bool,
    touches: bool,
}

impl<const N: usize> Environment<N> {
    /// Objects, in an order that numbers them, and pushers.
    pub fn new(objects: Vec<Object<N>>, pushers: Vec<Pusher<N>>) -> Self {
        let bodies = objects.iter().filter(|object| object.body().is_some()).count();
        // Near or not: one may come near between two kinks.
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
            touches: false,
            objects,
            pushers,
        }
    }

    /// Nothing.
    pub fn empty() -> Self {
        Self::new(Vec::new(), Vec::new())
    }

    /// The time of the pushers begins at `time_s`; infinity is never.
    pub fn push_from(&mut self, time_s: f64) {
        let push_from = if time_s.is_nan() { f64::INFINITY } else { time_s };
        if push_from != self.push_from {
            (self.push_from, self.stretch) = (push_from, Stretch::NONE);
        }
    }

    /// Force of objects and pushers on the tool in N at one instant; free bodies as they are now.
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

    /// The push in N at the begin of a piece of `step` in s within a stretch, and by how much it grows in N/s; `inside` is any
    /// time of the piece clear of its ends.
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

    /// Whether the tool was inside an object when the force was last computed; a spring has no inside.
    pub fn touches(&self) -> bool {
        self.touches
    }

    /// The same force from every object, near or not: what [`Environment::force`] is held to.
    pub fn force_of_all(&self, position: &Axes<N>, velocity: &Axes<N>, time_s: f64) -> Axes<N> {
        let push = self.push(time_s, time_s);
        self.force_of(push, 0..self.objects.len(), position, velocity, time_s).0
    }

    /// Where object `index` is in m, if it is a free body: its plane's point, its centre or its anchor.
    pub fn body_position(&self, index: usize) -> Option<Axes<N>> {
        let object = self.objects.get(index)?;
        Some(object.shape().reference() + object.body()?.displacement)
    }

    /// V in m/s of object `index`, if it is a free body.
    pub fn body_velocity(&self, index: usize) -> Option<Axes<N>> {
        Some(self.objects.get(index)?.body()?.velocity)
    }

    /// Step so far that were too stiff to be followed to full accuracy and were taken by a stable method of
    /// order 1.
    pub fn coarse_steps(&self) -> u64 {
        self.solver.coarse_steps
    }

    /// Make sure that all objects that could be touched here are among the near ones.
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
        // Far enough that a fast tool does not look again in each of the next steps.
        self.reach.look(&self.objects, position, time_s, 16e-3 * norm(velocity));
        let mut slot = 0;
        for &index in &self.reach.near {
            if self.objects[index].body().is_some() {
                self.slots[index] = slot;
                slot += 1;
            }
        }
    }

    /// How far in m the tool may move within `span` in s before it touches one of the objects `apart` that are near,
    /// infinity where none is; 0 where one that is not near may be touched at up to twice its speed.
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
            // Distances carry the rounding of places.
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

    /// The stretch of time that `time_s` lies in, in which the push has no kink; looked for once for each.
    #[inline]
    pub(crate) fn push_stretch(&mut self, time_s: f64) -> Stretch<N> {
        if !self.stretch.holds(time_s) {
            self.stretch = self.stretch_from(time_s);
        }
        self.stretch
    }

    fn stretch_from(&self, time_s: f64) -> Stretch<N> {
        let until = self.next_push_kink(time_s);
        // Any time of it clear of its ends; they count in whole ns.
        let inside = 0.5 * (time_s + until.min(time_s + 1.0));
        let level = |pusher: &Pusher<N>| pusher.level_on(self.push_time(inside));
        let is_clear = until - time_s > 4.0 * ROUNDING;
        let steady = if is_clear { self.pushers.iter().map(level).sum() } else { None };
        // A kink less than a ns ahead counts as passed.
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

    /// First time after `time_s` at which a force or a motion that depends on time alone has a kink.
    pub(crate) fn next_kink(&self, time_s: f64) -> f64 {
        let mut next = self.next_push_kink(time_s);
        for &index in &self.movers {
            next = next.min(self.objects[index].next_kink(time_s));
        }
        next
    }

    /// `push`, the force of the pushers, and that of some objects, and whether the tool is inside one of these.
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

    /// Force of the spring that object `index` is.
    fn pull(&self, index: usize, place: &Axes<N>, velocity: &Axes<N>) -> Axes<N> {
        let object = &self.objects[index];
        let (stiffness, damping) = object.contact().linear();
        (object.shape().reference() - place) * stiffness - velocity * damping
    }

    /// Force of object `index` on the smooth piece that its law is on.
    pub(crate) fn smooth(&self, index: usize, place: &Axes<N>, velocity: &Axes<N>) -> Axes<N> {
        let object = &self.objects[index];
        if object.shape().is_spring() {
            return self.pull(index, place, velocity);
        }
        let (distance, normal) = object.shape().surface(place);
        object.contact().force(self.modes[index], distance, &normal, velocity)
    }

    /// On which piece of its law object `index` is.
    pub(crate) fn mode(&self, index: usize, place: &Axes<N>, velocity: &Axes<N>) -> Mode {
        let object = &self.objects[index];
        if object.shape().is_spring() {
            return Mode::Touching;
        }
        let (distance, normal) = object.shape().surface(place);
        object.contact().mode(-distance, -normal.dot(velocity))
    }

    /// Force of object `index` and its slopes; of a spring, which acts along all axes alike, with `drag` too.
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

/// A stretch of time without a kink of the push.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Stretch<const N: usize> {
    from: f64,
    /// The next kink.
    pub(crate) until: f64,
    /// The push in N, where it is the same all along.
    pub(crate) steady: Option<Axes<N>>,
}

impl<const N: usize> Stretch<N> {
    /// No time lies in it.
    const NONE: Self = Self { from: f64::INFINITY, until: f64::NEG_INFINITY, steady: None };

    /// Whether a time lies in it, clear of its ends.
    #[inline]
    fn holds(&self, time_s: f64) -> bool {
        self.from <= time_s && time_s < self.until - ROUNDING
    }
}

impl<const N: usize> PartialEq for Stretch<N> {
    /// It follows from pushers and time, and is no part of a state.
    fn eq(&self, _: &Self) -> bool {
        true
    }
}

/// Distance in m within which an object is looked at in every step.
const NEAR: f64 = 0.01;

/// The objects near a place, and how far anything may move before another one can be touched.
///
/// An object at distance d cannot be touched before tool and object have moved by d between them. So all others are
/// left alone until the tool's way and the fastest object's way together reach the smallest of their distances: what is
/// left out would have exerted no force.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Reach<const N: usize> {
    /// In the order of the objects, so that forces are added in the same order as without leaving any out.
    pub(crate) near: Vec<usize>,
    place: Axes<N>,
    time: f64,
    /// Least distance in m among those that are not near; negative before the first look.
    clearance: f64,
    /// Top speed in m/s among those that are not near.
    speed: f64,
}

impl<const N: usize> Reach<N> {
    pub(crate) fn new(objects: usize) -> Self {
        let near = Vec::with_capacity(objects);
        Self { near, place: Axes::zeros(), time: 0.0, clearance: -1.0, speed: 0.0 }
    }

    /// Whether none but the near objects can be touched at `place` in m, `time` in s, nor within `margin` in m of it.
    pub(crate) fn covers(&self, place: &Axes<N>, time: f64, margin: f64) -> bool {
        norm(&(place - self.place)) + self.speed * (time - self.time).abs() + margin < self.clearance
    }

    /// Looks at all objects again; those within `radius` in m, or a little more, are near.
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
            // Distances carry rounding; what is near costs little.
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
        /// Within a stretch the push is what it is where it is looked for at each instant, whenever time begins.
        #[test]
        fn a_push_that_stands_is_the_push_of_each_instant(
            pushers in prop::collection::vec((0_u8..4, 0_u32..400, 0_u32..400, 1_u32..100), 0..4),
            begins_ms in prop::option::of(-50_i32..50),
            // Half of the cases at whole ms, as kinks are.
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
    fn it_is_looked_for_once_for_each_stretch_and_anew_for_another_beginning() {
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
