//! Measurements of a device at one tick.

use nalgebra::UnitQuaternion;

use crate::Axes;

/// Orientation and, if the device measures it, angular velocity in rad/s, both in the base frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Turned {
    /// R, `base_from_body`.
    pub orientation: UnitQuaternion<f64>,
    /// w in rad/s.
    pub angular_velocity: Option<Axes<3>>,
}

/// Measurements of a device at one tick.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sample<const N: usize> {
    /// x in m (rad).
    pub position: Axes<N>,
    /// V in m/s (rad/s), if the device measures it; given at every sample or at none.
    pub velocity: Option<Axes<N>>,
    /// Rotation of a device that turns.
    pub rotation: Option<Turned>,
}

/// Borrowed parts of a [`Sample`], so that the check of every tick copies nothing.
#[derive(Clone, Copy)]
pub(crate) struct Parts<'a, const N: usize> {
    pub(crate) position: &'a Axes<N>,
    pub(crate) velocity: Option<&'a Axes<N>>,
    pub(crate) rotation: Option<&'a Turned>,
}

impl<const N: usize> Parts<'_, N> {
    pub(super) fn sample(&self) -> Sample<N> {
        let Self { position, velocity, rotation } = *self;
        Sample { position: *position, velocity: velocity.copied(), rotation: rotation.copied() }
    }
}

impl<const N: usize> Sample<N> {
    /// Borrow the parts.
    #[inline(always)]
    pub(crate) fn parts(&self) -> Parts<'_, N> {
        let Self { position, velocity, rotation } = self;
        Parts { position, velocity: velocity.as_ref(), rotation: rotation.as_ref() }
    }

    /// Create the sample of a point.
    #[inline]
    pub fn point(position: &Axes<N>, velocity: Option<&Axes<N>>) -> Self {
        Self { position: *position, velocity: velocity.copied(), rotation: None }
    }

    /// Return this sample after a shift of the device's origin: add the position of `by`, and apply its rotation in the
    /// base frame. Velocities stay.
    pub(super) fn shifted(&self, by: &Self) -> Self {
        let turned = self
            .rotation
            .zip(by.rotation)
            .map(|(turned, by)| Turned { orientation: by.orientation * turned.orientation, ..turned });
        Self { position: self.position + by.position, rotation: turned.or(self.rotation), ..*self }
    }

    /// Interpolate from this sample to a later one: along a straight line, and at constant rate about one axis.
    #[must_use]
    pub fn towards(&self, later: &Self, share: f64) -> Self {
        let turned = |from: &UnitQuaternion<f64>, to: &UnitQuaternion<f64>| {
            let turn = UnitQuaternion::from_scaled_axis((to * from.inverse()).scaled_axis() * share);
            UnitQuaternion::new_normalize((turn * from).into_inner())
        };
        Self {
            position: self.position + (later.position - self.position) * share,
            velocity: between(self.velocity, later.velocity, share),
            rotation: self.rotation.zip(later.rotation).map(|(from, to)| Turned {
                orientation: turned(&from.orientation, &to.orientation),
                angular_velocity: between(from.angular_velocity, to.angular_velocity, share),
            }),
        }
    }
}

fn between<const N: usize>(from: Option<Axes<N>>, to: Option<Axes<N>>, share: f64) -> Option<Axes<N>> {
    from.zip(to).map(|(from, to)| from + (to - from) * share)
}
