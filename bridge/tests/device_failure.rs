//! A device that fails: what a person did before anybody could see it takes nothing of it away.
#![allow(clippy::unwrap_used)] // a test may

use std::{net::SocketAddr, time::Duration};

use haptether_bridge::{
    Act, Clutch, DrivenMaster, DrivenSlave, FaultText, LadderSettings, LadderState, MasterEndpoint,
    MasterSettings, MasterSide, Side, SlaveEndpoint, SlaveSettings, SlaveSide, TickTime,
    coupling::CommandBounds,
    live::{
        LiveSettings, LiveWatch, PacedLoop, PeerAddress, PeerSocket, RealtimeDemand, RealtimeSettings,
        Security, paced_by_device,
    },
    wire::Role,
};
use haptether_safety::{
    DeviceModel, Fault, LimiterSettings, controller::SafetySettings, estimator::EstimatorKind,
};

const MS: u64 = 1_000_000;

fn master() -> MasterSide<DrivenMaster<1>, 1> {
    let endpoint = MasterEndpoint::new(&MasterSettings {
        period_ns: MS,
        session: 1,
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
        session: 2,
        position_scale: 1.0,
        bounds: CommandBounds::default(),
        ladder: LadderSettings::default(),
    })
    .unwrap();
    SlaveSide::new(DrivenSlave::new(2.0).unwrap(), endpoint)
}

/// At what a test looks.
trait Seen: Side {
    fn spoil(&mut self, bad: bool);
    /// State of the ladder, and the fault's code.
    fn shown(record: &Self::Record) -> (LadderState, u8);
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

/// What there is to be met at one tick.
#[derive(Clone, Copy)]
struct Met {
    acknowledged: bool,
    failed: bool,
    bad: bool,
}

const NOTHING: Met = Met { acknowledged: false, failed: false, bad: false };

/// The failure is told before the acts of the same tick, as a loop does, or after them.
fn ticks<S: Seen>(mut side: S, failed_first: bool, met: &[Met]) -> Vec<(LadderState, u8)> {
    side.begin(0);
    let mut tick = |(n, met): (u64, &Met)| {
        let now_ns = n * MS;
        if met.failed && failed_first {
            side.device_failed();
        }
        if met.acknowledged {
            side.act(now_ns, Act::Acknowledge).unwrap();
        }
        if met.failed && !failed_first {
            side.device_failed();
        }
        side.spoil(met.bad);
        S::shown(&side.tick(TickTime::at(now_ns)))
    };
    (0..).zip(met).map(&mut tick).collect()
}

fn a_failure_outlasts_the_acts_of_its_tick<S: Seen>(side: impl Fn() -> S) {
    let failed = Met { failed: true, ..NOTHING };
    let bad = Met { bad: true, ..NOTHING };
    let acknowledged = Met { acknowledged: true, ..NOTHING };
    let both = Met { acknowledged: true, ..failed };
    let device = (LadderState::Fault, Fault::Device.code());
    for failed_first in [true, false] {
        let run = |met: &[Met]| ticks(side(), failed_first, met);
        // One sample says so, and none after it.
        let seen = run(&[NOTHING, both, NOTHING, NOTHING, acknowledged, NOTHING]);
        assert_eq!(seen[1..4], [device; 3], "{failed_first}");
        // Once it was seen it is mended as any other is.
        for (state, fault) in &seen[4..] {
            assert!(*state != LadderState::Fault && *fault == 0, "{failed_first} {state:?} {fault}");
        }
        // What is acknowledged is the fault before; the new one stands, and under its own name.
        let seen = run(&[NOTHING, bad, NOTHING, both, NOTHING]);
        assert!(seen[2].0 == LadderState::Fault && seen[2].1 != device.1, "{failed_first}");
        assert_eq!(seen[3..], [device; 2], "{failed_first}");
    }
}

#[test]
fn a_failure_outlasts_an_acknowledgement_of_the_same_tick() {
    a_failure_outlasts_the_acts_of_its_tick(master);
    a_failure_outlasts_the_acts_of_its_tick(slave);
}

/// A loop whose driver is here, with nobody at the other end.
fn paced<S: Seen>(side: S, role: Role) -> (PacedLoop<S>, LiveWatch<S::Record>) {
    let local: SocketAddr = "127.0.0.1:0".parse().unwrap();
    let settings = LiveSettings {
        role,
        period_ns: MS,
        duration_ns: None,
        patience_ns: None,
        ring: 1000,
        realtime: RealtimeSettings { demand: RealtimeDemand::Off, ..RealtimeSettings::default() },
    };
    let socket = PeerSocket::bind(local, PeerAddress::Learned).unwrap();
    paced_by_device(side, socket, settings, Security::Insecure, None).unwrap()
}

/// The same in the loop that drivers turn: an act waits when the sample comes that says so.
fn a_loop_keeps_a_failure<S: Seen>(side: S, role: Role) {
    let (mut paced, mut watch) = paced(side, role);
    paced.begin().unwrap();
    let turn = |paced: &mut PacedLoop<S>, failed: bool| {
        let before = |side: &mut S| {
            if failed {
                side.device_failed();
            }
        };
        let told = paced.turn(before, |side| side.state());
        paced.wait();
        told
    };
    turn(&mut paced, false);
    watch.act(Act::Acknowledge).unwrap();
    assert_eq!(turn(&mut paced, true), Some(LadderState::Fault), "{role:?}");
    assert_eq!(turn(&mut paced, false), Some(LadderState::Fault), "{role:?}");
    watch.act(Act::Acknowledge).unwrap();
    assert_ne!(turn(&mut paced, false), Some(LadderState::Fault), "{role:?}");
}

#[test]
fn a_live_loop_keeps_a_failure_that_an_act_had_come_before() {
    a_loop_keeps_a_failure(master(), Role::Master);
    a_loop_keeps_a_failure(slave(), Role::Slave);
}

/// Whoever says at any time that it is mended.
fn a_device_that_is_gone_is_gone<S: Seen + Send + 'static>(side: S, role: Role) {
    let (mut paced, mut watch) = paced(side, role);
    paced.begin().unwrap();
    let failing = std::thread::spawn(move || paced.fail(&FaultText::new("the bus is down")));
    while !failing.is_finished() {
        // Full where the loop has not taken them yet.
        let _ = watch.act(Act::Acknowledge);
        std::thread::sleep(Duration::from_micros(100));
    }
    failing.join().unwrap();
    let mut told = Vec::new();
    watch.drain(|record| told.push(S::shown(&record).0));
    assert!(told.len() > 10 && told.iter().all(|state| *state == LadderState::Fault), "{role:?} {told:?}");
}

#[test]
fn a_device_that_is_gone_cannot_be_mended_while_the_peer_is_told() {
    a_device_that_is_gone_is_gone(master(), Role::Master);
    a_device_that_is_gone_is_gone(slave(), Role::Slave);
}
