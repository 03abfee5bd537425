//! Orientations as measured and sent: unit quaternions, w first, with one encoding each.

use haptether_safety::Axes;
use nalgebra::{Quaternion, Unit, UnitQuaternion};

use super::CouplingError;

/// Rotation of a side at one tick, as measured and as sent: in its base frame, about the tool point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RotationState {
    /// R, `base_from_tool`.
    pub orientation: UnitQuaternion<f64>,
    /// w in rad/s.
    pub angular_velocity: Axes<3>,
    /// Torque in N m: at the master of the device, at the slave of the environment on the tool.
    pub torque: Axes<3>,
}

impl Default for RotationState {
    fn default() -> Self {
        let [angular_velocity, torque] = [Axes::zeros(); 2];
        Self { orientation: UnitQuaternion::identity(), angular_velocity, torque }
    }
}

/// Tolerance of the norm of a measured or received quaternion.
pub const MAX_NORM_ERROR: f64 = 1e-9;

/// Tolerance of the norm of a rounded quaternion, such as one of 32-bit floats.
const ROUNDED: f64 = 1e-6;

/// Orientation reported by a sensor. A rounded quaternion is normalised; any other non-unit quaternion is
/// kept, and the check of the sample raises a fault.
pub fn measured([w, x, y, z]: [f64; 4]) -> UnitQuaternion<f64> {
    let quaternion = Quaternion::new(w, x, y, z);
    if (quaternion.norm() - 1.0).abs() <= ROUNDED {
        Unit::new_normalize(quaternion)
    } else {
        Unit::new_unchecked(quaternion)
    }
}

/// Components of an orientation, w first.
pub fn quat_wxyz(orientation: &UnitQuaternion<f64>) -> [f64; 4] {
    let [x, y, z, w] = orientation.coords.into();
    [w, x, y, z]
}

/// Canonical `quat_wxyz` of an orientation, the encoding that is sent.
///
/// q and -q are the same orientation. The canonical one has a positive first non-zero component in the order
/// w, x, y, z. Every zero is +0.
pub fn canonical(orientation: &UnitQuaternion<f64>) -> [f64; 4] {
    let quat_wxyz = quat_wxyz(orientation);
    let first = quat_wxyz.into_iter().find(|part| *part != 0.0).unwrap_or(1.0);
    // Adding +0 turns -0 into +0, and changes nothing else.
    quat_wxyz.map(|part| if first < 0.0 { 0.0 - part } else { part + 0.0 })
}

/// Return whether a quaternion is in the encoding of [`canonical`], bit for bit.
pub fn is_canonical(quat_wxyz: [f64; 4]) -> bool {
    let first = quat_wxyz.into_iter().find(|part| *part != 0.0).unwrap_or(-1.0);
    first > 0.0 && !quat_wxyz.into_iter().any(|part| part == 0.0 && part.is_sign_negative())
}

/// Orientation of `quat_wxyz`, with either sign. An error unless all components are finite and the norm is 1
/// to within [`MAX_NORM_ERROR`].
///
/// The components are kept bit for bit, so that a received orientation encodes to the same bytes.
pub fn checked(quat_wxyz: [f64; 4]) -> Result<UnitQuaternion<f64>, CouplingError> {
    let norm = quat_wxyz.iter().map(|part| part * part).sum::<f64>().sqrt();
    if norm.is_nan() || (norm - 1.0).abs() > MAX_NORM_ERROR {
        return Err(CouplingError::Orientation { seen: quat_wxyz, norm });
    }
    let [w, x, y, z] = quat_wxyz;
    Ok(Unit::new_unchecked(Quaternion::new(w, x, y, z)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::coupling::drawn::orientation;
    use nalgebra::Vector3;
    use proptest::prelude::*;
    use std::f64::consts::PI;

    #[test]
    fn one_orientation_has_one_encoding() {
        let half = std::f64::consts::FRAC_1_SQRT_2;
        for (seen, expected) in [
            ([1.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]),
            ([-1.0, 0.0, -0.0, 0.0], [1.0, 0.0, 0.0, 0.0]),
            ([half, -half, 0.0, 0.0], [half, -half, 0.0, 0.0]),
            ([-half, half, 0.0, -0.0], [half, -half, 0.0, 0.0]),
            ([0.0, -0.6, 0.8, 0.0], [0.0, 0.6, -0.8, 0.0]),
            ([-0.0, 0.0, -0.6, 0.8], [0.0, 0.0, 0.6, -0.8]),
            ([-0.0, -0.0, -0.0, -1.0], [0.0, 0.0, 0.0, 1.0]),
        ] {
            let encoded = canonical(&checked(seen).unwrap());
            assert_eq!(encoded.map(f64::to_bits), expected.map(f64::to_bits), "of {seen:?}");
            assert!(is_canonical(encoded));
            let same = seen.map(f64::to_bits) == expected.map(f64::to_bits);
            assert_eq!(is_canonical(seen), same, "{seen:?}");
        }
        assert!(!is_canonical([0.0; 4]));
    }

    proptest! {
        #[test]
        fn both_signs_encode_to_the_same_bits(of in orientation()) {
            let negative = Unit::new_unchecked(-of.into_inner());
            let bits = canonical(&of).map(f64::to_bits);
            prop_assert_eq!(bits, canonical(&negative).map(f64::to_bits));
            let decoded = checked(canonical(&of)).unwrap();
            prop_assert_eq!(bits, canonical(&decoded).map(f64::to_bits));
            prop_assert!(is_canonical(canonical(&of)) && decoded.rotation_to(&of).angle() < 1e-15);
        }
    }

    #[test]
    fn invalid_orientations_are_refused() {
        for (seen, text) in [
            ([1.0 + 1.1e-9, 0.0, 0.0, 0.0], "must be 1 to within 1e-9"),
            ([0.6, 0.8, 0.0, 1e-4], "[0.6, 0.8, 0.0, 0.0001] has a norm of 1.00000000"),
            ([0.0; 4], "norm of 0"),
            ([f64::NAN, 0.0, 0.0, 1.0], "norm of NaN"),
            ([1.0, f64::INFINITY, 0.0, 0.0], "norm of inf"),
            ([1e200, 0.0, 0.0, 0.0], "norm of inf"),
        ] {
            let error = checked(seen).unwrap_err();
            assert!(error.to_string().contains(text), "{error}");
        }
        checked([1.0 - 0.9e-9, 0.0, 0.0, 0.0]).unwrap();
        checked([-0.6, 0.0, 0.8, 0.0]).unwrap();
    }

    /// The coupling relies on this: exp and log of the library are inverse up to rounding, also at 0 and pi.
    #[test]
    fn exp_and_log_are_precise_at_zero_and_at_pi() {
        let axis = Vector3::new(0.36, -0.48, 0.8);
        for angle in [0.0, 1e-300, 1e-17, 1e-12, 1e-8, 1e-4, 1.0, 3.0, PI - 1e-8, PI - 1e-12] {
            let vector = axis * angle;
            let back = UnitQuaternion::from_scaled_axis(vector).scaled_axis();
            // Half an angle is exact; sine, cosine and arc tangent round by an ulp or two of pi.
            assert!((back - vector).norm() < 4.0 * f64::EPSILON, "{angle}: {:e}", (back - vector).norm());
        }
    }
}
