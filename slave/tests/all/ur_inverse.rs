//! Inverse kinematics of UR arms against an independent forward kinematics: the pose matches to 1e-12.
#![allow(clippy::unwrap_used)] // a test may

use std::f64::consts::{FRAC_PI_2, PI};

use haptether_slave::{UrInverse, UrPose, UrRows, UrUnreached};
use nalgebra::{Matrix4, Rotation3, Vector3};
use proptest::prelude::*;

const ALPHA: [f64; 6] = [FRAC_PI_2, 0.0, 0.0, FRAC_PI_2, -FRAC_PI_2, 0.0];
const NONE: [f64; 6] = [0.0; 6];
const TURN: f64 = 2.0 * PI;

fn model(d1: f64, a2: f64, a3: f64, d4: f64, d5: f64, d6: f64) -> UrRows {
    UrRows { theta: NONE, a: [0.0, a2, a3, 0.0, 0.0, 0.0], d: [d1, 0.0, 0.0, d4, d5, d6], alpha: ALPHA }
}

fn models() -> [UrRows; 4] {
    [
        model(0.1519, -0.24365, -0.21325, 0.11235, 0.08535, 0.0819), // UR3
        model(0.1625, -0.425, -0.3922, 0.1333, 0.0997, 0.0996),      // UR5e
        model(0.2363, -0.8620, -0.7287, 0.2010, 0.1593, 0.1543),     // UR20
        model(0.1, 0.5, -0.3, 0.1, -0.1, 0.1),                       // no arm: other signs
    ]
}

/// Deltas of a UR10, from the tests of the vendor's ROS driver.
fn unit() -> (UrRows, UrRows) {
    let model = model(0.1273, -0.612, -0.5723, 0.163_941, 0.1157, 0.0922);
    let sum = |row: [f64; 6], delta: [f64; 6]| std::array::from_fn(|i| row[i] + delta[i]);
    let unit = UrRows {
        theta: [
            -0.000_000_241_478_068_943_590_25,
            1.602_339_523_866_945_6,
            -1.686_071_907_521_713,
            0.083_733_114_770_011_87,
            -0.000_000_101_260_355_871_157_78,
            0.000_000_039_198_620_918_612_37,
        ],
        a: sum(
            model.a,
            [
                0.000_021_223_486_557_120_59,
                0.632_017_132_627_700_7,
                0.002_298_336_388_912_303,
                -0.000_046_140_902_372_093_39,
                -0.000_063_928_005_347_180_15,
                0.0,
            ],
        ),
        d: sum(
            model.d,
            [
                -0.000_160_188_285_741_325_04,
                439.140_974_079_900_96,
                -446.027_059_806_332_15,
                6.886_186_896_423_601_5,
                -0.000_038_658_849_685_818_675,
                -0.000_879_082_742_573_741_9,
            ],
        ),
        alpha: sum(
            model.alpha,
            [
                -0.000_650_246_557_584_166_5,
                0.001_394_166_668_255_904,
                0.006_938_188_803_259_951,
                -0.000_811_641_562_390_219_6,
                0.000_411_120_504_570_705_6,
                0.0,
            ],
        ),
    };
    (model, unit)
}

/// The flange from one homogeneous matrix per joint, without code shared with the tested module.
fn forward(rows: &UrRows, q: &[f64; 6]) -> Matrix4<f64> {
    (0..6).fold(Matrix4::identity(), |base_from_link, i| {
        let turn = Rotation3::from_axis_angle(&Vector3::z_axis(), q[i] + rows.theta[i]).to_homogeneous();
        let step = Matrix4::new_translation(&Vector3::new(rows.a[i], 0.0, rows.d[i]));
        let twist = Rotation3::from_axis_angle(&Vector3::x_axis(), rows.alpha[i]).to_homogeneous();
        base_from_link * turn * step * twist
    })
}

fn pose(matrix: &Matrix4<f64>) -> UrPose {
    UrPose::from_rows(&std::array::from_fn(|row| std::array::from_fn(|column| matrix[(row, column)])))
        .unwrap()
}

fn free(rows: &UrRows) -> UrInverse {
    UrInverse::new(rows, None, [-TURN; 6], [TURN; 6]).unwrap()
}

fn off(rows: &UrRows, q: &[f64; 6], target: &Matrix4<f64>) -> f64 {
    (forward(rows, q) - target).amax()
}

fn apart(one: &[f64; 6], other: &[f64; 6]) -> f64 {
    one.iter().zip(other).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
}

/// Joint angles anywhere, and often where branches meet.
fn angles() -> impl Strategy<Value = [f64; 6]> {
    let anywhere = -TURN..TURN;
    let special =
        prop::sample::select(vec![0.0, PI, -PI, FRAC_PI_2, -FRAC_PI_2, 1e-13, 3e-9, PI - 1e-7, TURN, -TURN]);
    prop::array::uniform6(prop_oneof![4 => anywhere, 1 => special])
}

proptest! {
    #[test]
    fn every_branch_leads_to_the_pose(q in angles(), arm in 0..4_usize) {
        let rows = models()[arm];
        let target = forward(&rows, &q);
        let found = free(&rows).all(&pose(&target));
        // The original posture is one of them, so there is at least one.
        prop_assert!(!found.postures().is_empty(), "{:?}", found.unreached());
        for posture in found.postures() {
            prop_assert!(off(&rows, posture, &target) < 1e-12, "{posture:?} {}", off(&rows, posture, &target));
        }
    }

    #[test]
    fn the_nearest_is_where_the_arm_was(q in angles(), arm in 0..4_usize) {
        let rows = models()[arm];
        let target = forward(&rows, &q);
        // Without limits: at a limit, rounding would send a joint the other way round.
        let endless = UrInverse::new(&rows, None, [f64::NEG_INFINITY; 6], [f64::INFINITY; 6]).unwrap();
        let posture = endless.nearest(&pose(&target), &q).unwrap();
        prop_assert!(off(&rows, &posture, &target) < 1e-12);
        // With the wrist centre over the base axis, rounding moves q1 by its square root without moving the flange. If
        // q5 is 0 as well, that turns q6 by any amount; if the arm is stretched or folded, the pose may become
        // unreachable.
        let centre = target.fixed_view::<3, 1>(0, 3) - target.fixed_view::<3, 1>(0, 2) * rows.d[5];
        let beside = centre.x.hypot(centre.y) - rows.d[3].abs();
        if beside < 1e-2 && (q[4].sin().abs() < 1e-3 || q[2].sin().abs() < 1e-3) {
            return Ok(());
        }
        // Where two branches meet at q = 0, rounding of e moves both by sqrt(e), and q4 or q6 compensate. e is a few
        // roundings of 2 m over the shortest lever of 0.03 m, that of a folded UR3.
        prop_assert!(apart(&posture, &q) < 1e-5, "{posture:?}");
    }

    #[test]
    fn limits_are_kept_and_the_nearest_turn_is_taken(q in angles(), near in angles(), arm in 0..4_usize) {
        let rows = models()[arm];
        let target = forward(&rows, &q);
        let posture = free(&rows).nearest(&pose(&target), &near).unwrap();
        prop_assert!(off(&rows, &posture, &target) < 1e-12);
        for i in 0..6 {
            prop_assert!(posture[i].abs() <= TURN);
            for turned in [posture[i] - TURN, posture[i] + TURN] {
                let nearer = (turned - near[i]).abs() < (posture[i] - near[i]).abs() - 1e-9;
                prop_assert!(!nearer || turned.abs() > TURN);
            }
        }
    }

    #[test]
    fn every_branch_of_a_unit_leads_to_the_pose(q in prop::array::uniform6(-TURN..TURN)) {
        let (model, unit) = unit();
        let target = forward(&unit, &q);
        let inverse = UrInverse::new(&model, Some(&unit), [-TURN; 6], [TURN; 6]).unwrap();
        for posture in inverse.all(&pose(&target)).postures() {
            prop_assert!(off(&unit, posture, &target) < 1e-12);
        }
        let posture = inverse.nearest(&pose(&target), &q).unwrap();
        prop_assert!(off(&unit, &posture, &target) < 1e-12);
        prop_assert!(apart(&posture, &q) < 1e-6, "{posture:?}");
    }
}

/// From 2e-3 rad before to 2e-3 rad after, exactly through the middle: every posture follows the previous one.
fn assert_continuous(rows: &UrRows, middle: [f64; 6], along: [f64; 6]) {
    let inverse = free(rows);
    let at =
        |step: i32| -> [f64; 6] { std::array::from_fn(|i| middle[i] + 1e-5 * f64::from(step) * along[i]) };
    let mut posture = at(-200);
    for step in -200..=200 {
        let target = forward(rows, &at(step));
        let next = inverse.nearest(&pose(&target), &posture).unwrap();
        assert!(off(rows, &next, &target) < 1e-12);
        // A tenth of a degree per step of 1e-5 rad: within the effect of rounding near the middle, and not another
        // branch.
        assert!(apart(&next, &at(step)) < 2e-3, "step {step}: {next:?} for {:?}", at(step));
        posture = next;
    }
}

#[test]
fn paths_go_straight_through_the_wrists_singularity() {
    for rows in models() {
        for q5 in [0.0, PI, -PI] {
            for along in [[0.0, 0.0, 0.0, 0.0, 1.0, 0.0], [0.3, -0.2, 0.5, 0.1, 1.0, -0.7]] {
                assert_continuous(&rows, [0.4, -1.3, 1.1, 0.6, q5, -2.0], along);
            }
        }
    }
}

#[test]
fn paths_touch_the_elbows_singularity_and_go_on() {
    for rows in models() {
        for q3 in [0.0, PI] {
            assert_continuous(&rows, [0.4, -1.3, q3, 0.6, 1.2, -2.0], [0.2, 0.4, 1.0, -0.3, 0.5, 0.1]);
        }
    }
}

#[test]
fn paths_touch_the_shoulders_singularity_and_go_on() {
    for rows in models() {
        // The wrist centre over the base axis: q4 is solved so that x of the centre in frame 1 is 0.
        let reach = |q4: f64| {
            let frame = forward(
                &UrRows { d: [rows.d[0], 0.0, 0.0, 0.0, rows.d[4], 0.0], ..rows },
                &[0.0, -1.2, 0.4, q4, 0.9, 0.3],
            );
            frame[(0, 3)]
        };
        let (mut low, mut high) = (-TURN, TURN);
        let sign =
            (0..=400).map(|i| -TURN + TURN * f64::from(i) / 200.0).find(|&q4| reach(q4) * reach(low) < 0.0);
        let Some(found) = sign else { continue };
        high = high.min(found);
        low = low.max(found - TURN / 200.0);
        for _ in 0..200 {
            let middle = 0.5 * (low + high);
            if reach(middle) * reach(low) > 0.0 { low = middle } else { high = middle }
        }
        assert_continuous(&rows, [0.7, -1.2, 0.4, low, 0.9, 0.3], [1.0, 0.3, -0.4, 0.6, 0.2, 0.1]);
    }
}

#[test]
fn at_the_wrists_singularity_the_last_joint_stays_where_it_was() {
    let rows = models()[1];
    let target = forward(&rows, &[0.4, -1.3, 1.1, 0.6, 0.0, -2.0]);
    let posture = free(&rows).nearest(&pose(&target), &[0.4, -1.3, 1.1, 0.5, 0.0, -1.9]).unwrap();
    assert_eq!(posture[5], -1.9);
    assert!(off(&rows, &posture, &target) < 1e-12);
}

#[test]
fn pose_out_of_reach_has_a_reason() {
    let rows = models()[1];
    let inverse = free(&rows);
    let mut place = Matrix4::identity();
    place[(0, 3)] = 2.0;
    let far = inverse.nearest(&pose(&place), &NONE).unwrap_err();
    assert!(matches!(far, UrUnreached::Elbow { max_m, .. } if (max_m - 0.8172).abs() < 1e-12), "{far}");
    place[(0, 3)] = 0.05;
    let inside = inverse.nearest(&pose(&place), &NONE).unwrap_err();
    assert!(
        matches!(inside, UrUnreached::Shoulder { radius_m, min_m }
        if (radius_m - 0.05).abs() < 1e-12 && min_m == 0.1333),
        "{inside}"
    );
    assert_eq!(inverse.all(&pose(&place)).unreached(), Some(inside));
    assert!(inverse.all(&pose(&place)).postures().is_empty());

    let (model, unit) = unit();
    let inverse = UrInverse::new(&model, Some(&unit), [-TURN; 6], [TURN; 6]).unwrap();
    // Pulled out of an almost stretched arm: the unit leaves its reach before it leaves the slack for units.
    let mut reasons = Vec::new();
    for millimetres in 0..120 {
        let mut drawn = forward(&model, &[0.3, -0.9, 0.1, 0.2, 1.1, 0.4]);
        let direction = Vector3::new(drawn[(0, 3)], drawn[(1, 3)], drawn[(2, 3)] - 0.1273).normalize();
        for row in 0..3 {
            drawn[(row, 3)] += 1e-3 * f64::from(millimetres) * direction[row];
        }
        match inverse.nearest(&pose(&drawn), &NONE) {
            Ok(posture) => {
                assert!(reasons.is_empty(), "reached again");
                assert!(off(&unit, &posture, &drawn) < 1e-12);
            }
            Err(reason) => reasons.push(reason),
        }
    }
    let (first, last) = (reasons[0], reasons[reasons.len() - 1]);
    assert!(
        matches!(first, UrUnreached::Refinement { residual } if (1e-5..5e-3).contains(&residual)),
        "{first}"
    );
    assert!(matches!(last, UrUnreached::Elbow { .. }), "{last}");
}

#[test]
fn a_joint_that_may_not_get_there_is_named() {
    let rows = models()[1];
    let q = [0.4, -1.3, 1.1, 0.6, 0.8, -2.0];
    let target = pose(&forward(&rows, &q));
    let (mut least, mut most) = ([-TURN; 6], [TURN; 6]);
    (least[1], most[1]) = (3.0, 3.001);
    let inverse = UrInverse::new(&rows, None, least, most).unwrap();
    let refused = inverse.nearest(&target, &q).unwrap_err();
    assert!(matches!(refused, UrUnreached::Limits { joint: 2, .. }), "{refused}");
    // A joint without limits follows any number of turns.
    let endless = UrInverse::new(&rows, None, [f64::NEG_INFINITY; 6], [f64::INFINITY; 6]).unwrap();
    let far = q.map(|angle| angle + 10.0 * TURN);
    assert!(apart(&endless.nearest(&target, &far).unwrap(), &far) < 1e-9);
    // At the limit itself, rounding does not send the joint the other way round.
    let edge = [TURN, -1.3, 1.1, 0.6, 0.8, -TURN];
    let found = free(&rows).nearest(&pose(&forward(&rows, &edge)), &edge).unwrap();
    assert!(apart(&found, &edge) < 1e-9 && found[0] <= TURN && found[5] >= -TURN, "{found:?}");
}

#[test]
fn invalid_rows_limits_and_poses_are_refused() {
    let rows = models()[1];
    let refused = |rows: &UrRows| UrInverse::new(rows, None, [-TURN; 6], [TURN; 6]).unwrap_err().name;
    assert_eq!(refused(&UrRows { theta: [1e-6; 6], ..rows }), "theta");
    assert_eq!(refused(&UrRows { a: [0.1; 6], ..rows }), "a");
    assert_eq!(refused(&UrRows { d: [0.1; 6], ..rows }), "d");
    assert_eq!(refused(&UrRows { a: NONE, ..rows }), "a2");
    assert_eq!(refused(&UrRows { alpha: NONE, ..rows }), "alpha");
    assert_eq!(refused(&UrRows { d: [f64::NAN, 0.0, 0.0, 0.1, 0.1, 0.1], ..rows }), "d1");
    let bad = UrRows { theta: [f64::NAN; 6], ..rows };
    assert_eq!(UrInverse::new(&rows, Some(&bad), [-TURN; 6], [TURN; 6]).unwrap_err().name, "theta");
    for least in [f64::NAN, TURN, 7.0] {
        assert!(UrInverse::new(&rows, None, [least; 6], [TURN; 6]).is_err());
    }
    let mut turn = [[1.0, 0.0, 0.0, 0.3], [0.0, 1.0, 0.0, 0.2], [0.0, 0.0, 1.0, 0.1]];
    assert!(UrPose::from_rows(&turn).is_ok());
    turn[2][2] = -1.0;
    assert!(UrPose::from_rows(&turn).is_err());
    turn[2][2] = 1.000_002;
    assert!(UrPose::from_rows(&turn).is_err());
    turn[2][3] = f64::NAN;
    assert!(UrPose::from_rows(&turn).is_err());
}

#[test]
fn a_pose_in_single_precision_is_the_rotation_beside_it() {
    let rows = models()[1];
    let q = [0.4, -1.3, 1.1, 0.6, 0.8, -2.0];
    let target = forward(&rows, &q);
    #[allow(clippy::cast_possible_truncation)]
    let single = target.map(|number| f64::from(number as f32));
    let posture = free(&rows).nearest(&pose(&single), &q).unwrap();
    // A few single-precision roundings over the lever of the wrist.
    assert!(apart(&posture, &q) < 1e-5);
    assert!(off(&rows, &posture, &single) < 2e-7);
}
