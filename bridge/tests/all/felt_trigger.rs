//! Trigger with force feedback, through both sides and their frames: pick-up, hold, separation and invalid readings.
#![allow(clippy::unwrap_used)] // a test may

use haptether_bridge::{
    ButtonSettings, ButtonWord, Clutch, DrivenMaster, HeldTrigger, LadderSettings, LadderState, LinkTime,
    MasterEndpoint, MasterRecord, MasterSettings, MasterSide, OperatorCommand, Side, SlaveEndpoint,
    SlaveGripper, SlaveSettings, SlaveSide, TickTime, Trigger, TriggerSettings, coupling::CommandBounds,
    wire::MAX_FRAME,
};
use haptether_master::{DeviceParameters, Hand, Leg, LegShape, Path};
use haptether_safety::{
    Axes, DeviceModel, Fault, LimiterSettings, Signal,
    controller::{ControllerKind, SafetySettings},
    estimator::EstimatorKind,
};
use haptether_slave::{GripperSettings, PushShape, Pusher, SimulatedSlave};

use crate::arms::arm_before_wall;

const MS: u64 = 1_000_000;
const JAWS_N: f64 = 40.0;
const SCALE: f64 = 0.05;
const TRAVEL_M: f64 = 0.03;
/// Fades of the ladder in ticks.
const FADE_IN: u64 = 200;
const FADE_OUT: u64 = 75;

fn feedback() -> TriggerSettings {
    TriggerSettings {
        travel_m: TRAVEL_M,
        device: DeviceModel::uniform(0.05, 0.0, 0.0).unwrap(),
        estimator: EstimatorKind::default(),
        safety: SafetySettings::default(),
        limiter: LimiterSettings {
            max_force_n: 5.0,
            max_slew_n_per_s: 20.0,
            max_power_w: 5.0,
            ramp_in_s: 0.0,
        },
        force_scale: SCALE,
    }
}

fn endpoint(safety: SafetySettings, trigger: &TriggerSettings) -> MasterEndpoint<1> {
    MasterEndpoint::new(&MasterSettings {
        period_ns: MS,
        run_id: 1,
        device: DeviceModel::phantom_desktop(),
        estimator: EstimatorKind::default(),
        safety,
        limiter: LimiterSettings::default(),
        force_scale: 1.0,
        ladder: LadderSettings::default(),
    })
    .unwrap()
    .with_trigger(trigger)
    .unwrap()
}

/// Both sides on a wire that may be cut; the jaws start at `jaws` and meet an object at 0.6.
struct Pair {
    master: MasterSide<DrivenMaster<1>, 1>,
    slave: SlaveSide<SimulatedSlave<1>, 1>,
    tick: u64,
    is_cut: bool,
}

impl Pair {
    fn new(trigger: Trigger, jaws: f64) -> Self {
        Self::watched(trigger, jaws, SafetySettings::default(), &feedback())
    }

    fn watched(trigger: Trigger, jaws: f64, safety: SafetySettings, settings: &TriggerSettings) -> Self {
        let master = MasterSide::new(DrivenMaster::default(), endpoint(safety, settings), Clutch::Once)
            .unwrap()
            .with_trigger(Some(trigger));
        let settings = SlaveSettings {
            period_ns: MS,
            run_id: 2,
            position_scale: 1.0,
            bounds: CommandBounds::default(),
            ladder: LadderSettings::default(),
        };
        let pusher = Pusher::shaped(PushShape::Ramp { rise_s: 0.1 }, 0.1, 1e3, Axes::<1>::new(2.0)).unwrap();
        let arm = arm_before_wall(1.0, Some(pusher), 2.0);
        let jaws = GripperSettings { position: jaws, speed: 2.0, force_n: JAWS_N, object: Some(0.6) };
        let slave = SlaveSide::new(arm, SlaveEndpoint::new(&settings).unwrap())
            .with_gripper(Some(SlaveGripper::simulated(jaws).unwrap()));
        Self { master, slave, tick: 0, is_cut: false }
    }

    /// Tick both sides; return the master's record and the force in N at the trigger.
    fn step(&mut self) -> (MasterRecord<1>, f64) {
        let (now_ns, mut buffer) = (self.tick * MS, [0; MAX_FRAME]);
        self.tick += 1;
        let record = self.master.tick(TickTime::at(now_ns));
        let frame = self.master.send(LinkTime::at(now_ns), &mut buffer);
        if !self.is_cut {
            let _ = self.slave.receive(LinkTime::at(now_ns), frame);
        }
        self.slave.tick(TickTime::at(now_ns));
        let frame = self.slave.send(LinkTime::at(now_ns), &mut buffer);
        if !self.is_cut {
            let _ = self.master.receive(LinkTime::at(now_ns), frame);
        }
        (record, self.master.felt().unwrap().device_force[0])
    }

    fn steps(&mut self, ticks: u64) -> (MasterRecord<1>, f64) {
        (0..ticks).map(|_| self.step()).last().unwrap()
    }

    fn lead(&mut self, to: Option<f64>) {
        self.master.trigger = Some(Trigger::Driven(to));
    }

    /// Close the trigger until the jaws hold the object and its whole force is felt.
    fn grip(&mut self) {
        self.lead(Some(0.0));
        self.steps(2 * FADE_IN);
        for n in 0..=400 {
            self.lead(Some(0.002 * f64::from(n)));
            self.step();
        }
        let (record, felt) = self.steps(600);
        assert_eq!(record.state, LadderState::Engaged);
        assert!((felt + SCALE * JAWS_N).abs() < 1e-12, "{felt}");
    }
}

#[test]
fn a_finger_closes_feels_what_is_held_and_balances_it() {
    let legs = vec![
        Leg { duration_s: 0.5, end: Axes::zeros(), shape: LegShape::Linear },
        Leg { duration_s: 0.5, end: Axes::<1>::new(TRAVEL_M), shape: LegShape::Linear },
    ];
    let finger = Hand::new(300.0, 3.0, f64::INFINITY, Path::new(Axes::zeros(), legs).unwrap(), None).unwrap();
    let device = DeviceParameters { measures_velocity: false, ..DeviceParameters::ideal(0.05, 0.0, 0.0) };
    let held = HeldTrigger::new(device, TRAVEL_M, finger).unwrap();
    let mut pair = Pair::new(Trigger::Held(Box::new(held)), 0.0);
    let mut before = 0.0;
    for _ in 0..2500 {
        let (_, felt) = pair.step();
        assert!(felt <= 0.0 && before - felt <= 20.0 * 1e-3 + 1e-12, "{felt} N after {before} N");
        before = felt;
    }
    // K_f (travel - x) = lambda F.
    let (record, felt) = pair.step();
    let expected = 1.0 - SCALE * JAWS_N / 300.0 / TRAVEL_M;
    assert!((felt + SCALE * JAWS_N).abs() < 1e-12 && (record.trigger - expected).abs() < 1e-9);
}

#[test]
fn nothing_is_felt_before_the_gripper_is_picked_up() {
    // The jaws already hold an object, and the trigger is open.
    let mut pair = Pair::new(Trigger::Driven(Some(0.3)), 0.6);
    for _ in 0..1000 {
        let (record, felt) = pair.step();
        assert_eq!(felt, 0.0);
        assert!(pair.tick < 10 || record.state == LadderState::Engaged);
    }
    pair.lead(Some(0.7));
    assert_eq!(pair.step().1, 0.0);
    let half = pair.steps(FADE_IN / 2).1;
    assert!(half < 0.0 && half > -0.6 * SCALE * JAWS_N, "{half}");
    assert!((pair.steps(FADE_IN).1 + SCALE * JAWS_N).abs() < 1e-12);
}

#[test]
fn trigger_force_fades_in_silence_and_is_zero_while_uncoupled() {
    let mut pair = Pair::new(Trigger::Driven(Some(0.0)), 0.0);
    pair.grip();
    pair.is_cut = true;
    let (mut states, mut faded, mut last) = (Vec::new(), 0, SCALE * JAWS_N);
    for _ in 0..400 {
        let (record, felt) = pair.step();
        assert!(felt <= 0.0 && -felt <= last + 1e-12, "{:?}: {felt} after {last}", record.state);
        match record.state {
            // Late frames do not reduce the force.
            LadderState::Engaged | LadderState::Stale => assert_eq!(-felt, SCALE * JAWS_N),
            _ => {
                faded += u64::from(felt != 0.0);
                let gain = pair.master.exchange().ladder().gain();
                assert!((felt + SCALE * JAWS_N * gain).abs() < 1e-12, "{felt} N at {gain}");
            }
        }
        last = -felt;
        if states.last() != Some(&record.state) {
            states.push(record.state);
        }
    }
    assert_eq!(states, [LadderState::Engaged, LadderState::Stale, LadderState::Hold, LadderState::Stop]);
    // The force ends within the fade, and not at once.
    assert!((FADE_OUT - 2..=FADE_OUT).contains(&faded), "{faded} ticks");
    assert_eq!(last, 0.0);
    // The wire is whole again but nobody presses: still no force.
    pair.is_cut = false;
    for _ in 0..400 {
        let (record, felt) = pair.step();
        assert!(!record.state.is_coupled() && felt == 0.0, "{:?}", record.state);
    }
    // After a new press the gripper must be picked up again, because the trigger was released meanwhile.
    pair.lead(Some(0.2));
    pair.step();
    pair.master.command(pair.tick * MS, OperatorCommand::Press).unwrap();
    for _ in 0..800 {
        assert_eq!(pair.step().1, 0.0);
    }
    assert_eq!(pair.master.exchange().state(), LadderState::Engaged);
    pair.lead(Some(0.8));
    assert!((pair.steps(600).1 + SCALE * JAWS_N).abs() < 1e-12);
}

#[test]
fn finger_does_not_feel_a_grip_by_button() {
    let mut pair = Pair::new(Trigger::Driven(Some(0.8)), 0.0);
    let works = ButtonSettings { clutch: None, engage: None, gripper: Some(0) };
    pair.master = pair.master.with_buttons(Some(works)).unwrap();
    pair.slave.endpoint.exchange.carry_buttons();
    pair.master.plant.buttons = ButtonWord(Some(0));
    pair.steps(2 * FADE_IN);
    pair.master.plant.buttons = ButtonWord(Some(1));
    for _ in 0..1000 {
        assert_eq!(pair.step().1, 0.0);
    }
    let (jaws, _) = pair.slave.gripper.as_ref().unwrap().state();
    assert!(jaws.holds_object && pair.master.exchange().peer_gripper().unwrap().follows);
}

#[test]
fn loop_stall_is_no_motion_of_the_finger() {
    let mut pair = Pair::new(Trigger::Driven(Some(0.0)), 0.0);
    pair.grip();
    pair.tick += 500;
    pair.master.exchange_mut().stalled(pair.tick * MS);
    // The trigger opened during the stall, which is not a velocity within one tick, and the force ends here.
    pair.lead(Some(0.1));
    let (_, felt) = pair.step();
    assert_eq!((felt, pair.master.felt().unwrap().motion.velocity[0]), (0.0, 0.0));
}

#[test]
fn unknown_trigger_is_no_force_and_no_fault() {
    for unknown in [None, Some(f64::NAN), Some(f64::INFINITY), Some(-0.1), Some(1.1)] {
        let mut pair = Pair::new(Trigger::Driven(Some(0.0)), 0.0);
        pair.grip();
        pair.lead(unknown);
        let (record, felt) = pair.step();
        assert_eq!((felt, record.fault, record.state), (0.0, 0, LadderState::Engaged), "{unknown:?}");
        // When the trigger is known again, the force rises from zero, once the jaws follow it.
        pair.lead(Some(0.8));
        let (_, felt) = pair.step();
        assert!(felt.abs() <= SCALE * JAWS_N / FADE_IN as f64 + 1e-12, "{unknown:?}: {felt}");
    }
}

/// A wrong sample of a trigger counts once, with and without force feedback.
#[test]
fn a_wrong_sample_of_a_trigger_counts_once() {
    let mut pair = Pair::new(Trigger::Driven(Some(0.3)), 0.3);
    pair.steps(100);
    for wrong in 1..=4 {
        pair.lead(Some(0.9));
        pair.step();
        pair.lead(Some(0.3));
        let (record, _) = pair.steps(20);
        assert_eq!((record.outliers, record.fault), (wrong, 0));
    }
}

#[test]
fn fault_of_the_hand_stops_the_trigger_until_acknowledged() {
    let mut pair = Pair::new(Trigger::Driven(Some(0.0)), 0.0);
    pair.grip();
    pair.master.plant.position = Axes::<1>::new(f64::NAN);
    let (record, felt) = pair.step();
    assert_eq!(felt, 0.0);
    assert_eq!(record.state, LadderState::Fault);
    assert!(Fault::from_code(record.fault).is_some());
    pair.master.plant.position = Axes::zeros();
    for _ in 0..FADE_IN {
        let (record, felt) = pair.step();
        assert_eq!((felt, record.state), (0.0, LadderState::Fault));
    }
    pair.master.command(pair.tick * MS, OperatorCommand::Acknowledge).unwrap();
    pair.step();
    assert_ne!(pair.master.exchange().state(), LadderState::Fault);
    assert_eq!(pair.master.felt().unwrap().fault, None);
}

#[test]
fn a_fault_of_the_trigger_stops_the_hand() {
    // It moves by 1 m within a tick, which no finger can do.
    let safety = SafetySettings { controllers: [ControllerKind::Hsc].into(), ..SafetySettings::default() };
    let estimator = EstimatorKind::BackwardDifference {};
    let settings = TriggerSettings { travel_m: 1.0, estimator, safety, ..feedback() };
    let mut pair = Pair::watched(Trigger::Driven(Some(0.0)), 0.0, SafetySettings::default(), &settings);
    let before = pair.steps(2 * FADE_IN).0;
    assert!(before.device_force[0] > 0.5 && before.state == LadderState::Engaged);
    pair.lead(Some(1.0));
    // It may be an outlier for 3 ticks.
    for _ in 0..3 {
        let (record, felt) = pair.step();
        assert_eq!((record.fault, felt), (0, 0.0));
    }
    let (record, felt) = pair.step();
    assert_eq!(Fault::from_code(record.fault), Some(Fault::TooFast(Signal::Position)));
    assert_eq!((record.device_force[0], felt, record.state), (0.0, 0.0, LadderState::Fault));
}

#[test]
fn trips_of_finger_and_hand_are_independent() {
    let watched = SafetySettings { controllers: [ControllerKind::Vfc].into(), ..SafetySettings::default() };
    let scaled = SafetySettings { damping: 5.0, ..watched.at_scale(5.0 / 7.9, TRAVEL_M / 0.14) };
    for is_finger in [true, false] {
        let settings = TriggerSettings { safety: scaled, ..feedback() };
        let mut pair = Pair::watched(Trigger::Driven(Some(0.0)), 0.0, watched, &settings);
        pair.grip();
        let before = pair.step().0;
        assert!(before.device_force[0] > 1.0, "the arm is pushed: {}", before.device_force[0]);
        let mut tripped = [false; 2];
        for n in 0..30 {
            // Either the finger or the hand yields to its force.
            if is_finger {
                pair.lead(Some(0.8 - 0.01 * f64::from(n)));
            } else {
                pair.master.plant.position = Axes::<1>::new(2e-3 * f64::from(n));
            }
            let (record, felt) = pair.step();
            let of_finger = pair.master.felt().unwrap().intervention.tripped.bits();
            tripped = [tripped[0] || record.tripped != 0, tripped[1] || of_finger != 0];
            if is_finger {
                assert_eq!(record.device_force, before.device_force);
            } else {
                assert!((felt + SCALE * JAWS_N).abs() < 1e-12, "{felt}");
            }
        }
        assert_eq!(tripped, [!is_finger, is_finger]);
        let log: serde_json::Value =
            serde_json::from_str(&pair.master.exchange().flight().to_json()).unwrap();
        let rows = log["interventions"].as_array().unwrap();
        let layer = if is_finger { "trigger" } else { "translation" };
        assert!(!rows.is_empty() && rows.iter().all(|row| row["layer"] == layer), "{rows:?}");
    }
}
