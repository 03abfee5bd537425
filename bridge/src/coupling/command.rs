//! What a slave takes of a remote command: bounds beyond which it is clamped and counted, and extrapolation where it is
//! late.

use std::f64::consts::PI;

use haptether_safety::{Axes, Real, norm};
use nalgebra::{SimdBool as _, Unit, UnitQuaternion};
use schemars::JsonSchema;
use serde::{Deserialize, Deserializer};

use super::CouplingError;

/// Bounds on the command of a slave. A command from the network can never trip more than these.
///
/// In `[coupling]` of a scene they are `command_speed` and `command_reach`, null without a bound.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, JsonSchema)]
pub struct CommandBounds {
    /// Largest speed in m/s of the commanded position, of all axes together.
    #[serde(rename = "command_speed", deserialize_with = "infinite_or")]
    #[schemars(with = "Option<f64>")]
    pub speed: f64,
    /// Largest distance in m from where the slave stood at its first tick.
    #[serde(rename = "command_reach", deserialize_with = "infinite_or")]
    #[schemars(with = "Option<f64>")]
    pub reach: f64,
}

fn infinite_or<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    Ok(Option::deserialize(deserializer)?.unwrap_or(f64::INFINITY))
}

impl Default for CommandBounds {
    /// 3 m/s is the Cartesian bound of libfranka; the reach is not bounded, for it is the arm's own.
    fn default() -> Self {
        Self { speed: 3.0, reach: f64::INFINITY }
    }
}

impl CommandBounds {
    /// Refuses bounds that are no numbers above 0.
    pub fn check(&self) -> Result<(), CouplingError> {
        for (name, symbol, seen) in
            [("command_speed", "v_max", self.speed), ("command_reach", "r_max", self.reach)]
        {
            if seen.is_nan() || seen <= 0.0 {
                return Err(CouplingError::scale(name, symbol, seen));
            }
        }
        Ok(())
    }
}

/// Bounds on the commanded orientation of a slave, as [`CommandBounds`] on its position.
///
/// In `[coupling]` of a scene they are `command_angular_speed` and `command_turn`, null without a bound.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, JsonSchema)]
pub struct RotationBounds {
    /// Largest angular speed in rad/s of the commanded orientation.
    #[serde(rename = "command_angular_speed", deserialize_with = "infinite_or")]
    #[schemars(with = "Option<f64>")]
    pub speed: f64,
    /// Largest angle in rad from how the slave stood at its first tick.
    #[serde(rename = "command_turn", deserialize_with = "infinite_or")]
    #[schemars(with = "Option<f64>")]
    pub turn: f64,
}

impl Default for RotationBounds {
    /// 2.5 rad/s is the Cartesian bound of libfranka; the angle is not bounded, for it is the arm's own.
    fn default() -> Self {
        Self { speed: 2.5, turn: f64::INFINITY }
    }
}

impl RotationBounds {
    /// Refuses bounds that are no numbers above 0.
    pub fn check(&self) -> Result<(), CouplingError> {
        for (name, symbol, seen) in
            [("command_angular_speed", "w_max", self.speed), ("command_turn", "phi_max", self.turn)]
        {
            if seen.is_nan() || seen <= 0.0 {
                return Err(CouplingError::scale(name, symbol, seen));
            }
        }
        Ok(())
    }
}

/// Which bounds acted on a command.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[allow(clippy::struct_excessive_bools)] // any of them, in any combination
pub struct Limited {
    /// The commanded position would have moved faster than it may.
    pub speed: bool,
    /// It would have left its reach.
    pub reach: bool,
    /// The commanded orientation would have turned faster than it may.
    pub angular_speed: bool,
    /// It would have turned too far.
    pub turn: bool,
}

impl Limited {
    /// As bits: 1 speed, 2 reach, 4 angular speed, 8 turn.
    pub const fn bits(self) -> u8 {
        let Self { speed, reach, angular_speed, turn } = self;
        speed as u8 | (reach as u8) << 1 | (angular_speed as u8) << 2 | (turn as u8) << 3
    }

    /// Whether any acted.
    pub const fn any(self) -> bool {
        self.bits() != 0
    }
}

/// `wanted` as far as it may be commanded `elapsed_s` after `last`, for a slave that began at `home`: the shorter way
/// round, each. Where that way would lead out of the bound on the angle, past pi, it stays at `last`.
pub(crate) fn turned_within(
    bounds: &RotationBounds,
    elapsed_s: f64,
    [home, last, wanted]: [&UnitQuaternion<f64>; 3],
    limited: &mut Limited,
) -> UnitQuaternion<f64> {
    let mut command = *wanted;
    let at_most = |from: &UnitQuaternion<f64>, to: &UnitQuaternion<f64>, angle: f64| {
        let way = (to * from.inverse()).scaled_axis();
        if way.norm() == 0.0 {
            return *to;
        }
        let turn = UnitQuaternion::from_scaled_axis(way * (angle / way.norm()));
        Unit::new_normalize((turn * from).into_inner())
    };
    if command.angle_to(home) > bounds.turn {
        limited.turn = true;
        command = at_most(home, &command, bounds.turn);
    }
    if bounds.turn < PI && passes_pi(home, last, &command) {
        // Both ends are within the bound, and the way between them is not.
        limited.turn = true;
        return *last;
    }
    let max_step = bounds.speed * elapsed_s;
    if command.angle_to(last) > max_step {
        limited.angular_speed = true;
        command = at_most(last, &command, max_step);
    }
    command
}

/// Whether the shorter way between two orientations leads past an angle of pi from `home`.
fn passes_pi(home: &UnitQuaternion<f64>, from: &UnitQuaternion<f64>, to: &UnitQuaternion<f64>) -> bool {
    // Of q and -q the one on the side of home: what lies within a bound is the same side of a sphere, and convex there.
    let near_home = |of: &UnitQuaternion<f64>| {
        let turn = (of * home.inverse()).into_inner();
        if turn.w < 0.0 { -turn } else { turn }
    };
    near_home(from).dot(&near_home(to)) < 0.0
}

/// `wanted` as far as it may be commanded within `bounds` on the speed in m/s and on the distance in m from `home`, where the
/// slave began, `elapsed_s` after `last`; and where each of these acted.
#[inline(always)] // once a tick, from few places
pub(crate) fn bounded<const N: usize, S: Real>(
    [speed, reach]: [S; 2],
    elapsed_s: f64,
    home: &Axes<N, S>,
    last: &Axes<N, S>,
    wanted: &Axes<N, S>,
) -> (Axes<N, S>, [S::SimdBool; 2]) {
    let mut command = *wanted;
    let out = command - home;
    let distance = norm(&out);
    let leaves = distance.simd_gt(reach);
    if leaves.any() {
        let at_reach = home + out * (reach / distance);
        command = command.zip_map(&at_reach, |wanted, nearer| nearer.select(leaves, wanted));
    }
    let step = command - last;
    let max_step = speed * S::splat(elapsed_s);
    let length = norm(&step);
    let hurries = length.simd_gt(max_step);
    if hurries.any() {
        let slower = last + step * (max_step / length);
        command = command.zip_map(&slower, |wanted, nearer| nearer.select(hurries, wanted));
    }
    (command, [hurries, leaves])
}

/// Displacement in s per unit of velocity, and share of the velocity that is left, `late_ns` into a decay of
/// `decay_ns`.
///
/// `d(t) = t - t² / (2 T)`, `v(t) / v = 1 - t / T` for t < T; then `T / 2` and 0.
///
/// With a constant velocity an arm of 1 m/s would run on by 0.2 m before a watchdog of 200 ms; here it goes at most
/// `v T / 2`, 7.5 mm at 15 ms, and stands when HOLD begins.
pub(crate) fn decayed(late_ns: u64, decay_ns: u64) -> (f64, f64) {
    let (t, whole) = (late_ns.min(decay_ns) as f64 * 1e-9, decay_ns as f64 * 1e-9);
    if whole == 0.0 {
        return (0.0, 0.0);
    }
    if late_ns == 0 {
        // To the bit what the formula gives.
        return (0.0, 1.0);
    }
    (t - t * t / (2.0 * whole), 1.0 - t / whole)
}

#[cfg(test)]
mod bounds_tests {
    use super::*;
    use crate::coupling::drawn::orientation;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn what_is_commanded_is_within_both_bounds(
            (wanted, last) in (prop::array::uniform3(-9.0..9.0f64), prop::array::uniform3(-0.5..0.5f64)),
            (speed, reach) in (0.1..5.0f64, 1.0..3.0f64),
        ) {
            let (home, last, wanted) = (Axes::<3>::zeros(), Axes::from(last), Axes::from(wanted));
            let (command, limited) = bounded([speed, reach], 1e-3, &home, &last, &wanted);
            prop_assert!((command - last).norm() <= speed * 1e-3 * (1.0 + 1e-9));
            // A step towards a place within a ball, from within it, stays within it.
            prop_assert!(command.norm() <= reach * (1.0 + 1e-9));
            prop_assert_eq!(limited != [false; 2], command != wanted);
        }
    }

    proptest! {
        #[test]
        fn an_orientation_is_within_both_bounds(
            (wanted, from) in (orientation(), prop::array::uniform3(-1.0..1.0f64)),
            (speed, turn, share) in (0.1..5.0f64, 0.1..3.1f64, 0.0..=1.0f64),
        ) {
            let bounds = RotationBounds { speed, turn };
            let home = UnitQuaternion::from_scaled_axis(Axes::<3>::new(0.3, -0.2, 0.7));
            let from = Axes::<3>::from(from).try_normalize(1e-6).unwrap_or_default() * (share * turn);
            let last = UnitQuaternion::from_scaled_axis(from) * home;
            let mut limited = Limited::default();
            let command = turned_within(&bounds, 1e-3, [&home, &last, &wanted], &mut limited);
            // Rounding of a quaternion whose angle is taken by its inverse cosine or sine: 1e-8 at 0.
            prop_assert!(command.angle_to(&last) <= speed * 1e-3 + 3e-8);
            prop_assert!(command.angle_to(&home) <= turn + 3e-8);
            prop_assert_eq!(limited.any(), command != wanted);
            prop_assert!((command.norm() - 1.0).abs() < 1e-15);
        }
    }

    #[test]
    fn bounds_that_are_none_are_refused() {
        for (speed, turn) in [(0.0, 1.0), (f64::NAN, 1.0), (1.0, -1.0), (1.0, f64::NAN)] {
            assert!(RotationBounds { speed, turn }.check().is_err());
        }
        RotationBounds::default().check().unwrap();
        for (speed, reach) in [(0.0, 1.0), (f64::NAN, 1.0), (1.0, -1.0), (1.0, f64::NAN)] {
            assert!(CommandBounds { speed, reach }.check().is_err());
        }
        assert!(CommandBounds { speed: f64::INFINITY, ..CommandBounds::default() }.check().is_ok());
    }
}

#[cfg(test)]
mod decay_tests {
    use super::*;

    #[test]
    fn it_begins_with_all_of_the_velocity_and_ends_at_rest() {
        const MS: u64 = 1_000_000;
        assert_eq!(decayed(0, 15 * MS), (0.0, 1.0));
        for late in [15 * MS, 16 * MS, u64::MAX] {
            let (distance, share) = decayed(late, 15 * MS);
            assert!((distance - 7.5e-3).abs() < 1e-17 && share == 0.0);
        }
        assert_eq!(decayed(5 * MS, 0), (0.0, 0.0));
        // The distance is the integral of the velocity: trapezoids are exact for a straight line.
        let mut distance = 0.0;
        for tick in 0..15 {
            let [(_, before), (_, after)] = [tick, tick + 1].map(|tick| decayed(tick * MS, 15 * MS));
            distance += 0.5 * (before + after) * 1e-3;
            assert!((decayed((tick + 1) * MS, 15 * MS).0 - distance).abs() < 1e-16);
        }
    }
}
