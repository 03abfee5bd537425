//! Alignment of an arm with its master before engagement, with delays, in virtual time.
#![allow(clippy::unwrap_used)] // a test may

use std::{collections::VecDeque, f64::consts::PI};

use haptether_bridge::{
    Clutch, Diagnosis, DrivenMaster, DrivenSlave, Explanation, LadderSettings, LadderState, LinkTime,
    MasterEndpoint, MasterRotation, MasterRotationSettings, MasterSettings, MasterSide, OperatorCommand,
    Reason, Remedy, Side, SlaveEndpoint, SlaveOrder, SlaveRotation, SlaveRotationSettings, SlaveSettings,
    SlaveSide, TickTime,
    coupling::{
        ALIGNED_RAD, AlignmentSettings, CommandBounds, RotationBounds, RotationLock, RotationState, quat_wxyz,
    },
    wire::MAX_FRAME,
};
use haptether_master::RotationSample;
use haptether_safety::{
    Axes, DeviceModel, LimiterSettings, RotationModel,
    controller::{Controllers, SafetySettings},
    estimator::EstimatorKind,
};
use nalgebra::{Quaternion, Unit, UnitQuaternion};
use proptest::prelude::*;

use LadderState::{Aligning, Disengaged, Engaged, Fault, Hold};

const MS: u64 = 1_000_000;
const SPEED: f64 = 0.5;
const ALIGNMENT: AlignmentSettings = AlignmentSettings { speed: SPEED, max_angle: 1.5 };
/// Rounding error of an angle from an inverse tangent of products: 3e-8 at 0.
const ROUNDING: f64 = 3e-8;

type Orientation = UnitQuaternion<f64>;

#[derive(Clone, Copy)]
struct Set {
    alignment: Option<AlignmentSettings>,
    bounds: RotationBounds,
    /// C.
    frame: Orientation,
    /// Orientations of the hand and of the tool.
    start: [Orientation; 2],
    /// One-way delays in ticks: to the slave, and back.
    delays: [usize; 2],
}

impl Default for Set {
    fn default() -> Self {
        Self {
            alignment: Some(ALIGNMENT),
            bounds: RotationBounds::default(),
            frame: turned(0.5, 0.8, -0.3),
            start: [turned(0.2, -0.1, 0.3), turned(-0.1, 0.2, 0.1)],
            delays: [10, 15],
        }
    }
}

struct Pair {
    master: MasterSide<DrivenMaster<3>, 3, MasterRotation>,
    slave: SlaveSide<DrivenSlave<3>, 3, SlaveRotation>,
    under_way: [VecDeque<Vec<u8>>; 2],
    delays: [usize; 2],
    /// True if frames to the slave, and to the master, are lost.
    is_silent: [bool; 2],
    tick: u64,
    frame: Orientation,
}

fn turned(x: f64, y: f64, z: f64) -> Orientation {
    UnitQuaternion::from_scaled_axis(Axes::<3>::new(x, y, z))
}

/// Return the settings with the hand at `angle` from the slave's orientation, in the slave's frame.
fn off_by(set: Set, angle: f64) -> Set {
    let way = UnitQuaternion::from_scaled_axis(Axes::<3>::new(0.6, 0.0, -0.8) * angle);
    let hand = set.frame.inverse() * way * set.start[1] * set.frame;
    Set { start: [hand, set.start[1]], ..set }
}

fn rotation_settings(set: &Set) -> SlaveRotationSettings {
    let Set { alignment, bounds, .. } = *set;
    SlaveRotationSettings { rotation_scale: 1.0, lock: RotationLock::Free, bounds, alignment }
}

fn slave_settings() -> SlaveSettings {
    SlaveSettings {
        period_ns: MS,
        run_id: 2,
        position_scale: 1.0,
        bounds: CommandBounds::default(),
        ladder: LadderSettings::default(),
    }
}

impl Pair {
    /// Build a pair with an open clutch.
    fn new(set: Set) -> Self {
        let safety =
            SafetySettings { controllers: Controllers::NONE, damping: 0.0, ..SafetySettings::default() };
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
            shares_trips: true,
        };
        let endpoint = MasterEndpoint::of_pose(&settings, &rotation, RotationLock::Free).unwrap();
        let master =
            MasterSide::new(DrivenMaster::default(), endpoint, Clutch::Once).unwrap().recording_rotation();
        let endpoint = SlaveEndpoint::of_pose(&slave_settings(), &rotation_settings(&set)).unwrap();
        let slave = SlaveSide::new(DrivenSlave::new(5.0).unwrap(), endpoint).recording_rotation();
        let Set { frame, start: [hand, tool], delays, .. } = set;
        let mut pair = Self {
            master,
            slave,
            under_way: Default::default(),
            delays,
            is_silent: [false; 2],
            tick: 0,
            frame,
        };
        let command = OperatorCommand::Frame { quat_wxyz: quat_wxyz(&frame), locked: [false; 7] };
        assert!(pair.master.command(0, command).unwrap() && pair.slave.command(0, command).unwrap());
        pair.press(false);
        pair.hand(hand);
        let torque = Axes::<3>::new(0.0, 0.0, 0.02);
        pair.slave.plant.rotation =
            Some(RotationState { orientation: tool, torque, ..RotationState::default() });
        pair.slave.plant.sample[0] = Axes::<3>::new(0.4, 0.1, 0.2);
        pair.slave.plant.sample[2] = Axes::<3>::new(0.3, 0.0, 0.0);
        // Run until both sides hear each other.
        pair.ticks(100 + delays[0] + delays[1]);
        pair
    }

    fn hand(&mut self, orientation: Orientation) {
        self.master.plant.rotation = Some(RotationSample { orientation, angular_velocity: None });
    }

    fn press(&mut self, is_closed: bool) {
        self.master.plant.clutch = Some(is_closed);
    }

    fn tick(&mut self) -> [LadderState; 2] {
        self.tick_at(true)
    }

    fn tick_at(&mut self, slave_ticks: bool) -> [LadderState; 2] {
        let (now, time) = (LinkTime::at(self.tick * MS), TickTime::at(self.tick * MS));
        let mut buffer = [0; MAX_FRAME];
        let [to_slave, to_master] = &mut self.under_way;
        let mut states = [self.master.tick(time).state, self.slave.exchange().state()];
        to_slave.push_back(self.master.send(now, &mut buffer).to_vec());
        if to_slave.len() > self.delays[0] {
            let frame = to_slave.pop_front().unwrap();
            if !self.is_silent[0] {
                let _ = self.slave.receive(now, &frame);
            }
        }
        if slave_ticks {
            states[1] = self.slave.tick(time).state;
            to_master.push_back(self.slave.send(now, &mut buffer).to_vec());
        }
        if to_master.len() > self.delays[1] {
            let frame = to_master.pop_front().unwrap();
            if !self.is_silent[1] {
                let _ = self.master.receive(now, &frame);
            }
        }
        self.tick += 1;
        states
    }

    fn ticks(&mut self, count: usize) -> [LadderState; 2] {
        let mut states = self.tick();
        for _ in 1..count {
            states = self.tick();
        }
        states
    }

    /// Return commanded orientation, angular velocity and position of the tool point.
    fn order(&self) -> (Orientation, Axes<3>, Axes<3>) {
        match self.slave.plant.order() {
            SlaveOrder::Move { position, velocity, rotation: Some((orientation, w)) } => {
                assert_eq!(velocity, &Axes::<3>::zeros());
                (*orientation, *w, *position)
            }
            other => panic!("{other:?}"),
        }
    }

    /// Return `C R_m C'` for the present orientation of the hand.
    fn target(&self) -> Orientation {
        self.frame * self.master.plant.rotation.unwrap().orientation * self.frame.inverse()
    }

    fn pushes(&self) -> bool {
        self.master.plant.force != Axes::<3>::zeros() || self.master.plant.torque != Axes::<3>::zeros()
    }

    fn cause(&self, of_slave: bool) -> Option<Explanation> {
        let flight = if of_slave { self.slave.exchange().flight() } else { self.master.exchange().flight() };
        flight.diagnosis().map(Diagnosis::explain)
    }

    /// Turn the hand from one angle off the slave's start to another, at a speed possible for a hand.
    fn sweep(&mut self, set: &Set, from: f64, to: f64) {
        for n in 1..=500 {
            self.hand(off_by(*set, from + (to - from) * f64::from(n) / 500.0).start[0]);
            self.tick();
        }
    }

    /// Press, and wait until the arm has turned for this number of ticks.
    fn turn_for(&mut self, ticks: usize) {
        self.press(true);
        self.ticks(self.delays[0] + ticks);
        assert_eq!(self.slave.exchange().state(), Aligning);
        assert!((self.order().1.norm() - SPEED).abs() < 1e-9, "it turns");
    }

    /// Check that the arm turned until this tick.
    fn begins_to_brake(&self) {
        assert!(self.order().1.norm() > 0.9 * SPEED, "evenly, not at once");
    }

    /// Check that the arm, no longer turned, brakes evenly and then stands, whatever frames arrive.
    fn comes_to_rest(&mut self, ticks: usize) {
        let (mut before, mut w_before, place) = self.order();
        let from = before;
        for n in 0..ticks {
            let [master, slave] = self.tick();
            let (now, w, position) = self.order();
            assert!(!master.is_coupled() && !slave.is_coupled() && !self.pushes(), "{n}");
            assert!(now.angle_to(&before) <= SPEED * 1e-3 + ROUNDING, "{n}");
            assert!(w.norm() <= w_before.norm() + 1e-12, "{n}");
            assert!((w - w_before).norm() <= 25e-3 + 1e-9, "{n}: evenly, not at once");
            // From 0.5 rad/s with 25 rad/s²: 20 ms.
            assert!(n < 22 || w.norm() == 0.0 && now.angle_to(&before) < ROUNDING, "{n}");
            assert_eq!(position, place);
            (before, w_before) = (now, w);
        }
        // w² / 2 a, plus one tick.
        assert!(before.angle_to(&from) < SPEED * SPEED / 50.0 + SPEED * 1e-3 + ROUNDING);
    }
}

/// Run a whole alignment with checks at each tick; return the number of ticks for which the slave turned.
fn aligns(pair: &mut Pair, speed: f64, mut hand: impl FnMut(u64) -> Option<Orientation>) -> u64 {
    pair.press(true);
    let (start, place) = (pair.slave.plant.rotation.unwrap().orientation, pair.slave.plant.sample[0]);
    let (mut before, mut turning) = (start, 0);
    for n in 0..6000 {
        if let Some(hand) = hand(n) {
            pair.hand(hand);
        }
        let [master, slave] = pair.tick();
        if slave == Disengaged {
            assert_eq!(*pair.slave.plant.order(), SlaveOrder::Wait);
            continue;
        }
        assert!(!pair.pushes(), "{n}");
        if turning > 0 || slave == Engaged {
            let (now, w, position) = pair.order();
            assert!(now.angle_to(&before) <= speed * 1e-3 + ROUNDING, "{n}: {}", now.angle_to(&before));
            assert_eq!(position, place);
            before = now;
            if slave == Engaged {
                assert_ne!(master, Engaged, "the slave first, when it is there");
                return turning;
            }
            assert!(w.norm() <= speed * (1.0 + 1e-9), "{n}: {w}");
            assert_eq!(master, Aligning);
        } else {
            before = pair.order().0;
            assert!(before.angle_to(&start) <= speed * 1e-3 + ROUNDING);
        }
        assert_eq!(slave, Aligning);
        turning += 1;
    }
    panic!("never engaged");
}

/// Check after engagement that `R_s = C R_m C'` of one delay ago, for further motion of the hand.
fn stays_aligned(pair: &mut Pair, start: Orientation) {
    pair.ticks(pair.delays[0] + 1);
    let mut sent = VecDeque::from(vec![pair.target(); pair.delays[0] + 1]);
    let mut before = pair.order().0;
    for n in 0..300_u32 {
        pair.hand(
            UnitQuaternion::from_scaled_axis(Axes::<3>::new(0.3, 0.0, 0.4) * (1e-3 * f64::from(n))) * start,
        );
        sent.push_back(pair.target());
        sent.pop_front();
        pair.tick();
        let now = pair.order().0;
        assert!(now.angle_to(&sent[0]) < 1e-7, "{n}: {}", now.angle_to(&sent[0]));
        assert!(now.angle_to(&before) <= 0.51e-3, "{n}");
        before = now;
    }
    assert_eq!(pair.tick(), [Engaged; 2]);
    assert!(pair.pushes(), "force and torque fade in from then on");
}

/// Alignment takes exactly the angle divided by the speed, and nothing jumps at engagement.
#[test]
fn alignment_takes_the_angle_over_the_speed() {
    for (angle, speed, delays) in [
        (1.4, 0.5, [10, 15]),
        (1.4, 2.5, [0, 0]),
        (0.3, 0.1, [100, 30]),
        (PI - 1e-3, 1.0, [250, 250]),
        (0.01, 0.5, [10, 15]),
        (1e-4, 0.5, [10, 15]),
    ] {
        let alignment = Some(AlignmentSettings { speed, max_angle: (angle + 0.1).min(PI) });
        let set = off_by(Set { alignment, delays, ..Set::default() }, angle);
        let mut pair = Pair::new(set);
        let ticks = aligns(&mut pair, speed, |_| None) as f64;
        // The slave engages at the last step.
        let expected = (angle / (speed * 1e-3)).ceil() - 1.0;
        assert!((ticks - expected).abs() <= 1.0, "{angle} at {speed}: {ticks} ticks, must be {expected}");
        assert!(pair.order().0.angle_to(&pair.target()) < 1e-7);
        // No energy of contacts during the alignment was sent.
        let energy = pair.master.exchange().link().newest().unwrap().energy;
        assert_eq!([energy.in_j, energy.out_j], [0.0; 2]);
        stays_aligned(&mut pair, set.start[0]);
    }
}

fn orientations() -> impl Strategy<Value = Orientation> {
    prop::array::uniform4(-1.0..1.0_f64)
        .prop_filter("some length", |parts| parts.iter().map(|part| part * part).sum::<f64>() > 0.01)
        .prop_map(|[w, x, y, z]| UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z)))
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(40))]

    /// Any frame, two orientations and delays, with a hand at rest or slower than the arm.
    #[test]
    fn any_two_orientations_align_and_stay_aligned(
        (frame, hand, tool) in (orientations(), orientations(), orientations()),
        delays in prop::array::uniform2(0..120_usize),
        (speed, rate) in (0.8..2.4_f64, prop::array::uniform3(-0.1..0.1_f64)),
    ) {
        let alignment = Some(AlignmentSettings { speed, max_angle: PI });
        let set = Set { alignment, frame, start: [hand, tool], delays, ..Set::default() };
        let mut pair = Pair::new(set);
        let angle = pair.target().angle_to(&tool);
        let rate = Axes::<3>::from(rate);
        // Beyond pi, the shorter way is about another axis, and a moving hand could lead the arm back and forth.
        let rate = if angle > 2.8 { Axes::<3>::zeros() } else { rate };
        let moved = |n: u64| UnitQuaternion::from_scaled_axis(rate * (1e-3 * n as f64)) * hand;
        let mut last = hand;
        let ticks = aligns(&mut pair, speed, |n| {
            last = moved(n);
            Some(last)
        }) as f64;
        let (fast, slow) = (angle / (speed + rate.norm()), angle / (speed - rate.norm()));
        // The hand also turned while the press was in flight.
        let lead_s = rate.norm() * 0.3 / speed;
        prop_assert!(ticks * 1e-3 >= fast - lead_s - 3e-3 && ticks * 1e-3 <= slow + lead_s + 3e-3, "{ticks} {fast} {slow}");
        stays_aligned(&mut pair, last);
    }
}

/// For a hand that trembles faster than the arm may turn, staying near for long enough counts as aligned, and nothing
/// jumps.
#[test]
fn trembling_hand_is_met_within_the_tolerance() {
    let alignment = Some(AlignmentSettings { speed: 0.1, max_angle: 0.4 });
    let set = off_by(Set { alignment, ..Set::default() }, 0.1);
    let mut pair = Pair::new(set);
    // 4 mrad at 8 Hz: 0.2 rad/s.
    let tremor = |n: u64| {
        let (sine, cosine) = (0.05 * n as f64).sin_cos();
        turned(4e-3 * sine, 4e-3 * cosine, 4e-3 * sine * cosine)
    };
    let ticks = aligns(&mut pair, 0.1, |n| Some(tremor(n) * set.start[0]));
    // 0.1 rad at 0.1 rad/s, less the tolerance, and 0.2 s within it.
    assert!((1050..1350).contains(&ticks), "{ticks}");
    pair.hand(set.start[0]);
    pair.ticks(pair.delays[0] + 1);
    let left = pair.order().0.angle_to(&pair.target());
    assert!(left > 1e-4 && left < ALIGNED_RAD + 0.5e-3, "{left}");
}

/// Beyond the largest angle nothing moves; both sides report the reason and the remedy at once.
#[test]
fn too_large_angle_is_refused_without_motion_and_with_reason() {
    let tight = RotationBounds { speed: 2.5, turn: 0.3 };
    for (angle, bounds) in [(1.51, RotationBounds::default()), (3.1, RotationBounds::default()), (1.0, tight)]
    {
        let set = off_by(Set { bounds, ..Set::default() }, angle);
        let mut pair = Pair::new(set);
        pair.press(true);
        for n in 0..5500_usize {
            let [master, slave] = pair.tick();
            assert_eq!(*pair.slave.plant.order(), SlaveOrder::Wait, "{n}");
            assert_eq!(slave, Disengaged);
            assert_eq!(master, if n < 5000 { Aligning } else { Disengaged }, "{n}");
            assert!(!pair.pushes());
            if n > 30 {
                for of_slave in [false, true] {
                    let cause = pair.cause(of_slave).unwrap();
                    assert_eq!(cause.at, "slave");
                    assert!(cause.text.contains("larger than the slave may turn"), "{}", cause.text);
                    let steps: Vec<_> = cause.steps.iter().map(|step| (step.at, step.remedy)).collect();
                    assert_eq!(steps, [("master", Remedy::Turn), ("master", Remedy::Press)]);
                }
            }
        }
        let last = pair.slave.exchange().ladder().history().last().unwrap();
        assert_eq!(last.reason, Reason::TurnRefused);
        // A hand that turns back does not count as a press.
        pair.sweep(&set, angle, 0.2);
        for _ in 0..300 {
            pair.tick();
            assert_eq!(*pair.slave.plant.order(), SlaveOrder::Wait);
        }
        pair.press(false);
        pair.ticks(100);
        aligns(&mut pair, SPEED, |_| None);
        assert_eq!(pair.ticks(100), [Engaged; 2]);
        assert_eq!([pair.cause(false), pair.cause(true)], [None, None]);
    }
}

/// If the hand turns out of reach during the alignment, the arm brakes, and the return of the hand does not engage.
#[test]
fn hand_out_of_reach_ends_the_alignment() {
    let set = off_by(Set::default(), 1.4);
    let mut pair = Pair::new(set);
    pair.turn_for(200);
    // 1.3 rad are left, and 0.1 rad per 25 ms is faster than the arm.
    let mut angle = 1.4;
    while pair.slave.exchange().state() == Aligning {
        angle += 4e-3;
        pair.hand(off_by(set, angle).start[0]);
        pair.tick();
    }
    let behind = off_by(set, angle - 4e-3 * pair.delays[0] as f64).start[0];
    let left = (set.frame * behind * set.frame.inverse()).angle_to(&pair.order().0);
    assert!((left - ALIGNMENT.max_angle).abs() < 6e-3, "{left}");
    pair.begins_to_brake();
    pair.comes_to_rest(50);
    assert!(pair.cause(true).unwrap().text.contains("larger than the slave may turn"));
    pair.sweep(&set, angle, 1.4);
    assert!(pair.cause(false).unwrap().text.contains("larger than the slave may turn"));
    pair.comes_to_rest(300);
}

/// An arm that a person has turned beyond `command_turn` since its start is led back no faster than any other.
#[test]
fn arm_beyond_its_bound_is_turned_no_faster() {
    let bounds = RotationBounds { speed: 2.5, turn: 0.5 };
    let set = off_by(Set { bounds, ..Set::default() }, 0.3);
    let mut pair = Pair::new(set);
    // The arm started at set.start[1]. Turned 1.1 rad the other way from there, it is 1.4 rad off the hand.
    let way = UnitQuaternion::from_scaled_axis(Axes::<3>::new(0.6, 0.0, -0.8) * -1.1);
    let turned_away = way * set.start[1];
    for n in 1..=500 {
        let part = UnitQuaternion::identity().slerp(&way, f64::from(n) / 500.0);
        pair.slave.plant.rotation.as_mut().unwrap().orientation = part * set.start[1];
        pair.tick();
    }
    let ticks = aligns(&mut pair, SPEED, |_| None) as f64;
    let expected = 1.4 / (SPEED * 1e-3);
    assert!((ticks - expected).abs() <= 3.0, "{ticks} ticks, must be {expected}");
    assert!(turned_away.angle_to(&pair.target()) > 1.39 && pair.order().0.angle_to(&pair.target()) < 1e-7);
}

/// After a press during the fade, the hand feels none of the contacts of the arm during the alignment.
#[test]
fn fading_force_has_no_contacts_of_the_alignment() {
    let mut pair = Pair::new(off_by(Set { delays: [0, 0], ..Set::default() }, 0.01));
    aligns(&mut pair, SPEED, |_| None);
    assert_eq!(pair.ticks(400), [Engaged; 2]);
    assert!(pair.pushes());
    pair.press(false);
    let start = pair.master.plant.rotation.unwrap().orientation;
    for n in 1..=25 {
        pair.hand(turned(0.2, 0.0, 0.1).powf(f64::from(n) / 25.0) * start);
        pair.tick();
    }
    pair.press(true);
    let states = pair.ticks(3);
    assert_eq!(states, [Aligning; 2]);
    for n in 0..20 {
        pair.slave.plant.sample[2] = Axes::<3>::new(3.0, 0.0, f64::from(n));
        pair.tick();
        let newest = pair.master.exchange().link().newest().unwrap();
        assert_eq!((newest.force, newest.rotation.unwrap().torque), (Axes::zeros(), Axes::zeros()));
        let gain = pair.master.exchange().ladder().gain();
        assert!(!pair.pushes() && gain > 0.2, "{n}: {gain}");
    }
}

/// Errors midway, and the states they lead to.
#[test]
fn any_error_midway_brakes_the_arm_and_needs_a_new_press() {
    type Wrong = fn(&mut Pair);
    let cases: [(&str, Wrong, usize, Reason); 7] = [
        ("released", |pair| pair.press(false), 11, Reason::ClutchReleased),
        ("silence to the slave", |pair| pair.is_silent[0] = true, 22, Reason::TurnCut),
        // The master hears nothing, and its frames report that one delay later.
        ("silence to the master", |pair| pair.is_silent[1] = true, 32, Reason::TurnCut),
        (
            "a late loop of the slave",
            |pair| {
                let now_ns = pair.tick * MS;
                pair.slave.exchange_mut().stalled(now_ns);
            },
            1,
            Reason::OwnDelay,
        ),
        (
            "an invalid orientation of the hand",
            |pair| pair.hand(Unit::new_unchecked(Quaternion::from([f64::NAN; 4]))),
            11,
            Reason::PeerFaulted,
        ),
        ("no orientation of the hand", |pair| pair.master.plant.rotation = None, 11, Reason::PeerFaulted),
        ("the end of the master", |pair| pair.master.exchange_mut().end(), 11, Reason::ClutchReleased),
    ];
    for (what, wrong, ticks, reason) in cases {
        let set = off_by(Set::default(), 1.4);
        let mut pair = Pair::new(set);
        pair.turn_for(300);
        wrong(&mut pair);
        for n in 1..ticks {
            pair.tick();
            assert_eq!(pair.slave.exchange().state(), Aligning, "{what}: {n}");
        }
        pair.tick();
        assert_eq!(pair.slave.exchange().state(), Disengaged, "{what}");
        assert_eq!(pair.slave.exchange().ladder().history().last().unwrap().reason, reason, "{what}");
        pair.begins_to_brake();
        pair.comes_to_rest(60);
        // The error is over and the clutch may still be closed, but nothing moves.
        pair.is_silent = [false; 2];
        pair.hand(set.start[0]);
        pair.comes_to_rest(300);
        if reason == Reason::TurnCut {
            for of_slave in [false, true] {
                let cause = pair.cause(of_slave).unwrap();
                assert!(
                    cause.text.contains("the slave stopped turning to the master"),
                    "{what}: {}",
                    cause.text
                );
                assert_eq!(cause.steps.last().unwrap().remedy, Remedy::Press);
            }
        }
        if what == "the end of the master" {
            continue;
        }
        let now_ns = pair.tick * MS;
        pair.master.command(now_ns, OperatorCommand::Acknowledge).unwrap();
        pair.press(false);
        pair.ticks(100);
        let stood = pair.order().0;
        pair.press(true);
        let left = stood.angle_to(&pair.target());
        assert!(left > 1.2 && left < 1.3, "{what}: {left}");
        pair.ticks(10 + 2000);
        assert_eq!(pair.slave.exchange().state(), Aligning, "{what}");
        // At most 2.6 s, and back.
        assert_eq!(pair.ticks(600 + 20), [Engaged; 2], "{what}");
        assert!(pair.order().0.angle_to(&pair.target()) < 1e-7);
    }
}

/// A fault of the arm itself is a stop, and its acknowledgement causes no motion.
#[test]
fn a_fault_of_the_arm_midway_stops_it() {
    let mut pair = Pair::new(off_by(Set::default(), 1.4));
    pair.turn_for(300);
    let sound = pair.slave.plant.rotation;
    pair.slave.plant.rotation = None;
    pair.tick();
    assert_eq!((pair.slave.exchange().state(), *pair.slave.plant.order()), (Fault, SlaveOrder::Stop));
    pair.slave.plant.rotation = sound;
    pair.ticks(100);
    pair.slave.command(pair.tick * MS, OperatorCommand::Acknowledge).unwrap();
    for _ in 0..500 {
        pair.tick();
        assert_eq!(*pair.slave.plant.order(), SlaveOrder::Stop);
    }
    assert_eq!(pair.slave.exchange().state(), Disengaged);
}

/// A hand that the arm never reaches is followed within the speed limit until the press times out.
#[test]
fn unreachable_hand_is_followed_until_the_press_times_out() {
    let set = off_by(Set::default(), 1.2);
    let mut pair = Pair::new(set);
    let axis = Axes::<3>::new(0.6, 0.0, -0.8);
    pair.press(true);
    let mut before = set.start[1];
    let mut whole = 0.0;
    for n in 0..5400_u32 {
        let way = UnitQuaternion::from_scaled_axis(axis * (1.2 + SPEED * 1e-3 * f64::from(n)));
        pair.hand(set.frame.inverse() * way * set.start[1] * set.frame);
        let [master, slave] = pair.tick();
        assert!(!master.is_coupled() && !slave.is_coupled() && !pair.pushes(), "{n}");
        if n >= 10 {
            let now = pair.order().0;
            assert!(now.angle_to(&before) <= SPEED * 1e-3 + ROUNDING, "{n}");
            whole += now.angle_to(&before);
            before = now;
        }
    }
    assert_eq!(pair.tick(), [Disengaged; 2]);
    let last = pair.master.exchange().ladder().history().last().unwrap();
    assert_eq!(last.reason, Reason::AlignTimedOut);
    assert!((whole - 5.0 * SPEED).abs() < 0.05, "{whole}");
    pair.comes_to_rest(200);
}

/// A loop that wakes late does not make up for it at once.
#[test]
fn a_late_tick_turns_no_further_than_two_of_them() {
    let mut pair = Pair::new(off_by(Set::default(), 1.4));
    pair.turn_for(200);
    for late in [3, 9, 15] {
        let before = pair.order().0;
        for _ in 1..late {
            pair.tick_at(false);
        }
        pair.tick();
        let step = pair.order().0.angle_to(&before);
        assert!((step - 2.0 * SPEED * 1e-3).abs() < ROUNDING, "{step}");
        pair.ticks(100);
    }
}

/// A press of a master that does not hear the arm turns nothing until it does, and nothing at all if that is too late.
#[test]
fn a_press_of_a_deaf_master_turns_nothing() {
    for (deaf_for, is_late) in [(20, false), (100, true)] {
        let mut pair = Pair::new(off_by(Set::default(), 0.5));
        pair.is_silent[1] = true;
        pair.ticks(40);
        pair.press(true);
        pair.ticks(pair.delays[0] + 1);
        for tick in 0..deaf_for {
            pair.tick();
            let expected = if tick < 60 { Aligning } else { Disengaged };
            assert!((45..60).contains(&tick) || pair.slave.exchange().state() == expected, "{tick}");
            assert_eq!(*pair.slave.plant.order(), SlaveOrder::Wait);
        }
        pair.is_silent[1] = false;
        pair.ticks(12);
        if is_late {
            pair.ticks(1030);
            assert_eq!(*pair.slave.plant.order(), SlaveOrder::Wait);
            let last = pair.slave.exchange().ladder().history().last().unwrap();
            assert_eq!((last.to, last.reason), (Disengaged, Reason::PeerDeaf));
        } else {
            assert_ne!(*pair.slave.plant.order(), SlaveOrder::Wait);
            // 0.5 rad at 0.5 rad/s, and back.
            assert_eq!(pair.ticks(1030), [Engaged; 2]);
        }
    }
}

/// The same after a hold: a new press first turns the arm, from where it stands.
#[test]
fn a_press_after_a_hold_turns_it_first() {
    let set = off_by(Set::default(), 0.2);
    let mut pair = Pair::new(set);
    aligns(&mut pair, SPEED, |_| None);
    pair.ticks(400);
    pair.is_silent = [true; 2];
    pair.ticks(60);
    assert_eq!(pair.slave.exchange().state(), Hold);
    let stood = pair.order().0;
    pair.is_silent = [false; 2];
    pair.sweep(&set, 0.2, 1.0);
    assert_eq!(pair.tick(), [Hold; 2]);
    pair.ticks(60);
    pair.press(false);
    pair.ticks(60);
    assert!(pair.order().0.angle_to(&stood) < ROUNDING);
    pair.press(true);
    // 0.8 rad are left.
    pair.ticks(1500);
    assert_eq!(pair.slave.exchange().state(), Aligning);
    assert!(!pair.pushes());
    assert_eq!(pair.ticks(200), [Engaged; 2]);
    assert!(pair.order().0.angle_to(&pair.target()) < 1e-7);
}

/// Without the setting both engage at once in any orientation, and the arm keeps its orientation.
#[test]
fn without_alignment_sides_engage_as_they_are() {
    let set = off_by(Set { alignment: None, ..Set::default() }, 2.5);
    let mut pair = Pair::new(set);
    pair.press(true);
    pair.ticks(pair.delays[0]);
    assert_eq!(pair.tick(), [Aligning, Engaged]);
    assert!(pair.order().0.angle_to(&set.start[1]) < ROUNDING);
}

#[test]
fn invalid_alignment_is_refused_with_its_reason() {
    let good = rotation_settings(&Set::default());
    let with = |speed, max_angle| SlaveRotationSettings {
        alignment: Some(AlignmentSettings { speed, max_angle }),
        ..good
    };
    let axis = RotationLock::only_about([0.0, 0.0, 1.0]).unwrap();
    for (settings, text) in [
        (SlaveRotationSettings { rotation_scale: 2.0, ..good }, "rotation_scale = 2: must be 1"),
        (SlaveRotationSettings { lock: RotationLock::Locked, ..good }, "locks_rotation and rotation_axis"),
        (SlaveRotationSettings { lock: axis, ..good }, "locks_rotation and rotation_axis"),
        (with(0.0, 1.0), "alignment_speed (w_max) = 0"),
        (with(f64::NAN, 1.0), "alignment_speed (w_max) = NaN"),
        (with(1.0, 0.0), "alignment_angle = 0 rad"),
        (with(1.0, 3.2), "alignment_angle = 3.2 rad"),
        (with(2.6, 1.0), "must be at most command_angular_speed = 2.5"),
        (with(0.25, 1.001), "alignment.max_angle / alignment.speed = 4.004 s: must be at most 4 s"),
    ] {
        let error = SlaveEndpoint::<3>::of_pose(&slave_settings(), &settings).unwrap_err().to_string();
        assert!(error.starts_with(text) || error.contains(text), "{error}");
    }
    SlaveEndpoint::<3>::of_pose(&slave_settings(), &with(0.25, 1.0)).unwrap();
    // The scale may not be changed during a run either.
    let mut endpoint = SlaveEndpoint::<3>::of_pose(&slave_settings(), &good).unwrap();
    let error = endpoint.command(0, OperatorCommand::RotationScale(1.5)).unwrap_err().to_string();
    assert!(error.contains("rotation_scale = 1.5: must be 1"), "{error}");
    endpoint.command(0, OperatorCommand::RotationScale(1.0)).unwrap();
}
