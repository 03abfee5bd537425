//! Effects of a silent peer on both sides, in virtual time.
#![allow(clippy::unwrap_used)] // a test may

use std::{collections::VecDeque, ops::ControlFlow};

use haptether_bridge::{
    Clutch, FrameLink, LadderSettings, LadderState, LinkTime, MasterEndpoint, MasterReading, MasterSettings,
    MasterSide, OperatorCommand, PortState, Side, SlaveEndpoint, SlavePlant, SlaveReading, SlaveSettings,
    SlaveSide, Status, TickTime, VirtualSettings,
    coupling::CommandBounds,
    run_virtual,
    wire::{Frame, FrameLayout, MAX_FRAME, Role, padded},
};
use haptether_master::{DeviceParameters, Hand, Leg, LegShape, Path, SimulatedMaster};
use haptether_netsim::{ClockSettings, EndpointClock, LinkSettings};
use haptether_safety::{
    Axes, DeviceModel, LimiterSettings,
    controller::{ControllerKind, SafetySettings},
    estimator::EstimatorKind,
};
use haptether_slave::SimulatedSlave;

use crate::arms::arm_before_wall;

const MS: u64 = 1_000_000;

type Master = MasterSide<SimulatedMaster<1>, 1>;
type Slave = SlaveSide<SimulatedSlave<1>, 1>;

fn master_settings() -> MasterSettings<1> {
    MasterSettings {
        period_ns: MS,
        run_id: 1,
        device: DeviceModel::phantom_desktop(),
        estimator: EstimatorKind::default(),
        safety: SafetySettings::default(),
        limiter: LimiterSettings::default(),
        force_scale: 1.0,
        ladder: LadderSettings::default(),
    }
}

fn slave_settings(session: u64) -> SlaveSettings {
    SlaveSettings {
        period_ns: MS,
        run_id: session,
        position_scale: 1.0,
        bounds: CommandBounds::default(),
        ladder: LadderSettings::default(),
    }
}

fn sides() -> (Master, Slave) {
    sides_with(Clutch::Once)
}

fn sides_with(clutch: Clutch) -> (Master, Slave) {
    let legs = vec![Leg { duration_s: 0.5, end: Axes::<1>::new(-0.03), shape: LegShape::MinimumJerk }];
    let hand = Hand::new(300.0, 8.0, 20.0, Path::new(Axes::<1>::new(0.02), legs).unwrap(), None).unwrap();
    let mut device = SimulatedMaster::new(DeviceParameters::phantom_desktop(), hand, 0).unwrap();
    device.set_waiting(true);
    let master = MasterEndpoint::new(&master_settings()).unwrap();
    let slave = SlaveEndpoint::new(&slave_settings(2)).unwrap();
    let arm = arm_before_wall(0.0, None, 0.02);
    (MasterSide::new(device, master, clutch).unwrap(), SlaveSide::new(arm, slave))
}

/// Run both sides. `passes` returns for each tick whether frames reach the slave, and whether they reach the master.
fn run(ticks: u64, passes: impl Fn(u64) -> (bool, bool)) -> Vec<[(LadderState, f64); 2]> {
    run_with(Clutch::Once, ticks, passes)
}

/// Simulated person who presses again half a second after both sides are ready.
const PERSON: Clutch = Clutch::Auto { reaction_ns: 500 * MS };

fn run_with(
    clutch: Clutch,
    ticks: u64,
    passes: impl Fn(u64) -> (bool, bool),
) -> Vec<[(LadderState, f64); 2]> {
    let (mut master, mut slave) = sides_with(clutch);
    let mut buffer = [0; MAX_FRAME];
    let mut history = Vec::new();
    for tick in 0..ticks {
        let now_ns = tick * MS;
        let (there, back) = passes(tick);
        let at_master = master.tick(TickTime::at(now_ns));
        let frame = master.send(LinkTime::at(now_ns), &mut buffer);
        if there {
            slave.receive(LinkTime::at(now_ns), frame).unwrap();
        }
        let at_slave = slave.tick(TickTime::at(now_ns));
        let frame = slave.send(LinkTime::at(now_ns), &mut buffer);
        if back {
            master.receive(LinkTime::at(now_ns), frame).unwrap();
        }
        history.push([(at_master.state, at_master.device_force[0]), (at_slave.state, at_slave.command[0])]);
    }
    history
}

#[test]
fn a_contact_settles_where_three_springs_in_series_do() {
    let history = run(3000, |_| (true, true));
    let pole = std::f64::consts::TAU * 15.0;
    let arm = 4.0 * pole * pole;
    // Both start at 0.02 m, and the target is 0.03 m deep: three springs in series.
    let force = 0.03 / (1.0 / 300.0 + 1.0 / arm + 1.0 / 100.0);
    let [(state, device_force), _] = history[2999];
    assert_eq!(state, LadderState::Engaged);
    // Coulomb friction may hold the device up to c off the balance.
    assert!((device_force - force).abs() < 0.038, "{device_force} {force}");
}

#[test]
fn silence_removes_the_force_within_100_ms_and_holds_the_arm() {
    let history = run(2000, |tick| if tick < 1500 { (true, true) } else { (false, false) });
    assert!(history[1499][0].1 > 1.5);
    let held = history[1520][1].1;
    for (tick, [(master, force), (slave, command)]) in history.iter().enumerate().skip(1500) {
        if tick >= 1522 {
            assert!(matches!(master, LadderState::Hold | LadderState::Stop), "{tick} {master:?}");
            assert!(matches!(slave, LadderState::Hold | LadderState::Stop), "{tick} {slave:?}");
            assert_eq!(*command, held, "the arm holds");
        }
        if tick >= 1600 {
            assert_eq!(*force, 0.0, "{tick}");
        }
    }
    assert_eq!(history[1999].map(|side| side.0), [LadderState::Stop; 2]);
}

#[test]
fn one_dead_direction_holds_both_sides() {
    for dead in [(false, true), (true, false)] {
        let history = run(2000, |tick| if tick < 1500 { (true, true) } else { dead });
        assert_eq!(history[1530].map(|side| side.0), [LadderState::Hold; 2], "{dead:?}");
        assert_eq!(history[1999].map(|side| side.0), [LadderState::Stop; 2], "{dead:?}");
        assert_eq!(history[1640][0].1, 0.0);
    }
}

/// Check that the command never jumps and the force never changes too fast, whatever the network does.
fn check_no_jump(history: &[[(LadderState, f64); 2]]) {
    for (tick, pair) in history.windows(2).enumerate() {
        let [[(_, before), (_, commanded)], [(_, after), (state, next)]] = [pair[0], pair[1]];
        // The limiter's 1000 N/s is 1 N per tick; unloading over 75 ms is slower.
        assert!((after - before).abs() <= 1.0 + 1e-9, "{tick}: {before} {after}");
        assert!((next - commanded).abs() < 2e-3, "{tick}: the arm is never asked to jump");
        assert!(state.is_coupled() || next == commanded, "{tick}: no motion in {state:?}");
    }
}

#[test]
fn short_outage_holds_until_a_new_press() {
    let outage = |tick| if (1500..1560).contains(&tick) { (false, false) } else { (true, true) };
    let history = run(4000, outage);
    assert_eq!(history[1540].map(|side| side.0), [LadderState::Hold; 2]);
    for sides in &history[1600..] {
        assert_eq!(sides.map(|side| side.0), [LadderState::Hold; 2], "frames alone do not engage again");
        assert_eq!(sides[0].1, 0.0);
    }
    let history = run_with(PERSON, 4000, outage);
    assert_eq!(history[2000].map(|side| side.0), [LadderState::Hold; 2]);
    assert_eq!(history[2100].map(|side| side.0), [LadderState::Engaged; 2]);
    assert_eq!(history[3999].map(|side| side.0), [LadderState::Engaged; 2]);
    assert!(history[3999][0].1 > 0.5, "the hand feels the wall again");
    check_no_jump(&history);
}

/// Outages up to 10 s, in both directions or one: the resulting state of each. After each, a person can engage again.
#[test]
fn person_can_engage_again_after_any_outage() {
    use LadderState::{Engaged, Hold, Stale, Stop};
    for dead in [(false, false), (false, true), (true, false)] {
        for (length, worst) in [
            (4, Engaged),
            (10, Stale),
            (19, Stale),
            (30, Hold),
            (60, Hold),
            (150, Hold),
            (300, Stop),
            (1_000, Stop),
            (10_000, Stop),
        ] {
            let end = 1500 + length;
            let passes = |tick| if (1500..end).contains(&tick) { dead } else { (true, true) };
            let history = run_with(PERSON, end + 2500, passes);
            check_no_jump(&history);
            let seen = |side: usize| {
                history[1500..]
                    .iter()
                    .map(|sides| sides[side].0)
                    .filter(|state| state.is_coupled() || state.is_held())
                    .max()
            };
            let what = format!("{dead:?} {length}");
            // The side that still hears follows when the peer reports the silence, which never happens in a short
            // outage.
            let sides = match dead {
                (false, true) => vec![1],
                (true, false) => vec![0],
                _ => vec![0, 1],
            };
            for side in sides {
                assert_eq!(seen(side), Some(worst), "{what}");
            }
            if worst.is_held() {
                assert!((0..2).all(|side| seen(side) >= Some(Hold)), "{what}: both hold");
            }
            assert_eq!(history.last().unwrap().map(|side| side.0), [Engaged; 2], "{what}");
        }
    }
}

/// After 15 ms of silence the arm stands, and it has moved less than with constant velocity.
#[test]
fn arm_extrapolates_briefly_and_comes_to_rest() {
    // In the middle the hand moves at about 0.1 m/s; the last frame before the outage is that of tick 299.
    let history = run(400, |tick| if tick < 300 { (true, true) } else { (false, false) });
    let command = |tick: usize| history[tick][1].1;
    let velocity = (command(299) - command(298)) / 1e-3;
    assert!(velocity < -0.05);
    for tick in 300..=305 {
        assert_eq!(command(tick), command(299), "{tick}");
    }
    let distance = command(399) - command(299);
    assert!(
        distance < 0.0 && distance > 1.05 * velocity * 7.5e-3 && distance < 0.9 * velocity * 7.5e-3,
        "{distance} {velocity}"
    );
    let steps: Vec<_> = (305..330).map(|tick| (command(tick + 1) - command(tick)).abs()).collect();
    assert!(steps.windows(2).all(|pair| pair[1] <= pair[0] + 1e-15), "it only slows down: {steps:?}");
    assert!((320..399).all(|tick| command(tick) == command(399)));
}

/// Links with delays up to 500 ms each way engage and stay engaged, because silence counts from the usual age of the
/// link.
#[test]
fn long_delay_engages_and_stays() {
    for delay in [0, 20, 100, 500_u64] {
        let (mut master, mut slave) = sides();
        let (mut there, mut back) = (VecDeque::new(), VecDeque::new());
        let mut buffer = [0; MAX_FRAME];
        let mut engaged_at = None;
        for tick in 0..4000_u64 {
            let now_ns = tick * MS;
            while back.front().is_some_and(|(due, _)| *due <= tick) {
                let (_, frame): (u64, Vec<u8>) = back.pop_front().unwrap();
                master.receive(LinkTime::at(now_ns), &frame).unwrap();
            }
            let state = master.tick(TickTime::at(now_ns)).state;
            there.push_back((tick + delay, master.send(LinkTime::at(now_ns), &mut buffer).to_vec()));
            while there.front().is_some_and(|(due, _)| *due <= tick) {
                let (_, frame): (u64, Vec<u8>) = there.pop_front().unwrap();
                slave.receive(LinkTime::at(now_ns), &frame).unwrap();
            }
            slave.tick(TickTime::at(now_ns));
            back.push_back((tick + delay.max(1), slave.send(LinkTime::at(now_ns), &mut buffer).to_vec()));
            if state == LadderState::Engaged {
                engaged_at.get_or_insert(tick);
            } else {
                assert_eq!(engaged_at, None, "{delay}: it stays");
            }
        }
        // One round trip, so that each side knows that it is heard.
        assert_eq!(engaged_at, Some((2 * delay).max(1)), "{delay}");
    }
}

/// Indexing with the clutch: the hand moves back without the arm.
#[test]
fn an_open_clutch_moves_the_hand_and_not_the_arm() {
    let clutch = Clutch::Schedule(vec![(0, 200 * MS), (600 * MS, 5000 * MS)]);
    let history = run_with(clutch, 1500, |_| (true, true));
    check_no_jump(&history);
    assert_eq!(history[199].map(|side| side.0), [LadderState::Engaged; 2]);
    for sides in &history[201..600] {
        assert_eq!(sides.map(|side| side.0), [LadderState::Disengaged; 2]);
        assert_eq!(sides[1].1, history[201][1].1);
    }
    assert_eq!(history[601].map(|side| side.0), [LadderState::Engaged; 2]);
    // Meanwhile the hand moved from about 0.015 m to -0.03 m, and the arm did not follow.
    assert!(history[1499][1].1 > 0.0, "{}", history[1499][1].1);
}

#[test]
fn a_wild_command_is_clamped_and_counted_and_nothing_stops() {
    let mut slave = SlaveEndpoint::<1>::new(&slave_settings(2)).unwrap();
    let mut link = FrameLink::new(Role::Master, 1, 1, 200 * MS);
    let mut buffer = [0; MAX_FRAME];
    let still = Axes::<1>::zeros();
    let mut last: f64 = 0.0;
    for tick in 0..1000_u64 {
        let now_ns = tick * MS;
        let aligning = if tick < 2 { LadderState::Aligning } else { LadderState::Engaged };
        let status = Status { state: aligning.code(), hears_peer: true, clutch: true, ..Status::default() };
        // At 100 ms the position jumps by 500 m with an extreme velocity; at 110 ms it is back.
        let wild = (100..110).contains(&tick);
        let pose = Axes::<1>::new(if wild { 500.0 } else { 0.0 });
        let speed = Axes::<1>::new(if wild { 900.0 } else { 0.0 });
        slave
            .exchange
            .receive(
                LinkTime::at(now_ns),
                link.send(
                    LinkTime::at(now_ns),
                    status,
                    PortState { position: padded(&pose), velocity: padded(&speed), ..PortState::default() },
                    &mut buffer,
                ),
            )
            .unwrap();
        let output = slave.tick(now_ns, &SlaveReading::point([still; 3]));
        let answer = slave.exchange.send(LinkTime::at(now_ns), &mut buffer).to_vec();
        link.receive(LinkTime::at(now_ns), &answer).unwrap();
        let command = output.command.map_or(0.0, |command| command[0]);
        assert!((command - last).abs() <= 3e-3 + 1e-12, "{tick}: {command}");
        assert!(output.command_velocity.norm() <= 3.0 + 1e-12);
        assert!(tick < 2 || output.state == LadderState::Engaged, "{tick}: {:?}", output.state);
        // Ten steps out and ten back; the last one just fits, except for rounding.
        assert!(tick == 119 || output.limited.any() == (100..119).contains(&tick), "{tick}");
        last = command;
    }
    assert!(
        matches!(slave.exchange.counts().limited, 19 | 20) && last == 0.0,
        "{} {last}",
        slave.exchange.counts().limited
    );
}

/// Run with a delay of 50 ms each way, and a master whose loop stalls for a while.
fn run_with_stall(ticks: u64, asleep: std::ops::Range<u64>) -> Vec<(LadderState, f64)> {
    let (mut master, mut slave) = sides_with(PERSON);
    let (mut there, mut back) = (VecDeque::new(), VecDeque::new());
    let mut buffer = [0; MAX_FRAME];
    let mut history = Vec::new();
    for tick in 0..ticks {
        let now_ns = tick * MS;
        if !asleep.contains(&tick) {
            let woke = tick == asleep.end;
            while back.front().is_some_and(|(due, _)| *due <= tick) {
                let (_, frame): (u64, Vec<u8>) = back.pop_front().unwrap();
                // The live loop drops frames that waited during a stall.
                if !woke {
                    master.receive(LinkTime::at(now_ns), &frame).unwrap();
                }
            }
            let missed = if woke { asleep.end - asleep.start } else { 0 };
            if woke {
                master.exchange_mut().stalled(now_ns);
            }
            let record = master.tick(TickTime { missed, ..TickTime::at(now_ns) });
            there.push_back((tick + 50, master.send(LinkTime::at(now_ns), &mut buffer).to_vec()));
            history.push((record.state, record.device_force[0]));
        }
        while there.front().is_some_and(|(due, _)| *due <= tick) {
            let (_, frame): (u64, Vec<u8>) = there.pop_front().unwrap();
            slave.receive(LinkTime::at(now_ns), &frame).unwrap();
        }
        slave.tick(TickTime::at(now_ns));
        back.push_back((tick + 50, slave.send(LinkTime::at(now_ns), &mut buffer).to_vec()));
    }
    history
}

#[test]
fn stalled_loop_restarts_from_zero_force() {
    for asleep in [30, 60, 90] {
        let history = run_with_stall(4000, 2000..2000 + asleep);
        assert!(history[1999].1 > 1.5, "the hand feels the wall");
        assert_eq!(history[2000], (LadderState::Hold, 0.0), "asleep for {asleep} ms");
        for pair in history[2000..].windows(2) {
            // Up to 2.3 N within a fade-in of 200 ms, and the wall yields meanwhile.
            assert!(pair[1].1 - pair[0].1 < 0.05, "asleep for {asleep} ms: {pair:?}");
        }
        assert_eq!(history.last().unwrap().0, LadderState::Engaged);
    }
}

#[test]
fn a_stopped_master_stays_stopped_whatever_arrives() {
    let (mut master, mut slave) = sides();
    let (_, mut restarted) = sides();
    restarted.endpoint = SlaveEndpoint::new(&slave_settings(3)).unwrap();
    let mut buffer = [0; MAX_FRAME];
    for tick in 0..3000 {
        let now_ns = tick * MS;
        let record = master.tick(TickTime::at(now_ns));
        let frame = master.send(LinkTime::at(now_ns), &mut buffer).to_vec();
        let peer = match tick {
            0..1000 => &mut slave,
            1000..1500 => {
                if tick >= 1300 {
                    assert_eq!((record.state, record.device_force[0]), (LadderState::Stop, 0.0));
                }
                continue;
            }
            _ => &mut restarted,
        };
        let _ = peer.receive(LinkTime::at(now_ns), &frame);
        peer.tick(TickTime::at(now_ns));
        let _ = master.receive(LinkTime::at(now_ns), peer.send(LinkTime::at(now_ns), &mut buffer));
        if tick >= 1500 {
            assert_eq!((record.state, record.device_force[0]), (LadderState::Stop, 0.0), "{tick}");
        }
    }
}

/// With WSC a fast hand is damped while engaged. Damping is a force too, and ends without the peer.
#[test]
fn no_force_without_a_peer_for_any_motion() {
    for safety in [
        SafetySettings {
            controllers: [ControllerKind::Wsc, ControllerKind::Pc].into(),
            ..SafetySettings::default()
        },
        SafetySettings {
            controllers: [ControllerKind::Hsc, ControllerKind::Vfc].into(),
            ..SafetySettings::default()
        },
    ] {
        let mut endpoint = MasterEndpoint::<1>::new(&MasterSettings { safety, ..master_settings() }).unwrap();
        for tick in 0..500_u32 {
            let position = Axes::<1>::new(0.8 * f64::from(tick) * 1e-3);
            let output = endpoint.tick(u64::from(tick) * MS, 0, &MasterReading::point(position, None), true);
            assert_eq!(output.safety.device_force[0], 0.0);
        }
    }
}

#[test]
fn a_bad_sample_stops_both_sides_and_says_why() {
    let (mut master, mut slave) = sides();
    let mut buffer = [0; MAX_FRAME];
    let mut faults = Vec::new();
    for tick in 0..1500 {
        let now_ns = tick * MS;
        if tick == 1000 {
            let output =
                master.endpoint.tick(now_ns, 0, &MasterReading::point(Axes::<1>::new(f64::NAN), None), true);
            assert_eq!(output.safety.device_force[0], 0.0, "in the same tick");
        }
        let record = master.tick(TickTime::at(now_ns));
        let _ = slave.receive(LinkTime::at(now_ns), master.send(LinkTime::at(now_ns), &mut buffer));
        let at_slave = slave.tick(TickTime::at(now_ns));
        let _ = master.receive(LinkTime::at(now_ns), slave.send(LinkTime::at(now_ns), &mut buffer));
        faults.push((record.state, record.fault, record.device_force[0], at_slave.state));
    }
    let fault = haptether_safety::Fault::from_code(faults[1499].1).unwrap();
    assert_eq!(fault.to_string(), "position is not a finite number");
    assert!(faults[1000..].iter().all(|(state, _, force, _)| *state == LadderState::Fault && *force == 0.0));
    assert_eq!(faults[1002].3, LadderState::Hold);
    assert_eq!(faults[1499].3, LadderState::Stop);
}

/// In each frame, each sum is that of the work of all earlier ticks of the engagement. It never falls during one, even if
/// frames are lost, and starts at zero with each.
#[test]
fn frames_report_the_energy_through_each_port() {
    let (mut master, mut slave) = sides();
    let mut buffer = [0; MAX_FRAME];
    let (mut sums, mut whole) = ([[0.0_f64; 2]; 2], [[0.0_f64; 2]; 2]);
    let mut epochs = [0_u16; 2];
    // Position, and force on the link from there on, of each side while it is coupled.
    let mut last = [None::<[f64; 2]>; 2];
    let mut check = |side: usize, tick: u64, frame: &Frame, state: LadderState, force: f64| {
        let message = frame.message;
        assert_eq!(message.epoch != 0, state.is_coupled(), "{side}, {tick}");
        if message.epoch != 0 && message.epoch != epochs[side] {
            assert_eq!(message.epoch, epochs[side] + 1);
            (epochs[side], sums[side]) = (message.epoch, [0.0; 2]);
        }
        let position = frame.position[0];
        if let Some([before, force]) = last[side] {
            let work = force * (position - before);
            sums[side][usize::from(work <= 0.0)] += work.abs();
            whole[side][usize::from(work <= 0.0)] += work.abs();
        }
        last[side] = state.is_coupled().then_some([position, force]);
        for (sent, expected) in [frame.energy.in_j, frame.energy.out_j].iter().zip(sums[side]) {
            // A rounding of each of at most 3000 sums.
            let most = 3000.0 * f64::EPSILON * expected;
            assert!((sent - expected).abs() <= most, "{side}, {tick}: {sent} J, must be {expected} J");
        }
        (epochs, whole)
    };
    let mut seen = None;
    for tick in 0..4000 {
        let now_ns = tick * MS;
        if tick == 3000 {
            assert!(master.command(now_ns, OperatorCommand::Press).unwrap());
        }
        let near = master.tick(TickTime::at(now_ns));
        assert_eq!((near.tripped, near.safety_force[0]), (0, 0.0), "damping is no power of the coupling");
        let frame =
            Frame::decode(master.send(LinkTime::at(now_ns), &mut buffer), Role::Master, FrameLayout::of(1))
                .unwrap();
        check(0, tick, &frame, near.state, -near.device_force[0]);
        // Every third frame is lost; the next one contains its energy.
        if tick % 3 != 0 {
            let _ = slave.receive(LinkTime::at(now_ns), &buffer[..FrameLayout::of(1).length()]);
        }
        let sample = SlavePlant::read(&mut slave.plant, now_ns);
        let output = slave.endpoint.tick(now_ns, &SlaveReading::point(sample));
        if let Some(command) = &output.command {
            SlavePlant::write(&mut slave.plant, command, &output.command_velocity);
        }
        let frame =
            Frame::decode(slave.send(LinkTime::at(now_ns), &mut buffer), Role::Slave, FrameLayout::of(1))
                .unwrap();
        assert_eq!(frame.position[0], sample[0][0]);
        seen = Some(check(1, tick, &frame, output.state, sample[2][0]));
        let _ = master.receive(LinkTime::at(now_ns), &buffer[..FrameLayout::of(1).length()]);
    }
    let (epochs, [[master_in, _], [_, slave_out]]) = seen.unwrap();
    assert_eq!(epochs, [2, 2]);
    // The hand presses into the wall: energy enters the wall at the slave, and leaves the hand at the master.
    assert!(master_in > 1e-3 && slave_out > 1e-3, "{master_in} J, {slave_out} J");
}

#[test]
fn a_frame_from_a_stranger_changes_nothing() {
    let (mut master, _) = sides();
    let noise = [7_u8; FrameLayout::of(1).length()];
    for tick in 0..50 {
        assert!(master.receive(LinkTime::at(tick * MS), &noise).is_err());
        assert_eq!(master.tick(TickTime::at(tick * MS)).state, LadderState::Aligning);
    }
    assert_eq!(master.exchange().counts().link.refused, 50);
}

/// A round trip is measured on one clock, and the peer's waiting time on the other. Offset and drift change it by no
/// more than the rounding to ticks.
#[test]
fn round_trip_is_independent_of_clock_errors() {
    let link = LinkSettings { delay_s: 0.05, ..LinkSettings::default() };
    for drift_ppm in [-100.0, 0.0, 100.0] {
        let clock = ClockSettings { offset_s: -1e6, drift_ppm, ..ClockSettings::default() };
        let (mut master, mut slave) = sides();
        let settings = VirtualSettings {
            period_ns: MS,
            slave_period_ns: MS,
            ticks: 100_000,
            forward: link.clone(),
            backward: link.clone(),
            seed: 0,
            secure: false,
            encoded: false,
            master_clock: None,
            slave_clock: Some(EndpointClock::new(&clock).unwrap()),
        };
        run_virtual(&settings, &mut master, &mut slave, |_, _| ControlFlow::Continue(())).unwrap();
        for counts in [master.exchange().counts(), slave.exchange().counts()] {
            assert_eq!(counts.holds, 0, "{drift_ppm}");
            for round_trip_ns in [counts.link.round_trip_ns, counts.link.min_round_trip_ns] {
                assert!((100 * MS - 100..=102 * MS).contains(&round_trip_ns), "{drift_ppm}: {round_trip_ns}");
            }
        }
    }
}

/// Link with a delay in ticks each way, and cuts of the frames to the slave and to the master. A cut drops frames, or
/// keeps them until its end.
struct Wire {
    delay: u64,
    cuts: [Vec<std::ops::Range<u64>>; 2],
    keeps: bool,
}

impl Wire {
    /// Build a wire with 30 ms delay and the same cut both ways.
    fn cut(cut: std::ops::Range<u64>, keeps: bool) -> Self {
        Self { delay: 30, cuts: [vec![cut.clone()], vec![cut]], keeps }
    }

    /// Return the cut that affects a frame sent by side `from` at a tick.
    fn cut_at(&self, from: usize, sent: u64) -> Option<&std::ops::Range<u64>> {
        self.cuts[from].iter().find(|cut| cut.contains(&sent))
    }
}

/// Run both sides with these times of the ladder on a wire, and return their states at each tick. A person presses
/// again at `presses`; the slave restarts at `restarts`.
fn run_delayed(
    ticks: u64,
    wire: &Wire,
    ladder: LadderSettings,
    presses: &[u64],
    restarts: Option<u64>,
) -> Vec<[LadderState; 2]> {
    let (mut master, mut slave) = sides();
    let slave_settings = |session| SlaveSettings { ladder, ..slave_settings(session) };
    master.endpoint = MasterEndpoint::new(&MasterSettings { ladder, ..master_settings() }).unwrap();
    slave.endpoint = SlaveEndpoint::new(&slave_settings(2)).unwrap();
    let mut under_way: [VecDeque<(u64, Vec<u8>)>; 2] = Default::default();
    let mut buffer = [0; MAX_FRAME];
    let mut history = Vec::new();
    for tick in 0..ticks {
        let now_ns = tick * MS;
        if restarts == Some(tick) {
            slave.endpoint = SlaveEndpoint::new(&slave_settings(3)).unwrap();
        }
        if presses.contains(&tick) {
            master.command(now_ns, OperatorCommand::Press).unwrap();
        }
        for (from, frames) in under_way.iter_mut().enumerate() {
            let due_at = |sent: u64| wire.cut_at(from, sent).map_or(sent, |cut| cut.end) + wire.delay;
            while frames.front().is_some_and(|(sent, _)| due_at(*sent) <= tick) {
                let (sent, frame) = frames.pop_front().unwrap();
                if wire.keeps || wire.cut_at(from, sent).is_none() {
                    // A frame of an old session is refused.
                    let _ = if from == 0 {
                        slave.receive(LinkTime::at(now_ns), &frame)
                    } else {
                        master.receive(LinkTime::at(now_ns), &frame)
                    };
                }
            }
        }
        let near = master.tick(TickTime::at(now_ns)).state;
        under_way[0].push_back((tick, master.send(LinkTime::at(now_ns), &mut buffer).to_vec()));
        let far = slave.tick(TickTime::at(now_ns)).state;
        under_way[1].push_back((tick, slave.send(LinkTime::at(now_ns), &mut buffer).to_vec()));
        history.push([near, far]);
    }
    history
}

fn engagements(history: &[[LadderState; 2]]) -> usize {
    history.windows(2).filter(|pair| !pair[0][0].is_coupled() && pair[1][0].is_coupled()).count()
}

/// The link is cut so that the slave receives the release of a press but not the press. When the link is back after
/// 20 s, only another press couples the sides.
#[test]
fn press_unseen_by_the_slave_couples_nothing_later() {
    use LadderState::{Aligning, Disengaged, Engaged, Stop};
    let held = |tick: u64| (1000..1600).contains(&tick);
    let ladder = LadderSettings::default();
    let history = run_delayed(2000, &Wire::cut(1000..1600, false), ladder, &[], None);
    assert!(held(1599) && history[1999] == [Stop; 2]);
    for keeps in [false, true] {
        for restarts in [None, Some(15_000)] {
            // The press at 2 s opens the clutch for 100 ms; the cut begins 15 ms before it closes again.
            let mut presses = vec![2000];
            let cut = 2100 - 15..22_000;
            let wire = Wire::cut(cut, keeps);
            let history = run_delayed(26_000, &wire, ladder, &presses, restarts);
            let what = format!("keeps {keeps}, restarts {restarts:?}");
            assert_eq!(history[1999], [Engaged; 2], "{what}");
            assert_eq!(history[2090][1], Disengaged, "{what}: the slave saw the release");
            assert_eq!(history[2101][0], Aligning, "{what}");
            assert!(history[2101 + 250..].iter().all(|sides| sides[0] == Disengaged), "{what}");
            let coupled = history[2101..].iter().any(|sides| sides[1].is_coupled());
            assert!(!coupled, "{what}: the slave engaged by an old press");
            presses.push(24_000);
            let history = run_delayed(26_000, &wire, ladder, &presses, restarts);
            assert_eq!(history[23_999][0], Disengaged, "{what}");
            assert_eq!(history[25_999], [Engaged; 2], "{what}: a new press");
            assert_eq!(engagements(&history), 2, "{what}");
        }
    }
}

/// Both sides are engaged, or in STOP after an outage. One direction is cut from 5 ms before a press until some time
/// after it. If the peer's frames do not confirm the press for two round trips, it ends; after a shorter cut or on a
/// long link it does not.
#[test]
fn unconfirmed_press_ends() {
    use LadderState::{Aligning, Disengaged, Engaged, Stop};
    // With these times no silence becomes STOP while a press waits.
    let patient = LadderSettings { stop_after_ns: 10_000 * MS, ..LadderSettings::default() };
    let usual = LadderSettings::default();
    for (name, was_stopped, to_slave, ladder, delay, back_after, engages) in [
        ("deaf", false, true, usual, 1, 3_400, false),
        ("deaf", false, true, usual, 1, 4_800, false),
        ("deaf", false, true, usual, 1, 200, false),
        ("deaf", false, true, usual, 30, 4_000, false),
        ("deaf", false, true, usual, 300, 3_400, false),
        ("stopped", true, true, usual, 1, 3_400, false),
        ("stopped", true, true, usual, 30, 4_800, false),
        ("stopped", true, true, usual, 30, 200, false),
        ("stopped", true, true, usual, 300, 3_400, false),
        ("the slave's press", false, false, patient, 1, 3_400, false),
        ("the slave's press", false, false, patient, 30, 4_800, false),
        ("within two round trips", false, true, usual, 1, 20, true),
        ("within two round trips", false, true, usual, 300, 400, true),
        ("within two round trips", true, true, usual, 1, 20, true),
        ("within two round trips", true, true, usual, 300, 400, true),
        ("a long way", true, true, usual, 1, 0, true),
        ("a long way", true, true, usual, 100, 0, true),
        ("a long way", true, true, usual, 900, 0, true),
    ] {
        let what = format!("{name}: {delay} ms, back after {back_after} ms");
        let press = 4_000 + 8 * delay;
        let cut = press - 5..press + back_after;
        let mut cuts = [vec![cut], vec![]];
        if !to_slave {
            cuts.swap(0, 1);
        }
        if was_stopped {
            let outage = press - 1_500 - 2 * delay..press - 1_000 - 2 * delay;
            for cuts in &mut cuts {
                cuts.push(outage.clone());
            }
        }
        let wire = Wire { delay, cuts, keeps: false };
        let history = run_delayed(press + 8_000 + 4 * delay, &wire, ladder, &[press - 100], None);
        let at = |tick: u64| history[usize::try_from(tick).unwrap()];
        assert_eq!(at(press - 101), [if was_stopped { Stop } else { Engaged }; 2], "{what}");
        assert_eq!(at(press)[0], Aligning, "{what}");
        let end = press + back_after + 2_000 + 4 * delay;
        if engages {
            assert_eq!(at(end), [Engaged; 2], "{what}");
        } else {
            let last = usize::try_from(press).unwrap();
            let coupled = history[last + 1..].iter().filter(|sides| sides[0].is_coupled()).count();
            assert_eq!((coupled, at(press + 5_000)[0]), (0, Disengaged), "{what}: engaged without an act");
            assert!(!at(press + 5_000)[1].is_coupled(), "{what}");
        }
    }
}

/// Same for a press in HOLD, by a person who waits until the link is good again.
#[test]
fn a_press_out_of_hold_ends_with_the_link() {
    use LadderState::{Aligning, Disengaged, Engaged, Hold};
    // The arm's loop is late for a moment: both sides hold.
    let (mut master, mut slave) = sides();
    let mut under_way: [VecDeque<(u64, Vec<u8>)>; 2] = Default::default();
    let mut buffer = [0; MAX_FRAME];
    let mut states = Vec::new();
    for tick in 0..25_000_u64 {
        let now_ns = tick * MS;
        match tick {
            1000 => slave.exchange_mut().stalled(now_ns),
            2000 => assert!(master.command(now_ns, OperatorCommand::Press).unwrap()),
            _ => {}
        }
        for (from, frames) in under_way.iter_mut().enumerate() {
            while frames.front().is_some_and(|(sent, _)| sent + 30 <= tick) {
                let (sent, frame) = frames.pop_front().unwrap();
                if !(2085..22_000).contains(&sent) {
                    if from == 0 {
                        slave.receive(LinkTime::at(now_ns), &frame)
                    } else {
                        master.receive(LinkTime::at(now_ns), &frame)
                    }
                    .unwrap();
                }
            }
        }
        let near = master.tick(TickTime::at(now_ns)).state;
        under_way[0].push_back((tick, master.send(LinkTime::at(now_ns), &mut buffer).to_vec()));
        let far = slave.tick(TickTime::at(now_ns)).state;
        under_way[1].push_back((tick, slave.send(LinkTime::at(now_ns), &mut buffer).to_vec()));
        states.push([near, far]);
    }
    assert_eq!(states[999], [Engaged; 2]);
    assert_eq!(states[1999], [Hold; 2]);
    assert_eq!(states[2110][0], Aligning);
    assert!(states[2400..].iter().all(|sides| sides[0] == Disengaged), "{:?}", states.last());
    assert!(states[2000..].iter().all(|sides| !sides[1].is_coupled()));
}

/// A master that starts long before its slave needs another press; one that starts shortly before does not.
#[test]
fn a_start_is_a_press_for_as_long_as_any_is() {
    use LadderState::{Aligning, Disengaged, Engaged};
    for (late, presses, expected) in
        [(4000, vec![], Engaged), (60_000, vec![], Disengaged), (60_000, vec![61_000], Engaged)]
    {
        let (mut master, mut slave) = sides();
        let mut buffer = [0; MAX_FRAME];
        let mut state = Disengaged;
        for tick in 0..late + 2000 {
            let now_ns = tick * MS;
            if presses.contains(&tick) {
                master.command(now_ns, OperatorCommand::Press).unwrap();
            }
            state = master.tick(TickTime::at(now_ns)).state;
            assert_eq!(
                state == Aligning && tick < late,
                tick < late.min(5000),
                "{late} at {tick}: {state:?}"
            );
            let frame = master.send(LinkTime::at(now_ns), &mut buffer);
            if tick >= late {
                slave.receive(LinkTime::at(now_ns), frame).unwrap();
                slave.tick(TickTime::at(now_ns));
                master.receive(LinkTime::at(now_ns), slave.send(LinkTime::at(now_ns), &mut buffer)).unwrap();
            }
        }
        assert_eq!(state, expected, "{late} {presses:?}");
    }
}

/// A slave restarts during alignment of the master, after a silence too short for a stop: its first frame ends the
/// press.
#[test]
fn slave_restarted_during_alignment_ends_the_press() {
    use LadderState::{Aligning, Disengaged, Engaged};
    let (mut master, mut slave) = sides();
    // It has had a fault and accepts no press.
    slave.endpoint.exchange.device_failed(None);
    let mut buffer = [0; MAX_FRAME];
    let mut states = Vec::new();
    for tick in 0..4000_u64 {
        let now_ns = tick * MS;
        if tick == 10 {
            slave.endpoint.command(now_ns, OperatorCommand::Acknowledge).unwrap();
        }
        if tick == 60 {
            slave.endpoint = SlaveEndpoint::new(&slave_settings(3)).unwrap();
        }
        if tick == 20 || tick == 3000 {
            master.command(now_ns, OperatorCommand::Press).unwrap();
        }
        states.push(master.tick(TickTime::at(now_ns)).state);
        let frame = master.send(LinkTime::at(now_ns), &mut buffer);
        // The old slave does not hear the press, for less time than would end it.
        if !(20..60).contains(&tick) {
            slave.receive(LinkTime::at(now_ns), frame).unwrap();
        }
        slave.tick(TickTime::at(now_ns));
        if !(60..261).contains(&tick) {
            master.receive(LinkTime::at(now_ns), slave.send(LinkTime::at(now_ns), &mut buffer)).unwrap();
        }
    }
    assert_eq!(states[260], Aligning);
    assert!(states[300..3000].iter().all(|state| *state == Disengaged), "{:?}", states[300]);
    assert_eq!(states[3999], Engaged);
}
