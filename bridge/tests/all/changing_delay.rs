//! Reaction of the ladder to a link with a changing delay, on both sides, in virtual time.
#![allow(clippy::unwrap_used)] // a test may

use std::ops::ControlFlow;

use LadderState::{Engaged, Hold, Stale};
use haptether_bridge::{
    Clutch, Event, LadderSettings, LadderState, MasterEndpoint, MasterSettings, MasterSide, Reason,
    SlaveEndpoint, SlaveSettings, SlaveSide, VirtualSettings, coupling::CommandBounds, run_virtual,
};
use haptether_master::{DeviceParameters, Hand, Leg, LegShape, Path, SimulatedMaster};
use haptether_netsim::{DelayChange, LinkSettings};
use haptether_safety::{
    Axes, DeviceModel, LimiterSettings, controller::SafetySettings, estimator::EstimatorKind,
};

use crate::arms::arm_before_wall;

const MS: u64 = 1_000_000;

/// State and force of the master, and state and command of the slave, each ms.
type Shown = ((LadderState, f64), (LadderState, f64));

fn run(ticks: u64, clutch: Clutch, forward: Vec<DelayChange>, backward: Vec<DelayChange>) -> Vec<Shown> {
    let link = |timeline| LinkSettings { delay_s: 0.01, timeline, ..LinkSettings::default() };
    run_over(ticks, clutch, [link(forward), link(backward)], 0).0
}

/// Same, with the reason of each hold of the master and of the slave.
fn run_over(
    ticks: u64,
    clutch: Clutch,
    [forward, backward]: [LinkSettings; 2],
    seed: u64,
) -> (Vec<Shown>, [Vec<Reason>; 2]) {
    let legs = vec![Leg { duration_s: 0.5, end: Axes::<1>::new(-0.03), shape: LegShape::MinimumJerk }];
    let hand = Hand::new(300.0, 8.0, 20.0, Path::new(Axes::<1>::new(0.02), legs).unwrap(), None).unwrap();
    let mut device = SimulatedMaster::new(DeviceParameters::phantom_desktop(), hand, 0).unwrap();
    device.set_waiting(true);
    let near = MasterEndpoint::new(&MasterSettings {
        period_ns: MS,
        run_id: 1,
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
        run_id: 2,
        position_scale: 1.0,
        bounds: CommandBounds::default(),
        ladder: LadderSettings::default(),
    })
    .unwrap();
    let arm = arm_before_wall(0.0, None, 0.02);
    let mut master = MasterSide::new(device, near, clutch).unwrap();
    let mut slave = SlaveSide::new(arm, far);
    let settings = VirtualSettings {
        period_ns: MS,
        slave_period_ns: MS,
        ticks,
        forward,
        backward,
        seed,
        secure: false,
        encoded: false,
        master_clock: None,
        slave_clock: None,
    };
    let (mut near, mut far) = (Vec::<(LadderState, f64)>::new(), Vec::<(LadderState, f64)>::new());
    let mut held = [const { Vec::new() }; 2];
    let mut note = |side: usize, before: Option<&(LadderState, f64)>, state, reason| {
        if state == Hold && before.is_none_or(|(before, _)| *before != Hold) {
            held[side].extend(Reason::from_code(reason));
        }
    };
    run_virtual(&settings, &mut master, &mut slave, |event, _| {
        match event {
            Event::Master(record) => {
                note(0, near.last(), record.state, record.reason);
                near.push((record.state, record.device_force[0]));
            }
            Event::Slave(record) => {
                note(1, far.last(), record.state, record.reason);
                far.push((record.state, record.command[0]));
            }
        }
        ControlFlow::Continue(())
    })
    .unwrap();
    (near.into_iter().zip(far).collect(), held)
}

const PERSON: Clutch = Clutch::Auto { reaction_ns: 500 * MS };

fn step(at_s: f64, delay_s: f64) -> Vec<DelayChange> {
    vec![DelayChange { at_s, delay_s, ramp_s: 0.0 }]
}

fn worst(history: &[Shown]) -> LadderState {
    history.iter().map(|((near, _), (far, _))| (*near).max(*far)).max().unwrap()
}

/// A delay that becomes 100 ms longer at once is a silence of 100 ms: both sides hold. Later frames do not engage
/// them. After a new press both run at the new delay and stay engaged.
#[test]
fn permanent_delay_step_holds_and_then_runs_at_the_new_delay() {
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
        // Until the slave has engaged as well, and no further.
        assert_eq!(worst(&again[engaged + 300..]), Engaged, "{both}");
        assert!(again.last().unwrap().0.1 > 0.3, "the hand feels the wall again");
    }
}

/// A single step of 15 ms: frames are late for 15 ms, the arm extrapolates briefly, and operation continues.
#[test]
fn a_delay_that_steps_up_by_less_than_a_hold_is_stale_once() {
    let history = run(2000, Clutch::Once, step(0.3, 0.025), Vec::new());
    let stale: Vec<_> = (100..2000).filter(|tick| history[*tick].1.0 == Stale).collect();
    assert!(!stale.is_empty() && stale.len() <= 15 && stale[0] >= 310, "{stale:?}");
    assert!(stale.windows(2).all(|pair| pair[1] == pair[0] + 1), "once: {stale:?}");
    assert_eq!(worst(&history[100..]), Stale);
    // After a step down, frames are newer than expected, and nothing happens.
    let history = run(2000, Clutch::Once, step(0.3, 0.001), Vec::new());
    assert_eq!(worst(&history[100..]), Engaged);
}

/// A delay that swings by 6 ms within 0.2 s, for two seconds: the arm follows throughout, because no frame is 20 ms
/// older than usual.
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

/// A delay that jumps up by 30 ms and back every 0.2 s: the first jump holds, and later frames neither engage nor move
/// anything.
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

/// A delay that grows by 12 ms per second without a gap holds both sides once frames are 20 ms older than usual. A
/// press engages at the new delay.
#[test]
fn a_delay_that_creeps_up_holds_once_news_is_old() {
    let creep = |max_s: f64| vec![DelayChange { at_s: 3.0, delay_s: 0.01 + max_s, ramp_s: 10.0 }];
    for (forward, backward) in
        [(creep(0.12), Vec::new()), (Vec::new(), creep(0.12)), (creep(0.06), creep(0.06))]
    {
        let link = |timeline: &Vec<_>| LinkSettings {
            delay_s: 0.01,
            timeline: timeline.clone(),
            ..LinkSettings::default()
        };
        let links = || [link(&forward), link(&backward)];
        let (history, reasons) = run_over(14_000, Clutch::Once, links(), 0);
        assert_eq!(worst(&history[100..4600]), Engaged);
        let held =
            |side: fn(&Shown) -> LadderState| history.iter().position(|one| side(one) == Hold).unwrap();
        // 20 ms are reached after 1.667 s. Waits for the ticks of both loops, and 0.2 ms left of the first deviation
        // estimate, add at most 3 ms: 0.25 s. The other side learns of it within 30 ms.
        for at in [held(|one| one.0.0), held(|one| one.1.0)] {
            assert!((4667..4667 + 250 + 35).contains(&at), "{at}");
        }
        assert!(reasons.iter().any(|side| *side == [Reason::NewsOld]), "{reasons:?}");
        assert!(history[5000..].iter().all(|((near, _), (far, _))| near.is_held() && far.is_held()));
        assert_eq!(worst(&history[5000..]), Hold, "the peer is heard, so nobody stops");

        let (again, reasons) = run_over(18_000, PERSON, links(), 0);
        assert!((2..=6).contains(&reasons[0].len()), "{reasons:?}");
        assert_eq!(worst(&again[15_000..]), Engaged);
        assert!(again.last().unwrap().0.1 > 0.3, "the hand feels the wall again");
    }
}

/// On the network of the demonstration, frames never become so old that a side holds.
#[test]
fn ordinary_jitter_and_loss_do_not_hold_for_age() {
    let link = LinkSettings { delay_s: 0.05, jitter_s: 0.005, loss: 0.01, ..LinkSettings::default() };
    for seed in 0..4 {
        let (_, reasons) = run_over(60_000, PERSON, [link.clone(), link.clone()], seed);
        assert!(reasons.iter().flatten().all(|reason| *reason != Reason::NewsOld), "{seed}: {reasons:?}");
    }
}
