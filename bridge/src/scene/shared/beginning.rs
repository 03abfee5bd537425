//! Runs that differ only in their controllers share their beginning.
//!
//! Until the first controller intervenes, the hand feels the same force in all runs. Device, arm, network and ladder
//! are then the same, bit for bit. So one run leads, and the others only compute their force from it, tick by tick. A
//! run that intervenes, or whose leader does, continues by itself from an earlier snapshot.

use std::{
    ops::ControlFlow,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
};

use super::super::{
    assemble::{SceneError, exact_master},
    bilateral::{self, RunOptions, SESSIONS, Sides},
    measures::Outcome,
    sides::{hand_and_coupling, simulated_arm, slave_endpoint, with_waiting_hand},
    spec::SceneSpec,
    timed::Timed,
    watched::Watched,
};
use super::Outcomes;
use crate::{
    Event, MasterPlant, MasterRecord, MasterSide, ModelArm, Side, SlavePlant, SlaveSide, VirtualSettings,
    endpoint::{Hand, HandInput, MasterReading},
    virtual_time::{BatchedRun, Snapshot},
};
use haptether_safety::{Axes, Fault, controller::Intervention};
use haptether_slave::SimulatedSlave;

/// Ticks of the master between two snapshots. Few ticks are repeated, and packets in flight are rarely copied.
const MAX_SINCE_SNAPSHOT: u64 = 400;

/// Return whether two scenes differ only in their controllers.
pub(super) fn share_beginning<const N: usize>(one: &SceneSpec<N>, other: &SceneSpec<N>) -> bool {
    let mut same = other.clone();
    same.safety.settings = one.safety.settings;
    same == *one
}

/// Compute the outcomes of scenes that share the beginning of the first one, each equal to that of a separate run.
///
/// The outcome of a scene that is not run here is None.
///
/// # Errors
///
/// [`SceneError::Stopped`].
pub(super) fn outcomes<const N: usize>(
    scenes: &[&SceneSpec<N>],
    stop: &AtomicBool,
) -> Result<Outcomes, SceneError> {
    let mut outcomes: Outcomes = vec![None; scenes.len()];
    let mut members = Vec::with_capacity(scenes.len());
    for (row, scene) in scenes.iter().enumerate() {
        match hand_and_coupling(scene) {
            Ok((hand, _)) => members.push(Member { row, hand }),
            Err(error) => outcomes[row] = Some(Err(error)),
        }
    }
    // The first valid scene; the others have the same device, arm and network.
    let Some(built) = members.first().map(|member| scenes[member.row]) else {
        return Ok(vec![None; scenes.len()]);
    };
    let shared = exact_master(built)
        .and_then(|plant| first_group(built, with_waiting_hand(plant), members))
        .and_then(|group| run(built, group, stop, &mut outcomes));
    match shared {
        Err(SceneError::Stopped) => Err(SceneError::Stopped),
        // Each scene is then run, and refused, by itself.
        Err(_) => Ok(vec![None; scenes.len()]),
        Ok(()) => Ok(outcomes),
    }
}

/// Run of a group.
#[derive(Clone)]
struct Member<const N: usize> {
    row: usize,
    /// Computes its force.
    hand: Hand<N>,
}

impl<const N: usize> Member<N> {
    /// Compute the force at a tick of the leader. Returns whether the run intervenes or differs from a leader that
    /// does not intervene.
    fn intervenes(&mut self, record: &MasterRecord<N>) -> bool {
        let measured = record.measured_velocity;
        let velocity = measured.iter().all(|v| !v.is_nan()).then_some(measured);
        let input = HandInput {
            received_force: record.received_force,
            requested_force: record.requested_force,
            gain: record.gain,
            missed: record.missed,
            past: record.past,
            fault: Fault::from_code(record.given_fault),
            ..HandInput::idle()
        };
        let (tick, _) = self.hand.tick(&MasterReading::point(record.position, velocity), &input);
        let Intervention { tripped, withheld, safety_force, .. } = &tick.intervention;
        let is_same = || {
            is_same(&tick.rendered_force, &record.rendered_force)
                && is_same(&tick.device_force, &record.device_force)
        };
        tripped.bits() != 0
            || *withheld
            || tick.fault.is_some()
            || *safety_force != Axes::<N>::zeros()
            || (!leader_intervenes(record) && !is_same())
    }
}

/// Compare bits: zeros of different sign give different results.
fn is_same<const N: usize>(one: &Axes<N>, other: &Axes<N>) -> bool {
    one.iter().zip(other).all(|(one, other)| one.to_bits() == other.to_bits())
}

/// Return whether the controllers of the leader act; PC damps without a trip.
fn leader_intervenes<const N: usize>(record: &MasterRecord<N>) -> bool {
    record.tripped != 0 || record.fault != 0 || record.safety_force != Axes::<N>::zeros()
}

/// State of runs that were equal so far.
struct Start<M: Side, S: Side, const N: usize> {
    run: Snapshot<M, S>,
    watched: Watched<N>,
    /// Ticks of the master that are not observed yet; no run intervenes in them.
    pending: usize,
}

/// Runs that were equal so far.
struct Group<M: Side, S: Side, const N: usize> {
    start: Arc<Start<M, S, N>>,
    /// Runs at the tick of the snapshot; the first one leads.
    members: Vec<Member<N>>,
}

type Master<P, const N: usize> = Timed<MasterSide<P, N>>;
type Slave<A, const N: usize> = Timed<SlaveSide<A, N>>;
type Running<P, A, const N: usize> = Group<Master<P, N>, Slave<A, N>, N>;

/// Build the group of all runs before the first tick; None if a run cannot be copied.
fn first_group<P: MasterPlant<N> + Clone, const N: usize>(
    scene: &SceneSpec<N>,
    plant: P,
    members: Vec<Member<N>>,
) -> Result<Option<Running<P, SimulatedSlave<N>, N>>, SceneError> {
    let options = RunOptions { outcome_only: true, ..RunOptions::default() };
    bilateral::check(scene)?;
    let settings = bilateral::settings(scene)?;
    let master = bilateral::master(scene, plant, &options)?;
    let slave = SlaveSide::new(simulated_arm(scene)?, slave_endpoint(scene, SESSIONS.1)?);
    let (mut master, mut slave, watched) = bilateral::prepared(scene, &settings, master, slave, &options)?;
    let run = BatchedRun::new(&settings, &mut master, &mut slave)?.snapshot();
    Ok(run.map(|run| Group { start: Arc::new(Start { run, watched, pending: 0 }), members }))
}

/// Run a group, and the runs that leave it, to the end.
fn run<P, A, const N: usize>(
    scene: &SceneSpec<N>,
    group: Option<Running<P, A, N>>,
    stop: &AtomicBool,
    outcomes: &mut [Option<Result<Outcome, SceneError>>],
) -> Result<(), SceneError>
where
    P: MasterPlant<N> + Clone,
    A: SlavePlant<N> + ModelArm + Clone,
{
    let settings = bilateral::settings(scene)?;
    Groups { scene, settings, waiting: Vec::from_iter(group), stop, outcomes }.run()
}

/// Groups to run, and the outcomes so far.
struct Groups<'a, P: MasterPlant<N>, A: SlavePlant<N>, const N: usize> {
    scene: &'a SceneSpec<N>,
    settings: VirtualSettings,
    waiting: Vec<Running<P, A, N>>,
    stop: &'a AtomicBool,
    outcomes: &'a mut [Option<Result<Outcome, SceneError>>],
}

impl<P, A, const N: usize> Groups<'_, P, A, N>
where
    P: MasterPlant<N> + Clone,
    A: SlavePlant<N> + ModelArm + Clone,
{
    /// Run all groups, and the runs that leave them, to the end.
    fn run(mut self) -> Result<(), SceneError> {
        while let Some(group) = self.waiting.pop() {
            self.follow(group)?;
        }
        Ok(())
    }

    /// Follow the leader of a group to its end. Runs that leave wait as groups of their own.
    fn follow(&mut self, mut kept: Running<P, A, N>) -> Result<(), SceneError> {
        let stop = self.stop;
        let mut followers = kept.members.clone();
        if followers.is_empty() {
            return Ok(());
        }
        let Member { row, hand } = followers.remove(0);
        let Start { run, watched, pending } = &*kept.start;
        let (mut watched, mut pending, mut since) = (watched.clone(), *pending, 0);
        let (mut master, mut slave) = (run.master.clone(), run.slave.clone());
        master.side.endpoint.set_hand(hand);
        let mut batched = BatchedRun::resume(&self.settings, run, &mut master, &mut slave)?;
        loop {
            let mut intervenes = false;
            let mut gone = vec![false; followers.len()];
            let flow = batched.advance(&mut |event, (master, slave): Sides<'_, '_, P, A, (), (), N>| {
                if stop.load(Ordering::Relaxed) {
                    return ControlFlow::Break(());
                }
                #[cfg(test)]
                tests::count(&event);
                if let Event::Master(record) = &event
                    && !followers.is_empty()
                    && !intervenes
                {
                    since += 1;
                    if pending > 0 {
                        pending -= 1;
                    } else {
                        intervenes = leader_intervenes(record);
                        for (follower, gone) in followers.iter_mut().zip(&mut gone) {
                            *gone = *gone || follower.intervenes(record);
                        }
                    }
                }
                watched.take(&event, &master.side, &slave.side.plant)
            });
            if stop.load(Ordering::Relaxed) {
                return Err(SceneError::Stopped);
            }
            if intervenes || gone.contains(&true) {
                self.part(&kept, &mut followers, &gone, intervenes);
            }
            if flow.is_break() {
                break;
            }
            if since >= MAX_SINCE_SNAPSHOT && !followers.is_empty() && pending == 0 {
                let mut members = vec![Member { row, hand: batched.master().side.endpoint.hand().clone() }];
                members.extend(followers.iter().cloned());
                let quiet = batched.pending_master_records().all(|record| {
                    !leader_intervenes(record)
                        && !members[1..].iter_mut().any(|member| member.intervenes(record))
                });
                if let (true, Some(run)) = (quiet, batched.snapshot()) {
                    let pending = batched.pending_master_records().count();
                    let start = Start { run, watched: watched.clone(), pending };
                    kept = Group { start: Arc::new(start), members };
                    since = 0;
                }
            }
        }
        let counts = batched.counts();
        let outcome = watched.finish(self.scene, &self.settings, &master, &slave, &counts);
        let outcome = outcome.map(|run| run.outcome);
        for same in followers {
            self.outcomes[same.row] = Some(outcome.clone());
        }
        self.outcomes[row] = Some(outcome);
        Ok(())
    }

    /// Continue followers from the snapshot `kept`: each of the `gone` ones by itself, and the others together if the
    /// leader intervenes.
    fn part(
        &mut self,
        kept: &Running<P, A, N>,
        followers: &mut Vec<Member<N>>,
        gone: &[bool],
        leader_intervenes: bool,
    ) {
        let mut left = Vec::new();
        let mut leave = |members| self.waiting.push(Group { start: kept.start.clone(), members });
        for (follower, gone) in followers.iter().zip(gone) {
            let member = kept.members.iter().find(|member| member.row == follower.row).cloned();
            if *gone {
                leave(Vec::from_iter(member));
            } else {
                left.extend(member);
            }
        }
        if leader_intervenes {
            followers.clear();
            if !left.is_empty() {
                leave(left);
            }
        } else {
            let mut gone = gone.iter();
            followers.retain(|_| gone.next() == Some(&false));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::virtual_time::MAX_BATCH_TICKS;
    use serde::Deserialize as _;
    use std::cell::Cell;

    thread_local! {
        static MASTER_TICKS: Cell<u64> = const { Cell::new(0) };
    }

    pub(super) fn count<M, S>(event: &Event<'_, M, S>) {
        if matches!(event, Event::Master(_)) {
            MASTER_TICKS.with(|ticks| ticks.set(ticks.get() + 1));
        }
    }

    /// Outcomes do not show whether a beginning is shared; the number of ticks does.
    #[test]
    fn three_runs_take_less_than_three() {
        let mut scene: serde_json::Value =
            serde_json::from_slice(include_bytes!("../../../tests/remote_push.json")).unwrap();
        scene["run"]["duration_s"] = 2.0.into();
        scene["operator"]["release"]["at_s"] = 1.0.into();
        let ticks = |sets: &[&[&str]]| {
            let of = |set: &&[&str]| {
                let mut scene = scene.clone();
                scene["safety"]["controllers"] = (*set).into();
                SceneSpec::<1>::deserialize(&scene).unwrap()
            };
            let scenes: Vec<_> = sets.iter().map(of).collect();
            MASTER_TICKS.with(|ticks| ticks.set(0));
            let all =
                super::super::outcomes(&scenes.iter().collect::<Vec<_>>(), true, &AtomicBool::new(false))
                    .unwrap();
            assert!(all.iter().all(Result::is_ok));
            MASTER_TICKS.with(Cell::get)
        };
        let three = ticks(&[&[], &["wsc"], &["hsc"]]);
        // Each intervenes a little after the release, about 1.1 s after the start. It continues from a snapshot that
        // is at most one interval of snapshots and the lead of a side old.
        let back = MAX_SINCE_SNAPSHOT + MAX_BATCH_TICKS as u64;
        assert!((2000 + 2 * 700..2000 + 2 * (900 + back)).contains(&three), "{three}");
        // PC intervenes from the start, so only the others share.
        let four = ticks(&[&["pc"], &[], &["wsc"], &["hsc"]]);
        assert!((three + 1900..=three + 2500).contains(&four), "{four}");
        // A single run does not come here, so nothing counts it.
        assert_eq!(ticks(&[&["wsc"]]), 0);
    }
}
