//! Changes by an operator while both sides run: they fade, and stay within the bounds of the scene.
#![allow(clippy::unwrap_used)] // a test may

use OperatorCommand::{ForceScale, Frame, PositionScale, Press, Release};
use haptether_bridge::{
    Clutch, LadderSettings, LadderState, LinkTime, MasterEndpoint, MasterRecord, MasterRotationSettings,
    MasterSettings, MasterSide, OperatorCommand, Side, SlaveEndpoint, SlaveRecord, SlaveRotationSettings,
    SlaveSettings, SlaveSide, TickTime,
    coupling::{CommandBounds, RotationBounds, RotationLock, ScaleRange, ScaleRanges},
    wire::MAX_FRAME,
};
use haptether_master::{DeviceParameters, Hand, Leg, LegShape, Path, SimulatedMaster};
use haptether_safety::{
    Axes, DeviceModel, LimiterSettings, RotationModel, controller::SafetySettings, estimator::EstimatorKind,
};
use haptether_slave::SimulatedSlave;

use crate::arms::arm_before_wall;

const MS: u64 = 1_000_000;
/// Ticks of the fade, equal to that of an engagement.
const FADE: usize = 200;

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

fn slave_settings() -> SlaveSettings {
    SlaveSettings {
        period_ns: MS,
        run_id: 2,
        position_scale: 1.0,
        bounds: CommandBounds::default(),
        ladder: LadderSettings::default(),
    }
}

struct Pair {
    master: MasterSide<SimulatedMaster<1>, 1>,
    slave: SlaveSide<SimulatedSlave<1>, 1>,
    tick: u64,
}

impl Pair {
    /// Build a pair whose hand moves from 2 cm before a wall to `end` in 2 s and stays there.
    fn new(end: f64) -> Self {
        let legs = vec![Leg { duration_s: 2.0, end: Axes::<1>::new(end), shape: LegShape::MinimumJerk }];
        let hand = Hand::new(300.0, 8.0, 20.0, Path::new(Axes::<1>::new(0.02), legs).unwrap(), None).unwrap();
        let mut device = SimulatedMaster::new(DeviceParameters::phantom_desktop(), hand, 0).unwrap();
        device.set_waiting(true);
        let arm = arm_before_wall(0.0, None, 0.02);
        let master = MasterEndpoint::new(&master_settings()).unwrap();
        let slave = SlaveEndpoint::new(&slave_settings()).unwrap();
        Self {
            master: MasterSide::new(device, master, Clutch::Once).unwrap(),
            slave: SlaveSide::new(arm, slave),
            tick: 0,
        }
    }

    fn tick(&mut self) -> (MasterRecord<1>, SlaveRecord<1>) {
        let (now_ns, mut buffer) = (self.tick * MS, [0; MAX_FRAME]);
        self.tick += 1;
        let near = self.master.tick(TickTime::at(now_ns));
        let _ = self.slave.receive(LinkTime::at(now_ns), self.master.send(LinkTime::at(now_ns), &mut buffer));
        let far = self.slave.tick(TickTime::at(now_ns));
        let _ = self.master.receive(LinkTime::at(now_ns), self.slave.send(LinkTime::at(now_ns), &mut buffer));
        (near, far)
    }

    fn run(&mut self, ticks: usize) -> Vec<(MasterRecord<1>, SlaveRecord<1>)> {
        (0..ticks).map(|_| self.tick()).collect()
    }

    /// Command both sides, as a scene does; return the error if a side refuses.
    fn command(&mut self, command: OperatorCommand) -> Result<(), String> {
        let now_ns = self.tick * MS;
        self.master.command(now_ns, command).map_err(|error| error.to_string())?;
        self.slave.command(now_ns, command).map(|_| ()).map_err(|error| error.to_string())
    }
}

/// Return the largest change from one tick to the next.
fn largest_step(values: impl Iterator<Item = f64>) -> f64 {
    let values: Vec<_> = values.collect();
    values.windows(2).fold(0.0, |most, pair| (pair[1] - pair[0]).abs().max(most))
}

/// In contact at 2 N, the force changes per tick by at most its share of the fade. That holds up, down, for locked and
/// freed axes, and for a change during another one. At the end the force has the new scale.
#[test]
fn a_force_in_contact_fades_to_another_scale() {
    let locked = |locked| Frame { quat_wxyz: [1.0, 0.0, 0.0, 0.0], locked: [locked; 7] };
    for (name, changes, expected) in [
        ("twice", vec![(0, ForceScale(2.0))], 2.0),
        ("half", vec![(0, ForceScale(0.5))], 0.5),
        ("there and back", vec![(0, ForceScale(2.0)), (100, ForceScale(0.5)), (150, ForceScale(1.5))], 1.5),
        ("again and again", (0..100).map(|n| (4 * n, ForceScale([2.0, 0.5][n % 2]))).collect(), 0.5),
        ("locked", vec![(0, locked(true))], 0.0),
        ("locked and freed", vec![(0, locked(true)), (300, locked(false))], 1.0),
    ] {
        let mut pair = Pair::new(-0.03);
        let (before, _) = pair.run(4000).pop().unwrap();
        assert!(before.state == LadderState::Engaged && before.rendered_force[0] > 1.9, "{name}: {before:?}");
        let mut seen = Vec::new();
        for tick in 0..1500 {
            for (_, command) in changes.iter().filter(|(at, _)| *at == tick) {
                pair.command(*command).unwrap();
            }
            seen.push(pair.tick());
        }
        // Share of a tick in the largest force felt, 4 N, and half of it again for the motion of the arm meanwhile.
        let most = 1.5 * 4.0 / FADE as f64;
        for step in [
            largest_step(seen.iter().map(|(near, _)| near.rendered_force[0])),
            largest_step(seen.iter().map(|(near, _)| near.device_force[0])),
        ] {
            assert!(step <= most, "{name}: {step} N in a tick, must be at most {most} N");
        }
        let (near, far) = seen.last().unwrap();
        let off = near.rendered_force[0] - expected * far.environment_force[0];
        assert!(off.abs() < 1e-3, "{name}: {} N, must be {expected} times", near.rendered_force[0]);
    }
}

/// In free space at up to 0.19 m/s, a change causes no motion by itself. The velocity passes from one scale to the
/// other over the fade.
#[test]
fn a_motion_fades_to_another_scale() {
    for (name, command) in [("twice", PositionScale(2.0)), ("half", PositionScale(0.5))] {
        let moved = |change: Option<OperatorCommand>| -> Vec<f64> {
            let mut pair = Pair::new(0.22);
            let mut seen = pair.run(900);
            if let Some(command) = change {
                pair.command(command).unwrap();
            }
            seen.extend(pair.run(900));
            seen.iter().map(|(_, far)| far.command[0]).collect()
        };
        let (plain, changed) = (moved(None), moved(Some(command)));
        let speeds = |of: &[f64]| of.windows(2).map(|pair| pair[1] - pair[0]).collect::<Vec<_>>();
        let (plain, changed) = (speeds(&plain), speeds(&changed));
        let scale = if name == "twice" { 2.0 } else { 0.5 };
        assert!(plain[900] > 1.5e-4, "{name}: it moves, by {} m a tick", plain[900]);
        for tick in 890..1700 {
            let share = ((tick as f64 - 899.0) / FADE as f64).clamp(0.0, 1.0);
            let expected = plain[tick] * (1.0 + share * (scale - 1.0));
            // The hand feels no force from it, so both hands move alike.
            assert!(
                (changed[tick] - expected).abs() < 1.01e-2 * plain[tick],
                "{name} at {tick}: {} {expected}",
                changed[tick]
            );
        }
    }
}

/// With a scale of 1 in the scene: refused values, whatever was changed before, and the text of a refusal.
#[test]
fn changes_stay_within_the_bounds_of_the_scene() {
    const CLOSED: [f64; 12] = [
        2.000_001,
        5.0,
        200.0,
        1e6,
        1e308,
        0.499_999,
        1e-300,
        0.0,
        -1.0,
        f64::NAN,
        f64::INFINITY,
        f64::NEG_INFINITY,
    ];
    let mut pair = Pair::new(-0.03);
    let refused = |pair: &mut Pair, scales: &[f64]| {
        for scale in scales {
            for (name, command) in [
                ("force_scale (lambda_f)", ForceScale(*scale)),
                ("position_scale (lambda_p)", PositionScale(*scale)),
            ] {
                let said = pair.command(command).expect_err(name);
                assert!(
                    said.starts_with(&format!("{name} = {scale:?}: must be between 0.5 and 2, ")),
                    "{said}"
                );
                let remedy = if (0.01..=100.0).contains(scale) {
                    "release the clutch first, or state a larger coupling.change_factor in the scene"
                } else {
                    "_scale in the scene"
                };
                assert!(said.contains("with an open clutch between 0.01 and 100; "), "{said}");
                assert!(said.ends_with(remedy), "{said}");
            }
        }
    };
    pair.run(3000);
    refused(&mut pair, &CLOSED);
    // In steps, each within a factor of 2 of the last one, and before its fade is over.
    for ticks in [0, 50, 300] {
        for scale in [1.4, 2.0, 0.5, 1.0, 2.0] {
            pair.command(ForceScale(scale)).unwrap();
            pair.command(PositionScale(scale)).unwrap();
            pair.run(ticks);
        }
        refused(&mut pair, &[2.8, 4.0, 8.0, 0.25]);
    }
    let force = pair.run(1).pop().unwrap().0.rendered_force[0];
    refused(&mut pair, &CLOSED);
    let after = pair.run(1).pop().unwrap().0.rendered_force[0];
    assert!((after - force).abs() < 1e-2, "a refusal changes nothing");
    // A clutch counts as open only without force; during the fade-out it does not.
    pair.command(Release).unwrap();
    pair.run(10);
    refused(&mut pair, &[5.0]);
    pair.run(200);
    for scale in [5.0, 0.01, 100.0, 1.0] {
        pair.command(ForceScale(scale)).unwrap();
        pair.command(PositionScale(scale)).unwrap();
    }
    refused(&mut pair, &[100.1, 200.0, 1e308, 0.0, f64::NAN, 0.009]);
    // A value set with an open clutch does not widen the range of a closed one.
    pair.command(ForceScale(4.0)).unwrap();
    pair.command(Press).unwrap();
    pair.run(1000);
    assert_eq!(pair.master.exchange().state(), LadderState::Engaged);
    refused(&mut pair, &[4.0, 5.0, 8.0]);
    pair.command(ForceScale(2.0)).unwrap();
}

/// A press together with the largest change of an open clutch: the force comes with the engagement, without a step.
#[test]
fn a_change_that_arrives_with_a_press_fades_in_with_it() {
    for (scale, before_press) in [(5.0, true), (5.0, false), (2.0, true), (2.0, false), (0.2, true)] {
        let mut pair = Pair::new(-0.03);
        pair.run(4000);
        pair.command(Release).unwrap();
        pair.run(300);
        for command in if before_press { [ForceScale(scale), Press] } else { [Press, ForceScale(scale)] } {
            pair.command(command).unwrap();
        }
        let seen = pair.run(1000);
        let last = seen.last().unwrap();
        assert_eq!(last.0.state, LadderState::Engaged, "{scale}");
        let step = largest_step(seen.iter().map(|(near, _)| near.device_force[0]));
        let most = seen.iter().fold(0.0_f64, |most, (near, _)| most.max(near.device_force[0]));
        assert!(step <= 4.0 * most / FADE as f64 + 1e-3, "{scale}: {step} N in a tick of {most} N");
        let off = last.0.rendered_force[0] - scale * last.1.environment_force[0];
        assert!(off.abs() < 1e-2, "{scale}: {off} N off");
    }
}

/// A press with a scale that requests more than the device can render: the largest force is reached at the end of the
/// fade.
#[test]
fn force_beyond_the_device_fades_in_with_a_press() {
    let most = LimiterSettings::default().max_force_n;
    for scale in [8.0, 30.0, 100.0] {
        let mut pair = Pair::new(-0.03);
        pair.run(4000);
        pair.command(Release).unwrap();
        pair.run(300);
        pair.command(ForceScale(scale)).unwrap();
        pair.command(Press).unwrap();
        let forces: Vec<_> = pair.run(1000).iter().map(|(near, _)| near.device_force[0]).collect();
        let felt = forces.iter().skip_while(|force| **force == 0.0);
        for (n, force) in felt.enumerate() {
            let bound = most * ((n + 1) as f64 / FADE as f64).min(1.0);
            assert!(*force <= bound + 1e-9, "{scale}: {force} N at tick {n}, must be at most {bound} N");
        }
        assert!(forces.iter().any(|force| *force > 0.5 * most), "{scale}");
    }
}

/// A side that turns also has scales of rotation and torque. A side that does not turn refuses its own and ignores
/// those of the other side. A scene sets another factor, and the values of its own changes.
#[test]
fn each_side_has_the_bounds_of_its_scales() {
    use OperatorCommand::{RotationScale, TorqueScale};
    let mut master = MasterEndpoint::<1>::new(&master_settings()).unwrap();
    let mut slave = SlaveEndpoint::<1>::new(&slave_settings()).unwrap();
    let none = "_scale: only a side of kind \"pose\" has it";
    assert!(master.command(0, TorqueScale(1.0)).unwrap_err().to_string().ends_with(none));
    assert!(slave.command(0, RotationScale(1.0)).unwrap_err().to_string().ends_with(none));
    for other in [PositionScale(1e9), RotationScale(1e9)] {
        assert_eq!(master.command(0, other), Ok(false));
    }
    for other in [ForceScale(1e9), TorqueScale(1e9)] {
        assert_eq!(slave.command(0, other), Ok(false));
    }
    let MasterSettings { period_ns, run_id, estimator, safety, limiter, force_scale, ladder, .. } =
        master_settings();
    let device = DeviceModel::new(Axes::repeat(0.157), Axes::repeat(0.0), Axes::repeat(0.038)).unwrap();
    let settings =
        MasterSettings::<3> { period_ns, run_id, device, estimator, safety, limiter, force_scale, ladder };
    let rotation = MasterRotationSettings {
        device: RotationModel::new(Axes::<3>::repeat(1e-4), 1e-4, 0.0).unwrap(),
        estimator,
        safety: SafetySettings { damping: 0.0, pc_max_damping: 0.01, ..safety.at_lever(0.05) },
        limiter: limiter.at_lever(0.05),
        torque_scale: 0.4,
        shares_trips: false,
    };
    let mut master = MasterEndpoint::of_pose(&settings, &rotation, RotationLock::Free).unwrap();
    let rotation = SlaveRotationSettings {
        rotation_scale: 0.4,
        lock: RotationLock::Free,
        bounds: RotationBounds::default(),
        alignment: None,
    };
    let mut slave = SlaveEndpoint::<3>::of_pose(&slave_settings(), &rotation).unwrap();
    for scale in [0.004, 40.0] {
        assert_eq!(master.command(0, TorqueScale(scale)), Ok(true));
        assert_eq!(slave.command(0, RotationScale(scale)), Ok(true));
    }
    for scale in [0.0039, 41.0] {
        let said = master.command(0, TorqueScale(scale)).unwrap_err().to_string();
        assert!(
            said.contains("torque_scale (lambda_tau)") && said.contains("between 0.2 and 0.8,"),
            "{said}"
        );
        let said = slave.command(0, RotationScale(scale)).unwrap_err().to_string();
        assert!(
            said.contains("rotation_scale (lambda_r)") && said.contains("between 0.2 and 0.8,"),
            "{said}"
        );
    }
    let range = ScaleRange::force(0.5, 4.0, [0.1, 1.0, 7.0]);
    for (scale, is_open, passes) in [
        (0.1, false, true),
        (0.09, false, false),
        (7.0, false, true),
        (7.1, false, false),
        (7.1, true, true),
        (50.0, true, true),
        (50.1, true, false),
    ] {
        assert_eq!(range.check(scale, is_open).is_ok(), passes, "{scale} {is_open}");
    }
    let mut pair = Pair::new(-0.03);
    let ranges = ScaleRanges { translation: Some(range), rotation: None };
    pair.master.endpoint = MasterEndpoint::new(&master_settings()).unwrap().with_ranges(ranges);
    assert_eq!(pair.master.ranges(), ranges);
    pair.run(1000);
    pair.command(ForceScale(7.0)).unwrap();
    assert!(pair.command(ForceScale(7.1)).is_err());
}
