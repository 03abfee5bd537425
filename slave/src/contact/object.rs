//! An object that the tool may touch: its shape and its motion, prescribed or by pushing.

use haptether_numeric::Real as _;

use crate::{Axes, Contact, ContactLaw, ModelError, amax, contact::window::Window, require, require_axes};

/// Mobility of an object.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Mobility<const N: usize> {
    Fixed,
    Moving(ObjectMotion<N>),
    Free(FreeBody<N>),
}

/// A shape that resists. It may have a prescribed motion or be pushed.
///
/// A spring exerts `F = K (anchor - x) - B V` everywhere, with K and B of its contact.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Object<const N: usize> {
    shape: Shape<N>,
    contact: Contact,
    mobility: Mobility<N>,
}

impl<const N: usize> Object<N> {
    /// An immobile object.
    pub fn fixed(shape: Shape<N>, contact: Contact) -> Result<Self, ModelError> {
        Self::checked(shape, contact, Mobility::Fixed)
    }

    /// An object with a prescribed motion; contact does not change it.
    pub fn moving(shape: Shape<N>, contact: Contact, motion: ObjectMotion<N>) -> Result<Self, ModelError> {
        Self::checked(shape, contact, Mobility::Moving(motion))
    }

    /// An object that the tool pushes and that pushes back.
    pub fn free(shape: Shape<N>, contact: Contact, body: FreeBody<N>) -> Result<Self, ModelError> {
        Self::checked(shape, contact, Mobility::Free(body))
    }

    fn checked(shape: Shape<N>, contact: Contact, mobility: Mobility<N>) -> Result<Self, ModelError> {
        if shape.is_spring() {
            let friction = contact.friction();
            require("friction of a spring", friction, friction == 0.0, "0: a spring has no surface")?;
            if let ContactLaw::HuntCrossley { exponent, .. } = contact.law() {
                require("exponent of a spring", exponent, false, "that of Kelvin and Voigt, a linear law")?;
            }
        }
        Ok(Self { shape, contact, mobility })
    }

    /// Its shape at its initial position.
    pub fn shape(&self) -> &Shape<N> {
        &self.shape
    }

    /// Its contact law.
    pub fn contact(&self) -> &Contact {
        &self.contact
    }

    /// Its body, if it is free.
    pub fn body(&self) -> Option<&FreeBody<N>> {
        if let Mobility::Free(body) = &self.mobility { Some(body) } else { None }
    }

    pub(crate) fn body_mut(&mut self) -> Option<&mut FreeBody<N>> {
        if let Mobility::Free(body) = &mut self.mobility { Some(body) } else { None }
    }

    pub(crate) fn is_fixed(&self) -> bool {
        self.mobility == Mobility::Fixed
    }

    /// True if its motion is prescribed.
    pub(crate) fn moves(&self) -> bool {
        matches!(self.mobility, Mobility::Moving(_))
    }

    /// Displacement in m and velocity in m/s at t in s, on the smooth piece valid at `piece`. A free body returns its
    /// present state.
    #[inline]
    pub(crate) fn place(&self, piece: f64, t: f64) -> (Axes<N>, Axes<N>) {
        match &self.mobility {
            Mobility::Fixed => (Axes::zeros(), Axes::zeros()),
            Mobility::Moving(motion) => motion.on(piece, t),
            Mobility::Free(body) => (body.displacement, body.velocity),
        }
    }

    /// Speed in m/s that it does not exceed without contact.
    pub(crate) fn top_speed(&self) -> f64 {
        match &self.mobility {
            Mobility::Fixed => 0.0,
            Mobility::Moving(motion) => motion.top_speed(),
            Mobility::Free(body) => body.velocity.norm(),
        }
    }

    pub(crate) fn next_kink(&self, t: f64) -> f64 {
        if let Mobility::Moving(motion) = &self.mobility { motion.next_kink(t) } else { f64::INFINITY }
    }
}

/// Shape of an object at its initial position.
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
    /// A half space opposite to `normal`, which need not have unit length; `point` in m lies on its surface.
    pub fn plane(point: Axes<N>, normal: Axes<N>) -> Result<Self, ModelError> {
        require_axes("plane point", &point, |_| true, "finite")?;
        require_axes("plane normal", &normal, |_| true, "finite")?;
        // Scaled first, so that the square of a huge or tiny normal does not overflow or underflow.
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

    /// A spring without a surface: it pushes and pulls towards `anchor` in m everywhere.
    pub fn spring(anchor: Axes<N>) -> Result<Self, ModelError> {
        require_axes("spring anchor", &anchor, |_| true, "finite")?;
        Ok(Self { kind: Kind::Spring { anchor } })
    }

    /// Signed distance in m from the surface (negative inside) and its gradient, the unit outward normal.
    ///
    /// A spring has no surface; its distance is minus infinity. Where the gradient does not exist (the centre of a
    /// sphere, equally near faces of a box), the first of the equivalent axes is used.
    #[inline(always)] // avoids a return through memory
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

    /// Distance in m that a point inside may move along each axis while the same face stays nearest; none for shapes
    /// without flat faces.
    pub(crate) fn margin_of_face(&self, point: &Axes<N>) -> Option<f64> {
        match &self.kind {
            Kind::Plane { .. } => Some(f64::INFINITY),
            Kind::Cuboid { centre, half_extents, .. } => {
                let from_centre = point - centre;
                let beyond = from_centre.abs() - half_extents;
                let nearest = beyond.imax();
                // The opposite face becomes nearest at the centre.
                let mut margin = from_centre[nearest].abs();
                for axis in (0..N).filter(|&axis| axis != nearest) {
                    margin = margin.min(0.5 * (beyond[nearest] - beyond[axis]));
                }
                Some(margin)
            }
            Kind::Sphere { .. } | Kind::Spring { .. } => None,
        }
    }

    /// Bound in m on the absolute coordinates of the shape; for a plane, of its point. It scales the rounding of points
    /// on the shape.
    pub(crate) fn extent(&self) -> f64 {
        let size = match &self.kind {
            Kind::Plane { .. } | Kind::Spring { .. } => 0.0,
            Kind::Sphere { radius, .. } => *radius,
            Kind::Cuboid { half_extents, .. } => amax(half_extents),
        };
        amax(self.reference()) + size
    }

    /// Point in m that moves with the object: the point of the plane, the centre or the anchor.
    pub fn reference(&self) -> &Axes<N> {
        match &self.kind {
            Kind::Plane { point, .. } => point,
            Kind::Sphere { centre, .. } | Kind::Cuboid { centre, .. } => centre,
            Kind::Spring { anchor } => anchor,
        }
    }

    /// Lower bound in m on the distance, cheaper than the distance.
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
#[inline(always)]
fn cuboid<const N: usize>(point: &Axes<N>, half_extents: &Axes<N>) -> (f64, Axes<N>) {
    let beyond = point.abs() - half_extents;
    let outside = beyond.map(|q| q.larger(0.0));
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

/// Constant velocity in a time window, plus a sine.
///
/// `p(t) = p_0 + V (min(t, until) - from)+ + a sin(2 pi f t)`
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ObjectMotion<const N: usize> {
    velocity: Axes<N>,
    window: Window,
    amplitude: Axes<N>,
    /// 2 pi f in rad/s.
    rate: f64,
}

impl<const N: usize> ObjectMotion<N> {
    /// V in m/s between two times in s, a in m, f in Hz (>= 0).
    pub fn new(
        velocity: Axes<N>,
        begin_s: f64,
        until_s: f64,
        amplitude: Axes<N>,
        frequency_hz: f64,
    ) -> Result<Self, ModelError> {
        require_axes("motion velocity", &velocity, |_| true, "finite")?;
        require("motion begin", begin_s, true, "finite")?;
        require("motion end", until_s, until_s >= begin_s, "finite and not before its begin")?;
        require_axes("motion amplitude", &amplitude, |_| true, "finite")?;
        require("motion frequency", frequency_hz, frequency_hz >= 0.0, "finite and 0 or more")?;
        let window = Window::between(begin_s, until_s);
        Ok(Self { velocity, window, amplitude, rate: std::f64::consts::TAU * frequency_hz })
    }

    /// Displacement in m and velocity in m/s at t in s.
    pub fn at(&self, t: f64) -> (Axes<N>, Axes<N>) {
        self.on(t, t)
    }

    /// The same, on the smooth piece valid at time `piece`.
    pub(crate) fn on(&self, piece: f64, t: f64) -> (Axes<N>, Axes<N>) {
        let (begin_s, until_s) = (self.window.begin_s(), self.window.until_s());
        let (mut displacement, mut velocity) = if self.window.contains(piece) {
            (self.velocity * (t - begin_s), self.velocity)
        } else if self.window.begins_after(piece) {
            (Axes::zeros(), Axes::zeros())
        } else {
            (self.velocity * (until_s - begin_s), Axes::zeros())
        };
        if self.rate > 0.0 {
            let (sin, cos) = (self.rate * t).sin_cos();
            displacement += self.amplitude * sin;
            velocity += self.amplitude * (self.rate * cos);
        }
        (displacement, velocity)
    }

    /// First time after t at which the velocity jumps.
    pub(crate) fn next_kink(&self, t: f64) -> f64 {
        self.window.next_bound(t)
    }

    /// Upper bound on its speed, in m/s.
    pub(crate) fn top_speed(&self) -> f64 {
        self.velocity.norm() + self.rate * self.amplitude.norm()
    }
}

/// Speed in m/s below which a body rests if the applied force is within its Coulomb friction; above it, friction has
/// its full value. It is far below any measured speed, so stopping distances match the closed form.
pub(crate) const STANDS: f64 = 1e-6;

/// A body in translation with ground friction: `m v' = F - b v - c v / |v|`. It rests while `|F| <= c`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FreeBody<const N: usize> {
    pub(crate) mass_kg: f64,
    viscous: f64,
    coulomb: f64,
    /// Displacement in m from its initial position.
    pub(crate) displacement: Axes<N>,
    pub(crate) velocity: Axes<N>,
    /// True while friction holds it.
    pub(crate) stands: bool,
}

impl<const N: usize> FreeBody<N> {
    /// Mass in kg (> 0), viscous friction in N s/m, Coulomb friction in N (>= 0), initial velocity in m/s.
    pub fn new(mass_kg: f64, viscous: f64, coulomb: f64, velocity: Axes<N>) -> Result<Self, ModelError> {
        require("body mass", mass_kg, mass_kg > 0.0, "finite and above 0")?;
        require("body viscous friction", viscous, viscous >= 0.0, "finite and 0 or more")?;
        require("body Coulomb friction", coulomb, coulomb >= 0.0, "finite and 0 or more")?;
        require_axes("body velocity", &velocity, |_| true, "finite")?;
        let stands = coulomb > 0.0 && velocity.norm() <= STANDS;
        let velocity = if stands { Axes::zeros() } else { velocity };
        Ok(Self { mass_kg, viscous, coulomb, displacement: Axes::zeros(), velocity, stands })
    }

    /// Acceleration in m/s² of the sliding body under `force` in N.
    pub(crate) fn acceleration(&self, velocity: &Axes<N>, force: &Axes<N>) -> Axes<N> {
        (force - velocity * self.drag(velocity)) / self.mass_kg
    }

    /// Friction force over speed, in N s/m.
    pub(crate) fn drag(&self, velocity: &Axes<N>) -> f64 {
        if self.coulomb > 0.0 {
            self.viscous + self.coulomb / velocity.norm().max(STANDS)
        } else {
            self.viscous
        }
    }

    /// True if friction can hold it under `force` in N.
    pub(crate) fn holds(&self, force: &Axes<N>) -> bool {
        self.coulomb > 0.0 && force.norm() <= self.coulomb
    }

    /// Slide for `step` in s without contact; exact.
    ///
    /// With z = b t / m, `s = s_0 e^-z - (c/m) t phi_1(z)` and `x = s_0 t phi_1(z) - (c/m) t² phi_2(z)`, until s = 0.
    pub(crate) fn coast(&mut self, step: f64) {
        let speed = self.velocity.norm();
        if self.stands || speed == 0.0 {
            return;
        }
        let stops_in = if self.coulomb == 0.0 {
            f64::INFINITY
        } else if self.viscous > 0.0 {
            (speed * self.viscous / self.coulomb).ln_1p() * self.mass_kg / self.viscous
        } else {
            speed * self.mass_kg / self.coulomb
        };
        let t = step.min(stops_in);
        let (decay, first, second) = exponentials(self.viscous * t / self.mass_kg);
        let slowing = self.coulomb / self.mass_kg;
        let way = speed * t * first - slowing * t * t * second;
        self.displacement += self.velocity * (way / speed);
        if step < stops_in {
            self.velocity *= (speed * decay - slowing * t * first).max(0.0) / speed;
        } else {
            self.velocity = Axes::zeros();
            self.stands = true;
        }
    }
}

/// `e^-z`, `phi_1 = (1 - e^-z) / z` and `phi_2 = (e^-z - 1 + z) / z²` for z >= 0.
fn exponentials(z: f64) -> (f64, f64, f64) {
    let decay = (-z).exp();
    if z < 0.3 {
        // Series where the closed forms cancel: 14 terms are below rounding at 0.3.
        let (mut term, mut first, mut second) = (1.0, 0.0, 0.0);
        for k in 1..15_u32 {
            first += term / f64::from(k);
            second += term / f64::from(k * (k + 1));
            term *= -z / f64::from(k);
        }
        (decay, first, second)
    } else {
        (decay, -(-z).exp_m1() / z, (decay - 1.0 + z) / (z * z))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_coasting_body_stops_where_the_textbook_says() {
        for (b, c) in [(0.0, 2.0), (1e-9, 2.0), (0.7, 2.0), (30.0, 2.0)] {
            let mut body = FreeBody::new(0.5, b, c, Axes::<1>::new(-1.2)).unwrap();
            for _ in 0..2000 {
                body.coast(1e-3);
            }
            // m s ds/dx = -(b s + c)
            let s: f64 = 1.2;
            let way =
                if b < 1e-6 { 0.5 * s * s / (2.0 * c) } else { 0.5 / b * (s - c / b * (s * b / c).ln_1p()) };
            assert!(body.stands);
            assert!((body.displacement[0] + way).abs() < 1e-9, "{b}: {} {way}", body.displacement[0]);
        }
    }

    #[test]
    fn series_and_closed_form_meet() {
        let (below, above) = (exponentials(0.3 - 1e-12), exponentials(0.3));
        assert!(
            (below.1 - above.1).abs() < 2e-12 && (below.2 - above.2).abs() < 2e-12,
            "{below:?} {above:?}"
        );
        let (_, first, second) = exponentials(0.0);
        assert_eq!((first, second), (1.0, 0.5));
    }
}
