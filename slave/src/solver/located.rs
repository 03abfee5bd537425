//! Contacts and bodies within a step: their state, the piece of their law, and the time of its change.

use crate::{
    Axes, Environment,
    arm::drive::Tool,
    contact::{law::Mode, object::STANDS},
    solver::{
        adaptive::SHORTEST,
        state::{Piece, Solver, TOOL, dense},
    },
};

/// Least and greatest share of a step between two tests for a change.
const FINEST: f64 = 1.0 / 256.0;
const COARSEST: f64 = 0.25;

impl<const N: usize> Environment<N> {
    pub(crate) fn near_bodies(&self) -> usize {
        self.reach.near.iter().filter(|&&index| self.slots[index] != usize::MAX).count()
    }

    /// Search all objects again from the present state; the far bodies lag by `late` in s.
    pub(crate) fn look_around(&mut self, solver: &mut Solver<N>, now: f64, late: f64) {
        self.store(solver);
        self.coast(late);
        self.look(&solver.state[0], &solver.state[1], now);
        self.load_bodies(solver);
    }

    pub(crate) fn load(&self, solver: &mut Solver<N>, tool: &Tool<N>) {
        solver.state[0] = tool.position;
        solver.state[1] = tool.velocity;
        solver.state[2] = tool.set_velocity;
        self.load_bodies(solver);
    }

    pub(crate) fn load_bodies(&self, solver: &mut Solver<N>) {
        for &index in &self.reach.near {
            if let Some(body) = self.objects[index].body() {
                let slot = TOOL + 2 * self.slots[index];
                solver.state[slot] = body.displacement;
                solver.state[slot + 1] = body.velocity;
            }
        }
    }

    pub(crate) fn store(&mut self, solver: &Solver<N>) {
        for &index in &self.reach.near {
            if let Some(body) = self.objects[index].body_mut() {
                let slot = TOOL + 2 * self.slots[index];
                body.displacement = solver.state[slot];
                body.velocity = solver.state[slot + 1];
            }
        }
    }

    /// Advance the bodies that are out of reach.
    pub(crate) fn coast(&mut self, span: f64) {
        if self.bodies > self.near_bodies() {
            for (index, object) in self.objects.iter_mut().enumerate() {
                if self.slots[index] == usize::MAX
                    && let Some(body) = object.body_mut()
                {
                    body.coast(span);
                }
            }
        }
    }

    /// Displacement and velocity of object `index` in a state.
    pub(crate) fn place_of(
        &self,
        state: &[Axes<N>],
        index: usize,
        piece: f64,
        now: f64,
    ) -> (Axes<N>, Axes<N>) {
        let slot = self.slots[index];
        if slot == usize::MAX {
            self.objects[index].place(piece, now)
        } else {
            (state[TOOL + 2 * slot], state[TOOL + 2 * slot + 1])
        }
    }

    /// Position and velocity of the tool relative to object `index`.
    pub(crate) fn relative(
        &self,
        state: &[Axes<N>],
        index: usize,
        piece: Piece,
        now: f64,
    ) -> (Axes<N>, Axes<N>) {
        let (displacement, velocity) = self.place_of(state, index, piece.inside, now);
        (state[0] - displacement, state[1] - velocity)
    }

    /// Update the law piece of each near object and the bodies held by friction. Returns true if a body has just come
    /// to rest.
    pub(crate) fn settle(&mut self, solver: &mut Solver<N>, piece: Piece, now: f64) -> bool {
        let mut came_to_rest = false;
        for near in 0..self.reach.near.len() {
            let index = self.reach.near[near];
            let (place, velocity) = self.relative(&solver.state, index, piece, now);
            self.modes[index] = self.mode(index, &place, &velocity).0;
            let reaction = -self.smooth(index, &place, &velocity);
            let slot = self.slots[index];
            if let Some(body) = self.objects[index].body_mut() {
                let sliding = &mut solver.state[TOOL + 2 * slot + 1];
                let rests = sliding.norm() <= STANDS && body.holds(&reaction);
                if rests && !body.stands {
                    // Exactly zero.
                    *sliding = Axes::zeros();
                    came_to_rest = true;
                }
                body.stands = rests;
            }
        }
        came_to_rest
    }

    /// Time in s in which no contact begins after the state `next`, at twice the speeds there. None if, in that state,
    /// a contact is on another piece of its law or a resting body breaks away.
    fn clear_s(&self, solver: &Solver<N>, piece: Piece, now: f64) -> Option<f64> {
        let mut clear = f64::INFINITY;
        for &index in &self.reach.near {
            if self.objects[index].shape().is_spring() && self.objects[index].body().is_none() {
                continue;
            }
            let (place, velocity) = self.relative(&solver.next, index, piece, now);
            let (mode, distance) = self.mode(index, &place, &velocity);
            if mode != self.modes[index]
                || self.objects[index]
                    .body()
                    .is_some_and(|body| body.stands && !body.holds(&self.smooth(index, &place, &velocity)))
            {
                return None;
            }
            if mode == Mode::Apart {
                clear = clear.min(distance / (2.0 * velocity.norm()));
            }
        }
        Some(clear)
    }

    /// Share of the step just after the first change.
    pub(crate) fn first_change(
        &self,
        solver: &mut Solver<N>,
        blocks: usize,
        piece: Piece,
        now: f64,
        step: f64,
    ) -> Option<f64> {
        if self.reach.near.is_empty() {
            return None;
        }
        first_share(step, |share| {
            solver.combine(blocks, step, &dense(share));
            self.clear_s(solver, piece, now + share * step)
        })
    }
}

/// Share of a step in s just after the first change, as far as a test shows it at shares between [`FINEST`] and
/// [`COARSEST`]; `clear_s` gives the time in s in which no contact begins after a share, and None after a change.
///
/// A tool that passes the corner of a box may touch it for less than a quarter of a step.
pub(crate) fn first_share(step: f64, mut clear_s: impl FnMut(f64) -> Option<f64>) -> Option<f64> {
    let (mut before, mut after) = (0.0, 0.0);
    let mut ahead = clear_s(0.0).unwrap_or(0.0);
    loop {
        after = (after + (ahead / step).clamp(FINEST, COARSEST)).min(1.0);
        match clear_s(after) {
            None => break,
            Some(_) if after == 1.0 => return None,
            Some(time) => (before, ahead) = (after, time),
        }
    }
    // To the rounding of the share, or to a time in which nothing moves.
    while after - before > 1e-15 && (after - before) * step > 0.1 * SHORTEST {
        let middle = 0.5 * (before + after);
        if clear_s(middle).is_none() { after = middle } else { before = middle }
    }
    Some(after)
}
