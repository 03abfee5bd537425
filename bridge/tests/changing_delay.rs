//! What the ladder makes of a link whose delay changes, on both sides, in virtual time.
#![allow(clippy::unwrap_used)] // a test may

use std::ops::ControlFlow;

use LadderState::{Engaged, Hold, Stale};
use haptether_bridge::{
    Clutch, Event, LadderSettings, LadderState, MasterEndpoint, MasterSettings, MasterSide, SlaveEndpoint,
    SlaveSettings, SlaveSide, VirtualSettings, coupling::CommandBounds, run_virtual,
};
use haptether_master::{DeviceParameters, Hand, Leg, LegShape, Path, SimulatedMaster};
use haptether_netsim::{DelayChange, LinkSettings};
use haptether_safety::{
    Axes, DeviceModel, LimiterSettings, controller::SafetySettings, estimator::EstimatorKind,
};
use haptether_slave::{ArmParameters, SimulatedSlave, Wall};

const MS: u64 = 1_000_000;

/// State and force of the master, state and command of the slave, each ms.
type Shown = ((LadderState, f64), (LadderState, f64));

fn run(ticks: u64, clutch: Clutch, forward: Vec<DelayChange>, backward: Vec<DelayChange>) -> Vec<Shown> {
    let legs = vec![Leg { duration_s: 0.5, end: Axes::<1>::new(-0.03), shape: LegShape::MinimumJerk }];
    let hand = Hand::new(300.0, 8.0, 20.0, Path::new(Axes::<1>::new(0.02), legs).unwrap(), None).unwrap();
    let mut device = SimulatedMaster::new(DeviceParameters::phantom_desktop(), hand, 0).unwrap();
    device.set_waiting(true);
    let near = MasterEndpoint::new(&MasterSettings {
        period_ns: MS,
        session: 1,
        device: DeviceModel::phantom_desktop(),
        estimator: EstimatorKind::default(),
        safety: SafetySettings::default(),
        limiter: LimiterSettings::default(),
        force_scale: 0.5,
        ladder: LadderSettings::default(),
    })
    .unwrap();
    let far = SlaveEndpoint::new(&SlaveSettings {
        period_ns: MS,
        session: 2,
        position_scale: 1.0,
        bounds: CommandBounds::default(),
        ladder: LadderSettings::default(),
    })
    .unwrap();
    let wall = Wall::new(0.0, 100.0).unwrap();
    let arm = SimulatedSlave::new(ArmParameters::default(), wall, None, 0.02, 0).unwrap();
    let mut master = MasterSide::new(device, near, clutch).unwrap();
    let mut slave = SlaveSide::new(arm, far);
    let link = |timeline| LinkSettings { delay_s: 0.01, timeline, ..LinkSettings::default() };
    let settings = VirtualSettings {
        period_ns: MS,
        slave_period_ns: MS,
        ticks,
        forward: link(forward),
        backward: link(backward),
        seed: 0,
        secure: false,
        master_clock: None,
        slave_clock: None,
    };
    let (mut near, mut far) = (Vec::new(), Vec::new());
    run_virtual(&settings, &mut master, &mut slave, |event, _| {
        match event {
            Event::Master(record) => near.push((record.state, record.device_force[0])),
            Event::Slave(record) => far.push((record.state, record.command[0])),
        }
        ControlFlow::Continue(())
    })
    .unwrap();
    near.into_iter().zip(far).collect()
}

const PERSON: Clutch = Clutch::Auto { reaction_ns: 500 * MS };

fn step(at_s: f64, delay_s: f64) -> Vec<DelayChange> {
    vec![DelayChange { at_s, delay_s, ramp_s: 0.0 }]
}

fn worst(history: &[Shown]) -> LadderState {
    history.iter().map(|((near, _), (far, _))| (*near).max(*far)).max().unwrap()
}

/// A way that is 100 ms longer from one moment on is a silence of 100 ms: both hold. The frames come back, and nothing
/// engages by itself; pressed anew, both run at the new delay and stay.
#[test]
fn a_delay_that_steps_up_for_good_holds_and_then_runs_at_the_new_one() {
    for both in [true, false] {
        let back = if both { step(1.0, 0.11) } else { Vec::new() };
        let held = run(3000, Clutch::Once, step(1.0, 0.11), back.clone());
        assert_eq!(worst(&held[100..1000]), Engaged);
        let after = &held[1150..];
        assert!(after.iter().all(|((near, _), (far, _))| (*near, *far) == (Hold, Hold)), "{both}");
        assert!(held[1250..].iter().all(|((_, force), _)| *force == 0.0));
        let (_, (_, command)) = held[1150];
        assert!(after.iter().all(|(_, (_, one))| *one == command), "the arm holds");

        let again = run(5000, PERSON, step(1.0, 0.11), back);
        let engaged = again.iter().skip(1150).position(|((near, _), _)| *near == Engaged).unwrap() + 1150;
        assert!((1500..2300).contains(&engaged), "{engaged}");
        // Until the slave knows as well, and no further.
        assert_eq!(worst(&again[engaged + 300..]), Engaged, "{both}");
        assert!(again.last().unwrap().0.1 > 0.3, "the hand feels the wall again");
    }
}

/// 15 ms more, once: frames are late for 15 ms, the arm goes on for a moment, and all is as before.
#[test]
fn a_delay_that_steps_up_by_less_than_a_hold_is_stale_once() {
    let history = run(2000, Clutch::Once, step(0.3, 0.025), Vec::new());
    let stale: Vec<_> = (100..2000).filter(|tick| history[*tick].1.0 == Stale).collect();
    assert!(!stale.is_empty() && stale.len() <= 15 && stale[0] >= 310, "{stale:?}");
    assert!(stale.windows(2).all(|pair| pair[1] == pair[0] + 1), "once: {stale:?}");
    assert_eq!(worst(&history[100..]), Stale);
    // Down again, what comes is newer than what was expected, and nothing happens at all.
    let history = run(2000, Clutch::Once, step(0.3, 0.001), Vec::new());
    assert_eq!(worst(&history[100..]), Engaged);
}

/// A delay that swings by 6 ms each way within 0.2 s, for two seconds: the arm follows all the time. Silence alone says
/// nothing of a rise that is slower than time itself.
#[test]
fn a_delay_that_swings_gently_goes_unnoticed() {
    let swing: Vec<_> = (0..20)
        .map(|n| {
            let delay_s = if n % 2 == 0 { 0.016 } else { 0.01 };
            DelayChange { at_s: 0.5 + 0.1 * f64::from(n), delay_s, ramp_s: 0.1 }
        })
        .collect();
    let history = run(3000, Clutch::Once, swing.clone(), swing);
    assert_eq!(worst(&history[100..]), Engaged);
}

/// A delay that jumps up by 30 ms and down again, each 0.2 s: the first jump holds, and nothing of what follows engages
/// or moves anything.
#[test]
fn a_delay_that_jumps_to_and_fro_holds_once_and_stays() {
    let jumps: Vec<_> = (0..10)
        .map(|n| {
            let delay_s = if n % 2 == 0 { 0.04 } else { 0.01 };
            DelayChange { at_s: 0.5 + 0.2 * f64::from(n), delay_s, ramp_s: 0.0 }
        })
        .collect();
    let history = run(3000, Clutch::Once, jumps.clone(), jumps);
    let held = history.iter().position(|(_, (far, _))| *far == Hold).unwrap();
    assert!((520..550).contains(&held), "{held}");
    let command = history[held].1.1;
    for (tick, ((near, force), (far, one))) in history.iter().enumerate().skip(held + 60) {
        assert!(near.is_held() && far.is_held() && *one == command, "{tick}: {near:?} {far:?}");
        assert!(*force == 0.0 || tick < held + 150, "{tick}: {force}");
    }
}
