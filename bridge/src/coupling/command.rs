//! Limits on a remote command at the slave: bounds that clamp and count, and extrapolation of late commands.

use std::f64::consts::PI;

use haptether_safety::{Axes, Real, norm};
use nalgebra::{SimdBool as _, Unit, UnitQuaternion};
use schemars::JsonSchema;
use serde::{Deserialize, Deserializer};

use super::CouplingError;

/// Bounds on the command of a slave. A remote command beyond them is clamped and counted; it never causes a
/// fault.
///
/// In `[coupling]` of a scene they are `command_speed` and `command_reach`; null means unbounded.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, JsonSchema)]
pub struct CommandBounds {
    /// Largest speed in m/s of the commanded position: norm over all axes.
    #[serde(rename = "command_speed", deserialize_with = "infinite_or")]
    #[schemars(with = "Option<f64>")]
    pub speed: f64,
    /// Largest distance in m from the slave's start: its first sample after three accepted ones. An
    /// acknowledged fault of the arm renews it.
    #[serde(rename = "command_reach", deserialize_with = "infinite_or")]
    #[schemars(with = "Option<f64>")]
    pub reach: f64,
}

fn infinite_or<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    Ok(Option::deserialize(deserializer)?.unwrap_or(f64::INFINITY))
}

impl Default for CommandBounds {
    /// Default: 3 m/s, the Cartesian bound of libfranka. The reach is unbounded, because the arm itself
    /// limits it.
    fn default() -> Self {
        Self { speed: 3.0, reach: f64::INFINITY }
    }
}

impl CommandBounds {
    /// Return an error for bounds that are not above 0.
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
/// In `[coupling]` of a scene they are `command_angular_speed` and `command_turn`; null means unbounded.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, JsonSchema)]
pub struct RotationBounds {
    /// Largest angular speed in rad/s of the commanded orientation.
    #[serde(rename = "command_angular_speed", deserialize_with = "infinite_or")]
    #[schemars(with = "Option<f64>")]
    pub speed: f64,
    /// Largest angle in rad from the slave's orientation at its start, as [`CommandBounds::reach`].
    #[serde(rename = "command_turn", deserialize_with = "infinite_or")]
    #[schemars(with = "Option<f64>")]
    pub turn: f64,
}

impl Default for RotationBounds {
    /// Default: 2.5 rad/s, the Cartesian bound of libfranka. The angle is unbounded, because the arm itself
    /// limits it.
    fn default() -> Self {
        Self { speed: 2.5, turn: f64::INFINITY }
    }
}

impl RotationBounds {
    /// Return an error for bounds that are not above 0.
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

/// Bounds that acted on a command.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[allow(clippy::struct_excessive_bools)] // independent flags
pub struct Limited {
    /// The bound on the speed of the position.
    pub speed: bool,
    /// The bound on the reach.
    pub reach: bool,
    /// The bound on the angular speed.
    pub angular_speed: bool,
    /// The bound on the turn.
    pub turn: bool,
}

impl Limited {
    /// Return the flags as bits: 1 speed, 2 reach, 4 angular speed, 8 turn.
    pub const fn bits(self) -> u8 {
        let Self { speed, reach, angular_speed, turn } = self;
        speed as u8 | (reach as u8) << 1 | (angular_speed as u8) << 2 | (turn as u8) << 3
    }

    /// Return whether any bound acted.
    pub const fn any(self) -> bool {
        self.bits() != 0
    }
}

/// Limit the orientation `wanted` to `bounds`, `elapsed_s` after the command `last`, for a slave that began
/// at `home`. Each turn takes the shorter way. If the way between two permitted orientations leads past pi
/// from `home`, the command stays at `last`.
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
        // Both ends are within the bound, but the way between them is not.
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

/// Return whether the shorter way between two orientations leads past an angle of pi from `home`.
fn passes_pi(home: &UnitQuaternion<f64>, from: &UnitQuaternion<f64>, to: &UnitQuaternion<f64>) -> bool {
    // Choose the sign of q on the side of home. Orientations within a bound lie on one half of the sphere,
    // which is convex.
    let near_home = |of: &UnitQuaternion<f64>| {
        let turn = (of * home.inverse()).into_inner();
        if turn.w < 0.0 { -turn } else { turn }
    };
    near_home(from).dot(&near_home(to)) < 0.0
}

/// Limit the position `wanted`, `elapsed_s` after the command `last`: to the speed in m/s, and to the reach
/// in m from `home`. Returns the command and the masks of both bounds.
#[inline(always)] // once per tick, from few callers
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

/// Return the extrapolation in s per unit of velocity, and the remaining share of the velocity, `late_ns`
/// into a decay of `decay_ns`.
///
/// `d(t) = t - t² / (2 T)`, `v(t) / v = 1 - t / T` for t < T; then `T / 2` and 0.
///
/// At constant velocity, an arm at 1 m/s would continue for 0.2 m until a watchdog of 200 ms. Here it
/// continues for at most `v T / 2`, 7.5 mm at 15 ms, and stands still when HOLD begins.
pub(crate) fn decayed(late_ns: u64, decay_ns: u64) -> (f64, f64) {
    let (t, whole) = (late_ns.min(decay_ns) as f64 * 1e-9, decay_ns as f64 * 1e-9);
    if whole == 0.0 {
        return (0.0, 0.0);
    }
    if late_ns == 0 {
        // Bit-identical to the formula.
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
        fn command_is_within_both_bounds(
            (wanted, last) in (prop::array::uniform3(-9.0..9.0f64), prop::array::uniform3(-0.5..0.5f64)),
            (speed, reach) in (0.1..5.0f64, 1.0..3.0f64),
        ) {
            let (home, last, wanted) = (Axes::<3>::zeros(), Axes::from(last), Axes::from(wanted));
            let (command, limited) = bounded([speed, reach], 1e-3, &home, &last, &wanted);
            prop_assert!((command - last).norm() <= speed * 1e-3 * (1.0 + 1e-9));
            // A step from within a ball towards a point of the ball stays in the ball.
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
            // Rounding of an angle from the inverse cosine or sine of a quaternion: 1e-8 at 0.
            prop_assert!(command.angle_to(&last) <= speed * 1e-3 + 3e-8);
            prop_assert!(command.angle_to(&home) <= turn + 3e-8);
            prop_assert_eq!(limited.any(), command != wanted);
            prop_assert!((command.norm() - 1.0).abs() < 1e-15);
        }
    }

    #[test]
    fn invalid_bounds_are_refused() {
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
    fn decay_begins_at_full_velocity_and_ends_at_rest() {
        const MS: u64 = 1_000_000;
        assert_eq!(decayed(0, 15 * MS), (0.0, 1.0));
        for late in [15 * MS, 16 * MS, u64::MAX] {
            let (distance, share) = decayed(late, 15 * MS);
            assert!((distance - 7.5e-3).abs() < 1e-17 && share == 0.0);
        }
        assert_eq!(decayed(5 * MS, 0), (0.0, 0.0));
        // The distance is the integral of the velocity; trapezoids are exact for a straight line.
        let mut distance = 0.0;
        for tick in 0..15 {
            let [(_, before), (_, after)] = [tick, tick + 1].map(|tick| decayed(tick * MS, 15 * MS));
            distance += 0.5 * (before + after) * 1e-3;
            assert!((decayed((tick + 1) * MS, 15 * MS).0 - distance).abs() < 1e-16);
        }
    }
}
