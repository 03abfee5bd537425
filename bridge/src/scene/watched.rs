//! Observation of both sides of a run at each tick, and the outcome.

mod aimed;
mod lanes;

use std::ops::ControlFlow;

use aimed::AimedReleases;
pub(super) use lanes::{MasterLaneTick, WatchedLanes};

use super::{
    assemble::SceneError,
    coupling::Present,
    measures::{Divergence, DivergenceCause, Ending, MeasureSettings, Measures, Outcome},
    pose::{self, RotationMeasures},
    record::{EventLog, Recorder, Sample, SceneRun},
    spec::SceneSpec,
    timed::Timed,
    tracking::Tracking,
};
use crate::{
    EndpointError, Event, Exchange, LadderState, LoopCounts, MasterPlant, MasterRecord, MasterSide,
    MasterTurn, ModelArm, OperatorCommand, Reason, Side as _, SideKind, SlavePlant, SlaveRecord, SlaveSide,
    SlaveTurn, VirtualSettings, coupling::CouplingError, live::LoopReport, virtual_time::VirtualCounts,
};
use haptether_safety::{
    Axes, Fault,
    controller::{ControllerKind, Tripped},
    norm,
};

/// Observer of both sides of a run.
#[derive(Clone)]
pub(super) struct Watched<const N: usize> {
    has_gripper: bool,
    takes_force: bool,
    judged: MeasureSettings,
    measures: Measures<N>,
    /// Distance of the arm in m that counts as divergence.
    max_distance: f64,
    log: EventLog,
    master: Recorder,
    slave: Recorder,
    /// Ladder states of master and slave.
    states: [LadderState; 2],
    engaged_s: Option<f64>,
    /// Reason that ended the first attempt to engage with alignment.
    ended_by: Option<Reason>,
    /// Time in ns since the start at which each side first coupled; `u64::MAX` if never.
    engaged_ns: [u64; 2],
    /// Time in ns of the newest tick of the master.
    newest_ns: u64,
    tracking: Tracking<N>,
    ticks: u64,
    diverged: Option<Divergence>,
    settled: bool,
    /// Frames dropped because too many were in flight.
    overflowed: u64,
    /// Measures of the rotation, if the hand turns.
    rotation: Option<RotationMeasures>,
    /// Time in s since engagement at which the hand lets go of the rotation.
    turn_release_s: Option<f64>,
    /// Releases of a hand that follows aims.
    aimed: AimedReleases,
    /// Error of an operator command that the coupling refused.
    refused: Option<CouplingError>,
    /// Duration in ns of a fade, out and in. The last fade ends at `fades_until_ns`; until then tracking errors are
    /// not measured.
    fade_ns: u64,
    fades_until_ns: u64,
}

impl<const N: usize> Watched<N> {
    /// Build the observer before the first tick of a device at `start` in m, with the operator commands and their
    /// times.
    pub(super) fn new(
        scene: &SceneSpec<N>,
        settings: &VirtualSettings,
        commands: Vec<(u64, OperatorCommand)>,
        start: &Axes<N>,
        has_gripper: bool,
    ) -> Result<Self, SceneError> {
        let (_, coupling) = scene.coupled()?;
        let rotation = match scene.master.kind {
            SideKind::Pose => {
                let lock = pose::rotation_lock(coupling).map_err(EndpointError::from)?;
                Some(RotationMeasures::new(coupling, lock).map_err(EndpointError::from)?)
            }
            SideKind::Linear | SideKind::Joints => None,
        };
        let coupling = Present::new(coupling, commands);
        let longest_ns = settings.period_ns.max(settings.slave_period_ns);
        let every = scene.record.as_ref().map_or(0, |record| record.every);
        // Both sides are recorded at about the same rate.
        let slave_every = (every * settings.period_ns).div_ceil(settings.slave_period_ns);
        let judged = MeasureSettings::of(scene);
        // Until engagement, a scheduled release lies in the future.
        let ahead = MeasureSettings { release_s: judged.release_s.map(|_| f64::INFINITY), ..judged };
        let takes_force = scene.slave.as_ref().is_some_and(|arm| arm.takes_force);
        Ok(Self {
            has_gripper,
            takes_force,
            judged,
            measures: Measures::new(&ahead, start),
            max_distance: scene.run.diverged_position * coupling.max_position_scale().max(1.0),
            log: EventLog::default(),
            master: Recorder::new(every, settings.ticks),
            slave: Recorder::new(
                slave_every,
                (settings.ticks * settings.period_ns).div_ceil(settings.slave_period_ns),
            ),
            states: [LadderState::Disengaged; 2],
            engaged_s: None,
            ended_by: None,
            engaged_ns: [u64::MAX; 2],
            newest_ns: 0,
            tracking: Tracking::new(judged.metrics, coupling),
            ticks: 0,
            diverged: None,
            settled: false,
            overflowed: 0,
            rotation,
            turn_release_s: turn_release_s(scene),
            aimed: AimedReleases::of(scene),
            refused: None,
            fade_ns: 2 * (scene.safety.ladder.unwrap_or_default().fade_in_ns + longest_ns),
            fades_until_ns: 0,
        })
    }

    /// Take the record of a tick of either side; break if the run has diverged or settled.
    #[inline(always)] // once a tick, from few places
    pub(super) fn take<P, A, R, Q>(
        &mut self,
        event: &Event<'_, MasterRecord<N, R>, SlaveRecord<N, Q>>,
        master: &MasterSide<P, N, R>,
        arm: &A,
    ) -> ControlFlow<()>
    where
        P: MasterPlant<N>,
        A: ModelArm,
        R: MasterTurn,
        Q: SlaveTurn,
    {
        match event {
            Event::Master(record) => self.take_master(record, master),
            Event::Slave(record) => self.take_slave(record, arm),
        }
    }

    /// Apply the operator's changes due at `now_ns`.
    #[inline(always)] // most ticks have none due
    fn change(&mut self, now_ns: u64) {
        match self.changed(now_ns) {
            Ok(true) => {
                self.tracking.restart();
                if self.states.iter().any(|state| state.is_coupled()) {
                    self.fades_until_ns = now_ns.saturating_add(self.fade_ns);
                }
            }
            Ok(false) => {}
            Err(error) => self.refused = Some(error),
        }
    }

    /// Return true if both sides are coupled and no change is fading at `now_ns`.
    #[inline(always)] // as change
    fn is_comparable(&self, now_ns: u64) -> bool {
        self.states.iter().all(|state| state.is_coupled()) && now_ns >= self.fades_until_ns
    }

    /// Apply the due changes to coupling and rotation; return true if anything changed.
    #[inline(always)] // as change
    fn changed(&mut self, now_ns: u64) -> Result<bool, CouplingError> {
        let coupling = &mut self.tracking.coupling;
        if !coupling.is_due(now_ns) {
            return Ok(false);
        }
        let before = coupling.done();
        let changed = coupling.advance(now_ns)?;
        if let Some(rotation) = &mut self.rotation {
            for command in coupling.since(before) {
                rotation.change(command)?;
            }
        }
        Ok(changed)
    }

    /// Restart the measures at engagement, because the hand's schedule begins there.
    fn engage(&mut self, time_s: f64, start: &Axes<N>) {
        self.engaged_s = Some(time_s);
        self.judged = from_engagement(&self.judged, time_s);
        self.judged.release_s = self.judged.release_s.or(self.aimed.engage(time_s));
        self.measures = Measures::new(&self.judged, start);
        if let Some(rotation) = &mut self.rotation {
            rotation.engage(time_s + self.turn_release_s.unwrap_or(0.0));
        }
    }

    #[inline]
    fn ladder(&mut self, side: usize, time_ns: u64, state: LadderState, reason: u8) {
        let before = std::mem::replace(&mut self.states[side], state);
        if before != state {
            self.ladder_changed(side, time_ns, [before, state], reason);
        }
    }

    #[inline(never)]
    fn ladder_changed(&mut self, side: usize, time_ns: u64, [before, state]: [LadderState; 2], reason: u8) {
        let time_s = time_ns as f64 / 1e9;
        if state.is_coupled() {
            self.engaged_ns[side] = self.engaged_ns[side].min(time_ns);
        }
        // Changes between coupled states are not logged: late frames may cause thousands of them, and the signals show
        // them.
        if !(before.is_coupled() && state.is_coupled()) {
            let side = ["master", "slave"][side];
            let detail = match Reason::from_code(reason) {
                Some(reason) => format!("{side}: {}", reason.text()),
                None => side.to_owned(),
            };
            self.log.add(time_s, state.name(), detail);
            // The side that ends the attempt has the reason; the peer receives it later.
            if before == LadderState::Aligning && !state.is_coupled() {
                self.ended_by = self.ended_by.or(Reason::from_code(reason));
            }
        }
    }

    fn diverge(&mut self, time_s: f64, cause: DivergenceCause) -> ControlFlow<()> {
        self.diverged = Some(Divergence { time_s, cause });
        ControlFlow::Break(())
    }

    /// Count a fault as divergence: a model produces invalid numbers only after its loop has diverged.
    fn faults(&mut self, side: &'static str, time_s: f64, code: u8) -> ControlFlow<()> {
        match Fault::from_code(code) {
            Some(fault) => self.diverge(time_s, DivergenceCause::Fault(side, fault)),
            None => ControlFlow::Continue(()),
        }
    }

    #[inline(always)] // as take
    fn take_master<P: MasterPlant<N>, R: MasterTurn>(
        &mut self,
        record: &MasterRecord<N, R>,
        side: &MasterSide<P, N, R>,
    ) -> ControlFlow<()> {
        let flow = self.measure_master(record);
        if self.diverged.is_some() {
            return flow;
        }
        if let Some(felt) = side.felt() {
            self.log.trigger_tripped(record.time_ns as f64 / 1e9, felt.intervention.tripped);
        }
        if self.master.begin_tick() {
            self.record_master(record, side, record.time_ns as f64 / 1e9);
        }
        flow
    }

    /// Take the record of a tick of the master without its signals; break as in [`take`](Self::take).
    #[inline(always)] // as take
    pub(super) fn measure_master<R: MasterTurn>(&mut self, record: &MasterRecord<N, R>) -> ControlFlow<()> {
        let time_s = record.time_ns as f64 / 1e9;
        self.change(record.time_ns);
        self.ladder(0, record.time_ns, record.state, record.reason);
        self.faults("master", time_s, record.fault)?;
        if record.state.is_coupled() && self.engaged_s.is_none() {
            self.engage(time_s, &record.true_position);
        }
        let (x, v, force) = (&record.true_position, &record.velocity, &record.device_force);
        if self.measures.diverged(x, v, force) {
            return self.diverge(time_s, self.measures.cause(0, x, v));
        }
        let turn = record.rotation.rotation();
        let tripped = record.tripped | turn.map_or(0, |turn| turn.tripped);
        let settled = self.measures.take(
            time_s,
            x,
            v,
            &record.rendered_force,
            force,
            &record.hand_force,
            (tripped != 0).then_some(true),
        );
        self.aimed.take(time_s, v);
        self.settled = settled == Some(true) && self.engaged_s.is_some();
        self.ticks += 1;
        self.log.tripped(time_s, Tripped::from_bits(tripped));
        let coupled = self.is_comparable(record.time_ns);
        if let (Some(rotation), Some(turn)) = (&mut self.rotation, turn)
            && self.judged.metrics.has_rotation()
        {
            rotation.take_master(time_s, turn, coupled);
        }
        self.tracking.take_master(coupled, x, force);
        self.newest_ns = record.time_ns;
        if self.settled { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    }

    /// Record the signals of a tick of the master.
    #[inline(never)]
    fn record_master<P: MasterPlant<N>, R: MasterTurn>(
        &mut self,
        record: &MasterRecord<N, R>,
        side: &MasterSide<P, N, R>,
        time_s: f64,
    ) {
        let age_s = if record.age_ns == u64::MAX { f64::NAN } else { record.age_ns as f64 * 1e-9 };
        let signals = [
            ("time_s", Sample::Scalar(time_s)),
            ("position", Sample::Vector(&record.true_position)),
            ("measured_position", Sample::Vector(&record.position)),
            ("velocity", Sample::Vector(&record.velocity)),
            ("hand_force", Sample::Vector(&record.hand_force)),
            ("rendered_force", Sample::Vector(&record.rendered_force)),
            ("grasp_force", Sample::Vector(&record.grasp_force)),
            ("safety_force", Sample::Vector(&record.safety_force)),
            ("device_force", Sample::Vector(&record.device_force)),
        ];
        let trigger = self.has_gripper.then_some(("trigger", Sample::Scalar(record.trigger)));
        let observed =
            ControllerKind::ALL.map(|kind| (kind.observed().column, Sample::Scalar(record.observers[kind])));
        let state = [
            ("tripped", Sample::Scalar(f64::from(record.tripped))),
            ("state", Sample::Scalar(f64::from(record.state.code()))),
            ("age_s", Sample::Scalar(age_s)),
        ];
        self.master.take(signals.into_iter().chain(observed).chain(state).chain(trigger));
        if let Some(turn) = record.rotation.rotation() {
            self.master.also(|add| turn.signals(add));
        }
        if side.felt().is_some() {
            self.master.also(|add| side.finger_signals(add));
        }
    }

    #[inline(always)] // as take
    fn take_slave<Q: SlaveTurn>(
        &mut self,
        record: &SlaveRecord<N, Q>,
        arm: &impl ModelArm,
    ) -> ControlFlow<()> {
        self.measure_slave(record)?;
        if self.slave.begin_tick() {
            self.record_slave(record, arm, record.time_ns as f64 / 1e9);
        }
        ControlFlow::Continue(())
    }

    /// Take the record of a tick of the slave without its signals; break if the run has diverged.
    #[inline(always)] // as take
    pub(super) fn measure_slave<Q: SlaveTurn>(&mut self, record: &SlaveRecord<N, Q>) -> ControlFlow<()> {
        let time_s = record.time_ns as f64 / 1e9;
        self.change(record.time_ns);
        self.ladder(1, record.time_ns, record.state, record.reason);
        self.faults("slave", time_s, record.fault)?;
        let distance = norm(&record.position);
        if distance.is_nan() || distance > self.max_distance {
            return self.diverge(time_s, DivergenceCause::Arm(distance));
        }
        self.log.touches(time_s, record.touches);
        self.log.grips(time_s, record.holds_object);
        let coupled = self.is_comparable(record.time_ns);
        self.tracking.take_slave(coupled, &record.position, &record.environment_force);
        let turn = record.rotation.rotation();
        if let (Some(turn), Some(rotation)) = (turn, &mut self.rotation)
            && self.judged.metrics.has_rotation()
        {
            rotation.take_slave(turn);
        }
        ControlFlow::Continue(())
    }

    /// Record the signals of a tick of the slave.
    #[inline(never)]
    fn record_slave<Q: SlaveTurn>(&mut self, record: &SlaveRecord<N, Q>, arm: &impl ModelArm, time_s: f64) {
        let gripper = self.has_gripper.then_some([
            ("gripper", Sample::Scalar(record.gripper)),
            ("gripper_command", Sample::Scalar(record.gripper_command)),
            ("gripper_force", Sample::Scalar(record.gripper_force)),
            ("holds_object", Sample::Scalar(f64::from(u8::from(record.holds_object)))),
        ]);
        let exerted = self.takes_force.then_some(("exerted_force", Sample::Vector(&record.exerted_force)));
        self.slave.take(
            [
                ("slave_time_s", Sample::Scalar(time_s)),
                ("slave_position", Sample::Vector(&record.position)),
                ("slave_command", Sample::Vector(&record.command)),
                ("environment_force", Sample::Vector(&record.environment_force)),
                ("slave_state", Sample::Scalar(f64::from(record.state.code()))),
            ]
            .into_iter()
            .chain(exerted)
            .chain(gripper.into_iter().flatten()),
        );
        if let Some(turn) = record.rotation.rotation() {
            self.slave.also(|add| {
                turn.signals(add);
                arm.world(add);
            });
        }
    }

    /// Return the reason why the sides never engaged.
    fn never_engaged(&self, heard: bool) -> &'static str {
        match self.ended_by {
            _ if !heard => "master and slave did not hear each other",
            Some(reason) => reason.text(),
            None if self.states.contains(&LadderState::Aligning) => {
                "the run ended before both sides had aligned"
            }
            None => "the clutch was not pressed",
        }
    }

    fn ending(&self) -> Ending {
        if self.diverged.is_some() {
            Ending::Diverged
        } else if let Some(apart) = self.states.iter().find(|state| !state.is_coupled()) {
            Ending::Uncoupled(*apart)
        } else if self.settled {
            Ending::Settled
        } else {
            Ending::Complete
        }
    }

    /// Return the outcome of the run.
    pub(super) fn outcome(&self) -> Result<Outcome, SceneError> {
        if let Some(error) = self.refused {
            return Err(EndpointError::from(error).into());
        }
        let mut outcome = self.measures.outcome(0, self.ticks, self.ending(), self.diverged);
        outcome.max_ejection_velocity =
            outcome.max_ejection_velocity.map(|peak| self.aimed.peak().unwrap_or(peak));
        [outcome.position_rmse_m, outcome.force_rmse_n] = self.tracking.rmse(0);
        if let Some(rotation) = &self.rotation {
            outcome = rotation.complete(outcome, self.judged.metrics);
        }
        Ok(if self.engaged_s.is_none() { outcome.never_engaged() } else { outcome })
    }

    /// Return the outcome with signals, events and reports, from the sides after the last tick.
    pub(super) fn finish<P, A, R, Q>(
        mut self,
        scene: &SceneSpec<N>,
        settings: &VirtualSettings,
        master: &Timed<MasterSide<P, N, R>>,
        slave: &Timed<SlaveSide<A, N, Q>>,
        counts: &VirtualCounts,
    ) -> Result<SceneRun, SceneError>
    where
        P: MasterPlant<N>,
        A: SlavePlant<N> + ModelArm,
        R: MasterTurn,
        Q: SlaveTurn,
    {
        let coarse = slave.side.plant.coarse_steps();
        self.overflowed = counts.overflowed;
        let engaged_ns = self.engaged_ns;
        let [of_master, of_slave] = &counts.loops;
        let reports = [
            report(master.exchange(), of_master, engaged_ns[0], settings.secure),
            report(slave.exchange(), of_slave, engaged_ns[1], settings.secure),
        ];
        let links = reports.each_ref().map(|report| report.link);
        let outcome = self.outcome()?;
        // With a clock error, the number of ticks does not give the true time.
        let end_s = self.newest_ns as f64 / 1e9 + scene.run.period_s;
        self.log.schedule(scene, self.engaged_s.unwrap_or(f64::INFINITY), &outcome);
        if self.engaged_s.is_some() {
            self.aimed.log(end_s, &mut self.log);
        }
        if self.engaged_s.is_none() && self.diverged.is_none() {
            let heard = reports.iter().all(|report| report.link.fresh > 0);
            self.log.add(end_s, "never-engaged", self.never_engaged(heard));
        }
        if self.settled {
            self.log.add(end_s, "settled", "nothing more happens");
        }
        self.log.coarse(end_s, coarse);
        let missing: u64 = links.iter().map(|link| link.missing).sum();
        if missing > 0 {
            let sent: u64 = links.iter().map(|link| link.sent).sum();
            self.log.add(end_s, "lost", format!("{missing} of {sent} frames did not arrive"));
        }
        for (side, link) in ["master", "slave"].into_iter().zip(&links) {
            if link.refused > 0 {
                self.log.add(
                    end_s,
                    "refused",
                    format!("{side}: {} datagrams were none of the peer's", link.refused),
                );
            }
        }
        if self.overflowed > 0 {
            let detail = format!("{} frames were dropped: too many were under way", self.overflowed);
            self.log.add(end_s, "overflow", detail);
        }
        let mut signals = self.master.into_signals();
        signals.extend(self.slave.into_signals());
        Ok(SceneRun {
            signals,
            events: self.log.into_events(),
            outcome,
            period_s: scene.run.period_s,
            reports: Some(reports),
        })
    }
}

/// Shift the times of the measures by the engagement at `time_s`, where the hand's schedule begins.
fn from_engagement(judged: &MeasureSettings, time_s: f64) -> MeasureSettings {
    // Round to whole ns, like the tick times compared with it.
    let since = |release: f64| ((release + time_s) * 1e9).round() / 1e9;
    MeasureSettings {
        release_s: judged.release_s.map(since),
        quiet_after_s: judged.quiet_after_s.map(|quiet| quiet + time_s),
        ..*judged
    }
}

/// Return when the hand lets go of the rotation, in s since engagement; by default when it lets go of the device.
fn turn_release_s<const N: usize>(scene: &SceneSpec<N>) -> Option<f64> {
    let operator = scene.operator.as_ref()?;
    let of_turn = operator.rotation.as_ref().and_then(|rotation| rotation.release);
    of_turn.or(operator.release).map(|release| release.at_s)
}

/// Return the report of a loop, in the form of a live run.
fn report(exchange: &Exchange, counts: &LoopCounts, engaged_ns: u64, secure: bool) -> LoopReport {
    let LoopCounts { ticks, skipped, clock_ns, rejections } = *counts;
    let of_side = exchange.counts();
    LoopReport {
        ticks,
        skipped,
        link: of_side.link.with(&rejections),
        path: exchange.link().path().report(clock_ns),
        holds: of_side.holds,
        limited: of_side.limited,
        outliers: of_side.outliers,
        secure,
        rejections,
        engaged_ns,
        ..LoopReport::default()
    }
}
