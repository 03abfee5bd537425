//! Inverse kinematics of a UR arm in closed form: all eight branches.
//!
//! Written out anew from the rows of [`UrRows`]. With `u = (s1, -c1, 0)`, the direction of the three parallel axes, and
//! `m = R' u`, which is `(s5 c6, -s5 s6, c5)`:
//!
//! 1. the wrist's centre `p - d6 z6` is `d4` from the plane through the base's axis along which u is normal: two q1;
//! 2. q5 is the angle of m from its z axis, either sign, q6 where it points to; both from `atan2`, so that nothing is lost
//!    where an arc cosine is flat;
//! 3. what is left is an arm of two links in that plane: two q3, q2, and q4 from the angle of the last link.
//!
//! Where two branches meet (shoulder: the wrist's centre at d4 from the base's axis; elbow: arm stretched or folded),
//! joint angles hang on the square root of rounding, yet the pose they lead to is right to rounding: what q1 and q3
//! miss is of second order, and all after them is solved for the q1 and q3 that were found. Where q5 is 0 or pi
//! (wrist), q4 and q6 turn about the same line: q6 then stays where it was.
//!
//! Source: K. P. Hawkins, "Analytic Inverse Kinematics for the Universal Robots UR-5/UR-10 Arms", Georgia Institute of
//! Technology, 2013, for the order of the steps and the eight branches.

use std::f64::consts::PI;

use nalgebra::{Vector2, Vector3};

use crate::{UrPose, ur::chain::UrLengths};

/// What m may be off by, and how far out of reach a pose may be.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Slack {
    /// rad: over the sine of q5, it leaves q6 open.
    pub(crate) rotation: f64,
    /// m: such a pose gets the posture that comes nearest.
    pub(crate) place_m: f64,
}

/// Rounding, with what the pose brings along.
pub(crate) const ROUNDING: Slack = Slack { rotation: 1e-14, place_m: 4e-13 };

/// Why a pose cannot be had.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum UrUnreached {
    /// The wrist's centre is within the cylinder around the base's axis that no posture enters.
    #[error("wrist centre {radius_m:.6} m from the axis of the base: must be at least {min_m:.6} m")]
    Shoulder {
        /// Of the wrist's centre, m.
        radius_m: f64,
        /// That can be had, m.
        min_m: f64,
    },
    /// The wrist is farther from the shoulder than the arm is long, or nearer than it folds.
    #[error("wrist {reach_m:.6} m from the shoulder: must be within {min_m:.6} to {max_m:.6} m")]
    Elbow {
        /// Of the branch that comes nearest, m.
        reach_m: f64,
        /// Folded, m.
        min_m: f64,
        /// Stretched, m.
        max_m: f64,
    },
    /// Every branch has a joint that would leave its limits.
    #[error("joint {joint} at {angle:.6} rad: no turn of it is within its limits in any branch")]
    Limits {
        /// Of the branch nearest to where the arm was, from 1.
        joint: usize,
        /// Its angle, rad.
        angle: f64,
    },
    /// No branch of the model leads to a posture of this unit.
    #[error("off by {residual:.3e} m or rad after refinement: must be within 5e-13")]
    Refinement {
        /// Of the branch that is nearest, m or rad.
        residual: f64,
    },
}

/// Up to eight postures, rad, and why there are none.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct UrBranches {
    postures: [[f64; 6]; 8],
    count: usize,
    pub(crate) unreached: Option<UrUnreached>,
}

impl UrBranches {
    pub(crate) fn none() -> Self {
        Self { postures: [[0.0; 6]; 8], count: 0, unreached: None }
    }

    /// The postures: shoulder, wrist and elbow one way and the other, in this order.
    pub fn postures(&self) -> &[[f64; 6]] {
        &self.postures[..self.count]
    }

    /// Why there is no posture at all, if there is none.
    pub fn unreached(&self) -> Option<UrUnreached> {
        if self.count == 0 { self.unreached } else { None }
    }

    pub(crate) fn push(&mut self, posture: [f64; 6]) {
        self.postures[self.count] = posture;
        self.count += 1;
    }

    /// Drop the others.
    pub(crate) fn keep(&mut self, wanted: impl Fn(&[f64; 6]) -> bool) {
        let mut kept = 0;
        for index in 0..self.count {
            if wanted(&self.postures[index]) {
                self.postures[kept] = self.postures[index];
                kept += 1;
            }
        }
        self.count = kept;
    }

    /// Keep the reason that comes nearest to having been none.
    fn miss_elbow(&mut self, reach_m: f64, min_m: f64, max_m: f64) {
        let short = |reach: f64| (reach - max_m).max(min_m - reach);
        let closer = match self.unreached {
            Some(UrUnreached::Elbow { reach_m: before, .. }) => short(reach_m) < short(before),
            _ => true,
        };
        if closer {
            self.unreached = Some(UrUnreached::Elbow { reach_m, min_m, max_m });
        }
    }
}

/// An angle within -pi to pi.
pub(crate) fn wrapped(angle: f64) -> f64 {
    angle - 2.0 * PI * (angle / (2.0 * PI)).round()
}

/// All branches that lead to a pose of the flange.
///
/// Where q5 is so near 0 or pi that q6 is open, q6 is as near to `q6` as that allows.
pub(crate) fn closed_form(arm: &UrLengths, flange: &UrPose, q6: Option<f64>, slack: Slack) -> UrBranches {
    let mut found = UrBranches::none();
    let (rotation, place) = (&flange.rotation, &flange.place);
    let z6 = rotation.column(2);
    let centre = place - z6 * arm.d6;
    let radius = libm::hypot(centre.x, centre.y);
    let inner = arm.d4.abs();
    if radius < inner - slack.place_m {
        found.unreached = Some(UrUnreached::Shoulder { radius_m: radius, min_m: inner });
        return found;
    }
    // u'c = d4 means radius sin(q1 - angle of c) = d4.
    let along = ((radius - inner) * (radius + inner)).max(0.0).sqrt();
    let bearing = centre.y.atan2(centre.x);
    let (stretched, fold) = (arm.a2.abs() + arm.a3.abs(), (arm.a2.abs() - arm.a3.abs()).abs());
    for side in [1.0, -1.0] {
        let q1 = bearing + arm.d4.atan2(side * along);
        let (s1, c1) = q1.sin_cos();
        let m = rotation.tr_mul(&Vector3::new(s1, -c1, 0.0));
        let across = libm::hypot(m.x, m.y);
        let open = (slack.rotation / across.max(f64::MIN_POSITIVE)).min(PI);
        let in_plane = |v: &Vector3<f64>| Vector2::new(c1 * v.x + s1 * v.y, v.z);
        let wrist = Wrist {
            centre: in_plane(&centre) - Vector2::new(0.0, arm.d1),
            x6: in_plane(&rotation.column(0).into()),
            y6: in_plane(&rotation.column(1).into()),
            d5: arm.d5,
        };
        for bend in [1.0, -1.0] {
            let q5 = (bend * across).atan2(m.z);
            let seen = (-bend * m.y).atan2(bend * m.x);
            let mut q6 = seen + wrapped(q6.unwrap_or(seen) - seen).clamp(-open, open);
            let mut reach = wrist.place(q6).norm();
            if let Some(other) = wrist.brought_within(fold, stretched, reach, q6)
                && wrapped(other - seen).abs() <= open
            {
                q6 = other;
                reach = wrist.place(q6).norm();
            }
            if reach > stretched + slack.place_m || reach < fold - slack.place_m {
                found.miss_elbow(reach, fold, stretched);
                continue;
            }
            let (s5, c5) = q5.sin_cos();
            let (s6, c6) = q6.sin_cos();
            // The x axis of frame 4 as the flange sees it.
            let x4 = rotation * Vector3::new(c5 * c6, -c5 * s6, -s5);
            let q234 = x4.z.atan2(c1 * x4.x + s1 * x4.y);
            // tan^2(q3/2) of the angle between the links, each factor a difference of what is measured.
            let bent = ((stretched - reach) * (stretched + reach)).max(0.0).sqrt();
            let straight = ((reach - fold) * (reach + fold)).max(0.0).sqrt();
            let between = 2.0 * bent.atan2(straight);
            // With a2 and a3 of opposite signs, stretched is q3 = pi.
            let elbow = if arm.a2 * arm.a3 > 0.0 { between } else { PI - between };
            let place = wrist.place(q6);
            for up in [1.0, -1.0] {
                let q3 = up * elbow;
                let (s3, c3) = q3.sin_cos();
                let q2 = place.y.atan2(place.x) - (arm.a3 * s3).atan2(arm.a2 + arm.a3 * c3);
                found.push([q1, q2, q3, q234 - q2 - q3, q5, q6].map(wrapped));
            }
        }
    }
    found
}

/// Where the end of the two links must be in their plane, seen from the shoulder, by q6.
struct Wrist {
    centre: Vector2<f64>,
    x6: Vector2<f64>,
    y6: Vector2<f64>,
    d5: f64,
}

impl Wrist {
    /// `c - d5 z4`, where z4, the axis of joint 5, is `(-s6, -c6, 0)` to the flange.
    fn place(&self, q6: f64) -> Vector2<f64> {
        let (s6, c6) = q6.sin_cos();
        self.centre + (self.x6 * s6 + self.y6 * c6) * self.d5
    }

    /// The nearest q6 that has the wrist within reach, if it is not.
    ///
    /// For a q6 that is free: then x6 and y6 are square, and `reach^2 = c^2 + d5^2 + 2 d5 k cos(q6 - phase)`.
    fn brought_within(&self, fold: f64, stretched: f64, reach: f64, q6: f64) -> Option<f64> {
        let limit = if reach > stretched {
            stretched
        } else if reach < fold {
            fold
        } else {
            return None;
        };
        let (along_x, along_y) = (self.centre.dot(&self.x6), self.centre.dot(&self.y6));
        let phase = along_x.atan2(along_y);
        let cosine = (limit * limit - self.centre.norm_squared() - self.d5 * self.d5)
            / (2.0 * self.d5 * libm::hypot(along_x, along_y));
        // Where no q6 has it within reach, the one that comes nearest.
        let away = cosine.clamp(-1.0, 1.0).acos();
        away.is_finite().then(|| phase + away.copysign(wrapped(q6 - phase)))
    }
}
