//! A hand that turns and an arm that follows it through a delay, in virtual time.
#![allow(clippy::unwrap_used)] // a test may

use std::collections::VecDeque;

use haptether_bridge::{
    Clutch, DrivenMaster, DrivenSlave, LadderSettings, LadderState, LinkTime, MasterEndpoint, MasterRecord,
    MasterRotation, MasterRotationSettings, MasterSettings, MasterSide, OperatorCommand, Side, SlaveEndpoint,
    SlaveOrder, SlaveRotation, SlaveRotationSettings, SlaveSettings, SlaveSide, TickTime,
    coupling::{CommandBounds, RotationBounds, RotationLock, RotationState},
    wire::{Frame, MAX_FRAME, Role},
};
use haptether_master::RotationSample;
use haptether_safety::{
    Axes, DeviceModel, LimiterSettings, RotationModel,
    controller::{ControllerKind, Controllers, SafetySettings},
    estimator::EstimatorKind,
};
use nalgebra::{Quaternion, Unit, UnitQuaternion};

const MS: u64 = 1_000_000;
/// One-way delay in ticks.
const DELAY: usize = 10;
const SCALE: f64 = 1.5;

struct Pair {
    master: MasterSide<DrivenMaster<3>, 3, MasterRotation>,
    slave: SlaveSide<DrivenSlave<3>, 3, SlaveRotation>,
    under_way: [VecDeque<Vec<u8>>; 2],
    is_silent: bool,
    tick: u64,
    /// Last record of the master.
    last: Option<MasterRecord<3, MasterRotation>>,
}

fn turned(x: f64, y: f64, z: f64) -> UnitQuaternion<f64> {
    UnitQuaternion::from_scaled_axis(Axes::<3>::new(x, y, z))
}

impl Pair {
    fn new(bounds: RotationBounds) -> Self {
        Self::with(bounds, Controllers::NONE, true)
    }

    fn watched(controllers: Controllers, shares_trips: bool) -> Self {
        Self::with(RotationBounds::default(), controllers, shares_trips)
    }

    fn with(bounds: RotationBounds, controllers: Controllers, shares_trips: bool) -> Self {
        let safety = SafetySettings { controllers, damping: 0.0, ..SafetySettings::default() };
        let settings = MasterSettings {
            period_ns: MS,
            run_id: 1,
            device: DeviceModel::phantom_desktop(),
            estimator: EstimatorKind::default(),
            safety,
            limiter: LimiterSettings::default(),
            force_scale: 1.0,
            ladder: LadderSettings::default(),
        };
        let rotation = MasterRotationSettings {
            device: RotationModel::new(Axes::<3>::repeat(1e-4), 1e-4, 0.0).unwrap(),
            estimator: EstimatorKind::default(),
            safety: SafetySettings { damping: 0.0, pc_max_damping: 0.01, ..safety.at_lever(0.05) },
            limiter: LimiterSettings::default().at_lever(0.05),
            torque_scale: 1.0,
            shares_trips,
        };
        let endpoint = MasterEndpoint::of_pose(&settings, &rotation, RotationLock::Free).unwrap();
        let master =
            MasterSide::new(DrivenMaster::default(), endpoint, Clutch::Once).unwrap().recording_rotation();
        let settings = SlaveSettings {
            period_ns: MS,
            run_id: 2,
            position_scale: 1.0,
            bounds: CommandBounds::default(),
            ladder: LadderSettings::default(),
        };
        let rotation = SlaveRotationSettings {
            rotation_scale: SCALE,
            lock: RotationLock::Free,
            bounds,
            alignment: None,
        };
        let endpoint = SlaveEndpoint::of_pose(&settings, &rotation).unwrap();
        let slave = SlaveSide::new(DrivenSlave::new(5.0).unwrap(), endpoint).recording_rotation();
        let mut pair =
            Self { master, slave, under_way: Default::default(), is_silent: false, tick: 0, last: None };
        pair.hand(turned(0.2, -0.1, 0.3));
        let orientation = turned(-0.4, 0.2, 0.1);
        let torque = Axes::<3>::new(0.0, 0.0, 0.02);
        pair.slave.plant.rotation = Some(RotationState { orientation, torque, ..RotationState::default() });
        pair.slave.plant.sample[2] = Axes::<3>::new(0.3, 0.0, 0.0);
        pair
    }

    fn hand(&mut self, orientation: UnitQuaternion<f64>) {
        self.master.plant.rotation = Some(RotationSample { orientation, angular_velocity: None });
    }

    /// Tick both sides; return the record of the master.
    fn record(&mut self) -> MasterRecord<3, MasterRotation> {
        self.tick();
        self.last.unwrap()
    }

    fn tick(&mut self) -> [LadderState; 2] {
        let (now, time) = (LinkTime::at(self.tick * MS), TickTime::at(self.tick * MS));
        let mut buffer = [0; MAX_FRAME];
        let [to_slave, to_master] = &mut self.under_way;
        let record = self.master.tick(time);
        self.last = Some(record);
        let states = [record.state, {
            to_slave.push_back(self.master.send(now, &mut buffer).to_vec());
            if to_slave.len() > DELAY {
                let frame = to_slave.pop_front().unwrap();
                if !self.is_silent {
                    let _ = self.slave.receive(now, &frame);
                }
            }
            self.slave.tick(time).state
        }];
        to_master.push_back(self.slave.send(now, &mut buffer).to_vec());
        if to_master.len() > DELAY {
            let _ = self.master.receive(now, &to_master.pop_front().unwrap());
        }
        self.tick += 1;
        states
    }

    fn engage(&mut self) {
        for _ in 0..600 {
            self.tick();
        }
        assert_eq!(self.tick(), [LadderState::Engaged; 2]);
    }

    fn order(&self) -> (UnitQuaternion<f64>, Axes<3>) {
        match self.slave.plant.order() {
            SlaveOrder::Move { rotation: Some(rotation), .. } => *rotation,
            other => panic!("{other:?}"),
        }
    }
}

/// `R_s = C (R_m R_m0')^lambda C' R_s0`
#[test]
fn the_arm_turns_as_the_hand_did_a_delay_ago() {
    let mut pair = Pair::new(RotationBounds::default());
    let c = turned(0.5, 0.8, -0.3);
    let frame = OperatorCommand::Frame { quat_wxyz: [c.w, c.i, c.j, c.k], locked: [false; 7] };
    assert!(pair.master.command(0, frame).unwrap() && pair.slave.command(0, frame).unwrap());
    pair.engage();
    let (from, start) = (turned(0.2, -0.1, 0.3), turned(-0.4, 0.2, 0.1));
    let phi = |n: usize| Axes::<3>::new(0.6, 0.0, 0.8) * (0.5e-3 * n as f64);
    for n in 0..1000 {
        pair.hand(UnitQuaternion::from_scaled_axis(phi(n)) * from);
        pair.tick();
        let seen = phi(n.saturating_sub(DELAY)) * SCALE;
        let expected = UnitQuaternion::from_scaled_axis(c * seen) * start;
        // Rounding error of an angle from an inverse cosine: 3e-8 at 0.
        assert!(pair.order().0.angle_to(&expected) < 1e-7, "{n}");
    }
}

#[test]
fn the_command_keeps_within_speed_and_turn() {
    let bounds = RotationBounds { speed: 0.5, turn: 0.4 };
    let mut pair = Pair::new(bounds);
    pair.engage();
    let (start, mut before, mut furthest) = (turned(-0.4, 0.2, 0.1), pair.order().0, 0.0_f64);
    for n in 0..1500 {
        pair.hand(turned(0.0, 0.0, 1e-3 * f64::from(n.min(1000))) * turned(0.2, -0.1, 0.3));
        pair.is_silent = n % 100 > 90;
        pair.tick();
        let (now, w) = pair.order();
        assert!(now.angle_to(&before) <= 0.5e-3 + 3e-8 && w.norm() <= 0.5 + 1e-12, "{n}");
        furthest = furthest.max(now.angle_to(&start));
        before = now;
    }
    assert!((furthest - 0.4).abs() < 0.5e-3 + 3e-8, "{furthest}");
}

/// Beyond pi from the first orientation, the shorter way to a bound leads through the forbidden range.
#[test]
fn a_hand_that_turns_on_past_pi_does_not_lead_the_arm_out_of_its_bound() {
    for turn in [1.7, 2.4, 3.0] {
        let mut pair = Pair::new(RotationBounds { speed: 2.5, turn });
        pair.engage();
        let start = turned(-0.4, 0.2, 0.1);
        let mut furthest = 0.0_f64;
        for n in 0..4000 {
            pair.hand(turned(0.0, 0.0, 1.5e-3 * f64::from(n)) * turned(0.2, -0.1, 0.3));
            pair.tick();
            furthest = furthest.max(pair.order().0.angle_to(&start));
        }
        assert!((furthest - turn).abs() < 1e-7, "{furthest} {turn}");
    }
}

#[test]
fn invalid_orientation_is_a_fault_without_force_or_torque() {
    let long = Unit::new_unchecked(Quaternion::new(1.1, 0.0, 0.0, 0.0));
    let none = Unit::new_unchecked(Quaternion::from([f64::NAN; 4]));
    for (bad, at_master) in [(long, true), (none, true), (long, false), (none, false)] {
        let mut pair = Pair::new(RotationBounds::default());
        pair.engage();
        assert!(pair.master.plant.force.norm() > 0.1 && pair.master.plant.torque.norm() > 5e-3);
        if at_master {
            pair.hand(bad);
        } else {
            pair.slave.plant.rotation.as_mut().unwrap().orientation = bad;
        }
        let [master, slave] = pair.tick();
        if at_master {
            assert_eq!(master, LadderState::Fault);
            assert_eq!([pair.master.plant.force, pair.master.plant.torque], [Axes::<3>::zeros(); 2]);
        } else {
            assert_eq!(slave, LadderState::Fault);
            assert_eq!(*pair.slave.plant.order(), SlaveOrder::Stop);
        }
        for _ in 0..=DELAY {
            pair.tick();
        }
        assert!(pair.tick().iter().all(|state| !state.is_coupled()));
    }
}

#[test]
fn silence_brings_the_rotation_to_rest_and_then_to_a_stop() {
    let mut pair = Pair::new(RotationBounds::default());
    pair.engage();
    let mut held = 0;
    for n in 0..2000 {
        pair.hand(turned(0.0, 0.0, 1e-3 * f64::from(n)) * turned(0.2, -0.1, 0.3));
        pair.is_silent = n >= 300;
        let before = pair.slave.plant.order().to_owned();
        let [_, slave] = pair.tick();
        if slave == LadderState::Hold && matches!(before, SlaveOrder::Move { .. }) {
            assert!(pair.order().1.norm() < 1e-12, "{n}");
            held += 1;
        }
    }
    assert!(held > 10, "{held}");
    assert_eq!(*pair.slave.plant.order(), SlaveOrder::Stop);
}

/// An arm without a valid orientation is held at none, and none is recorded.
#[test]
fn arm_with_unknown_rest_orientation_is_held_at_none() {
    let at = turned(0.1, 0.2, -0.3);
    let long = Unit::new_unchecked(Quaternion::new(1.1, 0.0, 0.0, 0.0));
    for (rest, expected) in [(Some(at), Some(at)), (None, None), (Some(long), None)] {
        let mut pair = Pair::new(RotationBounds::default());
        pair.engage();
        assert!(pair.slave.endpoint.last_orientation().is_some());
        pair.slave.endpoint.set_rest(&Axes::zeros(), rest.as_ref());
        assert_eq!(pair.slave.endpoint.last_orientation(), expected);
    }
    let mut pair = Pair::new(RotationBounds::default());
    pair.engage();
    pair.slave.plant.rotation.as_mut().unwrap().orientation = long;
    assert_eq!(pair.tick()[1], LadderState::Fault);
    assert_eq!(pair.slave.endpoint.last_orientation(), None, "its stop decides how it rests");
}

/// If the hand is much faster than the bound, the lag is dropped; the arm is never led back the shorter way.
#[test]
fn lagging_command_continues_in_its_direction() {
    let mut pair = Pair::new(RotationBounds::default());
    pair.engage();
    let start = pair.order().0;
    let (mut before, mut whole) = (start, 0.0_f64);
    for n in 0..1200 {
        // 8 rad at 16 rad/s, scaled by 1.5 for the arm, which turns at 2.5 rad/s at most.
        let angle = 16e-3 * f64::from(n.min(500));
        pair.hand(turned(0.0, 0.0, angle) * turned(0.2, -0.1, 0.3));
        pair.tick();
        let (now, w) = pair.order();
        let step = (now * before.inverse()).scaled_axis();
        assert!(step.z >= -1e-9 && w.z >= -1e-9, "{n}: turned back by {step}, {w}");
        assert!(step.norm() <= 2.5e-3 + 3e-8 && w.norm() <= 2.5 + 1e-9, "{n}");
        whole += step.z;
        before = now;
    }
    // 2.5 rad/s during the 0.5 s of the hand, and at most a quarter turn after that.
    assert!(whole > 1.2 && whole < 1.25 + std::f64::consts::FRAC_PI_2 + 0.05, "{whole}");
    assert!(pair.slave.exchange().counts().limited > 400);
}

/// If the bound holds the orientation, it also holds the velocity; otherwise a follower would go beyond it.
#[test]
fn bounded_orientation_has_no_velocity() {
    let mut pair = Pair::new(RotationBounds { speed: 2.5, turn: 0.4 });
    pair.engage();
    for n in 0..1000 {
        pair.hand(turned(0.0, 0.0, 1e-3 * f64::from(n)) * turned(0.2, -0.1, 0.3));
        pair.tick();
        let (now, w) = pair.order();
        // 0.4 rad are reached after 0.27 s at 1.5 rad/s.
        if n > 320 {
            assert!((now.angle_to(&turned(-0.4, 0.2, 0.1)) - 0.4).abs() < 1e-7, "{n}");
            assert!(w.norm() < 1e-4, "{n}: {w}");
        }
    }
}

/// The bounds refer to the arm's first valid sample, not to an invalid one.
#[test]
fn invalid_first_sample_keeps_the_bounds() {
    let bounds = RotationBounds { speed: 2.5, turn: 0.2 };
    for bad in [Quaternion::from([f64::NAN; 4]), Quaternion::from([0.0; 4])] {
        let mut pair = Pair::new(bounds);
        let sound = pair.slave.plant.rotation.unwrap();
        let none = Unit::new_unchecked(bad);
        pair.slave.plant.rotation = Some(RotationState { orientation: none, ..sound });
        for _ in 0..20 {
            pair.tick();
        }
        assert_eq!(pair.slave.exchange().state(), LadderState::Fault);
        pair.slave.plant.rotation = Some(sound);
        assert!(pair.slave.command(pair.tick * MS, OperatorCommand::Acknowledge).unwrap());
        for _ in 0..100 {
            pair.tick();
        }
        assert!(pair.master.command(pair.tick * MS, OperatorCommand::Press).unwrap());
        pair.engage();
        let start = pair.order().0;
        for n in 0..800 {
            pair.hand(turned(0.0, 0.0, 1e-3 * f64::from(n)) * turned(0.2, -0.1, 0.3));
            pair.tick();
            assert!(pair.order().0.angle_to(&start) < 0.2 + 1e-7, "{n}");
        }
        assert!((pair.order().0.angle_to(&start) - 0.2).abs() < 1e-7);
    }
}

/// After a release of the clutch and a new press, the arm continues from where it is, and the torque rises from zero.
#[test]
fn new_press_sets_a_new_anchor_without_a_jump() {
    let mut pair = Pair::new(RotationBounds::default());
    pair.engage();
    for n in 0..300 {
        pair.hand(turned(0.0, 0.0, 1e-3 * f64::from(n)) * turned(0.2, -0.1, 0.3));
        pair.tick();
    }
    for _ in 0..100 {
        pair.tick();
    }
    let held = pair.order().0;
    assert!(pair.master.command(pair.tick * MS, OperatorCommand::Press).unwrap());
    let mut before = held;
    for n in 0..1200 {
        // While the clutch is open, the hand turns elsewhere and comes to rest.
        pair.hand(turned(1e-3 * f64::from(n.min(60)), 0.0, 0.3) * turned(0.2, -0.1, 0.3));
        pair.tick();
        let now = pair.order().0;
        assert!(now.angle_to(&before) < 2e-3, "{n}");
        // The torque fades within 75 ms, and the clutch is open for 100 ms.
        assert!(n != 80 || pair.master.plant.torque == Axes::<3>::zeros(), "{n}");
        before = now;
    }
    assert_eq!(pair.slave.exchange().state(), LadderState::Engaged);
    assert!(before.angle_to(&held) < 1e-6, "turns while uncoupled are not made up for");
}

/// The energies in frames are the sums of `-(f·dx + tau·dphi)` of all ticks, separately for each direction, with the
/// wrench that the device has exerted since the tick before.
#[test]
fn the_energy_of_the_frames_is_that_of_the_whole_wrench() {
    let mut pair = Pair::new(RotationBounds::default());
    pair.engage();
    let read = |pair: &mut Pair| {
        let mut buffer = [0; MAX_FRAME];
        let now = LinkTime::at(pair.tick * MS);
        let layout = pair.master.exchange().link().layout();
        let bytes = pair.master.send(now, &mut buffer).to_vec();
        let frame = Frame::decode(&bytes, Role::Master, layout).unwrap();
        assert_eq!(frame.message.epoch, 1);
        [frame.energy.in_j, frame.energy.out_j]
    };
    let begun = read(&mut pair);
    let place = |pair: &Pair| (pair.master.plant.position, pair.master.plant.rotation.unwrap().orientation);
    let (mut sums, mut said, mut rotated) = ([0.0_f64; 2], begun, 0.0_f64);
    let mut last = (place(&pair), pair.last.unwrap());
    for n in 0..500 {
        let swing = (0.01 * f64::from(n)).sin() * 0.3;
        pair.hand(turned(0.0, 0.1 * swing, swing) * turned(0.2, -0.1, 0.3));
        pair.master.plant.position = Axes::<3>::new(0.02 * swing, 0.0, 0.0);
        let time = TickTime::at(pair.tick * MS);
        let record = pair.master.tick(time);
        let ((position, orientation), before) = last;
        let now = place(&pair);
        let angle = (now.1 * orientation.inverse()).scaled_axis();
        let turning = before.rotation.device_torque.dot(&angle);
        let work = -(before.device_force.dot(&(now.0 - position)) + turning);
        sums[usize::from(work <= 0.0)] += work.abs();
        rotated += turning.abs();
        last = (now, record);
        // The slave is stepped as in `Pair::tick`, so that the sides stay coupled.
        let now = LinkTime::at(pair.tick * MS);
        let mut buffer = [0; MAX_FRAME];
        let frame = pair.master.send(now, &mut buffer).to_vec();
        let _ = pair.slave.receive(now, &frame);
        pair.slave.tick(time);
        let back = pair.slave.send(now, &mut buffer).to_vec();
        let _ = pair.master.receive(now, &back);
        pair.tick += 1;
        said = read(&mut pair);
    }
    assert!(rotated > 1e-4, "{rotated}");
    for (way, name) in [(0, "in"), (1, "out")] {
        let grown = said[way] - begun[way];
        // A rounding of 32 epsilon in the angle of each tick, with torques below 0.1 N m, and one of the sum.
        let most = 500.0 * f64::EPSILON * (3.2 + said[way]);
        assert!(sums[way] > 1e-4, "{name}: {}", sums[way]);
        assert!((grown - sums[way]).abs() <= most, "{name}: {grown} J, must be {} J", sums[way]);
    }
}

/// HSC detects a torque that the hand does not hold. If trips are shared, the force is cancelled too.
#[test]
fn shared_trip_of_the_torque_acts_on_the_force() {
    for shares_trips in [true, false] {
        let mut pair = Pair::watched([ControllerKind::Hsc].into(), shares_trips);
        pair.engage();
        // A device that stands still under a torque looks held, because the estimate assigns all of the torque to a
        // hand. So the device is released here: it turns by the torque alone, with I = 1e-4 kg m².
        let (mut angle, mut rate) = (0.0, 0.0);
        let mut seen = false;
        for _ in 0..120 {
            let torque = pair.master.plant.torque.z;
            rate += torque / 1e-4 * 1e-3;
            angle += rate * 1e-3;
            pair.hand(turned(0.2, -0.1, 0.3) * turned(0.0, 0.0, angle));
            let record = pair.record();
            if record.rotation.tripped != 0 && record.rotation.device_torque.norm() < 1e-9 {
                seen = true;
                let force = record.device_force.norm();
                assert!(if shares_trips { force < 1e-9 } else { force > 0.1 }, "{force}");
            }
        }
        assert!(seen, "the torque must have tripped");
        let log: serde_json::Value =
            serde_json::from_str(&pair.master.exchange().flight().to_json()).unwrap();
        let mut rows = log["interventions"].as_array().unwrap().iter();
        let row = rows.find(|row| row["layer"] == "rotation").unwrap();
        assert_eq!(row["trips"][0]["controller"], "hsc");
    }
}
