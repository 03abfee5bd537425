//! What a silent peer leads to, on both sides, in virtual time.
#![allow(clippy::unwrap_used)] // a test may

use std::{collections::VecDeque, ops::ControlFlow};

use haptether_bridge::{
    LadderSettings, LadderState, MasterEndpoint, MasterSettings, MasterSide, Side, SlaveEndpoint,
    SlaveSettings, SlaveSide, TickTime, VirtualSettings, run_virtual, wire::MAX_FRAME,
};
use haptether_master::{DeviceParameters, Hand, Leg, LegShape, Path, SimulatedMaster};
use haptether_netsim::{ClockSettings, EndpointClock, LinkSettings};
use haptether_safety::{
    Axes, DeviceModel, LimiterSettings, controller::SafetySettings, estimator::EstimatorKind,
};
use haptether_slave::{ArmParameters, SimulatedSlave, Wall};

const MS: u64 = 1_000_000;

type Master = MasterSide<SimulatedMaster<1>, 1>;
type Slave = SlaveSide<SimulatedSlave<1>, 1>;

fn master_settings() -> MasterSettings<1> {
    MasterSettings {
        period_ns: MS,
        session: 1,
        device: DeviceModel::phantom_desktop(),
        estimator: EstimatorKind::default(),
        safety: SafetySettings::default(),
        limiter: LimiterSettings::default(),
        force_scale: 1.0,
        ladder: LadderSettings::default(),
    }
}

fn sides() -> (Master, Slave) {
    let legs = vec![Leg { duration_s: 0.5, end: Axes::<1>::new(-0.03), shape: LegShape::MinimumJerk }];
    let hand = Hand::new(300.0, 8.0, 20.0, Path::new(Axes::<1>::new(0.02), legs).unwrap(), None).unwrap();
    let mut device = SimulatedMaster::new(DeviceParameters::phantom_desktop(), hand, 0).unwrap();
    device.set_waiting(true);
    let master = MasterEndpoint::new(&master_settings()).unwrap();
    let slave = SlaveEndpoint::new(&SlaveSettings {
        period_ns: MS,
        session: 2,
        position_scale: 1.0,
        ladder: LadderSettings::default(),
    })
    .unwrap();
    let wall = Wall::new(0.0, 100.0).unwrap();
    let arm = SimulatedSlave::new(ArmParameters::default(), wall, None, 0.02, 0).unwrap();
    (MasterSide { plant: device, endpoint: master }, SlaveSide { plant: arm, endpoint: slave })
}

/// Which way the network passes frames at a tick: (to the slave, to the master).
fn run(ticks: u64, passes: impl Fn(u64) -> (bool, bool)) -> Vec<[(LadderState, f64); 2]> {
    let (mut master, mut slave) = sides();
    let mut buffer = [0; MAX_FRAME];
    let mut history = Vec::new();
    for tick in 0..ticks {
        let now_ns = tick * MS;
        let (there, back) = passes(tick);
        let at_master = master.tick(TickTime::at(now_ns));
        let frame = master.send(now_ns, &mut buffer);
        if there {
            slave.receive(now_ns, frame).unwrap();
        }
        let at_slave = slave.tick(TickTime::at(now_ns));
        let frame = slave.send(now_ns, &mut buffer);
        if back {
            master.receive(now_ns, frame).unwrap();
        }
        history.push([(at_master.state, at_master.device_force[0]), (at_slave.state, at_slave.command[0])]);
    }
    history
}

#[test]
fn a_contact_settles_where_three_springs_in_series_do() {
    let history = run(3000, |_| (true, true));
    let arm = ArmParameters::default().stiffness();
    // Both begin at 0.02 m and the target lies 0.03 m deep: three springs in series.
    let force = 0.03 / (1.0 / 300.0 + 1.0 / arm + 1.0 / 100.0);
    let [(state, device_force), _] = history[2999];
    assert_eq!(state, LadderState::Engaged);
    // Coulomb friction may hold the device up to c beside the balance.
    assert!((device_force - force).abs() < 0.038, "{device_force} {force}");
}

#[test]
fn silence_takes_the_force_within_100_ms_and_the_arm_holds() {
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

#[test]
fn a_short_outage_fades_out_and_in_again_without_a_jump() {
    let history = run(3000, |tick| if (1500..1560).contains(&tick) { (false, false) } else { (true, true) });
    assert_eq!(history[1540].map(|side| side.0), [LadderState::Hold; 2]);
    assert_eq!(history[2999].map(|side| side.0), [LadderState::Engaged; 2]);
    for pair in history.windows(2).skip(1500) {
        let [[(_, before), (_, commanded)], [(_, after), (_, next)]] = [pair[0], pair[1]];
        // 1000 N/s of the limiter is 1 N a tick; unloading over 80 ms is less.
        assert!((after - before).abs() <= 1.0 + 1e-9);
        assert!((next - commanded).abs() < 2e-3, "the arm is never asked to jump");
    }
}

/// A network that delivers every frame 50 ms after it was sent, both ways, and a master that sleeps for a while.
fn run_with_stall(ticks: u64, asleep: std::ops::Range<u64>) -> Vec<(LadderState, f64)> {
    let (mut master, mut slave) = sides();
    let (mut there, mut back) = (VecDeque::new(), VecDeque::new());
    let mut buffer = [0; MAX_FRAME];
    let mut history = Vec::new();
    for tick in 0..ticks {
        let now_ns = tick * MS;
        if !asleep.contains(&tick) {
            let woke = tick == asleep.end;
            while back.front().is_some_and(|(due, _)| *due <= tick) {
                let (_, frame): (u64, Vec<u8>) = back.pop_front().unwrap();
                // The live loop throws away what waited while it slept.
                if !woke {
                    master.receive(now_ns, &frame).unwrap();
                }
            }
            let missed = if woke { asleep.end - asleep.start } else { 0 };
            if woke {
                master.stalled(now_ns);
            }
            let record = master.tick(TickTime { missed, ..TickTime::at(now_ns) });
            there.push_back((tick + 50, master.send(now_ns, &mut buffer).to_vec()));
            history.push((record.state, record.device_force[0]));
        }
        while there.front().is_some_and(|(due, _)| *due <= tick) {
            let (_, frame): (u64, Vec<u8>) = there.pop_front().unwrap();
            slave.receive(now_ns, &frame).unwrap();
        }
        slave.tick(TickTime::at(now_ns));
        back.push_back((tick + 50, slave.send(now_ns, &mut buffer).to_vec()));
    }
    history
}

#[test]
fn a_loop_that_slept_starts_again_from_zero_force() {
    for asleep in [30, 60, 90] {
        let history = run_with_stall(4000, 2000..2000 + asleep);
        assert!(history[1999].1 > 1.5, "the hand feels the wall");
        assert_eq!(history[2000], (LadderState::Hold, 0.0), "asleep for {asleep} ms");
        for pair in history[2000..].windows(2) {
            // Up to 2.3 N within a fade-in of 200 ms, and the wall gives way meanwhile.
            assert!(pair[1].1 - pair[0].1 < 0.05, "asleep for {asleep} ms: {pair:?}");
        }
        assert_eq!(history.last().unwrap().0, LadderState::Engaged);
    }
}

#[test]
fn a_stopped_master_stays_stopped_whatever_arrives() {
    let (mut master, mut slave) = sides();
    let (_, mut restarted) = sides();
    restarted.endpoint = SlaveEndpoint::new(&SlaveSettings {
        period_ns: MS,
        session: 3,
        position_scale: 1.0,
        ladder: LadderSettings::default(),
    })
    .unwrap();
    let mut buffer = [0; MAX_FRAME];
    for tick in 0..3000 {
        let now_ns = tick * MS;
        let record = master.tick(TickTime::at(now_ns));
        let frame = master.send(now_ns, &mut buffer).to_vec();
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
        let _ = peer.receive(now_ns, &frame);
        peer.tick(TickTime::at(now_ns));
        let _ = master.receive(now_ns, peer.send(now_ns, &mut buffer));
        if tick >= 1500 {
            assert_eq!((record.state, record.device_force[0]), (LadderState::Stop, 0.0), "{tick}");
        }
    }
}

/// With WSC on, a fast hand is damped while the two are engaged; damping is a force too, and goes with the peer.
#[test]
fn nothing_is_exerted_without_a_peer_however_the_hand_moves() {
    for safety in [
        SafetySettings { wsc: true, pc: true, ..SafetySettings::default() },
        SafetySettings { hsc: true, vfc: true, ..SafetySettings::default() },
    ] {
        let mut endpoint = MasterEndpoint::<1>::new(&MasterSettings { safety, ..master_settings() }).unwrap();
        for tick in 0..500_u32 {
            let position = Axes::<1>::new(0.8 * f64::from(tick) * 1e-3);
            let told = endpoint.tick(u64::from(tick) * MS, 0, &position, None);
            assert_eq!(told.safety.device_force[0], 0.0);
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
            let told = master.endpoint.tick(now_ns, 0, &Axes::<1>::new(f64::NAN), None);
            assert_eq!(told.safety.device_force[0], 0.0, "in the same tick");
        }
        let record = master.tick(TickTime::at(now_ns));
        let _ = slave.receive(now_ns, master.send(now_ns, &mut buffer));
        let at_slave = slave.tick(TickTime::at(now_ns));
        let _ = master.receive(now_ns, slave.send(now_ns, &mut buffer));
        faults.push((record.state, record.fault, record.device_force[0], at_slave.state));
    }
    let fault = haptether_safety::Fault::from_code(faults[1499].1).unwrap();
    assert_eq!(fault.to_string(), "position is not a finite number");
    assert!(faults[1000..].iter().all(|(state, _, force, _)| *state == LadderState::Fault && *force == 0.0));
    assert_eq!(faults[1002].3, LadderState::Hold);
    assert_eq!(faults[1499].3, LadderState::Stop);
}

#[test]
fn a_frame_from_a_stranger_changes_nothing() {
    let (mut master, _) = sides();
    let noise = [7_u8; 92];
    for tick in 0..50 {
        assert!(master.receive(tick * MS, &noise).is_err());
        assert_eq!(master.tick(TickTime::at(tick * MS)).state, LadderState::Waiting);
    }
    assert_eq!(master.counts().0.refused, 50);
}

/// A round trip is measured on one clock, and what the peer held on the other: neither offset nor drift shows in it
/// beyond the rounding up to ticks.
#[test]
fn the_round_trip_does_not_show_a_clock_that_is_wrong() {
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
            master_clock: None,
            slave_clock: Some(EndpointClock::new(&clock).unwrap()),
        };
        run_virtual(&settings, &mut master, &mut slave, |_, _| ControlFlow::Continue(())).unwrap();
        for (statistics, holds) in [master.counts(), slave.counts()] {
            assert_eq!(holds, 0, "{drift_ppm}");
            for round_trip_ns in [statistics.round_trip_ns, statistics.least_round_trip_ns] {
                assert!((100 * MS - 100..=102 * MS).contains(&round_trip_ns), "{drift_ppm}: {round_trip_ns}");
            }
        }
    }
}
