//! Adaptive integrator of tool and free bodies with located contacts.

use crate::{
    Axes, Environment, all_finite,
    arm::drive::{ArmDrive, Tool},
    contact::law::Mode,
    solver::state::{NODES, Piece, STAGES, Solver, TOOL},
};

/// Longest step in s, for any estimated error.
const LONGEST: f64 = 1e-3;
/// Shortest step in s; accepted for any estimated error, so that a tick ends.
pub(crate) const SHORTEST: f64 = 1e-11;
/// Attempts for one millisecond before its rest is solved coarsely.
const MAX_ATTEMPTS: u32 = 20_000;
/// Attempts for the shortest piece.
const MIN_ATTEMPTS: u32 = 1_000;

/// Drive of the tool.
pub(crate) enum Drive<'a, const N: usize> {
    /// No force: a straight line.
    Straight,
    Arm(&'a mut ArmDrive<N>),
}

impl<const N: usize> Environment<N> {
    /// Move the free bodies over a step in s that starts at `time_s`, while the tool moves from a position at constant
    /// velocity.
    pub fn advance(&mut self, time_s: f64, step_s: f64, position: &Axes<N>, velocity: &Axes<N>) {
        if self.bodies > 0 && step_s > 0.0 {
            let mut tool = Tool { position: *position, velocity: *velocity, set_velocity: Axes::zeros() };
            self.solve(&mut Drive::Straight, &mut tool, time_s, step_s);
        }
    }

    /// Advance tool and bodies by `span` in s from `from` in s.
    pub(crate) fn solve(&mut self, drive: &mut Drive<'_, N>, tool: &mut Tool<N>, from: f64, span: f64) {
        // Time since `from`: late in a run, the time since the start could not resolve two short steps.
        let mut done = 0.0;
        while done < span {
            let now = from + done;
            self.keep_near(&tool.position, &tool.velocity, now);
            let mut end = (done + LONGEST).min(self.next_kink(now) - from);
            if let Drive::Arm(arm) = drive {
                arm.plan();
                end = end.min(done + arm.phase());
            }
            end = end.max(done + 1e-12);
            if span - end < 1e-12 {
                end = span;
            }
            let piece = Piece { origin: from, inside: from + 0.5 * (done + end), planned: done };
            let reached = if let Drive::Arm(arm) = drive { self.slide(arm, tool, piece, end) } else { done };
            if reached < end {
                self.solve_piece(drive, tool, piece, reached, end);
            }
            if let Drive::Arm(arm) = drive {
                arm.advance(end - done);
            }
            done = end;
        }
    }

    /// Advance over a piece without kinks.
    fn solve_piece(&mut self, drive: &Drive<'_, N>, tool: &mut Tool<N>, piece: Piece, begin: f64, end: f64) {
        // Taken out of the environment while in use, so that the rest can be read meanwhile.
        let mut solver = std::mem::take(&mut self.solver);
        let mut done = begin;
        let mut attempts = 0;
        // For the whole piece, even if only a part is left.
        let limit = allowed_attempts(end - piece.planned);
        // After a stiff piece, another full trial is rarely worth its cost.
        let patience = limit / if std::mem::take(&mut solver.gave_up) { 200 } else { 10 };
        // Time up to which the bodies out of reach have moved.
        let mut coasted = begin;
        let mut known = false;
        self.load(&mut solver, tool);
        while done < end {
            let now = piece.origin + done;
            let left = end - done;
            let (speed, ahead) = (solver.state[1].norm(), solver.step.min(left));
            if !self.reach.covers(&solver.state[0], now + ahead, 2.0 * speed * ahead) {
                self.look_around(&mut solver, now, done - coasted);
                coasted = done;
                known = false;
            }
            known &= !self.settle(&mut solver, piece, now);
            let blocks = TOOL + 2 * self.near_bodies();
            if !known {
                self.slopes(drive, &mut solver, 0, piece, now, done - piece.planned);
            }
            let mut step = solver.step.clamp(SHORTEST, LONGEST).min(left);
            let mut proposed;
            loop {
                attempts += 1;
                self.stages(drive, &mut solver, blocks, piece, (now, done - piece.planned), step);
                let error = solver.error(blocks, step);
                proposed = step * (0.9 * error.powf(-0.2)).clamp(0.2, 5.0);
                let short = step <= SHORTEST;
                if error > 1.0 && !short {
                    step = proposed.max(SHORTEST);
                    solver.step = step;
                    continue;
                }
                if !short && !self.reach.covers(&solver.next[0], now + step, 0.0) {
                    step = (0.5 * step).max(SHORTEST);
                    continue;
                }
                break;
            }
            if attempts > limit
                || (attempts > patience && slow(attempts, limit, (done - begin) / (end - begin)))
            {
                coasted = self.coarsely(drive, &mut solver, piece, (done, end), coasted);
                break;
            }
            if let Some(share) = self.first_change(&mut solver, blocks, piece, now, step) {
                step = (share * step).max(SHORTEST.min(left));
                self.stages(drive, &mut solver, blocks, piece, (now, done - piece.planned), step);
                known = false;
            } else {
                solver.combine(blocks, step, STAGES[6]);
                solver.step = if step < left { proposed } else { proposed.max(solver.step) }.min(LONGEST);
                known = true;
                solver.slopes.swap(0, 6);
            }
            if !solver.next[..blocks].iter().all(all_finite) {
                // Overflow: the tool stays at its last position.
                solver.state[1] = Axes::zeros();
                solver.coarse_steps += 1;
                break;
            }
            let Solver { state, next, .. } = &mut solver;
            std::mem::swap(state, next);
            done = if step >= left { end } else { done + step };
        }
        self.store(&solver);
        self.coast(end - coasted);
        *tool = Tool { position: solver.state[0], velocity: solver.state[1], set_velocity: solver.state[2] };
        self.solver = solver;
    }

    /// Slopes of the state at a stage; stage 0 reads `state`, the others read `next`.
    fn slopes(
        &self,
        drive: &Drive<'_, N>,
        solver: &mut Solver<N>,
        stage: usize,
        piece: Piece,
        now: f64,
        since_plan: f64,
    ) {
        let Solver { state, next, slopes, .. } = solver;
        let state: &[Axes<N>] = if stage == 0 { state } else { next };
        let slopes = &mut slopes[stage];
        let mut force = self.push(piece.inside, now);
        for &index in &self.reach.near {
            let slot = self.slots[index];
            let mut reaction = Axes::zeros();
            if self.modes[index] == Mode::Touching {
                let (place, velocity) = self.relative(state, index, piece, now);
                reaction = self.smooth(index, &place, &velocity);
                force += reaction;
            }
            if let Some(body) = self.objects[index].body() {
                let (at, moving) = (TOOL + 2 * slot, &state[TOOL + 2 * slot + 1]);
                let held = body.stands;
                slopes[at] = if held { Axes::zeros() } else { *moving };
                slopes[at + 1] = if held { Axes::zeros() } else { body.acceleration(moving, &-reaction) };
            }
        }
        slopes[0] = state[1];
        let tool = Tool { position: state[0], velocity: state[1], set_velocity: state[2] };
        (slopes[1], slopes[2]) = match drive {
            Drive::Straight => (Axes::zeros(), Axes::zeros()),
            Drive::Arm(arm) => arm.accelerations(since_plan, &tool, &force),
        };
    }

    /// All stages of one step, from the slopes of stage 0; the result is in `next`.
    fn stages(
        &self,
        drive: &Drive<'_, N>,
        solver: &mut Solver<N>,
        blocks: usize,
        piece: Piece,
        (now, since_plan): (f64, f64),
        step: f64,
    ) {
        for stage in 1..7 {
            solver.combine(blocks, step, STAGES[stage]);
            let ahead = NODES[stage] * step;
            self.slopes(drive, solver, stage, piece, now + ahead, since_plan + ahead);
        }
    }

    /// Solve the rest of a piece by a method that is stable at any stiffness. Returns the time up to which the far
    /// bodies have moved.
    fn coarsely(
        &mut self,
        drive: &Drive<'_, N>,
        solver: &mut Solver<N>,
        piece: Piece,
        (mut done, end): (f64, f64),
        mut coasted: f64,
    ) -> f64 {
        const COARSE: f64 = 2e-5;
        solver.gave_up = true;
        let steps = ((end - done) / COARSE).ceil().max(1.0);
        let step = (end - done) / steps;
        while end - done > 0.5 * step {
            let now = piece.origin + done;
            if !self.reach.covers(&solver.state[0], now, 2.0 * step * solver.state[1].norm()) {
                self.look_around(solver, now, done - coasted);
                coasted = done;
            }
            done += step;
            solver.coarse_steps += 1;
            self.coarse_step(
                drive,
                &mut solver.state,
                (piece.inside, piece.origin + done),
                done - piece.planned,
                step,
            );
        }
        coasted
    }
}

/// Attempts for a piece of `span` in s: in proportion to it, so that short ticks do not each get the attempts of a long
/// one.
fn allowed_attempts(span: f64) -> u32 {
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // 0 to MAX_ATTEMPTS, and saturates
    let share = (f64::from(MAX_ATTEMPTS) * (span / LONGEST)) as u32;
    share.clamp(MIN_ATTEMPTS, MAX_ATTEMPTS)
}

/// True if the rest of the piece would need more than `limit` attempts at the present progress.
fn slow(attempts: u32, limit: u32, done: f64) -> bool {
    f64::from(attempts) > f64::from(limit) * done
}
