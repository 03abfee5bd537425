//! Who watches the hand in a local loop, and what they are told.

use haptether_safety::{
    Axes, Limiter, Observation, Real, SafetyLayer,
    controller::{Response, SafetyController},
};

use super::LocalPlant;

/// Observers and controllers, told either what a live master knows or the truth.
#[derive(Clone, Debug)]
pub enum Watch<const N: usize, S: Real = f64> {
    /// What the estimator makes of the measured positions, as live.
    Estimated(Box<SafetyLayer<N, S>>),
    /// The model's own velocity and force of the hand, for studies that leave estimation out.
    True {
        /// Observers and controllers.
        controller: SafetyController<N, S>,
        /// Bounds on the force, before the observers and after the controllers as in the layer; none where a study
        /// switches them off.
        limiters: Option<[Limiter<N, S>; 2]>,
    },
}

/// What was seen and decided at one tick.
#[derive(Clone, Copy, Debug)]
pub struct Watched<const N: usize, S: Real = f64> {
    /// `F_v` in N as far as it can be rendered.
    pub rendered_force: Axes<N, S>,
    /// `F_h` in N as the observers saw it.
    pub grasp_force: Axes<N, S>,
    /// `F_device` in N.
    pub device_force: Axes<N, S>,
    /// `F_c` and what the observers said.
    pub response: Response<N, S>,
}

impl<const N: usize, S: Real> Watch<N, S> {
    /// Several side by side; none if they are told different things or are built differently.
    pub(crate) fn gather(of: &[&Watch<N>]) -> Option<Self> {
        let (mut layers, mut controllers) = (Vec::new(), Vec::new());
        let mut bounds = [Vec::new(), Vec::new()];
        for one in of {
            match one {
                Watch::Estimated(layer) => layers.push((**layer).clone()),
                Watch::True { controller, limiters } => {
                    controllers.push(controller.clone());
                    if let Some(limiters) = limiters {
                        for (bounds, limiter) in bounds.iter_mut().zip(limiters) {
                            bounds.push(limiter.clone());
                        }
                    }
                }
            }
        }
        if layers.len() == of.len() {
            return Some(Self::Estimated(Box::new(SafetyLayer::gather(&layers)?)));
        }
        let limiters = match bounds[0].len() {
            0 => None,
            _ => Some([Limiter::gather(&bounds[0])?, Limiter::gather(&bounds[1])?]),
        };
        Some(Self::True { controller: SafetyController::gather(&controllers)?, limiters })
    }

    /// One tick: `position` in m as measured, `asked` in N.
    #[inline(always)]
    pub fn step(
        &mut self,
        plant: &impl LocalPlant<N, S>,
        position: &Axes<N, S>,
        asked: &Axes<N, S>,
    ) -> Watched<N, S> {
        let all = S::splat(1.0);
        match self {
            Self::Estimated(layer) => {
                let tick = layer.advance(position, plant.measured_velocity().as_ref(), asked, all);
                Watched {
                    rendered_force: tick.rendered_force,
                    grasp_force: tick.grasp_force,
                    device_force: tick.device_force,
                    response: tick.response,
                }
            }
            Self::True { controller, limiters } => {
                let (velocity, grasp_force) = (plant.velocity(), plant.hand_force());
                let rendered_force = match limiters {
                    Some([rendering, _]) => rendering.limit(asked, &Axes::zeros()).force,
                    None => *asked,
                };
                let response =
                    controller.respond(&Observation::exact(velocity, rendered_force, grasp_force), all);
                let sum = rendered_force + response.safety_force;
                let device_force = match limiters {
                    Some([_, limiter]) => limiter.limit(&sum, &velocity).force,
                    None => sum,
                };
                Watched { rendered_force, grasp_force, device_force, response }
            }
        }
    }
}
