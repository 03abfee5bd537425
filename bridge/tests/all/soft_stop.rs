//! Motion of an arm when its master falls silent: it holds, stops softly, and later continues from there.
#![allow(clippy::unwrap_used)] // a test may

use haptether_bridge::{
    FrameLink, LadderSettings, LadderState, LinkTime, OperatorCommand, PortState, Side, SlaveEndpoint,
    SlaveSettings, SlaveSide, Status, TickTime,
    coupling::CommandBounds,
    wire::{MAX_FRAME, Role, padded},
};
use haptether_safety::Axes;
use haptether_slave::{ArmControl, ArmModel, Environment, SimulatedSlave};
use proptest::prelude::*;

const MS: u64 = 1_000_000;
/// Speed of the hand in m/s.
const SPEED: f64 = 0.5;

/// Slave, and a master that moves at constant speed and is heard only at times.
struct Bench {
    slave: SlaveSide<SimulatedSlave<1>, 1>,
    master: FrameLink,
    tick: u64,
    hand: f64,
}

/// Values of one tick: state, commanded position, and position of the arm.
#[derive(Clone, Copy, Debug)]
struct Shown {
    state: LadderState,
    command: f64,
    position: f64,
}

impl Bench {
    fn new(arm: ArmModel) -> Self {
        let plant =
            SimulatedSlave::in_environment(arm, Environment::empty(), None, Axes::zeros(), 0).unwrap();
        let endpoint = SlaveEndpoint::new(&SlaveSettings {
            period_ns: MS,
            run_id: 2,
            position_scale: 1.0,
            bounds: CommandBounds::default(),
            ladder: LadderSettings::default(),
        })
        .unwrap();
        let master = FrameLink::new(Role::Master, 1, 1, 200 * MS);
        Self { slave: SlaveSide::new(plant, endpoint), master, tick: 0, hand: 0.0 }
    }

    fn tick(&mut self, heard: bool, clutch: bool, speed: f64) -> Shown {
        let now_ns = self.tick * MS;
        let mut buffer = [0; MAX_FRAME];
        self.hand += speed * 1e-3;
        let state = if clutch { LadderState::Aligning } else { LadderState::Disengaged };
        // A master engages after its slave.
        let state =
            if clutch && self.slave.exchange().state().is_coupled() { LadderState::Engaged } else { state };
        let status = Status { state: state.code(), hears_peer: true, clutch, ..Status::default() };
        let [position, velocity] = [self.hand, speed].map(Axes::<1>::new);
        let sent =
            PortState { position: padded(&position), velocity: padded(&velocity), ..PortState::default() };
        let frame = self.master.send(LinkTime::at(now_ns), status, sent, &mut buffer).to_vec();
        if heard {
            let _ = self.slave.receive(LinkTime::at(now_ns), &frame);
        }
        let record = self.slave.tick(TickTime::at(now_ns));
        let answer = self.slave.send(LinkTime::at(now_ns), &mut buffer).to_vec();
        if heard {
            let _ = self.master.receive(LinkTime::at(now_ns), &answer);
        }
        self.tick += 1;
        Shown { state: record.state, command: record.command[0], position: record.position[0] }
    }

    fn run(&mut self, ticks: u64, heard: bool, clutch: bool, speed: f64) -> Vec<Shown> {
        (0..ticks).map(|_| self.tick(heard, clutch, speed)).collect()
    }
}

fn arms() -> Vec<(&'static str, ArmModel)> {
    let critical = 2.0 * (4000.0_f64 * 2.0).sqrt();
    let of = |control, speed, acceleration| ArmModel::new(control, 2.0, speed, acceleration).unwrap();
    vec![
        ("position", of(ArmControl::Position { bandwidth_hz: 15.0 }, Some(1.0), None)),
        ("position, slow", of(ArmControl::Position { bandwidth_hz: 5.0 }, Some(1.0), Some(5.0))),
        ("velocity", of(ArmControl::Velocity { bandwidth_hz: 10.0 }, Some(1.0), None)),
        ("velocity, limited", of(ArmControl::Velocity { bandwidth_hz: 10.0 }, Some(1.0), Some(20.0))),
        ("pd", of(ArmControl::Pd { stiffness: 4000.0, damping: critical }, None, None)),
    ]
}

/// The hand moves at 0.5 m/s when the link fails. From HOLD on the command is constant, and the arm comes to rest at
/// it. It does not jump ahead, moves back by at most 1 % of its path, and is at rest after the stop.
#[test]
fn an_arm_at_speed_comes_to_rest_without_a_jump_or_a_swing() {
    for (name, arm) in arms() {
        let mut bench = Bench::new(arm);
        bench.run(20, true, true, 0.0);
        let moving = *bench.run(300, true, true, SPEED).last().unwrap();
        assert_eq!(moving.state, LadderState::Engaged, "{name}");
        let after = bench.run(1500, false, true, SPEED);
        let held = after.iter().position(|one| one.state == LadderState::Hold).unwrap();
        let stopped = after.iter().position(|one| one.state == LadderState::Stop).unwrap();
        assert!((20..=23).contains(&held) && (199..=203).contains(&stopped), "{name}: {held} {stopped}");
        for pair in after[held..].windows(2) {
            let step = pair[1].command - pair[0].command;
            assert!(step == 0.0 || pair[1].state != pair[0].state, "{name}: the command stands");
        }
        // Never faster than before.
        let speeds: Vec<_> =
            after.windows(2).map(|pair| (pair[1].position - pair[0].position) / 1e-3).collect();
        assert!(speeds.iter().all(|speed| speed.abs() <= 1.02 * SPEED), "{name}: {speeds:?}");
        let end = after.last().unwrap();
        let furthest = after.iter().fold(f64::MIN, |most, one| most.max(one.position));
        let distance = end.position - moving.position;
        assert!(furthest - end.position <= 0.01 * distance + 1e-6, "{name}: {furthest} {end:?}");
        assert!(speeds[stopped + 300..].iter().all(|speed| speed.abs() < 1e-4), "{name}: at rest");
        assert!((end.position - end.command).abs() < 1e-4, "{name}: {end:?}");
    }
}

/// An arm far behind its command at the stop brakes where it is, and the rest of the path is dropped. Later commands
/// begin where it came to rest.
#[test]
fn stop_drops_the_rest_of_the_path() {
    let creeping =
        ArmModel::new(ArmControl::Position { bandwidth_hz: 10.0 }, 2.0, Some(0.1), Some(2.0)).unwrap();
    let mut bench = Bench::new(creeping);
    bench.run(20, true, true, 0.0);
    let far = *bench.run(400, true, true, SPEED).last().unwrap();
    assert!(far.command - far.position > 0.1, "{far:?}");
    let after = bench.run(1000, false, true, SPEED);
    let stopped = after.iter().position(|one| one.state == LadderState::Stop).unwrap();
    // v²/2a of the set position, and the lag of the tool behind it.
    let most = 0.1 * 0.1 / 4.0 + 0.1 * 2.0 / (2.0 * std::f64::consts::PI * 10.0) + 1e-6;
    let (at_stop, end) = (after[stopped], after.last().unwrap());
    assert!(end.position - at_stop.position <= most, "{at_stop:?} {end:?}");
    assert!((end.command - end.position).abs() < 1e-6 && end.command < far.command, "{end:?}");
    // After release and press it engages where it stands, wherever the hand went.
    bench.run(100, true, false, 0.3);
    let again = bench.run(300, true, true, 0.0);
    assert_eq!(again.last().unwrap().state, LadderState::Engaged);
    assert!(again.iter().all(|one| (one.command - end.command).abs() < 1e-12));
}

/// A stop is ordered once; neither frames nor an acknowledgement undo it.
#[test]
fn a_stop_is_latched() {
    for (name, arm) in arms() {
        let mut bench = Bench::new(arm);
        bench.run(320, true, true, SPEED);
        bench.run(500, false, true, SPEED);
        let rest = bench.tick(false, true, 0.0).command;
        bench.slave.command(bench.tick * MS, OperatorCommand::Acknowledge).unwrap();
        // The master is heard again, and its clutch was never released.
        for one in bench.run(500, true, true, SPEED) {
            assert_eq!((one.state, one.command), (LadderState::Stop, rest), "{name}");
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    /// A change while the arm follows causes no motion by itself, even if frames are late and the arm extrapolates. At
    /// that tick, the command is the same as without the change.
    #[test]
    fn a_change_moves_nothing(
        late in 0_u64..19,
        (scale, locked) in (0.5..2.0f64, any::<bool>()),
        (speed, which) in (-SPEED..SPEED, any::<bool>()),
    ) {
        let act = if which {
            OperatorCommand::PositionScale(scale)
        } else {
            OperatorCommand::Frame { quat_wxyz: [1.0, 0.0, 0.0, 0.0], locked: [locked; 7] }
        };
        let run = |act: Option<OperatorCommand>| {
            let mut bench = Bench::new(arms().swap_remove(0).1);
            bench.run(20, true, true, 0.0);
            bench.run(100, true, true, speed);
            bench.run(late, false, true, speed);
            // The tick before has the same frame.
            let before = bench.tick(false, true, speed);
            if let Some(act) = act {
                bench.slave.command(bench.tick * MS, act).unwrap();
            }
            let after = bench.tick(false, true, speed);
            // When frames return, the arm follows from there with the new scale, once that has faded in.
            bench.run(450, true, true, speed);
            [before, after, bench.tick(true, true, speed), bench.tick(true, true, speed)]
        };
        let [before, after, one, two] = run(Some(act));
        let [_, unchanged, ..] = run(None);
        prop_assert!(before.state.is_coupled() == (late < 19));
        prop_assert!((after.command - unchanged.command).abs() <= 1e-12, "{unchanged:?} {after:?}");
        if one.state.is_coupled() && two.state.is_coupled() {
            let expected = if which { scale } else { f64::from(u8::from(!locked)) } * speed * 1e-3;
            prop_assert!((two.command - one.command - expected).abs() <= 1e-12, "{one:?} {two:?} {expected}");
        }
    }
}
