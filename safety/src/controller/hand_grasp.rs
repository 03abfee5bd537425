//! Hand safety controller, HSC.

use crate::{
    About, DeviceModel, Observation, ParameterError, Real,
    controller::{Controller, Observed, SafetySettings, Verdict},
    lanes::{norm, pack, part},
    observer::HandGraspObserver,
    parameter::{in_range, non_negative},
};

/// HSC: unsafe while `S_h > zeta` and `|F_v| > F_t`.
///
/// Source: paper Eq. 14 with the criterion of Eq. 8.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HandGraspController<const N: usize, S = f64> {
    observer: HandGraspObserver<S>,
    grasp_threshold: S,
    force_threshold_n: S,
}

impl<const N: usize> HandGraspController<N> {
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

impl<const N: usize, S: Real> Controller<N, S> for HandGraspController<N, S> {
    type One = HandGraspController<N>;
    const ABOUT: &'static About = &About { name: "hsc", title: "hand grasp", source: "paper Eq. 14" };
    const OBSERVED: &'static Observed =
        &Observed { symbol: "S_h", column: "grasp", meaning: "S_h; null where not observed" };
    const READS_GRASP_FORCE: bool = true;
    const READS_ALIGNED_FORCE: bool = true;

    fn build(
        _: &DeviceModel<N>,
        _: f64,
        settings: &SafetySettings,
        _: bool,
    ) -> Result<Self::One, ParameterError> {
        let observer = HandGraspObserver::new(settings.grasp_floor_n)?;
        HandGraspController::new(observer, settings.grasp_threshold, settings.hsc_force_threshold_n)
            .map_err(|error| error.of_field("force_threshold_n", "hsc_force_threshold_n"))
    }

    fn gather(of: &[Self::One]) -> Option<Self> {
        Some(Self {
            observer: part(of, |one| one.observer, HandGraspObserver::gather)?,
            grasp_threshold: pack(of, |one| one.grasp_threshold)?,
            force_threshold_n: pack(of, |one| one.force_threshold_n)?,
        })
    }

    #[inline(always)]
    fn step(&mut self, seen: &Observation<N, S>) -> Verdict<N, S> {
        let observed = self.observer.observe(seen);
        // F_t is there because S_h means little of small forces, so it must hold for the force that S_h is made of.
        let pushing = norm(&seen.rendered_force).simd_gt(self.force_threshold_n)
            & norm(&seen.aligned_rendered_force).simd_gt(self.force_threshold_n);
        Verdict::without_force(observed, pushing & observed.simd_gt(self.grasp_threshold))
    }

    /// zeta, of Eq. 8.
    fn threshold(settings: &SafetySettings) -> f64 {
        settings.grasp_threshold
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Axes;

    #[test]
    fn both_conditions_must_hold() {
        let observer = HandGraspObserver::new(1e-3).unwrap();
        let mut controller = HandGraspController::<1>::new(observer, 1.5, 1.0).unwrap();
        for (rendered, grasp, trips) in
            [(3.0, -3.0, false), (3.0, -1.9, true), (3.0, -2.1, false), (0.9, 0.0, false), (1.1, 0.0, true)]
        {
            let seen =
                Observation::exact(Axes::<1>::zeros(), Axes::<1>::new(rendered), Axes::<1>::new(grasp));
            assert_eq!(controller.step(&seen).is_unsafe, trips, "{rendered} {grasp}");
        }
        assert!(HandGraspController::<1>::new(observer, 1.0, 1.0).is_err());
    }
}
