//! Random orientations, directions and vectors for the property tests of rotations.

use nalgebra::{Quaternion, Unit, UnitQuaternion, Vector3};
use proptest::prelude::*;

/// Any orientation, with either sign of its quaternion.
pub(crate) fn orientation() -> impl Strategy<Value = UnitQuaternion<f64>> {
    prop::array::uniform4(-1.0..1.0f64)
        .prop_map(|[w, x, y, z]| Quaternion::new(w, x, y, z))
        .prop_filter("no direction", |quaternion| quaternion.norm() > 0.1)
        .prop_map(Unit::new_normalize)
}

pub(super) fn direction() -> impl Strategy<Value = Unit<Vector3<f64>>> {
    vector(1.0).prop_filter("no direction", |vector| vector.norm() > 0.1).prop_map(Unit::new_normalize)
}

/// Any vector with components of at most `largest`.
pub(super) fn vector(largest: f64) -> impl Strategy<Value = Vector3<f64>> {
    prop::array::uniform3(-largest..largest).prop_map(Vector3::from)
}
