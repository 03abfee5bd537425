//! A free body that slides on a ground.

use crate::{Axes, ModelError, axes::require_axes, require};

/// Speed in m/s below which a body stands if what pushes it is within its Coulomb friction; above it, friction has its
/// full value. Far below anything that is measured, so that stopping distances are those of the textbook.
pub(crate) const STANDS: f64 = 1e-6;

/// A body that only translates, slowed by friction with the ground: `m v' = F - b v - c v / |v|`; at rest it stays
/// while `|F| <= c`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FreeBody<const N: usize> {
    pub(crate) mass_kg: f64,
    viscous: f64,
    coulomb: f64,
    /// From where its shape was put, in m.
    pub(crate) displacement: Axes<N>,
    pub(crate) velocity: Axes<N>,
    /// Held by friction.
    pub(crate) stands: bool,
}

impl<const N: usize> FreeBody<N> {
    /// Mass in kg (> 0), viscous friction in N s/m, Coulomb friction in N (>= 0), velocity at the start in m/s.
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

    /// Friction over speed, in N s/m.
    pub(crate) fn drag(&self, velocity: &Axes<N>) -> f64 {
        if self.coulomb > 0.0 {
            self.viscous + self.coulomb / velocity.norm().max(STANDS)
        } else {
            self.viscous
        }
    }

    /// Whether friction can hold it under `force` in N.
    pub(crate) fn holds(&self, force: &Axes<N>) -> bool {
        self.coulomb > 0.0 && force.norm() <= self.coulomb
    }

    /// Slides on for `step` in s while nothing touches it: exact.
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
        // The series, where the closed forms cancel: 14 terms are below rounding at 0.3.
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
