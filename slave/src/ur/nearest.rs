//! The posture of a UR arm nearest to its previous one, over all branches and turns of its joints.

use std::f64::consts::PI;

use crate::{
    ModelError, UrBranches, UrPose, UrRows, UrUnreached,
    ur::chain::{CLOSE, UrChain, UrLengths},
    ur::inverse::{ROUNDING, Slack, closed_form, wrapped},
};

/// Allowed difference in reach between a unit and its model; rotations as in the model.
const UNIT: Slack = Slack { place_m: 0.05, ..ROUNDING };
/// The same, with different rotations allowed.
const LOOSE_UNIT: Slack = Slack { rotation: 0.02, ..UNIT };
/// Sine of q5 below which the difference matters.
const BESIDE: f64 = 0.2;
/// Number of q6 values to try where the rotations of the unit leave it free.
const AROUND: i32 = 8;
/// Distance in rad by which rounding may put a joint past its limit; it is then set to the limit.
const SLACK_RAD: f64 = 1e-13;
/// Largest distance in rad that refinement may move a branch towards the previous posture; more distant branches are
/// skipped.
const MOVED_RAD: f64 = 0.3;

/// Distance of the flange from its target, in m and rad, within which a posture is worth a start.
const WITHIN: f64 = 0.3;

/// Inverse kinematics of one arm: (pose) -> postures, without state.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct UrInverse {
    arm: UrLengths,
    /// Chain of a unit that differs from its model.
    unit: Option<UrChain>,
    lower: [f64; 6],
    upper: [f64; 6],
}

impl UrInverse {
    /// Build from the rows of the model, those of the unit if it has its own, and the joint limits in rad.
    ///
    /// # Errors
    ///
    /// The model is not a UR arm, a number is not finite (a limit may be infinite), or the limits are empty.
    pub fn new(
        model: &UrRows,
        unit: Option<&UrRows>,
        lower: [f64; 6],
        upper: [f64; 6],
    ) -> Result<Self, ModelError> {
        let arm = model.lengths()?;
        if let Some(rows) = unit {
            rows.check_finite()?;
        }
        for (&low, &high) in lower.iter().zip(&upper) {
            if low.is_nan() || high.is_nan() || low >= high {
                return Err(ModelError {
                    name: "position_min",
                    seen: low,
                    allowed: "less than position_max",
                });
            }
        }
        Ok(Self { arm, unit: unit.map(UrChain::new), lower, upper })
    }

    /// All branches, each joint within -pi to pi, without limits. A free q6 has an arbitrary value.
    ///
    /// Branches that meet at a singularity appear twice.
    pub fn all(&self, base_from_flange: &UrPose) -> UrBranches {
        let Some(unit) = &self.unit else {
            return closed_form(&self.arm, base_from_flange, None, ROUNDING);
        };
        let starts = closed_form(&self.arm, base_from_flange, None, UNIT);
        let mut found = UrBranches::none();
        found.unreached = starts.unreached;
        for start in starts.postures() {
            match unit.refine(base_from_flange, start) {
                Ok(posture) => found.push(posture.map(wrapped)),
                Err(residual) => found.miss_refinement(residual),
            }
        }
        found
    }

    /// Posture within the limits nearest to `near`, by the sum of squares over the joints, in rad.
    ///
    /// A free q6 keeps its value.
    ///
    /// # Errors
    ///
    /// The reason why there is no posture.
    pub fn nearest(&self, base_from_flange: &UrPose, near: &[f64; 6]) -> Result<[f64; 6], UrUnreached> {
        match &self.unit {
            None => {
                let branches = closed_form(&self.arm, base_from_flange, Some(near[5]), ROUNDING);
                let mut choice = Choice::new(near, branches.unreached());
                for posture in branches.postures() {
                    choice.offer(self, posture);
                }
                choice.made()
            }
            Some(unit) => self.nearest_of_unit(unit, base_from_flange, near),
        }
    }

    fn nearest_of_unit(
        &self,
        unit: &UrChain,
        flange: &UrPose,
        near: &[f64; 6],
    ) -> Result<[f64; 6], UrUnreached> {
        let branches = closed_form(&self.arm, flange, Some(near[5]), UNIT);
        let mut choice = Choice::new(near, branches.unreached());
        // The previous posture is a start as well, unless it is far off. Beside a singularity a posture may be nearer
        // to it than to any branch of the model.
        if unit.is_within(flange, near, WITHIN) {
            choice.offer_refined(self, unit, flange, near);
        }
        self.offer_refined(unit, flange, near, &branches, &mut choice);
        // If the arm is almost stretched and q5 almost 0, the q6 of the model may be far off.
        for step in 0..AROUND {
            if choice.distance.is_finite() {
                break;
            }
            let q6 = near[5] + 2.0 * PI * f64::from(step) / f64::from(AROUND);
            let mut branches = closed_form(&self.arm, flange, Some(q6), LOOSE_UNIT);
            branches.keep(|posture| posture[4].sin().abs() < BESIDE);
            self.offer_refined(unit, flange, near, &branches, &mut choice);
        }
        choice.made()
    }

    /// Refine branches of the model, nearest first, while they may become the choice.
    fn offer_refined(
        &self,
        unit: &UrChain,
        flange: &UrPose,
        near: &[f64; 6],
        branches: &UrBranches,
        choice: &mut Choice,
    ) {
        let mut starts = [(f64::INFINITY, [0.0; 6]); 8];
        for (start, posture) in starts.iter_mut().zip(branches.postures()) {
            let turned: [f64; 6] = std::array::from_fn(|i| near[i] + wrapped(posture[i] - near[i]));
            *start = (distance(&turned, near), turned);
        }
        starts.sort_unstable_by(|one, other| one.0.total_cmp(&other.0));
        for (away, start) in &starts[..branches.postures().len()] {
            if away.sqrt() > choice.distance.sqrt() + MOVED_RAD {
                break;
            }
            choice.offer_refined(self, unit, flange, start);
        }
    }

    /// Each joint at the turn within its limits nearest to its angle; else the first joint without one.
    fn within_limits(&self, posture: &[f64; 6]) -> Result<[f64; 6], UrUnreached> {
        let mut turned = [0.0; 6];
        for (i, turned) in turned.iter_mut().enumerate() {
            let (lower, upper) = (self.lower[i], self.upper[i]);
            let mut angle = posture[i];
            if angle > upper + SLACK_RAD {
                angle -= 2.0 * PI * ((angle - upper - SLACK_RAD) / (2.0 * PI)).ceil();
            } else if angle < lower - SLACK_RAD {
                angle += 2.0 * PI * ((lower - SLACK_RAD - angle) / (2.0 * PI)).ceil();
            }
            if angle > upper + SLACK_RAD || angle < lower - SLACK_RAD {
                return Err(UrUnreached::Limits { joint: i + 1, angle: posture[i] });
            }
            *turned = angle.clamp(lower, upper);
        }
        Ok(turned)
    }
}

impl UrBranches {
    fn miss_refinement(&mut self, residual: f64) {
        match self.unreached {
            Some(UrUnreached::Refinement { residual: before }) if before <= residual => {}
            _ => self.unreached = Some(UrUnreached::Refinement { residual }),
        }
    }
}

fn distance(one: &[f64; 6], other: &[f64; 6]) -> f64 {
    one.iter().zip(other).map(|(a, b)| (a - b) * (a - b)).sum()
}

/// Nearest of the offered postures, or the reason why there was none.
struct Choice<'a> {
    near: &'a [f64; 6],
    posture: [f64; 6],
    distance: f64,
    unreached: Option<UrUnreached>,
    /// Distance of the nearest posture outside the limits.
    forbidden: f64,
}

impl<'a> Choice<'a> {
    fn new(near: &'a [f64; 6], unreached: Option<UrUnreached>) -> Self {
        Self { near, posture: [0.0; 6], distance: f64::INFINITY, unreached, forbidden: f64::INFINITY }
    }

    fn offer(&mut self, arm: &UrInverse, posture: &[f64; 6]) {
        let nearest = std::array::from_fn(|i| self.near[i] + wrapped(posture[i] - self.near[i]));
        match arm.within_limits(&nearest) {
            Ok(posture) => {
                let away = distance(&posture, self.near);
                if away < self.distance {
                    (self.posture, self.distance) = (posture, away);
                }
            }
            Err(reason) => {
                let away = distance(&nearest, self.near);
                if away < self.forbidden {
                    (self.unreached, self.forbidden) = (Some(reason), away);
                }
            }
        }
    }

    fn offer_refined(&mut self, arm: &UrInverse, unit: &UrChain, flange: &UrPose, start: &[f64; 6]) {
        match unit.refine(flange, start) {
            Ok(posture) => self.offer(arm, &posture),
            // A limit is more specific than a failed start; of failed starts, keep the best.
            Err(residual) if self.forbidden == f64::INFINITY => match self.unreached {
                Some(UrUnreached::Refinement { residual: before }) if before <= residual => {}
                _ => self.unreached = Some(UrUnreached::Refinement { residual }),
            },
            Err(_) => {}
        }
    }

    fn made(self) -> Result<[f64; 6], UrUnreached> {
        if self.distance.is_finite() {
            return Ok(self.posture);
        }
        Err(self.unreached.unwrap_or(UrUnreached::Refinement { residual: CLOSE }))
    }
}
