//! Both halves of the rotation against the closed form on SO(3), over delays and a turned frame.

use std::collections::VecDeque;

use haptether_safety::Axes;
use nalgebra::UnitQuaternion;

use super::{super::*, *};
use crate::{
    SideKind,
    coupling::{RotationCoupling, RotationState, VirtualToolSettings, quat_wxyz},
    port::CouplingMessage,
    wire::{Frame, Role},
};

const T: f64 = 1e-3;
const K_HAND: f64 = 0.6;
const K: f64 = 0.25;
const K_WALL: f64 = 2.0;

fn exp(phi: [f64; 3]) -> UnitQuaternion<f64> {
    UnitQuaternion::from_scaled_axis(Axes::<3>::from(phi))
}

fn log(to: &UnitQuaternion<f64>, from: &UnitQuaternion<f64>) -> Axes<3> {
    (to * from.inverse()).scaled_axis()
}

/// Frame of an engaged side with these numbers.
fn frame(
    kind: CouplingKind,
    sequence: usize,
    (turned, energy_j): (&Axes<3>, f64),
    [angular_velocity, torque]: [Axes<3>; 2],
) -> Frame {
    let turned = *turned;
    let rotation = RotationState { angular_velocity, torque, ..RotationState::default() };
    Frame {
        role: Role::Slave,
        kind: SideKind::Pose,
        coupling: kind,
        message: CouplingMessage { epoch: 1, turned, sums: [0.0, energy_j], ..CouplingMessage::ZERO },
        rotation: Some(rotation),
        sequence: sequence as u64,
        ..Frame::EMPTY
    }
}

/// Gains of a coupling for a ball of 1e-3 kg m² and a delay a way in ticks.
fn gains(kind: CouplingKind, delay: usize) -> Gains {
    let spring = Gains::spring(K, 0.02 + 1.3 * K * T * (delay as f64 + 1.0));
    if kind.is_linear() {
        return spring;
    }
    let default = kind.default_gains().unwrap();
    let [impedance, most_damping] = [default.impedance, default.most_damping].map(|one| one.min(0.02));
    Gains {
        impedance,
        most_damping,
        start_j: default.start_j,
        spread_s: default.spread_s,
        environment_gain: default.environment_gain,
        grasp_gain: default.grasp_gain,
        ..Gains::spring(K, 0.1)
    }
}

/// A ball of a hand, held by a spring, and a tool in a spring of the world, or an arm that takes torques. Returns the torque
/// on the hand at rest.
fn rest(
    (kind, takes_force): (CouplingKind, bool),
    delay: usize,
    target: UnitQuaternion<f64>,
    wall: UnitQuaternion<f64>,
) -> Axes<3> {
    let gains = gains(kind, delay);
    let tool = VirtualToolSettings::new(2e-3, Some(0.08), 0.0).unwrap();
    let rotation = Some((gains, tool));
    let forces = takes_force.then(|| [ForceArm::new(2e-3, 10.0).unwrap(); 2]);
    let settings = MethodSettings { kind, gains, tool, forces, position_scale: 1.0, rotation };
    let (mut master, mut slave) =
        (CoupledMasterTurn::new(&settings).unwrap(), CoupledSlaveTurn::new(&settings).unwrap());
    let map = |force: f64| {
        let mut map = RotationCoupling::new(1.0, force).unwrap();
        map.set_frame(quat_wxyz(&exp([0.5, -0.2, 0.3])), 0).unwrap();
        map
    };
    let (of_master, mut of_slave) = (map(1.0), map(1.0));
    // The hand starts elsewhere than the tool: only the turns since the engagement couple.
    let start = exp([0.3, 0.1, -0.6]);
    let (mut hand, mut w, mut command) = (start, Axes::<3>::zeros(), UnitQuaternion::identity());
    let (mut forth, mut back) = (VecDeque::new(), VecDeque::new());
    let [mut torque, mut grasp, mut spin, zero] = [Axes::zeros(); 4];
    for tick in 0..20_000 {
        // The world is there once the sides have engaged: the hand's turn begins at that of the tool.
        let stiffness = if tick > 2 * delay { K_WALL } else { 0.0 };
        let measured = log(&wall, &command) * stiffness;
        let (message, velocity, felt, at): (CouplingMessage, Axes<3>, Axes<3>, UnitQuaternion<f64>) =
            if forth.len() > delay { forth.pop_front().unwrap() } else { Default::default() };
        let epoch = message.epoch;
        let master_state = OfMaster {
            at: &at,
            velocity: &velocity,
            force: &felt,
            half: OfHalf { message: &message, epoch, sequence: tick as u64, ..OfHalf::NONE },
        };
        let room = Room { velocity: &spin, ..Room::free(&zero) };
        command = slave.step(&mut of_slave, &command, (&room, &measured), &master_state, T);
        if let Some((exerted, _)) = slave.exerted() {
            // A ball with the inertia and friction of the virtual tool.
            spin = (spin + (exerted + measured) * (T / 2e-3)) / (1.0 + 0.08 * T / 2e-3);
            command = UnitQuaternion::from_scaled_axis(spin * T) * command;
        }
        back.push_back(frame(kind, tick, slave.sent().unwrap(), [*slave.velocity(), measured]));
        if back.len() > delay {
            let newest = back.pop_front().unwrap();
            let grasp = &grasp;
            let motion = HandMotion { at: &hand, velocity: &w, exerted: &torque, grasp, gain: 1.0, dt: T };
            torque = master.request(&of_master, &motion, true, (&newest, newest.message.epoch));
        }
        let turned = master.sent(&hand);
        if turned.is_some() {
            let target = UnitQuaternion::identity().slerp(&target, (tick as f64 / 2000.0).min(1.0));
            grasp = log(&(target * start), &hand) * K_HAND - w * 0.02;
            w += (grasp + torque) * (T / 1e-3);
            hand = UnitQuaternion::from_scaled_axis(w * T) * hand;
        }
        let epoch = u16::from(turned.is_some());
        let (turned, energy_j) = turned.unwrap_or_default();
        let message = CouplingMessage { epoch, turned, sums: [0.0, energy_j], ..CouplingMessage::ZERO };
        forth.push_back((message, w, of_master.coupled_torque(&grasp), hand));
    }
    torque
}

/// `tau = log(R_w C R_t' C') / (1/k_h + 1/k + 1/k_e)` in the frame of the slave: all orientations lie on one geodesic at rest.
#[test]
fn torques_settle_at_the_closed_form_on_so3() {
    let (target, wall, frame) = (exp([0.5, -0.2, 0.3]), exp([0.1, 0.15, -0.1]), exp([0.5, -0.2, 0.3]));
    let wanted = frame * target * frame.inverse();
    let arms = CouplingKind::ALL[1..].iter().flat_map(|kind| [(*kind, false), (*kind, true)]);
    for (kind, takes_force) in arms {
        for delay in [0, 5, 20, 100, 250] {
            // Waves of 250 ms have not come to rest after 20 s.
            if (!kind.sends_energy() && kind != CouplingKind::PdDamped && delay > 20)
                || (kind == CouplingKind::Wave && delay > 100)
            {
                continue;
            }
            // A message of the hand is read at the next tick.
            let round_s = (2 * delay + 1) as f64 * T;
            let compliance = kind.compliance(&gains(kind, delay), round_s, T).unwrap();
            let expected = frame.inverse() * log(&wall, &wanted) / (1.0 / K_HAND + compliance + 1.0 / K_WALL);
            let seen = rest((kind, takes_force), delay, target, wall);
            // TDPA ripples above 100 ms, where alpha takes back what the master gave.
            let tolerance = match kind {
                // An integral of twists along a curved path is off by this much along the torque.
                CouplingKind::Wave => 1e-2,
                CouplingKind::Tdpa if delay > 20 => 0.15,
                CouplingKind::Tdpa => 5e-3,
                _ => 1e-4,
            };
            let off = (seen - expected).norm() / expected.norm();
            assert!(off < tolerance, "{kind:?}, {takes_force}, {delay} ms: {seen} {expected}");
        }
    }
}

/// About one axis and without a frame, the rotation is a translation along one axis.
#[test]
fn a_turn_about_one_axis_is_a_translation() {
    let seen = rest((CouplingKind::PdDamped, false), 10, exp([0.0, 0.0, 0.4]), exp([0.0, 0.0, -0.1]));
    let turned = exp([0.5, -0.2, 0.3]);
    let wanted = turned * exp([0.0, 0.0, 0.4]) * turned.inverse();
    let expected = turned.inverse() * log(&exp([0.0, 0.0, -0.1]), &wanted);
    assert!((seen - expected / (1.0 / K_HAND + 1.0 / K + 1.0 / K_WALL)).norm() < 1e-5);
}
