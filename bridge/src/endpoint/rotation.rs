//! Rotation of a slave's endpoint: from the master's orientation to the commanded orientation.

use haptether_safety::{Axes, Fault, Signal};
use nalgebra::UnitQuaternion;

use crate::{
    coupling::{
        ALIGNED_RAD, Alignment, AlignmentSettings, AlignmentStep, CoupledSlaveTurn, CouplingError, Limited,
        OfHalf, OfMaster, Room, RotationBounds, RotationCoupling, RotationLock, RotationState, SETTLED_S,
        turned_within,
    },
    ladder::AlignmentState,
};

/// Largest lag in rad of a command behind the master; beyond pi, the shorter way has the opposite direction.
const MAX_LAG_RAD: f64 = std::f64::consts::FRAC_PI_2;

/// Relative rounding error of an alignment step, so that no bound acts on rounding.
const ROUNDING: f64 = 1e-9;

/// Settings of the rotation of a slave's endpoint.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SlaveRotationSettings {
    /// `lambda_r`.
    pub rotation_scale: f64,
    /// Part of the rotation that does not follow the master.
    pub lock: RotationLock,
    /// Bounds on a remote command.
    pub bounds: RotationBounds,
    /// Settings of the alignment with the master before the two engage; without them, they engage in any
    /// orientation.
    pub alignment: Option<AlignmentSettings>,
}

/// Rotation part of a slave's endpoint.
#[derive(Clone, Debug)]
pub(super) struct SlaveRotation {
    pub(super) coupling: RotationCoupling,
    /// Half of the coupling; None for position-force.
    pub(super) coupled: Option<Box<CoupledSlaveTurn>>,
    pub(super) alignment: Option<Alignment>,
    /// Time in s that the turning arm has been within [`ALIGNED_RAD`] of the master.
    near_s: f64,
    bounds: RotationBounds,
    /// Bounds on commands, with the speed reduced by the part for the arm's own braking.
    left: RotationBounds,
    /// Orientation of the arm at the first confirmed sample.
    home: Option<UnitQuaternion<f64>>,
    /// Last command; none before the first engagement.
    pub(super) command: Option<UnitQuaternion<f64>>,
}

impl SlaveRotation {
    /// Build the rotation part; `align_s` is the timeout of a press in s.
    pub(super) fn new(settings: &SlaveRotationSettings, align_s: f64) -> Result<Self, CouplingError> {
        let SlaveRotationSettings { rotation_scale, lock, bounds, alignment } = settings;
        bounds.check()?;
        let mut coupling = RotationCoupling::new(*rotation_scale, 1.0)?;
        coupling.set_lock(*lock);
        let alignment = match alignment {
            None => None,
            Some(alignment) => {
                alignment.check(*rotation_scale, lock, bounds, align_s)?;
                Some(Alignment::new([1.0, 0.0, 0.0, 0.0], alignment.speed, alignment.max_angle)?)
            }
        };
        Ok(Self {
            coupling,
            coupled: None,
            alignment,
            near_s: 0.0,
            bounds: *bounds,
            left: *bounds,
            home: None,
            command: None,
        })
    }

    /// Reserve `angular_speed` in rad/s of the bound for the arm's own braking.
    pub(super) fn set_braking(&mut self, angular_speed: f64) {
        self.left.speed = (self.bounds.speed - angular_speed).max(0.0);
    }

    /// Change `lambda_r` over `ticks` ticks; with an alignment it must stay 1.
    pub(super) fn set_rotation_scale(&mut self, scale: f64, ticks: u32) -> Result<(), CouplingError> {
        if self.alignment.is_some() {
            AlignmentSettings::check_scale(scale)?;
        }
        self.coupling.set_rotation_scale(scale, ticks)
    }

    /// Change C, a unit quaternion, over `ticks` ticks.
    pub(super) fn set_frame(&mut self, quat_wxyz: [f64; 4], ticks: u32) -> Result<(), CouplingError> {
        if let Some(alignment) = &mut self.alignment {
            alignment.set_frame(quat_wxyz)?;
        }
        self.coupling.set_frame(quat_wxyz, ticks)
    }

    /// Return the alignment state and the next step of the command towards the master's newest rotation
    /// within `elapsed_s`. The step is `None` if the turn is refused. `turns` is true if the arm was turning
    /// at the last tick.
    pub(super) fn toward(
        &mut self,
        alignment: &Alignment,
        (master, measured): (&RotationState, &RotationState),
        elapsed_s: f64,
        turns: bool,
    ) -> (AlignmentState, Option<AlignmentStep>) {
        let Some(home) = self.home else { return (AlignmentState::Remaining, None) };
        let from = self.command.unwrap_or(measured.orientation);
        let is_within = alignment.target(&master.orientation).angle_to(&home) <= self.bounds.turn;
        let step = alignment.step(&master.orientation, &from, elapsed_s).ok().filter(|_| is_within);
        let Some(mut step) = step else { return (AlignmentState::TooFar, None) };
        // The bound on the speed also applies to an arm that returns from beyond the bound on its turn.
        let speed = self.left.speed.min(alignment.max_speed() * (1.0 + ROUNDING));
        let turn = RotationBounds { speed, ..self.bounds };
        let mut limited = Limited::default();
        step.orientation = turned_within(&turn, elapsed_s, [&home, &from, &step.orientation], &mut limited);
        if limited.any() {
            let way = (step.orientation * from.inverse()).scaled_axis();
            let velocity = if elapsed_s > 0.0 { way / elapsed_s } else { Axes::zeros() };
            step.angular_velocity = velocity.cap_magnitude(alignment.max_speed());
        }
        let is_near = turns && step.remaining_rad <= ALIGNED_RAD;
        self.near_s = if is_near { self.near_s + elapsed_s } else { 0.0 };
        let is_there = (step.remaining_rad == 0.0 || self.near_s >= SETTLED_S) && !limited.any();
        let state = if is_there { AlignmentState::Reached } else { AlignmentState::Remaining };
        (state, Some(step))
    }

    /// Return the fault of an invalid or missing measurement.
    pub(super) fn check(measured: Option<&RotationState>) -> Result<(), Fault> {
        let Some(RotationState { orientation, angular_velocity, torque }) = measured else {
            return Err(Fault::NotFinite(Signal::Orientation));
        };
        check_orientation(orientation)?;
        Signal::AngularVelocity.check(angular_velocity)?;
        Signal::EnvironmentTorque.check(torque)
    }

    /// End the coupling: the next engagement starts from the orientations at that time.
    pub(super) fn disengage(&mut self) {
        self.coupling.disengage();
        if let Some(coupled) = &mut self.coupled {
            coupled.disengage();
        }
    }

    /// Store the orientation of the first confirmed sample as home.
    pub(super) fn begin(&mut self, measured: &RotationState) {
        self.home.get_or_insert(measured.orientation);
    }

    /// Forget home: the next confirmed sample becomes home.
    pub(super) fn forget_home(&mut self) {
        self.home = None;
    }

    /// Follow the master's newest rotation, extrapolated by `ahead_s`; `share` of its angular velocity
    /// remains.
    ///
    /// Returns the angular velocity in rad/s of the command.
    pub(super) fn follow(
        &mut self,
        master: &RotationState,
        measured: &RotationState,
        elapsed_s: f64,
        (ahead_s, share): (f64, f64),
        limited: &mut Limited,
    ) -> Axes<3> {
        let home = self.home.unwrap_or(measured.orientation);
        let from = self.command.unwrap_or(measured.orientation);
        let ahead = |velocity: Axes<3>| UnitQuaternion::from_scaled_axis(velocity * ahead_s);
        let mut velocity = self.velocity(master, limited);
        // If the coupling starts while frames are late, the command already contains the extrapolation.
        let followed = self.coupling.commanded_orientation(&master.orientation, &(ahead(-velocity) * from));
        velocity = self.velocity(master, limited);
        let mut wanted = ahead(velocity) * followed;
        if wanted.angle_to(&from) > MAX_LAG_RAD {
            // Continuing on the shorter way would turn back; so the coupling restarts at the present command.
            limited.angular_speed = true;
            self.coupling.clear_anchor();
            self.coupling.commanded_orientation(&master.orientation, &from);
            (wanted, velocity) = (from, Axes::zeros());
        }
        let (command, acted) = self.bound(elapsed_s, [&home, &from, &wanted], limited);
        if acted.any() {
            // The velocity of a limited command is that of the limited motion.
            let way = (command * from.inverse()).scaled_axis();
            velocity = if elapsed_s > 0.0 { way / elapsed_s } else { Axes::zeros() };
        }
        velocity * share
    }

    /// Step the tool of a coupling with torque, or the arm; return the angular velocity in rad/s of the command, and the
    /// work in J of the torque.
    pub(super) fn push(
        &mut self,
        master: &RotationState,
        half: &OfHalf<'_>,
        measured: &RotationState,
        (elapsed_s, dt): (f64, f64),
        limited: &mut Limited,
    ) -> Option<(Axes<3>, f64)> {
        let home = self.home.unwrap_or(measured.orientation);
        let takes_force = self.coupled.as_ref()?.takes_force();
        let from = self.command.filter(|_| !takes_force).unwrap_or(measured.orientation);
        let room = Room {
            away: &(measured.orientation * home.inverse()).scaled_axis(),
            velocity: &measured.angular_velocity,
            bounds: [self.left.speed, self.left.turn],
        };
        let RotationState { orientation: at, angular_velocity: velocity, torque: force } = master;
        let master = OfMaster { at, velocity, force, half: *half };
        let coupled = self.coupled.as_mut()?;
        let wanted = coupled.step(&mut self.coupling, &from, (&room, &measured.torque), &master, dt);
        if let Some((_, [hurries, leaves])) = coupled.exerted() {
            self.command = Some(wanted);
            limited.angular_speed |= hurries;
            limited.turn |= leaves;
            return Some((measured.angular_velocity, coupled.work_j()));
        }
        let (command, acted) = self.bound(elapsed_s, [&home, &from, &wanted], limited);
        let coupled = self.coupled.as_mut()?;
        if acted.any() {
            coupled.limit([&wanted, &command], self.left.speed, acted.turn);
        }
        Some((coupled.velocity().cap_magnitude(self.left.speed), coupled.work_j()))
    }

    /// Store the command that the bounds leave of home, last command and wanted orientation; return it and the bounds that
    /// acted.
    fn bound(
        &mut self,
        elapsed_s: f64,
        orientations: [&UnitQuaternion<f64>; 3],
        limited: &mut Limited,
    ) -> (UnitQuaternion<f64>, Limited) {
        let mut acted = Limited::default();
        let command = turned_within(&self.left, elapsed_s, orientations, &mut acted);
        self.command = Some(command);
        limited.turn |= acted.turn;
        limited.angular_speed |= acted.angular_speed;
        (command, acted)
    }

    /// Angular velocity in rad/s of the command, within the bound on its speed.
    fn velocity(&self, master: &RotationState, limited: &mut Limited) -> Axes<3> {
        let velocity = self.coupling.commanded_velocity(&master.angular_velocity);
        limited.angular_speed |= velocity.norm() > self.left.speed;
        velocity.cap_magnitude(self.left.speed)
    }
}

/// Return an error for a quaternion that is not finite or not a unit quaternion.
pub(super) fn check_orientation(orientation: &UnitQuaternion<f64>) -> Result<(), Fault> {
    let norm = orientation.quaternion().norm();
    if (norm - 1.0).abs() <= Signal::Orientation.bound() {
        return Ok(());
    }
    Err(if norm.is_finite() {
        Fault::OutOfRange(Signal::Orientation)
    } else {
        Fault::NotFinite(Signal::Orientation)
    })
}
