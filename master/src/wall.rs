//! A wall that acts on the device at every instant, like a physical one and unlike a servo loop.

use crate::{Axes, ModelError, polynomial::Series, require};

/// A plane spring and damper on the device.
///
/// With depth `d = x_w - n·x`: `F = n max(0, K d + B d')` while d > 0, else 0. A two-sided wall acts
/// everywhere and also pulls.
///
/// Source: paper Eq. 15, without pulling forces.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ContinuousWall<const N: usize> {
    pub(crate) normal: Axes<N>,
    pub(crate) surface: f64,
    pub(crate) stiffness: f64,
    pub(crate) damping: f64,
    pub(crate) is_two_sided: bool,
}

impl<const N: usize> ContinuousWall<N> {
    /// A wall behind the plane through `point` in m with outward `normal` of any length, K in N/m and B in N
    /// s/m (>= 0).
    pub fn new(
        point: Axes<N>,
        normal: Axes<N>,
        stiffness: f64,
        damping: f64,
        is_two_sided: bool,
    ) -> Result<Self, ModelError> {
        for x in &point {
            require("wall point", *x, true, "finite")?;
        }
        let length = normal.norm();
        require("wall normal", length, length > 0.0, "finite and of some length")?;
        require("wall stiffness", stiffness, stiffness >= 0.0, "finite and 0 or more")?;
        require("wall damping", damping, damping >= 0.0, "finite and 0 or more")?;
        let normal = normal / length;
        Ok(Self { normal, surface: normal.dot(&point), stiffness, damping, is_two_sided })
    }

    /// Depth d in m.
    pub fn depth(&self, position: &Axes<N>) -> f64 {
        self.surface - self.normal.dot(position)
    }

    /// `K d + B d'` in N, also outside the wall.
    pub(crate) fn push(&self, position: &Axes<N>, velocity: &Axes<N>) -> f64 {
        self.stiffness * self.depth(position) - self.damping * self.normal.dot(velocity)
    }

    /// Largest push in N that may be rounding of its two parts.
    pub(crate) fn slight(&self, depth: f64, velocity: &Axes<N>) -> f64 {
        1e-14 * (self.stiffness * depth.abs() + self.damping * velocity.norm())
    }

    /// Force on the device in N.
    pub fn force(&self, position: &Axes<N>, velocity: &Axes<N>) -> Axes<N> {
        let push = self.push(position, velocity);
        let acts = self.is_two_sided || (self.depth(position) > 0.0 && push > 0.0);
        if acts { self.normal * push } else { Axes::zeros() }
    }

    /// Series of d and of `K d + B d'` along a motion.
    pub(crate) fn along(&self, motion: &[Axes<N>]) -> (Series, Series) {
        let mut depth: Series = std::array::from_fn(|n| -self.normal.dot(&motion[n]));
        depth[0] += self.surface;
        let push = std::array::from_fn(|n| {
            let rate = depth.get(n + 1).map_or(0.0, |next| (n + 1) as f64 * next);
            self.stiffness * depth[n] + self.damping * rate
        });
        (depth, push)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pushes_out_and_never_pulls() {
        let at = |x: f64, v: f64| (Axes::<2>::new(x, 7.0), Axes::<2>::new(v, 1.0));
        let wall =
            ContinuousWall::new(Axes::<2>::zeros(), Axes::<2>::new(2.0, 0.0), 100.0, 1.0, false).unwrap();
        for (x, v, expected) in [(0.1, -5.0, 0.0), (-0.1, 0.0, 10.0), (-0.1, -2.0, 12.0), (-0.1, 20.0, 0.0)] {
            let (x, v) = at(x, v);
            assert_eq!(wall.force(&x, &v), Axes::<2>::new(expected, 0.0));
        }
        let spring =
            ContinuousWall::new(Axes::<2>::zeros(), Axes::<2>::new(1.0, 0.0), 100.0, 0.0, true).unwrap();
        assert_eq!(spring.force(&at(0.1, 0.0).0, &at(0.1, 0.0).1)[0], -10.0);
        for (normal, k) in [(Axes::<2>::zeros(), 1.0), (Axes::<2>::new(1.0, 0.0), -1.0)] {
            assert!(ContinuousWall::new(Axes::zeros(), normal, k, 0.0, false).is_err());
        }
    }
}
