//! What is seen of both sides of several runs that have the same link and ladders, side by side.

use haptether_numeric::{nowhere, pack};
use haptether_safety::{Advance, Axes, Real, norm};

use super::{Watched, from_engagement};
use crate::{
    LadderState, Truth,
    scene::{
        measures::{Ending, MeasureSettings, Measures, Outcome},
        tracking::Tracking,
    },
};

/// A tick of the master in each lane.
pub(in crate::scene) struct NearTick<'a, const N: usize, S: Real> {
    /// True time in ns.
    pub(in crate::scene) now_ns: u64,
    pub(in crate::scene) state: LadderState,
    pub(in crate::scene) truth: &'a Truth<N, S>,
    /// What the safety layers decided.
    pub(in crate::scene) decided: &'a Advance<N, S>,
}

/// What is seen of both sides as they run, in each lane.
pub(in crate::scene) struct WatchedLanes<const N: usize, S: Real> {
    judged: Vec<MeasureSettings>,
    measures: Measures<N, S>,
    tracking: Tracking<N, S>,
    /// Of the arm in m, beyond which the loop has diverged.
    max_distance: S,
    /// Of the master and the slave.
    states: [LadderState; 2],
    has_engaged: bool,
    ticks: u64,
}

impl<const N: usize, S: Real> WatchedLanes<N, S> {
    /// Of runs before their first tick; lanes that are left over repeat the last one. None where they are not measured alike,
    /// or turn.
    pub(in crate::scene) fn gather(of: &[&Watched<N>]) -> Option<Self> {
        if of.iter().any(|one| one.rotation.is_some() || one.ticks > 0) {
            return None;
        }
        Some(Self {
            judged: of.iter().map(|one| one.judged).collect(),
            measures: Measures::gather(&of.iter().map(|one| one.measures).collect::<Vec<_>>())?,
            tracking: Tracking::gather(&of.iter().map(|one| &one.tracking).collect::<Vec<_>>())?,
            max_distance: pack(of, |one| one.max_distance)?,
            states: [LadderState::Disengaged; 2],
            has_engaged: false,
            ticks: 0,
        })
    }

    fn is_coupled(&self) -> bool {
        self.states.iter().all(|state| state.is_coupled())
    }

    /// Take what the operator has changed by then; says whether it could be.
    #[inline(always)] // most ticks have none due
    fn change(&mut self, now_ns: u64) -> bool {
        if !self.tracking.coupling.is_due(now_ns) {
            return true;
        }
        let changed = self.tracking.coupling.advance(now_ns);
        if changed == Ok(true) {
            self.tracking.begin_anew();
        }
        changed.is_ok()
    }

    #[inline(never)] // once
    fn engage(&mut self, time_s: f64, start: &Axes<N, S>) {
        self.has_engaged = true;
        let begun = self.judged.iter().enumerate().map(|(lane, judged)| {
            let start = Axes::from_fn(|axis, _| start[axis].extract(lane));
            Measures::new(&from_engagement(judged, time_s), &start)
        });
        if let Some(measures) = Measures::gather(&begun.collect::<Vec<_>>()) {
            self.measures = measures;
        }
    }

    /// Take a tick of the master as [`Watched::measure_near`]; return where the loop has not diverged, and where nothing more
    /// will happen. What has diverged is not to be looked at any more.
    #[inline(always)] // once a tick, from one place
    pub(in crate::scene) fn near(&mut self, tick: &NearTick<'_, N, S>) -> [S::SimdBool; 2] {
        let NearTick { now_ns, state, truth, decided } = *tick;
        let time_s = now_ns as f64 / 1e9;
        if !self.change(now_ns) {
            return [nowhere::<S>(); 2];
        }
        self.states[0] = state;
        if state.is_coupled() && !self.has_engaged {
            self.engage(time_s, &truth.position);
        }
        let (x, v, force) = (&truth.position, &truth.velocity, &decided.device_force);
        let mut stays = !nowhere::<S>();
        if self.measures.may_have_diverged(x, v, force) {
            // A copy, for what a call gets the address of.
            let measures = self.measures;
            stays = !measures.diverged(x, v, force);
        }
        let response = &decided.response;
        let is_on = response.may_act.then_some(response.acts);
        let settled =
            self.measures.take(time_s, x, v, &decided.rendered_force, force, &truth.hand_force, is_on);
        self.ticks += 1;
        self.tracking.near(self.is_coupled(), x, force);
        [stays, settled.filter(|_| self.has_engaged).unwrap_or(nowhere::<S>())]
    }

    /// Take a tick of the slave as [`Watched::measure_far`], with x and `F_e`; return where the loop has not diverged.
    #[inline(always)] // as of the master
    pub(in crate::scene) fn far(
        &mut self,
        now_ns: u64,
        state: LadderState,
        [position, environment_force]: [&Axes<N, S>; 2],
    ) -> S::SimdBool {
        if !self.change(now_ns) {
            return nowhere::<S>();
        }
        self.states[1] = state;
        let is_coupled = self.is_coupled();
        self.tracking.far(is_coupled, position, environment_force);
        norm(position).simd_le(self.max_distance)
    }

    /// What the run of one lane has come to: all of it, or where it has settled.
    pub(in crate::scene) fn outcome(&self, lane: usize, has_settled: bool) -> Outcome {
        let apart = self.states.iter().find(|state| !state.is_coupled());
        let ending = match apart {
            Some(apart) => Ending::Uncoupled(*apart),
            None if has_settled => Ending::Settled,
            None => Ending::Complete,
        };
        let mut outcome = self.measures.outcome(lane, self.ticks, ending, None);
        [outcome.position_rmse_m, outcome.force_rmse_n] = self.tracking.rmse(lane);
        if self.has_engaged { outcome } else { outcome.never_engaged() }
    }
}
