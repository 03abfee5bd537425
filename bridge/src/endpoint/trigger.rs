//! Force feedback of a trigger: a separate one-axis coupling from the jaws to the finger.

use haptether_safety::{
    Axes, DeviceModel, Excess, Fault, LayerSettings, LimiterSettings, ParameterError, SafetyLayer,
    SafetyTick, controller::SafetySettings, estimator::EstimatorKind,
};

use crate::coupling::{CouplingError, GripperState};

/// Settings of the force feedback of a trigger; forces and displacements are those of the finger.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TriggerSettings {
    /// Travel from open to closed in m.
    pub travel_m: f64,
    /// Dynamics of the trigger.
    pub device: DeviceModel<1>,
    /// Estimator of V and A from positions.
    pub estimator: EstimatorKind,
    /// Observers and controllers.
    pub safety: SafetySettings,
    /// Bounds on the force. The limiter's ramp-in is not used, because the ladder fades the force in.
    pub limiter: LimiterSettings,
    /// Ratio of the finger force to the force between the jaws.
    pub force_scale: f64,
}

/// Coupling from the jaws to the finger: `F_v = -g lambda F_jaws` along the closing direction `x = travel p`.
/// `F_v` is 0 unless the jaws press on something and follow the trigger. Once they follow, g rises from 0 to 1
/// within the ladder's fade-in.
///
/// The trigger has its own [`SafetyLayer`]; its trips and those of the hand are independent. When
/// the finger leaves the trigger, the gripper opens. This must not remove the force that the hand
/// leans on.
#[derive(Clone, Debug)]
pub(super) struct TriggerFeedback {
    layer: SafetyLayer<1>,
    travel_m: f64,
    force_scale: f64,
    /// Gain g.
    share: f64,
    /// Rise of g per tick.
    rise: f64,
    /// True if x was known at the last tick.
    is_known: bool,
    /// True if x was unknown while the two sides were coupled. The force then stays zero until the sides
    /// part, so that a gap cannot clear a trip.
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

    /// Step one tick at `position`, 0 open to 1 closed, if known. `jaws` is the state in the peer's newest
    /// frame; `gain` is the ladder's gain.
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
            // After an unknown position the force stays zero until the two sides engage again.
            (self.is_known, self.share, self.is_lost) = (false, 0.0, is_coupled);
            return SafetyTick::still();
        };
        let mut missed = missed;
        if !std::mem::replace(&mut self.is_known, true) {
            // `tick_after` below reports an invalid position.
            let _ = self.layer.restart(&Axes::<1>::new(x));
            missed = 0;
        }
        self.share = match jaws {
            // After the sides part, the ladder fades the remaining force.
            _ if !is_coupled && gain > 0.0 => self.share,
            Some(GripperState { follows: true, .. }) if is_coupled && !self.is_lost => {
                (self.share + self.rise).min(1.0)
            }
            _ => 0.0,
        };
        let pressing_n = jaws.filter(|jaws| jaws.holds_object).map_or(0.0, |jaws| jaws.force_n);
        // `0.0 - x` avoids the negative zero.
        let pressing = Axes::<1>::new(self.force_scale * pressing_n * self.share);
        let requested = Axes::<1>::new(0.0 - self.layer.faded(&pressing, gain)[0]);
        self.layer.tick_after(missed, &Axes::<1>::new(x), None, &requested, gain)
    }

    /// Speed beyond the trigger's bound that caused its fault.
    pub(super) fn excess(&self) -> Option<Excess> {
        self.layer.excess()
    }

    /// Number of implausible samples that predictions replaced.
    pub(super) fn outliers(&self) -> u64 {
        self.layer.guard().outliers()
    }

    /// Restart after a stall: forget the state before it.
    pub(super) fn restart(&mut self) {
        (self.is_known, self.share) = (false, 0.0);
    }

    /// Restart after an acknowledged fault, and clear the fault.
    pub(super) fn reset(&mut self) {
        // The next known position restarts the layer there.
        let _ = self.layer.reset(&Axes::zeros());
        self.restart();
    }

    /// Set the force to zero until [`reset`](Self::reset).
    pub(super) fn fail(&mut self, fault: Fault) -> SafetyTick<1> {
        self.layer.fail(fault);
        SafetyTick { fault: Some(fault), ..SafetyTick::still() }
    }
}

/// Largest travel of a trigger in m.
const MAX_TRAVEL_M: f64 = 1.0;

/// Invalid settings of a trigger.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum TriggerError {
    /// Travel out of range.
    #[error("master.gripper.travel_m = {0}: must be above 0 and at most 1 m")]
    Travel(f64),
    /// Scale that is zero, negative or not finite.
    #[error(transparent)]
    Coupling(#[from] CouplingError),
    /// A parameter of its safety layer.
    #[error("[master.gripper] or [safety.gripper]: {0}")]
    Safety(#[from] ParameterError),
}

#[cfg(test)]
mod tests;
