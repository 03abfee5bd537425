//! Failing devices: a person's command given before the failure is visible does not clear it.
#![allow(clippy::unwrap_used)] // a test may

use std::{f64::consts::PI, net::SocketAddr, ops::ControlFlow, time::Duration};

use haptether_bridge::{
    Clutch, DrivenMaster, DrivenSlave, Event, FaultText, LadderSettings, LadderState, LinkTime,
    MasterEndpoint, MasterSettings, MasterSide, OperatorCommand, Side, SlaveEndpoint, SlaveReading,
    SlaveRotationSettings, SlaveSettings, SlaveSide, TickTime, VirtualSettings,
    coupling::{CommandBounds, RotationBounds, RotationLock, RotationState},
    live::{
        DriverLoop, Ineffective, LiveSettings, Newest, Paced, PacedLoop, PeerAddress, PeerSocket,
        RealtimeDemand, RealtimeSettings, RecordOutputs, Security, now_ns, paced_by_device,
    },
    run_virtual,
    scene::{SceneSpec, driven_master, simulated_master, simulated_slave},
    wire::{MAX_FRAME, Role},
};
use haptether_netsim::LinkSettings;
use haptether_safety::{
    Axes, DeviceModel, Fault, LimiterSettings, Signal, controller::SafetySettings, estimator::EstimatorKind,
};
use nalgebra::UnitQuaternion;

const MS: u64 = 1_000_000;

fn master() -> MasterSide<DrivenMaster<1>, 1> {
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
    MasterSide::new(DrivenMaster::default(), endpoint, Clutch::Once).unwrap()
}

fn slave() -> SlaveSide<DrivenSlave<1>, 1> {
    let endpoint = SlaveEndpoint::new(&SlaveSettings {
        period_ns: MS,
        run_id: 2,
        position_scale: 1.0,
        bounds: CommandBounds::default(),
        ladder: LadderSettings::default(),
    })
    .unwrap();
    SlaveSide::new(DrivenSlave::new(2.0).unwrap(), endpoint)
}

/// Access of a test to a side.
trait Seen: Side + Send + 'static {
    fn spoil(&mut self, bad: bool);
    /// State of the ladder, and code of the fault.
    fn shown(record: &Self::Record) -> (LadderState, u8)
    where
        Self: Sized;
}

impl Seen for MasterSide<DrivenMaster<1>, 1> {
    fn spoil(&mut self, bad: bool) {
        self.plant.position[0] = if bad { f64::NAN } else { 0.0 };
    }

    fn shown(record: &Self::Record) -> (LadderState, u8) {
        (record.state, record.fault)
    }
}

impl Seen for SlaveSide<DrivenSlave<1>, 1> {
    fn spoil(&mut self, bad: bool) {
        self.plant.sample[0][0] = if bad { f64::NAN } else { 0.0 };
    }

    fn shown(record: &Self::Record) -> (LadderState, u8) {
        (record.state, record.fault)
    }
}

/// Events of one tick.
#[derive(Clone, Copy)]
struct Met {
    acknowledged: bool,
    failed: bool,
    bad: bool,
}

const NOTHING: Met = Met { acknowledged: false, failed: false, bad: false };

/// Run ticks with these events. The failure is reported before the commands of the same tick, as in a loop, or after
/// them.
fn ticks<S: Seen>(mut side: S, failed_first: bool, met: &[Met]) -> Vec<(LadderState, u8)> {
    side.begin(0);
    let mut tick = |(n, met): (u64, &Met)| {
        let now_ns = n * MS;
        if met.failed && failed_first {
            side.exchange_mut().device_failed(None);
        }
        if met.acknowledged {
            side.command(now_ns, OperatorCommand::Acknowledge).unwrap();
        }
        if met.failed && !failed_first {
            side.exchange_mut().device_failed(None);
        }
        side.spoil(met.bad);
        S::shown(&side.tick(TickTime::at(now_ns)))
    };
    (0..).zip(met).map(&mut tick).collect()
}

fn failure_outlasts_commands_of_its_tick<S: Seen>(side: impl Fn() -> S) {
    let failed = Met { failed: true, ..NOTHING };
    let bad = Met { bad: true, ..NOTHING };
    let acknowledged = Met { acknowledged: true, ..NOTHING };
    let both = Met { acknowledged: true, ..failed };
    let device = (LadderState::Fault, Fault::Device.code());
    for failed_first in [true, false] {
        let run = |met: &[Met]| ticks(side(), failed_first, met);
        // One sample reports the failure, and no later one does.
        let seen = run(&[NOTHING, both, NOTHING, NOTHING, acknowledged, NOTHING]);
        assert_eq!(seen[1..4], [device; 3], "{failed_first}");
        // After that it can be acknowledged like any other fault.
        for (state, fault) in &seen[4..] {
            assert!(*state != LadderState::Fault && *fault == 0, "{failed_first} {state:?} {fault}");
        }
        // The acknowledgement applies to the earlier fault; the new one stays, with its own code.
        let seen = run(&[NOTHING, bad, NOTHING, both, NOTHING]);
        assert!(seen[2].0 == LadderState::Fault && seen[2].1 != device.1, "{failed_first}");
        assert_eq!(seen[3..], [device; 2], "{failed_first}");
    }
}

#[test]
fn failure_outlasts_an_acknowledgement_of_the_same_tick() {
    failure_outlasts_commands_of_its_tick(master);
    failure_outlasts_commands_of_its_tick(slave);
}

/// Start a loop with a driver in this test and without a peer.
fn paced<S: Seen>(side: S, role: Role) -> Paced<S> {
    started(side, role, None)
}

/// Start a loop that a person started at a time of the monotonic clock.
fn started<S: Seen>(side: S, role: Role, started_ns: Option<u64>) -> Paced<S> {
    let local: SocketAddr = "127.0.0.1:0".parse().unwrap();
    let settings = LiveSettings {
        role,
        period_ns: MS,
        duration_ns: None,
        patience_ns: None,
        started_ns,
        realtime: RealtimeSettings { demand: RealtimeDemand::Off, ..RealtimeSettings::default() },
    };
    let socket = PeerSocket::bind(local, PeerAddress::Learned).unwrap();
    let outputs = RecordOutputs { newest: Newest::of(1000).unwrap(), ..RecordOutputs::default() };
    paced_by_device(side, socket, settings, Security::Insecure, outputs).unwrap()
}

/// Same in a loop stepped by a driver: the command is waiting when the failing sample arrives.
fn a_loop_keeps_a_failure<S: Seen>(side: S, role: Role) {
    let (mut paced, mut watch, _) = paced(side, role);
    paced.begin().unwrap();
    let step = |paced: &mut PacedLoop<S>, failed: bool| {
        let before = |side: &mut S| {
            if failed {
                side.exchange_mut().device_failed(None);
            }
        };
        let state = paced.step(None, before, |side| side.exchange().state());
        paced.wait();
        state
    };
    step(&mut paced, false);
    watch.command(OperatorCommand::Acknowledge).unwrap();
    assert_eq!(step(&mut paced, true), Some(LadderState::Fault), "{role:?}");
    assert_eq!(step(&mut paced, false), Some(LadderState::Fault), "{role:?}");
    watch.command(OperatorCommand::Acknowledge).unwrap();
    assert_ne!(step(&mut paced, false), Some(LadderState::Fault), "{role:?}");
}

#[test]
fn live_loop_keeps_a_failure_after_an_earlier_command() {
    a_loop_keeps_a_failure(master(), Role::Master);
    a_loop_keeps_a_failure(slave(), Role::Slave);
}

/// A start in the future would never become old.
#[test]
fn only_a_start_of_the_last_seconds_is_a_press() {
    const SECOND: u64 = 1_000_000_000;
    for (started_ns, counts) in [
        (now_ns(), true),
        (now_ns() - 3 * SECOND, true),
        (now_ns() - 6 * SECOND, false),
        (now_ns() + 60 * SECOND, false),
        (u64::MAX, false),
    ] {
        let (mut paced, watch, _) = started(master(), Role::Master, Some(started_ns));
        paced.begin().unwrap();
        paced.step(None, |_| {}, |_| {});
        let void = (1, Some(Ineffective::OldStart));
        assert_eq!(
            watch.handle().ineffective_presses(),
            if counts { (0, None) } else { void },
            "{started_ns}"
        );
        assert_eq!(watch.handle().is_start_void(), !counts, "{started_ns}");
    }
}

/// A button can press even if the start does not count.
#[test]
fn old_start_is_not_void_with_a_button() {
    let (mut paced, watch, _) = started(master(), Role::Master, Some(0));
    paced.begin().unwrap();
    paced.step(None, |side| side.plant.clutch = Some(true), |_| {});
    assert_eq!(watch.handle().ineffective_presses(), (1, Some(Ineffective::OldStart)));
    assert!(!watch.handle().is_start_void());
}

/// A press that is ignored is reported, even before the first tick.
#[test]
fn press_beside_a_button_is_reported_ineffective_from_the_first_tick() {
    for (button, ineffective) in [(Some(false), (1, Some(Ineffective::HasButton))), (None, (0, None))] {
        let (mut paced, watch, _) = started(master(), Role::Master, Some(now_ns()));
        paced.begin().unwrap();
        watch.handle().press_clutch();
        paced.step(None, |side| side.plant.clutch = button, |_| {});
        assert_eq!(watch.handle().ineffective_presses(), ineffective, "{button:?}");
    }
}

/// A person acknowledges all the time while the device fails.
fn lost_device_stays_lost<S: Seen + Send + 'static>(side: S, role: Role) {
    let (mut paced, mut watch, records) = paced(side, role);
    paced.begin().unwrap();
    let failing = std::thread::spawn(move || paced.fail(&FaultText::new("the bus is down")));
    while !failing.is_finished() {
        // The queue may be full until the loop takes the commands.
        let _ = watch.command(OperatorCommand::Acknowledge);
        std::thread::sleep(Duration::from_micros(100));
    }
    failing.join().unwrap();
    let states: Vec<_> = records.take().iter().map(|record| S::shown(record).0).collect();
    assert!(
        states.len() > 10 && states.iter().all(|state| *state == LadderState::Fault),
        "{role:?} {states:?}"
    );
}

#[test]
fn lost_device_cannot_be_acknowledged_while_the_peer_is_notified() {
    lost_device_stays_lost(master(), Role::Master);
    lost_device_stays_lost(slave(), Role::Slave);
}

/// Clutch of a scene's operator.
enum Operator {
    Absent,
    Says(&'static str),
    Times(&'static [(f64, f64)]),
}

fn scene(operator: &Operator) -> SceneSpec<1> {
    let bytes = include_bytes!("../remote_push.json");
    let mut json: serde_json::Value = serde_json::from_slice(bytes).unwrap();
    match operator {
        Operator::Absent => json["operator"] = serde_json::Value::Null,
        Operator::Says(clutch) => json["operator"]["clutch"] = (*clutch).into(),
        Operator::Times(times) => json["operator"]["clutch_times"] = serde_json::to_value(times).unwrap(),
    }
    serde_json::from_value(json).unwrap()
}

/// Engage with a slave, interrupt for 60 ms or 300 ms or by a stall of the loop, and continue for 8 s. Returns the
/// number of engagements. With `pressed_again`, a person presses again after 5 s.
fn engagements(mut side: impl Side, slave: &mut impl Side, away: Away, pressed_again: bool) -> usize {
    let mut buffer = [0; MAX_FRAME];
    let (mut engagements, mut was) = (0, false);
    side.begin(0);
    slave.begin(0);
    for tick in 0..9000_u64 {
        let now_ns = tick * MS;
        let gone = match away {
            Away::Link(length) => (1000..1000 + length).contains(&tick),
            Away::Blocked => (1000..1060).contains(&tick),
        };
        if !(gone && matches!(away, Away::Blocked)) {
            if tick == 1060 && matches!(away, Away::Blocked) {
                side.exchange_mut().stalled(now_ns);
            }
            if pressed_again && tick == 6000 {
                side.command(now_ns, OperatorCommand::Press).unwrap();
            }
            side.tick(TickTime::at(now_ns));
            let frame = side.send(LinkTime::at(now_ns), &mut buffer);
            if !gone {
                let _ = slave.receive(LinkTime::at(now_ns), frame);
            }
        }
        slave.tick(TickTime::at(now_ns));
        let frame = slave.send(LinkTime::at(now_ns), &mut buffer);
        if !gone {
            let _ = side.receive(LinkTime::at(now_ns), frame);
        }
        engagements += usize::from(side.exchange().state().is_coupled() && !was);
        was = side.exchange().state().is_coupled();
    }
    engagements
}

#[derive(Clone, Copy, Debug)]
enum Away {
    /// For this number of ms: to HOLD, or to STOP.
    Link(u64),
    Blocked,
}

/// Only start, button and command press the clutch of a real device, whatever operator its scene has.
#[test]
fn nobody_simulated_presses_for_a_real_device() {
    use Operator::{Absent, Says, Times};
    for away in [Away::Link(60), Away::Link(300), Away::Blocked] {
        for (name, operator) in [("absent", Absent), ("auto", Says("auto")), ("once", Says("once"))] {
            let scene = scene(&operator);
            for (simulated, pressed_again, button, expected) in [
                (false, false, None, 1),
                (false, true, None, 2),
                (true, false, None, 2),
                // Held throughout: only the button counts, neither a command nor a simulated operator.
                (false, true, Some(true), 1),
                (true, true, Some(true), 1),
                (true, true, Some(false), 0),
            ] {
                let mut side = driven_master::<1>(&scene, 1, simulated).unwrap();
                side.side.plant.driven().unwrap().clutch = button;
                let mut slave = simulated_slave::<1>(&scene, 2).unwrap();
                let seen = engagements(side, &mut slave, away, pressed_again);
                let what =
                    format!("{away:?} {name} simulated {simulated}, again {pressed_again}, {button:?}");
                assert_eq!(seen, expected, "{what}");
            }
            // A simulated device without an operator follows the same rule.
            let mut slave = simulated_slave::<1>(&scene, 2).unwrap();
            let side = simulated_master::<1>(&scene, 1).unwrap();
            let expected = if name == "auto" { 2 } else { 1 };
            assert_eq!(
                engagements(side, &mut slave, away, false),
                expected,
                "{away:?} {name}, simulated device"
            );
        }
    }
    let refused = driven_master::<1>(&scene(&Times(&[(0.0, 1.0), (2.0, 3.0)])), 1, false).err().unwrap();
    assert!(
        refused.to_string().starts_with("operator.clutch: times press the clutch of a real device"),
        "{refused}"
    );
    let mut slave = simulated_slave::<1>(&scene(&Absent), 2).unwrap();
    let never = driven_master::<1>(&scene(&Times(&[])), 1, false).unwrap();
    assert_eq!(engagements(never, &mut slave, Away::Link(60), true), 0);
}

/// A force on the arm beyond the measurable range is a fault of the slave in the same tick. One delay later the master
/// stops. The hand feels none of it.
#[test]
fn a_force_that_cannot_be_measured_stops_both_sides() {
    const PUSHED_MS: usize = 1000;
    const DELAY_MS: usize = 5;
    const FADE_MS: usize = 76;
    for force_n in [1e4, 1e300, f64::MAX] {
        let mut json: serde_json::Value =
            serde_json::from_slice(include_bytes!("../remote_push.json")).unwrap();
        json["operator"]["legs"] =
            serde_json::json!([{"duration_s": 0.8, "end": [-0.03], "shape": "minimum-jerk"}]);
        json["operator"]["release"] = serde_json::Value::Null;
        json["operator"]["clutch"] = "once".into();
        json["safety"]["controllers"] = serde_json::json!([]);
        json["environment"]["pushers"] = serde_json::json!([{"shape": "step", "at_s": 1.0, "duration_s": 0.5,
            "rise_s": 0.0, "frequency_hz": 0.0, "force_n": [force_n], "recorded": null}]);
        let scene: SceneSpec<1> = serde_json::from_value(json).unwrap();
        let mut master = simulated_master::<1>(&scene, 1).unwrap();
        let mut slave = simulated_slave::<1>(&scene, 2).unwrap();
        let link = LinkSettings { delay_s: DELAY_MS as f64 * 1e-3, ..LinkSettings::default() };
        let settings = VirtualSettings {
            period_ns: MS,
            slave_period_ns: MS,
            ticks: 3000,
            forward: link.clone(),
            backward: link,
            seed: 7,
            secure: true,
            encoded: false,
            master_clock: None,
            slave_clock: None,
        };
        let (mut near, mut far) = (Vec::new(), Vec::new());
        run_virtual(&settings, &mut master, &mut slave, |event, _| {
            match event {
                Event::Master(record) => near.push((record.state, record.device_force[0].abs())),
                Event::Slave(record) => far.push((record.state, record.command[0])),
            }
            ControlFlow::Continue(())
        })
        .unwrap();
        assert_eq!(far.last().unwrap().0, LadderState::Fault, "{force_n}");
        assert_eq!(near.last().unwrap().0, LadderState::Stop, "{force_n}");
        let engaged = far.iter().position(|(state, _)| state.is_coupled()).unwrap();
        let pushed = engaged + PUSHED_MS;
        let held =
            |states: &[(LadderState, f64)]| states.iter().position(|(state, _)| *state >= LadderState::Hold);
        let (near_held, far_held) = (held(&near).unwrap(), held(&far).unwrap());
        assert!((pushed..=pushed + 1).contains(&far_held), "{force_n}: {far_held}, pushed at {pushed}");
        assert!((pushed..=pushed + DELAY_MS + 2).contains(&near_held), "{force_n}: {near_held}");
        assert!(far[far_held..].iter().all(|(_, command)| *command == far[far_held].1), "the command stays");
        assert!(near[near_held + FADE_MS + 1..].iter().all(|(_, force)| *force == 0.0), "{force_n}");
        let most = |forces: &[(LadderState, f64)]| forces.iter().map(|(_, force)| *force).fold(0.0, f64::max);
        // The press still settles by less than this. The smallest effect of the push would be 1 N, the limiter's step.
        assert!(most(&near[pushed..]) <= most(&near[..pushed]) + 1e-6, "{force_n}");
        assert!(most(&near[..pushed]) > 1.0, "the hand felt the wall");
    }
}

/// Ticks before a sample beyond the speed bound is decided: the fourth such sample shows that it is no outlier.
const DECIDED: u64 = 3;

#[test]
fn unreachable_position_of_an_arm_is_a_fault() {
    let jumped = Fault::TooFast(Signal::Position).code();
    // 20 mm in 1 ms is 20 m/s. Two ticks in close succession count as at least one period apart.
    for (by, after_ns, is_jump) in [
        (0.019, MS, false),
        (0.021, MS, true),
        (-5.0, MS, true),
        (0.021, 2 * MS, false),
        (0.019, MS / 100, false),
    ] {
        let mut side = slave();
        side.begin(0);
        for n in 0..50 {
            side.plant.sample[0][0] = 1e-4 * n as f64;
            assert_eq!(side.tick(TickTime::at(n * MS)).fault, 0);
        }
        side.plant.sample[0][0] += by;
        for n in 0..DECIDED {
            assert_eq!(side.tick(TickTime::at(49 * MS + after_ns + n * MS)).fault, 0, "{by}");
        }
        let record = side.tick(TickTime::at(49 * MS + after_ns + DECIDED * MS));
        assert_eq!(record.fault == jumped, is_jump, "{by}: {}", record.fault);
        if !is_jump {
            continue;
        }
        assert_eq!(record.state, LadderState::Fault);
        assert_eq!(side.tick(TickTime::at(55 * MS)).fault, jumped, "it is latched");
        side.command(56 * MS, OperatorCommand::Acknowledge).unwrap();
        assert_eq!(side.tick(TickTime::at(56 * MS)).fault, 0, "where it is now it may stay");
    }
}

/// 60 mrad in 1 ms is 60 rad/s; a turn beyond pi is the shorter turn the other way.
#[test]
fn impossible_turn_of_a_tool_is_a_fault() {
    let jumped = Some(Fault::TooFast(Signal::Orientation));
    for (by, is_jump) in [(0.059, false), (0.062, true), (-3.0, true), (2.0 * PI - 0.05, false)] {
        let settings = SlaveSettings {
            period_ns: MS,
            run_id: 2,
            position_scale: 1.0,
            bounds: CommandBounds::default(),
            ladder: LadderSettings::default(),
        };
        let rotation = SlaveRotationSettings {
            rotation_scale: 1.0,
            lock: RotationLock::Free,
            bounds: RotationBounds::default(),
            alignment: None,
        };
        let mut arm = SlaveEndpoint::<3>::of_pose(&settings, &rotation).unwrap();
        let mut at = |n: u64, angle| {
            let turned = RotationState {
                orientation: UnitQuaternion::from_scaled_axis(Axes::<3>::new(0.6, 0.0, -0.8) * angle),
                angular_velocity: Axes::zeros(),
                torque: Axes::zeros(),
            };
            let point = SlaveReading::point([Axes::zeros(); 3]);
            arm.tick(n * MS, &SlaveReading { rotation: Some(turned), ..point })
        };
        for n in 0..3 {
            assert_eq!(at(n, 0.3).fault, None);
        }
        for n in 0..DECIDED {
            assert_eq!(at(3 + n, 0.3 + by).fault, None);
        }
        let seen = at(3 + DECIDED, 0.3 + by);
        let expected = (jumped.filter(|_| is_jump), is_jump);
        assert_eq!((seen.fault, seen.state == LadderState::Fault), expected, "{by}");
    }
}

/// No force answers before the fault, because the estimators have not received the sample.
#[test]
fn unreachable_position_of_a_device_is_a_fault() {
    let jumped = Fault::TooFast(Signal::Position).code();
    // 20 mm in 1 ms is 20 m/s.
    for (by, is_jump) in [(0.019, false), (-0.019, false), (0.021, true), (-5.0, true)] {
        let mut side = master();
        side.begin(0);
        for n in 0..50 {
            side.plant.position[0] = 1e-4 * n as f64;
            assert_eq!(side.tick(TickTime::at(n * MS)).fault, 0);
        }
        side.plant.position[0] += by;
        for n in 0..DECIDED {
            let record = side.tick(TickTime::at((50 + n) * MS));
            assert_eq!((record.fault, record.device_force[0]), (0, 0.0), "{by}");
        }
        let record = side.tick(TickTime::at((50 + DECIDED) * MS));
        assert_eq!(record.fault == jumped, is_jump, "{by}: {}", record.fault);
        if !is_jump {
            continue;
        }
        assert_eq!((record.state, record.device_force[0]), (LadderState::Fault, 0.0));
        side.command(55 * MS, OperatorCommand::Acknowledge).unwrap();
        assert_eq!(side.tick(TickTime::at(55 * MS)).fault, 0, "where it is now it may stay");
    }
}
