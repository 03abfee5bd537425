//! The chain of a UR arm: Denavit-Hartenberg rows, poses of the flange, and a Newton iteration from a posture of the
//! model to a posture of the unit.

use std::f64::consts::FRAC_PI_2;

use nalgebra::{Matrix3, Matrix6, Vector3, Vector6};

use crate::ModelError;

/// Denavit-Hartenberg rows, base to flange: `T_i = Rz(q_i + theta_i) Tz(d_i) Tx(a_i) Rx(alpha_i)`, m and rad.
///
/// Source: Universal Robots, "DH Parameters for calculations of kinematics and dynamics".
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct UrRows {
    /// Added to the joint angle.
    pub theta: [f64; 6],
    /// Length of the common normal.
    pub a: [f64; 6],
    /// Offset along the joint's axis.
    pub d: [f64; 6],
    /// Twist about the common normal.
    pub alpha: [f64; 6],
}

/// The six lengths in which UR arms differ, in m.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct UrLengths {
    pub(crate) d1: f64,
    pub(crate) a2: f64,
    pub(crate) a3: f64,
    pub(crate) d4: f64,
    pub(crate) d5: f64,
    pub(crate) d6: f64,
}

impl UrRows {
    /// The lengths, if the other parameters are those of every UR arm: the closed form needs exactly parallel and
    /// perpendicular axes.
    pub(crate) fn lengths(&self) -> Result<UrLengths, ModelError> {
        let twists = [FRAC_PI_2, 0.0, 0.0, FRAC_PI_2, -FRAC_PI_2, 0.0];
        for (&seen, &twist) in self.alpha.iter().zip(&twists) {
            if seen != twist {
                return Err(ModelError { name: "alpha", seen, allowed: "(pi/2, 0, 0, pi/2, -pi/2, 0)" });
            }
        }
        let [a1, a2, a3, a4, a5, a6] = self.a;
        let [d1, d2, d3, d4, d5, d6] = self.d;
        for (name, allowed, zeros) in [
            ("theta", "0 for every joint", &self.theta[..]),
            ("a", "0 but for joints 2 and 3", &[a1, a4, a5, a6][..]),
            ("d", "0 for joints 2 and 3", &[d2, d3][..]),
        ] {
            if let Some(&seen) = zeros.iter().find(|&&length| length != 0.0) {
                return Err(ModelError { name, seen, allowed });
            }
        }
        for (name, seen) in [("a2", a2), ("a3", a3), ("d1", d1), ("d4", d4), ("d5", d5), ("d6", d6)] {
            if !(seen.is_finite() && (seen != 0.0 || name.starts_with('d'))) {
                return Err(ModelError { name, seen, allowed: "finite, a length that is not 0" });
            }
        }
        Ok(UrLengths { d1, a2, a3, d4, d5, d6 })
    }

    pub(crate) fn check_finite(&self) -> Result<(), ModelError> {
        for (name, row) in [("theta", self.theta), ("a", self.a), ("d", self.d), ("alpha", self.alpha)] {
            if let Some(&seen) = row.iter().find(|number| !number.is_finite()) {
                return Err(ModelError { name, seen, allowed: "finite" });
            }
        }
        Ok(())
    }
}

/// Pose of a frame in another frame, in m.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct UrPose {
    pub(crate) rotation: Matrix3<f64>,
    pub(crate) place: Vector3<f64>,
}

/// Allowed deviation of a matrix from a rotation: passes single precision and rejects other matrices.
const NOT_ROTATION: f64 = 1e-6;
/// Deviation below which a matrix is a rotation to double precision.
const ROUNDED: f64 = 1e-14;

impl UrPose {
    /// Pose from the upper three rows of a homogeneous transform, row by row.
    ///
    /// A matrix that is a rotation to single precision is moved to the nearest one.
    ///
    /// Source: N. J. Higham, "Computing the Polar Decomposition", SIAM J. Sci. Stat. Comput. 7(4), 1986, for Newton's
    /// iteration in the form without an inverse.
    ///
    /// # Errors
    ///
    /// A number is not finite, or the matrix is not a rotation within 1e-6.
    pub fn from_rows(rows: &[[f64; 4]; 3]) -> Result<Self, ModelError> {
        for &seen in rows.iter().flatten() {
            if !seen.is_finite() {
                return Err(ModelError { name: "pose", seen, allowed: "finite" });
            }
        }
        let mut rotation = Matrix3::from_fn(|row, column| rows[row][column]);
        let place = Vector3::from_fn(|row, _| rows[row][3]);
        let off = |rotation: &Matrix3<f64>| (rotation.transpose() * rotation - Matrix3::identity()).amax();
        let seen = off(&rotation);
        if seen > NOT_ROTATION || rotation.determinant() < 0.0 {
            let allowed = "a rotation, R'R - 1 within 1e-6 and no reflection";
            return Err(ModelError { name: "R'R - 1 of the pose", seen, allowed });
        }
        if seen > ROUNDED {
            // Each step squares the deviation.
            for _ in 0..2 {
                rotation = rotation * (Matrix3::identity() * 1.5 - rotation.transpose() * rotation * 0.5);
            }
        }
        Ok(Self { rotation, place })
    }

    /// Composition: `a_from_b.then(&b_from_c)` is `a_from_c`.
    #[must_use]
    pub fn then(&self, child: &Self) -> Self {
        Self { rotation: self.rotation * child.rotation, place: self.rotation * child.place + self.place }
    }

    /// Inverse pose: the parent in this frame.
    #[must_use]
    pub fn inverse(&self) -> Self {
        let rotation = self.rotation.transpose();
        Self { rotation, place: -(rotation * self.place) }
    }
}

/// Allowed error of a posture, in m and rad. The guarantee is 1e-12; rounding of common normals at 446 m makes a
/// hundredth of this value unattainable.
pub(crate) const CLOSE: f64 = 5e-13;
/// Error below which refinement gains nothing.
const REFINED: f64 = 2e-14;
/// A simple root takes 3 to 5 steps. Where two branches meet, each step halves the distance: 2^-30 of 1 rad.
const MAX_STEPS: usize = 40;
/// Consecutive steps that may fail to halve the error.
const MAX_IDLE: usize = 12;
/// Longest step of a joint, in rad; the linearisation does not hold beyond.
const LONGEST: f64 = 0.5;

/// The chain of one unit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct UrChain {
    rows: UrRows,
    twists: [(f64, f64); 6],
}

impl UrChain {
    pub(crate) fn new(rows: &UrRows) -> Self {
        Self { rows: *rows, twists: rows.alpha.map(f64::sin_cos) }
    }

    /// Pose of the flange and geometric Jacobian, linear over angular velocity, in the base.
    ///
    /// Source: B. Siciliano et al., "Robotics: Modelling, Planning and Control", 2009, Eq. 3.30.
    pub(crate) fn forward(&self, q: &[f64; 6]) -> (UrPose, Matrix6<f64>) {
        let (mut rotation, mut place) = (Matrix3::identity(), Vector3::zeros());
        let mut axes = [(Vector3::zeros(), Vector3::zeros()); 6];
        for (i, axis) in axes.iter_mut().enumerate() {
            let (s, c) = (q[i] + self.rows.theta[i]).sin_cos();
            let (sa, ca) = self.twists[i];
            let (x, y, z) = (
                rotation.column(0) * c + rotation.column(1) * s,
                rotation.column(1) * c - rotation.column(0) * s,
                rotation.column(2).into_owned(),
            );
            let (along, normal) = (z * self.rows.d[i], x * self.rows.a[i]);
            // The axis, and the step from it to the next frame.
            *axis = (z, normal);
            place += along + normal;
            rotation = Matrix3::from_columns(&[x, y * ca + z * sa, z * ca - y * sa]);
        }
        let mut jacobian = Matrix6::zeros();
        let mut lever = Vector3::zeros();
        for (i, (z, normal)) in axes.iter().enumerate().rev() {
            lever += normal;
            jacobian.fixed_view_mut::<3, 1>(0, i).copy_from(&z.cross(&lever));
            jacobian.fixed_view_mut::<3, 1>(3, i).copy_from(z);
            lever += z * self.rows.d[i];
        }
        (UrPose { rotation, place }, jacobian)
    }

    /// True if each coordinate of the flange is within `limit`, in m or rad, of `target`.
    pub(crate) fn is_within(&self, target: &UrPose, q: &[f64; 6], limit: f64) -> bool {
        difference(target, &self.forward(q).0).amax() < limit
    }

    /// Posture near `start` with the flange at `target`, or the remaining error.
    ///
    /// Levenberg-Marquardt steps, `(J'J + |e|^2 / 100) dq = J'e`: quadratic also where solutions are not isolated, such
    /// as at the wrist singularity.
    ///
    /// Source: N. Yamashita, M. Fukushima, "On the Rate of Convergence of the Levenberg-Marquardt Method", Computing
    /// Supplement 15, 2001.
    pub(crate) fn refine(&self, target: &UrPose, start: &[f64; 6]) -> Result<[f64; 6], f64> {
        let mut q = *start;
        let (mut best, mut smallest) = (q, f64::INFINITY);
        let mut idle = 0;
        for _ in 0..MAX_STEPS {
            let (pose, jacobian) = self.forward(&q);
            let error = difference(target, &pose);
            let off = error.amax();
            idle = if off > 0.5 * smallest { idle + 1 } else { 0 };
            let stalled = idle > if off <= CLOSE { 0 } else { MAX_IDLE };
            if off < smallest {
                (best, smallest) = (q, off);
            }
            if smallest <= REFINED || stalled {
                break;
            }
            let transposed = jacobian.transpose();
            let mut normal = transposed * jacobian;
            // Without the second term a singular matrix may have no factors.
            let damping = 0.01 * error.norm_squared() + 1e-14;
            for i in 0..6 {
                normal[(i, i)] += damping;
            }
            let Some(factors) = normal.cholesky() else { break };
            let step = factors.solve(&(transposed * error));
            let short = (LONGEST / step.amax()).min(1.0);
            for (angle, change) in q.iter_mut().zip(&step) {
                *angle += short * change;
            }
        }
        if smallest <= CLOSE { Ok(best) } else { Err(smallest) }
    }
}

/// Difference between two poses in the base: translation over rotation vector.
pub(crate) fn difference(target: &UrPose, from: &UrPose) -> Vector6<f64> {
    let apart = target.rotation * from.rotation.transpose();
    let axis = Vector3::new(
        apart[(2, 1)] - apart[(1, 2)],
        apart[(0, 2)] - apart[(2, 0)],
        apart[(1, 0)] - apart[(0, 1)],
    ) * 0.5;
    let (sine, cosine) = (axis.norm(), (apart.trace() - 1.0) * 0.5);
    // angle / sin(angle) is 1 to rounding below 1e-8.
    let scale =
        if sine < 1e-8 && cosine > 0.0 { 1.0 } else { sine.atan2(cosine) / sine.max(f64::MIN_POSITIVE) };
    let place = target.place - from.place;
    Vector6::new(place.x, place.y, place.z, axis.x * scale, axis.y * scale, axis.z * scale)
}
