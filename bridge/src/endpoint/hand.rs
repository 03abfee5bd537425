//! Decision over the force on a hand. Live runs, virtual time and the replay of a recording all use it.

use haptether_safety::{
    Advance, Axes, Coupled, CoupledTurn, Excess, Fault, Guard, Real, SafetyLayer, SafetyTick, Sample,
    SampleBounds, Signal, Track, controller::ResearchController, is_within,
};

use super::layer::{Layer, MasterReading};

/// State that a tick takes over from the one before.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum CarriedState {
    /// All state.
    #[default]
    All,
    /// Only a fault: the loop had stalled.
    FaultOnly,
    /// Nothing: the operator has acknowledged a fault.
    Nothing,
}

impl CarriedState {
    /// Name in recordings.
    pub fn name(self) -> &'static str {
        match self {
            Self::All => "kept",
            Self::FaultOnly => "stalled",
            Self::Nothing => "acknowledged",
        }
    }
}

/// Inputs of a tick beside the measurements of the device.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HandInput<const N: usize> {
    /// `F_e` in N of the newest frame; zero before the first.
    pub received_force: Axes<N>,
    /// Moment in N m of the newest frame; zero before the first.
    pub received_torque: Axes<3>,
    /// `F_v` in N that the coupling requests, from `F_e`.
    pub requested_force: Axes<N>,
    /// Torque in N m that the coupling requests, from the moment.
    pub requested_torque: Axes<3>,
    /// Gain of the ladder on the request, 0 to 1.
    pub gain: f64,
    /// Ticks left out since the last one.
    pub missed: u64,
    /// State taken over from the last tick.
    pub past: CarriedState,
    /// Fault that only other parts can detect: of the device or of the trigger.
    pub fault: Option<Fault>,
}

impl<const N: usize> HandInput<N> {
    /// Input without request and without events.
    pub fn idle() -> Self {
        Self {
            received_force: Axes::zeros(),
            received_torque: Axes::zeros(),
            requested_force: Axes::zeros(),
            requested_torque: Axes::zeros(),
            gain: 0.0,
            missed: 0,
            past: CarriedState::All,
            fault: None,
        }
    }
}

/// Safety layer of a hand.
#[derive(Clone, Debug)]
pub(crate) struct Hand<const N: usize> {
    layer: Layer<N>,
    /// True if the first tick is still to come.
    is_new: bool,
}

impl<const N: usize> Hand<N> {
    pub(super) fn new(layer: Layer<N>) -> Self {
        Self { layer, is_new: true }
    }

    /// Replace the sample bounds of position and rotation, before the first tick.
    pub(crate) fn with_samples(self, bounds: [SampleBounds; 2]) -> Self {
        Self { layer: self.layer.with_samples(bounds), ..self }
    }

    /// Estimate the wrench of the hand at every tick, before the first one.
    pub(super) fn with_grasp(self) -> Self {
        Self { layer: self.layer.with_grasp(), ..self }
    }

    /// Force in N and torque in N m of the hand at the last tick; zero unless something needs it.
    pub(super) fn grasp(&self) -> (Axes<N>, Axes<3>) {
        self.layer.grasp()
    }

    /// Sample in use at this tick: the newest one, or its prediction.
    #[inline]
    pub(crate) fn sample_in_use(&self) -> &Sample<N> {
        self.layer.sample_in_use()
    }

    /// Guard that checks the samples.
    #[inline]
    pub(crate) fn guard(&self) -> &Guard<N> {
        self.layer.guard()
    }

    /// Speed beyond the device's bound that caused the fault.
    pub(super) fn excess(&self) -> Option<Excess> {
        self.layer.excess()
    }

    /// Add the caller's own controller. Returns `None` for a hand that turns.
    pub(super) fn with_research(mut self, controller: Box<dyn ResearchController>) -> Option<Self> {
        self.layer = self.layer.with_research(controller)?;
        Some(self)
    }

    /// Force in N and torque in N m of the coupling that the device has exerted since the last tick.
    pub(super) fn exerted(&self) -> (Axes<N>, Axes<3>) {
        self.layer.exerted()
    }

    /// Step one tick with the requests of `input`.
    #[inline(always)] // its result is large and mostly empty
    pub(crate) fn tick(
        &mut self,
        reading: &MasterReading<N>,
        input: &HandInput<N>,
    ) -> (SafetyTick<N>, Option<SafetyTick<3>>) {
        self.tick_coupled(reading, input, |_| input.requested_force, |_| input.requested_torque)
    }

    /// Step one tick with the force of `couple` and the torque of `couple_torque`, which get the motion of this tick.
    #[inline(always)] // its result is large and mostly empty
    pub(super) fn tick_coupled(
        &mut self,
        reading: &MasterReading<N>,
        input: &HandInput<N>,
        couple: impl FnOnce(&Coupled<'_, N>) -> Axes<N>,
        couple_torque: impl FnOnce(&CoupledTurn<'_>) -> Axes<3>,
    ) -> (SafetyTick<N>, Option<SafetyTick<3>>) {
        // The state before a gap does not apply after it. If the position is still invalid, the layer stays
        // in fault, and the tick below reports it again.
        let missed = match input.past {
            CarriedState::All => input.missed,
            CarriedState::Nothing => {
                let _ = self.layer.reset(reading);
                0
            }
            CarriedState::FaultOnly => {
                let _ = self.layer.restart(reading);
                0
            }
        };
        if let Some(fault) = input.fault {
            // After the reset above, so that an acknowledgement does not clear a fault of this very tick.
            self.layer.fail(fault);
        }
        self.is_new = false;
        self.layer.tick(missed, reading, couple, couple_torque, input.gain)
    }
}

/// Safety layers of several point hands in SIMD lanes, with the paths of their samples.
#[derive(Clone, Debug)]
pub(crate) struct HandLanes<const N: usize, S> {
    layer: SafetyLayer<N, S>,
    track: Track<N, S>,
    /// Last measured velocity in m/s.
    last: Option<Axes<N, S>>,
}

impl<const N: usize, S: Real> HandLanes<N, S> {
    /// Gather hands before their first tick; surplus lanes repeat the last hand. Returns `None` if a hand has
    /// begun, or if layers differ in more than numbers.
    pub(crate) fn gather(of: &[&Hand<N>]) -> Option<Self> {
        if of.iter().any(|one| !one.is_new) {
            return None;
        }
        let layers: Option<Vec<_>> = of.iter().map(|one| one.layer.of_point()).collect();
        let track = Track::gather(&of.iter().map(|one| one.layer.guard().track()).collect::<Vec<_>>())?;
        Some(Self { layer: SafetyLayer::gather(&layers?)?, track, last: None })
    }

    /// Step one tick without missed ticks, like [`Hand::tick`]: x in m, V in m/s if measured, the request in
    /// N, and the ladder's `gain`.
    ///
    /// Also returns the mask of valid lanes: their numbers are valid and lie on the path of the samples. In
    /// the other lanes the scalar hand raises a fault or holds the sample.
    #[inline(always)] // once per tick, from one caller
    pub(crate) fn tick(
        &mut self,
        position: &Axes<N, S>,
        velocity: Option<&Axes<N, S>>,
        requested_force: &Axes<N, S>,
        gain: f64,
    ) -> (Advance<N, S>, S::SimdBool) {
        let requested = self.layer.faded(requested_force, gain);
        let mut passes = is_within(position, Signal::Position.bound())
            & is_within(&requested, Signal::RenderedForce.bound());
        if let Some(velocity) = velocity {
            passes = passes & is_within(velocity, Signal::Velocity.bound());
            if let Some(last) = self.last.replace(*velocity) {
                passes = passes & self.track.is_steady(&last, velocity);
            }
        }
        passes = passes & self.track.step(position, S::one());
        let tick = self.layer.advance(position, velocity, &requested, S::splat(gain));
        (tick, passes & tick.seen().passes())
    }
}

#[cfg(test)]
mod tests {
    use haptether_numeric::{Lanes, WIDTH, pack};
    use haptether_safety::{
        DeviceModel, LayerSettings, LimiterSettings,
        controller::{ControllerKind, SafetySettings},
        estimator::EstimatorKind,
    };
    use nalgebra::SimdValue as _;
    use proptest::prelude::*;

    use super::*;

    fn hand() -> Hand<1> {
        let [mass, viscous, coulomb] = [0.157, -0.005, 0.038].map(Axes::<1>::new);
        let controllers = ControllerKind::ALL.into_iter().collect();
        let settings = LayerSettings {
            device: DeviceModel::new(mass, viscous, coulomb).unwrap(),
            period_s: 1e-3,
            estimator: EstimatorKind::BackwardDifference {},
            safety: SafetySettings { controllers, ..SafetySettings::default() },
            limiter: LimiterSettings { ramp_in_s: 0.0, ..LimiterSettings::default() },
        };
        Hand::new(Layer::new(settings, None).unwrap())
    }

    /// Draw steps, a few of them off the path.
    fn step() -> impl Strategy<Value = f64> {
        prop_oneof![40 => -1e-4..1e-4, 1 => -0.05..0.05, 1 => Just(f64::NAN), 1 => Just(2e3)]
    }

    /// Draw numbers, a few of them invalid or with invalid results.
    fn number(size: f64) -> impl Strategy<Value = f64> {
        let odd = prop_oneof![Just(f64::NAN), Just(f64::INFINITY), Just(2e3), Just(-900.0), Just(2e4)];
        prop_oneof![60 => -size..size, 1 => odd]
    }

    proptest! {
        /// A lane is valid only if its scalar hand raises no fault and holds no sample; results are then
        /// bit-identical.
        #[test]
        fn lanes_equal_scalar_hands(
            ticks in prop::collection::vec(
                prop::collection::vec((step(), step(), number(5.0)), WIDTH),
                1..40,
            ),
            measures_velocity in any::<bool>(),
            gain in 0.0..=1.0f64,
        ) {
            let mut alone = vec![hand(); WIDTH];
            let mut beside =
                HandLanes::<1, Lanes>::gather(&alone.iter().collect::<Vec<_>>()).unwrap();
            let mut running = [true; WIDTH];
            let mut at = [(0.0, 0.0); WIDTH];
            for tick in &ticks {
                // Positions accumulate from tick to tick, and so do velocities.
                let tick = &tick.iter().zip(&mut at).map(|((dx, dv, force), (x, v))| {
                    (*x, *v) = (*x + dx, *v + 1e3 * dv);
                    (*x, *v, *force)
                }).collect::<Vec<_>>();
                let lanes = |which: fn(&(f64, f64, f64)) -> f64| {
                    pack::<_, Axes<1, Lanes>>(tick, |of| Axes::<1>::new(which(of))).unwrap()
                };
                let [x, v, force] = [lanes(|of| of.0), lanes(|of| of.1), lanes(|of| of.2)];
                let (decided, passes) = beside.tick(&x, measures_velocity.then_some(&v), &force, gain);
                for lane in (0..WIDTH).filter(|lane| running[*lane]).collect::<Vec<_>>() {
                    let (x, v, force) = tick[lane];
                    let velocity = measures_velocity.then_some(Axes::<1>::new(v));
                    let reading = MasterReading::point(Axes::<1>::new(x), velocity);
                    let input = HandInput { requested_force: Axes::<1>::new(force), gain, ..HandInput::idle() };
                    let (single, _) = alone[lane].tick(&reading, &input);
                    let stays = single.fault.is_none() && !alone[lane].guard().holds();
                    // A lane may be invalid although the scalar hand returns to the path.
                    prop_assert!(stays || !passes.extract(lane), "lane {lane}: {:?}", single.fault);
                    running[lane] = passes.extract(lane);
                    if running[lane] {
                        prop_assert_eq!(format!("{:?}", decided.lane(lane)), format!("{:?}", single));
                    }
                }
            }
        }
    }
}
