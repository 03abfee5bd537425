//! The exact master against closed forms.

use crate::*;

const TICK_NS: u64 = 1_000_000;
const MASS: f64 = 0.157;

fn frictionless() -> DeviceParameters<1> {
    DeviceParameters::ideal(MASS, 0.0, 0.0)
}

fn at(x: f64) -> Axes<1> {
    Axes::<1>::new(x)
}

fn alone(device: DeviceParameters<1>, position: f64) -> SimulatedMaster<1> {
    SimulatedMaster::new(device, Hand::absent(at(position)).unwrap(), 0).unwrap()
}

/// Peak velocity when a sampled and held wall of stiffness K ejects the device from depth D.
fn ejection(stiffness: f64, depth: f64) -> f64 {
    let mut master = alone(frictionless(), -depth);
    for tick in 0..1000 {
        let sample = master.read(tick * TICK_NS);
        master.write(&at(-stiffness * sample.position[0].min(0.0)));
    }
    master.velocity()[0]
}

#[test]
fn held_wall_matches_the_sampled_recursion() {
    for (stiffness, depth) in [(200.0, 0.039), (1000.0, 0.0078), (500.0, 0.01)] {
        let (mut z, mut v, dt) = (-depth, 0.0_f64, 1e-3);
        while z < 0.0 {
            let force = -stiffness * z;
            z += v * dt + force * dt * dt / (2.0 * 0.157);
            v += force * dt / 0.157;
        }
        assert!((ejection(stiffness, depth) - v).abs() < 1e-12);
    }
}

#[test]
fn a_held_wall_returns_more_than_it_took() {
    // Half a tick of delay acts as damping -K dT / 2; over a quarter period the gain is exp(pi/8 dT
    // sqrt(K/m)).
    let w = (200.0_f64 / 0.157).sqrt();
    let gain = ejection(200.0, 0.039) / (w * 0.039);
    let predicted = (std::f64::consts::PI / 8.0 * 1e-3 * w).exp();
    // The device leaves the wall inside a tick, up to K D w dT² / m beyond the edge: 1 - cos(w dT) of the
    // velocity.
    assert!((gain - predicted).abs() < 1e-3, "{gain} {predicted}");
    assert!((1.013..1.016).contains(&gain));
}

#[test]
fn coulomb_friction_stops_exactly() {
    let device = DeviceParameters { coulomb: at(0.038), ..frictionless() };
    let mut master = alone(device, 0.0);
    master.place(at(0.0), at(0.1)).unwrap();
    master.read(10_000 * TICK_NS);
    // v² / (2 c / m)
    assert!((master.position()[0] - 0.01 * 0.157 / (2.0 * 0.038)).abs() < 1e-15);
    assert_eq!(master.velocity()[0], 0.0);
}

#[test]
fn stiction_holds_up_to_c_and_not_beyond() {
    let device = DeviceParameters { coulomb: at(0.038), ..frictionless() };
    for (force, moves) in [(0.0379, false), (-0.0379, false), (0.0381, true), (-0.0381, true)] {
        let mut master = alone(device, 0.0);
        master.write(&at(force));
        master.read(100 * TICK_NS);
        assert_eq!(master.position()[0] != 0.0, moves, "{force}");
    }
}

#[test]
fn time_may_begin_anywhere() {
    let mut master = alone(frictionless(), 0.01);
    master.write(&at(1.0));
    // A monotonic clock may have run for years; advancing from 0 would never end.
    master.begin(u64::MAX / 2);
    assert_eq!(master.read(u64::MAX / 2).position[0], 0.01);
    master.read(u64::MAX / 2 + 10 * TICK_NS);
    assert!((master.velocity()[0] - 0.01 / 0.157).abs() < 1e-12);
}

#[test]
fn a_stop_takes_the_speed_and_lets_go_again() {
    let device = DeviceParameters { stops: (at(-0.1), at(0.08)), ..frictionless() };
    let mut master = alone(device, 0.0);
    master.write(&at(2.0));
    // x = F t² / (2 m) reaches the stop at 112 ms.
    master.read(112 * TICK_NS);
    assert!((master.velocity()[0] - 2.0 * 0.112 / 0.157).abs() < 1e-12);
    master.read(300 * TICK_NS);
    assert_eq!((master.position()[0], master.velocity()[0]), (0.08, 0.0));
    master.write(&at(-1.0));
    master.read(400 * TICK_NS);
    assert!((master.position()[0] - (0.08 - 0.005 / 0.157)).abs() < 1e-12);
}

#[test]
fn rests_where_hand_and_force_balance() {
    let path =
        Path::new(at(0.02), vec![Leg { duration_s: 0.5, end: at(-0.03), shape: LegShape::MinimumJerk }])
            .unwrap();
    let hand = Hand::new(300.0, 5.0, 50.0, path, None).unwrap();
    let mut master = SimulatedMaster::new(frictionless(), hand, 0).unwrap();
    master.write(&at(3.0));
    master.read(3000 * TICK_NS);
    assert!((master.position()[0] - (-0.03 + 3.0 / 300.0)).abs() < 1e-9);
    assert!((master.hand_force()[0] + 3.0).abs() < 1e-6);
}

#[test]
fn a_grip_slips_only_beyond_its_strength() {
    for (strength, holds) in [(3.1, true), (2.9, false)] {
        let path = Path::new(at(0.0), Vec::new()).unwrap();
        let hand = Hand::new(300.0, 20.0, strength, path, None).unwrap();
        let mut master = SimulatedMaster::new(frictionless(), hand, 0).unwrap();
        master.write(&at(3.0 * 0.2));
        master.read(500 * TICK_NS);
        // Approach slowly so that the dynamic overshoot does not break the grip.
        for tick in 500..3000_u32 {
            master.write(&at(0.6 + 2.4 * f64::from(tick - 500) / 2500.0));
            master.read(u64::from(tick) * TICK_NS);
        }
        master.write(&at(3.0));
        master.read(4000 * TICK_NS);
        assert_eq!(master.position()[0] < 0.0105, holds, "{strength}: {}", master.position()[0]);
    }
}

/// A linear release from a balanced hold: while the hand slips, m x'' = F0 t / T for constant F0.
#[test]
fn release_follows_its_ramp() {
    let path = Path::new(at(0.0), Vec::new()).unwrap();
    let release = Some(Release { at_s: 0.1, decay_s: 0.05, kind: ReleaseKind::Strength });
    // The strength equals the load, so it slips from the start of the release. The hand is very stiff, so x
    // stays put.
    let hand = Hand::new(1e6, 1e3, 7.8, path, release).unwrap();
    let mut master = SimulatedMaster::new(frictionless(), hand, 0).unwrap();
    master.write(&at(7.8));
    master.place(at(7.8e-6), at(0.0)).unwrap();
    master.read(100 * TICK_NS);
    assert!(master.velocity()[0].abs() < 1e-6);
    master.read(130 * TICK_NS);
    let t: f64 = 0.03;
    let expected = 7.8 / (2.0 * 0.157 * 0.05) * t * t;
    assert!((master.velocity()[0] - expected).abs() < 1e-4 * expected, "{}", master.velocity()[0]);
    assert!((master.hand_force()[0] + 7.8 * 0.4).abs() < 1e-9);
}

#[test]
fn work_of_all_forces_is_the_kinetic_energy() {
    // Slipping hand, friction and held force together, at a step that differs from the internal one.
    let path = Path::new(at(0.0), Vec::new()).unwrap();
    let release = Some(Release { at_s: 0.01, decay_s: 0.02, kind: ReleaseKind::Strength });
    let hand = Hand::new(300.0, 5.0, 4.0, path, release).unwrap();
    let device = DeviceParameters { viscous: at(0.5), coulomb: at(0.05), ..frictionless() };
    let mut coarse = SimulatedMaster::new(device, hand.clone(), 0).unwrap();
    let mut fine = SimulatedMaster::new(device, hand, 0).unwrap();
    coarse.write(&at(3.0));
    fine.write(&at(3.0));
    let (mut work, mut last) = (0.0, (0.0, 0.0));
    for step in 1..=60_000_u64 {
        fine.read(step * 1000);
        let (x, v) = (fine.position()[0], fine.velocity()[0]);
        let middle = 0.5 * (v + last.1);
        let friction = 0.5 * middle + 0.05 * if middle == 0.0 { 0.0 } else { middle.signum() };
        work += (3.0 + fine.hand_force()[0] - friction) * (x - last.0);
        last = (x, v);
    }
    coarse.read(60 * TICK_NS);
    assert!((coarse.velocity()[0] - fine.velocity()[0]).abs() < 1e-10);
    let kinetic = 0.5 * 0.157 * fine.velocity()[0].powi(2);
    assert!((work - kinetic).abs() < 2e-4 * kinetic, "{work} {kinetic}");
}

/// A wall at x = 0 that fills x < 0.
fn wall(stiffness: f64, damping: f64) -> ContinuousWall<1> {
    ContinuousWall::new(at(0.0), at(1.0), stiffness, damping, false).unwrap()
}

#[test]
fn continuous_wall_matches_the_closed_form() {
    // V = sqrt(K/m) D; the energy K D² / 2 becomes m V² / 2.
    for exponent in 4..=24 {
        let stiffness = 10.0_f64.powf(f64::from(exponent) / 4.0);
        let depth = (7.8 / stiffness).min(0.05);
        let mut master = alone(frictionless(), 0.0).with_walls(vec![wall(stiffness, 0.0)]).unwrap();
        master.place(at(-depth), at(0.0)).unwrap();
        for tick in 1..=1000 {
            master.read(tick * TICK_NS);
        }
        let expected = (stiffness / MASS).sqrt() * depth;
        let error = (master.velocity()[0] / expected - 1.0).abs();
        assert!(error < 1e-13, "{stiffness}: {error:e}");
        // A quarter of the period.
        let left = master.touch().broke_s.unwrap();
        let quarter = std::f64::consts::FRAC_PI_2 * (MASS / stiffness).sqrt();
        assert!((left / quarter - 1.0).abs() < 1e-12, "{stiffness}: {left} {quarter}");
    }
}

#[test]
fn an_undamped_bounce_keeps_its_energy_over_ten_thousand_contacts() {
    let mut master = alone(frictionless(), 0.01).with_walls(vec![wall(1000.0, 0.0)]).unwrap();
    master.write(&at(-1.0));
    let energy = |master: &SimulatedMaster<1>| {
        let (x, v) = (master.position()[0], master.velocity()[0]);
        0.5 * MASS * v * v + 500.0 * x.min(0.0).powi(2) + x
    };
    let begun = energy(&master);
    let mut tick = 0;
    let mut worst: f64 = 0.0;
    while master.touch().count < 10_000 {
        tick += 1;
        master.read(tick * TICK_NS);
        worst = worst.max((energy(&master) / begun - 1.0).abs());
    }
    assert!(worst < 1e-12, "{worst:e}");
    assert!(tick > 100_000);
}

#[test]
fn damped_wall_matches_the_closed_form() {
    // Under the contact law m x'' + B x' + K x = 0 until K d + B d' = 0.
    let (stiffness, damping) = (1000.0_f64, 2.0_f64);
    let mut master = alone(frictionless(), 0.0).with_walls(vec![wall(stiffness, damping)]).unwrap();
    master.place(at(0.0), at(-0.5)).unwrap();
    for tick in 1..=100 {
        master.read(tick * TICK_NS);
    }
    let decay = damping / (2.0 * MASS);
    let rate = (stiffness / MASS - decay * decay).sqrt();
    // x = -V/rate e^{-decay t} sin(rate t); K x + B x' = 0 where tan(rate t) = -B rate / (K - B decay).
    let t = (std::f64::consts::PI - (damping * rate / (stiffness - damping * decay)).atan()) / rate;
    let expected = -0.5 * (-decay * t).exp() * ((rate * t).cos() - decay / rate * (rate * t).sin());
    let left = master.touch().broke_s.unwrap();
    assert!((left - t).abs() < 1e-14, "{left} {t}");
    assert!((master.velocity()[0] - expected).abs() < 1e-14, "{} {expected}", master.velocity()[0]);
}

#[test]
fn a_damped_wall_is_met_once_per_bounce() {
    for phase in 0..100_u32 {
        let device = frictionless();
        let mut master =
            alone(device, 0.02 + 1e-5 * f64::from(phase)).with_walls(vec![wall(1000.0, 0.5)]).unwrap();
        master.write(&at(-0.5));
        let (mut bounces, mut was_out) = (0, true);
        for tick in 1..=1500 {
            master.read(tick * TICK_NS);
            let is_out = master.position()[0] > 0.0;
            bounces += u64::from(was_out && !is_out);
            was_out = is_out;
        }
        assert!(bounces > 5);
        assert_eq!(master.touch().count, bounces, "{phase}");
    }
}

#[test]
fn ticks_do_not_shift_the_time_of_the_hand() {
    let path =
        Path::new(at(0.0), vec![Leg { duration_s: 40.0, end: at(1.0), shape: LegShape::Linear }]).unwrap();
    let hand = Hand::new(300.0, 0.0, f64::INFINITY, path, None).unwrap();
    let device = DeviceParameters { mass_kg: at(1e12), ..frictionless() };
    let mut master = SimulatedMaster::new(device, hand.clone(), 0).unwrap();
    for tick in 1..=30_000_u64 {
        master.read(tick * TICK_NS);
        let expected = hand.force(tick as f64 / 1e3, master.position(), master.velocity());
        // Rounding of the clock, 4e-15 s, and of the target.
        assert!((master.hand_force() - expected).norm() < 1e-12, "{tick}");
    }
}

/// Decimal times that are not multiples of the tick: the rest of a tick after a kink may be below the clock's
/// resolution.
#[test]
fn kinks_beside_a_tick_stay_finite() {
    for hundredths in 1..200_u32 {
        let path = Path::new(at(0.0), Vec::new()).unwrap();
        let release =
            Release { at_s: f64::from(hundredths) * 0.01, decay_s: 0.05, kind: ReleaseKind::Strength };
        let hand = Hand::new(300.0, 5.0, 6.0, path, Some(release)).unwrap();
        let hand = hand.with_regrasp(Regrasp { reaction_s: 0.01, rise_s: 0.02 }).unwrap();
        let mut master = SimulatedMaster::new(frictionless(), hand, 0).unwrap();
        master.write(&at(3.0));
        for tick in 1..=u64::from(hundredths) * 10 + 90 {
            master.read(tick * TICK_NS);
        }
        assert!(master.position()[0].is_finite(), "{hundredths}");
    }
}

#[test]
fn friction_in_space_stops_where_energy_predicts() {
    let device = DeviceParameters::<3>::ideal(MASS, 0.0, 0.05);
    let start = Axes::<3>::new(0.1, -0.05, 0.02);
    let mut master = SimulatedMaster::new(device, Hand::absent(start).unwrap(), 0).unwrap();
    let velocity = Axes::<3>::new(0.06, -0.03, 0.02);
    master.place(start, velocity).unwrap();
    for tick in 1..=500 {
        master.read(tick * TICK_NS);
    }
    let length = MASS * velocity.norm_squared() / (2.0 * 0.05);
    let expected = start + velocity.normalize() * length;
    assert!((master.position() - expected).norm() < 1e-15);
    assert_eq!(*master.velocity(), Axes::<3>::zeros());
}

/// A stylus on three axes with friction, held and slipping, against the same at a hundredth of the tick.
#[test]
fn the_tick_does_not_change_the_motion_in_space() {
    let device = DeviceParameters::<3>::ideal(MASS, -0.005, 0.038);
    let leg = |x, y, z| Leg { duration_s: 0.1, end: Axes::<3>::new(x, y, z), shape: LegShape::MinimumJerk };
    let path = Path::new(Axes::<3>::zeros(), vec![leg(0.02, -0.01, 0.005), leg(0.0, 0.01, 0.0)]).unwrap();
    let release = Some(Release { at_s: 0.15, decay_s: 0.03, kind: ReleaseKind::Strength });
    let hand = Hand::new(300.0, 5.0, 1.5, path, release).unwrap();
    let wall = ContinuousWall::new(
        Axes::<3>::new(0.01, 0.0, 0.0),
        Axes::<3>::new(-1.0, 0.2, 0.0),
        500.0,
        0.5,
        false,
    );
    let master = SimulatedMaster::new(device, hand, 0).unwrap().with_walls(vec![wall.unwrap()]).unwrap();
    let (mut coarse, mut fine) = (master.clone(), master);
    coarse.write(&Axes::<3>::new(0.3, 0.9, -0.2));
    fine.write(&Axes::<3>::new(0.3, 0.9, -0.2));
    let mut worst: f64 = 0.0;
    for tick in 1..=300_u64 {
        coarse.read(tick * TICK_NS);
        for step in 1..=100 {
            fine.read((tick - 1) * TICK_NS + step * TICK_NS / 100);
        }
        worst = worst.max((coarse.position() - fine.position()).norm());
        assert!((coarse.velocity() - fine.velocity()).norm() < 1e-8, "{tick}");
    }
    assert!(worst < 1e-10, "{worst:e}");
    assert!(coarse.touch().count > 0);
}

#[test]
fn a_hand_that_regrasps_catches_the_stylus() {
    let path = || Path::new(at(0.0), Vec::new()).unwrap();
    let release = Some(Release { at_s: 0.1, decay_s: 0.02, kind: ReleaseKind::Gain });
    let once = Hand::new(300.0, 10.0, f64::INFINITY, path(), release).unwrap();
    let again = once.clone().with_regrasp(Regrasp { reaction_s: 0.15, rise_s: 0.1 }).unwrap();
    let far = |hand| {
        let mut master = SimulatedMaster::new(frictionless(), hand, 0).unwrap();
        master.write(&at(0.3));
        master.read(2000 * TICK_NS);
        master.position()[0]
    };
    // Without a regrasp it flies off at F/m; with one it rests where the spring holds 0.3 N.
    assert!(far(once) > 2.0);
    assert!((far(again) - 0.3 / 300.0).abs() < 1e-6);
}

/// Eight ticks of 5 ms end one rounding before the end of the release at 0.04 s. The rest of the tick is
/// below the clock's resolution.
#[test]
fn a_release_may_end_within_rounding_of_a_tick() {
    let places = [5_000_000_u64, 1_000_000, 700_000].map(|tick_ns| {
        let legs = vec![Leg { duration_s: 0.1, end: at(0.0), shape: LegShape::MinimumJerk }];
        let path = Path::new(at(0.01), legs).unwrap();
        let release = Release { at_s: 0.0, decay_s: 0.04, kind: ReleaseKind::Gain };
        let hand = Hand::new(300.0, 5.0, f64::INFINITY, path, Some(release)).unwrap();
        let mut master = SimulatedMaster::new(DeviceParameters::ideal(0.1, 0.0, 0.0), hand, 0).unwrap();
        for tick in 1..=60_000_000 / tick_ns {
            master.read(tick * tick_ns);
        }
        master.read(60_000_000).position[0]
    });
    assert!(places.iter().all(|place| (place - places[0]).abs() < 1e-15), "{places:?}");
}

#[test]
fn zero_durations_take_effect_at_once() {
    let thrown = [0.0, 1e-300, 1e-13].map(|duration_s| {
        let path = Path::new(at(0.01), Vec::new()).unwrap();
        let release = Release { at_s: 0.01, decay_s: duration_s, kind: ReleaseKind::Strength };
        let hand = Hand::new(300.0, 5.0, 9.0, path, Some(release)).unwrap();
        let hand = hand.with_regrasp(Regrasp { reaction_s: 0.01, rise_s: duration_s }).unwrap();
        let mut master = SimulatedMaster::new(frictionless(), hand, 0).unwrap();
        master.write(&at(1.0));
        (1..=40).map(|tick| master.read(tick * 1_000_000).position[0]).last().unwrap()
    });
    assert!(thrown[0] > 0.01 && thrown.iter().all(|place| *place == thrown[0]), "{thrown:?}");
    assert!(
        Path::new(at(0.0), vec![Leg { duration_s: 1e-300, end: at(1.0), shape: LegShape::Linear }]).is_err()
    );
}

/// At a speed whose square underflows, friction along the motion has no direction. A device that creeps,
/// turns on the spot or is pushed barely beyond friction stays finite and passive.
#[test]
fn friction_in_space_has_a_direction_at_any_speed() {
    for speed in [1e-300, 1e-256, 1e-160, 1e-120, 1e-30, 1e-11, 1e-9, 1e-6] {
        for push in [0.0, 0.5 - 1e-12, 0.5, 0.5 + 1e-12, 0.6, 5.0] {
            for friction in [0.5, 1e-172] {
                let device = DeviceParameters::<3>::ideal(0.2, 0.0, friction);
                let hand = Hand::absent(Axes::<3>::zeros()).unwrap();
                let mut master = SimulatedMaster::new(device, hand, 0).unwrap();
                master.place(Axes::zeros(), Axes::<3>::new(speed, 0.0, -speed)).unwrap();
                master.write(&Axes::<3>::new(0.0, push, 0.0));
                master.read(20 * TICK_NS);
                let velocity = master.velocity().norm();
                let free = ((push - friction).max(0.0) * 0.02) / 0.2;
                assert!(
                    (velocity - free).abs() < 2e-6 + 1e-6 * free,
                    "{speed} {push} {friction}: {velocity}"
                );
                assert!((master.position().norm() - 0.01 * free).abs() < 1e-7, "{speed} {push} {friction}");
            }
        }
    }
}

/// A force that slowly grows past friction and turns moves the device no faster than the path.
#[test]
fn a_device_in_space_sets_off_gently() {
    let device = DeviceParameters::<3>::ideal(MASS, 0.0, 0.038);
    for (duration_s, shape) in
        [(1.5, LegShape::MinimumJerk), (20.0, LegShape::Linear), (0.05, LegShape::Linear)]
    {
        for aside in [0.0, 0.0068, 0.03] {
            let leg = Leg { duration_s, end: Axes::<3>::new(0.0, 0.04, 0.02), shape };
            let path = Path::new(Axes::<3>::zeros(), vec![leg]).unwrap();
            let hand = Hand::new(300.0, 8.0, 12.0, path, None).unwrap();
            let mut master = SimulatedMaster::new(device, hand, 0).unwrap();
            master.write(&Axes::<3>::new(aside, 0.0, 0.0));
            let mut fastest = 0.0_f64;
            for tick in 1..2000_u64 {
                master.read(tick * 1_000_000);
                fastest = fastest.max(master.velocity().norm());
            }
            // The path's own speed is at most 1.875 L / T; the release of held friction adds c / sqrt(K m).
            let most = 1.5 * 1.875 * 0.0448 / duration_s + 0.038 / (300.0 * MASS).sqrt();
            assert!(fastest > 0.0 && fastest < most, "{duration_s} {aside}: {fastest} {most}");
        }
    }
}

/// `m x'' = F - B x' - K x` over t in s in closed form, for two real, well separated roots.
fn overdamped([mass, damping, stiffness]: [f64; 3], force: f64, [x, v]: [f64; 2], t: f64) -> [f64; 2] {
    let half = 0.5 * damping / mass;
    let fast = -(half + (half * half - stiffness / mass).sqrt());
    let slow = stiffness / mass / fast;
    let from_rest = x - force / stiffness;
    // w = x' - slow x and y = x' - fast x decay independently.
    let (w, y) = ((v - slow * from_rest) * (fast * t).exp(), (v - fast * from_rest) * (slow * t).exp());
    [force / stiffness + (y - w) / (slow - fast), (slow * y - fast * w) / (slow - fast)]
}

/// B dT / m from 30 to 1e9: damping removes the motion, and more stiffness leaves less to diverge.
#[test]
fn stiff_damping_is_the_closed_form() {
    let (stiffness, period_s) = (300.0, 1e-3);
    for ratio in [30.0, 100.0, 1e4, 1e6, 1e9] {
        let damping = ratio * MASS / period_s;
        let path = Path::new(at(0.0), Vec::new()).unwrap();
        let hand = Hand::new(stiffness, damping, f64::INFINITY, path, None).unwrap();
        let mut master = SimulatedMaster::new(frictionless(), hand, 0).unwrap();
        master.place(at(0.01), at(0.8)).unwrap();
        let mut expected = [0.01, 0.8];
        for tick in 1..=40_u32 {
            let force = if tick % 3 == 0 { -4.0 } else { 2.0 * f64::from(tick % 5) };
            master.write(&at(force));
            master.read(u64::from(tick) * TICK_NS);
            expected = overdamped([MASS, damping, stiffness], force, expected, period_s);
            // Rounding of x, and of V as the difference of K x and F: a few eps of each per tick.
            let (off, fast) = (master.position()[0] - expected[0], master.velocity()[0] - expected[1]);
            let pace = (stiffness * 0.02 + 8.0) / damping + if tick == 1 { 0.8 } else { 0.0 };
            assert!(off.abs() < 1e-15 * f64::from(tick), "{ratio} {tick}: {off:e}");
            assert!(fast.abs() < 1e-12 * pace, "{ratio} {tick}: {fast:e} of {pace:e}");
        }
    }
}

/// Behind a target in steady motion a damped hand lags by B V / K, and a stiff one follows its path.
#[test]
fn a_stiffly_damped_hand_follows_its_path() {
    let (stiffness, speed, lasts) = (5e4, 0.1, 0.4);
    let damping = 1e4 * MASS / 1e-3;
    let legs = vec![Leg { duration_s: lasts, end: at(speed * lasts), shape: LegShape::Linear }];
    let hand = Hand::new(stiffness, damping, f64::INFINITY, Path::new(at(0.0), legs).unwrap(), None).unwrap();
    let mut master = SimulatedMaster::new(frictionless(), hand, 0).unwrap();
    for tick in 1..=400 {
        master.read(tick * TICK_NS);
    }
    // x = V (t - T) + A e^(r t) with T = B / K, from rest; the fast root adds a fraction m / B.
    let lag = damping / stiffness;
    let rest = overdamped([MASS, damping, stiffness], 0.0, [speed * lag, -speed], lasts);
    assert!((master.position()[0] - (speed * (lasts - lag) + rest[0])).abs() < 1e-13);
    assert!((master.velocity()[0] - (speed + rest[1])).abs() < 1e-12);
}

/// With a slipping grip, friction, stops, walls and several axes, stiff damping only removes energy.
#[test]
fn stiff_damping_only_removes_energy() {
    let mut devices = Vec::new();
    for friction in [Friction::Axis, Friction::Vector] {
        devices.push(DeviceParameters::<3> { friction, ..DeviceParameters::ideal(MASS, 0.0, 0.05) });
    }
    for device in devices {
        for (ratio, strength, kind) in [
            (1e4, f64::INFINITY, ReleaseKind::Gain),
            (1e4, 5.0, ReleaseKind::Strength),
            (1e7, 5.0, ReleaseKind::Strength),
        ] {
            let start = Axes::<3>::new(0.02, -0.01, 0.0);
            let path = Path::new(Axes::zeros(), Vec::new()).unwrap();
            let release = Release { at_s: 0.02, decay_s: 0.01, kind };
            let hand = Hand::new(300.0, ratio * MASS / 1e-3, strength, path, Some(release)).unwrap();
            let wall = ContinuousWall::new(start, Axes::<3>::new(1.0, 1.0, 0.0), 500.0, 40.0, false).unwrap();
            let mut master = SimulatedMaster::new(device, hand, 0).unwrap().with_walls(vec![wall]).unwrap();
            master.place(start, Axes::<3>::new(0.5, 0.2, -0.1)).unwrap();
            // Energy of motion, spring and wall. A slipping grip stores nothing and adds at most its work.
            let mut given = 0.0;
            let energy = |master: &SimulatedMaster<3>| {
                let depth = wall.depth(master.position()).max(0.0);
                let spring =
                    if strength.is_finite() { 0.0 } else { 300.0 * master.position().norm_squared() };
                0.5 * (MASS * master.velocity().norm_squared() + 500.0 * depth * depth + spring)
            };
            let mut before = energy(&master);
            let begun = before;
            let mut at = *master.position();
            for tick in 1..=60 {
                master.read(tick * TICK_NS);
                let now = energy(&master);
                if strength.is_finite() {
                    given += strength * (master.position() - at).norm();
                    assert!(now <= begun + given, "{ratio} {kind:?} {tick}: {begun} {now} {given}");
                } else {
                    assert!(now <= before * (1.0 + 1e-9) + 1e-12, "{ratio} {kind:?} {tick}: {before} {now}");
                }
                (before, at) = (now, *master.position());
            }
            assert!(
                master.velocity().norm() < 0.55 && master.position().norm() < 0.05,
                "{:?}",
                master.position()
            );
        }
    }
}
