//! An arm among springs and planes across the axes. It is linear between contacts on each axis, and is advanced exactly
//! while it stays clear of all other objects.

mod transition;

use transition::{Transition, TransitionMap};

use haptether_numeric::{all_lanes, norm, pack, shared};
use nalgebra::SimdBool as _;

use crate::{
    Axes, Environment, Object, Real,
    arm::drive::{ArmDrive, Tool},
};

/// Longest piece in s.
pub(crate) const LONGEST: f64 = 1e-3;
/// Shortest time in s per event, so that a tick ends.
pub(crate) const SHORTEST: f64 = 1e-12;
/// Steps for one piece before its rest is taken in one step.
const MAX_STEPS: u32 = 20_000;

/// Objects that act on one axis of the tool, without the pushers; of one arm, or of one per lane.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Line<S: Real = f64> {
    planes: Vec<LinePlane<S>>,
    /// Sums over the springs: K in N/m, B in N s/m and K anchor in N.
    spring: [f64; 3],
    regime: Regime<S>,
    /// Bound in m on the distance of x from its value at the start of the tick, if requested; infinity if a contact may
    /// have changed. None between ticks, so it is not part of the state.
    swing: Option<S>,
}

/// Dynamics for one arm and one set of touched planes.
#[derive(Clone, Copy, Debug)]
struct Regime<S> {
    /// M in kg, K in N/m and B in N s/m of the arm; NaN before the first regime.
    arm: [f64; 3],
    /// Total B per kg.
    c: S,
    /// Sum of K anchor and K surface, per kg.
    pull: S,
    transition: Transition<S>,
    /// Longest piece in s in which no contact can hide. An undamped contact lasts pi / sqrt(k); this is half a radian.
    /// Infinite without planes; negative before the first regime.
    longest: S,
    cached: CachedTransition<S>,
}

impl<S: Real> Default for Regime<S> {
    fn default() -> Self {
        let (zero, one) = (S::zero(), S::one());
        let transition = Transition::default();
        Self {
            arm: [f64::NAN; 3],
            c: zero,
            pull: zero,
            transition,
            longest: -one,
            cached: CachedTransition::default(),
        }
    }
}

impl<S> PartialEq for Regime<S> {
    /// Always equal: a regime follows from its inputs and is not part of the state.
    fn eq(&self, _: &Self) -> bool {
        true
    }
}

/// Map of the last whole piece, and its time step, which nearly every tick repeats.
#[derive(Clone, Copy, Debug)]
struct CachedTransition<S> {
    time: f64,
    map: TransitionMap<S>,
}

impl<S: Real> Default for CachedTransition<S> {
    fn default() -> Self {
        Self { time: f64::NAN, map: TransitionMap::default() }
    }
}

impl<S: Real> CachedTransition<S> {
    /// Map of `transition` over `t`; `transition` is that of the regime that owns this.
    #[inline(always)] // nearly every tick finds it
    fn over(&mut self, transition: &Transition<S>, t: f64) -> TransitionMap<S> {
        if self.time != t {
            self.time = t;
            (0..S::LANES).for_each(|lane| self.load(lane, transition));
        }
        self.map
    }

    #[inline(never)] // rare, and long
    fn load(&mut self, lane: usize, transition: &Transition<S>) {
        self.map.load(lane, &transition.of_lane(lane).over(self.time));
    }
}

/// A plane across an axis: `F = max(0, K d + B d')` along its normal.
#[derive(Clone, Copy, Debug, PartialEq)]
struct LinePlane<S = f64> {
    surface: S,
    normal: S,
    stiffness: S,
    damping: S,
    /// [`APART`], [`TOUCHING`] or [`LEAVING`].
    mode: S,
}

const APART: f64 = 0.0;
const TOUCHING: f64 = 1.0;
/// Inside, where the plane would have to pull.
const LEAVING: f64 = 2.0;

impl<S: Real> LinePlane<S> {
    /// Depth of the tool in m, and the mode there.
    #[inline(always)]
    fn mode(&self, [x, v]: [S; 2]) -> (S, S) {
        let depth = self.normal * (self.surface - x);
        let presses = (self.stiffness * depth - self.damping * self.normal * v).simd_gt(S::zero());
        let inside = S::splat(TOUCHING).select(presses, S::splat(LEAVING));
        (depth, S::splat(APART).select(depth.simd_le(S::zero()), inside))
    }
}

/// `x'' = -k x - c x' + u_0 + u_1 t + u_2 t²` from a given state, per kg.
#[derive(Clone, Copy, Debug)]
struct Course<S = f64> {
    transition: Transition<S>,
    /// Coefficients of the particular solution, quadratic in time.
    particular: [S; 3],
    /// State minus the particular solution at t = 0.
    beside: [S; 2],
}

impl Course {
    #[cfg(test)]
    fn new(k: f64, c: f64, input: [f64; 3], state: [f64; 2]) -> Self {
        Self::of(Transition::new(k, c), c, input, state)
    }

    fn at(self, t: f64) -> [f64; 2] {
        self.by(&self.transition.over(t), t)
    }
}

/// An additional input per kg: `slope (s - at)` up to s = `at`.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Bend<S = f64> {
    /// In s.
    pub(crate) at: S,
    /// In m/s³.
    pub(crate) slope: S,
}

impl<S: Real> Course<S> {
    #[inline(always)]
    fn of(transition: Transition<S>, c: S, [u0, u1, u2]: [S; 3], [x, v]: [S; 2]) -> Self {
        // Three divisions in sequence would dominate the cost.
        let (two, per_k) = (S::splat(2.0), transition.per_k);
        let a2 = u2 * per_k;
        let a1 = (u1 - two * c * a2) * per_k;
        let a0 = (u0 - c * a1 - two * a2) * per_k;
        Self { transition, particular: [a0, a1, a2], beside: [x - a0, v - a1] }
    }

    /// State after t, by the map over t.
    #[inline(always)]
    fn by(self, map: &TransitionMap<S>, t: f64) -> [S; 2] {
        let (two, t) = (S::splat(2.0), S::splat(t));
        let [a0, a1, a2] = self.particular;
        let [x, v] = map.apply(self.beside);
        [x + a0 + t * (a1 + t * a2), v + a1 + two * a2 * t]
    }

    /// State after t: the course plus the response to a [`Bend`], from the map over t and the map over the time after
    /// the bend.
    ///
    /// The response to a line `f_0 + f_1 s` from rest is `b_0 + b_1 s` minus the map of `(b_0, b_1)`. Its coefficients
    /// are `b_1 = f_1 / k` and `b_0 = (f_0 - c b_1) / k`. At the bend the line is subtracted again. The two lines then
    /// cancel, and the two maps remain.
    #[inline(always)]
    fn bent(&self, bend: &Bend<S>, c: S, map: &TransitionMap<S>, rest: &TransitionMap<S>, t: f64) -> [S; 2] {
        let per_k = self.transition.per_k;
        let b1 = bend.slope * per_k;
        let from_bend = -c * b1 * per_k;
        let b0 = from_bend - bend.slope * bend.at * per_k;
        let [y, v] = self.beside;
        let [x, v] = Self { beside: [y - b0, v - b1], ..*self }.by(map, t);
        let [more_x, more_v] = rest.apply([from_bend, b1]);
        [x + more_x, v + more_v]
    }

    /// Bounds on `|x(s) - x(0)|` in m and `|x'(s)|` in m/s for s up to t. The difference to the particular solution
    /// satisfies `y'' + c y' + k y = 0`; its energy `y'² + k y²` does not grow for c >= 0.
    #[inline(always)]
    fn bounds(self, t: f64) -> [S; 2] {
        let (two, t) = (S::splat(2.0), S::splat(t));
        let [_, a1, a2] = self.particular;
        let (a1, a2) = (a1.magnitude(), a2.magnitude());
        let [y, v] = self.beside;
        let swing = (v * v + self.transition.k * y * y).root();
        [t * (swing + a1 + t * a2), swing + a1 + two * t * a2]
    }
}

/// The objects of an environment, sorted by axis.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct LinearArm<const N: usize> {
    lines: [Line; N],
    /// Mask of the objects that are on no line.
    apart: Vec<bool>,
    /// True if every object is on a line.
    pub(crate) is_complete: bool,
    pub(crate) coarse_steps: u64,
}

impl<const N: usize> LinearArm<N> {
    /// None unless every axis is linear between contacts with some of the objects.
    pub(crate) fn new(drive: &ArmDrive<N>, environment: &Environment<N>) -> Option<Self> {
        use crate::ArmControl::Velocity;
        let arm = drive.model();
        let (stiffness, ..) = arm.impedance();
        // The particular solution divides by k = K / M; below 1 / s² that would lose digits.
        if matches!(arm.control(), Velocity { .. }) || stiffness < arm.mass_kg() {
            return None;
        }
        if !environment.is_push_linear {
            return None;
        }
        if environment.bodies > 0 {
            // Bodies move, near or not.
            return None;
        }
        let mut lines: [Line; N] = std::array::from_fn(|_| Line::default());
        let apart: Vec<_> = environment.objects.iter().map(|object| !sort(&mut lines, object)).collect();
        let is_complete = !apart.contains(&true);
        Some(Self { lines, apart, is_complete, coarse_steps: 0 })
    }

    /// Objects on each axis.
    pub(crate) fn lines(&self) -> &[Line; N] {
        &self.lines
    }

    /// Like [`LinearArm::advance`] if bounds exclude contact with objects that are on no line. Otherwise the state is
    /// unchanged and the result is false.
    pub(crate) fn advance_clear(
        &mut self,
        drive: &mut ArmDrive<N>,
        environment: &mut Environment<N>,
        tool: &mut Tool<N>,
        from: f64,
        span: f64,
    ) -> bool {
        let room = environment.room(&self.apart, (&tool.position, &tool.velocity), from, span);
        if room <= 2.0 * span * norm(&tool.velocity) {
            // Rarely worth a trial.
            return false;
        }
        let (drive_before, tool_before, coarse_before) = (*drive, *tool, self.coarse_steps);
        if room.is_finite() {
            self.lines.iter_mut().for_each(|line| line.swing = Some(0.0));
        }
        self.advance(drive, environment, tool, from, span);
        let swing = norm(&Axes::<N>::from_fn(|axis, _| self.lines[axis].swing.take().unwrap_or(0.0)));
        let stays_clear = environment.reach.covers(&tool.position, from + span, 0.0) && swing < room;
        if !stays_clear {
            (*drive, *tool, self.coarse_steps) = (drive_before, tool_before, coarse_before);
        }
        stays_clear
    }

    /// Advance the tool by `span` in s from `from` in s.
    pub(crate) fn advance(
        &mut self,
        drive: &mut ArmDrive<N>,
        environment: &mut Environment<N>,
        tool: &mut Tool<N>,
        from: f64,
        span: f64,
    ) {
        let mut done = 0.0;
        while done < span {
            let now = from + done;
            drive.plan();
            let stretch = environment.push_stretch(now);
            let mut end = (done + LONGEST).min(stretch.until - from).min(done + drive.unsteady_phase());
            end = end.max(done + SHORTEST);
            if span - end < SHORTEST {
                end = span;
            }
            let step = end - done;
            let inside = from + 0.5 * (done + end);
            let (push, growth) = environment.linear_push(&stretch, inside, [now, from + end], step);
            let wanted = drive.command_velocity();
            let mass = drive.model().mass_kg();
            let (stiffness, damping, feed_forward) = drive.model().impedance();
            for (axis, line) in self.lines.iter_mut().enumerate() {
                let set = &drive.set_points()[axis];
                let feed = if feed_forward { damping * wanted[axis] } else { 0.0 };
                let input = [
                    (push[axis] + stiffness * set.position + feed) / mass,
                    (growth[axis] + stiffness * set.velocity) / mass,
                    0.5 * stiffness * set.acceleration / mass,
                ];
                let state = [tool.position[axis], tool.velocity[axis]];
                let arm = [mass, stiffness, damping];
                let bend = (set.arrives_steadily() && set.phase < step)
                    .then(|| Bend { at: set.phase, slope: stiffness * set.velocity / mass });
                let (state, whole) = line.advance(arm, input, bend, state, step);
                let finite = state.iter().all(|value| value.is_finite());
                self.coarse_steps += u64::from(!(whole && finite));
                // Overflow: the tool stays at its last position.
                [tool.position[axis], tool.velocity[axis]] =
                    if finite { state } else { [tool.position[axis], 0.0] };
            }
            drive.advance(step);
            done = end;
        }
    }
}

/// Add an object to the axes on which it acts; false if it is not linear.
fn sort<const N: usize>(lines: &mut [Line; N], object: &Object<N>) -> bool {
    let Some((stiffness, damping)) = object.contact().kelvin_voigt() else { return false };
    if !object.is_fixed() {
        return false;
    }
    if object.shape().is_spring() {
        for (line, anchor) in lines.iter_mut().zip(object.shape().reference()) {
            line.spring[0] += stiffness;
            line.spring[1] += damping;
            line.spring[2] += stiffness * anchor;
        }
        return true;
    }
    let Some((axis, surface, normal)) = object.shape().across_axis() else { return false };
    let frictionless = object.contact().friction() == 0.0 || N == 1;
    if frictionless {
        lines[axis].planes.push(LinePlane { surface, normal, stiffness, damping, mode: APART });
    }
    frictionless
}

impl<S: Real> Line<S> {
    /// Lanes without a regime yet; None if the numbers of planes differ.
    pub(crate) fn gather(of: &[&Line]) -> Option<Self> {
        let plane = |index: usize| {
            Some(LinePlane {
                surface: pack(of, |one| one.planes[index].surface)?,
                normal: pack(of, |one| one.planes[index].normal)?,
                stiffness: pack(of, |one| one.planes[index].stiffness)?,
                damping: pack(of, |one| one.planes[index].damping)?,
                mode: S::splat(LEAVING),
            })
        };
        let planes = (0..shared(of, |one| one.planes.len())?).map(plane).collect::<Option<_>>()?;
        Some(Self { planes, spring: [0.0; 3], regime: Regime::default(), swing: None })
    }

    /// Copy the regime of one arm with M, K and B into its lane.
    pub(crate) fn load(&mut self, lane: usize, line: &Line, arm: [f64; 3]) {
        let (regime, of) = (&mut self.regime, &line.regime);
        let mut lasts = of.arm == arm;
        for (plane, of) in self.planes.iter_mut().zip(&line.planes) {
            plane.mode.replace(lane, of.mode);
            lasts &= of.mode != LEAVING;
        }
        regime.c.replace(lane, of.c);
        regime.pull.replace(lane, of.pull);
        regime.transition.load(lane, &of.transition);
        regime.longest.replace(lane, if lasts { of.longest } else { -1.0 });
        regime.cached.load(lane, &regime.transition);
    }

    /// (x, V) after a step in one piece, and the mask of lanes in which no contact may change within it.
    ///
    /// The input per kg is quadratic in time. Where `bends`, it is linear and loses the slope of `bend` at its time. The
    /// result is the course of the input after the bend, plus the response to the difference before the bend.
    #[inline(always)] // once per tick and axis
    pub(crate) fn one_piece(
        &mut self,
        [u0, u1, u2]: [S; 3],
        (bends, bend): (S::SimdBool, &Bend<S>),
        state: [S; 2],
        step: f64,
    ) -> ([S; 2], S::SimdBool) {
        let (zero, Regime { c, pull, transition, longest, .. }) = (S::zero(), self.regime);
        let any_bends = bends.any();
        let [mut later0, mut later1, mut impulse] = [u0, u1, zero];
        if any_bends {
            later0 = (u0 + bend.slope * bend.at).select(bends, u0);
            later1 = (u1 - bend.slope).select(bends, u1);
            // Bound on the integral of |slope (t - bend)|, which is half of it.
            impulse = ((bend.slope * bend.at).magnitude() * bend.at).select(bends, zero);
        }
        // First, so that the course stays in registers: no call follows it.
        let map = self.regime.cached.over(&transition, step);
        let course = Course::of(transition, c, [later0 + pull, later1, u2], state);
        let mut keeps = longest.simd_ge(S::splat(step));
        if !self.planes.is_empty() {
            keeps = keeps & c.simd_ge(zero) & self.stays(&course, state, step, impulse);
        }
        self.add_swing(&course, step, impulse, keeps);
        let mut found = course.by(&map, step);
        if any_bends {
            let (rest, is_exact) = transition.over_each(S::splat(step) - bend.at);
            keeps = keeps & (is_exact | !bends);
            let [bent_x, bent_v] = course.bent(bend, c, &map, &rest, step);
            found = [bent_x.select(bends, found[0]), bent_v.select(bends, found[1])];
        }
        (found, keeps)
    }

    /// Add a bound on the travel in t in s of a course, where no contact changes; `impulse` as in
    /// [`stays`](Self::stays).
    #[inline(always)]
    fn add_swing(&mut self, course: &Course<S>, t: f64, impulse: S, keeps: S::SimdBool) {
        if let Some(swing) = &mut self.swing {
            let [farther, _] = course.bounds(t);
            let most = (farther + impulse * S::splat(t))
                .select(self.regime.c.simd_ge(S::zero()), S::splat(f64::INFINITY));
            *swing += most.select(keeps, S::zero());
        }
    }

    /// Mask of lanes in which bounds exclude a change of contact within t in s on a course from a state, with an
    /// additional input of `impulse` in m/s.
    ///
    /// The response to it is at most `impulse t` and `impulse`, because the response to a unit impulse is at most t and
    /// 1.
    #[inline(always)]
    fn stays(&self, course: &Course<S>, state: [S; 2], t: f64, impulse: S) -> S::SimdBool {
        let [farther, fastest] = course.bounds(t);
        let (farther, fastest) = (farther + impulse * S::splat(t), fastest + impulse);
        let [a0, ..] = course.particular;
        let mut stays = all_lanes::<S>();
        for plane in &self.planes {
            let (depth, mode) = plane.mode(state);
            // Far above the rounding of positions.
            let size = state[0].magnitude() + a0.magnitude() + plane.surface.magnitude();
            let farther = farther + S::splat(1e-12) * size;
            let pushes = plane.stiffness * (depth - farther);
            let touches = mode.simd_eq(S::splat(TOUCHING))
                & pushes.simd_gt(plane.damping * fastest * S::splat(1.0 + 1e-12));
            let is_apart = mode.simd_eq(S::splat(APART)) & (depth + farther).simd_lt(S::zero());
            stays = stays & mode.simd_eq(plane.mode) & (touches | is_apart);
        }
        stays
    }
}

impl Line {
    /// Advance (x, V) by `step` in s under an arm with M, K, B and an input per kg that is quadratic in time, or linear
    /// with a bend. Returns true if every contact was located.
    #[inline(always)] // has one caller
    fn advance(
        &mut self,
        arm: [f64; 3],
        [u0, u1, u2]: [f64; 3],
        bend: Option<Bend>,
        state: [f64; 2],
        step: f64,
    ) -> ([f64; 2], bool) {
        self.renew(arm, state);
        let Bend { at, slope } = bend.unwrap_or(Bend { at: 0.0, slope: 0.0 });
        let (found, keeps) = self.one_piece([u0, u1, u2], (bend.is_some(), &Bend { at, slope }), state, step);
        if keeps {
            return (found, true);
        }
        if bend.is_none() {
            return self.advance_by_pieces(arm, [u0, u1, u2], state, step);
        }
        let (state, before) = self.advance_by_pieces(arm, [u0, u1, 0.0], state, at);
        let [later0, later1] = [u0 + slope * at, u1 - slope];
        let later = [later0 + at * later1, later1, 0.0];
        let (state, after) = self.advance_by_pieces(arm, later, state, step - at);
        (state, before && after)
    }

    /// As [`advance`](Self::advance), from contact to contact.
    #[inline(never)] // rare, and long
    fn advance_by_pieces(
        &mut self,
        arm: [f64; 3],
        [u0, u1, u2]: [f64; 3],
        mut state: [f64; 2],
        step: f64,
    ) -> ([f64; 2], bool) {
        let mut done = 0.0;
        for _ in 0..MAX_STEPS {
            self.renew(arm, state);
            let Regime { c, pull, transition, longest, .. } = self.regime;
            let input = [u0 + done * (u1 + done * u2) + pull, u1 + 2.0 * u2 * done, u2];
            let course = Course::of(transition, c, input, state);
            let left = step - done;
            let longest = left.min(longest);
            if longest >= left && c >= 0.0 && self.stays(&course, state, left, 0.0) {
                self.add_swing(&course, left, 0.0, true);
                // The rest of a step has an arbitrary length: do not keep its map.
                return (course.at(left), true);
            }
            self.swing = self.swing.map(|_| f64::INFINITY);
            let taken = self.first_change(&course, longest).unwrap_or(longest);
            state = course.at(taken);
            if taken >= left {
                return (state, true);
            }
            done += taken;
        }
        (state, false)
    }

    /// Set the regime of a state: the previous one, unless the arm or the set of touched planes has changed.
    #[inline]
    fn renew(&mut self, arm: [f64; 3], state: [f64; 2]) {
        let mut is_same = self.regime.arm == arm;
        for plane in &mut self.planes {
            let (_, mode) = plane.mode(state);
            is_same &= (mode == TOUCHING) == (plane.mode == TOUCHING);
            plane.mode = mode;
        }
        if !is_same {
            self.regime = self.regime_of(arm);
        }
    }

    fn regime_of(&self, arm: [f64; 3]) -> Regime<f64> {
        let [mass, mut stiffness, mut damping] = arm;
        stiffness += self.spring[0];
        damping += self.spring[1];
        let mut pull = self.spring[2];
        for plane in self.planes.iter().filter(|plane| plane.mode == TOUCHING) {
            stiffness += plane.stiffness;
            damping += plane.damping;
            pull += plane.stiffness * plane.surface;
        }
        let (k, c) = (stiffness / mass, damping / mass);
        let longest = if self.planes.is_empty() { f64::INFINITY } else { 0.5 / k.sqrt() };
        let transition = Transition::new(k, c);
        Regime { arm, c, pull: pull / mass, transition, longest, cached: CachedTransition::default() }
    }

    fn changed(&self, state: [f64; 2]) -> bool {
        self.planes.iter().any(|plane| plane.mode(state).1 != plane.mode)
    }

    /// Time in s just after the first change of a contact.
    fn first_change(&self, course: &Course, longest: f64) -> Option<f64> {
        let mut before = 0.0;
        let mut after = [0.25, 0.5, 0.75, 1.0].into_iter().map(|share| share * longest).find(|&t| {
            let found = self.changed(course.at(t));
            before = if found { before } else { t };
            found
        })?;
        while after - before > 1e-15 * longest && after > SHORTEST {
            let middle = 0.5 * (before + after);
            if middle <= before || middle >= after {
                break;
            }
            if self.changed(course.at(middle)) { after = middle } else { before = middle }
        }
        Some(after.max(SHORTEST.min(longest)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    use proptest::prelude::*;

    proptest! {
        /// If the bounds exclude a change of contact, none occurs at any instant of the course.
        #[test]
        fn a_contact_that_stays_by_its_bounds_stays(
            (k, c, x, v) in (1.0..1e5_f64, 0.0..600.0_f64, -0.02..0.02_f64, -1.0..1.0_f64),
            input in (-50.0..50.0_f64, -1e4..1e4_f64, -1e6..1e6_f64),
            (surface, stiffness, damping) in (-0.02..0.02_f64, 100.0..1e5_f64, 0.0..200.0_f64),
            is_above in any::<bool>(),
            t in 1e-5..1e-3_f64,
        ) {
            let normal = if is_above { 1.0 } else { -1.0 };
            let mut plane = LinePlane { surface, normal, stiffness, damping, mode: APART };
            plane.mode = plane.mode([x, v]).1;
            let line = Line { planes: vec![plane], ..Line::default() };
            let course = Course::new(k, c, [input.0, input.1, input.2], [x, v]);
            let [farther, fastest] = course.bounds(t);
            for share in 0..=200 {
                let at = f64::from(share) / 200.0 * t;
                let [moved, speed] = course.at(at);
                prop_assert!((moved - x).abs() <= farther + 1e-12, "{} {}", moved - x, farther);
                prop_assert!(speed.abs() <= fastest * (1.0 + 1e-9) + 1e-9, "{} {}", speed, fastest);
                prop_assert!(!line.stays(&course, [x, v], t, 0.0) || !line.changed([moved, speed]), "{share}");
            }
        }
    }

    proptest! {
        /// A step in one piece is bit-identical to the steps from contact to contact.
        #[test]
        fn one_piece_is_all_pieces(
            (stiffness, damping, x, v) in (0.0..5000.0_f64, 0.0..600.0_f64, -0.02..0.02_f64, -1.0..1.0_f64),
            (u0, u1, u2) in (-50.0..50.0_f64, -1e4..1e4_f64, -1e6..1e6_f64),
            (surface, wall, lost) in (-0.02..0.02_f64, 100.0..1e5_f64, 0.0..200.0_f64),
            normal in prop_oneof![Just(1.0), Just(-1.0)],
            step in prop_oneof![Just(1e-3), 1e-5..1e-3_f64],
        ) {
            let plane = LinePlane { surface, normal, stiffness: wall, damping: lost, mode: APART };
            let line = Line { planes: vec![plane], swing: Some(0.0), ..Line::default() };
            let ([mut one, mut other], arm) = ([line.clone(), line], [2.0, stiffness, damping]);
            let found = one.advance(arm, [u0, u1, u2], None, [x, v], step);
            let expected = other.advance_by_pieces(arm, [u0, u1, u2], [x, v], step);
            prop_assert_eq!(found, expected);
            prop_assert_eq!(one.swing, other.swing);
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(2000))]

        /// An input that bends equals two courses in sequence. If the bounds exclude a change of contact, none occurs
        /// on either.
        #[test]
        fn a_bent_input_is_two_courses(
            [mass, frequency, ratio] in [0.5..10.0_f64, 2.0..40.0_f64, 0.0..2.0_f64],
            (x, v, away) in (-0.02..0.02_f64, -1.0..1.0_f64, -1e-3..1e-3_f64),
            (slower, nearer) in (0.0..5.0_f64, 0.0..6.0_f64),
            (push, growth) in (-20.0..20.0_f64, -1e3..1e3_f64),
            (gap, wall, damping) in (-0.02..0.02_f64, 100.0..1e5_f64, 0.0..200.0_f64),
            (has_wall, is_above) in any::<(bool, bool)>(),
            share in 0.0..1.0_f64,
        ) {
            // Include speeds and gaps small enough for a bend to decide: some um in a step.
            let [v, push, growth] = [v, push, growth].map(|fast| fast * 10_f64.powf(-slower));
            let surface = x + gap * 10_f64.powf(-nearer);
            let rate = std::f64::consts::TAU * frequency;
            let arm = [mass, mass * rate * rate, 2.0 * ratio * mass * rate];
            let normal = if is_above { 1.0 } else { -1.0 };
            let plane = LinePlane { surface, normal, stiffness: wall, damping, mode: APART };
            let line = Line { planes: vec![plane; usize::from(has_wall)], ..Line::default() };
            let step = 1e-3;
            // A set position `away` from its target arrives there at the bend.
            let bend = share * step;
            let speed = away / bend.max(1e-6);
            let slope = arm[1] * speed / mass;
            let input = [(push + arm[1] * (x - away)) / mass, growth / mass + slope, 0.0];
            let state = [x, v];
            let (found, whole) = line.clone().advance(arm, input, Some(Bend { at: bend, slope }), state, step);
            prop_assert!(whole);
            let mut by_halves = line.clone();
            let (middle, _) = by_halves.advance(arm, input, None, state, bend);
            let [u0, u1] = [input[0] + slope * bend, input[1] - slope];
            let (end, _) = by_halves.advance(arm, [u0 + u1 * bend, u1, 0.0], None, middle, step - bend);
            // A few roundings of the terms of the courses: positions, and speeds divided by the rates.
            let risen = growth.abs() / (mass * rate * rate);
            let size =
                x.abs() + v.abs() * step + away.abs() + input[0].abs() / (rate * rate) + (speed.abs() + risen) / rate;
            let unsure = 64.0 * f64::EPSILON * (size + surface.abs());
            prop_assert!((found[0] - end[0]).abs() < unsure, "{found:?} {end:?}");
            let fastest = rate.max((wall / mass).sqrt()).max(arm[2] / mass).max(damping / mass);
            prop_assert!((found[1] - end[1]).abs() < unsure * fastest.max(1.0 / step), "{found:?} {end:?}");

            // The bound on the distance holds everywhere within the step and is tight enough.
            let mut bounded = Line { swing: Some(0.0), ..line.clone() };
            let _ = bounded.advance(arm, input, Some(Bend { at: bend, slope }), state, step);
            let swing = bounded.swing.unwrap();
            prop_assert!(!swing.is_nan() && (has_wall || swing.is_finite()));
            for part in 0..=50 {
                let t = f64::from(part) / 50.0 * step;
                let mut seen = line.clone();
                let (now, _) = seen.advance(arm, input, None, state, t.min(bend));
                let (now, _) = seen.advance(arm, [u0 + u1 * bend, u1, 0.0], None, now, (t - bend).max(0.0));
                prop_assert!((now[0] - x).abs() <= swing + unsure, "{part}: {} {swing}", now[0] - x);
            }
            // The energy of the motion beside the particular solution of the input after the bend bounds its speed.
            let pull = input[0].abs() + (slope * bend).abs();
            let around = rate * (x.abs() + (pull + arm[2] / mass * risen) / (rate * rate));
            let fastest = v.abs() + around + 2.0 * risen + (slope * bend).abs() * bend;
            prop_assert!(has_wall || swing <= step * fastest * (1.0 + 1e-9), "{swing} {}", step * fastest);

            let mut watched = line;
            watched.renew(arm, state);
            let regime = watched.regime;
            let later = [u0 + regime.pull, u1, 0.0];
            let course = Course::of(regime.transition, regime.c, later, state);
            if has_wall && watched.stays(&course, state, step, (slope * bend).abs() * bend) {
                let modes = watched.planes.clone();
                for part in 0..=50 {
                    let t = f64::from(part) / 50.0 * step;
                    let mut seen = watched.clone();
                    let (now, _) = seen.advance(arm, input, None, state, t.min(bend));
                    let (now, _) = seen.advance(arm, [u0 + u1 * bend, u1, 0.0], None, now, (t - bend).max(0.0));
                    prop_assert!(modes[0].mode(now).1 == modes[0].mode, "{part}");
                }
            }
        }
    }

    /// The kept map is that of the requested time, after any earlier request, and is reused for the same time.
    #[test]
    fn a_kept_map_is_that_of_its_time() {
        let (transition, state) = (Transition::new(9.0, 1.0), [0.7, -1.3]);
        let mut cached = CachedTransition::<f64>::default();
        for t in [1e-3, 2e-3, 2e-3, 1e-3] {
            assert_eq!(cached.over(&transition, t).apply(state), transition.apply(t, state), "{t}");
            assert_eq!(cached.time, t);
        }
        // A substituted map is returned, so the map is kept.
        let other = Transition::new(4.0, 1.0).over(1e-3);
        cached.map = other;
        assert_eq!(cached.over(&transition, 1e-3).apply(state), other.apply(state));
        assert_ne!(other.apply(state), transition.apply(1e-3, state));
    }

    /// The regime follows the arm and the touched planes, independent of its history.
    #[test]
    fn a_regime_follows_the_arm_and_what_is_touched() {
        let plane = |surface: f64, normal: f64| LinePlane {
            surface,
            normal,
            stiffness: 3000.0,
            damping: 5.0,
            mode: APART,
        };
        let planes = vec![plane(0.0, 1.0), plane(0.1, -1.0)];
        let mut line = Line { planes, spring: [10.0, 1.0, 0.3], ..Line::default() };
        let arms = [[2.0, 2000.0, 100.0], [3.0, 2000.0, 100.0], [2.0, 2000.0, 90.0]];
        for round in 0..2 {
            for arm in arms {
                for x in [0.05, -0.01, -0.02, 0.11, 0.05, -0.01] {
                    line.renew(arm, [x, 0.0]);
                    let regime = line.regime;
                    let touched = line.planes.iter().filter(|plane| plane.mode == TOUCHING).count();
                    assert_eq!(touched, usize::from(x != 0.05), "{round} {x}");
                    let fresh = line.regime_of(arm);
                    assert_eq!(
                        (regime.arm, regime.c, regime.pull, regime.longest, regime.transition),
                        (fresh.arm, fresh.c, fresh.pull, fresh.longest, fresh.transition)
                    );
                    let stiffness = arm[1] + 10.0 + 3000.0 * f64::from(u8::from(x != 0.05));
                    assert_eq!(regime.transition.k, stiffness / arm[0]);
                    // No map of another regime is left.
                    let map = line.regime.cached.over(&regime.transition, 1e-3);
                    assert_eq!(map.apply([1.0, 2.0]), regime.transition.apply(1e-3, [1.0, 2.0]));
                }
            }
        }
    }

    /// The bounds are tight enough to recognise a tool that is clear of a wall or rests on it.
    #[test]
    fn bounds_tell_of_a_tool_that_is_clear_and_of_one_that_rests() {
        // 2 kg under 2000 N/m and critical damping, on a wall of 3000 N/m at 0 whose normal points up.
        let (mass, arm, wall) = (2.0, 2000.0, 3000.0);
        let damping = 2.0 * f64::sqrt(mass * arm);
        for (x, set_point, touches) in [(0.01, 0.012, false), (-0.004, -0.01, true)] {
            let mut plane =
                LinePlane { surface: 0.0, normal: 1.0, stiffness: wall, damping: 0.0, mode: APART };
            plane.mode = plane.mode([x, 0.0]).1;
            assert_eq!(plane.mode == TOUCHING, touches);
            let line = Line { planes: vec![plane], ..Line::default() };
            let k = (arm + if touches { wall } else { 0.0 }) / mass;
            let course = Course::new(k, damping / mass, [arm * set_point / mass, 0.0, 0.0], [x, 0.0]);
            assert!(line.stays(&course, [x, 0.0], 1e-3, 0.0));
            // They do not exclude the contact of an arriving tool.
            assert!(!line.stays(
                &Course::new(k, damping / mass, [0.0; 3], [1e-4, -1.0]),
                [1e-4, -1.0],
                1e-3,
                0.0
            ));
        }
    }
}
