//! Trigger that leads a gripper at the master, and the led gripper at the slave.

use haptether_master::{DeviceParameters, Hand, ModelError as MasterError, SimulatedMaster};
use haptether_safety::{Guard, Sample, SampleBounds};
use haptether_slave::{
    Axes, GripperCommand, GripperSample, GripperSettings, ModelError, Series, SimulatedGripper,
};

use crate::coupling::GripperFollower;

/// Trigger that leads the gripper: 0 open to 1 closed.
#[derive(Clone, Debug, PartialEq)]
pub enum Trigger {
    /// Operator who moves it since engagement, along straight lines.
    Simulated {
        /// Course of positions.
        course: Series<1>,
        /// Engagement of the sides in ns.
        engaged_ns: Option<u64>,
    },
    /// Model with a motor, held by the finger of a modelled operator.
    Held(Box<HeldTrigger>),
    /// Position read by a device's driver; `None` without a trigger.
    Driven(Option<f64>),
}

impl Trigger {
    /// Create a simulated trigger: increasing times in s since engagement, with positions.
    pub fn simulated(course: &[[f64; 2]]) -> Result<Self, ModelError> {
        let (times, positions): (Vec<_>, Vec<_>) = course.iter().map(|[at_s, to]| (*at_s, *to)).unzip();
        for position in &positions {
            let allowed = "0 (open) to 1 (closed)";
            if !(0.0..=1.0).contains(position) {
                return Err(ModelError { name: "operator.trigger", seen: *position, allowed });
            }
        }
        let course = Series::new(times, positions.into_iter().map(Axes::<1>::new).collect())?;
        Ok(Self::Simulated { course, engaged_ns: None })
    }

    pub(crate) fn begin(&mut self, now_ns: u64) {
        if let Self::Held(held) = self {
            held.device.begin(now_ns);
        }
    }

    pub(crate) fn position(&mut self, now_ns: u64) -> Option<f64> {
        match self {
            Self::Simulated { course, engaged_ns } => {
                let since_ns = engaged_ns.map_or(0, |engaged_ns| now_ns.saturating_sub(engaged_ns));
                Some(course.at(since_ns as f64 * 1e-9)[0])
            }
            Self::Held(held) => Some(held.read(now_ns)),
            Self::Driven(position) => *position,
        }
    }

    /// Exerts `force_n` on a model's finger, positive closing.
    pub(crate) fn write(&mut self, force_n: f64) {
        if let Self::Held(held) = self {
            held.device.write(&Axes::<1>::new(force_n));
        }
    }

    /// True velocity and force of a model.
    pub(crate) fn truth(&self) -> Option<FingerTruth> {
        let Self::Held(held) = self else { return None };
        let [velocity, finger_force_n] = [held.device.velocity()[0], held.device.hand_force()[0]];
        Some(FingerTruth { velocity, finger_force_n })
    }

    pub(crate) fn engaged(&mut self, at_ns: u64) {
        match self {
            Self::Simulated { engaged_ns, .. } => _ = engaged_ns.get_or_insert(at_ns),
            Self::Held(held) => held.device.set_waiting(false),
            Self::Driven(_) => {}
        }
    }
}

/// Positions of a trigger that leads a gripper, 0 open to 1 closed, without outliers: [`Guard`].
///
/// Bounds of a point over 30 mm, read by 8 bits. The speed is unbounded: a driver may use a button, and the gripper
/// limits itself.
#[derive(Clone, Debug)]
pub(crate) struct LeadingTrigger {
    guard: Guard<1>,
}

impl LeadingTrigger {
    /// Create the filter for ticks of `period_s`, before the first position.
    pub(crate) fn new(period_s: f64) -> Self {
        let bounds = SampleBounds {
            speed: f64::INFINITY,
            velocity_change: SampleBounds::LINEAR.velocity_change / 0.03,
            quantum: 1.0 / 256.0,
            per_axis: false,
        };
        Self { guard: Guard::new(bounds, SampleBounds::UNBOUNDED, period_s) }
    }

    /// Return the position, or its prediction while held; `ticks` after the previous.
    pub(crate) fn filtered(&mut self, position: f64, ticks: f64) -> f64 {
        let sample = Sample::point(&Axes::<1>::new(position), None);
        // Without a bound on the speed nothing is refused.
        let _ = self.guard.pass(&sample, ticks);
        self.guard.sample_in_use().position[0].clamp(0.0, 1.0)
    }

    pub(crate) fn outliers(&self) -> u64 {
        self.guard.outliers()
    }
}

/// True motion of a trigger.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct FingerTruth {
    /// True velocity in m/s; positive closes.
    pub(crate) velocity: f64,
    /// True force of the finger in N.
    pub(crate) finger_force_n: f64,
}

/// A trigger as a one-axis device between stops, open at 0 and closed at `travel_m`, with the finger that holds it.
#[derive(Clone, Debug, PartialEq)]
pub struct HeldTrigger {
    device: SimulatedMaster<1>,
    travel_m: f64,
}

impl HeldTrigger {
    /// Create a trigger at rest at the start of the finger's path in m, until the sides engage.
    pub fn new(device: DeviceParameters<1>, travel_m: f64, finger: Hand<1>) -> Result<Self, MasterError> {
        let stops = (Axes::<1>::zeros(), Axes::<1>::new(travel_m));
        let mut device = SimulatedMaster::new(DeviceParameters { stops, ..device }, finger, 0)?;
        device.set_waiting(true);
        Ok(Self { device, travel_m })
    }

    /// Position, 0 open to 1 closed.
    fn read(&mut self, now_ns: u64) -> f64 {
        // An encoder may round beyond a stop.
        (self.device.read(now_ns).position[0] / self.travel_m).clamp(0.0, 1.0)
    }
}

/// Order to the driver of a gripper.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum GripperOrder {
    /// Stay, and keep the grip force.
    Hold,
    /// Move to a position.
    Move(GripperCommand),
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Jaws {
    Simulated(SimulatedGripper),
    /// As read by the driver.
    Driven(GripperSample),
}

/// A gripper that follows the master's trigger while coupled, and otherwise keeps its grip.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SlaveGripper {
    jaws: Jaws,
    follower: GripperFollower,
    sample: GripperSample,
    order: GripperOrder,
    /// Time of the last `lead` in ns.
    led_ns: Option<u64>,
}

impl SlaveGripper {
    /// Create a model.
    pub fn simulated(settings: GripperSettings) -> Result<Self, ModelError> {
        Ok(Self::new(Jaws::Simulated(SimulatedGripper::new(settings)?), &settings))
    }

    /// Create a gripper whose driver is elsewhere; unknown until read.
    pub fn driven(settings: GripperSettings) -> Result<Self, ModelError> {
        let settings = settings.checked()?;
        let at = GripperSample { position: f64::NAN, ..GripperSample::default() };
        Ok(Self::new(Jaws::Driven(at), &settings))
    }

    fn new(jaws: Jaws, settings: &GripperSettings) -> Self {
        Self {
            jaws,
            follower: GripperFollower::new(settings),
            sample: GripperSample::default(),
            order: GripperOrder::Hold,
            led_ns: None,
        }
    }

    /// Store the sample of its driver.
    pub fn take(&mut self, read: GripperSample) {
        if let Jaws::Driven(sample) = &mut self.jaws {
            *sample = read;
        }
    }

    /// Set where a model's jaws meet a rigid object.
    pub(crate) fn set_object(&mut self, object: Option<f64>) {
        if let Jaws::Simulated(gripper) = &mut self.jaws {
            gripper.set_object(object);
        }
    }

    /// Return the sample at `now_ns`.
    pub(crate) fn read(&mut self, now_ns: u64) -> GripperSample {
        self.sample = match &mut self.jaws {
            Jaws::Simulated(gripper) => gripper.read(now_ns),
            Jaws::Driven(sample) => *sample,
        };
        self.sample
    }

    /// Follow `trigger`, 0 open to 1 closed; keeps the grip if `None`.
    pub(crate) fn lead(&mut self, now_ns: u64, trigger: Option<f64>) {
        let elapsed_s = now_ns.saturating_sub(self.led_ns.replace(now_ns).unwrap_or(now_ns)) as f64 * 1e-9;
        self.order = match self.follower.step(trigger, &self.sample, elapsed_s) {
            Some(command) => GripperOrder::Move(command),
            None => GripperOrder::Hold,
        };
        if let Jaws::Simulated(gripper) = &mut self.jaws {
            match self.order {
                GripperOrder::Move(command) => gripper.write(command),
                GripperOrder::Hold => gripper.hold(),
            }
        }
    }

    /// Return whether the trigger leads it.
    pub(crate) fn follows(&self) -> bool {
        self.follower.follows()
    }

    /// Order to its driver after this tick.
    pub fn order(&self) -> &GripperOrder {
        &self.order
    }

    /// Sample of this tick, and the last command, 0 open to 1 closed.
    pub fn state(&self) -> (GripperSample, Option<f64>) {
        (self.sample, self.follower.position())
    }
}

#[cfg(test)]
mod tests {
    use haptether_safety::{
        DeviceModel, LimiterSettings, controller::SafetySettings, estimator::EstimatorKind,
    };

    use super::*;
    use crate::{
        Clutch, DrivenMaster, LadderSettings, MasterEndpoint, MasterSettings, MasterSide, Side as _,
    };

    const MS: u64 = 1_000_000;

    /// A trigger at mid-travel that nobody holds.
    fn free() -> Trigger {
        let device = DeviceParameters::ideal(0.05, 0.0, 0.0);
        let held = HeldTrigger::new(device, 0.03, Hand::absent(Axes::<1>::new(0.015)).unwrap()).unwrap();
        Trigger::Held(Box::new(held))
    }

    #[test]
    fn held_trigger_moves_between_its_stops() {
        let mut trigger = free();
        trigger.begin(5 * MS);
        assert_eq!(trigger.position(5 * MS), Some(0.5));
        trigger.write(-2.0);
        // x = F t^2 / 2 m: 0.1 of 30 mm in 12.2 ms, all of its half in 27.4 ms.
        let way = 0.5 * 2.0 / 0.05 * 0.01 * 0.01 / 0.03;
        assert!((trigger.position(15 * MS).unwrap() - (0.5 - way)).abs() < 1e-12);
        assert!((trigger.truth().unwrap().velocity + 2.0 / 0.05 * 0.01).abs() < 1e-12);
        assert_eq!(trigger.position(40 * MS), Some(0.0));
        trigger.write(f64::NAN);
        assert_eq!(trigger.position(100 * MS), Some(0.0));
    }

    #[test]
    fn side_at_rest_leaves_trigger_without_force() {
        let endpoint = MasterEndpoint::new(&MasterSettings {
            period_ns: MS,
            run_id: 1,
            device: DeviceModel::phantom_desktop(),
            estimator: EstimatorKind::default(),
            safety: SafetySettings::default(),
            limiter: LimiterSettings::default(),
            force_scale: 1.0,
            ladder: LadderSettings::default(),
        })
        .unwrap();
        let plant = DrivenMaster::<1>::default();
        let mut side = MasterSide::new(plant, endpoint, Clutch::Once).unwrap().with_trigger(Some(free()));
        side.begin(0);
        side.trigger.as_mut().unwrap().write(-2.0);
        side.rest();
        assert_eq!(side.trigger.as_mut().unwrap().position(100 * MS), Some(0.5));
    }
}
