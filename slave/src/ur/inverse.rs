//! Inverse kinematics of a UR arm in closed form: all eight branches.
//!
//! Derived from the rows of [`UrRows`]. `u = (s1, -c1, 0)` is the direction of the three parallel axes, and `m = R' u`
//! is `(s5 c6, -s5 s6, c5)`:
//!
//! 1. The wrist centre `p - d6 z6` is `d4` from the plane through the base axis with normal u: two q1.
//! 2. q5 is the angle of m from its z axis, with either sign, and m points along q6. Both use `atan2`, which loses no
//!    digits where an arc cosine is flat.
//! 3. The rest is a two-link arm in that plane: two q3, q2, and q4 from the angle of the last link.
//!
//! Two branches meet at the shoulder singularity (wrist centre at d4 from the base axis) and at the elbow singularity
//! (arm stretched or folded). There, joint angles depend on the square root of rounding, but the resulting pose is
//! right to rounding. The errors of q1 and q3 act in second order, and all later angles are solved for the q1 and q3
//! found. At the wrist singularity (q5 is 0 or pi), q4 and q6 turn about the same line; q6 then keeps its value.
//!
//! Source: K. P. Hawkins, "Analytic Inverse Kinematics for the Universal Robots UR-5/UR-10 Arms", Georgia Institute of
//! Technology, 2013, for the order of the steps and the eight branches.

use std::f64::consts::PI;

use nalgebra::{Vector2, Vector3};

use crate::{UrPose, ur::chain::UrLengths};

/// Tolerances: error of m, and distance of a pose beyond reach.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Slack {
    /// rad; divided by the sine of q5 it is the interval in which q6 is free.
    pub(crate) rotation: f64,
    /// m; a pose within it gets the nearest posture.
    pub(crate) place_m: f64,
}

/// Rounding, including that of the pose.
pub(crate) const ROUNDING: Slack = Slack { rotation: 1e-14, place_m: 4e-13 };

/// Reason why a pose cannot be reached.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum UrUnreached {
    /// The wrist centre is within the cylinder around the base axis that no posture reaches.
    #[error("wrist centre {radius_m:.6} m from the axis of the base: must be at least {min_m:.6} m")]
    Shoulder {
        /// Radius of the wrist centre, m.
        radius_m: f64,
        /// Smallest radius within reach, m.
        min_m: f64,
    },
    /// The wrist is farther from the shoulder than the stretched arm, or nearer than the folded arm.
    #[error("wrist {reach_m:.6} m from the shoulder: must be within {min_m:.6} to {max_m:.6} m")]
    Elbow {
        /// Reach of the nearest branch, m.
        reach_m: f64,
        /// Reach of the folded arm, m.
        min_m: f64,
        /// Reach of the stretched arm, m.
        max_m: f64,
    },
    /// In every branch, a joint would leave its limits.
    #[error("joint {joint} at {angle:.6} rad: no turn of it is within its limits in any branch")]
    Limits {
        /// Joint of the branch nearest to the previous posture, from 1.
        joint: usize,
        /// Its angle, rad.
        angle: f64,
    },
    /// No branch of the model leads to a posture of this unit.
    #[error("off by {residual:.3e} m or rad after refinement: must be within 5e-13")]
    Refinement {
        /// Error of the nearest branch, m or rad.
        residual: f64,
    },
}

/// Up to eight postures in rad, or the reason why there are none.
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

    /// The postures, ordered by shoulder, wrist and elbow side.
    pub fn postures(&self) -> &[[f64; 6]] {
        &self.postures[..self.count]
    }

    /// Reason why there is no posture; none if there is one.
    pub fn unreached(&self) -> Option<UrUnreached> {
        if self.count == 0 { self.unreached } else { None }
    }

    pub(crate) fn push(&mut self, posture: [f64; 6]) {
        self.postures[self.count] = posture;
        self.count += 1;
    }

    /// Keep only the wanted postures.
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

    /// Keep the reason of the branch that is closest to reach.
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

/// Wrap an angle into -pi to pi.
pub(crate) fn wrapped(angle: f64) -> f64 {
    angle - 2.0 * PI * (angle / (2.0 * PI)).round()
}

/// All branches that reach a pose of the flange.
///
/// If q5 is so near 0 or pi that q6 is free, q6 is as near to the argument `q6` as possible.
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
            // The x axis of frame 4 in the base.
            let x4 = rotation * Vector3::new(c5 * c6, -c5 * s6, -s5);
            let q234 = x4.z.atan2(c1 * x4.x + s1 * x4.y);
            // tan^2(q3/2) of the angle between the links; each factor is a difference of measured lengths.
            let bent = ((stretched - reach) * (stretched + reach)).max(0.0).sqrt();
            let straight = ((reach - fold) * (reach + fold)).max(0.0).sqrt();
            let between = 2.0 * bent.atan2(straight);
            // If a2 and a3 have opposite signs, q3 = pi is the stretched arm.
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

/// Target of the end of the two links in their plane, seen from the shoulder, as a function of q6.
struct Wrist {
    centre: Vector2<f64>,
    x6: Vector2<f64>,
    y6: Vector2<f64>,
    d5: f64,
}

impl Wrist {
    /// `c - d5 z4`, where z4, the axis of joint 5, is `(-s6, -c6, 0)` in the flange frame.
    fn place(&self, q6: f64) -> Vector2<f64> {
        let (s6, c6) = q6.sin_cos();
        self.centre + (self.x6 * s6 + self.y6 * c6) * self.d5
    }

    /// Nearest q6 that brings the wrist within reach, if it is out of reach.
    ///
    /// For a free q6: x6 and y6 are then perpendicular, and `reach^2 = c^2 + d5^2 + 2 d5 k cos(q6 - phase)`.
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
        // If no q6 brings it within reach, use the one that comes nearest.
        let away = cosine.clamp(-1.0, 1.0).acos();
        away.is_finite().then(|| phase + away.copysign(wrapped(q6 - phase)))
    }
}
