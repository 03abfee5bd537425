//! Shapes: signed distance and outward normal.

use crate::{Axes, ModelError, axes::require_axes, require};

/// The shape of an object, where it is before it moves.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Shape<const N: usize> {
    kind: Kind<N>,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Kind<const N: usize> {
    Plane { point: Axes<N>, normal: Axes<N> },
    Sphere { centre: Axes<N>, radius: f64 },
    Cuboid { centre: Axes<N>, half_extents: Axes<N>, ball: f64 },
    Spring { anchor: Axes<N> },
}

impl<const N: usize> Shape<N> {
    /// Fills the side of a plane that `normal` points away from; `point` in m lies on it, `normal` need not have unit
    /// length.
    pub fn plane(point: Axes<N>, normal: Axes<N>) -> Result<Self, ModelError> {
        require_axes("plane point", &point, |_| true, "finite")?;
        require_axes("plane normal", &normal, |_| true, "finite")?;
        // Scaled first, so that neither a huge nor a tiny normal leaves the range of a number when squared.
        let largest = normal.amax();
        require("plane normal", largest, largest > 0.0, "no zero vector")?;
        let normal = (normal / largest).normalize();
        Ok(Self { kind: Kind::Plane { point, normal } })
    }

    /// A ball, in m.
    pub fn sphere(centre: Axes<N>, radius: f64) -> Result<Self, ModelError> {
        require_axes("sphere centre", &centre, |_| true, "finite")?;
        require("sphere radius", radius, radius > 0.0, "finite and above 0")?;
        Ok(Self { kind: Kind::Sphere { centre, radius } })
    }

    /// A box along the axes, in m.
    pub fn cuboid(centre: Axes<N>, half_extents: Axes<N>) -> Result<Self, ModelError> {
        require_axes("box centre", &centre, |_| true, "finite")?;
        require_axes("box half extents", &half_extents, |half| half > 0.0, "finite and above 0")?;
        Ok(Self { kind: Kind::Cuboid { centre, half_extents, ball: half_extents.norm() } })
    }

    /// No surface: a spring from `anchor` in m that pushes and pulls everywhere.
    pub fn spring(anchor: Axes<N>) -> Result<Self, ModelError> {
        require_axes("spring anchor", &anchor, |_| true, "finite")?;
        Ok(Self { kind: Kind::Spring { anchor } })
    }

    /// Signed distance in m from the surface (negative inside) and unit outward normal, its gradient.
    ///
    /// A spring has no surface and is minus infinity deep everywhere. Where the gradient does not exist (the centre
    /// of a ball, equally near faces of a box) the first axis that is as good as any other is taken.
    pub fn surface(&self, point: &Axes<N>) -> (f64, Axes<N>) {
        match &self.kind {
            Kind::Plane { point: on, normal } => ((point - on).dot(normal), *normal),
            Kind::Sphere { centre, radius } => {
                let from_centre = point - centre;
                let norm = from_centre.norm();
                let normal = if norm > 0.0 { from_centre / norm } else { unit(0, 1.0) };
                (norm - radius, normal)
            }
            Kind::Cuboid { centre, half_extents, .. } => cuboid(&(point - centre), half_extents),
            Kind::Spring { .. } => (f64::NEG_INFINITY, Axes::zeros()),
        }
    }

    /// The point that moves with the object: on the plane, or the centre, or the anchor, in m.
    pub fn reference(&self) -> &Axes<N> {
        match &self.kind {
            Kind::Plane { point, .. } => point,
            Kind::Sphere { centre, .. } | Kind::Cuboid { centre, .. } => centre,
            Kind::Spring { anchor } => anchor,
        }
    }

    /// A lower bound in m on the distance, cheaper than the distance.
    pub(crate) fn clearance(&self, point: &Axes<N>) -> f64 {
        match &self.kind {
            Kind::Cuboid { centre, ball, .. } => (point - centre).norm() - ball,
            _ => self.surface(point).0,
        }
    }

    pub(crate) fn is_spring(&self) -> bool {
        matches!(self.kind, Kind::Spring { .. })
    }

    /// Axis, coordinate of the surface in m and sign of the normal, if this is a plane across one axis.
    pub(crate) fn across_axis(&self) -> Option<(usize, f64, f64)> {
        let Kind::Plane { point, normal } = &self.kind else { return None };
        let axis = normal.iamax();
        (normal[axis].abs() == 1.0).then(|| (axis, point[axis], normal[axis]))
    }
}

fn unit<const N: usize>(axis: usize, sign: f64) -> Axes<N> {
    let mut normal = Axes::zeros();
    normal[axis] = sign;
    normal
}

/// Distance and normal of a box around the origin: exact outside, nearest face inside.
///
/// Source: I. Quilez, "Distance functions", sdBox.
fn cuboid<const N: usize>(point: &Axes<N>, half_extents: &Axes<N>) -> (f64, Axes<N>) {
    let beyond = point.abs() - half_extents;
    let outside = beyond.map(|q| q.max(0.0));
    let distance = outside.norm();
    if distance > 0.0 {
        return (distance, outside.zip_map(point, |q, x| q.copysign(x) / distance));
    }
    let mut nearest = 0;
    for axis in 1..N {
        if beyond[axis] > beyond[nearest] {
            nearest = axis;
        }
    }
    (beyond[nearest], unit(nearest, 1_f64.copysign(point[nearest])))
}
