//! Safety observers: each gives one value per tick that measures how safe the hand is.
//!
//! An observer is one file in this folder and one line in [`OBSERVERS`]. A controller that acts on it is another
//! file, in [`controller`](crate::controller).

mod hand_grasp;
mod passivity;
mod safety;
mod velocity_force;
mod windowed;

pub use hand_grasp::HandGraspObserver;
pub use passivity::PassivityObserver;
pub use safety::SafetyObserver;
pub use velocity_force::{VelocityForceForm, VelocityForceObserver};
pub use windowed::WindowedSafetyObserver;

use crate::{
    About, Axes, Real,
    fault::{Fault, Signal},
};
use haptether_numeric::{is_within, no_lanes};

/// Name, title and source of each observer.
pub const OBSERVERS: [About; 5] = [
    VelocityForceObserver::ABOUT,
    HandGraspObserver::ABOUT,
    SafetyObserver::<1>::ABOUT,
    WindowedSafetyObserver::<1>::ABOUT,
    PassivityObserver::<1>::ABOUT,
];

/// Signals of one tick that observers and controllers read.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Observation<const N: usize, S = f64> {
    /// V in m/s.
    pub velocity: Axes<N, S>,
    /// `F_v` in N, requested by the remote side.
    pub rendered_force: Axes<N, S>,
    /// `F_h` in N: estimated force of the hand on the device (Eq. 4).
    pub grasp_force: Axes<N, S>,
    /// Force in N that the device was asked to render, with the lag of `F_h`, because `S_h` compares the two.
    ///
    /// It passes through the same kernel of past ticks ([`Estimator::align`](crate::estimator::Estimator::align)).
    /// With exact signals and without an intervention it equals `F_v`.
    pub aligned_rendered_force: Axes<N, S>,
}

impl<const N: usize, S: Real> Observation<N, S> {
    /// Create an observation of exact signals: `F_h` has no lag, so `F_v` needs no alignment.
    #[inline(always)]
    pub fn exact(velocity: Axes<N, S>, rendered_force: Axes<N, S>, grasp_force: Axes<N, S>) -> Self {
        Self { velocity, rendered_force, grasp_force, aligned_rendered_force: rendered_force }
    }

    /// Return the mask of lanes that [`check`](Observation::check) would accept.
    #[inline(always)]
    pub fn passes(&self) -> S::SimdBool {
        [
            (Signal::Velocity, &self.velocity),
            (Signal::RenderedForce, &self.rendered_force),
            (Signal::RenderedForce, &self.aligned_rendered_force),
            (Signal::GraspForce, &self.grasp_force),
        ]
        .into_iter()
        .fold(!no_lanes::<S>(), |passes, (signal, value)| passes & is_within(value, signal.bound()))
    }
}

impl<const N: usize> Observation<N> {
    /// Return a fault for a value that is not finite or out of range.
    #[inline(always)]
    pub fn check(&self) -> Result<(), Fault> {
        Signal::Velocity.check(&self.velocity)?;
        Signal::RenderedForce.check(&self.rendered_force)?;
        Signal::RenderedForce.check(&self.aligned_rendered_force)?;
        Signal::GraspForce.check(&self.grasp_force)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    type Field = fn(&mut Observation<2>) -> &mut Axes<2>;

    #[test]
    fn values_within_bounds_pass_and_others_are_named() {
        let good = Observation::<2>::exact(Axes::zeros(), Axes::zeros(), Axes::zeros());
        assert_eq!((good.check(), good.passes()), (Ok(()), true));
        let fields: [(Signal, Field); 4] = [
            (Signal::Velocity, |of| &mut of.velocity),
            (Signal::RenderedForce, |of| &mut of.rendered_force),
            (Signal::GraspForce, |of| &mut of.grasp_force),
            (Signal::RenderedForce, |of| &mut of.aligned_rendered_force),
        ];
        for (signal, field) in fields {
            let bound = signal.bound();
            for axis in 0..2 {
                for (value, passes) in [
                    (bound, true),
                    (-bound, true),
                    (bound * (1.0 + f64::EPSILON), false),
                    (f64::NAN, false),
                    (f64::NEG_INFINITY, false),
                ] {
                    let mut seen = good;
                    field(&mut seen)[axis] = value;
                    assert_eq!((seen.passes(), seen.check().is_ok()), (passes, passes), "{seen:?}");
                    // A second invalid value changes nothing.
                    field(&mut seen)[1 - axis] = value;
                    assert_eq!((seen.passes(), seen.check().is_ok()), (passes, passes), "{seen:?}");
                }
            }
        }
    }
}
