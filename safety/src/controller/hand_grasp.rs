//! Hand safety controller, HSC.

use crate::{
    Observation, ParameterError, Real,
    lanes::{norm, pack, part},
    observer::HandGraspObserver,
    parameter::{in_range, non_negative},
};

/// HSC: unsafe while `S_h > zeta` and `|F_v| > F_t`.
///
/// Source: paper Eq. 14 with the criterion of Eq. 8.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HandGraspController<S = f64> {
    observer: HandGraspObserver<S>,
    grasp_threshold: S,
    force_threshold_n: S,
}

impl HandGraspController {
    /// Grasp threshold zeta (above 1; the paper uses 1.5), force threshold `F_t` in N (>= 0).
    pub fn new(
        observer: HandGraspObserver,
        grasp_threshold: f64,
        force_threshold_n: f64,
    ) -> Result<Self, ParameterError> {
        Ok(Self {
            observer,
            grasp_threshold: in_range(
                "grasp_threshold",
                "zeta",
                grasp_threshold,
                1.0 + f64::EPSILON,
                f64::MAX,
                "finite and above 1",
            )?,
            force_threshold_n: non_negative("force_threshold_n", "F_t", force_threshold_n)?,
        })
    }
}

impl<S: Real> HandGraspController<S> {
    /// As many controllers as there are lanes; None for another number of them.
    pub fn gather(of: &[HandGraspController]) -> Option<Self> {
        Some(Self {
            observer: part(of, |one| one.observer, HandGraspObserver::gather)?,
            grasp_threshold: pack(of, |one| one.grasp_threshold)?,
            force_threshold_n: pack(of, |one| one.force_threshold_n)?,
        })
    }

    /// `S_h` and whether it is unsafe.
    #[inline(always)]
    pub fn judge<const N: usize>(&self, seen: &Observation<N, S>) -> (S, S::SimdBool) {
        let observed = self.observer.observe(seen);
        // F_t is there because S_h means little of small forces, so it must hold for the force that S_h is made of.
        let pushing = norm(&seen.rendered_force).simd_gt(self.force_threshold_n)
            & norm(&seen.aligned_rendered_force).simd_gt(self.force_threshold_n);
        (observed, pushing & observed.simd_gt(self.grasp_threshold))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Axes;

    #[test]
    fn both_conditions_must_hold() {
        let observer = HandGraspObserver::new(1e-3).unwrap();
        let controller = HandGraspController::new(observer, 1.5, 1.0).unwrap();
        for (rendered, grasp, trips) in
            [(3.0, -3.0, false), (3.0, -1.9, true), (3.0, -2.1, false), (0.9, 0.0, false), (1.1, 0.0, true)]
        {
            let seen =
                Observation::exact(Axes::<1>::zeros(), Axes::<1>::new(rendered), Axes::<1>::new(grasp));
            assert_eq!(controller.judge(&seen).1, trips, "{rendered} {grasp}");
        }
        assert!(HandGraspController::new(observer, 1.0, 1.0).is_err());
    }
}
