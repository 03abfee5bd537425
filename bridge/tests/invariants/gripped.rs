//! A gripper and the trigger that leads it: drawn, and what must never be of them.

use haptether_bridge::{GripperOrder, LedGripper, TickTime, Trigger};
use haptether_slave::{GripperCommand, GripperSample, GripperSettings, SimulatedGripper};

use crate::{
    drawn::{Broken, MS, Numbers},
    spied::{ROUNDING, Watch},
};

/// How near a trigger must be to the last command to take the gripper along.
const PICKS_UP_WITHIN: f64 = 0.02;

/// Of a gripper and its trigger.
#[derive(Clone, Debug)]
pub(crate) struct DrawnGripper {
    pub(crate) settings: GripperSettings,
    /// Whether drivers elsewhere read trigger and gripper.
    pub(crate) is_driven: [bool; 2],
    /// Time in s and position of the trigger.
    pub(crate) course: Vec<[f64; 2]>,
    pub(crate) broken: [Option<Broken>; 2],
}

impl DrawnGripper {
    pub(crate) fn draw(n: &mut Numbers, end_ns: u64) -> Self {
        let mut at_s = 0.0;
        let course = (0..n.whole(1, 6))
            .map(|_| {
                at_s += n.one_of(&[1e-3, 0.02, 0.1]) * n.real(0.5, 1.5);
                [at_s, n.one_of(&[0.0, 1.0, n.clone().real(0.0, 1.0)])]
            })
            .collect();
        let position = n.one_of(&[0.0, 0.0, 0.3]);
        Self {
            settings: GripperSettings {
                position,
                speed: n.one_of(&[2.0, 10.0, 50.0]),
                force_n: n.real(0.0, 100.0),
                object: n.chance(0.7).then(|| position + n.real(0.0, 0.3)),
            },
            is_driven: [n.chance(0.5), n.chance(0.5)],
            course,
            broken: [Broken::draw(n, end_ns), Broken::draw(n, end_ns)],
        }
    }

    /// What leads it.
    pub(crate) fn trigger(&self) -> Trigger {
        if self.is_driven[0] { Trigger::Driven(None) } else { Trigger::simulated(&self.course).unwrap() }
    }

    /// What is led.
    pub(crate) fn led(&self) -> LedGripper {
        let new = if self.is_driven[1] { LedGripper::driven } else { LedGripper::simulated };
        new(self.settings).unwrap()
    }

    /// The trigger as its driver has read it; none of a trigger that is a model.
    pub(crate) fn read_trigger(&self, now_ns: u64) -> Option<Trigger> {
        if !self.is_driven[0] {
            return None;
        }
        let at_s = now_ns as f64 * 1e-9;
        // Before the first it says nothing.
        let level =
            self.course.iter().rev().find(|[from_s, _]| *from_s <= at_s).map(|[_, position]| *position);
        Some(Trigger::Driven(Broken::at(self.broken[0], now_ns).or(level)))
    }
}

/// What was seen of grippers.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct SeenGripper {
    /// Ticks at which one was led.
    pub(crate) led: u64,
    /// Ticks at which one held something while nobody led it.
    pub(crate) kept: u64,
    /// Ticks at which one waited, coupled, for the trigger.
    pub(crate) waited: u64,
    /// How often one met something.
    pub(crate) grips: u64,
    pub(crate) broken: u64,
}

impl SeenGripper {
    pub(crate) fn and(&self, other: &Self) -> Self {
        Self {
            led: self.led + other.led,
            kept: self.kept + other.kept,
            waited: self.waited + other.waited,
            grips: self.grips + other.grips,
            broken: self.broken + other.broken,
        }
    }

    /// What a run of ten thousand scenes must have met.
    pub(crate) fn all(&self) -> [u64; 5] {
        [self.led, self.kept, self.waited, self.grips, self.broken]
    }
}

/// What a gripper is held to, and the driver of one that is elsewhere.
#[derive(Clone, Debug)]
pub(crate) struct GripperWatch {
    settings: GripperSettings,
    /// Jaws of a driver, that do what it is ordered.
    jaws: Option<SimulatedGripper>,
    broken: Option<Broken>,
    now_ns: u64,
    command: Option<f64>,
    /// The trigger as last heard.
    trigger: Option<f64>,
    was_led: bool,
    /// As measured, if that can be.
    sample: Option<GripperSample>,
}

impl GripperWatch {
    pub(crate) fn new(drawn: &DrawnGripper) -> Self {
        let settings = drawn.settings;
        let jaws = drawn.is_driven[1].then(|| SimulatedGripper::new(settings).unwrap());
        let broken = drawn.broken[1].filter(|_| jaws.is_some());
        Self { settings, jaws, broken, now_ns: 0, command: None, trigger: None, was_led: false, sample: None }
    }

    /// Its driver reads before the tick.
    pub(crate) fn read(&mut self, now_ns: u64, gripper: &mut LedGripper) {
        let Some(jaws) = &mut self.jaws else { return };
        let sample = jaws.read(now_ns);
        let broken = Broken::at(self.broken, now_ns);
        gripper.take(match broken {
            Some(value) if (now_ns / MS).is_multiple_of(2) => GripperSample { position: value, ..sample },
            Some(value) => GripperSample { velocity: value, force_n: value, ..sample },
            None => sample,
        });
    }

    /// After the tick: `trigger` is what the peer's newest frame says.
    pub(crate) fn tick(
        &mut self,
        watch: &mut Watch,
        time: TickTime,
        gripper: &LedGripper,
        trigger: Option<f64>,
    ) {
        let elapsed_s = (time.now_ns - std::mem::replace(&mut self.now_ns, time.now_ns)) as f64 * 1e-9;
        let ((sample, command), order) = (gripper.state(), *gripper.order());
        let is_broken = Broken::at(self.broken, time.now_ns).is_some();
        let coupled = watch.state.is_coupled();
        let heard = std::mem::replace(&mut self.trigger, trigger.filter(|_| coupled));
        let before = std::mem::replace(&mut self.command, command);
        let was_led = std::mem::replace(&mut self.was_led, matches!(order, GripperOrder::Move(_)));
        let sampled = std::mem::replace(&mut self.sample, (!is_broken).then_some(sample));
        let state = watch.state;
        watch.hold(coupled || order == GripperOrder::Hold, time, || format!("{order:?} in {state:?}"));
        let from = before.unwrap_or(sample.position);
        if let GripperOrder::Move(GripperCommand { position, speed, force_n }) = order {
            let GripperSettings { speed: fastest, force_n: strongest, .. } = self.settings;
            let fits = (0.0..=1.0).contains(&position) && (speed, force_n) == (fastest, strongest);
            watch.hold(fits && command == Some(position), time, || format!("{order:?}, {command:?}"));
            let (step, most) = ((position - from).abs(), fastest * elapsed_s * (1.0 + ROUNDING) + 1e-12);
            watch.hold(step <= most, time, || format!("gripper commanded by {step} > {most}"));
            // What it held when the two came together, it must not let fall because the trigger was elsewhere.
            let is_near = trigger.is_some_and(|trigger| {
                (trigger - from).abs() <= PICKS_UP_WITHIN
                    || heard.is_some_and(|heard| (heard - from) * (trigger - from) < 0.0)
            });
            watch.hold(was_led || is_near, time, || format!("taken along from {from} by {trigger:?}"));
        } else {
            let is_kept = command == before || (before.is_none() && command == Some(sample.position));
            watch.hold(is_kept, time, || format!("command {before:?} to {command:?} without an order"));
        }
        // Not led since the tick before, the jaws stand, and what they hold they hold.
        if let (false, Some(last), Some(now)) = (was_led, sampled, self.sample) {
            let same = last.position == now.position && last.holds_object == now.holds_object;
            watch.hold(same, time, || format!("{last:?} to {now:?} while nobody led it, in {state:?}"));
            let grip = !now.holds_object || now.force_n == last.force_n;
            watch.hold(grip, time, || format!("{last:?} to {now:?}: another grip"));
        }
        if let (Some(jaws), GripperOrder::Move(command)) = (&mut self.jaws, order) {
            jaws.write(command);
        } else if let Some(jaws) = &mut self.jaws {
            jaws.hold();
        }
        let holds = sample.holds_object;
        let seen = &mut watch.seen.gripper;
        seen.led += u64::from(self.was_led);
        seen.kept += u64::from(!coupled && holds);
        seen.waited += u64::from(coupled && !self.was_led && trigger.is_some());
        seen.grips += u64::from(holds && sampled.is_some_and(|last| !last.holds_object));
        seen.broken += u64::from(is_broken);
    }
}
