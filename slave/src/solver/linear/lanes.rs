//! One axis of several arms in lanes, over pieces without a change of contact.

use nalgebra::SimdBool as _;

use super::{
    Bend, Course, Line,
    transition::{NEARLY_CRITICAL, REACH, Transition, TransitionMap},
};
use crate::{Real, contact::law::Mode};

/// A plane across the axis, one per arm.
#[derive(Clone, Debug)]
struct PlaneLanes<S: Real> {
    surface: S,
    normal: S,
    stiffness: S,
    damping: S,
    /// 1 if it is touched in the present regime, else 0.
    touched: S,
}

/// Objects that act on one axis of several tools, without the pushers, and the dynamics while no contact changes.
#[derive(Clone, Debug)]
pub(crate) struct LineLanes<S: Real> {
    planes: Vec<PlaneLanes<S>>,
    c: S,
    pull: S,
    transition: Transition<S>,
    /// Map over a piece of `step` in s.
    map: TransitionMap<S>,
    step: f64,
    /// Longest piece in s in which no contact can hide; negative without a valid regime.
    longest: S,
}

impl<S: Real> LineLanes<S> {
    /// Lanes without a regime; none unless all have the same number of planes.
    pub(crate) fn gather(of: &[&Line]) -> Option<Self> {
        let planes = of.first()?.planes.len();
        if of.iter().any(|one| one.planes.len() != planes) {
            return None;
        }
        let (zero, one) = (S::zero(), S::one());
        let plane = PlaneLanes { surface: zero, normal: one, stiffness: zero, damping: zero, touched: zero };
        let transition = Transition { k: one, per_k: one, half: zero, discriminant: zero };
        Some(Self {
            planes: vec![plane; planes],
            c: zero,
            pull: zero,
            transition,
            map: TransitionMap { k: one, from_y: one, from_v: zero, sine: zero },
            step: 0.0,
            longest: -one,
        })
    }

    /// Copy the regime of one arm with M, K and B, as its last piece left it.
    pub(crate) fn load(&mut self, lane: usize, line: &Line, arm: [f64; 3]) {
        let regime = &line.regime;
        let mut lasts = regime.arm == arm && (line.planes.is_empty() || regime.c >= 0.0);
        for (plane, of) in self.planes.iter_mut().zip(&line.planes) {
            plane.surface.replace(lane, of.surface);
            plane.normal.replace(lane, of.normal);
            plane.stiffness.replace(lane, of.stiffness);
            plane.damping.replace(lane, of.damping);
            plane.touched.replace(lane, f64::from(u8::from(of.mode == Mode::Touching)));
            lasts &= of.mode != Mode::Leaving;
        }
        self.c.replace(lane, regime.c);
        self.pull.replace(lane, regime.pull);
        let Transition { k, per_k, half, discriminant } = regime.transition;
        self.transition.k.replace(lane, k);
        self.transition.per_k.replace(lane, per_k);
        self.transition.half.replace(lane, half);
        self.transition.discriminant.replace(lane, discriminant);
        let longest = if line.planes.is_empty() { f64::INFINITY } else { regime.longest };
        self.longest.replace(lane, if lasts { longest } else { -1.0 });
        self.load_map(lane);
    }

    fn load_map(&mut self, lane: usize) {
        let Transition { k, per_k, half, discriminant } = self.transition;
        let [k, per_k, half, discriminant] = [k, per_k, half, discriminant].map(|of| of.extract(lane));
        let map = Transition { k, per_k, half, discriminant }.over(self.step);
        self.map.k.replace(lane, map.k);
        self.map.from_y.replace(lane, map.from_y);
        self.map.from_v.replace(lane, map.from_v);
        self.map.sine.replace(lane, map.sine);
    }

    /// Compute the maps over a piece of `step` in s, unless they are kept.
    #[inline(always)] // nearly always they are kept
    pub(crate) fn prepare(&mut self, step: f64) {
        if self.step.to_bits() != step.to_bits() {
            self.step = step;
            for lane in 0..S::LANES {
                self.load_map(lane);
            }
        }
    }

    /// (x, V) after the piece, under an input per kg that is linear in time; in lanes of the mask `bends`, `bend` is
    /// removed from its instant on. The mask holds the lanes whose result is bit-identical to [`Line::advance`] and
    /// [`Line::advance_bent`].
    #[inline(always)] // once a tick and axis
    pub(crate) fn advance(
        &self,
        [u0, u1]: [S; 2],
        bends: S::SimdBool,
        bend: &Bend<S>,
        state: [S; 2],
    ) -> ([S; 2], S::SimdBool) {
        let (zero, step) = (S::zero(), self.step);
        let mut stays = self.longest.simd_ge(S::splat(step));
        let [mut later0, mut later1] = [u0, u1];
        let mut impulse = zero;
        let any_bends = bends.any();
        if any_bends {
            later0 = (u0 + bend.slope * bend.at).select(bends, u0);
            later1 = (u1 - bend.slope).select(bends, u1);
            impulse = ((bend.slope * bend.at).magnitude() * bend.at).select(bends, zero);
        }
        let course = Course::of(self.transition, self.c, [later0 + self.pull, later1, zero], state);
        if !self.planes.is_empty() {
            stays = stays & self.keeps_contacts(&course, state, step, impulse);
        }
        let mut found = course.by(&self.map, step);
        if any_bends {
            let left = S::splat(step) - bend.at;
            let z = self.transition.discriminant * left * left;
            let is_short = z.magnitude().simd_le(S::splat(NEARLY_CRITICAL))
                & (self.transition.half.magnitude() * left).simd_le(S::splat(REACH));
            stays = stays & (is_short | !bends);
            let rest = self.transition.over_nearly_critical(left);
            let bent = course.bent(bend, self.c, &self.map, &rest, step);
            let [[bent_x, bent_v], [x, v]] = [bent, found];
            found = [bent_x.select(bends, x), bent_v.select(bends, v)];
        }
        (found, stays)
    }

    /// Mask of the lanes in which every plane is touched as in the regime, and bounds show that this does not change.
    #[inline(always)] // like advance
    fn keeps_contacts(&self, course: &Course<S>, [x, v]: [S; 2], t: f64, impulse: S) -> S::SimdBool {
        let zero = S::zero();
        let [farther, fastest] = course.bounds(t);
        let (farther, fastest) = (farther + impulse * S::splat(t), fastest + impulse);
        let [a0, ..] = course.particular;
        let mut stays = !zero.simd_lt(zero);
        for plane in &self.planes {
            let depth = plane.normal * (plane.surface - x);
            let pressing = plane.stiffness * depth - plane.damping * plane.normal * v;
            let farther =
                farther + S::splat(1e-12) * (x.magnitude() + a0.magnitude() + plane.surface.magnitude());
            let apart = depth.simd_le(zero) & (depth + farther).simd_lt(zero);
            let pushes = plane.stiffness * (depth - farther);
            let touching = depth.simd_gt(zero)
                & pressing.simd_gt(zero)
                & pushes.simd_gt(plane.damping * fastest * S::splat(1.0 + 1e-12));
            let touched = plane.touched.simd_gt(zero);
            stays = stays & ((touching & touched) | (apart & !touched));
        }
        stays
    }
}
