//! Hand safety controller, HSC.

use crate::{
    About, DeviceModel, Observation, ParameterError, Real,
    controller::{Controller, Observed, SafetySettings, Verdict},
    observer::HandGraspObserver,
    parameter::{in_range, non_negative},
};
use haptether_numeric::{norm, pack, part};

/// HSC: unsafe while `S_h > zeta` and `|F_v| > F_t`; with a velocity threshold, also `V·F_v / |F_v| > V_s`.
///
/// A push ejects a device only by doing work on it. A hand that takes up a load moves into the push, or yields
/// slowly. The inertial force of the device is then part of `F_v`, but no hand holds it: `S_h` exceeds zeta without
/// an ejection. `V_s` accepts this case. A released device exceeds `V_s` after `m V_s / |F_v|`.
///
/// Source: paper Eq. 14 with the criterion of Eq. 8; `V_s`, `docs/thresholds.md`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HandGraspController<const N: usize, S = f64> {
    observer: HandGraspObserver<S>,
    grasp_threshold: S,
    force_threshold_n: S,
    /// `V_s`; 0 disables the condition.
    velocity_threshold: S,
}

impl<const N: usize> HandGraspController<N> {
    /// Create a controller with grasp threshold zeta (above 1; the paper uses 1.5) and force threshold `F_t` in N (>=
    /// 0).
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
            velocity_threshold: 0.0,
        })
    }

    /// Set the velocity threshold `V_s` in m/s (>= 0); 0 is Eq. 14 as printed.
    pub fn with_velocity_threshold(self, velocity_threshold: f64) -> Result<Self, ParameterError> {
        let velocity_threshold = non_negative("velocity_threshold", "V_s", velocity_threshold)?;
        Ok(Self { velocity_threshold, ..self })
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
            .map_err(|error| error.of_field("force_threshold_n", "hsc_force_threshold_n"))?
            .with_velocity_threshold(settings.hsc_velocity_threshold)
            .map_err(|error| error.of_field("velocity_threshold", "hsc_velocity_threshold"))
    }

    fn gather(of: &[&Self::One]) -> Option<Self> {
        Some(Self {
            observer: part(of, |one| &one.observer, HandGraspObserver::gather)?,
            grasp_threshold: pack(of, |one| one.grasp_threshold)?,
            force_threshold_n: pack(of, |one| one.force_threshold_n)?,
            velocity_threshold: pack(of, |one| one.velocity_threshold)?,
        })
    }

    #[inline(always)]
    fn step(&mut self, seen: &Observation<N, S>) -> Verdict<N, S> {
        let observed = self.observer.observe(seen);
        // S_h is unreliable for small forces, so F_t must also hold for the force that S_h is computed from.
        let force = norm(&seen.rendered_force);
        let pushing = force.simd_gt(self.force_threshold_n)
            & norm(&seen.aligned_rendered_force).simd_gt(self.force_threshold_n);
        // Negated comparison: a NaN must not let a push pass.
        let yields = !seen.velocity.dot(&seen.rendered_force).simd_le(self.velocity_threshold * force);
        let moves = yields | self.velocity_threshold.simd_eq(S::splat(0.0));
        Verdict::without_force(observed, pushing & observed.simd_gt(self.grasp_threshold) & moves)
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

    /// Only the speed along the push counts, for any direction of the push and any motion across it.
    #[test]
    fn with_a_velocity_threshold_the_device_must_move_along_the_push() {
        let observer = HandGraspObserver::new(1e-3).unwrap();
        let printed = HandGraspController::<2>::new(observer, 1.5, 1.0).unwrap();
        let push = Axes::<2>::new(-3.0, 4.0);
        let (along, across) = (push / 5.0, Axes::<2>::new(0.8, 0.6));
        for (threshold, speed, sideways, trips) in [
            (0.0, 0.0, 0.0, true),
            (0.0, -1.0, 0.0, true),
            (0.05, 0.0, 0.0, false),
            (0.05, 0.049, 0.0, false),
            (0.05, 0.051, 0.0, true),
            (0.05, -1.0, 0.0, false),
            (0.05, 0.0, 1.0, false),
            (0.05, 0.051, -1.0, true),
            (0.05, f64::NAN, 0.0, true),
        ] {
            let mut controller = printed.with_velocity_threshold(threshold).unwrap();
            for turn in [1.0, -1.0] {
                let velocity = (along * speed + across * sideways) * turn;
                let seen = Observation::exact(velocity, push * turn, Axes::<2>::zeros());
                assert_eq!(controller.step(&seen).is_unsafe, trips, "{threshold} {speed} {sideways}");
                let held = Observation::exact(velocity, push * turn, -push * turn);
                assert!(!controller.step(&held).is_unsafe, "a hand holds the force");
            }
        }
        for wrong in [-0.1, f64::NAN, f64::INFINITY] {
            assert!(printed.with_velocity_threshold(wrong).is_err());
        }
    }
}
