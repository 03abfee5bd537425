//! What decides over the command to an arm: the same live, in virtual time, and in runs that share link and ladders.

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
    link::PortState,
    wire::Padded,
};

/// What the newest frame says of the master.
#[derive(Clone, Copy, Debug)]
pub(crate) struct MasterState<'a, const N: usize> {
    /// x in m.
    pub(crate) position: Axes<N>,
    /// V in m/s.
    pub(crate) velocity: Axes<N>,
    /// Of a pose.
    pub(crate) rotation: Option<&'a RotationState>,
}

/// What decides over the command of a tick beside what the arm measures.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ArmInput<'a, const N: usize> {
    /// Where the ladder stands.
    pub(crate) state: LadderState,
    /// Whether the arm may turn to the master before the two engage.
    pub(crate) turns: bool,
    /// For how long in ns the ladder has stood in STALE.
    pub(crate) stale_ns: u64,
    /// None before the first frame.
    pub(crate) newest: Option<MasterState<'a, N>>,
}

/// What one tick decided.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ArmTick<const N: usize> {
    /// Velocity in m/s of the commanded position; zero unless engaged.
    pub(crate) command_velocity: Axes<N>,
    /// Angular velocity in rad/s of the commanded orientation; zero unless engaged or turned to the master.
    pub(crate) angular_velocity: Axes<3>,
    /// Which bounds acted on the command.
    pub(crate) limited: Limited,
}

/// Takes force and torque out of what the next frame says.
fn without_wrench(outgoing: &mut PortState) {
    outgoing.force = Padded::zeros();
    if let Some(rotation) = &mut outgoing.rotation {
        rotation.torque = Axes::zeros();
    }
}

/// Lever in m at which the rotation of a tool is held against its path: a tool of 0.1 m.
pub(crate) const TOOL_LEVER_M: f64 = 0.1;

/// Coupling and bounds of an arm, with what they have to know of the last tick.
#[derive(Clone, Debug)]
pub(crate) struct Arm<const N: usize> {
    translation: SlaveTranslation<N>,
    /// Of an arm that turns.
    rotation: Option<Box<SlaveRotation>>,
    fault: Option<Fault>,
    /// The speed beyond the bound of the arm that led to it.
    excess: Option<Excess>,
    guard: Guard<N>,
    /// Force in N and moment in N m of the last sample that was not held.
    wrench: (Axes<N>, Axes<3>),
    /// The longest time in s that one step of an alignment makes up for: two periods.
    max_step_s: f64,
}

impl<const N: usize> Arm<N> {
    /// Of a point.
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

    /// The same of a pose, with `rotation` and three axes, whose press waits for `align_s` at most.
    pub(super) fn turning(
        mut self,
        rotation: &SlaveRotationSettings,
        align_s: f64,
    ) -> Result<Self, EndpointError> {
        self.rotation = Some(Box::new(SlaveRotation::new(rotation, align_s)?));
        Ok(self)
    }

    /// The same before its first tick, whose samples are held against other bounds than [`SampleBounds::of_axes`] and those at a
    /// lever of 0.1 m: of position and rotation.
    pub(crate) fn with_samples(self, [bounds, rotation]: [SampleBounds; 2], period_s: f64) -> Self {
        Self { guard: Guard::new(bounds, rotation, period_s), ..self }
    }

    /// What its samples are held against.
    pub(crate) fn guard(&self) -> &Guard<N> {
        &self.guard
    }

    /// The speed beyond the bound of the arm that led to the fault.
    pub(super) fn excess(&self) -> Option<Excess> {
        self.excess
    }

    /// What it decides of a point.
    pub(crate) fn translation(&self) -> &SlaveTranslation<N> {
        &self.translation
    }

    /// The arm still brakes with `speed` in m/s and `angular_speed` in rad/s.
    pub(super) fn set_braking(&mut self, [speed, angular_speed]: [f64; 2]) {
        self.translation.set_braking(speed);
        if let Some(rotation) = &mut self.rotation {
            rotation.set_braking(angular_speed);
        }
    }

    /// Refuses a sample that cannot be, or of a device that has failed; returns what stands for one that is held, as it has left
    /// the path of the others ([`Guard`]): its prediction, under the last wrench.
    #[inline(always)] // once a tick, from few places
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

    #[inline(always)] // once a tick, from few places
    fn taken(&mut self, now_ns: u64, reading: &SlaveReading<N>) -> Result<Option<SlaveReading<N>>, Fault> {
        let ticks = self.translation.sampled(now_ns);
        let SlaveReading { position, velocity, environment_force, rotation } = reading;
        let turned = rotation.as_ref().filter(|_| self.rotation.is_some()).map(|state| Turned {
            orientation: state.orientation,
            angular_velocity: Some(state.angular_velocity),
        });
        let sample = Sample { position: *position, velocity: Some(*velocity), rotation: turned };
        if let Err(excess) = self.guard.pass(&sample, ticks) {
            // It begins anew from here, once it is acknowledged.
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

    /// The next step towards the master's newest orientation, of an arm that is turned there before the two engage, and how
    /// far it is with that; `before` is the input of the last tick with the newest frame. `checked`: the sample can be.
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

    /// One tick of what the arm measures, which was checked.
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
            // The two engage where it has just reached the master.
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
            // What it does to what it touches does not go over the link.
            (angular_velocity, turning) = (step.angular_velocity, Axes::zeros());
        }
        self.report(reading, power_w, &turning, elapsed_s, turns, outgoing);
        ArmTick { command_velocity, angular_velocity, limited }
    }

    /// Leaves what the next frame says of the arm; the energy is that of the whole wrench, `f·v + tau·w`. While it turns to
    /// the master (`turns`) there is no wrench: what fades on the hand from before must have nothing of that motion.
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

    /// The two are no longer coupled: when they engage again, it is from where both are then.
    pub(crate) fn disengage(&mut self) {
        self.translation.disengage();
        if let Some(rotation) = &mut self.rotation {
            rotation.coupling.disengage();
        }
    }

    /// The arm no longer follows and comes to rest at `rest` in m, and of a pose so turned: when the two engage again, it
    /// goes on from there.
    pub(crate) fn rests(&mut self, rest: &Axes<N>, orientation: Option<&UnitQuaternion<f64>>) {
        // Where it does not know where it is, nothing is commanded until the two engage anew.
        self.translation.rests(Signal::Position.check(rest).is_ok().then_some(*rest));
        if let Some(rotation) = &mut self.rotation {
            let known = orientation.filter(|orientation| check_orientation(orientation).is_ok());
            rotation.command = rotation.command.and(known.copied());
        }
    }

    /// Carries out a command of the operator over so many ticks; returns whether it changed anything. The slave goes on from
    /// where it is.
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

    /// Why it stands in FAULT.
    pub(super) fn fault(&self) -> Option<Fault> {
        self.fault
    }

    /// The last commanded position in m; none before the first engagement.
    pub(crate) fn last_command(&self) -> Option<Axes<N>> {
        self.translation.last_command()
    }

    /// The last commanded orientation; none of a point, and before the first engagement.
    pub(super) fn last_orientation(&self) -> Option<UnitQuaternion<f64>> {
        self.rotation.as_ref().and_then(|rotation| rotation.command)
    }
}
