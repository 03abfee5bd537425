//! A tool among flat faces with friction: between events the Taylor series of its motion, exact to rounding.
//!
//! `M x'' = K (x_set(t) - x) + B (V_cmd - V) + F_push(t) + sum F_face`.
//!
//! Each touched face presses along its normal by its law, `p = K_f d + B_f d'` or `p = K_f d^n (1 + chi d')`. Across
//! the normal it rubs with `mu_f p s / max(|s|, 1 mm/s)` against the slip s ([`crate::Contact`]). The nonlinear terms,
//! `s / |s|` and `d^n`, have series that follow from those of s and d.
//!
//! Events are: a face is touched or left, another face of a box becomes the nearest, or a slip crosses 1 mm/s. Bounds
//! from the coefficients exclude them; otherwise they are located.
//!
//! Source: recursion for powers of series, A. Jorba, M. Zou, "A software package for the numerical integration of ODEs
//! by means of high-order Taylor methods", Experimental Mathematics 14, 2005, section 2.

use arrayvec::ArrayVec;

use haptether_numeric::Real as _;

use crate::{
    Axes, ContactLaw, Environment, FULL_SLIP, all_finite, amax,
    arm::drive::{ArmDrive, Tool},
    contact::law::Mode,
    solver::{adaptive::SHORTEST, located::first_share, state::Piece},
};

/// Maximum number of coefficients of a series, including the constant.
const TERMS: usize = 20;
/// Maximum number of faces touched at once.
const MAX_FACES: usize = 3;
/// Maximum number of series for one piece, including those that do not converge, before the adaptive integrator takes
/// the rest; lower after a piece that ended there.
const MAX_SERIES: u32 = 1000;
const MAX_SERIES_AGAIN: u32 = 20;
/// Number of halvings of a step without convergence before the adaptive integrator takes it.
const MAX_HALVINGS: u32 = 6;
/// Coefficients below this share of the largest coefficient of V count as zero.
const NEGLIGIBLE: f64 = f64::EPSILON / 16.0;
/// Relative allowance of the bounds for the rounding of a position in m.
const ROUNDING: f64 = 1e-12;

/// `1 / (n + 1)`: a division takes longer than the rest of a term.
const INVERSE: [f64; TERMS] = {
    let mut inverse = [0.0; TERMS];
    let mut n = 0;
    while n < TERMS {
        inverse[n] = 1.0 / (n + 1) as f64;
        n += 1;
    }
    inverse
};

/// Course of a tool over a step: Taylor coefficients in shares of the step.
#[derive(Default)]
struct Course<const N: usize> {
    /// x in m, without its constant coefficient.
    moved: ArrayVec<Axes<N>, TERMS>,
    /// V in m/s.
    velocity: ArrayVec<Axes<N>, TERMS>,
}

impl<const N: usize> Course<N> {
    /// Displacement in m and V in m/s at a share of the step.
    fn at(&self, share: f64) -> (Axes<N>, Axes<N>) {
        if share == 1.0 {
            let sum = |series: &[Axes<N>]| series.iter().rev().sum();
            return (sum(&self.moved), sum(&self.velocity));
        }
        let sum =
            |series: &[Axes<N>]| series.iter().rev().fold(Axes::zeros(), |sum, term| sum * share + term);
        (sum(&self.moved), sum(&self.velocity))
    }

    /// Bound in m on the displacement along each axis at any time of the step.
    fn swing(&self) -> Axes<N> {
        self.moved.iter().map(Axes::abs).sum()
    }

    /// Bound in m/s on the speed at any time of the step.
    fn fastest(&self) -> f64 {
        self.velocity.iter().map(Axes::abs).sum::<Axes<N>>().norm()
    }
}

/// A touched face.
struct Face<const N: usize> {
    index: usize,
    normal: Axes<N>,
    law: ContactLaw,
    friction: f64,
    /// d in m at the start of the step.
    first_depth: f64,
    /// True if the slip is above [`FULL_SLIP`].
    glides: bool,
    /// Distance in m that the tool may move along each axis while this face stays the nearest.
    margin: f64,
}

/// Taylor coefficients of the quantities on a face, in shares of the step. Stored apart from the faces because moving
/// them is expensive.
struct FaceSeries<const N: usize> {
    /// d in m, its power, and d' in m/s; for laws with a power.
    depth: ArrayVec<f64, TERMS>,
    power: ArrayVec<f64, TERMS>,
    rate: ArrayVec<f64, TERMS>,
    /// p in N.
    pressing: ArrayVec<f64, TERMS>,
    /// s in m/s.
    slip: ArrayVec<Axes<N>, TERMS>,
    /// |s| in m/s; for faces on which the tool glides.
    speed: ArrayVec<f64, TERMS>,
    /// p over |s|, or over [`FULL_SLIP`].
    drag: ArrayVec<f64, TERMS>,
    /// 1 over the first |s|.
    inverse_speed: f64,
}

impl<const N: usize> FaceSeries<N> {
    #[inline]
    const fn new() -> Self {
        Self {
            depth: ArrayVec::new_const(),
            power: ArrayVec::new_const(),
            rate: ArrayVec::new_const(),
            pressing: ArrayVec::new_const(),
            slip: ArrayVec::new_const(),
            speed: ArrayVec::new_const(),
            drag: ArrayVec::new_const(),
            inverse_speed: 0.0,
        }
    }

    /// Clear all coefficients for another step.
    fn begin(&mut self) {
        let Self { depth, power, rate, pressing, slip, speed, drag, .. } = self;
        [depth, power, rate, pressing, speed, drag].into_iter().for_each(ArrayVec::clear);
        slip.clear();
    }

    /// The next coefficient of `d^n (1 + chi d')`. The coefficients of the power `q = d^n` follow from
    /// `k d_0 q_k = sum_i (n i - (k - i)) d_i q_(k-i)`.
    fn power_with_rate(&mut self, exponent: f64, damping: f64) -> f64 {
        let Self { depth, power, rate, .. } = self;
        let k = power.len();
        let next = if k == 0 {
            depth[0].powf(exponent)
        } else {
            let (mut sum, mut weight) = (0.0, -(k as f64));
            for (depth, before) in depth[1..].iter().zip(power.iter().rev()) {
                weight += exponent + 1.0;
                sum += weight * depth * before;
            }
            sum / (k as f64 * depth[0])
        };
        power.push(next);
        let damped: f64 = power.iter().zip(rate.iter().rev()).map(|(power, rate)| power * rate).sum();
        next + damping * damped
    }

    /// The next coefficient of `p s / |s|`, from that of V: `|s|² = s s` gives that of |s|, and `(p / |s|) |s| = p`
    /// gives the quotient.
    ///
    /// Terms that do not depend on the newest V are summed separately, oldest first, so that few operations remain once
    /// it is known.
    #[inline]
    fn gliding(&mut self, velocity: &Axes<N>) -> Axes<N> {
        let Self { pressing, slip, speed, drag, inverse_speed, .. } = self;
        let n = drag.len();
        if n == 0 {
            let first = slip[0].norm();
            *inverse_speed = first.recip();
            speed.push(first);
            drag.push(pressing[0] / first);
            return slip[0] * drag[0];
        }
        // Each product of two different coefficients counts twice.
        let (mut square, mut of_speed) = (Axes::zeros(), 0.0);
        let pairs = n.div_ceil(2);
        if n.is_multiple_of(2) {
            square = slip[pairs].component_mul(&slip[pairs]) * 0.5;
            of_speed = 0.5 * speed[pairs] * speed[pairs];
        }
        for (early, late) in slip[1..pairs].iter().rev().zip(&slip[n / 2 + 1..n]) {
            square += early.component_mul(late);
        }
        for (early, late) in speed[1..pairs].iter().rev().zip(&speed[n / 2 + 1..n]) {
            of_speed += early * late;
        }
        let (mut rubbing, mut braking) = (Axes::zeros(), 0.0);
        if n > 1 {
            let inner = 2..(n - 1).max(2);
            for (slip, drag) in slip[inner.clone()].iter().zip(drag[inner.clone()].iter().rev()) {
                rubbing += slip * *drag;
            }
            for (speed, drag) in speed[inner.clone()].iter().zip(drag[inner].iter().rev()) {
                braking += speed * drag;
            }
            if n > 2 {
                rubbing += slip[n - 1] * drag[1];
                braking += speed[n - 1] * drag[1];
            }
            rubbing += slip[1] * drag[n - 1];
            braking += speed[1] * drag[n - 1];
        }
        let (first, first_drag, inverse) = (slip[0], drag[0], *inverse_speed);
        let before = (square.sum() - of_speed) * inverse;
        let known = braking + before * first_drag;
        // The first slip lies across the normal, so its product with V equals that with the slip.
        let newest = first.dot(velocity) * inverse;
        let next = (pressing[n] - known) * inverse - newest * (first_drag * inverse);
        speed.push(before + newest);
        drag.push(next);
        rubbing + slip[n] * first_drag + first * next
    }

    /// The next coefficient of `p s` over [`FULL_SLIP`].
    #[inline]
    fn creeping(&mut self) -> Axes<N> {
        let Self { pressing, slip, drag, .. } = self;
        drag.push(pressing[drag.len()] * FULL_SLIP.recip());
        drag.iter().zip(slip.iter().rev()).map(|(drag, slip)| slip * *drag).sum()
    }
}

impl<const N: usize> Face<N> {
    /// The next coefficient of its force in N, from that of the motion in shares of a step.
    #[inline]
    fn force(&self, series: &mut FaceSeries<N>, moved: &Axes<N>, velocity: &Axes<N>) -> Axes<N> {
        let along = self.normal.dot(velocity);
        let depth = if series.pressing.is_empty() { self.first_depth } else { -self.normal.dot(moved) };
        let pressing = match self.law {
            ContactLaw::KelvinVoigt { stiffness, damping } => stiffness * depth - damping * along,
            ContactLaw::HuntCrossley { stiffness, exponent, damping } => {
                series.depth.push(depth);
                series.rate.push(-along);
                stiffness * series.power_with_rate(exponent, damping)
            }
        };
        series.pressing.push(pressing);
        let force = self.normal * pressing;
        if self.friction == 0.0 {
            return force;
        }
        let mut slip = velocity - self.normal * along;
        if series.slip.is_empty() {
            // Across the normal to the rounding of the slip, not of V, which may be a thousand times larger.
            slip -= self.normal * self.normal.dot(&slip);
        }
        series.slip.push(slip);
        let rubbing = if self.glides { series.gliding(velocity) } else { series.creeping() };
        force - rubbing * self.friction
    }

    /// True if bounds show that the contact does not change over the step, with a tool displacement of at most `swing`
    /// in m.
    fn stays(&self, series: &FaceSeries<N>, swing: &Axes<N>, rounding: f64) -> bool {
        let released: f64 = series.pressing[1..].iter().map(|p| p.abs()).sum();
        let is_pressed = self.first_depth > self.normal.abs().dot(swing) + rounding
            && series.pressing[0] > released * (1.0 + ROUNDING)
            && self.margin > amax(swing) + rounding;
        if !is_pressed || self.friction == 0.0 {
            return is_pressed;
        }
        let change = series.slip[1..].iter().map(Axes::abs).sum::<Axes<N>>().norm() * (1.0 + ROUNDING);
        let slip = series.slip[0].norm();
        if self.glides { slip - change > FULL_SLIP } else { slip + change <= FULL_SLIP }
    }
}

/// Contacts of the tool.
struct Touched<const N: usize> {
    faces: ArrayVec<Face<N>, MAX_FACES>,
    /// Series of each face.
    series: [FaceSeries<N>; MAX_FACES],
    /// Sums over the faces: `dF / dd` in N/m, and `dF / dd'` plus the damping of friction in N s/m.
    stiffness: f64,
    damping: f64,
    /// Distance in m to the nearest object without contact.
    clear: f64,
    /// True if the tool leaves an object faster than its surface follows.
    leaves: bool,
    /// Largest coordinate of an object, in m.
    extent: f64,
}

impl<const N: usize> Touched<N> {
    /// No contact.
    #[inline]
    fn new() -> Self {
        Self {
            faces: ArrayVec::new(),
            series: std::array::from_fn(|_| FaceSeries::new()),
            stiffness: 0.0,
            damping: 0.0,
            clear: f64::INFINITY,
            leaves: false,
            extent: 0.0,
        }
    }
}

/// Forces on the tool other than faces, linear in x and V.
struct Pull<const N: usize> {
    mass: f64,
    /// K in N/m and B in N s/m of arm and springs.
    stiffness: f64,
    damping: f64,
    /// Force in N at the start, and its growth apart from K and B: in N/s, and half of the second derivative in N/s².
    force: Axes<N>,
    growth: [Axes<N>; 2],
}

impl<const N: usize> Pull<N> {
    /// Compute the motion over `step` in s from V in m/s; true if its series converges.
    fn follow(
        &self,
        course: &mut Course<N>,
        touched: &mut Touched<N>,
        velocity: &Axes<N>,
        step: f64,
    ) -> bool {
        let Touched { faces, series, .. } = touched;
        let Course { moved, velocity: v } = course;
        moved.clear();
        v.clear();
        series.iter_mut().for_each(FaceSeries::begin);
        // The critical path of the loop, apart from the arrays.
        let (mut newest_moved, mut newest_velocity) = (Axes::zeros(), *velocity);
        moved.push(newest_moved);
        v.push(newest_velocity);
        let mut largest = amax(velocity);
        let mut negligible = 0;
        for (n, inverse) in INVERSE[..TERMS - 1].iter().enumerate() {
            let mut force = match n {
                0 => self.force,
                1 => self.growth[0] * step,
                2 => self.growth[1] * (step * step),
                _ => Axes::zeros(),
            };
            if n > 0 {
                force -= newest_moved * self.stiffness + newest_velocity * self.damping;
            }
            for (face, series) in faces.iter().zip(&mut *series) {
                force += face.force(series, &newest_moved, &newest_velocity);
            }
            let share = step * inverse;
            newest_moved = newest_velocity * share;
            moved.push(newest_moved);
            newest_velocity = force * (share / self.mass);
            v.push(newest_velocity);
            let size = amax(&newest_velocity);
            largest = size.larger(largest);
            negligible = if size <= NEGLIGIBLE * largest { negligible + 1 } else { 0 };
            // Terms quadratic in time enter with the third coefficient.
            if negligible >= 2 && n >= 3 {
                return true;
            }
        }
        false
    }
}

impl<const N: usize> Environment<N> {
    /// Move the tool over a piece without kinks, planned at its start, as far as series describe its motion. Returns
    /// the time reached.
    pub(crate) fn slide(&mut self, arm: &ArmDrive<N>, tool: &mut Tool<N>, piece: Piece, end: f64) -> f64 {
        let mut done = piece.planned;
        if self.bodies > 0 || arm.is_velocity_control() || !self.is_push_linear {
            return done;
        }
        let gave_up = std::mem::take(&mut self.solver.series_gave_up);
        let mut left = if gave_up { MAX_SERIES_AGAIN } else { MAX_SERIES };
        // For the whole piece, which has no kink: a step within it may start within rounding of its end.
        let steady = self.push_stretch(piece.origin + done).steady;
        while let Some(taken) = self.slide_once(arm, tool, (piece, steady), (done, end - done), &mut left) {
            if taken >= end - done {
                return end;
            }
            done += taken;
        }
        self.solver.series_gave_up = left == 0;
        done
    }

    /// Move the tool to the next event, over at most `left` in s; return the time taken.
    fn slide_once(
        &mut self,
        arm: &ArmDrive<N>,
        tool: &mut Tool<N>,
        (piece, steady): (Piece, Option<Axes<N>>),
        (done, left): (f64, f64),
        trials: &mut u32,
    ) -> Option<f64> {
        let now = piece.origin + done;
        let Tool { position, velocity, .. } = *tool;
        if !self.reach.covers(&position, now + left, 2.0 * velocity.norm() * left + SHORTEST) {
            self.look(&position, &velocity, now);
        }
        let mut pull = self.pull_of_arm(arm, tool, (piece, steady), (done, left));
        let mut touched = Touched::new();
        self.touch(tool, &mut pull, &mut touched)?;
        // Fastest rate at which the motion relaxes or swings.
        let rate = (pull.damping + touched.damping) / pull.mass
            + ((pull.stiffness + touched.stiffness) / pull.mass).sqrt();
        if rate.is_nan() || rate * left >= f64::from(MAX_SERIES) {
            return None;
        }
        let mut step = if rate * left > 1.0 { rate.recip() } else { left };
        let mut halvings = 0;
        let mut course = Course::default();
        loop {
            if *trials == 0 || halvings > MAX_HALVINGS {
                return None;
            }
            *trials -= 1;
            if pull.follow(&mut course, &mut touched, &velocity, step) {
                break;
            }
            (step, halvings) = (0.5 * step, halvings + 1);
        }
        let swing = course.swing();
        let farthest = swing.norm();
        if !self.reach.covers(&position, now + step, farthest) {
            return None;
        }
        let Touched { faces, series, clear, leaves, extent, .. } = &touched;
        let rounding = ROUNDING * (amax(&position) + extent);
        let stays = |(face, series): (&Face<N>, &FaceSeries<N>)| face.stays(series, &swing, rounding);
        let is_sure = !leaves && *clear > farthest + rounding && faces.iter().zip(series).all(stays);
        let mut taken = step;
        if !is_sure {
            let fastest = course.fastest();
            let clear_s = |share| {
                let (moved, velocity) = course.at(share);
                self.clear_m(faces, &(position + moved), &velocity).map(|clear| clear / fastest)
            };
            if let Some(share) = first_share(step, clear_s) {
                taken = (share * step).max(SHORTEST.min(step));
            }
        }
        let (moved, velocity) = course.at(taken / step);
        let position = position + moved;
        if !(all_finite(&position) && all_finite(&velocity)) {
            return None;
        }
        (tool.position, tool.velocity) = (position, velocity);
        Some(taken)
    }

    /// Determine the law piece of each near object at the tool's position. Contacts go to `touched`, springs to `pull`.
    /// None if an object moves, if a round object is touched, or if too many faces are touched.
    fn touch(&mut self, tool: &Tool<N>, pull: &mut Pull<N>, touched: &mut Touched<N>) -> Option<()> {
        let Tool { position, velocity, .. } = *tool;
        for near in 0..self.reach.near.len() {
            let index = self.reach.near[near];
            let object = &self.objects[index];
            if !object.is_fixed() {
                return None;
            }
            if object.shape().is_spring() {
                let (stiffness, damping) = object.contact().linear();
                pull.stiffness += stiffness;
                pull.damping += damping;
                pull.force += (object.shape().reference() - position) * stiffness - velocity * damping;
                continue;
            }
            let (distance, normal) = object.shape().surface(&position);
            touched.extent = object.shape().extent().max(touched.extent);
            let along = normal.dot(&velocity);
            let mode = object.contact().mode(-distance, -along);
            self.modes[index] = mode;
            match mode {
                Mode::Apart => touched.clear = distance.min(touched.clear),
                Mode::Leaving => touched.leaves = true,
                Mode::Touching => {
                    let contact = object.contact();
                    let margin = object.shape().margin_of_face(&position)?;
                    let reaction = contact.reaction(distance, &normal, &velocity)?;
                    let face = Face {
                        index,
                        normal,
                        law: contact.law(),
                        friction: if N == 1 { 0.0 } else { contact.friction() },
                        first_depth: -distance,
                        glides: (velocity - normal * along).norm() > FULL_SLIP,
                        margin,
                    };
                    touched.faces.try_push(face).ok()?;
                    touched.stiffness += reaction.stiffness;
                    touched.damping += reaction.damping;
                    if N > 1 {
                        touched.damping += reaction.drag;
                    }
                }
            }
        }
        Some(())
    }

    /// Forces of arm and pushers from `done` on.
    fn pull_of_arm(
        &self,
        arm: &ArmDrive<N>,
        tool: &Tool<N>,
        (piece, steady): (Piece, Option<Axes<N>>),
        (done, left): (f64, f64),
    ) -> Pull<N> {
        let (stiffness, damping, feed_forward) = arm.impedance();
        let since = done - piece.planned;
        let set = arm.set_points();
        let speed = Axes::from_fn(|axis, _| set[axis].velocity + since * set[axis].acceleration);
        let place = Axes::from_fn(|axis, _| {
            set[axis].position + since * (set[axis].velocity + 0.5 * since * set[axis].acceleration)
        });
        let now = piece.origin + done;
        let (push, push_growth) = if let Some(push) = steady {
            (push, Axes::zeros())
        } else {
            let [push, later] = [now, now + left].map(|time| self.push(piece.inside, time));
            (push, (later - push) / left)
        };
        let wanted = if feed_forward { arm.command_velocity() } else { Axes::zeros() };
        let force = (place - tool.position) * stiffness + (wanted - tool.velocity) * damping + push;
        let force = force + arm.exerted().copied().unwrap_or_else(Axes::zeros);
        let half = Axes::from_fn(|axis, _| 0.5 * stiffness * set[axis].acceleration);
        Pull {
            mass: arm.model().mass_kg(),
            stiffness,
            damping,
            force,
            growth: [speed * stiffness + push_growth, half],
        }
    }

    /// Distance in m to the nearest object without contact, at another position and velocity. None if an object is on
    /// another piece of its law there than in the modes and `faces`.
    fn clear_m(&self, faces: &[Face<N>], position: &Axes<N>, velocity: &Axes<N>) -> Option<f64> {
        let mut clear = f64::INFINITY;
        for &index in &self.reach.near {
            let object = &self.objects[index];
            if object.shape().is_spring() {
                continue;
            }
            let (distance, normal) = object.shape().surface(position);
            let along = normal.dot(velocity);
            let mode = object.contact().mode(-distance, -along);
            let glides = || (velocity - normal * along).norm() > FULL_SLIP;
            if mode != self.modes[index]
                || faces.iter().find(|face| face.index == index).is_some_and(|face| {
                    normal != face.normal || (face.friction > 0.0 && glides() != face.glides)
                })
            {
                return None;
            }
            if mode == Mode::Apart {
                clear = clear.min(distance);
            }
        }
        Some(clear)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        ArmControl, ArmModel, Contact, ContactLaw, Object, PushShape, Pusher, Shape, solver::adaptive::Drive,
    };
    use proptest::prelude::*;

    const KG: f64 = 4.0;
    const K: f64 = 2000.0;
    const B: f64 = 60.0;

    fn voigt(stiffness: f64, damping: f64, friction: f64) -> Contact {
        Contact::new(ContactLaw::KelvinVoigt { stiffness, damping }, friction).unwrap()
    }

    fn plane<const N: usize>(normal: Axes<N>, contact: Contact) -> Environment<N> {
        let shape = Shape::plane(Axes::zeros(), normal).unwrap();
        Environment::new(vec![Object::fixed(shape, contact).unwrap()], Vec::new())
    }

    proptest! {
        /// Gliding friction equals the sum of all products, for any inclination of the face and any ratio of impact
        /// speed to slip.
        #[test]
        fn friction_of_gliding_is_that_of_all_products(
            normal in prop::array::uniform3(-1.0..1.0_f64),
            terms in prop::collection::vec(prop::array::uniform3(-1.0..1.0_f64), TERMS - 1),
            (into, slip, fall) in (0.0..3.0_f64, 1.1e-3..0.2_f64, 0.05..0.5_f64),
        ) {
            let normal = Axes::<3>::from(normal);
            prop_assume!(normal.norm() > 0.1);
            let normal = normal.normalize();
            let across = |v: &Axes<3>| {
                let once = v - normal * normal.dot(v);
                once - normal * normal.dot(&once)
            };
            prop_assume!(across(&Axes::from(terms[0])).norm() > 0.1);
            let first = across(&Axes::from(terms[0])).normalize() * slip - normal * into;
            // Each later term is smaller by `fall`, across the normal and along it, as in a convergent series.
            let later = |n: usize| {
                let term = Axes::from(terms[n]);
                (across(&term) * slip + normal * (term[0] * into)) * fall.powf(n as f64)
            };
            let v: Vec<_> = (0..TERMS - 1).map(|n| if n == 0 { first } else { later(n) }).collect();
            let law = ContactLaw::KelvinVoigt { stiffness: 900.0, damping: 3.0 };
            let face =
                Face { index: 0, normal, law, friction: 0.4, first_depth: 2e-3, glides: true, margin: 1.0 };
            let mut series = FaceSeries::new();
            let (mut speed, mut drag) = (Vec::new(), Vec::new());
            let s: Vec<_> = v.iter().map(across).collect();
            for n in 0..TERMS - 1 {
                let moved = if n == 0 { Axes::zeros() } else { v[n - 1] * (1e-3 / n as f64) };
                let found = face.force(&mut series, &moved, &v[n]);
                let depth = if n == 0 { face.first_depth } else { -normal.dot(&moved) };
                let p = 900.0 * depth - 3.0 * normal.dot(&v[n]);
                if n == 0 {
                    speed.push(s[0].norm());
                    drag.push(p / speed[0]);
                } else {
                    let squares: f64 = (0..=n).map(|i| s[i].dot(&s[n - i])).sum();
                    let others: f64 = (1..n).map(|i| speed[i] * speed[n - i]).sum();
                    speed.push((squares - others) / (2.0 * speed[0]));
                    let known: f64 = (1..=n).map(|i| speed[i] * drag[n - i]).sum();
                    let pressing = series.pressing[n];
                    prop_assert!((pressing - p).abs() <= 1e-12 * (p.abs() + 3.0 * v[n].norm() + 1e-6));
                    drag.push((pressing - known) / speed[0]);
                }
                let rubbing: Axes<3> = (0..=n).map(|i| s[n - i] * drag[i]).sum();
                let expected = normal * series.pressing[n] - rubbing * 0.4;
                // Roundings of the earlier terms, of which each is at most that share of the previous one; about 20 of
                // them.
                let size = (0..=n).map(|i| s[n - i].norm() * drag[i].abs()).sum::<f64>() + expected.norm();
                prop_assert!((found - expected).norm() <= 1e-11 * size, "{n}: {:e}", (found - expected).norm() / size);
            }
        }
    }

    /// An arm with K and B that moves to `target` from the position of the tool.
    fn arm<const N: usize>(tool: &Tool<N>, target: Axes<N>, speed: Option<f64>) -> ArmDrive<N> {
        let control = ArmControl::Pd { stiffness: K, damping: B };
        let mut drive = ArmDrive::new(ArmModel::new(control, KG, speed, None).unwrap(), &tool.position);
        drive.command(target, Axes::zeros());
        drive
    }

    fn tool<const N: usize>(position: Axes<N>, velocity: Axes<N>) -> Tool<N> {
        Tool { position, velocity, set_velocity: Axes::zeros() }
    }

    /// Steps of `span` in s, all by series.
    fn slid<const N: usize>(
        environment: &mut Environment<N>,
        drive: &mut ArmDrive<N>,
        tool: &mut Tool<N>,
        span: f64,
        steps: u32,
    ) {
        for step in 0..steps {
            drive.plan();
            let origin = f64::from(step) * span;
            let piece = Piece { origin, inside: origin + 0.5 * span, planned: 0.0 };
            assert_eq!(environment.slide(drive, tool, piece, span), span, "step {step}");
            drive.advance(span);
        }
    }

    /// A pressed tool that slides straight under constant friction: `M u'' = K (u_set - u) - B u' - mu_f p` equals the
    /// exponential of its matrix.
    #[test]
    fn a_straight_slide_is_the_matrix_exponential() {
        let (normal, along) = (Axes::<3>::new(0.6, 0.0, 0.8), Axes::<3>::new(0.8, 0.0, -0.6));
        let (wall, rub) = (5000.0, 0.3);
        // The pressing is constant where K (set - x) and the wall's force balance along the normal.
        let depth = 1e-3;
        let pressing = wall * depth;
        let set_along_normal = -depth - pressing / K;
        let (u, u_set, v) = (0.01, 0.2, 0.05);
        let start = normal * -depth + along * u;
        let mut tool = tool(start, along * v);
        let mut environment = plane(normal, voigt(wall, 10.0, rub));
        let mut drive = arm(&tool, normal * set_along_normal + along * u_set, None);
        slid(&mut environment, &mut drive, &mut tool, 1e-3, 100);
        let rest = u_set - rub * pressing / K;
        let matrix = nalgebra::Matrix2::new(0.0, 1.0, -K / KG, -B / KG);
        let exact = (matrix * 0.1).exp() * nalgebra::Vector2::new(u - rest, v);
        let moved = tool.position - normal * -depth;
        // 100 steps, each with a few roundings of 0.2 m and of the position at which K (set - x) vanishes.
        assert!((moved.dot(&along) - rest - exact.x).abs() < 1e-14, "{}", moved.dot(&along) - rest - exact.x);
        assert!(
            (tool.velocity.dot(&along) - exact.y).abs() < 1e-13,
            "{}",
            tool.velocity.dot(&along) - exact.y
        );
        assert!(moved.dot(&normal).abs() < 1e-15 && tool.velocity.dot(&normal).abs() < 1e-13, "{moved}");
    }

    /// Below 1 mm/s friction is a damping of `mu_f p` over that speed.
    #[test]
    fn a_creeping_tool_is_damped_as_the_matrix_exponential_says() {
        let (wall, rub, depth) = (5000.0, 0.3, 1e-3);
        let pressing = wall * depth;
        let normal = Axes::<2>::new(0.0, 1.0);
        let mut tool = tool(Axes::<2>::new(0.0, -depth), Axes::<2>::new(9e-4, 0.0));
        let mut environment = plane(normal, voigt(wall, 10.0, rub));
        let mut drive = arm(&tool, Axes::<2>::new(2e-4, -depth - pressing / K), None);
        slid(&mut environment, &mut drive, &mut tool, 1e-3, 50);
        let damping = (B + rub * pressing / FULL_SLIP) / KG;
        let matrix = nalgebra::Matrix2::new(0.0, 1.0, -K / KG, -damping);
        let exact = (matrix * 0.05).exp() * nalgebra::Vector2::new(-2e-4, 9e-4);
        assert!((tool.position[0] - 2e-4 - exact.x).abs() < 1e-17, "{}", tool.position[0] - 2e-4 - exact.x);
        assert!((tool.velocity[0] - exact.y).abs() < 1e-15, "{}", tool.velocity[0] - exact.y);
    }

    /// A Hertzian face loses no energy: `M v² / 2 + K d^(n+1) / (n+1)` is constant.
    #[test]
    fn a_hertzian_press_conserves_energy() {
        let (stiffness, exponent) = (1e6, 1.5);
        let law = ContactLaw::HuntCrossley { stiffness, exponent, damping: 0.0 };
        let mut environment = plane(Axes::<2>::new(0.0, 1.0), Contact::new(law, 0.0).unwrap());
        let mut tool = tool(Axes::<2>::new(0.0, -2e-4), Axes::<2>::new(0.1, -0.05));
        let free = ArmModel::new(ArmControl::Pd { stiffness: 0.0, damping: 0.0 }, KG, None, None).unwrap();
        let mut drive = ArmDrive::new(free, &tool.position);
        let energy = |tool: &Tool<2>| {
            let depth = -tool.position[1];
            0.5 * KG * tool.velocity.norm_squared()
                + stiffness * depth.powf(exponent + 1.0) / (exponent + 1.0)
        };
        let before = energy(&tool);
        slid(&mut environment, &mut drive, &mut tool, 1e-3, 20);
        // The motion has reversed.
        assert!(tool.velocity[1] > 0.0 && tool.position[1] < 0.0, "{tool:?}");
        // 20 ticks of some steps each, a few roundings a step.
        assert!((energy(&tool) / before - 1.0).abs() < 5e-15, "{:e}", energy(&tool) / before - 1.0);
    }

    /// A slide along a curve gives the same result to rounding over long steps and over short ones, whose series end
    /// early.
    #[test]
    fn a_bending_slide_does_not_depend_on_the_step() {
        let at = |span: f64, steps: u32| {
            let mut tool = tool(Axes::<3>::new(0.0, 0.0, -1e-3), Axes::<3>::new(0.05, 0.0, 0.02));
            let mut environment = plane(Axes::<3>::new(0.0, 0.1, 1.0), voigt(5000.0, 10.0, 0.4));
            let mut drive = arm(&tool, Axes::<3>::new(-0.02, 0.05, -0.01), Some(0.5));
            slid(&mut environment, &mut drive, &mut tool, span, steps);
            tool
        };
        let [long, short] = [at(1e-3, 40), at(1.25e-4, 320)];
        // The motion has turned.
        assert!(long.velocity[1] > long.velocity[0].abs(), "{long:?}");
        // 320 steps with a few roundings each, of 5 cm and of 1 m/s.
        let errors = [(long.position - short.position).amax(), (long.velocity - short.velocity).amax()];
        assert!(errors[0] < 1e-15 && errors[1] < 1e-13, "{errors:?}");
    }

    /// Series and bounds miss nothing: any motion among planes, boxes and springs equals that of the adaptive
    /// integrator, whose error is 1e-10 of a step.
    fn compare(
        objects: &[Object<3>],
        pushers: &[Pusher<3>],
        start: Tool<3>,
        target: Axes<3>,
        control: ArmControl,
        ms: u32,
    ) -> Result<(), TestCaseError> {
        let arm = ArmModel::new(control, KG, Some(1.0), None).unwrap();
        let of = |by_series: bool| {
            let mut environment = Environment::new(objects.to_vec(), pushers.to_vec());
            environment.is_push_linear &= by_series;
            let mut drive = ArmDrive::new(arm, &start.position);
            drive.command(target, Axes::zeros());
            (environment, drive, start)
        };
        let (mut runs, mut largest) = ([of(true), of(false)], 0.0_f64);
        for tick in 0..ms {
            for (environment, drive, tool) in &mut runs {
                environment.solve(&mut Drive::Arm(drive), tool, f64::from(tick) * 1e-3, 1e-3);
            }
            let [(_, _, series), (_, _, adaptive)] = &runs;
            largest = largest.max(adaptive.velocity.amax());
            let position = (series.position - adaptive.position).amax();
            let velocity = (series.velocity - adaptive.velocity).amax();
            prop_assert!(
                position < 1e-9 && velocity < 1e-7 * (1.0 + largest),
                "{tick}: {position:e} {velocity:e}"
            );
        }
        prop_assert_eq!(runs[0].0.coarse_steps(), 0);
        Ok(())
    }

    /// A tool that passes a corner of a box touches it, here for up to 0.08 ms of a step of 1 ms.
    #[test]
    fn a_passed_corner_is_touched() {
        let law = ContactLaw::HuntCrossley { stiffness: 1.6e5, exponent: 1.3, damping: 1.0 };
        let shape = Shape::cuboid(Axes::zeros(), Axes::from([0.01, 0.01, 0.03])).unwrap();
        let corner = Object::fixed(shape, Contact::new(law, 0.1).unwrap()).unwrap();
        let control = ArmControl::Position { bandwidth_hz: 15.0 };
        for past in [2e-6, 2e-5, 6e-5] {
            let start = tool(Axes::from([-0.0098 + past, -0.0102, 0.0]), Axes::from([-0.8, 0.8, 0.1]));
            compare(&[corner], &[], start, start.position, control, 1).unwrap();
        }
    }

    fn vector(size: f64) -> impl Strategy<Value = Axes<3>> {
        prop::array::uniform3(-size..size).prop_map(Axes::<3>::from)
    }

    fn object() -> impl Strategy<Value = Object<3>> {
        let friction = || prop_oneof![Just(0.0), 0.05..0.8_f64];
        let hertz = (3e3..3e5_f64, 1.0..2.5_f64, 0.0..2.0_f64, friction()).prop_map(
            |(stiffness, exponent, damping, friction)| {
                Contact::new(ContactLaw::HuntCrossley { stiffness, exponent, damping }, friction).unwrap()
            },
        );
        let linear = (100.0..5000.0_f64, 0.0..20.0_f64, friction())
            .prop_map(|(stiffness, damping, friction)| voigt(stiffness, damping, friction));
        let contact = prop_oneof![2 => linear, 1 => hertz];
        let shape =
            prop_oneof![
                (vector(1.0)).prop_filter_map("a normal", |normal| Shape::plane(Axes::zeros(), normal).ok()),
                (vector(0.02), prop::array::uniform3(0.01..0.05_f64))
                    .prop_map(|(centre, half)| Shape::cuboid(centre, Axes::from(half)).unwrap()),
            ];
        let spring =
            (vector(0.05), 10.0..500.0_f64, 0.0..5.0_f64).prop_map(|(anchor, stiffness, damping)| {
                Object::fixed(Shape::spring(anchor).unwrap(), voigt(stiffness, damping, 0.0)).unwrap()
            });
        prop_oneof![
            5 => (shape, contact).prop_map(|(shape, contact)| Object::fixed(shape, contact).unwrap()),
            1 => spring,
        ]
    }

    proptest! {
        #[test]
        fn any_slide_is_that_of_the_adaptive_integrator(
            objects in prop::collection::vec(object(), 1..4),
            pushed in prop::option::of((vector(10.0), 0.0..0.02_f64)),
            (position, velocity, target) in (vector(0.03), vector(0.3), vector(0.06)),
            is_pd in any::<bool>(),
        ) {
            let pushers: Vec<_> = pushed
                .map(|(force, rise_s)| Pusher::shaped(PushShape::Ramp { rise_s }, 0.005, 0.02, force).unwrap())
                .into_iter()
                .collect();
            let control =
                if is_pd { ArmControl::Pd { stiffness: K, damping: B } } else { ArmControl::Position { bandwidth_hz: 15.0 } };
            compare(&objects, &pushers, tool(position, velocity), target, control, 40)?;
        }
    }
}
