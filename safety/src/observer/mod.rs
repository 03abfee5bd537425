//! Safety observers: one number per tick that says how safe the hand is.
//!
//! An observer is one file here and one line in [`OBSERVERS`]. A controller that acts on it is another file, in
//! [`controller`](crate::controller).

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
    lanes::{is_within, nowhere},
};

/// The observers.
pub const OBSERVERS: [About; 5] = [
    VelocityForceObserver::ABOUT,
    HandGraspObserver::ABOUT,
    SafetyObserver::<1>::ABOUT,
    WindowedSafetyObserver::<1>::ABOUT,
    PassivityObserver::<1>::ABOUT,
];

/// The signals of one tick that observers and controllers read.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Observation<const N: usize, S = f64> {
    /// V in m/s.
    pub velocity: Axes<N, S>,
    /// `F_v` in N: what the remote side requests.
    pub rendered_force: Axes<N, S>,
    /// `F_h` in N: estimated force of the hand on the device (Eq. 4).
    pub grasp_force: Axes<N, S>,
    /// What the device was asked to render, in N, as `F_h` sees it: passed through the same kernel of past ticks
    /// ([`Estimator::align`](crate::estimator::Estimator::align)), because `S_h` compares the two. With exact signals and
    /// without an intervention it is `F_v` itself.
    pub aligned_rendered_force: Axes<N, S>,
}

impl<const N: usize, S: Real> Observation<N, S> {
    /// An observation of exact signals: `F_h` is not late, so `F_v` needs no alignment.
    #[inline(always)]
    pub fn exact(velocity: Axes<N, S>, rendered_force: Axes<N, S>, grasp_force: Axes<N, S>) -> Self {
        Self { velocity, rendered_force, grasp_force, aligned_rendered_force: rendered_force }
    }

    /// Where [`check`](Observation::check) would let the numbers through.
    #[inline(always)]
    pub fn passes(&self) -> S::SimdBool {
        [
            (Signal::Velocity, &self.velocity),
            (Signal::RenderedForce, &self.rendered_force),
            (Signal::RenderedForce, &self.aligned_rendered_force),
            (Signal::GraspForce, &self.grasp_force),
        ]
        .into_iter()
        .fold(!nowhere::<S>(), |passes, (signal, value)| passes & is_within(value, signal.bound()))
    }
}

impl<const N: usize> Observation<N> {
    /// Refuses numbers that are not finite or absurd.
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
    fn numbers_within_their_bounds_pass_and_all_others_are_named() {
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
                    // Two that are wrong are no better than one.
                    field(&mut seen)[1 - axis] = value;
                    assert_eq!((seen.passes(), seen.check().is_ok()), (passes, passes), "{seen:?}");
                }
            }
        }
    }
}
