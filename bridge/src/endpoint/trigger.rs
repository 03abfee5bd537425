//! The force feedback of a trigger: a one-axis coupling of its own, from the jaws to the finger.

use haptether_safety::{
    Axes, DeviceModel, Excess, Fault, LayerSettings, LimiterSettings, ParameterError, SafetyLayer,
    SafetyTick, controller::SafetySettings, estimator::EstimatorKind,
};

use crate::coupling::{CouplingError, GripperState};

/// How the force feedback of a trigger is built; forces and ways are those of the finger.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TriggerSettings {
    /// From open to closed, in m.
    pub travel_m: f64,
    /// Dynamics of the trigger.
    pub device: DeviceModel<1>,
    /// How V and A are had from positions.
    pub estimator: EstimatorKind,
    /// Observers and controllers.
    pub safety: SafetySettings,
    /// Bounds on the force; the ladder fades it in, so the limiter's ramp-in is not used.
    pub limiter: LimiterSettings,
    /// Finger force per force between the jaws.
    pub force_scale: f64,
}

/// From the jaws to the finger: `F_v = -g lambda F_jaws` along the closing way `x = travel p`, while something stops the
/// jaws and they follow the trigger; else 0. g rises from 0 to 1 within the ladder's fade-in once they follow.
///
/// It has a [`SafetyLayer`] of its own. A trip of it is none of the hand, nor is one of the hand a trip of it: a finger
/// that leaves its trigger is how a gripper is opened, and must not take away the force that the hand leans on.
#[derive(Clone, Debug)]
pub(super) struct TriggerFeedback {
    layer: SafetyLayer<1>,
    travel_m: f64,
    force_scale: f64,
    /// g.
    share: f64,
    /// By how much g rises at a tick.
    rise: f64,
    /// Whether x was known at the last tick.
    is_known: bool,
    /// It was not known while the two sides were coupled: what a trip held back must not return by that.
    is_lost: bool,
}

impl TriggerFeedback {
    pub(super) fn new(
        settings: &TriggerSettings,
        period_s: f64,
        fade_in_s: f64,
    ) -> Result<Self, TriggerError> {
        let TriggerSettings { travel_m, device, estimator, safety, limiter, force_scale } = *settings;
        if !(travel_m > 0.0 && travel_m <= MAX_TRAVEL_M) {
            return Err(TriggerError::Travel(travel_m));
        }
        if !(force_scale > 0.0 && force_scale.is_finite()) {
            let (name, symbol) = ("master.gripper.force_scale", "lambda");
            return Err(CouplingError::Scale { name, symbol, seen: force_scale }.into());
        }
        let limiter = LimiterSettings { ramp_in_s: 0.0, ..limiter };
        let layer = SafetyLayer::new(&LayerSettings { device, period_s, estimator, safety, limiter })?;
        Ok(Self {
            layer,
            travel_m,
            force_scale,
            share: 0.0,
            rise: period_s / fade_in_s,
            is_known: false,
            is_lost: false,
        })
    }

    /// One tick at `position`, 0 open to 1 closed, where that is known; `jaws` as the peer's newest frame has them, and the
    /// share `gain` of the ladder.
    pub(super) fn tick(
        &mut self,
        position: Option<f64>,
        jaws: Option<GripperState>,
        is_coupled: bool,
        gain: f64,
        missed: u64,
    ) -> SafetyTick<1> {
        self.is_lost &= is_coupled;
        let Some(x) = position.map(|share| share * self.travel_m) else {
            // Nothing is known of a finger there: no force, before the two sides engage anew.
            (self.is_known, self.share, self.is_lost) = (false, 0.0, is_coupled);
            return SafetyTick::still();
        };
        let mut missed = missed;
        if !std::mem::replace(&mut self.is_known, true) {
            // A position that cannot be is met below.
            let _ = self.layer.restart(&Axes::<1>::new(x));
            missed = 0;
        }
        self.share = match jaws {
            // Apart, the ladder fades what there is.
            _ if !is_coupled && gain > 0.0 => self.share,
            Some(GripperState { follows: true, .. }) if is_coupled && !self.is_lost => {
                (self.share + self.rise).min(1.0)
            }
            _ => 0.0,
        };
        let pressing_n = jaws.filter(|jaws| jaws.holds_object).map_or(0.0, |jaws| jaws.force_n);
        // 0 - x: a force that there is not is 0, and not -0.
        let requested_n = 0.0 - self.force_scale * pressing_n * self.share * gain;
        self.layer.tick_after(missed, &Axes::<1>::new(x), None, &Axes::<1>::new(requested_n), gain)
    }

    /// The speed beyond the bound of the trigger that led to its fault.
    pub(super) fn excess(&self) -> Option<Excess> {
        self.layer.excess()
    }

    /// How many samples left their path and were replaced.
    pub(super) fn outliers(&self) -> u64 {
        self.layer.guard().outliers()
    }

    /// Forgets what lies before: a stall.
    pub(super) fn restart(&mut self) {
        (self.is_known, self.share) = (false, 0.0);
    }

    /// The same, and a fault is mended.
    pub(super) fn reset(&mut self) {
        // The next position that is known restarts it there.
        let _ = self.layer.reset(&Axes::zeros());
        self.restart();
    }

    /// No force from now on, until [`reset`](Self::reset).
    pub(super) fn fail(&mut self, fault: Fault) -> SafetyTick<1> {
        self.layer.fail(fault);
        SafetyTick { fault: Some(fault), ..SafetyTick::still() }
    }
}

/// Longest way of a trigger in m.
const MAX_TRAVEL_M: f64 = 1.0;

/// Settings that no trigger can have.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum TriggerError {
    /// A way that no finger goes.
    #[error("master.gripper.travel_m = {0}: must be above 0 and at most 1 m")]
    Travel(f64),
    /// A scale that couples nothing.
    #[error(transparent)]
    Coupling(#[from] CouplingError),
    /// A parameter of its safety layer.
    #[error("[master.gripper] or [safety.gripper]: {0}")]
    Safety(#[from] ParameterError),
}

#[cfg(test)]
mod tests;
