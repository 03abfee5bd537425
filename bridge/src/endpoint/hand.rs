//! What decides over the force on a hand: the same live, in virtual time, and when a recording is replayed.

use haptether_safety::{
    Advance, Axes, Fault, Real, SafetyLayer, SafetyTick, Signal, controller::ResearchController, is_within,
};

use super::layer::{Layer, MasterReading};
use crate::lanes::padded;

/// What a tick takes over from the one before.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Past {
    /// All of it.
    #[default]
    Kept,
    /// Nothing but a fault: the loop had stalled.
    Stalled,
    /// Nothing: the operator has acknowledged a fault.
    Acknowledged,
}

impl Past {
    /// As it stands in a recording.
    pub fn name(self) -> &'static str {
        match self {
            Self::Kept => "kept",
            Self::Stalled => "stalled",
            Self::Acknowledged => "acknowledged",
        }
    }
}

/// What decides over the force of a tick beside what the device measures.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HandInput<const N: usize> {
    /// `F_e` in N of the newest frame; zero before the first.
    pub received_force: Axes<N>,
    /// The moment in N m of the newest frame.
    pub received_torque: Axes<3>,
    /// `F_v` in N that the coupling requests of it.
    pub requested_force: Axes<N>,
    /// The torque in N m that it requests.
    pub requested_torque: Axes<3>,
    /// The ladder's share of what is requested.
    pub gain: f64,
    /// Ticks that were left out since the last.
    pub missed: u64,
    /// What is taken over from the last.
    pub past: Past,
    /// A fault that only others can see: of the device, or of the trigger.
    pub fault: Option<Fault>,
}

impl<const N: usize> HandInput<N> {
    /// Nothing is requested, nothing has happened.
    pub fn idle() -> Self {
        Self {
            received_force: Axes::zeros(),
            received_torque: Axes::zeros(),
            requested_force: Axes::zeros(),
            requested_torque: Axes::zeros(),
            gain: 0.0,
            missed: 0,
            past: Past::Kept,
            fault: None,
        }
    }
}

/// The safety layer of a hand, with what it has to know of the last tick.
#[derive(Clone, Debug)]
pub(crate) struct Hand<const N: usize> {
    layer: Layer<N>,
    /// Of the last tick.
    last: Option<MasterReading<N>>,
    period_s: f64,
}

impl<const N: usize> Hand<N> {
    pub(super) fn new(layer: Layer<N>, period_s: f64) -> Self {
        Self { layer, last: None, period_s }
    }

    /// With a controller of the caller's own, of a hand that does not turn; None for one that does.
    pub(super) fn with_research(mut self, controller: Box<dyn ResearchController>) -> Option<Self> {
        self.layer = self.layer.with_research(controller)?;
        Some(self)
    }

    /// One tick.
    #[inline(always)] // what it returns is large, and mostly none
    pub(crate) fn tick(
        &mut self,
        reading: &MasterReading<N>,
        input: &HandInput<N>,
    ) -> (SafetyTick<N>, Option<SafetyTick<3>>) {
        match input.past {
            // Where the position still is none that can be, the layer keeps its fault, and meets it again below.
            Past::Acknowledged => _ = self.layer.reset(reading),
            // What lies before the gap says nothing of what follows it. A position that cannot be is met below.
            Past::Stalled => _ = self.layer.restart(reading),
            Past::Kept => {
                // Before the estimators spread it over their window: no force answers a jump that no device makes.
                if let Err(fault) = self.check_jump(input.missed, reading) {
                    self.layer.fail(fault);
                }
                if input.missed > 0 {
                    self.carry_over(input.missed, reading);
                }
            }
        }
        if let Some(fault) = input.fault {
            // After the reset above: nobody can have acknowledged what shows at this tick only.
            self.layer.fail(fault);
        }
        self.last = Some(*reading);
        let gain = input.gain;
        self.layer.tick(reading, &(input.requested_force * gain), &(input.requested_torque * gain), gain)
    }

    /// Refuses a position that is further from the last than any device moves in the time between.
    fn check_jump(&self, missed: u64, reading: &MasterReading<N>) -> Result<(), Fault> {
        let Some(last) = self.last else { return Ok(()) };
        Signal::Position.check(&reading.position)?;
        let elapsed_s = self.period_s * (missed + 1) as f64;
        Signal::Velocity.check(&((reading.position - last.position) / elapsed_s))
    }

    /// Carries estimator and observers over missed ticks, along a straight line.
    #[inline(never)] // a loop is seldom late
    fn carry_over(&mut self, missed: u64, reading: &MasterReading<N>) {
        if let Some(before) = self.last {
            for tick in 1..=missed {
                self.layer.missed(&before.towards(reading, tick as f64 / (missed + 1) as f64));
            }
        }
    }
}

/// The safety layers of hands of points, side by side, with what they have to know of the last tick.
#[derive(Clone, Debug)]
pub(crate) struct HandLanes<const N: usize, S> {
    layer: SafetyLayer<N, S>,
    last: Option<Axes<N, S>>,
    period_s: f64,
}

impl<const N: usize, S: Real> HandLanes<N, S> {
    /// Of hands before their first tick; lanes that are left over repeat the last one. None where their layers differ in more
    /// than numbers.
    pub(crate) fn gather(of: &[&Hand<N>]) -> Option<Self> {
        let period_s = of.first()?.period_s;
        if of.iter().any(|one| one.last.is_some() || one.period_s.to_bits() != period_s.to_bits()) {
            return None;
        }
        let layers: Option<Vec<_>> = padded(of, S::LANES).map(|one| one.layer.of_point()).collect();
        Some(Self { layer: SafetyLayer::gather(&layers?)?, last: None, period_s })
    }

    /// One tick as that of [`Hand::tick`], of which none was missed before: of x in m and, where it is measured, V in m/s under
    /// what is requested in N and the ladder's `gain`. And where all of its numbers can be: elsewhere the hand meets a fault.
    #[inline(always)] // once a tick, from one place
    pub(crate) fn tick(
        &mut self,
        position: &Axes<N, S>,
        velocity: Option<&Axes<N, S>>,
        requested_force: &Axes<N, S>,
        gain: f64,
    ) -> (Advance<N, S>, S::SimdBool) {
        let requested = requested_force * S::splat(gain);
        let mut passes = is_within(position, Signal::Position.bound())
            & is_within(&requested, Signal::RenderedForce.bound());
        if let Some(velocity) = velocity {
            passes = passes & is_within(velocity, Signal::Velocity.bound());
        }
        if let Some(last) = self.last.replace(*position) {
            let jump = (position - last) / S::splat(self.period_s);
            passes = passes & is_within(&jump, Signal::Velocity.bound());
        }
        let tick = self.layer.advance(position, velocity, &requested, S::splat(gain));
        (tick, passes & tick.seen().passes())
    }
}

#[cfg(test)]
mod tests {
    use haptether_safety::{
        DeviceModel, LayerSettings, LimiterSettings,
        controller::{ControllerKind, SafetySettings},
        estimator::EstimatorKind,
    };
    use nalgebra::SimdValue as _;
    use proptest::prelude::*;

    use super::*;
    use crate::lanes::{Lanes, WIDTH};

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
        Hand::new(Layer::new(settings, None).unwrap(), 1e-3)
    }

    /// Mostly a number that can be, sometimes one of which something that follows from it cannot be.
    fn number(size: f64) -> impl Strategy<Value = f64> {
        let odd = prop_oneof![Just(f64::NAN), Just(f64::INFINITY), Just(2e3), Just(-900.0), Just(2e4)];
        prop_oneof![60 => -size..size, 1 => odd]
    }

    proptest! {
        /// A lane is where its hand would not meet a fault, and decides what that does, to the bit.
        #[test]
        fn hands_in_lanes_are_as_alone(
            ticks in prop::collection::vec(
                prop::collection::vec((number(0.05), number(0.5), number(5.0)), WIDTH),
                1..40,
            ),
            measures_velocity in any::<bool>(),
            gain in 0.0..=1.0f64,
        ) {
            let mut alone = vec![hand(); WIDTH];
            let mut beside =
                HandLanes::<1, Lanes>::gather(&alone.iter().collect::<Vec<_>>()).unwrap();
            let mut running = [true; WIDTH];
            for tick in &ticks {
                let lanes = |which: fn(&(f64, f64, f64)) -> f64| {
                    Axes::<1, Lanes>::new(crate::lanes::packed(tick, which))
                };
                let [x, v, force] = [lanes(|of| of.0), lanes(|of| of.1), lanes(|of| of.2)];
                let (decided, passes) = beside.tick(&x, measures_velocity.then_some(&v), &force, gain);
                for lane in (0..WIDTH).filter(|lane| running[*lane]).collect::<Vec<_>>() {
                    let (x, v, force) = tick[lane];
                    let velocity = measures_velocity.then_some(Axes::<1>::new(v));
                    let reading = MasterReading::point(Axes::<1>::new(x), velocity);
                    let input = HandInput { requested_force: Axes::<1>::new(force), gain, ..HandInput::idle() };
                    let (single, _) = alone[lane].tick(&reading, &input);
                    prop_assert_eq!(passes.extract(lane), single.fault.is_none(), "lane {}: {:?}", lane, single.fault);
                    running[lane] = single.fault.is_none();
                    if running[lane] {
                        prop_assert_eq!(format!("{:?}", decided.lane(lane)), format!("{:?}", single));
                    }
                }
            }
        }
    }
}
