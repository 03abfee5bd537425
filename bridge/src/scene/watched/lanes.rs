//! Measures of both sides of runs in lanes that share link and ladders.

use haptether_numeric::{no_lanes, pack};
use haptether_safety::{Advance, Axes, Real, norm};

use super::{Watched, from_engagement};
use crate::{
    LadderState, Truth,
    scene::{
        measures::{Ending, MeasureSettings, Measures, Outcome},
        tracking::Tracking,
    },
};

/// Tick of the master in each lane.
pub(in crate::scene) struct MasterLaneTick<'a, const N: usize, S: Real> {
    /// True time in ns.
    pub(in crate::scene) now_ns: u64,
    pub(in crate::scene) state: LadderState,
    pub(in crate::scene) truth: &'a Truth<N, S>,
    /// Decision of the safety layers.
    pub(in crate::scene) decided: &'a Advance<N, S>,
}

/// Measures of both sides in each lane.
pub(in crate::scene) struct WatchedLanes<const N: usize, S: Real> {
    judged: Vec<MeasureSettings>,
    measures: Measures<N, S>,
    tracking: Tracking<N, S>,
    /// Distance of the arm in m beyond which the loop has diverged.
    max_distance: S,
    /// States of master and slave.
    states: [LadderState; 2],
    has_engaged: bool,
    ticks: u64,
}

impl<const N: usize, S: Real> WatchedLanes<N, S> {
    /// Gather runs before their first tick; surplus lanes repeat the last one. None if they measure different metrics,
    /// turn or follow aims.
    pub(in crate::scene) fn gather(of: &[&Watched<N>]) -> Option<Self> {
        if of.iter().any(|one| one.rotation.is_some() || !one.aimed.is_empty() || one.ticks > 0) {
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

    /// Apply the operator's changes up to this time; return whether they are valid.
    #[inline(always)] // most ticks have none due
    fn change(&mut self, now_ns: u64) -> bool {
        if !self.tracking.coupling.is_due(now_ns) {
            return true;
        }
        let changed = self.tracking.coupling.advance(now_ns);
        if changed == Ok(true) {
            self.tracking.restart();
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

    /// Take a tick of the master as [`Watched::measure_master`]. Return the masks of lanes that have not diverged, and
    /// of lanes that have settled. The measures of a diverged lane are invalid.
    #[inline(always)] // once a tick, from one place
    pub(in crate::scene) fn take_master(&mut self, tick: &MasterLaneTick<'_, N, S>) -> [S::SimdBool; 2] {
        let MasterLaneTick { now_ns, state, truth, decided } = *tick;
        let time_s = now_ns as f64 / 1e9;
        if !self.change(now_ns) {
            return [no_lanes::<S>(); 2];
        }
        self.states[0] = state;
        if state.is_coupled() && !self.has_engaged {
            self.engage(time_s, &truth.position);
        }
        let (x, v, force) = (&truth.position, &truth.velocity, &decided.device_force);
        let mut stays = !no_lanes::<S>();
        if self.measures.may_have_diverged(x, v, force) {
            // A copy, so that the call does not force the original into memory.
            let measures = self.measures;
            stays = !measures.diverged(x, v, force);
        }
        let response = &decided.response;
        let is_on = response.may_act.then_some(response.acts);
        let settled =
            self.measures.take(time_s, x, v, &decided.rendered_force, force, &truth.hand_force, is_on);
        self.ticks += 1;
        self.tracking.take_master(self.is_coupled(), x, force);
        [stays, settled.filter(|_| self.has_engaged).unwrap_or(no_lanes::<S>())]
    }

    /// Take a tick of the slave as [`Watched::measure_slave`], with x and `F_e`; return the mask of lanes not diverged.
    #[inline(always)] // as of the master
    pub(in crate::scene) fn take_slave(
        &mut self,
        now_ns: u64,
        state: LadderState,
        [position, environment_force]: [&Axes<N, S>; 2],
    ) -> S::SimdBool {
        if !self.change(now_ns) {
            return no_lanes::<S>();
        }
        self.states[1] = state;
        let is_coupled = self.is_coupled();
        self.tracking.take_slave(is_coupled, position, environment_force);
        norm(position).simd_le(self.max_distance)
    }

    /// Return the outcome of a lane, of the whole run or up to where it has settled.
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
