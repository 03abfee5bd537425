//! Hand grasp observer, HGO.

use crate::{About, Observation, ParameterError, Real, parameter::positive};
use haptether_numeric::{norm, pack};

/// HGO: near 1 while the hand holds against the rendered force, large when no hand holds.
///
/// `S_h = |F_v| / (|F_h| + alpha)`. `F_v` is the force asked of the device, with the lag of `F_h`. Without that lag,
/// a force that has just risen would look like one that nobody holds.
///
/// Source: paper Eq. 5.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HandGraspObserver<S = f64> {
    grasp_floor_n: S,
}

impl HandGraspObserver {
    /// Name, title and source.
    pub const ABOUT: About = About { name: "hgo", title: "hand grasp", source: "paper Eq. 5" };

    /// Create an observer with the floor alpha in N (> 0), which keeps the ratio finite; the paper uses 0.001 N.
    pub fn new(grasp_floor_n: f64) -> Result<Self, ParameterError> {
        Ok(Self { grasp_floor_n: positive("grasp_floor_n", "alpha", grasp_floor_n)? })
    }
}

impl<S: Real> HandGraspObserver<S> {
    /// Gather one observer per lane; return None if there are more observers than lanes.
    pub fn gather(of: &[&HandGraspObserver]) -> Option<Self> {
        Some(Self { grasp_floor_n: pack(of, |one| one.grasp_floor_n)? })
    }

    /// Compute `S_h`, without unit; the grasp is safe up to zeta (Eq. 8).
    #[inline(always)]
    pub fn observe<const N: usize>(&self, seen: &Observation<N, S>) -> S {
        norm(&seen.aligned_rendered_force) / (norm(&seen.grasp_force) + self.grasp_floor_n)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Axes;

    #[test]
    fn holds_eq_6_and_7() {
        let observer = HandGraspObserver::new(1e-3).unwrap();
        let force = Axes::<2>::new(3.0, 4.0);
        let mut seen = Observation::exact(Axes::zeros(), force, -force);
        assert!((observer.observe(&seen) - 5.0 / 5.001).abs() < 1e-15);
        seen.grasp_force = Axes::zeros();
        assert!((observer.observe(&seen) - 5000.0).abs() < 1e-9);
    }
}
