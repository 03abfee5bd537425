//! Decision over the command to an arm. Live runs, virtual time, and runs that share link and ladders all use
//! it.

use haptether_safety::{Axes, Excess, Fault, Guard, Sample, SampleBounds, Signal, Turned};
use nalgebra::UnitQuaternion;

use super::{
    EndpointError, SlaveReading, SlaveSettings, SlaveTranslation, TranslationInput, period_s,
    rotation::{SlaveRotation, SlaveRotationSettings, check_orientation},
};
use crate::{
    command::OperatorCommand,
    coupling::{
        AlignmentStep, CoupledSlave, CoupledSlaveTurn, CouplingError, Limited, MethodSettings, OfHalf,
        RotationState,
    },
    ladder::{AlignmentState, LadderState},
    port::{CouplingMessage, PortState},
    wire::{Padded, padded},
};

/// State of the master in the newest frame.
#[derive(Clone, Copy, Debug)]
pub(crate) struct MasterState<'a, const N: usize> {
    /// x in m.
    pub(crate) position: Axes<N>,
    /// V in m/s.
    pub(crate) velocity: Axes<N>,
    pub(crate) rotation: Option<&'a RotationState>,
    pub(crate) half: OfHalf<'a>,
}

/// Inputs of a tick beside the measurements of the arm.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ArmInput<'a, const N: usize> {
    pub(crate) state: LadderState,
    /// True if the arm may rotate to the master's orientation before the two engage.
    pub(crate) turns: bool,
    /// Time in ns that the ladder has been in STALE.
    pub(crate) stale_ns: u64,
    /// State of the master; none before the first frame.
    pub(crate) newest: Option<MasterState<'a, N>>,
}

#[derive(Clone, Copy, Debug)]
pub(crate) struct ArmTick<const N: usize> {
    /// Velocity in m/s of the commanded position; zero unless engaged.
    pub(crate) command_velocity: Axes<N>,
    /// Angular velocity in rad/s of the commanded orientation; zero unless engaged or rotating to the
    /// master's orientation.
    pub(crate) angular_velocity: Axes<3>,
    pub(crate) limited: Limited,
    /// Force in N and torque in N m of the coupling, for an engaged arm that takes forces.
    pub(crate) exerted: Option<(Axes<N>, Axes<3>)>,
}

/// Set force and torque of the next frame to zero.
fn without_wrench(outgoing: &mut PortState) {
    outgoing.force = Padded::zeros();
    if let Some(rotation) = &mut outgoing.rotation {
        rotation.torque = Axes::zeros();
    }
}

/// Lever in m that converts sample bounds of position to those of rotation: a tool of 0.1 m.
pub(crate) const TOOL_LEVER_M: f64 = 0.1;

/// Coupling and bounds of an arm, with their memory of the last tick.
#[derive(Clone, Debug)]
pub(crate) struct Arm<const N: usize> {
    translation: SlaveTranslation<N>,
    /// Half of the coupling. None for position-force, which commands the master's own motion.
    coupled: Option<Box<CoupledSlave<N>>>,
    /// Position in m and `F_e` in N at the last tick of this engagement, from which the work of the next tick counts.
    last: Option<[Axes<N>; 2]>,
    /// The same for the rotation.
    last_rotation: Option<RotationState>,
    /// Rotation; none for a point.
    rotation: Option<Box<SlaveRotation>>,
    fault: Option<Fault>,
    /// Speed beyond the arm's bound that caused the fault.
    excess: Option<Excess>,
    guard: Guard<N>,
    /// Force in N and moment in N m of the last sample that was not held.
    wrench: (Axes<N>, Axes<3>),
    /// Longest time in s covered by one step of an alignment: two periods.
    max_step_s: f64,
}

impl<const N: usize> Arm<N> {
    /// Build the arm of a point.
    pub(crate) fn new(settings: &SlaveSettings) -> Result<Self, EndpointError> {
        Ok(Self {
            translation: SlaveTranslation::new(settings)?,
            coupled: None,
            last: None,
            last_rotation: None,
            rotation: None,
            fault: None,
            excess: None,
            guard: Guard::new(
                SampleBounds::of_axes(N),
                SampleBounds::LINEAR.at_lever(TOOL_LEVER_M),
                period_s(settings.period_ns),
            ),
            wrench: (Axes::zeros(), Axes::zeros()),
            max_step_s: 2.0 * period_s(settings.period_ns),
        })
    }

    /// Set a coupling with two halves; the default is position-force.
    pub(super) fn set_coupling(&mut self, settings: &MethodSettings) {
        self.coupled = CoupledSlave::new(settings).map(Box::new);
        if let Some(rotation) = &mut self.rotation {
            rotation.coupled = CoupledSlaveTurn::new(settings).map(Box::new);
        }
    }

    /// Exchange the halves of the coupling with those of another one, while nothing couples the sides.
    pub(super) fn switch(
        &mut self,
        coupled: &mut Option<Box<CoupledSlave<N>>>,
        turning: &mut Option<Box<CoupledSlaveTurn>>,
    ) {
        std::mem::swap(&mut self.coupled, coupled);
        if let Some(rotation) = &mut self.rotation {
            std::mem::swap(&mut rotation.coupled, turning);
        }
        self.disengage();
    }

    /// Add `rotation` (three axes). A press waits for at most `align_s`.
    pub(super) fn turning(
        mut self,
        rotation: &SlaveRotationSettings,
        align_s: f64,
    ) -> Result<Self, EndpointError> {
        self.rotation = Some(Box::new(SlaveRotation::new(rotation, align_s)?));
        Ok(self)
    }

    /// Replace the sample bounds of position and rotation, before the first tick. The defaults are
    /// [`SampleBounds::of_axes`] and the linear bounds at a lever of 0.1 m.
    pub(crate) fn with_samples(self, [bounds, rotation]: [SampleBounds; 2], period_s: f64) -> Self {
        Self { guard: Guard::new(bounds, rotation, period_s), ..self }
    }

    pub(crate) fn guard(&self) -> &Guard<N> {
        &self.guard
    }

    /// Speed beyond the arm's bound that caused the fault.
    pub(super) fn excess(&self) -> Option<Excess> {
        self.excess
    }

    pub(crate) fn translation(&self) -> &SlaveTranslation<N> {
        &self.translation
    }

    /// Reserve `speed` in m/s and `angular_speed` in rad/s of the bounds for the arm's own braking.
    pub(super) fn set_braking(&mut self, [speed, angular_speed]: [f64; 2]) {
        self.translation.set_braking(speed);
        if let Some(rotation) = &mut self.rotation {
            rotation.set_braking(angular_speed);
        }
    }

    /// Check a sample. An invalid sample or a failed device is a fault. If the [`Guard`] holds the sample as
    /// implausible, returns its substitute: the prediction with the last wrench.
    #[inline(always)] // once per tick, from few callers
    pub(crate) fn check(
        &mut self,
        now_ns: u64,
        reading: &SlaveReading<N>,
        device_failed: bool,
    ) -> Result<Option<SlaveReading<N>>, Fault> {
        let SlaveReading { position, velocity, environment_force, .. } = reading;
        let checked = if device_failed { Err(Fault::Device) } else { Ok(()) }
            .and_then(|()| Signal::Position.check(position))
            .and_then(|()| Signal::Velocity.check(velocity))
            .and_then(|()| Signal::EnvironmentForce.check(environment_force))
            .and_then(|()| match &self.rotation {
                None => Ok(()),
                Some(_) => SlaveRotation::check(reading.rotation.as_ref()),
            })
            .and_then(|()| self.substitute(now_ns, reading));
        if let Err(fault) = checked {
            self.fault.get_or_insert(fault);
        }
        self.translation.accepts(matches!(checked, Ok(None)));
        checked
    }

    #[inline(always)] // once per tick, from few callers
    fn substitute(
        &mut self,
        now_ns: u64,
        reading: &SlaveReading<N>,
    ) -> Result<Option<SlaveReading<N>>, Fault> {
        let ticks = self.translation.sampled(now_ns);
        let SlaveReading { position, velocity, environment_force, rotation } = reading;
        let turned = rotation.as_ref().filter(|_| self.rotation.is_some()).map(|state| Turned {
            orientation: state.orientation,
            angular_velocity: Some(state.angular_velocity),
        });
        let sample = Sample { position: *position, velocity: Some(*velocity), rotation: turned };
        if let Err(excess) = self.guard.pass(&sample, ticks) {
            // The guard restarts its path at once; the fault lasts until it is acknowledged.
            self.guard.restart_at(&sample);
            self.excess.get_or_insert(excess);
            return Err(excess.fault());
        }
        if !self.guard.holds() {
            self.wrench = (*environment_force, rotation.map_or(Axes::zeros(), |state| state.torque));
            return Ok(None);
        }
        let Sample { position, velocity, rotation } = *self.guard.sample_in_use();
        let (environment_force, torque) = self.wrench;
        let rotation = rotation.map(|Turned { orientation, angular_velocity }| RotationState {
            orientation,
            angular_velocity: angular_velocity.unwrap_or(Axes::zeros()),
            torque,
        });
        let velocity = velocity.unwrap_or(Axes::zeros());
        Ok(Some(SlaveReading {
            position,
            velocity,
            environment_force,
            rotation: rotation.or(reading.rotation),
        }))
    }

    /// Return the alignment state and the next step towards the master's newest orientation, for an arm that
    /// aligns before it engages.
    ///
    /// `before` gives state and turn flag of the last tick, and the newest frame.
    #[inline(always)] // as check
    pub(super) fn align(
        &mut self,
        now_ns: u64,
        measured: Option<&RotationState>,
        before: impl FnOnce() -> (LadderState, bool, Option<RotationState>),
    ) -> Option<(AlignmentState, Option<AlignmentStep>)> {
        let elapsed_s = self.translation.elapsed_s(now_ns);
        let rotation = self.rotation.as_mut()?;
        if let (Some(measured), true) = (measured, self.translation.is_confirmed()) {
            rotation.begin(measured);
        }
        let alignment = rotation.alignment?;
        let (state, turns, master) = before();
        let elapsed_s = elapsed_s.min(self.max_step_s);
        Some(match master.as_ref().zip(measured).filter(|_| !state.is_coupled()) {
            Some(both) => rotation.toward(&alignment, both, elapsed_s, turns),
            None => (AlignmentState::Remaining, None),
        })
    }

    /// Step one tick on a checked reading.
    #[inline(always)] // as check
    pub(crate) fn tick(
        &mut self,
        now_ns: u64,
        reading: &SlaveReading<N>,
        step: Option<&AlignmentStep>,
        input: &ArmInput<'_, N>,
        outgoing: &mut PortState,
    ) -> ArmTick<N> {
        let SlaveReading { position, environment_force, .. } = reading;
        let elapsed_s = self.translation.elapsed_s(now_ns);
        let ArmInput { state, turns, stale_ns, newest } = *input;
        let (mut command_velocity, mut angular_velocity) = (Axes::zeros(), Axes::zeros());
        let mut limited = Limited::default();
        if let (Some(rotation), Some(step), true) = (&mut self.rotation, step, turns || state.is_coupled()) {
            // The two sides engage at the orientation that this step reaches.
            rotation.command = Some(step.orientation);
        }
        let of_master = newest.as_ref().map(|master| [&master.position, &master.velocity]);
        let input = TranslationInput { state, stale_ns, newest: of_master };
        self.count_exerted(reading, outgoing);
        let led = if let Some(coupled) = &mut self.coupled {
            let half = newest.as_ref().map_or(OfHalf::NONE, |master| master.half);
            let measured = [position, &reading.velocity, environment_force];
            let pushed = self.translation.push(now_ns, measured, &input, coupled, &half);
            pushed.map(|(led, work_j)| {
                outgoing.energy.add(-work_j);
                led
            })
        } else {
            self.count_work(reading, outgoing);
            self.translation.follow(now_ns, position, &input)
        };
        if let Some(led) = led {
            let [speed, reach] = led.limited;
            limited = Limited { speed, reach, ..limited };
            command_velocity = led.velocity;
            if let (Some(rotation), Some(master), Some(measured), Some(newest)) =
                (&mut self.rotation, newest.and_then(|master| master.rotation), &reading.rotation, &newest)
            {
                let times = (elapsed_s, 0.5 * self.max_step_s);
                let pushed = rotation.push(master, &newest.half, measured, times, &mut limited);
                angular_velocity = if let Some((velocity, work_j)) = pushed {
                    outgoing.energy.add(-work_j);
                    velocity
                } else {
                    rotation.follow(master, measured, elapsed_s, led.extrapolated, &mut limited)
                };
            }
        } else if let Some(rotation) = &mut self.rotation {
            rotation.disengage();
        }
        if let (true, Some(step)) = (turns, step) {
            self.translation.stay_at(position);
            angular_velocity = step.angular_velocity;
        }
        let counts = self.coupled.is_none() && state.is_coupled();
        self.last = counts.then_some([reading.position, reading.environment_force]);
        if reading.rotation.is_some() {
            self.last_rotation = reading.rotation;
        }
        self.report(reading, turns, outgoing);
        let exerted = led.and_then(|_| self.exerted());
        ArmTick { command_velocity, angular_velocity, limited, exerted }
    }

    /// Count the work of the coupling on an arm that takes forces since the last tick, also at the tick that ends the
    /// engagement. An invalid reading shows no motion.
    #[inline(always)] // as check
    fn count_exerted(&self, reading: &SlaveReading<N>, outgoing: &mut PortState) {
        let Some(coupled) = self.coupled.as_ref().filter(|_| self.fault.is_none()) else { return };
        let turning = self.rotation.as_ref().and_then(|rotation| rotation.coupled.as_ref());
        let turned = turning.zip(reading.rotation).map_or(0.0, |(one, now)| one.worked_j(&now.orientation));
        outgoing.energy.add(-(coupled.worked_j(&reading.position) + turned));
    }

    /// Force in N and torque in N m of the coupling on an arm that takes forces.
    fn exerted(&self) -> Option<(Axes<N>, Axes<3>)> {
        let (force, _) = self.coupled.as_ref()?.exerted()?;
        let turning = self.rotation.as_ref().and_then(|rotation| rotation.coupled.as_ref());
        let torque = turning.and_then(|turning| turning.exerted());
        Some((*force, torque.map_or(Axes::zeros(), |(torque, _)| *torque)))
    }

    /// Count the work of the environment's wrench on the link since the last tick of this engagement:
    /// `f·dx + tau·dphi`. An invalid reading shows no motion.
    #[inline(always)] // as check
    fn count_work(&self, reading: &SlaveReading<N>, outgoing: &mut PortState) {
        let (Some([position, force]), None) = (&self.last, self.fault) else { return };
        let turned = self.last_rotation.zip(reading.rotation).map_or(0.0, |(last, now)| {
            last.torque.dot(&(now.orientation * last.orientation.inverse()).scaled_axis())
        });
        outgoing.energy.add(force.dot(&(reading.position - position)) + turned);
    }

    /// Fill the next frame's report of the arm.
    ///
    /// While the arm rotates to the master's orientation (`turns`) the wrench is zero. A force that still
    /// fades on the hand must not contain forces of that motion.
    #[inline(always)] // as check
    fn report(&self, reading: &SlaveReading<N>, turns: bool, outgoing: &mut PortState) {
        if self.fault.is_some() {
            without_wrench(outgoing);
            outgoing.message = CouplingMessage::ZERO;
            return;
        }
        if let Some(coupled) = &self.coupled {
            let turning = self.rotation.as_ref().and_then(|rotation| rotation.coupled.as_ref());
            let (vector, energy_j) =
                coupled.sent().map_or((Padded::zeros(), 0.0), |(sent, sum)| (padded(sent), sum));
            let (turned, turn_j) =
                turning.and_then(|one| one.sent()).map_or((Axes::zeros(), 0.0), |(sent, sum)| (*sent, sum));
            let message = &mut outgoing.message;
            (message.vector, message.turned, message.sums) = (vector, turned, [energy_j, turn_j]);
        }
        let SlaveReading { position, velocity, environment_force: force, rotation } = *reading;
        outgoing.report(&position, &velocity, &force, rotation);
        if turns {
            without_wrench(outgoing);
        }
    }

    /// Energy in J that the coupling may still give; NaN for a coupling that counts none.
    #[inline]
    pub(crate) fn left_j(&self) -> f64 {
        let turning = self.rotation.as_ref().and_then(|rotation| rotation.coupled.as_ref());
        let turning = turning.map_or(f64::NAN, |turning| turning.left_j());
        self.coupled.as_ref().map_or(f64::NAN, |coupled| coupled.left_j().min(turning))
    }

    /// End the coupling: the next engagement starts from the positions at that time.
    pub(crate) fn disengage(&mut self) {
        self.translation.disengage();
        self.last = None;
        if let Some(coupled) = &mut self.coupled {
            coupled.disengage();
        }
        if let Some(rotation) = &mut self.rotation {
            rotation.disengage();
        }
    }

    /// Record that the arm stops following and comes to rest at `rest` in m, and a pose at `orientation`. The
    /// next engagement continues from there.
    pub(crate) fn set_rest(&mut self, rest: &Axes<N>, orientation: Option<&UnitQuaternion<f64>>) {
        // An unknown position clears the command until the next engagement.
        self.translation.set_rest(Signal::Position.check(rest).is_ok().then_some(*rest));
        if let Some(rotation) = &mut self.rotation {
            let known = orientation.filter(|orientation| check_orientation(orientation).is_ok());
            rotation.command = rotation.command.and(known.copied());
        }
    }

    /// Carry out an operator command over `ticks` ticks; return whether it changed anything. The slave
    /// continues from its present position.
    pub(crate) fn command(&mut self, command: OperatorCommand, ticks: u32) -> Result<bool, CouplingError> {
        match (command, &mut self.rotation) {
            (OperatorCommand::Acknowledge, _) => {
                self.excess = None;
                if self.fault.take().is_some() {
                    // After a fault of the arm its origin may have moved.
                    self.translation.forget_home();
                    if let Some(rotation) = &mut self.rotation {
                        rotation.forget_home();
                    }
                }
                return Ok(true);
            }
            (OperatorCommand::RotationScale(scale), Some(rotation)) => {
                return rotation.set_rotation_scale(scale, ticks).map(|()| true);
            }
            (OperatorCommand::Frame { quat_wxyz, .. }, Some(rotation)) => {
                rotation.set_frame(quat_wxyz, ticks)?;
            }
            _ => {}
        }
        self.translation.coupling().command_at_slave(command, ticks)
    }

    /// Fault behind the state FAULT.
    pub(super) fn fault(&self) -> Option<Fault> {
        self.fault
    }

    /// Last commanded position in m; none before the first engagement.
    pub(crate) fn last_command(&self) -> Option<Axes<N>> {
        self.translation.last_command()
    }

    /// Last commanded orientation; none for a point, and before the first engagement.
    pub(super) fn last_orientation(&self) -> Option<UnitQuaternion<f64>> {
        self.rotation.as_ref().and_then(|rotation| rotation.command)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        LadderSettings,
        coupling::{CommandBounds, RotationBounds, RotationLock},
    };

    const MS: u64 = 1_000_000;
    const REACH: f64 = 0.1;
    const TURN: f64 = 0.2;

    fn reading(x: f64, angle: f64) -> SlaveReading<3> {
        let rotation = RotationState {
            orientation: UnitQuaternion::from_scaled_axis(Axes::<3>::new(0.0, 0.0, angle)),
            angular_velocity: Axes::zeros(),
            torque: Axes::zeros(),
        };
        let position = Axes::<3>::new(x, 0.0, 0.0);
        SlaveReading {
            rotation: Some(rotation),
            ..SlaveReading::point([position, Axes::zeros(), Axes::zeros()])
        }
    }

    /// An arm at rest at `at`, whose bounds on reach and turn are finite.
    struct Rig {
        arm: Arm<3>,
        at: [f64; 2],
        tick: u64,
    }

    impl Rig {
        fn new(at: [f64; 2]) -> Self {
            let bounds = CommandBounds { speed: 1e3, reach: REACH };
            let ladder = LadderSettings::default();
            let settings = SlaveSettings { period_ns: MS, run_id: 1, position_scale: 1.0, bounds, ladder };
            let rotation = SlaveRotationSettings {
                rotation_scale: 1.0,
                lock: RotationLock::Free,
                bounds: RotationBounds { speed: 1e3, turn: TURN },
                alignment: None,
            };
            Self { arm: Arm::new(&settings).unwrap().turning(&rotation, 1.0).unwrap(), at, tick: 0 }
        }

        /// Step one tick with samples off by `wrong` and the master at `[x, angle]`. The arm reaches its
        /// command.
        fn step(&mut self, wrong: [f64; 2], state: LadderState, master: [f64; 2]) -> Option<Fault> {
            self.tick += 1;
            let (now_ns, [x, angle]) = (self.tick * MS, self.at);
            let measured = reading(x + wrong[0], angle + wrong[1]);
            let checked = self.arm.check(now_ns, &measured, false);
            let taken = checked.ok().flatten().unwrap_or(measured);
            self.arm.align(now_ns, taken.rotation.as_ref(), || (state, false, None));
            let master = reading(master[0], master[1]);
            let newest = Some(MasterState {
                position: master.position,
                velocity: Axes::zeros(),
                rotation: master.rotation.as_ref(),
                half: OfHalf::NONE,
            });
            let input = ArmInput { state, turns: false, stale_ns: 0, newest };
            self.arm.tick(now_ns, &taken, None, &input, &mut PortState::default());
            if state == LadderState::Engaged
                && let (Some(to), Some(turned)) = (self.arm.last_command(), self.arm.last_orientation())
            {
                self.at = [to[0], turned.scaled_axis()[2]];
            }
            checked.err()
        }

        /// Acknowledge a fault, engage and move the master far to one side and then to the other.
        /// Return the commands.
        fn driven(&mut self, faulted: bool) -> Vec<[f64; 2]> {
            if faulted {
                self.arm.command(OperatorCommand::Acknowledge, 0).unwrap();
            }
            let mut commands = Vec::new();
            for n in 0..400 {
                // Within the change of velocity that the guard allows per tick.
                let far = 1e-4 * f64::from(if n < 200 { 20 * n } else { 20 * (400 - n) - 4000 });
                let _ = self.step([0.0; 2], LadderState::Engaged, [far, far]);
                commands.push(self.at);
            }
            commands
        }
    }

    /// Wrong first samples do not move the bounds on reach and turn, with or without a fault.
    #[test]
    fn reach_is_from_where_the_arm_really_started() {
        for size in [0.5, 0.05, 0.015, -0.01, 0.002] {
            for run in 0..=3 {
                for idle in [20, 300] {
                    let mut rig = Rig::new([0.3, 0.1]);
                    let mut faulted = false;
                    for n in 0..idle {
                        let wrong = if n < run { [size, size] } else { [0.0; 2] };
                        faulted |= rig.step(wrong, LadderState::Disengaged, [0.0; 2]).is_some();
                    }
                    let case = format!("{run} of {size}, {faulted}");
                    let commands = rig.driven(faulted);
                    for (which, bound) in [(0, REACH), (1, TURN)] {
                        let away = |of: &[f64; 2]| of[which] - [0.3, 0.1][which];
                        let most = commands.iter().map(away).fold(0.0, f64::max);
                        let least = commands.iter().map(away).fold(0.0, f64::min);
                        assert!((most - bound).abs() < 1e-9, "{case}: {most} of {bound}");
                        assert!((least + bound).abs() < 1e-9, "{case}: {least} of {bound}");
                    }
                }
            }
        }
    }
}
