//! A hand that turns and an arm that follows it, through a delay, in virtual time.
#![allow(clippy::unwrap_used)] // a test may

use std::collections::VecDeque;

use haptether_bridge::{
    Clutch, DrivenMaster, DrivenSlave, LadderSettings, LadderState, LinkTime, MasterEndpoint, MasterRotation,
    MasterRotationSettings, MasterSettings, MasterSide, OperatorCommand, Side, SlaveEndpoint, SlaveOrder,
    SlaveRotation, SlaveRotationSettings, SlaveSettings, SlaveSide, TickTime,
    coupling::{CommandBounds, RotationBounds, RotationLock, RotationState},
    wire::MAX_FRAME,
};
use haptether_master::RotationSample;
use haptether_safety::{
    Axes, DeviceModel, LimiterSettings, RotationModel, controller::SafetySettings, estimator::EstimatorKind,
};
use nalgebra::{Quaternion, Unit, UnitQuaternion};

const MS: u64 = 1_000_000;
/// One way, in ticks.
const DELAY: usize = 10;
const SCALE: f64 = 1.5;

struct Pair {
    master: MasterSide<DrivenMaster<3>, 3, MasterRotation>,
    slave: SlaveSide<DrivenSlave<3>, 3, SlaveRotation>,
    under_way: [VecDeque<Vec<u8>>; 2],
    is_silent: bool,
    tick: u64,
}

fn turned(x: f64, y: f64, z: f64) -> UnitQuaternion<f64> {
    UnitQuaternion::from_scaled_axis(Axes::<3>::new(x, y, z))
}

impl Pair {
    fn new(bounds: RotationBounds) -> Self {
        let safety = SafetySettings::default();
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
            safety: SafetySettings { damping: 0.01, pc_max_damping: 0.01, ..safety.at_lever(0.05) },
            limiter: LimiterSettings::default().at_lever(0.05),
            torque_scale: 1.0,
            shares_trips: true,
        };
        let endpoint = MasterEndpoint::of_pose(&settings, &rotation, RotationLock::Free).unwrap();
        let master = MasterSide::new(DrivenMaster::default(), endpoint, Clutch::Once).unwrap().turning();
        let settings = SlaveSettings {
            period_ns: MS,
            run_id: 2,
            position_scale: 1.0,
            bounds: CommandBounds::default(),
            ladder: LadderSettings::default(),
        };
        let rotation = SlaveRotationSettings { rotation_scale: SCALE, lock: RotationLock::Free, bounds };
        let endpoint = SlaveEndpoint::of_pose(&settings, &rotation).unwrap();
        let slave = SlaveSide::new(DrivenSlave::new(5.0).unwrap(), endpoint).turning();
        let mut pair = Self { master, slave, under_way: Default::default(), is_silent: false, tick: 0 };
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

    fn tick(&mut self) -> [LadderState; 2] {
        let (now, time) = (LinkTime::at(self.tick * MS), TickTime::at(self.tick * MS));
        let mut buffer = [0; MAX_FRAME];
        let [to_slave, to_master] = &mut self.under_way;
        let states = [self.master.tick(time).state, {
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
        // Rounding of an angle that is taken by an inverse cosine: 3e-8 at 0.
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

#[test]
fn an_orientation_that_is_none_is_a_fault_without_force_or_torque() {
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
