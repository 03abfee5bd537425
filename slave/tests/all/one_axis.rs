//! Arm, wall and pusher along one axis, with command and push held over each millisecond.
#![allow(clippy::unwrap_used)] // a test may

use haptether_slave::{ArmParameters, Axes, Pusher, SimulatedSlave, Wall};

const TICK_NS: u64 = 1_000_000;

fn slave(wall: Wall, pusher: Option<Pusher>) -> SimulatedSlave {
    SimulatedSlave::new(ArmParameters::default(), wall, pusher, 0.02, 0).unwrap()
}

/// A slave whose set position jumps.
fn fast(wall: Wall) -> SimulatedSlave {
    let arm = ArmParameters { max_speed: 1e6, ..ArmParameters::default() };
    SimulatedSlave::new(arm, wall, None, 0.02, 0).unwrap()
}

fn go_to(slave: &mut SimulatedSlave, position: f64) {
    slave.write(&Axes::<1>::new(position), &Axes::zeros());
}

#[test]
fn a_step_command_is_tracked_as_the_closed_form_says() {
    let wall = Wall::new(-1.0, 0.0).unwrap();
    let mut slave = fast(wall);
    go_to(&mut slave, 0.03);
    let w = std::f64::consts::TAU * ArmParameters::default().bandwidth_hz;
    for tick in 1..=50_u32 {
        let sample = slave.read(u64::from(tick) * TICK_NS);
        let t = f64::from(tick) * 1e-3;
        let expected = 0.03 - 0.01 * (1.0 + w * t) * (-w * t).exp();
        assert!((sample.position[0] - expected).abs() < 1e-15, "{tick}");
    }
}

#[test]
fn contact_settles_where_springs_in_series_do() {
    let wall = Wall::new(0.0, 500.0).unwrap();
    let mut slave = slave(wall, None);
    go_to(&mut slave, -0.03);
    let sample = slave.read(2000 * TICK_NS);
    let k = ArmParameters::default().stiffness();
    let force = 0.03 / (1.0 / k + 1.0 / 500.0);
    assert!((sample.environment_force[0] - force).abs() < 1e-9);
}

#[test]
fn contact_is_located_not_stepped_over() {
    // The same motion, read at once and every 0.1 ms: the crossing falls between reads in one of them.
    let wall = Wall::new(0.0, 1e4).unwrap();
    let (mut coarse, mut fine) = (fast(wall), fast(wall));
    for slave in [&mut coarse, &mut fine] {
        go_to(slave, -0.01); // the set position jumps, so both see the same command
    }
    for step in 1..=400_u64 {
        fine.read(step * TICK_NS / 10);
    }
    let (a, b) = (coarse.read(40 * TICK_NS), fine.read(40 * TICK_NS));
    assert!((a.position - b.position).norm() < 1e-12);
    assert!((a.velocity - b.velocity).norm() < 1e-10);
}

#[test]
fn a_push_is_felt_and_gives_way_by_its_compliance() {
    let pusher = Pusher::new(1.0, 0.0, 5.0, 6.0).unwrap();
    let mut slave = slave(Wall::new(-1.0, 0.0).unwrap(), Some(pusher));
    slave.start(0);
    assert_eq!(slave.read(999 * TICK_NS).environment_force[0], 0.0);
    let sample = slave.read(3000 * TICK_NS);
    assert_eq!(sample.environment_force[0], 6.0);
    assert!((sample.position[0] - 0.02 - 6.0 / ArmParameters::default().stiffness()).abs() < 1e-12);
}

#[test]
fn the_set_position_moves_no_faster_than_the_arm_may() {
    let mut slave = slave(Wall::new(-9.0, 0.0).unwrap(), None);
    go_to(&mut slave, 5.0);
    let before = slave.read(900 * TICK_NS).position[0];
    assert!((slave.read(1000 * TICK_NS).position[0] - before - 0.1).abs() < 1e-9);
    go_to(&mut slave, f64::NAN);
    assert!(slave.read(2000 * TICK_NS).position[0].is_finite());
}

#[test]
fn the_motion_is_the_same_bit_for_bit() {
    // FNV-1a over all samples of the first version of this model. Only the push differs: its times are now whole
    // nanoseconds, and 28 of 18000 values differ by an ulp.
    let mut hash = 0xcbf2_9ce4_8422_2325_u64;
    let mut add = |value: f64| {
        for byte in value.to_bits().to_le_bytes() {
            hash = (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3);
        }
    };
    for stiffness in [0.0, 100.0, 5e3, 1e6] {
        let wall = Wall::new(0.0, stiffness).unwrap();
        let mut slave = slave(wall, Some(Pusher::new(0.3, 0.0503, 0.4, 6.0).unwrap()));
        slave.begin(500);
        slave.start(120_000_500);
        let mut now_ns = 500;
        for tick in 0..1500_u32 {
            now_ns += [1_000_000, 1_000_000, 250_000, 2_700_000][(tick % 4) as usize];
            let sample = slave.read(now_ns);
            for value in [sample.position, sample.velocity, sample.environment_force] {
                add(value[0]);
            }
            go_to(&mut slave, 0.02 * (f64::from(tick * tick % 97) / 48.0 - 1.0));
            if tick % 100 == 99 {
                slave.stop();
            }
        }
    }
    assert_eq!(hash, 0x193d_1aeb_e90c_791c, "{hash:#018x}");
}
