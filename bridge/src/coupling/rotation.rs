//! Position-force coupling of a rotation: orientation forward, torque back.

use nalgebra::{Quaternion, Unit, UnitQuaternion, Vector3};
use std::f64::consts::{PI, TAU};

use super::{
    CouplingError, canonical,
    change::Changing,
    frame_map::{UNIT, normalised},
    mapping::check,
};

/// Angle in rad from the anchor beyond which a scaled rotation sets a new anchor.
pub const ANCHOR_REACH_RAD: f64 = 1.5 * PI;

/// Largest turn in rad of the master that is followed in one piece.
const MAX_PIECE_RAD: f64 = 0.5;

/// `cos²` of half the swing beyond which a rotation about one axis sets a new anchor: a swing of pi / 2.
const MIN_TWIST: f64 = 0.5;

/// Part of the rotation that does not follow.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum RotationLock {
    /// No part: the whole rotation follows.
    #[default]
    Free,
    /// All but the turn about this axis of the slave's base frame.
    OnlyAbout(Unit<Vector3<f64>>),
    /// The whole rotation: the slave keeps its orientation.
    Locked,
}

impl RotationLock {
    /// Build the lock that is free only about `axis`, a unit vector in the slave's base frame.
    pub fn only_about(axis: [f64; 3]) -> Result<Self, CouplingError> {
        let axis = Vector3::from(axis);
        let length = axis.norm();
        if length.is_nan() || (length - 1.0).abs() > UNIT {
            return Err(CouplingError::Axis(length));
        }
        Ok(Self::OnlyAbout(Unit::new_unchecked(axis / length)))
    }

    /// `L v`, with L = I, `e e'` or 0.
    fn of(&self, vector: Vector3<f64>) -> Vector3<f64> {
        match self {
            Self::Free => vector,
            Self::OnlyAbout(axis) => axis.into_inner() * axis.dot(&vector),
            Self::Locked => Vector3::zeros(),
        }
    }
}

/// Position-force coupling of a rotation: the slave turns like the master; the master renders the torque that
/// the slave measures.
///
/// `R_s = D^lambda_r R_s0` with `D = C R_m R_m0' C'`, `tau_m = lambda_tau C' L tau_s`; angular velocities and
/// torques in base frames, torques about the tool point. The two sides set `R_m0` and `R_s0` when they
/// engage, so the slave never jumps. A change of frame or lock sets both again; a change of the scale sets
/// only `R_s0`.
///
/// **Powers.** `D^lambda = exp(lambda phi)` with `exp(phi) = D`. The solutions phi differ by whole
/// turns; the coupling takes the one nearest to the last phi, so phi continues past pi without a
/// jump. For `lambda_r = 1` phi is not needed, and `D^1 = D` for any number of turns.
///
/// The velocity of this command is `w_s = lambda J(lambda phi) J(phi)^-1 C w_m`, with J the left Jacobian of
/// SO(3). Both Jacobians rotate and stretch the plane across phi, so their product has a closed form. Along
/// phi it is `lambda`. Across phi it is a stretch by `sin(lambda |phi| / 2) / sin(|phi| / 2)` and a turn
/// about phi by `(lambda - 1) |phi| / 2`.
///
/// **Reach.** Only whole powers are continuous on all of SO(3). Every phi of length 2 pi is the same D, but
/// their `lambda phi` are different rotations. So the stretch across a phi of nearly 2 pi is unbounded.
/// Beyond [`ANCHOR_REACH_RAD`] the coupling therefore anchors both sides again where they are. The command
/// has no jump there, but its velocity across phi has a step.
///
/// The slave thus turns at most `max(lambda_r, sqrt 2)` times as fast as the master, and while
/// `|phi| <= pi` at most `max(lambda_r, 1)` times. When the master returns to `R_m0`, the slave
/// returns to `R_s0` if the motion stayed within the reach, or was about one axis. Otherwise it
/// does not.
///
/// **About one axis** e: `R_s = exp(lambda alpha e) R_s0`, where alpha is the turn about e in
/// `D = exp(alpha e) S`, with S a swing about an axis across e. `alpha = 2 atan2(e·v, w)` of D's quaternion
/// (w, v), again the value nearest to the last, for any number of turns. `alpha' = g·C w_m`,
/// `g = (w² e + w v x e + (e·v) v) / (w² + (e·v)²)`, `|g| = 1 / cos(S / 2)`. At a swing of pi there is no
/// turn about e. Beyond pi / 2, where `|g| = sqrt 2`, the coupling anchors both sides again.
///
/// **Lost frames.** The coupling assumes that the master turned evenly, on the shorter way, between two
/// received orientations. If lost frames hide more than pi, the slave turns the other way. With
/// `lambda_r = 1` it still reaches the same orientation. Otherwise it is off by `lambda_r 2 pi`
/// until the next anchor. The bounds above also hold for the shorter way, so no loss makes the
/// command jump beyond them.
///
/// About a constant axis `tau_m·w_m = (lambda_tau / lambda_r) tau_s·w_s`. For other
/// motions this does not hold, because the hand must feel each moment about its own axis.
///
/// Source: Murray, Li and Sastry 1994, section 2.2.2 (exponential coordinates); Sola, Deray and Atchuthan, *A
/// micro Lie theory for state estimation in robotics*, arXiv 1812.01537, Eq. 145-146 (left Jacobian and its
/// inverse); Dobrowolski, *Swing-twist decomposition in Clifford algebra*, arXiv 1506.05481. The product of
/// the Jacobians, g and the bounds are derived here and tested against numerical derivatives.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RotationCoupling {
    /// `lambda_r`, `lambda_tau` and C.
    change: Changing<UnitQuaternion<f64>>,
    lock: RotationLock,
    anchor: Option<Anchor>,
}

/// Orientations of both sides at the anchor, and the turn since then. The master's are in the slave's frame.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Anchor {
    master: UnitQuaternion<f64>,
    slave: UnitQuaternion<f64>,
    /// Orientation of the master that was followed last.
    followed: UnitQuaternion<f64>,
    /// phi, or `alpha e`.
    turned: Vector3<f64>,
    /// Command for that turn.
    command: UnitQuaternion<f64>,
}

impl Anchor {
    const fn new(master: UnitQuaternion<f64>, slave: UnitQuaternion<f64>) -> Self {
        Self { master, slave, followed: master, turned: Vector3::new(0.0, 0.0, 0.0), command: slave }
    }

    /// Return D for an orientation of the master.
    fn turn(&self, master: &UnitQuaternion<f64>) -> UnitQuaternion<f64> {
        product(master, &self.master.inverse())
    }
}

/// Product with norm 1, so that a command can be sent.
fn product(left: &UnitQuaternion<f64>, right: &UnitQuaternion<f64>) -> UnitQuaternion<f64> {
    Unit::new_normalize((left * right).into_inner())
}

/// Return `angle` plus the whole turns that bring it nearest to `last`.
fn unwrapped(angle: f64, last: f64) -> f64 {
    angle + TAU * ((last - angle) / TAU).round()
}

/// Return the vector phi with `exp(phi) = turn` that is nearest to `last`.
fn logarithm(turn: &UnitQuaternion<f64>, last: &Vector3<f64>) -> Vector3<f64> {
    let [w, x, y, z] = canonical(turn);
    let vector = Vector3::new(x, y, z);
    let sine = vector.norm();
    if sine == 0.0 {
        // A whole number of turns, about any axis.
        return last.try_normalize(0.0).map_or(Vector3::zeros(), |axis| axis * unwrapped(0.0, last.norm()));
    }
    let axis = vector / sine;
    axis * unwrapped(2.0 * sine.atan2(w), axis.dot(last))
}

impl RotationCoupling {
    /// Build the coupling with scales `lambda_r` and `lambda_tau` (> 0).
    pub fn new(rotation_scale: f64, torque_scale: f64) -> Result<Self, CouplingError> {
        let motion = check("rotation_scale", "lambda_r", rotation_scale)?;
        let force = check("torque_scale", "lambda_tau", torque_scale)?;
        let change = Changing::new(motion, force, UnitQuaternion::identity());
        Ok(Self { change, lock: RotationLock::Free, anchor: None })
    }

    /// Change `lambda_r` over `ticks` ticks, 0 means at once. The slave continues from its present
    /// orientation.
    pub fn set_rotation_scale(&mut self, scale: f64, ticks: u32) -> Result<(), CouplingError> {
        self.change.set_motion(check("rotation_scale", "lambda_r", scale)?, ticks);
        self.drop_anchor(ticks);
        Ok(())
    }

    /// Change `lambda_tau` over `ticks` ticks, 0 means at once.
    pub fn set_torque_scale(&mut self, scale: f64, ticks: u32) -> Result<(), CouplingError> {
        self.change.set_force(check("torque_scale", "lambda_tau", scale)?, ticks);
        Ok(())
    }

    /// Change C, the rotation from the master's frame to the slave's as a unit quaternion. Both scales fade
    /// out and in over `ticks` ticks each, 0 means at once. The slave continues from its present orientation.
    pub fn set_frame(&mut self, quat_wxyz: [f64; 4], ticks: u32) -> Result<(), CouplingError> {
        let [w, x, y, z] = normalised(quat_wxyz)?;
        self.change.set_map(Unit::new_unchecked(Quaternion::new(w, x, y, z)), ticks);
        self.drop_anchor(ticks);
        Ok(())
    }

    /// Drop the anchor after an immediate change, so that the slave continues from its present orientation.
    fn drop_anchor(&mut self, ticks: u32) {
        if ticks == 0 {
            self.anchor = None;
        }
    }

    /// Step the changes by one tick of the master.
    #[inline]
    pub(crate) fn advance(&mut self) {
        if self.change.moves {
            self.change.step();
        }
    }

    /// Change the lock; the slave continues from its present orientation.
    pub fn set_lock(&mut self, lock: RotationLock) {
        self.lock = lock;
        self.anchor = None;
    }

    /// C.
    pub(super) fn frame(&self) -> UnitQuaternion<f64> {
        self.change.map
    }

    /// Master half: `tau_m` in N m from the newest `tau_s` in N m, in base frames about the tool point.
    pub fn rendered_torque(&self, slave_torque: &Vector3<f64>) -> Vector3<f64> {
        self.change.map.inverse_transform_vector(&self.lock.of(*slave_torque)) * self.change.force
    }

    /// Map a torque of the device in N m to the slave's frame, where a torque of this size would have requested it.
    pub(crate) fn coupled_torque(&self, of_device: &Vector3<f64>) -> Vector3<f64> {
        let force = self.change.force;
        if force > 0.0 { self.lock.of(self.change.map * of_device) / force } else { Vector3::zeros() }
    }

    /// Slave half: commanded orientation from the newest `R_m`. The first call after
    /// [`disengage`](Self::disengage) engages at `slave`.
    ///
    /// An `R_m` with NaN or infinity is not followed. Each call steps the changes by one tick.
    pub fn commanded_orientation(
        &mut self,
        master: &UnitQuaternion<f64>,
        slave: &UnitQuaternion<f64>,
    ) -> UnitQuaternion<f64> {
        if !master.coords.iter().all(|part| part.is_finite()) {
            return self.anchor.map_or(*slave, |anchor| anchor.command);
        }
        let frame = self.change.map;
        let master = product(&product(&frame, master), &frame.inverse());
        let Some(mut anchor) = self.anchor else {
            self.anchor = Some(Anchor::new(master, *slave));
            return *slave;
        };
        match self.lock {
            RotationLock::Locked => {}
            RotationLock::Free if self.change.motion == 1.0 => {
                anchor.command = product(&anchor.turn(&master), &anchor.slave);
            }
            RotationLock::Free | RotationLock::OnlyAbout(_) => {
                let way = product(&master, &anchor.followed.inverse()).scaled_axis();
                let pieces = (way.norm() / MAX_PIECE_RAD).ceil();
                let start = anchor.followed;
                let mut piece = 1.0;
                while piece < pieces {
                    let between = UnitQuaternion::from_scaled_axis(way * (piece / pieces)) * start;
                    self.follow(&mut anchor, between);
                    piece += 1.0;
                }
                self.follow(&mut anchor, master);
            }
        }
        anchor.followed = master;
        self.anchor = Some(anchor);
        if self.change.moves {
            self.step(anchor);
        }
        anchor.command
    }

    /// Step the changes by one tick after a command of `anchor`. A new power of the same turn needs a new
    /// origin, `R_s0 = exp(-lambda phi) R_s`, so that neither the command nor its velocity has a step.
    #[inline(never)]
    fn step(&mut self, mut anchor: Anchor) {
        if self.lock == RotationLock::Free && self.change.motion == 1.0 {
            // phi was not tracked until now; at power 1 every phi gives the same command.
            anchor.turned = logarithm(&anchor.turn(&anchor.followed), &Vector3::zeros());
        }
        let is_exchanged = self.change.step();
        let back = UnitQuaternion::from_scaled_axis(anchor.turned * -self.change.motion);
        anchor.slave = product(&back, &anchor.command);
        // In a new frame the turn so far is unknown, so drop the anchor; both scales are zero now.
        self.anchor = (!is_exchanged).then_some(anchor);
    }

    /// Follow the master a short way; set a new anchor if this one is out of reach.
    fn follow(&self, anchor: &mut Anchor, master: UnitQuaternion<f64>) {
        let turned = self.turned(anchor, &master).unwrap_or_else(|| {
            *anchor = Anchor::new(anchor.followed, anchor.command);
            self.turned(anchor, &master).unwrap_or_default()
        });
        anchor.turned = turned;
        anchor.followed = master;
        let scaled = UnitQuaternion::from_scaled_axis(turned * self.change.motion);
        anchor.command = product(&scaled, &anchor.slave);
    }

    /// Return phi or `alpha e` for an orientation of the master; `None` beyond the reach of the anchor.
    fn turned(&self, anchor: &Anchor, master: &UnitQuaternion<f64>) -> Option<Vector3<f64>> {
        let turn = anchor.turn(master);
        if let RotationLock::OnlyAbout(axis) = self.lock {
            let (cosine, sine) = (turn.w, axis.dot(&turn.imag()));
            let alpha = unwrapped(2.0 * sine.atan2(cosine), axis.dot(&anchor.turned));
            return (cosine * cosine + sine * sine >= MIN_TWIST).then(|| axis.into_inner() * alpha);
        }
        let phi = logarithm(&turn, &anchor.turned);
        (phi.norm() <= ANCHOR_REACH_RAD).then_some(phi)
    }

    /// Slave half: angular velocity in rad/s of the last command, from the newest `w_m` in rad/s.
    ///
    /// Without an anchor it is `lambda_r L C w_m`, the value at engagement.
    pub fn commanded_velocity(&self, master_velocity: &Vector3<f64>) -> Vector3<f64> {
        let velocity = self.change.map * master_velocity;
        let scale = self.change.motion;
        let Some(anchor) = &self.anchor else {
            return self.lock.of(velocity) * scale;
        };
        match self.lock {
            RotationLock::Locked => Vector3::zeros(),
            RotationLock::Free if scale == 1.0 => velocity,
            RotationLock::Free => {
                let angle = anchor.turned.norm();
                if angle == 0.0 {
                    return velocity * scale;
                }
                let axis = anchor.turned / angle;
                let along = axis * axis.dot(&velocity);
                let across = velocity - along;
                let stretch = (0.5 * scale * angle).sin() / (0.5 * angle).sin();
                let (sine, cosine) = (0.5 * (scale - 1.0) * angle).sin_cos();
                along * scale + (across * cosine + axis.cross(&across) * sine) * stretch
            }
            RotationLock::OnlyAbout(axis) => {
                let turn = anchor.turn(&anchor.followed);
                let (w, v) = (turn.w, turn.imag());
                let along = axis.dot(&v);
                let gradient = axis.into_inner() * (w * w) + v.cross(&axis) * w + v * along;
                axis.into_inner() * (scale * gradient.dot(&velocity) / (w * w + along * along))
            }
        }
    }

    /// Drop the anchor: the next [`commanded_orientation`](Self::commanded_orientation) continues from the
    /// given orientations.
    pub(crate) fn clear_anchor(&mut self) {
        self.anchor = None;
    }

    /// End the coupling and complete all changes.
    pub fn disengage(&mut self) {
        self.anchor = None;
        if self.change.moves {
            self.change.settle();
        }
    }
}

#[cfg(test)]
mod tests;
