//! Tick of both sides, three axes compared with poses: `cargo bench -p haptether-bridge --bench pose`.
//!
//! A tick is `tick, send, receive` of master and slave, without a session, with plants that cost nothing.
#![allow(clippy::unwrap_used, missing_docs)] // a bench may; criterion's macros make public items

use std::{hint::black_box, time::Instant};

use criterion::{Criterion, criterion_group, criterion_main};
use haptether_bridge::{
    Clutch, DrivenMaster, DrivenSlave, LadderSettings, LinkTime, MasterEndpoint, MasterRotationSettings,
    MasterSettings, MasterSide, Side, SlaveEndpoint, SlaveGripper, SlaveRotationSettings, SlaveSettings,
    SlaveSide, TickTime, Trigger,
    coupling::{CommandBounds, RotationBounds, RotationLock, RotationState},
    wire::MAX_FRAME,
};
use haptether_master::RotationSample;
use haptether_safety::{
    Axes, DeviceModel, LimiterSettings, RotationModel,
    controller::{ControllerKind, SafetySettings},
    estimator::EstimatorKind,
};
use haptether_slave::GripperSettings;

const MS: u64 = 1_000_000;

fn master(rotation: bool) -> MasterEndpoint<3> {
    let safety = SafetySettings { controllers: ControllerKind::ALL.into(), ..SafetySettings::default() };
    let settings = MasterSettings {
        period_ns: MS,
        run_id: 1,
        device: DeviceModel::uniform(0.157, 0.0, 0.038).unwrap(),
        estimator: EstimatorKind::default(),
        safety,
        limiter: LimiterSettings::default(),
        force_scale: 1.0,
        ladder: LadderSettings::default(),
    };
    if !rotation {
        return MasterEndpoint::new(&settings).unwrap();
    }
    let torque = MasterRotationSettings {
        device: RotationModel::new(Axes::repeat(4e-4), 0.0, 2e-3).unwrap(),
        estimator: EstimatorKind::default().at_lever(0.05),
        safety: safety.at_lever(0.05),
        limiter: LimiterSettings::default().at_lever(0.05),
        torque_scale: 1.0,
        shares_trips: true,
    };
    MasterEndpoint::of_pose(&settings, &torque, RotationLock::Free).unwrap()
}

fn slave(rotation: bool) -> SlaveEndpoint<3> {
    let settings = SlaveSettings {
        period_ns: MS,
        run_id: 2,
        position_scale: 1.0,
        bounds: CommandBounds::default(),
        ladder: LadderSettings::default(),
    };
    if !rotation {
        return SlaveEndpoint::new(&settings).unwrap();
    }
    let bounds = RotationBounds::default();
    let turning =
        SlaveRotationSettings { rotation_scale: 1.0, lock: RotationLock::Free, bounds, alignment: None };
    SlaveEndpoint::of_pose(&settings, &turning).unwrap()
}

/// Step both sides by `ticks` ticks of 1 ms.
fn run(near: &mut impl Side, far: &mut impl Side, from: u64, ticks: u64) {
    let mut buffer = [0; MAX_FRAME];
    for tick in from..from + ticks {
        let now_ns = tick * MS;
        black_box(near.tick(TickTime::at(now_ns)));
        let _ = far.receive(LinkTime::at(now_ns), near.send(LinkTime::at(now_ns), &mut buffer));
        black_box(far.tick(TickTime::at(now_ns)));
        let _ = near.receive(LinkTime::at(now_ns), far.send(LinkTime::at(now_ns), &mut buffer));
    }
}

fn plants(turns: bool) -> (DrivenMaster<3>, DrivenSlave<3>) {
    let at = Axes::<3>::new(0.01, 0.02, 0.03);
    let mut near = DrivenMaster { position: at, ..DrivenMaster::default() };
    let mut far = DrivenSlave::new(5.0).unwrap();
    far.sample = [at, Axes::zeros(), Axes::<3>::new(0.2, 0.0, -0.1)];
    if turns {
        let orientation = nalgebra::UnitQuaternion::from_scaled_axis(Axes::<3>::new(0.3, -0.2, 0.5));
        near.rotation = Some(RotationSample { orientation, angular_velocity: None });
        let torque = Axes::<3>::new(0.01, 0.0, 0.02);
        far.rotation = Some(RotationState { orientation, angular_velocity: Axes::zeros(), torque });
    }
    (near, far)
}

fn ticks(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("tick of both sides");
    for (name, turns, grips) in
        [("three axes", false, false), ("pose", true, false), ("pose with gripper", true, true)]
    {
        let (near, far) = plants(turns);
        let trigger = grips.then_some(Trigger::Driven(Some(0.3)));
        let settings = GripperSettings { position: 0.0, speed: 2.0, force_n: 40.0, object: None };
        let gripper = grips.then(|| SlaveGripper::driven(settings).unwrap());
        let near = MasterSide::new(near, master(turns), Clutch::Once).unwrap().with_trigger(trigger);
        let far = SlaveSide::new(far, slave(turns)).with_gripper(gripper);
        group.bench_function(name, |bencher| {
            bencher.iter_custom(|count| {
                // Sides with the same type of records as in a run.
                let begun = if turns {
                    let (mut near, mut far) =
                        (near.clone().recording_rotation(), far.clone().recording_rotation());
                    run(&mut near, &mut far, 0, 1000);
                    assert!(near.exchange().state().is_coupled() && far.exchange().state().is_coupled());
                    let begun = Instant::now();
                    run(&mut near, &mut far, 1000, count);
                    begun
                } else {
                    let (mut near, mut far) = (near.clone(), far.clone());
                    run(&mut near, &mut far, 0, 1000);
                    assert!(near.exchange().state().is_coupled() && far.exchange().state().is_coupled());
                    let begun = Instant::now();
                    run(&mut near, &mut far, 1000, count);
                    begun
                };
                begun.elapsed()
            });
        });
    }
    group.finish();
}

criterion_group!(benches, ticks);
criterion_main!(benches);
