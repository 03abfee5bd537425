//! Gripper and its trigger, with or without force feedback: drawn values and invariants.

use haptether_bridge::{
    FingerTick, GripperOrder, HeldTrigger, LadderState, SlaveGripper, TickTime, Trigger, TriggerSettings,
    coupling::GripperState,
};
use haptether_master::{DeviceParameters, Hand, Leg, LegShape, Path};
use haptether_safety::{
    ActiveLimits, Axes, DeviceModel, LimiterSettings, SafetyTick,
    controller::{ControllerKind, SafetySettings, Tripped},
};
use haptether_slave::{GripperCommand, GripperSample, GripperSettings, SimulatedGripper};

use super::{
    drawn::{Broken, Drawn, MS, Numbers, estimator, safety},
    spied::{ROUNDING, Watch},
};

/// Largest distance between trigger and last command at which the trigger takes over the gripper.
const PICKS_UP_WITHIN: f64 = 0.02;

/// Trigger with force feedback.
#[derive(Clone, Copy, Debug)]
pub(crate) struct DrawnFelt {
    pub(crate) settings: TriggerSettings,
    mass_kg: f64,
    /// Stiffness and damping of the finger.
    finger: [f64; 2],
}

impl DrawnFelt {
    fn draw(n: &mut Numbers) -> Self {
        let mass_kg = n.real(0.02, 0.2);
        // Sometimes the travel is so long that no finger could make a jump along it.
        let travel_m = if n.chance(0.1) { 1.0 } else { n.real(5e-3, 5e-2) };
        let max_force_n = n.real(0.5, 5.0);
        let scaled = safety(n).at_scale(max_force_n / 7.9, travel_m / 0.14);
        // Largest damping that a loop of the longest period can apply.
        let most = mass_kg / (5.0 * 3e-3) * 0.99;
        let settings = TriggerSettings {
            travel_m,
            device: DeviceModel::uniform(mass_kg, n.real(0.0, 0.5), n.one_of(&[0.0, 0.1])).unwrap(),
            estimator: estimator(n),
            safety: SafetySettings {
                damping: scaled.damping.min(most),
                pc_max_damping: scaled.pc_max_damping.min(most),
                ..scaled
            },
            limiter: LimiterSettings {
                max_force_n,
                max_slew_n_per_s: n.one_of(&[10.0, 100.0, 3000.0]),
                max_power_w: n.one_of(&[0.02, 5.0, 1e4]),
                ramp_in_s: 0.0,
            },
            force_scale: n.one_of(&[0.01, 0.05, 1.0]),
        };
        Self { settings, mass_kg, finger: [n.real(20.0, 800.0), n.real(0.0, 20.0)] }
    }

    /// Build a model of the trigger with a finger that follows `course`.
    fn held(&self, course: &[[f64; 2]]) -> HeldTrigger {
        let (travel_m, [stiffness, damping]) = (self.settings.travel_m, self.finger);
        let (mut from_s, at) = (0.0, |position: f64| Axes::<1>::new(position * travel_m));
        let legs = course.iter().map(|&[until_s, position]| {
            let duration_s = until_s - std::mem::replace(&mut from_s, until_s);
            Leg { duration_s, end: at(position), shape: LegShape::Linear }
        });
        let path = Path::new(at(0.0), legs.collect()).unwrap();
        let finger = Hand::new(stiffness, damping, f64::INFINITY, path, None).unwrap();
        let device =
            DeviceParameters { measures_velocity: false, ..DeviceParameters::ideal(self.mass_kg, 0.0, 0.0) };
        HeldTrigger::new(device, travel_m, finger).unwrap()
    }
}

/// Drawn gripper with its trigger.
#[derive(Clone, Debug)]
pub(crate) struct DrawnGripper {
    pub(crate) settings: GripperSettings,
    /// True if a driver reads the trigger, and the gripper.
    pub(crate) is_driven: [bool; 2],
    /// Time in s and position of the trigger.
    pub(crate) course: Vec<[f64; 2]>,
    pub(crate) broken: [Option<Broken>; 2],
    pub(crate) felt: Option<DrawnFelt>,
}

impl DrawnGripper {
    pub(crate) fn draw(n: &mut Numbers, end_ns: u64) -> Self {
        let mut at_s = 0.0;
        let course = (0..n.integer(1, 6))
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
            felt: n.chance(0.5).then(|| DrawnFelt::draw(n)),
        }
    }

    /// Return the trigger that leads the gripper.
    pub(crate) fn trigger(&self) -> Trigger {
        match &self.felt {
            _ if self.is_driven[0] => Trigger::Driven(None),
            Some(felt) => Trigger::Held(Box::new(felt.held(&self.course))),
            None => Trigger::simulated(&self.course).unwrap(),
        }
    }

    /// Return the led gripper.
    pub(crate) fn led(&self) -> SlaveGripper {
        let new = if self.is_driven[1] { SlaveGripper::driven } else { SlaveGripper::simulated };
        new(self.settings).unwrap()
    }

    /// Return the trigger as read by its driver; none for a modelled trigger.
    pub(crate) fn read_trigger(&self, now_ns: u64) -> Option<Trigger> {
        if !self.is_driven[0] {
            return None;
        }
        let at_s = now_ns as f64 * 1e-9;
        // Before the first point of the course the position is unknown.
        let level =
            self.course.iter().rev().find(|[from_s, _]| *from_s <= at_s).map(|[_, position]| *position);
        Some(Trigger::Driven(Broken::at(self.broken[0], now_ns).or(level)))
    }
}

/// Coverage of grippers.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct SeenGripper {
    /// Ticks at which a gripper was led.
    pub(crate) led: u64,
    /// Ticks at which a gripper held an object without being led.
    pub(crate) kept: u64,
    /// Ticks at which a coupled gripper waited for the trigger.
    pub(crate) waited: u64,
    /// Contacts with an object.
    pub(crate) grips: u64,
    pub(crate) broken: u64,
    /// Ticks with force on the finger: coupled, fading, and while a controller had tripped.
    pub(crate) felt: u64,
    pub(crate) faded: u64,
    pub(crate) tripped: u64,
    /// Ticks with a held object but no force: trigger unknown, or jaws not following it.
    pub(crate) unfelt: [u64; 2],
    pub(crate) faults: u64,
}

impl SeenGripper {
    pub(crate) fn and(&self, other: &Self) -> Self {
        Self {
            led: self.led + other.led,
            kept: self.kept + other.kept,
            waited: self.waited + other.waited,
            grips: self.grips + other.grips,
            broken: self.broken + other.broken,
            felt: self.felt + other.felt,
            faded: self.faded + other.faded,
            tripped: self.tripped + other.tripped,
            unfelt: std::array::from_fn(|why| self.unfelt[why] + other.unfelt[why]),
            faults: self.faults + other.faults,
        }
    }

    /// Return the counts that must be positive in a run of ten thousand scenes.
    pub(crate) fn all(&self) -> [u64; 11] {
        let Self { led, kept, waited, grips, broken, felt, faded, tripped, faults, .. } = *self;
        let [unknown, apart] = self.unfelt;
        [led, kept, waited, grips, broken, felt, faded, tripped, unknown, apart, faults]
    }
}

/// Invariants of a gripper, and the driver of a driven one.
#[derive(Clone, Debug)]
pub(crate) struct GripperWatch {
    settings: GripperSettings,
    /// Jaws of a driver, which follow their orders.
    jaws: Option<SimulatedGripper>,
    broken: Option<Broken>,
    now_ns: u64,
    command: Option<f64>,
    /// Trigger as last received.
    trigger: Option<f64>,
    was_led: bool,
    /// Last measured sample, if the sensor was not faulty.
    sample: Option<GripperSample>,
}

impl GripperWatch {
    pub(crate) fn new(drawn: &DrawnGripper) -> Self {
        let settings = drawn.settings;
        let jaws = drawn.is_driven[1].then(|| SimulatedGripper::new(settings).unwrap());
        let broken = drawn.broken[1].filter(|_| jaws.is_some());
        Self { settings, jaws, broken, now_ns: 0, command: None, trigger: None, was_led: false, sample: None }
    }

    /// Read the jaws before the tick, as a driver does.
    pub(crate) fn read(&mut self, now_ns: u64, gripper: &mut SlaveGripper) {
        let Some(jaws) = &mut self.jaws else { return };
        let sample = jaws.read(now_ns);
        let broken = Broken::at(self.broken, now_ns);
        gripper.take(match broken {
            Some(value) if (now_ns / MS).is_multiple_of(2) => GripperSample { position: value, ..sample },
            Some(value) => GripperSample { velocity: value, force_n: value, ..sample },
            None => sample,
        });
    }

    /// Check a tick; `trigger` is the position in the newest frame of the peer.
    pub(crate) fn tick(
        &mut self,
        watch: &mut Watch,
        time: TickTime,
        gripper: &SlaveGripper,
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
            // A trigger at another position must not make the gripper drop an object held at engagement.
            let is_near = trigger.is_some_and(|trigger| {
                (trigger - from).abs() <= PICKS_UP_WITHIN
                    || heard.is_some_and(|heard| (heard - from) * (trigger - from) < 0.0)
            });
            watch.hold(was_led || is_near, time, || format!("taken along from {from} by {trigger:?}"));
        } else {
            let is_kept = command == before || (before.is_none() && command == Some(sample.position));
            watch.hold(is_kept, time, || format!("command {before:?} to {command:?} without an order"));
        }
        // Jaws that were not led since the last tick keep their position and their object.
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

/// Values at a tick of a trigger with force feedback.
#[derive(Clone, Copy, Debug)]
pub(crate) struct FingerTickSeen {
    pub(crate) felt: Option<SafetyTick<1>>,
    pub(crate) recorded: FingerTick,
    /// Position that leads the gripper; NaN if unknown.
    pub(crate) position: f64,
    /// Jaws in the newest frame of the peer.
    pub(crate) jaws: Option<GripperState>,
    /// True if the loop stalled before the tick.
    pub(crate) stalled: bool,
}

/// Invariants of the force on a finger.
#[derive(Clone, Copy, Debug)]
pub(crate) struct FingerWatch {
    settings: TriggerSettings,
    /// True if a button leads the gripper instead of the finger.
    is_button: bool,
    period_s: f64,
    /// Largest rise per tick of the share of the jaw force.
    rise: f64,
    /// Upper bound of this share.
    share: f64,
    /// True if the trigger was unknown at some time since engagement.
    is_lost: bool,
    force_n: f64,
}

impl FingerWatch {
    pub(crate) fn new(drawn: &Drawn) -> Option<Self> {
        let settings = drawn.gripper.as_ref()?.felt?.settings;
        let period_s = drawn.periods_ns[0] as f64 * 1e-9;
        Some(Self {
            settings,
            is_button: drawn.buttons.as_ref().is_some_and(|buttons| buttons.settings.gripper.is_some()),
            period_s,
            rise: drawn.periods_ns[0] as f64 / drawn.ladder.fade_in_ns as f64,
            share: 0.0,
            is_lost: false,
            force_n: 0.0,
        })
    }

    /// Check a tick. The force only opens, and is at most the share of the jaw force and within its bounds. It is zero
    /// if the position is unknown.
    pub(crate) fn tick(&mut self, watch: &mut Watch, time: TickTime, tick: &FingerTickSeen) {
        let FingerTickSeen { felt, recorded, position, jaws, stalled } = *tick;
        let (state, gain, coupled) = (watch.state, watch.gain, watch.state.is_coupled());
        let Some(felt) = felt else {
            return watch.hold(false, time, || "a trigger with a motor without a force".into());
        };
        let before_n = std::mem::replace(&mut self.force_n, felt.device_force[0]);
        let (force_n, rendered_n) = (self.force_n, felt.rendered_force[0]);
        let safety_n = felt.intervention.safety_force[0];
        let is_recorded = (recorded.device_force, recorded.rendered_force) == (force_n, rendered_n);
        watch.hold(is_recorded, time, || format!("{recorded:?} recorded of {felt:?}"));

        let is_known = !self.is_button && !position.is_nan();
        let follows = jaws.is_some_and(|jaws| jaws.follows);
        self.is_lost = coupled && (self.is_lost || !is_known);
        if stalled || !is_known {
            self.share = 0.0;
        }
        self.share = if coupled && follows && is_known && !self.is_lost {
            (self.share + self.rise).min(1.0)
        } else if coupled || gain == 0.0 {
            0.0
        } else {
            self.share
        };
        let pressing_n = jaws.filter(|jaws| jaws.holds_object).map_or(0.0, |jaws| jaws.force_n);
        let share = self.share;
        let most_n = self.settings.force_scale * pressing_n * share * gain * (1.0 + ROUNDING);
        watch.hold((-most_n..=0.0).contains(&rendered_n), time, || {
            format!(
                "{rendered_n} N rendered to the finger of {jaws:?}, share {share}, gain {gain}, {state:?}"
            )
        });

        let LimiterSettings { max_force_n, max_slew_n_per_s, .. } = self.settings.limiter;
        let fits = force_n.abs() <= max_force_n * (1.0 + ROUNDING);
        watch.hold(fits, time, || format!("{force_n} N on the finger, beyond {max_force_n}"));
        let unloads = force_n * before_n >= 0.0;
        let growth_n = if unloads { force_n.abs() - before_n.abs() } else { force_n.abs() };
        let by_power = felt.acted.bits() & ActiveLimits::POWER.bits() != 0;
        let most_n = max_slew_n_per_s * self.period_s * (1.0 + ROUNDING) + 1e-12;
        watch.hold(by_power || growth_n <= most_n, time, || {
            format!("{before_n} to {force_n} N on the finger, by more than {most_n}")
        });
        let dead = gain == 0.0 || state == LadderState::Fault || felt.fault.is_some() || !is_known;
        watch.hold(!dead || force_n == 0.0, time, || {
            format!("{force_n} N on the finger in {state:?}, gain {gain}, at {position}")
        });
        // Without a request and without damping by a controller, the force is zero.
        let is_none = rendered_n == 0.0 && safety_n == 0.0;
        watch.hold(!is_none || force_n == 0.0, time, || format!("{force_n} N on the finger of nothing"));
        let stops = felt.fault.is_none() || state == LadderState::Fault;
        watch.hold(stops, time, || format!("{:?} of the finger in {state:?}", felt.fault));

        let holds = coupled && pressing_n > 0.0;
        let of_pc = Tripped::of(ControllerKind::Pc).bits();
        let seen = &mut watch.seen.gripper;
        seen.felt += u64::from(coupled && force_n != 0.0);
        seen.faded += u64::from(!coupled && force_n != 0.0);
        seen.tripped += u64::from(felt.intervention.tripped.bits() & !of_pc != 0);
        seen.unfelt[0] += u64::from(holds && !is_known);
        seen.unfelt[1] += u64::from(holds && !follows);
        seen.faults += u64::from(felt.fault.is_some());
    }
}
