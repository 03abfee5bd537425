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
    coupling::{AlignmentStep, CouplingError, Limited, RotationState},
    ladder::{AlignmentState, LadderState},
    port::PortState,
    wire::Padded,
};

/// State of the master in the newest frame.
#[derive(Clone, Copy, Debug)]
pub(crate) struct MasterState<'a, const N: usize> {
    /// x in m.
    pub(crate) position: Axes<N>,
    /// V in m/s.
    pub(crate) velocity: Axes<N>,
    pub(crate) rotation: Option<&'a RotationState>,
}

/// Inputs of a tick beside the measurements of the arm.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ArmInput<'a, const N: usize> {
    pub(crate) state: LadderState,
    /// True if the arm may turn to the master before the two engage.
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
    /// Angular velocity in rad/s of the commanded orientation; zero unless engaged or turning to the master.
    pub(crate) angular_velocity: Axes<3>,
    pub(crate) limited: Limited,
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
            .and_then(|()| self.taken(now_ns, reading));
        if let Err(fault) = checked {
            self.fault.get_or_insert(fault);
        }
        checked
    }

    #[inline(always)] // once per tick, from few callers
    fn taken(&mut self, now_ns: u64, reading: &SlaveReading<N>) -> Result<Option<SlaveReading<N>>, Fault> {
        let ticks = self.translation.sampled(now_ns);
        let SlaveReading { position, velocity, environment_force, rotation } = reading;
        let turned = rotation.as_ref().filter(|_| self.rotation.is_some()).map(|state| Turned {
            orientation: state.orientation,
            angular_velocity: Some(state.angular_velocity),
        });
        let sample = Sample { position: *position, velocity: Some(*velocity), rotation: turned };
        if let Err(excess) = self.guard.pass(&sample, ticks) {
            // The guard restarts its path at once; the fault lasts until it is acknowledged.
            self.guard.begin_anew(&sample);
            self.excess.get_or_insert(excess);
            return Err(excess.fault());
        }
        if !self.guard.holds() {
            self.wrench = (*environment_force, rotation.map_or(Axes::zeros(), |state| state.torque));
            return Ok(None);
        }
        let Sample { position, velocity, rotation } = *self.guard.taken();
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
    /// `before` gives state and turn flag of the last tick, and the newest frame. `checked` is true if the
    /// sample is valid.
    #[inline(always)] // as check
    pub(super) fn align(
        &mut self,
        now_ns: u64,
        measured: Option<&RotationState>,
        checked: bool,
        before: impl FnOnce() -> (LadderState, bool, Option<RotationState>),
    ) -> Option<(AlignmentState, Option<AlignmentStep>)> {
        let elapsed_s = self.translation.elapsed_s(now_ns);
        let rotation = self.rotation.as_mut()?;
        if let (Some(measured), true) = (measured, checked) {
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
        checked: bool,
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
        if let Some(led) = self.translation.follow(now_ns, position, checked, &input) {
            let [speed, reach] = led.limited;
            limited = Limited { speed, reach, ..limited };
            command_velocity = led.velocity;
            if let (Some(rotation), Some(master), Some(measured)) =
                (&mut self.rotation, newest.and_then(|master| master.rotation), &reading.rotation)
            {
                angular_velocity =
                    rotation.follow(master, measured, elapsed_s, led.extrapolated, &mut limited);
            }
        } else if let Some(rotation) = &mut self.rotation {
            rotation.coupling.disengage();
        }
        let power_w = environment_force.dot(&command_velocity);
        let mut turning = angular_velocity;
        if let (true, Some(step)) = (turns, step) {
            self.translation.stay_at(position);
            // The energy of this motion stays at the slave: the link does not carry it.
            (angular_velocity, turning) = (step.angular_velocity, Axes::zeros());
        }
        self.report(reading, power_w, &turning, elapsed_s, turns, outgoing);
        ArmTick { command_velocity, angular_velocity, limited }
    }

    /// Fill the next frame's report of the arm. The energy is that of the whole wrench, `f·v + tau·w`.
    ///
    /// While the arm turns to the master (`turns`) the wrench is zero. A force that still fades on the hand
    /// must not contain forces of that motion.
    #[inline(always)] // as check
    fn report(
        &self,
        reading: &SlaveReading<N>,
        power_w: f64,
        angular_velocity: &Axes<3>,
        elapsed_s: f64,
        turns: bool,
        outgoing: &mut PortState,
    ) {
        if self.fault.is_some() {
            without_wrench(outgoing);
            return;
        }
        let SlaveReading { position, velocity, environment_force: force, rotation } = *reading;
        let turning = rotation.map_or(0.0, |measured| measured.torque.dot(angular_velocity));
        outgoing.energy.add(power_w + turning, elapsed_s);
        outgoing.report(&position, &velocity, &force, rotation);
        if turns {
            without_wrench(outgoing);
        }
    }

    /// End the coupling: the next engagement starts from the positions at that time.
    pub(crate) fn disengage(&mut self) {
        self.translation.disengage();
        if let Some(rotation) = &mut self.rotation {
            rotation.coupling.disengage();
        }
    }

    /// Record that the arm stops following and comes to rest at `rest` in m, and a pose at `orientation`. The
    /// next engagement continues from there.
    pub(crate) fn rests(&mut self, rest: &Axes<N>, orientation: Option<&UnitQuaternion<f64>>) {
        // An unknown position clears the command until the next engagement.
        self.translation.rests(Signal::Position.check(rest).is_ok().then_some(*rest));
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
                (self.fault, self.excess) = (None, None);
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
