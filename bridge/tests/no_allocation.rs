//! A tick allocates nothing. A custom allocator counts, with every observer and controller on.
#![allow(clippy::unwrap_used)] // a test may

use std::{io::Read, os::unix::net::UnixStream};

use haptether_bridge::{
    Clutch, DrivenMaster, HeldTrigger, LadderSettings, LadderState, LinkTime, MasterEndpoint,
    MasterRotationSettings, MasterSettings, MasterSide, Side, SlaveEndpoint, SlaveGripper,
    SlaveRotationSettings, SlaveSettings, SlaveSide, TickTime, Trigger, TriggerSettings, TurningMaster,
    coupling::{AlignmentSettings, CommandBounds, RotationBounds, RotationLock},
    live::{
        DriverLoop, LiveSettings, Newest, PeerAddress, PeerSocket, RealtimeDemand, RealtimeSettings,
        RecordOutputs, Security, paced_by_device,
    },
    recorder::SecurityMark,
    session::{Incoming, MAX_DATAGRAM, PreSharedKey, Received, SessionEnd, SessionSettings, SystemEntropy},
    telemetry::{Telemetry, TelemetrySettings},
    wire::{FrameLayout, MAX_FRAME, Role},
};
use haptether_bridge::{
    path::{MAX_DRIFT_PPB, PacketAge, PathMeter, PeerClock, TimestampExchange},
    playout::{Playout, PlayoutSettings},
};
use haptether_master::{
    Aim, DeviceParameters, Hand, Leg, LegShape, Path, Release, ReleaseKind, RotationHand,
    RotationHandParameters, RotationLeg, RotationParameters, SimulatedMaster, SimulatedRotation,
};
use haptether_safety::{
    Axes, DeviceModel, LimiterSettings, RotationModel,
    controller::{ControllerKind, SafetySettings},
    estimator::{EstimatorKind, Fit},
};
use haptether_slave::{
    ArmControl, ArmModel, ArmSettings, ControlKind, Environment, GripperSettings, HandleSettings, Push,
    PushShape, Pusher, RigidBodySettings, SimulatedSlave, SimulatedTool, ToolSettings, ToolWorldSettings,
};

#[path = "../../numeric/tests/allocations/mod.rs"]
mod allocations;
#[path = "all/arms.rs"]
mod arms;

use allocations::allocations;
use arms::arm_before_wall;

const MS: u64 = 1_000_000;

#[test]
fn a_tick_of_both_sides_allocates_nothing() {
    for estimator in [
        EstimatorKind::BackwardDifference {},
        EstimatorKind::LowPass { cutoff_hz: 30.0 },
        EstimatorKind::AdaptiveWindow { noise_bound_m: 2.3e-5, max_window: 32, fit: Fit::Best },
        EstimatorKind::SavitzkyGolay { degree: 2, window: 21 },
        EstimatorKind::default(),
    ] {
        let legs = vec![Leg { duration_s: 0.5, end: Axes::<1>::new(-0.03), shape: LegShape::MinimumJerk }];
        let path = Path::new(Axes::<1>::new(0.02), legs).unwrap();
        let release = Some(Release { at_s: 1.2, decay_s: 0.05, kind: ReleaseKind::Strength });
        let hand = Hand::new(300.0, 8.0, 12.0, path, release).unwrap();
        let stops = (Axes::<1>::new(-0.08), Axes::<1>::new(0.08));
        let device = DeviceParameters { stops, ..DeviceParameters::phantom_desktop() };
        let mut plant = SimulatedMaster::new(device, hand, 0).unwrap();
        plant.set_waiting(true);
        let safety = SafetySettings { controllers: ControllerKind::ALL.into(), ..SafetySettings::default() };
        let endpoint = MasterEndpoint::new(&MasterSettings {
            period_ns: MS,
            run_id: 1,
            device: DeviceModel::phantom_desktop(),
            estimator,
            safety,
            limiter: LimiterSettings::default(),
            force_scale: 1.0,
            ladder: LadderSettings::default(),
        })
        .unwrap();
        let trigger = Trigger::simulated(&[[0.1, 0.0], [0.5, 1.0]]).unwrap();
        let mut master = MasterSide::new(plant, endpoint, Clutch::Once).unwrap().with_trigger(Some(trigger));
        let settings = SlaveSettings {
            period_ns: MS,
            run_id: 2,
            position_scale: 1.0,
            bounds: CommandBounds::default(),
            ladder: LadderSettings::default(),
        };
        let pusher = Pusher::shaped(PushShape::Ramp { rise_s: 0.1 }, 0.8, 1.0, Axes::<1>::new(3.0)).unwrap();
        let plant = arm_before_wall(0.0, Some(pusher), 0.02);
        let jaws = GripperSettings { position: 0.0, speed: 2.0, force_n: 40.0, object: Some(0.6) };
        let gripper = SlaveGripper::simulated(jaws).unwrap();
        let mut slave =
            SlaveSide::new(plant, SlaveEndpoint::new(&settings).unwrap()).with_gripper(Some(gripper));
        let mut buffer = [0; MAX_FRAME];
        let (mut tripped, mut holds) = (false, false);

        let before = allocations();
        for tick in 0..2000 {
            let now_ns = tick * MS;
            tripped |= master.tick(TickTime::at(now_ns)).tripped != 0;
            let _ = slave.receive(LinkTime::at(now_ns), master.send(LinkTime::at(now_ns), &mut buffer));
            holds |= slave.tick(TickTime::at(now_ns)).holds_object;
            let _ = master.receive(LinkTime::at(now_ns), slave.send(LinkTime::at(now_ns), &mut buffer));
            let _ = master.receive(LinkTime::at(now_ns), &[0; FrameLayout::of(1).length()]);
        }
        let allocated = allocations() - before;

        assert_eq!(allocated, 0, "{estimator:?}");
        assert!(
            tripped && holds && master.exchange().state() == LadderState::Engaged,
            "the run must have done something"
        );
    }
}

#[test]
fn an_aim_and_a_push_allocate_nothing() {
    let hand = Hand::absent(Axes::<1>::new(0.02)).unwrap();
    let mut master =
        SimulatedMaster::new(DeviceParameters::phantom_desktop(), hand, 0).unwrap().aimed().unwrap();
    let arm = ArmModel::new(ArmControl::Position { bandwidth_hz: 15.0 }, 4.0, Some(1.0), None).unwrap();
    let surroundings = Environment::empty().to_be_pushed();
    let mut slave = SimulatedSlave::in_environment(arm, surroundings, None, Axes::<1>::new(0.02), 0).unwrap();
    slave.start(0);
    let (mut lowest, mut pushed) = (f64::INFINITY, 0);
    let before = allocations();
    for tick in 0..1000 {
        if tick % 33 == 0 && tick < 300 {
            let target = Axes::<1>::new(-0.001 * tick as f64);
            assert!(master.aim(&Aim {
                target,
                over_s: 0.033,
                stiffness: 300.0,
                damping: 5.0,
                strength_n: 6.0
            }));
            assert!(slave.push(tick * MS, &Push { force_n: Axes::<1>::new(2.0), duration_s: 0.01 }));
        }
        lowest = master.read(tick * MS).position[0].min(lowest);
        pushed += u64::from(slave.read(tick * MS).environment_force[0] == 2.0);
    }
    assert_eq!(allocations() - before, 0);
    assert!(lowest < -0.2 && pushed == 100, "the run must have done something: {lowest} {pushed}");
}

#[test]
fn a_tick_of_a_trigger_that_is_felt_allocates_nothing() {
    let safety = SafetySettings { controllers: ControllerKind::ALL.into(), ..SafetySettings::default() };
    let endpoint = MasterEndpoint::new(&MasterSettings {
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
    .with_trigger(&TriggerSettings {
        travel_m: 0.03,
        device: DeviceModel::uniform(0.05, 0.0, 0.0).unwrap(),
        estimator: EstimatorKind::default(),
        safety: SafetySettings { damping: 10.0, pc_max_damping: 10.0, ..safety.at_scale(0.6, 0.2) },
        limiter: LimiterSettings::default(),
        force_scale: 0.05,
    })
    .unwrap();
    let close = Leg { duration_s: 0.5, end: Axes::<1>::new(0.03), shape: LegShape::Linear };
    let release = Some(Release { at_s: 1.2, decay_s: 0.05, kind: ReleaseKind::Gain });
    let path = Path::new(Axes::zeros(), vec![close]).unwrap();
    let finger = Hand::new(300.0, 3.0, f64::INFINITY, path, release).unwrap();
    let held = HeldTrigger::new(DeviceParameters::ideal(0.05, 0.0, 0.0), 0.03, finger).unwrap();
    let path = Path::new(Axes::<1>::zeros(), Vec::new()).unwrap();
    let hand = Hand::new(300.0, 8.0, 12.0, path, None).unwrap();
    let plant = SimulatedMaster::new(DeviceParameters::phantom_desktop(), hand, 0).unwrap();
    let mut master = MasterSide::new(plant, endpoint, Clutch::Once)
        .unwrap()
        .with_trigger(Some(Trigger::Held(Box::new(held))))
        .recording_trigger();
    let settings = SlaveSettings {
        period_ns: MS,
        run_id: 2,
        position_scale: 1.0,
        bounds: CommandBounds::default(),
        ladder: LadderSettings::default(),
    };
    let plant = arm_before_wall(1.0, None, 2.0);
    let jaws = GripperSettings { position: 0.0, speed: 2.0, force_n: 40.0, object: Some(0.6) };
    let mut slave = SlaveSide::new(plant, SlaveEndpoint::new(&settings).unwrap())
        .with_gripper(Some(SlaveGripper::simulated(jaws).unwrap()));
    let mut buffer = [0; MAX_FRAME];
    let (mut tripped, mut felt) = (false, 0.0_f64);

    let before = allocations();
    for tick in 0..2000 {
        let now_ns = tick * MS;
        let finger = master.tick(TickTime::at(now_ns)).rotation.finger;
        (tripped, felt) = (tripped || finger.tripped != 0, felt.min(finger.device_force));
        let _ = slave.receive(LinkTime::at(now_ns), master.send(LinkTime::at(now_ns), &mut buffer));
        slave.tick(TickTime::at(now_ns));
        let _ = master.receive(LinkTime::at(now_ns), slave.send(LinkTime::at(now_ns), &mut buffer));
    }
    let allocated = allocations() - before;

    assert_eq!(allocated, 0);
    assert!(tripped && felt < -1.0, "the run must have done something: {tripped} {felt}");
}

/// A hand that moves, turns and lets go.
fn turning_master() -> TurningMaster<SimulatedMaster<3>> {
    let release = Some(Release { at_s: 1.2, decay_s: 0.05, kind: ReleaseKind::Strength });
    let legs =
        vec![Leg { duration_s: 0.5, end: Axes::<3>::new(0.0, 0.02, 0.0), shape: LegShape::MinimumJerk }];
    let path = Path::new(Axes::<3>::zeros(), legs).unwrap();
    let hand = Hand::new(300.0, 8.0, 12.0, path, release).unwrap();
    let mut point = SimulatedMaster::new(DeviceParameters::<3>::phantom_desktop(), hand, 0).unwrap();
    point.set_waiting(true);
    let end_wxyz = [0.5_f64.cos(), 0.0, 0.0, 0.5_f64.sin()];
    let hand = RotationHandParameters {
        stiffness: 3.0,
        damping: 0.03,
        strength_n_m: Some(1.0),
        start_wxyz: [1.0, 0.0, 0.0, 0.0],
        legs: vec![RotationLeg { duration_s: 0.5, end_wxyz, shape: LegShape::MinimumJerk }],
        release,
    };
    let device = RotationParameters::ideal(1e-4, 1e-4, 0.0);
    let mut body = SimulatedRotation::new(device, RotationHand::new(&hand).unwrap(), 0).unwrap();
    body.set_waiting(true);
    TurningMaster { point, body }
}

/// A tool with a body between its jaws and a handle next to it.
fn holding_tool(turned_rad: f64) -> SimulatedTool {
    let turned = 0.5 * turned_rad;
    let arm = ArmSettings {
        control: ControlKind::Pd,
        mass_kg: 0.5,
        bandwidth_hz: 10.0,
        stiffness: 1250.0,
        damping: 50.0,
        max_speed: None,
        max_acceleration: None,
        takes_force: false,
        viscous: 0.0,
        max_force_n: 50.0,
        max_torque_nm: 5.0,
        speed_bound: None,
        period_s: 1e-3,
        position: Axes::<3>::zeros(),
        force_sensor: None,
        gripper: None,
        tool: None,
    };
    let tool = ToolSettings {
        inertia_kg_m2: Axes::<3>::repeat(1e-3),
        rotational_stiffness: 3.6,
        rotational_damping: 0.12,
        max_angular_speed: None,
        quat_wxyz: [turned.cos(), 0.0, 0.0, turned.sin()],
        points: vec![[0.0; 3]],
        jaw_width_m: 0.08,
        jaw_friction: 0.5,
        jaw_stiffness: 2e4,
        jaw_radius_m: 0.01,
    };
    let body = RigidBodySettings {
        mass_kg: 0.5,
        half_extents: [0.016, 0.02, 0.03],
        position: [0.0; 3],
        quat_wxyz: [1.0, 0.0, 0.0, 0.0],
        gravity: 0.0,
    };
    let handle = HandleSettings {
        point: [1.0, 0.0, 0.0],
        axis: [0.0, 0.0, 1.0],
        grip: [1.1, 0.0, 0.0],
        reach_m: 0.02,
        width_m: 0.02,
        inertia_kg_m2: 0.01,
        viscous: 0.01,
        coulomb: 0.01,
        stiffness: 0.1,
        stops_rad: [-2.0, 2.0],
        hold_stiffness: 5e3,
        hold_rotational_stiffness: 20.0,
    };
    let world =
        ToolWorldSettings { bodies: vec![body], handles: vec![handle], ..ToolWorldSettings::default() };
    SimulatedTool::new(&arm, &tool, &world, 0).unwrap()
}

#[test]
fn a_tick_of_two_poses_with_a_gripper_allocates_nothing() {
    poses_allocate_nothing(None);
}

#[test]
fn a_tick_of_an_arm_that_is_aligned_first_allocates_nothing() {
    poses_allocate_nothing(Some(AlignmentSettings { speed: 0.5, max_angle: 1.0 }));
}

fn poses_allocate_nothing(alignment: Option<AlignmentSettings>) {
    let safety = SafetySettings { controllers: ControllerKind::ALL.into(), ..SafetySettings::default() };
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
    let trigger = Trigger::simulated(&[[0.1, 0.0], [0.5, 1.0]]).unwrap();
    let mut master = MasterSide::new(turning_master(), endpoint, Clutch::Once)
        .unwrap()
        .with_trigger(Some(trigger))
        .recording_rotation();
    let settings = SlaveSettings {
        period_ns: MS,
        run_id: 2,
        position_scale: 1.0,
        bounds: CommandBounds::default(),
        ladder: LadderSettings::default(),
    };
    let rotation = SlaveRotationSettings {
        rotation_scale: if alignment.is_some() { 1.0 } else { 1.5 },
        lock: RotationLock::Free,
        bounds: RotationBounds::default(),
        alignment,
    };
    let jaws = GripperSettings { position: 0.0, speed: 2.0, force_n: 40.0, object: Some(0.6) };
    let endpoint = SlaveEndpoint::of_pose(&settings, &rotation).unwrap();
    let mut slave = SlaveSide::new(holding_tool(if alignment.is_some() { 0.1 } else { 0.0 }), endpoint)
        .with_gripper(Some(SlaveGripper::simulated(jaws).unwrap()))
        .recording_rotation();
    let mut buffer = [0; MAX_FRAME];
    let (mut tripped, mut holds, mut turned, mut aligning) = (false, false, 0.0_f64, 0);

    let before = allocations();
    for tick in 0..2000 {
        let now_ns = tick * MS;
        let record = master.tick(TickTime::at(now_ns));
        tripped |= record.tripped != 0 || record.rotation.tripped != 0;
        aligning += u64::from(master.exchange().state() == LadderState::Aligning);
        let _ = slave.receive(LinkTime::at(now_ns), master.send(LinkTime::at(now_ns), &mut buffer));
        let record = slave.tick(TickTime::at(now_ns));
        holds |= record.holds_object;
        turned = turned.max(record.rotation.orientation[3].abs());
        let _ = master.receive(LinkTime::at(now_ns), slave.send(LinkTime::at(now_ns), &mut buffer));
    }
    let allocated = allocations() - before;

    assert_eq!(allocated, 0);
    assert!(master.exchange().state() == LadderState::Engaged, "{:?}", master.exchange().state());
    assert!(tripped && holds && turned > 0.1, "{tripped} {holds} {turned}");
    // 0.1 rad at 0.5 rad/s, less the alignment tolerance.
    assert_eq!(aligning > 100, alignment.is_some(), "{aligning} ms");
}

#[test]
fn clock_age_playout_and_statistics_allocate_nothing() {
    let settings = PlayoutSettings { capacity: 64, ..PlayoutSettings::new(5 * MS) };
    let mut playout = Playout::new(settings).unwrap();
    let mut clock = PeerClock::new(MAX_DRIFT_PPB);
    let mut age = PacketAge::new(MAX_DRIFT_PPB);
    let mut meter = PathMeter::new();
    let before = allocations();
    let (mut played, mut now_ns) = (0, 0);
    for n in 0..50_000_u64 {
        // Delays of 20 to 30 ms, and one permanent change of path and clock.
        let delay_ns = 20 * MS + n * 7919 % 9973 * 1_000 + if n > 20_000 { 300 * MS } else { 0 };
        let sent_ns = n * MS;
        now_ns = (sent_ns + delay_ns).max(now_ns);
        let peer_ns = if n > 40_000 { 9_000_000 * MS } else { 0 } + now_ns;
        age.sent(n, sent_ns);
        let _ = age.received(now_ns, (n, 0));
        let times = TimestampExchange {
            sent_ns,
            peer_received_ns: peer_ns,
            peer_sent_ns: peer_ns,
            received_ns: now_ns,
        };
        let _ = clock.take(&times);
        meter.arrived(n, sent_ns, now_ns);
        playout.arrived(n, sent_ns, now_ns, [0.0; 8]);
        while playout.next_due(now_ns).is_some() {
            played += 1;
        }
    }
    assert!(played > 10_000 && meter.statistics(0).received == 50_000 && age.max_ns(now_ns).is_some());
    meter.restart();
    assert_eq!(meter.statistics(0).received, 0);
    assert_eq!(clock.steps(), 1);
    assert_eq!(allocations() - before, 0);
}

#[test]
fn sealing_and_opening_allocate_nothing() {
    let key = || PreSharedKey::new(b"the key that both ends share: 32").unwrap();
    let settings = |role| SessionSettings::new(role, 92, MS);
    let mut entropy = SystemEntropy::new();
    let mut master = SessionEnd::secure(settings(Role::Master), key(), &mut entropy).unwrap();
    let mut slave = SessionEnd::secure(settings(Role::Slave), key(), &mut entropy).unwrap();
    let mut hello = master.poll(0, &mut entropy).unwrap().unwrap();
    let Ok(Received::Reply(mut answer)) = slave.receive(0, &mut hello, &mut entropy) else {
        panic!("an authentic hello is answered");
    };
    master.receive(0, &mut answer, &mut entropy).unwrap();
    let (mut buffer, mut taken) = ([0; MAX_DATAGRAM], 0);

    let before = allocations();
    for tick in 0..5000_u64 {
        let now_ns = tick * MS;
        master.session.advance(now_ns);
        let length = master.session.seal(now_ns, &[7; 92], &mut buffer).unwrap().len();
        let mut forged = buffer;
        forged[60] ^= 1;
        assert!(slave.session.open(now_ns, &mut forged[..length]).is_err());
        let opened = slave.session.open(now_ns, &mut buffer[..length]);
        taken += u64::from(matches!(opened, Ok(Incoming::Payload { payload, .. }) if payload == [7; 92]));
        let length = slave.session.seal(now_ns, &[8; 92], &mut buffer).unwrap().len();
        taken += u64::from(master.session.open(now_ns, &mut buffer[..length]).is_ok());
    }
    let allocated = allocations() - before;

    assert_eq!((allocated, taken), (0, 10_000));
}

/// A loop whose device fails: its diagnosis and every record go to observers.
#[test]
fn tick_of_an_observed_loop_allocates_nothing() {
    let endpoint = MasterEndpoint::new(&MasterSettings {
        period_ns: MS,
        run_id: 1,
        device: DeviceModel::uniform(0.1, 0.0, 0.0).unwrap(),
        estimator: EstimatorKind::default(),
        safety: SafetySettings::default(),
        limiter: LimiterSettings::default(),
        force_scale: 1.0,
        ladder: LadderSettings::default(),
    })
    .unwrap();
    let side = MasterSide::new(DrivenMaster::<1>::default(), endpoint, Clutch::Once).unwrap();
    let settings = LiveSettings {
        role: Role::Master,
        period_ns: MS,
        duration_ns: None,
        patience_ns: None,
        started_ns: None,
        realtime: RealtimeSettings { demand: RealtimeDemand::Off, ..RealtimeSettings::default() },
    };
    let socket = PeerSocket::bind("127.0.0.1:0".parse().unwrap(), PeerAddress::Learned).unwrap();
    let path = std::env::temp_dir().join(format!("haptether-no-allocation-{}", std::process::id()));
    let telemetry = Telemetry::begin(&TelemetrySettings {
        path: path.clone(),
        security: SecurityMark::Insecure,
        scene: String::new(),
    });
    let outputs = RecordOutputs {
        newest: Newest::of(200).unwrap(),
        telemetry: Some(telemetry.unwrap()),
        ..RecordOutputs::default()
    };
    let mut reader = UnixStream::connect(&path).unwrap();
    let (mut paced, mut watch, _records) =
        paced_by_device(side, socket, settings, Security::Insecure, outputs).unwrap();
    paced.begin().unwrap();

    let before = allocations();
    for tick in 0..300 {
        let fails = |side: &mut MasterSide<DrivenMaster<1>, 1>| {
            if tick == 100 {
                side.exchange_mut().device_failed(None);
            }
        };
        paced.step(None, fails, |_| {}).unwrap();
        paced.wait();
    }
    let allocated = allocations() - before;

    assert!(watch.diagnosis().is_some());
    paced.end();
    let mut seen = String::new();
    reader.read_to_string(&mut seen).unwrap();
    assert!(
        [r#""kind":"cause""#, r#""kind":"sample""#, r#""kind":"end""#].iter().all(|kind| seen.contains(kind))
    );
    assert_eq!(allocated, 0);
}
