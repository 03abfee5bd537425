//! Runs of a scene without an arm: what is touched is rendered on the device itself.

use std::sync::atomic::{AtomicBool, Ordering};

use haptether_safety::Real;
use nalgebra::SimdBool as _;

use super::measures::{Divergence, Ending, Measures, Outcome};
use crate::local::{LocalLoop, LocalPlant, LocalTick, Rendering};

/// A loop and what it is judged by.
pub(crate) struct LocalRun<P, R, const N: usize, S: Real = f64> {
    pub(crate) looped: LocalLoop<P, R, N, S>,
    pub(crate) measures: Measures<N, S>,
    pub(crate) ticks: u64,
}

impl<P: LocalPlant<N, S>, R: Rendering<N, S>, const N: usize, S: Real> LocalRun<P, R, N, S> {
    /// Runs all scenarios to their ends, unless `stop` is set meanwhile.
    #[inline(always)]
    pub(crate) fn run(&mut self, stop: &AtomicBool, outcomes: &mut [Option<Outcome>]) {
        self.run_telling(stop, |_, _, _| {}, outcomes);
    }

    /// Runs all scenarios to their ends; tells each tick, its time in s and the loop to `observe`. None has an outcome
    /// once `stop` is set before its end.
    ///
    /// A scenario that ends early keeps the measures of that moment; its lane runs on unseen until all have ended.
    #[inline(always)]
    pub(crate) fn run_telling(
        &mut self,
        stop: &AtomicBool,
        mut observe: impl FnMut(f64, &LocalTick<N, S>, &LocalLoop<P, R, N, S>),
        outcomes: &mut [Option<Outcome>],
    ) {
        for tick in 0..self.ticks {
            if stop.load(Ordering::Relaxed) || self.turn(tick, &mut observe, outcomes) {
                return;
            }
        }
        self.complete(outcomes);
    }

    /// One tick; says whether all scenarios have ended early.
    #[inline(always)]
    pub(crate) fn turn(
        &mut self,
        tick: u64,
        observe: &mut impl FnMut(f64, &LocalTick<N, S>, &LocalLoop<P, R, N, S>),
        outcomes: &mut [Option<Outcome>],
    ) -> bool {
        let time_s = self.looped.time_s();
        let step = self.looped.step();
        if self.measures.may_have_diverged(&step.position, &step.velocity, &step.device_force)
            && self.end_diverged(tick, time_s, &step, outcomes)
        {
            return true;
        }
        let settled = self.measures.take(
            time_s,
            &step.position,
            &step.velocity,
            &(step.asked_force + step.wall_force),
            &step.device_force,
            &step.hand_force,
            step.response.acts,
        );
        observe(time_s, &step, &self.looped);
        match settled {
            Some(settled) if settled.any() => {
                self.end(settled.bitmask(), tick + 1, Ending::Settled, outcomes)
            }
            _ => false,
        }
    }

    /// All ticks have been run.
    pub(crate) fn complete(&self, outcomes: &mut [Option<Outcome>]) {
        self.end(u64::MAX, self.ticks, Ending::Complete, outcomes);
    }

    /// Keeps the outcome of the lanes in `mask` that have none yet; says whether now all have one.
    #[cold]
    fn end(&self, mask: u64, ticks: u64, ending: Ending, outcomes: &mut [Option<Outcome>]) -> bool {
        for (lane, outcome) in outcomes.iter_mut().enumerate().take(S::LANES) {
            if mask >> lane & 1 == 1 && outcome.is_none() {
                *outcome = Some(self.measures.outcome(lane, ticks, ending, None));
            }
        }
        outcomes.iter().all(Option::is_some)
    }

    #[cold]
    fn end_diverged(
        &self,
        tick: u64,
        time_s: f64,
        step: &LocalTick<N, S>,
        outcomes: &mut [Option<Outcome>],
    ) -> bool {
        let mask = self.measures.diverged(&step.position, &step.velocity, &step.device_force).bitmask();
        for (lane, outcome) in outcomes.iter_mut().enumerate().take(S::LANES) {
            if mask >> lane & 1 == 1 && outcome.is_none() {
                let cause = self.measures.cause(lane, &step.position, &step.velocity);
                let divergence = Divergence { time_s, cause };
                *outcome = Some(self.measures.outcome(lane, tick, Ending::Diverged, Some(divergence)));
            }
        }
        outcomes.iter().all(Option::is_some)
    }
}
