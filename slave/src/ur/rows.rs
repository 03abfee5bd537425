//! Denavit-Hartenberg rows of a UR arm, and where its flange is.

use std::f64::consts::FRAC_PI_2;

use nalgebra::{Matrix3, Vector3};

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

/// The six lengths that tell one UR arm from another, m.
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
    /// The lengths, if all else is as in every UR arm: the closed form needs its axes exactly parallel and square.
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

/// Where a frame is in another, m.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct UrPose {
    pub(crate) turn: Matrix3<f64>,
    pub(crate) place: Vector3<f64>,
}

/// How far a matrix may be from a rotation: single precision passes, what was never a rotation does not.
const NOT_ROTATION: f64 = 1e-6;
/// What is left of that by double precision.
const ROUNDED: f64 = 1e-14;

impl UrPose {
    /// From the upper three rows of a homogeneous transform, row after row.
    ///
    /// A matrix that is a rotation to single precision is moved to the nearest one.
    ///
    /// Source: N. J. Higham, "Computing the Polar Decomposition", SIAM J. Sci. Stat. Comput. 7(4), 1986, for
    /// Newton's iteration in the form without an inverse.
    ///
    /// # Errors
    ///
    /// A number that is not finite, or no rotation within 1e-6.
    pub fn from_rows(rows: &[[f64; 4]; 3]) -> Result<Self, ModelError> {
        for &seen in rows.iter().flatten() {
            if !seen.is_finite() {
                return Err(ModelError { name: "pose", seen, allowed: "finite" });
            }
        }
        let mut turn = Matrix3::from_fn(|row, column| rows[row][column]);
        let place = Vector3::from_fn(|row, _| rows[row][3]);
        let off = |turn: &Matrix3<f64>| (turn.transpose() * turn - Matrix3::identity()).amax();
        let seen = off(&turn);
        if seen > NOT_ROTATION || turn.determinant() < 0.0 {
            let allowed = "a rotation, R'R - 1 within 1e-6 and no reflection";
            return Err(ModelError { name: "R'R - 1 of the pose", seen, allowed });
        }
        if seen > ROUNDED {
            // Each step squares what it is off by.
            for _ in 0..2 {
                turn = turn * (Matrix3::identity() * 1.5 - turn.transpose() * turn * 0.5);
            }
        }
        Ok(Self { turn, place })
    }

    /// This frame's child in this frame's parent: `a_from_b.then(&b_from_c)` is `a_from_c`.
    #[must_use]
    pub fn then(&self, child: &Self) -> Self {
        Self { turn: self.turn * child.turn, place: self.turn * child.place + self.place }
    }

    /// The parent in this frame.
    #[must_use]
    pub fn inverse(&self) -> Self {
        let turn = self.turn.transpose();
        Self { turn, place: -(turn * self.place) }
    }
}
