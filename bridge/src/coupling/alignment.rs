//! Alignment: the slave rotates to the master's orientation before they engage.

use nalgebra::{Quaternion, Unit, UnitQuaternion, Vector3};
use schemars::JsonSchema;
use serde::Deserialize;
use std::f64::consts::PI;

use super::{CouplingError, RotationBounds, RotationLock, frame_map::normalised, mapping::check};

/// `[coupling.alignment]`: the slave's turn to the master before the two engage.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct AlignmentSettings {
    /// Largest angular speed in rad/s.
    pub speed: f64,
    /// Angle in rad between the two, in (0, pi], beyond which the alignment refuses.
    pub max_angle: f64,
}

/// Time in s that a press needs in addition to the turn: it travels to the slave, and the
/// engagement travels back. This covers 500 ms each way, the slowest link for which the timeout of
/// ALIGNING is made.
pub const ROUND_TRIP_S: f64 = 1.0;

/// Angle in rad within which the slave counts as aligned after [`SETTLED_S`], for a hand that trembles faster
/// than the slave may turn. A slower hand is reached exactly. Nobody feels half a degree.
pub const ALIGNED_RAD: f64 = 0.01;

/// Time in s for which the slave must stay within [`ALIGNED_RAD`].
pub const SETTLED_S: f64 = 0.2;

/// Alignment that does not fit its coupling.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum AlignmentError {
    /// With another scale the two would not stay aligned.
    #[error(
        "rotation_scale = {0}: must be 1 with an alignment: at another scale the \
         sides would not stay aligned; leave out one of the keys"
    )]
    Scale(f64),
    /// A locked rotation cannot reach the master's orientation.
    #[error(
        "locks_rotation and rotation_axis: must be left out with an alignment, which turns about any axis"
    )]
    Lock,
    /// Speed above the bound on any command of a master.
    #[error("alignment.speed = {seen} rad/s: must be at most command_angular_speed = {allowed} rad/s")]
    Fast {
        /// Given speed in rad/s.
        seen: f64,
        /// Bound in rad/s.
        allowed: f64,
    },
    /// The turn may last longer than the press.
    #[error(
        "alignment.max_angle / alignment.speed = {seen_s} s: must be at most {allowed_s} s: \
         a press waits {align_s} s, and a round trip takes 1 s of it; raise the \
         speed or lower the angle"
    )]
    Long {
        /// Longest turn in s.
        seen_s: f64,
        /// Time in s available for it.
        allowed_s: f64,
        /// Timeout of a press in s.
        align_s: f64,
    },
}

impl AlignmentSettings {
    /// Return an error if the alignment conflicts with the rest of the coupling, or may last longer than a
    /// press, `align_s`.
    pub fn check(
        &self,
        rotation_scale: f64,
        lock: &RotationLock,
        bounds: &RotationBounds,
        align_s: f64,
    ) -> Result<(), CouplingError> {
        let Self { speed, max_angle } = *self;
        Alignment::new([1.0, 0.0, 0.0, 0.0], speed, max_angle)?;
        Self::check_scale(rotation_scale)?;
        let (seen_s, allowed_s) = (max_angle / speed, align_s - ROUND_TRIP_S);
        let wrong = if *lock != RotationLock::Free {
            AlignmentError::Lock
        } else if speed > bounds.speed {
            AlignmentError::Fast { seen: speed, allowed: bounds.speed }
        } else if seen_s > allowed_s {
            AlignmentError::Long { seen_s, allowed_s, align_s }
        } else {
            return Ok(());
        };
        Err(wrong.into())
    }

    /// Return an error for a `lambda_r` with which the two would not stay aligned.
    pub(crate) fn check_scale(rotation_scale: f64) -> Result<(), CouplingError> {
        if rotation_scale == 1.0 { Ok(()) } else { Err(AlignmentError::Scale(rotation_scale).into()) }
    }
}

/// Turn of the slave's orientation to the master's at a bounded rate, or refusal beyond an angle.
///
/// `R_s -> C R_m C'`, an absolute orientation, about the axis of `phi = log(C R_m C' R_s')`, by at most
/// `w_max dt` each tick. A coupling of `lambda_r = 1` that engages there keeps `R_s = C R_m C'` from then on.
///
/// At an angle of exactly pi both directions about the axis are equally short; the same pair of orientations
/// always gives the same one. After the first tick the angle is smaller, and the turn continues about the
/// same axis.
///
/// Source: the dVRK aligns before it follows (`mtsTeleOperationPSM`, state `ALIGNING_MTM`), by turning its
/// motorised master to the slave. Here the slave turns, because most masters cannot.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Alignment {
    frame: UnitQuaternion<f64>,
    max_speed: f64,
    max_angle: f64,
}

/// Command of one tick of an alignment.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AlignmentStep {
    /// Commanded orientation.
    pub orientation: UnitQuaternion<f64>,
    /// Its angular velocity in rad/s, in the base frame.
    pub angular_velocity: Vector3<f64>,
    /// Angle in rad that remains after this step; 0 if aligned.
    pub remaining_rad: f64,
}

impl Alignment {
    /// Build an alignment: C as a unit quaternion, largest speed in rad/s (> 0), largest angle in rad, in
    /// `(0, pi]`.
    pub fn new(quat_wxyz: [f64; 4], max_speed: f64, max_angle: f64) -> Result<Self, CouplingError> {
        if !(max_angle > 0.0 && max_angle <= PI) {
            return Err(CouplingError::Angle { name: "alignment_angle", seen: max_angle });
        }
        let [w, x, y, z] = normalised(quat_wxyz)?;
        Ok(Self {
            frame: Unit::new_unchecked(Quaternion::new(w, x, y, z)),
            max_speed: check("alignment_speed", "w_max", max_speed)?,
            max_angle,
        })
    }

    /// Largest speed in rad/s.
    pub(crate) fn max_speed(&self) -> f64 {
        self.max_speed
    }

    /// Set C, the rotation from the master's frame to the slave's, as a unit quaternion.
    pub fn set_frame(&mut self, quat_wxyz: [f64; 4]) -> Result<(), CouplingError> {
        let [w, x, y, z] = normalised(quat_wxyz)?;
        self.frame = Unit::new_unchecked(Quaternion::new(w, x, y, z));
        Ok(())
    }

    /// `C R_m C'`: the final orientation.
    pub fn target(&self, master: &UnitQuaternion<f64>) -> UnitQuaternion<f64> {
        Unit::new_normalize((self.frame * master * self.frame.inverse()).into_inner())
    }

    /// Return the next command, `dt_s` after `command`. An angle beyond the largest one, or a NaN in an
    /// orientation, is an error, and the slave stays.
    ///
    /// `command` is the last commanded orientation, at first the measured one.
    pub fn step(
        &self,
        master: &UnitQuaternion<f64>,
        command: &UnitQuaternion<f64>,
        dt_s: f64,
    ) -> Result<AlignmentStep, CouplingError> {
        let target = self.target(master);
        let way = target * command.inverse();
        let angle = way.angle();
        if angle.is_nan() || angle > self.max_angle {
            return Err(CouplingError::Misaligned { seen_rad: angle, allowed_rad: self.max_angle });
        }
        let phi = way.scaled_axis();
        let max_step = self.max_speed * dt_s.max(0.0);
        if angle <= max_step {
            let angular_velocity = if max_step > 0.0 { phi / dt_s } else { Vector3::zeros() };
            return Ok(AlignmentStep { orientation: target, angular_velocity, remaining_rad: 0.0 });
        }
        let axis = phi / angle;
        let stepped = UnitQuaternion::from_scaled_axis(axis * max_step) * command;
        Ok(AlignmentStep {
            orientation: Unit::new_normalize(stepped.into_inner()),
            angular_velocity: if max_step > 0.0 { axis * self.max_speed } else { Vector3::zeros() },
            remaining_rad: angle - max_step,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::coupling::{
        RotationCoupling,
        drawn::{direction, orientation, vector},
    };
    use proptest::prelude::*;

    const SPEED: f64 = 0.5;
    const TICK_S: f64 = 1e-3;

    fn unturned(max_angle: f64) -> Alignment {
        Alignment::new([1.0, 0.0, 0.0, 0.0], SPEED, max_angle).unwrap()
    }

    fn about(axis: Vector3<f64>, angle: f64) -> UnitQuaternion<f64> {
        UnitQuaternion::from_scaled_axis(axis * angle)
    }

    /// Closed form: `|phi|` falls by `w_max dt` each tick, so the turn takes `ceil(|phi| / (w_max dt))`
    /// ticks.
    #[test]
    fn it_arrives_after_the_angle_over_the_rate() {
        let axis = Vector3::new(0.6, 0.0, -0.8);
        for (angle, ticks) in [(0.0, 1), (4e-4, 1), (0.0101, 21), (1.0, 2000), (3.1, 6200)] {
            let master = about(axis, 0.3 + angle);
            let mut command = about(axis, 0.3);
            let mut taken = 0_i32;
            loop {
                let step = unturned(PI).step(&master, &command, TICK_S).unwrap();
                taken += 1;
                let turned = step.orientation * command.inverse();
                let expected = UnitQuaternion::from_scaled_axis(step.angular_velocity * TICK_S);
                assert!(turned.angle_to(&expected) < 1e-15);
                assert!(step.angular_velocity.norm() < SPEED * (1.0 + 1e-9));
                command = step.orientation;
                if step.remaining_rad == 0.0 {
                    break;
                }
                // Each tick rounds by an ulp or two of the angle.
                let left = angle - SPEED * TICK_S * f64::from(taken);
                assert!((step.remaining_rad - left).abs() < 1e-15 * f64::from(taken) * 4.0);
            }
            assert!((taken - ticks).abs() <= 1, "{taken} ticks for {angle} rad, must be {ticks}");
            assert!(command.angle_to(&master) < 1e-15);
        }
    }

    proptest! {
        /// Frame invariance, and its consequence in the coupling: an aligned pair stays aligned.
        #[test]
        fn coupling_continues_from_the_aligned_orientation(
            (frame, master, slave) in (orientation(), orientation(), orientation()),
            hand in vector(1.0),
        ) {
            let [x, y, z, w] = frame.coords.into();
            let alignment = Alignment::new([w, x, y, z], 50.0, PI).unwrap();
            let mut command = slave;
            for _ in 0..64 {
                command = alignment.step(&master, &command, TICK_S).unwrap().orientation;
            }
            prop_assert!(command.angle_to(&(frame * master * frame.inverse())) < 1e-14);
            let mut coupling = RotationCoupling::new(1.0, 1.0).unwrap();
            coupling.set_frame([w, x, y, z], 0).unwrap();
            coupling.commanded_orientation(&master, &command);
            let turned = UnitQuaternion::from_scaled_axis(hand) * master;
            let seen = coupling.commanded_orientation(&turned, &command);
            prop_assert!(seen.angle_to(&(frame * turned * frame.inverse())) < 1e-14);
        }

        /// A moving hand that is slower than the slave: the slave reaches it and then follows in each tick.
        #[test]
        fn moving_hand_is_reached((start, axis) in (orientation(), direction())) {
            let (alignment, mut command) = (unturned(PI), start);
            let hand = |tick: i32| {
                about(axis.into_inner(), 0.2 * TICK_S * f64::from(tick)) * about(Vector3::x(), 0.3) * start
            };
            for tick in 0..1100 {
                let step = alignment.step(&hand(tick), &command, TICK_S).unwrap();
                let before = command;
                command = step.orientation;
                prop_assert!(command.angle_to(&before) < SPEED * TICK_S * (1.0 + 1e-9));
                // In the worst case the hand moves straight away: 0.3 rad at 0.5 - 0.2 rad/s take 1 s.
                prop_assert!(tick < 1001 || step.remaining_rad == 0.0);
            }
        }
    }

    #[test]
    fn too_large_angles_and_nan_are_refused() {
        let (master, slave) = (UnitQuaternion::identity(), about(Vector3::y(), 0.6));
        unturned(0.61).step(&master, &slave, TICK_S).unwrap();
        let error = unturned(0.59).step(&master, &slave, TICK_S).unwrap_err().to_string();
        assert!(error.contains("0.6 rad") && error.contains("up to 0.59 rad"), "{error}");
        let none = Unit::new_unchecked(Quaternion::new(f64::NAN, 0.0, 0.0, 1.0));
        for (master, slave) in [(&none, &slave), (&master, &none)] {
            let error = unturned(PI).step(master, slave, TICK_S).unwrap_err();
            assert!(matches!(error, CouplingError::Misaligned { seen_rad, .. } if seen_rad.is_nan()));
        }
        for dt_s in [0.0, -1.0, f64::NAN] {
            let step = unturned(PI).step(&master, &slave, dt_s).unwrap();
            assert_eq!(step.angular_velocity, Vector3::zeros());
            assert!(step.orientation.angle_to(&slave) < 1e-15 && (step.remaining_rad - 0.6).abs() < 1e-15);
        }
    }

    /// At an angle of pi both directions are equally short: the slave takes one and keeps it.
    #[test]
    fn opposite_orientation_turns_one_way() {
        let (master, mut command) = (about(Vector3::z(), PI), UnitQuaternion::identity());
        let mut axis = None;
        for tick in 1..=100 {
            let step = unturned(PI).step(&master, &command, TICK_S).unwrap();
            let about = *axis.get_or_insert(step.angular_velocity);
            assert!((step.angular_velocity - about).norm() < 1e-12);
            assert!((step.remaining_rad - (PI - 5e-4 * f64::from(tick))).abs() < 1e-13);
            command = step.orientation;
        }
    }

    #[test]
    fn invalid_bounds_are_refused() {
        for (speed, angle, text) in [
            (0.0, 1.0, "alignment_speed (w_max) = 0"),
            (f64::NAN, 1.0, "alignment_speed (w_max) = NaN"),
            (1.0, 0.0, "alignment_angle = 0 rad: must be above 0 and at most pi"),
            (1.0, 3.2, "alignment_angle = 3.2 rad"),
            (1.0, f64::NAN, "alignment_angle = NaN rad"),
        ] {
            let error = Alignment::new([1.0, 0.0, 0.0, 0.0], speed, angle).unwrap_err().to_string();
            assert!(error.starts_with(text), "{error}");
        }
        let error = Alignment::new([1.0, 0.1, 0.0, 0.0], 1.0, 1.0).unwrap_err();
        assert!(matches!(error, CouplingError::Quaternion(_)));
    }
}
