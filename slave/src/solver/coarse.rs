//! One step of the linearly implicit Euler method, for systems too stiff for explicit steps.

use nalgebra::SMatrix;

use crate::{
    Axes, Environment, all_finite,
    arm::drive::Tool,
    solver::{adaptive::Drive, state::TOOL},
};

impl<const N: usize> Environment<N> {
    /// Advance `state` by `step` in s to the time `now`, on the smooth piece valid at `piece`.
    ///
    /// `(M + h B + h² K) dV = h F - h² K V`, with the slopes K, B >= 0 of all forces at the beginning. The matrix is
    /// symmetric and positive definite, so a passive environment only loses energy, at any step. Bodies follow the tool
    /// within the step.
    ///
    /// Source: E. Hairer, G. Wanner, "Solving ordinary differential equations II", section IV.7 (Rosenbrock methods).
    pub(crate) fn coarse_step(
        &mut self,
        drive: &Drive<'_, N>,
        state: &mut [Axes<N>],
        (piece, now): (f64, f64),
        since_plan: f64,
        step: f64,
    ) {
        let (position, velocity) = (state[0], state[1]);
        let mut force = self.push(piece, now);
        let mut matrix = SMatrix::<f64, N, N>::zeros();
        let mut ahead = Axes::<N>::zeros();
        for &index in &self.reach.near {
            let (displacement, moving) = self.place_of(state, index, piece, now);
            let slip = velocity - moving;
            let Some(reaction) = self.linearised(index, &(position - displacement), &slip) else { continue };
            force += reaction.force;
            let along = reaction.normal * reaction.normal.transpose();
            let across = SMatrix::<f64, N, N>::identity() - along;
            // A spring has no normal: it resists along all axes.
            let stiff = if reaction.normal == Axes::<N>::zeros() { across } else { along };
            let springs = stiff * reaction.stiffness;
            matrix +=
                along * (step * reaction.damping) + across * (step * reaction.drag) + springs * (step * step);
            ahead += springs * slip * (step * step);
        }
        if let Drive::Arm(arm) = drive {
            let tool = Tool { position, velocity, set_velocity: state[2] };
            let (acceleration, set_acceleration) = arm.accelerations(since_plan, &tool, &force);
            let (mass, stiffness, damping) = arm.inertia();
            matrix += SMatrix::<f64, N, N>::identity() * (mass + step * (damping + step * stiffness));
            let push = acceleration * (mass * step) - ahead - velocity * (step * step * stiffness);
            if let Some(cholesky) = matrix.cholesky() {
                let faster = velocity + cholesky.solve(&push);
                state[1] = if all_finite(&faster) { faster } else { Axes::zeros() };
            }
            let set_velocity = state[2] + set_acceleration * step;
            state[2] = arm.within_speed(&set_velocity);
        }
        let moved = position + state[1] * step;
        if all_finite(&moved) {
            state[0] = moved;
        }
        self.coarse_bodies(state, (piece, now), step);
    }

    fn coarse_bodies(&mut self, state: &mut [Axes<N>], (piece, now): (f64, f64), step: f64) {
        for near in 0..self.reach.near.len() {
            let index = self.reach.near[near];
            if self.objects[index].body().is_none() {
                continue;
            }
            let (displacement, moving) = self.place_of(state, index, piece, now);
            let slip = state[1] - moving;
            let touch = self.linearised(index, &(state[0] - displacement), &slip);
            let (reaction, stiffness, damping) = touch.map_or((Axes::zeros(), 0.0, 0.0), |touch| {
                (-touch.force, touch.stiffness, touch.damping.max(touch.drag))
            });
            let slot = TOOL + 2 * self.slots[index];
            let Some(body) = self.objects[index].body_mut() else { continue };
            let rests = moving.norm() <= crate::contact::object::STANDS && body.holds(&reaction);
            body.stands = rests;
            let drag = body.drag(&moving);
            let weight = body.mass_kg + step * (damping + drag + step * stiffness);
            let push = (reaction - moving * drag) * step + slip * (step * step * stiffness);
            let faster = if rests { Axes::zeros() } else { moving + push / weight };
            if all_finite(&faster) {
                state[slot] += faster * step;
                state[slot + 1] = faster;
            }
        }
    }
}
