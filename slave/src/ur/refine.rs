//! From a posture of the model to one of this unit: a Newton iteration on its own chain.

use nalgebra::{Matrix3, Matrix6, Vector3, Vector6};

use crate::{UrPose, UrRows};

/// What a posture may be off by, in m and rad: a hundredth of what rounding leaves of common normals at 446 m would be
/// asking too much, and 1e-12 is what is promised.
pub(crate) const CLOSE: f64 = 5e-13;
/// Where nothing is left to be gained.
const ROUNDED: f64 = 2e-14;
/// A simple root takes 3 to 5; where two branches meet, each step halves the distance: 2^-30 of 1 rad.
const MAX_STEPS: usize = 40;
/// Steps that may fail to halve what a posture is off by, one after the other.
const MAX_IDLE: usize = 12;
/// Longest step of a joint, rad: farther, the chain is no longer as straight as a step takes it to be.
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
        let (mut turn, mut place) = (Matrix3::identity(), Vector3::zeros());
        let mut axes = [(Vector3::zeros(), Vector3::zeros()); 6];
        for (i, axis) in axes.iter_mut().enumerate() {
            let (s, c) = (q[i] + self.rows.theta[i]).sin_cos();
            let (sa, ca) = self.twists[i];
            let (x, y, z) = (
                turn.column(0) * c + turn.column(1) * s,
                turn.column(1) * c - turn.column(0) * s,
                turn.column(2).into_owned(),
            );
            let (along, normal) = (z * self.rows.d[i], x * self.rows.a[i]);
            // The axis, and the step from it to the next frame.
            *axis = (z, normal);
            place += along + normal;
            turn = Matrix3::from_columns(&[x, y * ca + z * sa, z * ca - y * sa]);
        }
        let mut jacobian = Matrix6::zeros();
        let mut lever = Vector3::zeros();
        for (i, (z, normal)) in axes.iter().enumerate().rev() {
            lever += normal;
            jacobian.fixed_view_mut::<3, 1>(0, i).copy_from(&z.cross(&lever));
            jacobian.fixed_view_mut::<3, 1>(3, i).copy_from(z);
            lever += z * self.rows.d[i];
        }
        (UrPose { turn, place }, jacobian)
    }

    /// Whether each coordinate of the flange is within `most`, in m or rad, of `target`.
    pub(crate) fn is_within(&self, target: &UrPose, q: &[f64; 6], most: f64) -> bool {
        difference(target, &self.forward(q).0).amax() < most
    }

    /// The posture near `start` that has the flange at `target`, or how far off it ends.
    ///
    /// Steps of Levenberg and Marquardt, `(J'J + |e|^2 / 100) dq = J'e`: quadratic also where solutions are not isolated, as
    /// at the wrist's singularity.
    ///
    /// Source: N. Yamashita, M. Fukushima, "On the Rate of Convergence of the Levenberg-Marquardt Method", Computing
    /// Supplement 15, 2001.
    pub(crate) fn refine(&self, target: &UrPose, start: &[f64; 6]) -> Result<[f64; 6], f64> {
        let mut q = *start;
        let (mut best, mut least) = (q, f64::INFINITY);
        let mut idle = 0;
        for _ in 0..MAX_STEPS {
            let (pose, jacobian) = self.forward(&q);
            let error = difference(target, &pose);
            let off = error.amax();
            idle = if off > 0.5 * least { idle + 1 } else { 0 };
            let stalled = idle > if off <= CLOSE { 0 } else { MAX_IDLE };
            if off < least {
                (best, least) = (q, off);
            }
            if least <= ROUNDED || stalled {
                break;
            }
            let transposed = jacobian.transpose();
            let mut normal = transposed * jacobian;
            // Without the second term the factors of a singular matrix may not exist.
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
        if least <= CLOSE { Ok(best) } else { Err(least) }
    }
}

/// What takes one pose to another, in the base: translation over rotation vector.
pub(crate) fn difference(target: &UrPose, from: &UrPose) -> Vector6<f64> {
    let apart = target.turn * from.turn.transpose();
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
