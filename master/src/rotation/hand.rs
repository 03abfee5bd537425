//! A hand on a handle: a torsion spring and damper towards a moving orientation, held by a finite grip.

use std::f64::consts::FRAC_PI_2;

use nalgebra::{Quaternion, UnitQuaternion};

use crate::{
    Axes, LegShape, ModelError, Release, ReleaseKind,
    hand::{or_at_once, rounded_to_ns},
    path::MIN_LEG_S,
    require,
};

use super::CLEAR;

/// How far the norm of a quaternion may lie from 1.
const MAX_NORM_ERROR: f64 = 1e-9;

/// Rotation of a quaternion (w, x, y, z) with norm 1 to 1e-9.
pub(super) fn unit(name: &'static str, quat_wxyz: [f64; 4]) -> Result<UnitQuaternion<f64>, ModelError> {
    let [w, x, y, z] = quat_wxyz;
    let quaternion = Quaternion::new(w, x, y, z);
    let norm = quaternion.norm();
    require(name, norm, (norm - 1.0).abs() <= MAX_NORM_ERROR, "a unit quaternion, of norm 1 to 1e-9")?;
    Ok(UnitQuaternion::new_normalize(quaternion))
}

/// A torsion spring and damper.
///
/// `tau = -K phi - B w`, `phi = log(R_rest^T R)`, all in the frame of the body. The log takes the shorter
/// rotation, so the torque changes its side at `|phi| = pi`.
///
/// `-K phi` is the gradient of `K |phi|² / 2`, so the spring is conservative: with `R exp(e)` the log moves
/// by `J_r^-1(phi) e`, and `phi J_r^-1(phi) = phi`.
///
/// Source: Bullo and Murray 1999, section 4 (proportional control on SO(3)); Chirikjian 2011, section 10.6 (`J_r`).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TorsionSpring {
    rest: UnitQuaternion<f64>,
    stiffness: f64,
    damping: f64,
}

impl TorsionSpring {
    /// A spring with K in N m/rad and B in N m s/rad (>= 0), without torque at `rest_wxyz`.
    pub fn new(stiffness: f64, damping: f64, rest_wxyz: [f64; 4]) -> Result<Self, ModelError> {
        require("torsion stiffness", stiffness, stiffness >= 0.0, "finite and 0 or more")?;
        require("torsion damping", damping, damping >= 0.0, "finite and 0 or more")?;
        Ok(Self { rest: unit("spring rest", rest_wxyz)?, stiffness, damping })
    }

    /// tau in N m on a body at orientation R with angular velocity w in rad/s; tau and w are in its frame.
    pub fn torque(&self, orientation: &UnitQuaternion<f64>, angular_velocity: &Axes<3>) -> Axes<3> {
        (self.rest.inverse() * orientation).scaled_axis() * -self.stiffness - angular_velocity * self.damping
    }

    /// `K |phi|² / 2` in J.
    pub fn energy_j(&self, orientation: &UnitQuaternion<f64>) -> f64 {
        0.5 * self.stiffness * (self.rest.inverse() * orientation).scaled_axis().norm_squared()
    }

    pub(super) fn gains(&self) -> [f64; 2] {
        [self.stiffness, self.damping]
    }
}

/// One leg: from where the last one ended to `end_wxyz` about a fixed axis, the shorter way, within `duration_s`.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Deserialize, schemars::JsonSchema), serde(deny_unknown_fields))]
pub struct RotationLeg {
    /// Duration in s (>= 1e-9).
    pub duration_s: f64,
    /// Orientation at its end.
    pub end_wxyz: [f64; 4],
    /// Profile of the leg.
    pub shape: LegShape,
}

/// Parameters of a hand on a handle.
#[derive(Clone, Debug, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Deserialize, schemars::JsonSchema), serde(deny_unknown_fields))]
pub struct RotationHandParameters {
    /// `K_h` in N m/rad (>= 0).
    pub stiffness: f64,
    /// `B_h` in N m s/rad (>= 0).
    pub damping: f64,
    /// Largest torque in N m that the grip transmits (>= 0); none means no bound.
    pub strength_n_m: Option<f64>,
    /// Orientation at the start of its path.
    pub start_wxyz: [f64; 4],
    /// Legs of its path; it rests before the first and after the last.
    pub legs: Vec<RotationLeg>,
    /// Release of the grip.
    pub release: Option<Release>,
}

/// A hand that steers the orientation of a handle with a limited grip.
///
/// `tau_h = -K_h log(R_target^T R) - B_h w`, its norm clipped to the grip strength; beyond it the handle
/// slips through the fingers. `R_target = R_from exp(s(t) log(R_from^T R_end))` on each leg.
///
/// Source: as [`Hand`](crate::Hand) and [`TorsionSpring`].
#[derive(Clone, Debug, PartialEq)]
pub struct RotationHand {
    stiffness: f64,
    damping: f64,
    strength_n_m: f64,
    start: UnitQuaternion<f64>,
    legs: Vec<Leg>,
    release: Option<Release>,
}

/// Torque of a hand, with its strain and turn.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Pull {
    /// Torque in N m, in the frame of the body.
    pub(super) torque: Axes<3>,
    /// Wished torque over grip strength: above 1 the grip slips.
    strain: f64,
    /// `log(R_target^T R)` in rad.
    turn: Axes<3>,
}

impl Pull {
    /// True if, since `before`, the grip has begun or ceased to slip, slips to the other side, or the spring has changed
    /// side at pi.
    pub(super) fn differs(&self, before: &Self) -> bool {
        let (slips, holds) = (self.strain > 1.0 + CLEAR, self.strain < 1.0 - CLEAR);
        let grip = if before.strain > 1.0 { holds || self.torque.dot(&before.torque) < 0.0 } else { slips };
        // Within pi/2 of the target the spring changes side through zero, without a jump.
        grip || (self.turn.dot(&before.turn) < 0.0 && self.turn.norm() > FRAC_PI_2)
    }
}

/// A leg with its beginning.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Leg {
    begin_s: f64,
    end_s: f64,
    from: UnitQuaternion<f64>,
    /// `log(R_from^T R_end)`.
    turn: Axes<3>,
    shape: LegShape,
}

impl RotationHand {
    /// A hand with `parameters`.
    pub fn new(parameters: &RotationHandParameters) -> Result<Self, ModelError> {
        let RotationHandParameters { stiffness, damping, strength_n_m, start_wxyz, legs, release } =
            parameters;
        require("hand stiffness", *stiffness, *stiffness >= 0.0, "finite and 0 or more")?;
        require("hand damping", *damping, *damping >= 0.0, "finite and 0 or more")?;
        if let Some(strength) = *strength_n_m {
            require("grip strength", strength, strength >= 0.0, "finite and 0 or more")?;
        }
        if let Some(Release { at_s, decay_s, kind }) = *release {
            require("release time", at_s, true, "finite")?;
            require("release duration", decay_s, decay_s >= 0.0, "finite and 0 or more")?;
            if kind == ReleaseKind::Strength && strength_n_m.is_none() {
                let allowed = "finite, for a release of the strength";
                return Err(ModelError { name: "grip strength", seen: f64::INFINITY, allowed });
            }
        }
        let start = unit("hand start", *start_wxyz)?;
        let (mut from, mut begin_s) = (start, 0.0);
        let mut built = Vec::with_capacity(legs.len());
        for leg in legs {
            let allowed = "finite and at least 1e-9";
            require("duration_s", leg.duration_s, leg.duration_s >= MIN_LEG_S, allowed)?;
            let end = unit("leg end", leg.end_wxyz)?;
            let turn = (from.inverse() * end).scaled_axis();
            let end_s = begin_s + leg.duration_s;
            built.push(Leg { begin_s, end_s, from, turn, shape: leg.shape });
            (from, begin_s) = (end, end_s);
        }
        Ok(Self {
            stiffness: *stiffness,
            damping: *damping,
            strength_n_m: strength_n_m.unwrap_or(f64::INFINITY),
            start,
            legs: built,
            release: release.map(|one| Release {
                at_s: rounded_to_ns(one.at_s),
                decay_s: or_at_once(one.decay_s),
                ..one
            }),
        })
    }

    /// No hand: the handle rests at `start_wxyz`.
    pub fn absent(start_wxyz: [f64; 4]) -> Result<Self, ModelError> {
        Self::new(&RotationHandParameters {
            stiffness: 0.0,
            damping: 0.0,
            strength_n_m: None,
            start_wxyz,
            legs: Vec::new(),
            release: None,
        })
    }

    /// `R_target` at time t in s.
    pub fn target_at(&self, t: f64) -> UnitQuaternion<f64> {
        let Some(leg) = self.legs.iter().rev().find(|leg| t >= leg.begin_s) else { return self.start };
        let s = ((t - leg.begin_s) / (leg.end_s - leg.begin_s)).min(1.0);
        let share = leg.shape.coefficients().iter().rev().fold(0.0, |sum, term| sum * s + term);
        leg.from * UnitQuaternion::from_scaled_axis(leg.turn * share)
    }

    /// Grip as a fraction of the full grip at time t in s.
    pub fn grip_at(&self, t: f64) -> f64 {
        match self.release {
            Some(Release { at_s, decay_s, .. }) if t >= at_s => {
                if t < rounded_to_ns(at_s + decay_s) {
                    1.0 - (t - at_s) / decay_s
                } else {
                    0.0
                }
            }
            _ => 1.0,
        }
    }

    /// Rate of the grip just after time t, in 1/s.
    fn grip_rate(&self, t: f64) -> f64 {
        match self.release {
            Some(Release { at_s, decay_s, .. }) if t >= at_s && t < rounded_to_ns(at_s + decay_s) => {
                -decay_s.recip()
            }
            _ => 0.0,
        }
    }

    /// `tau_h` in N m on a handle at orientation R with angular velocity w in rad/s; both vectors are in its
    /// frame.
    pub fn torque(&self, t: f64, orientation: &UnitQuaternion<f64>, angular_velocity: &Axes<3>) -> Axes<3> {
        self.pull(t, t, orientation, angular_velocity).torque
    }

    /// As [`torque`](Self::torque) at t, with the grip on the line that it is on from `since` to its next kink: a step
    /// that ends where the hand lets go has it to its end.
    pub(super) fn pull(
        &self,
        since: f64,
        t: f64,
        orientation: &UnitQuaternion<f64>,
        angular_velocity: &Axes<3>,
    ) -> Pull {
        let rate = self.grip_rate(since);
        let grip = if rate == 0.0 { self.grip_at(since) } else { self.grip_at(since) + rate * (t - since) };
        let (gain, strength) = match self.release.map(|release| release.kind) {
            Some(ReleaseKind::Gain) => (grip, self.strength_n_m),
            Some(ReleaseKind::Strength) => (1.0, (grip * self.strength_n_m).max(0.0)),
            None => (1.0, self.strength_n_m),
        };
        let [stiffness, damping] = self.gains().map(|of| of * gain);
        if stiffness == 0.0 && damping == 0.0 {
            return Pull { torque: Axes::zeros(), strain: 0.0, turn: Axes::zeros() };
        }
        let turn = (self.target_at(t).inverse() * orientation).scaled_axis();
        let wish = turn * -stiffness - angular_velocity * damping;
        let norm = wish.norm();
        let torque = if norm <= strength { wish } else { wish * (strength / norm) };
        Pull { torque, strain: if strength > 0.0 { norm / strength } else { f64::INFINITY }, turn }
    }

    /// True if target and grip are constant from t to the next kink.
    pub(super) fn is_still(&self, t: f64) -> bool {
        self.grip_rate(t) == 0.0 && !self.legs.iter().any(|leg| (leg.begin_s..leg.end_s).contains(&t))
    }

    pub(super) fn gains(&self) -> [f64; 2] {
        [self.stiffness, self.damping]
    }

    /// Next time after t at which path or grip is not smooth.
    pub(super) fn next_kink(&self, t: f64) -> Option<f64> {
        let of_grip = self
            .release
            .into_iter()
            .flat_map(|Release { at_s, decay_s, .. }| [at_s, rounded_to_ns(at_s + decay_s)]);
        let of_path = self.legs.iter().flat_map(|leg| [leg.begin_s, leg.end_s]);
        of_grip.chain(of_path).filter(|&kink| kink > t).min_by(f64::total_cmp)
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::FRAC_1_SQRT_2;

    use super::*;

    const UPRIGHT: [f64; 4] = [1.0, 0.0, 0.0, 0.0];
    const QUARTER: [f64; 4] = [FRAC_1_SQRT_2, 0.0, 0.0, FRAC_1_SQRT_2];

    fn holding() -> RotationHandParameters {
        RotationHandParameters {
            stiffness: 2.0,
            damping: 0.01,
            strength_n_m: Some(0.5),
            start_wxyz: UPRIGHT,
            legs: Vec::new(),
            release: None,
        }
    }

    #[test]
    fn the_target_passes_its_knots_about_a_fixed_axis() {
        let leg = |duration_s, end_wxyz| RotationLeg { duration_s, end_wxyz, shape: LegShape::Smooth };
        let legs = vec![leg(1.0, QUARTER), leg(2.0, UPRIGHT)];
        let hand = RotationHand::new(&RotationHandParameters { legs, ..holding() }).unwrap();
        for (t, quarters) in
            [(-1.0, 0.0), (0.0, 0.0), (0.5, 0.5), (1.0, 1.0), (2.0, 0.5), (3.0, 0.0), (9.0, 0.0)]
        {
            let turn = hand.target_at(t).scaled_axis();
            assert!((turn - Axes::<3>::new(0.0, 0.0, FRAC_PI_2 * quarters)).norm() < 1e-15, "{t}: {turn}");
        }
        let kinks: Vec<_> = [-1.0, 0.0, 1.0, 3.0].iter().map(|&t| hand.next_kink(t)).collect();
        assert_eq!(kinks, [Some(0.0), Some(1.0), Some(3.0), None]);
    }

    #[test]
    fn grip_clips_the_hand_torque() {
        let fades = Release { at_s: 1.0, decay_s: 0.5, kind: ReleaseKind::Strength };
        let hand = RotationHand::new(&RotationHandParameters { release: Some(fades), ..holding() }).unwrap();
        let torque = |t: f64, angle: f64| {
            let turned = UnitQuaternion::from_scaled_axis(Axes::<3>::new(angle, 0.0, 0.0));
            hand.torque(t, &turned, &Axes::<3>::new(2.0, 0.0, 0.0))[0]
        };
        for (t, angle, expected) in [
            (0.0, 0.1, -0.22),
            (0.0, 1.0, -0.5),
            (0.0, -1.0, 0.5),
            (1.25, 1.0, -0.25),
            (1.25, 0.1, -0.22),
            (1.5, 1.0, 0.0),
            (2.0, 0.1, 0.0),
        ] {
            assert!((torque(t, angle) - expected).abs() < 1e-14, "{t} {angle}: {}", torque(t, angle));
        }
        let gain = Release { kind: ReleaseKind::Gain, ..fades };
        let hand = RotationHand::new(&RotationHandParameters { release: Some(gain), ..holding() }).unwrap();
        let turned = UnitQuaternion::from_scaled_axis(Axes::<3>::new(0.1, 0.0, 0.0));
        assert!((hand.torque(1.25, &turned, &Axes::zeros())[0] + 0.1).abs() < 1e-15);
        assert_eq!([0.0, 1.0, 1.2, 1.5].map(|t| hand.next_kink(t)), [Some(1.0), Some(1.5), Some(1.5), None]);
    }

    /// `-K phi` against differences of `K |phi|² / 2` along each body axis.
    #[test]
    fn the_spring_is_the_gradient_of_its_energy() {
        let spring = TorsionSpring::new(3.0, 0.0, QUARTER).unwrap();
        for turn in [[0.3, -0.2, 0.1], [2.0, 1.0, -0.5], [0.0, 0.0, 0.0], [-1.0, 2.0, 1.5]] {
            let orientation = spring.rest * UnitQuaternion::from_scaled_axis(Axes::<3>::from(turn));
            let torque = spring.torque(&orientation, &Axes::zeros());
            for axis in 0..3 {
                let step = Axes::<3>::from_fn(|at, _| if at == axis { 1e-5 } else { 0.0 });
                let energy =
                    |by: Axes<3>| spring.energy_j(&(orientation * UnitQuaternion::from_scaled_axis(by)));
                let slope = (energy(step) - energy(-step)) / 2e-5;
                // Central differences err by h² times a third derivative of about K / (pi - |phi|)².
                assert!((torque[axis] + slope).abs() < 1e-8, "{turn:?} {axis}: {} {slope}", torque[axis]);
            }
        }
    }

    #[test]
    fn rejects_invalid_hand() {
        let fades = Some(Release { at_s: 1.0, decay_s: 0.1, kind: ReleaseKind::Strength });
        let leg = RotationLeg { duration_s: 1.0, end_wxyz: UPRIGHT, shape: LegShape::Linear };
        for bad in [
            RotationHandParameters { stiffness: -1.0, ..holding() },
            RotationHandParameters { damping: f64::NAN, ..holding() },
            RotationHandParameters { strength_n_m: Some(-1.0), ..holding() },
            RotationHandParameters { strength_n_m: None, release: fades, ..holding() },
            RotationHandParameters { start_wxyz: [1.0 + 2e-9, 0.0, 0.0, 0.0], ..holding() },
            RotationHandParameters { start_wxyz: [f64::NAN, 0.0, 0.0, 0.0], ..holding() },
            RotationHandParameters { legs: vec![RotationLeg { duration_s: 0.0, ..leg }], ..holding() },
            RotationHandParameters { legs: vec![RotationLeg { end_wxyz: [0.0; 4], ..leg }], ..holding() },
        ] {
            assert!(RotationHand::new(&bad).is_err(), "{bad:?}");
        }
        assert!(
            RotationHand::new(&RotationHandParameters { release: fades, legs: vec![leg], ..holding() })
                .is_ok()
        );
        assert!(TorsionSpring::new(-1.0, 0.0, UPRIGHT).is_err());
        assert!(TorsionSpring::new(1.0, 0.0, [0.0, 1.0, 1.0, 0.0]).is_err());
    }
}
