//! Differences and steps of positions, for translations and for rotations.

use haptether_safety::Axes;
use nalgebra::{UnitQuaternion, Vector3};

/// Geometry of the vectors of a half.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Space {
    /// Vectors in m.
    Translation,
    /// Rotation vectors in rad in the base frame; only of three axes.
    Rotation,
}

fn exp<const N: usize>(vector: &Axes<N>) -> UnitQuaternion<f64> {
    UnitQuaternion::from_scaled_axis(Vector3::from_iterator(vector.iter().copied()))
}

fn log<const N: usize>(turned: &UnitQuaternion<f64>) -> Axes<N> {
    Axes::from_iterator(turned.scaled_axis().iter().copied())
}

impl Space {
    /// Return the vector from a point to another after the point has moved: `difference - moved`, or
    /// `log(exp(difference) exp(moved)^-1)`.
    pub(super) fn left<const N: usize>(self, difference: &Axes<N>, moved: &Axes<N>) -> Axes<N> {
        match self {
            Self::Translation => difference - moved,
            Self::Rotation => log(&(exp(difference) * exp(moved).inverse())),
        }
    }

    /// Return the vector from a point to another after the other has moved: `difference + moved`, or
    /// `log(exp(moved) exp(difference))`.
    pub(super) fn advanced<const N: usize>(self, difference: &Axes<N>, moved: &Axes<N>) -> Axes<N> {
        match self {
            Self::Translation => difference + moved,
            Self::Rotation => log(&(exp(moved) * exp(difference))),
        }
    }

    /// Distance in m (rad) that counts as small.
    pub(super) const fn small(self) -> f64 {
        match self {
            Self::Translation => 3e-4,
            Self::Rotation => 3e-3,
        }
    }
}
