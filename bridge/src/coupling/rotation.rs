//! Position-force coupling of a rotation: orientation forward, torque back.

use nalgebra::{Quaternion, Unit, UnitQuaternion, Vector3};
use std::f64::consts::{PI, TAU};

use super::{CouplingError, UNIT, canonical, change::Changing, normalised, position_force::check};

/// Angle in rad from the anchor beyond which a scaled rotation goes on from a new anchor.
pub const ANCHOR_REACH_RAD: f64 = 1.5 * PI;

/// Largest turn in rad of the master that is taken in one piece.
const MAX_PIECE_RAD: f64 = 0.5;

/// `cos²` of half the swing beyond which a rotation about one axis goes on from a new anchor: a swing of pi / 2.
const MIN_TWIST: f64 = 0.5;

/// What of the rotation does not follow.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum RotationLock {
    /// All of it follows.
    #[default]
    Free,
    /// Only the turn about this axis of the slave's base frame follows.
    OnlyAbout(Unit<Vector3<f64>>),
    /// The slave keeps its orientation.
    Locked,
}

impl RotationLock {
    /// Free about `axis` alone, of length 1, in the slave's base frame.
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

/// The slave turns as the master does; the master renders the torque that the slave measures.
///
/// `R_s = D^lambda_r R_s0` with `D = C R_m R_m0' C'`, `tau_m = lambda_tau C' L tau_s`; angular velocities and torques in
/// base frames, torques about the tool point. `R_m0` and `R_s0` are taken when the two engage, so the slave never jumps;
/// they are taken anew when frame or lock change. Of a scale that changes, `R_s0` alone.
///
/// **Powers.** `D^lambda = exp(lambda phi)` with `exp(phi) = D`. Of the vectors phi that differ by whole turns it is the
/// one nearest to the last: phi goes on past pi, and nothing jumps there. With `lambda_r = 1` phi is not needed, and
/// `D^1 = D` for any number of turns. The velocity that belongs to it is `w_s = lambda J(lambda phi) J(phi)^-1 C w_m`,
/// with J the left Jacobian of SO(3). Both Jacobians turn and stretch the plane across phi, so their product is closed:
/// along phi `lambda`, across it a stretch by `sin(lambda |phi| / 2) / sin(|phi| / 2)` and a turn about phi by
/// `(lambda - 1) |phi| / 2`.
///
/// **Where it ends.** Only whole powers are continuous on all of SO(3): every phi of length 2 pi is the same D, but not
/// every `lambda phi` the same rotation, so across a phi of nearly 2 pi the stretch has no bound. Beyond
/// [`ANCHOR_REACH_RAD`] the two are therefore anchored anew where they are: the command goes on without a jump, its
/// velocity across phi has a step. So the slave turns at most `max(lambda_r, sqrt 2)` times as fast as the master,
/// `max(lambda_r, 1)` times up to pi. It is back in `R_s0` when the master is back in `R_m0`, by any way within this
/// reach, and about one axis after any number of turns; after a way of several axes that led beyond, it is not.
///
/// **About one axis** e: `R_s = exp(lambda alpha e) R_s0`, where alpha is the turn about e in `D = exp(alpha e) S`, with S
/// a swing about an axis across e: `alpha = 2 atan2(e·v, w)` of D's quaternion (w, v), again the one nearest to the last,
/// for any number of turns. `alpha' = g·C w_m`, `g = (w² e + w v x e + (e·v) v) / (w² + (e·v)²)`, `|g| = 1 / cos(S / 2)`.
/// At a swing of pi there is no such turn; beyond pi / 2, where `|g| = sqrt 2`, the two are anchored anew.
///
/// **Lost frames.** Between two orientations of the master it is taken to have turned the shorter way, evenly. Where lost
/// frames hide more than pi, the slave goes the other way round: with `lambda_r = 1` to the same orientation, else to one
/// that is `lambda_r 2 pi` off until they are anchored anew. The bounds above hold for the shorter way too: no loss
/// makes the command jump further than they allow.
///
/// About a constant axis `tau_m·w_m = (lambda_tau / lambda_r) tau_s·w_s`; of other motions the torque is not the dual,
/// for a moment is to be felt about the axis that it has.
///
/// Source: Murray, Li and Sastry 1994, section 2.2.2 (exponential coordinates); Sola, Deray and Atchuthan, *A micro Lie
/// theory for state estimation in robotics*, arXiv 1812.01537, Eq. 145-146 (left Jacobian and its inverse); Dobrowolski,
/// *Swing-twist decomposition in Clifford algebra*, arXiv 1506.05481; the product of the Jacobians, g and the bounds are
/// derived here and held to numeric derivatives.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RotationCoupling {
    /// `lambda_r`, `lambda_tau` and C.
    change: Changing<UnitQuaternion<f64>>,
    lock: RotationLock,
    anchor: Option<Anchor>,
}

/// Where both were when they engaged, and how far they have turned since; all of the master as the slave's frame has it.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Anchor {
    master: UnitQuaternion<f64>,
    slave: UnitQuaternion<f64>,
    /// The master's orientation up to which it has followed.
    followed: UnitQuaternion<f64>,
    /// phi, or `alpha e`.
    turned: Vector3<f64>,
    /// What was commanded for it.
    command: UnitQuaternion<f64>,
}

impl Anchor {
    const fn new(master: UnitQuaternion<f64>, slave: UnitQuaternion<f64>) -> Self {
        Self { master, slave, followed: master, turned: Vector3::new(0.0, 0.0, 0.0), command: slave }
    }

    /// D, at a master's orientation.
    fn turn(&self, master: &UnitQuaternion<f64>) -> UnitQuaternion<f64> {
        product(master, &self.master.inverse())
    }
}

/// Of norm 1, so that what is commanded can be sent.
fn product(left: &UnitQuaternion<f64>, right: &UnitQuaternion<f64>) -> UnitQuaternion<f64> {
    Unit::new_normalize((left * right).into_inner())
}

/// Of the angles that differ from `angle` by whole turns, the one nearest to `last`.
fn unwrapped(angle: f64, last: f64) -> f64 {
    angle + TAU * ((last - angle) / TAU).round()
}

/// Of the vectors phi with `exp(phi) = turn`, the one nearest to `last`.
fn logarithm(turn: &UnitQuaternion<f64>, last: &Vector3<f64>) -> Vector3<f64> {
    let [w, x, y, z] = canonical(turn);
    let vector = Vector3::new(x, y, z);
    let sine = vector.norm();
    if sine == 0.0 {
        // Whole turns, about any axis.
        return last.try_normalize(0.0).map_or(Vector3::zeros(), |axis| axis * unwrapped(0.0, last.norm()));
    }
    let axis = vector / sine;
    axis * unwrapped(2.0 * sine.atan2(w), axis.dot(last))
}

impl RotationCoupling {
    /// Scales `lambda_r` and `lambda_tau` (> 0).
    pub fn new(rotation_scale: f64, torque_scale: f64) -> Result<Self, CouplingError> {
        let motion = check("rotation_scale", "lambda_r", rotation_scale)?;
        let force = check("torque_scale", "lambda_tau", torque_scale)?;
        let change = Changing::new(motion, force, UnitQuaternion::identity());
        Ok(Self { change, lock: RotationLock::Free, anchor: None })
    }

    /// Changes `lambda_r` over so many ticks, 0 at once; the slave goes on from where it is.
    pub fn set_rotation_scale(&mut self, scale: f64, ticks: u32) -> Result<(), CouplingError> {
        self.change.set_motion(check("rotation_scale", "lambda_r", scale)?, ticks);
        self.anchor_anew(ticks);
        Ok(())
    }

    /// Changes `lambda_tau` over so many ticks, 0 at once.
    pub fn set_torque_scale(&mut self, scale: f64, ticks: u32) -> Result<(), CouplingError> {
        self.change.set_force(check("torque_scale", "lambda_tau", scale)?, ticks);
        Ok(())
    }

    /// Changes C, a unit quaternion of the rotation from the master's frame to the slave's: both scales fade out and in over
    /// so many ticks each, 0 at once. The slave goes on from where it is.
    pub fn set_frame(&mut self, quat_wxyz: [f64; 4], ticks: u32) -> Result<(), CouplingError> {
        let [w, x, y, z] = normalised(quat_wxyz)?;
        self.change.set_map(Unit::new_unchecked(Quaternion::new(w, x, y, z)), ticks);
        self.anchor_anew(ticks);
        Ok(())
    }

    /// Where a change is at once, the slave goes on from where it is.
    fn anchor_anew(&mut self, ticks: u32) {
        if ticks == 0 {
            self.anchor = None;
        }
    }

    /// One tick of the master for what is being changed.
    #[inline]
    pub(crate) fn advance(&mut self) {
        if self.change.moves {
            self.change.step();
        }
    }

    /// Changes what does not follow; the slave goes on from where it is.
    pub fn set_lock(&mut self, lock: RotationLock) {
        self.lock = lock;
        self.anchor = None;
    }

    /// Master half: `tau_m` in N m from the newest `tau_s` in N m, in base frames about the tool point.
    pub fn rendered_torque(&self, slave_torque: &Vector3<f64>) -> Vector3<f64> {
        self.change.map.inverse_transform_vector(&self.lock.of(*slave_torque)) * self.change.force
    }

    /// Slave half: the orientation to command, from the newest `R_m`; the first call since
    /// [`disengage`](Self::disengage) engages at `slave`.
    ///
    /// An `R_m` that is no number is not followed. Each call is a tick of what is being changed.
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

    /// One tick of what is being changed, of a slave that was commanded by `anchor`: with another power of the same turn it
    /// begins elsewhere, `R_s0 = exp(-lambda phi) R_s`, so that neither the command nor its velocity has a step.
    #[inline(never)]
    fn step(&mut self, mut anchor: Anchor) {
        if self.lock == RotationLock::Free && self.change.motion == 1.0 {
            // Not followed until now: of the first power all are the same.
            anchor.turned = logarithm(&anchor.turn(&anchor.followed), &Vector3::zeros());
        }
        let is_exchanged = self.change.step();
        let back = UnitQuaternion::from_scaled_axis(anchor.turned * -self.change.motion);
        anchor.slave = product(&back, &anchor.command);
        // In another frame nothing is known of the way, and nothing passes at that tick.
        self.anchor = (!is_exchanged).then_some(anchor);
    }

    /// Follows the master a short way, from a new anchor where this one does not reach.
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

    /// phi or `alpha e` at a master's orientation, within reach of the anchor.
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

    /// Slave half: the angular velocity in rad/s of the orientation that was commanded last, from the newest `w_m` in rad/s.
    ///
    /// Before the two engage it is that with which they will: `lambda_r L C w_m`.
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

    /// The slave is to go on from where it is: the next call of [`commanded_orientation`](Self::commanded_orientation)
    /// takes both anew.
    pub(crate) fn let_go(&mut self) {
        self.anchor = None;
    }

    /// The two are no longer coupled; what is being changed arrives.
    pub fn disengage(&mut self) {
        self.anchor = None;
        if self.change.moves {
            self.change.settle();
        }
    }
}

#[cfg(test)]
mod tests;
