//! Invariants of both sides over random scenes in virtual time. A seed draws parameters, networks, attacks, clocks,
//! clutches, device faults and changes by people. The scenes have points or hands that turn, with buttons and
//! grippers.
//!
//! Case i of the run has the seed `HAPTETHER_SEED + i` (0 by default); `PROPTEST_CASES` is the number of cases. A
//! failing case prints its seed and its drawn scene. `HAPTETHER_SEED=<seed> PROPTEST_CASES=1` runs it again.
#![allow(clippy::unwrap_used)] // a test may

mod drawn;
mod gripped;
mod homes;
mod plant;
mod pressed;
mod spied;
mod turned;
mod turning;

use std::ops::ControlFlow;

use drawn::{Control, Drawn};
use gripped::DrawnGripper;
use haptether_bridge::{
    LadderState, MasterEndpoint, MasterPlant, MasterSettings, MasterSide, MasterTurn, SlaveEndpoint,
    SlavePlant, SlaveSettings, SlaveSide, SlaveTurn, VirtualSettings, WithTriggerFeedback,
    coupling::ReferencePoint, run_virtual,
};
use haptether_master::{DeviceParameters, Hand, Leg, LegShape, Path, SimulatedMaster};
use haptether_netsim::EndpointClock;
use haptether_safety::{Axes, DeviceModel};
use haptether_slave::{
    ArmControl, ArmModel, Contact, ContactLaw, Environment, Object, PushShape, Pusher, Shape, SimulatedSlave,
};
use plant::Plant;
use spied::{Far, Near, Seen, Sent, Turning};
use turned::DrawnPose;
use turning::{Arm, Complaint};

/// Return a vector along the first axis.
fn along<const N: usize>(value: f64) -> Axes<N> {
    let mut axes = Axes::zeros();
    axes[0] = value;
    axes
}

fn device<const N: usize>(drawn: &Drawn) -> SimulatedMaster<N> {
    let [mass_kg, viscous, encoder_quantum] = drawn.device;
    let [stiffness, damping, strength_n] = drawn.hand;
    let legs = drawn.legs.iter().map(|&(duration_s, end)| {
        // With three axes, the path also has lateral components.
        let end = Axes::from_fn(|axis, _| if axis == 0 { end } else { 0.3 * end });
        Leg { duration_s, end, shape: LegShape::MinimumJerk }
    });
    let path = Path::new(along(0.02), legs.collect()).unwrap();
    let hand = Hand::new(stiffness, damping, strength_n, path, None).unwrap();
    let parameters = DeviceParameters {
        encoder_quantum,
        measures_velocity: encoder_quantum == 0.0,
        stops: (Axes::repeat(-0.2), Axes::repeat(0.2)),
        ..DeviceParameters::ideal(mass_kg, viscous, 0.0)
    };
    let mut device = SimulatedMaster::new(parameters, hand, 0).unwrap();
    device.set_waiting(true);
    device
}

fn arm<const N: usize>(drawn: &Drawn) -> SimulatedSlave<N> {
    let [mass_kg, bandwidth_hz, speed] = drawn.arm;
    let control = match drawn.control {
        Control::Position => ArmControl::Position { bandwidth_hz },
        Control::Velocity => ArmControl::Velocity { bandwidth_hz },
        Control::Pd => {
            ArmControl::Pd { stiffness: 100.0 * bandwidth_hz, damping: 2.0 * mass_kg * bandwidth_hz }
        }
    };
    let model = ArmModel::new(control, mass_kg, Some(speed), drawn.max_acceleration).unwrap();
    let [stiffness, damping] = drawn.wall;
    let contact = Contact::new(ContactLaw::KelvinVoigt { stiffness, damping }, 0.0).unwrap();
    let wall = Object::fixed(Shape::plane(Axes::zeros(), along(1.0)).unwrap(), contact).unwrap();
    let push = Pusher::shaped(PushShape::Ramp { rise_s: 0.05 }, 0.05, 0.2, along(drawn.push_n)).unwrap();
    let environment = Environment::new(vec![wall], vec![push]);
    SimulatedSlave::in_environment(model, environment, None, along(0.02), 0).unwrap()
}

fn near_settings<const N: usize>(drawn: &Drawn) -> MasterSettings<N> {
    let [mass_kg, viscous, _] = drawn.device;
    MasterSettings {
        period_ns: drawn.periods_ns[0],
        run_id: 1,
        device: DeviceModel::new(Axes::repeat(mass_kg), Axes::repeat(viscous), Axes::zeros()).unwrap(),
        estimator: drawn.estimator,
        safety: drawn.safety,
        limiter: drawn.limiter,
        force_scale: drawn.scales[1],
        ladder: drawn.ladder,
    }
}

fn far_settings(drawn: &Drawn) -> SlaveSettings {
    SlaveSettings {
        period_ns: drawn.periods_ns[1],
        run_id: 2,
        position_scale: drawn.scales[0],
        bounds: drawn.bounds,
        ladder: drawn.ladder,
    }
}

fn run<const N: usize>(drawn: &Drawn) -> Result<Seen, String> {
    let near = MasterEndpoint::new(&near_settings(drawn)).map_err(|error| error.to_string())?;
    let far = SlaveEndpoint::new(&far_settings(drawn)).map_err(|error| error.to_string())?;
    let near = near_side(near_plant(device::<N>(drawn), drawn), with_felt_trigger(near, drawn)?, drawn);
    let far = SlaveSide::new(Plant::new(arm::<N>(drawn), drawn.broken[1]), far);
    let far = far.with_gripper(drawn.gripper.as_ref().map(DrawnGripper::led));
    between(drawn, near.recording_trigger(), far, Turning::default())
}

/// Same as [`run`], with a hand and an arm that turn.
fn run_pose(drawn: &Drawn, pose: &DrawnPose) -> Result<Seen, String> {
    let near = MasterEndpoint::of_pose(&near_settings(drawn), &pose.master, pose.lock)
        .map_err(|error| error.to_string())?;
    let far = SlaveEndpoint::of_pose(&far_settings(drawn), &pose.slave).map_err(|error| error.to_string())?;
    let device = near_plant(turning::device(device(drawn), pose), drawn).turning(pose.broken[0]);
    let (complaint, turning) = (Complaint::default(), Turning::default());
    let arm = Arm::new(drawn, pose, complaint.clone(), turning.clone());
    let arm = Plant::new(arm, drawn.broken[1]).turning(pose.broken[1]);
    let reference_point = pose.reference_m.map(|by| ReferencePoint::new(by.into()).unwrap());
    let far = SlaveSide::new(arm, far)
        .with_gripper(drawn.gripper.as_ref().map(DrawnGripper::led))
        .with_reference_point(reference_point)
        .recording_rotation();
    let near =
        near_side(device, with_felt_trigger(near, drawn)?, drawn).recording_rotation().recording_trigger();
    let seen = between(drawn, near, far, turning)?;
    complaint.take().map_or(Ok(seen), Err)
}

fn with_felt_trigger<const N: usize>(
    endpoint: MasterEndpoint<N>,
    drawn: &Drawn,
) -> Result<MasterEndpoint<N>, String> {
    match drawn.gripper.as_ref().and_then(|gripper| gripper.felt) {
        Some(felt) => endpoint.with_trigger(&felt.settings).map_err(|error| error.to_string()),
        None => Ok(endpoint),
    }
}

fn near_plant<P, const N: usize>(model: P, drawn: &Drawn) -> Plant<P, N> {
    Plant::new(model, drawn.broken[0]).with_buttons(drawn.buttons.clone())
}

fn near_side<P: MasterPlant<N>, const N: usize>(
    plant: P,
    endpoint: MasterEndpoint<N>,
    drawn: &Drawn,
) -> MasterSide<P, N> {
    MasterSide::new(plant, endpoint, drawn.clutch.clone())
        .unwrap()
        .with_buttons(drawn.buttons.as_ref().map(|buttons| buttons.settings))
        .unwrap()
        .with_trigger(drawn.gripper.as_ref().map(DrawnGripper::trigger))
}

/// Run both sides over their network.
fn between<P, Q, R, S, const N: usize>(
    drawn: &Drawn,
    near: MasterSide<Plant<P, N>, N, WithTriggerFeedback<R>>,
    far: SlaveSide<Plant<Q, N>, N, S>,
    turning: Turning,
) -> Result<Seen, String>
where
    P: MasterPlant<N>,
    Q: SlavePlant<N>,
    R: MasterTurn,
    S: SlaveTurn,
{
    let sent = drawn.secure.then(Sent::default);
    let mut near = Near::new(near, drawn, sent.clone(), turning.clone());
    let mut far = Far::new(far, drawn, sent, turning);
    let [master_clock, slave_clock] =
        drawn.clocks.map(|clock| clock.map(|settings| EndpointClock::new(&settings).unwrap()));
    let [forward, backward] = drawn.links.clone();
    let settings = VirtualSettings {
        period_ns: drawn.periods_ns[0],
        slave_period_ns: drawn.periods_ns[1],
        ticks: drawn.end_ns / drawn.periods_ns[0],
        forward,
        backward,
        seed: drawn.seed,
        secure: drawn.secure,
        encoded: true,
        master_clock,
        slave_clock,
    };
    run_virtual(&settings, &mut near, &mut far, |_, _| ControlFlow::Continue(()))
        .map_err(|error| error.to_string())?;
    Ok(near.verdict()?.and(&far.verdict()?))
}

fn setting(name: &str, otherwise: u64) -> u64 {
    std::env::var(name).map_or(otherwise, |text| text.parse().unwrap())
}

#[test]
fn what_must_never_be_is_not_in_ten_thousand_scenes() {
    let (first, cases) = (setting("HAPTETHER_SEED", 0), setting("PROPTEST_CASES", 10_000));
    let mut seen = Seen::default();
    for seed in first..first.saturating_add(cases) {
        let drawn = Drawn::new(seed);
        let ended = match &drawn.pose {
            Some(pose) => run_pose(&drawn, pose),
            None if drawn.axes == 3 => run::<3>(&drawn),
            None => run::<1>(&drawn),
        };
        match ended {
            Ok(one) => seen = seen.and(&one),
            Err(wrong) => panic!("HAPTETHER_SEED={seed} PROPTEST_CASES=1: {wrong}\n{drawn:#?}"),
        }
    }
    println!("{seen:?}");
    // Fewer cases do not reach every condition.
    if cases >= 10_000 {
        for (side, ticks) in seen.ticks.iter().enumerate() {
            for state in LadderState::ALL {
                assert!(ticks[usize::from(state.code())] > 10_000, "{side} {state:?}: {ticks:?}");
            }
        }
        assert!(seen.engagements.iter().all(|count| *count > cases * 8 / 10), "{seen:?}");
        let rest = [
            seen.samples[0],
            seen.samples[1],
            seen.growth_limited,
            seen.commands_limited,
            seen.soft_stops,
            seen.accepted,
            seen.authentic,
            seen.refused,
        ];
        assert!(rest.iter().all(|count| *count > cases / 10), "{seen:?}");
        assert!(seen.turn.fading > 0, "{seen:?}");
        // The energies were computed in most ticks of either side, and only copied in the others.
        let computed = |side: usize| seen.worked[side] > seen.unknown[side].max(10 * cases);
        assert!(computed(0) && computed(1), "{seen:?}");
        let parts = [&seen.turn.all()[..], &seen.buttons.all(), &seen.gripper.all()];
        assert!(parts.concat().iter().all(|count| *count > cases / 50), "{seen:?}");
    }
}
