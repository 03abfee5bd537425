//! Half of a coupling at the slave, for the rotation.

use haptether_safety::Axes;
use nalgebra::{Unit, UnitQuaternion};

use super::{
    super::{
        ForceArm, Half, Local, MethodSettings, OfHalf, OfMaster, Peer, Room, Sends, Space,
        VirtualToolSettings, capped,
        slave::{GAP_S, MasterEngagement},
    },
    stretch,
};
use crate::{
    coupling::{CouplingKind, RotationCoupling},
    wire::Role,
};

/// Half of a coupling at the slave for the rotation, as [`CoupledSlave`](super::super::CoupledSlave).
///
/// The virtual tool is a ball: `I_v w' = tau_c + tau_e - b_v w`.
#[derive(Clone, Copy, Debug)]
pub(crate) struct CoupledSlaveTurn {
    half: Half<3>,
    /// The half before any tick.
    fresh: Half<3>,
    kind: CouplingKind,
    tool: VirtualToolSettings,
    /// Arm that takes torques; None for one that takes motions.
    arm: Option<ForceArm>,
    /// Orientation and angular velocity in rad/s of the tool.
    orientation: UnitQuaternion<f64>,
    velocity: Axes<3>,
    engaged: bool,
    master: MasterEngagement,
    /// Sequence of the frame at the last tick, and the time in s since it changed.
    sequence: u64,
    silent_s: f64,
    /// Orientation of the master at which its turn is zero, if it sends waves.
    origin: Option<UnitQuaternion<f64>>,
    /// Turn in rad of the master in its last engaged frame.
    moved: Axes<3>,
    /// Integral of a wave, and energy in J, in that frame.
    wave: Axes<3>,
    energy_j: f64,
    sent: Axes<3>,
    /// `tau_c` in N m since the last tick, and the orientation of the tool before it.
    torque: Axes<3>,
    before: UnitQuaternion<f64>,
    /// Work in J of `tau_c` on a virtual tool at the last tick.
    work_j: f64,
    /// Bounds on speed and turn that acted on `tau_c`.
    limited: [bool; 2],
}

fn product(left: &UnitQuaternion<f64>, right: &UnitQuaternion<f64>) -> UnitQuaternion<f64> {
    Unit::new_normalize((left * right).into_inner())
}

impl CoupledSlaveTurn {
    /// Build the half. None for position-force, and for a scene that does not turn.
    pub(crate) fn new(settings: &MethodSettings) -> Option<Self> {
        let (gains, tool) = settings.rotation?;
        let kind = settings.kind;
        let half = Half::new(kind, gains, Space::Rotation)?;
        let (fresh, orientation) = (half, UnitQuaternion::identity());
        let [velocity, moved, wave, sent, torque] = [Axes::zeros(); 5];
        let (engaged, before, master) = (false, orientation, MasterEngagement::new(kind));
        let (origin, energy_j) = (None, 0.0);
        Some(Self {
            half,
            fresh,
            kind,
            tool,
            arm: settings.forces.map(|[_, arm]| arm),
            orientation,
            velocity,
            engaged,
            master,
            sequence: 0,
            silent_s: 0.0,
            origin,
            moved,
            wave,
            energy_j,
            sent,
            torque,
            before,
            work_j: 0.0,
            limited: [false; 2],
        })
    }

    /// True if `tau_c` turns the arm itself.
    pub(crate) fn takes_force(&self) -> bool {
        self.arm.is_some()
    }

    /// Return the work in J of `tau_c` since the last tick, for an engaged arm that takes torques at an orientation; else 0.
    pub(crate) fn worked_j(&self, orientation: &UnitQuaternion<f64>) -> f64 {
        if self.engaged && self.takes_force() {
            self.torque.dot(&(orientation * self.before.inverse()).scaled_axis())
        } else {
            0.0
        }
    }

    /// Step an engaged tick of `dt` s at the command `from`; return the command that the coupling requests. `torque` is
    /// `tau_e` in N m. For an arm that takes torques, `from` is its orientation and stays the command.
    #[inline(never)]
    pub(crate) fn step(
        &mut self,
        map: &mut RotationCoupling,
        from: &UnitQuaternion<f64>,
        (room, torque): (&Room<'_, 3>, &Axes<3>),
        master: &OfMaster<'_, UnitQuaternion<f64>, 3>,
        dt: f64,
    ) -> UnitQuaternion<f64> {
        let OfMaster { at, velocity, force, half } = *master;
        let OfHalf { message, epoch, sequence, is_stale, .. } = half;
        (self.work_j, self.limited) = (0.0, [false; 2]);
        if !self.engaged {
            (self.orientation, self.velocity) = (*from, Axes::zeros());
            map.clear_anchor();
            map.commanded_orientation(&UnitQuaternion::identity(), from);
            [self.moved, self.wave, self.sent, self.torque] = [Axes::zeros(); 4];
            (self.half, self.origin, self.energy_j) = (self.fresh, None, 0.0);
            self.master.begin(epoch);
            (self.engaged, self.before) = (true, *from);
            return *from;
        }
        let is_engaged = self.master.takes(message.epoch);
        let sends_wave = self.kind.sends(Role::Master) == Some(Sends::Wave);
        let is_new = std::mem::replace(&mut self.sequence, sequence) != sequence;
        if is_engaged {
            if sends_wave {
                self.moved = (at * self.origin.get_or_insert(*at).inverse()).scaled_axis();
                self.wave = message.turned;
            } else {
                self.moved = message.turned;
            }
            self.energy_j = self.energy_j.max(message.sums[1]);
        }
        let turned = UnitQuaternion::from_scaled_axis(self.moved);
        let target = map.commanded_orientation(&turned, from);
        // A half that keeps a ledger does not extrapolate beyond a short gap.
        self.silent_s = if is_new { 0.0 } else { self.silent_s + dt };
        let is_silent = is_stale && self.silent_s > GAP_S;
        let moves = is_engaged && !(is_silent && self.kind.sends_energy());
        let velocity = if moves { map.commanded_velocity(velocity) } else { Axes::zeros() };
        if self.takes_force() {
            (self.orientation, self.velocity) = (*from, *room.velocity);
        }
        let own = Local {
            position: &Axes::zeros(),
            velocity: &self.velocity,
            moved: &(self.orientation * self.before.inverse()).scaled_axis(),
            exerted: &self.torque,
            force: torque,
            gain: 1.0,
            dt,
        };
        let phi = stretch(&self.orientation, &target);
        let peer = Peer {
            position: &phi,
            velocity: &velocity,
            force: &if is_engaged && !is_silent { *force } else { Axes::zeros() },
            vector: &self.wave,
            sum: self.energy_j,
            is_new,
            rests: !moves,
        };
        let mut coupled = self.half.slave(&own, &peer);
        if let Some(arm) = &self.arm {
            (coupled, self.limited) = arm.bounded(&coupled, room);
        }
        self.sent = match self.kind.sends(Role::Slave) {
            // The turn beyond the target, in the frame of the master.
            Some(Sends::Motion) => {
                let beyond = map.frame().inverse() * (self.orientation * target.inverse()) * map.frame();
                (beyond * turned).scaled_axis()
            }
            Some(Sends::Force) => coupled,
            Some(Sends::Wave) | None => self.half.sent().0,
        };
        (self.torque, self.before) = (coupled, self.orientation);
        if self.takes_force() {
            return *from;
        }
        let VirtualToolSettings { mass, damping, lead_s } = self.tool;
        self.velocity = (self.velocity + (coupled + torque) * (dt / mass)) / (1.0 + dt * damping / mass);
        self.orientation = product(&UnitQuaternion::from_scaled_axis(self.velocity * dt), &self.orientation);
        self.work_j = coupled.dot(&(self.orientation * self.before.inverse()).scaled_axis());
        product(&UnitQuaternion::from_scaled_axis(self.velocity * lead_s), &self.orientation)
    }

    /// Follow the command that bounds have turned from `wanted` to `command`, at most at `max_speed` in rad/s, and not
    /// outwards where `leaves` is true.
    pub(crate) fn limit(
        &mut self,
        [wanted, command]: [&UnitQuaternion<f64>; 2],
        max_speed: f64,
        leaves: bool,
    ) {
        let moved = (command * wanted.inverse()).scaled_axis();
        if leaves && moved.norm() > 0.0 {
            let direction = moved.normalize();
            self.velocity -= direction * self.velocity.dot(&direction).min(0.0);
        }
        self.velocity = capped(&self.velocity, max_speed);
        let lead = self.velocity * self.tool.lead_s;
        self.orientation = product(&UnitQuaternion::from_scaled_axis(-lead), command);
    }

    /// Angular velocity in rad/s of the tool.
    pub(crate) fn velocity(&self) -> &Axes<3> {
        &self.velocity
    }

    /// `tau_c` in N m, and whether the bounds on speed and turn acted. None unless the arm takes torques.
    pub(crate) fn exerted(&self) -> Option<(&Axes<3>, [bool; 2])> {
        self.arm.map(|_| (&self.torque, self.limited))
    }

    /// Work in J of `tau_c` on a virtual tool over the tick that begins; 0 for an arm that takes torques.
    pub(crate) fn work_j(&self) -> f64 {
        self.work_j
    }

    /// Numbers and energy in J for the next frame; None while not engaged.
    pub(crate) fn sent(&self) -> Option<(&Axes<3>, f64)> {
        self.engaged.then(|| (&self.sent, self.half.sent().1))
    }

    /// End the engagement; the spring loses its energy.
    pub(crate) fn disengage(&mut self) {
        self.engaged = false;
    }

    /// Energy in J that the half may still give; NaN for a half that counts none.
    pub(crate) fn left_j(&self) -> f64 {
        self.half.left_j()
    }
}
