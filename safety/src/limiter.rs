//! Last limits before the device: norm, slew, power and ramp-in.

use nalgebra::SimdBool as _;

use crate::{
    Axes, ParameterError, Real,
    parameter::{in_range, positive},
};
use haptether_numeric::{choose, choose_axes, no_lanes, norm, pack};

/// Limits of the force that a device is commanded to exert.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Deserialize, schemars::JsonSchema), serde(deny_unknown_fields))]
pub struct LimiterSettings {
    /// Largest `|F|` in N.
    pub max_force_n: f64,
    /// Largest growth of the force in N/s. Unloading is not limited: the force may drop towards zero at once.
    pub max_slew_n_per_s: f64,
    /// Largest power F·V in W from the device into the hand.
    pub max_power_w: f64,
    /// Time in s over which the force rises from zero after a reset.
    pub ramp_in_s: f64,
}

impl LimiterSettings {
    /// Convert the limits to a rotation whose handle is held at lever r in m.
    ///
    /// Torque is r F; power and time stay.
    #[must_use]
    pub fn at_lever(self, lever_m: f64) -> Self {
        Self {
            max_force_n: self.max_force_n * lever_m,
            max_slew_n_per_s: self.max_slew_n_per_s * lever_m,
            ..self
        }
    }
}

impl Default for LimiterSettings {
    /// Return 7.9 N of a PHANTOM Desktop, 1000 N/s, 20 W and 0.2 s.
    ///
    /// After the ramp-in of 0.2 s the force can rise from zero to 7.9 N in 8 ms. The unprotected ejection in the
    /// paper reaches 11 W (7.8 N at 1.4 m/s), so the power limit acts on faults only.
    fn default() -> Self {
        Self { max_force_n: 7.9, max_slew_n_per_s: 1000.0, max_power_w: 20.0, ramp_in_s: 0.2 }
    }
}

/// Set of limits that acted at a tick.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ActiveLimits(u8);

impl ActiveLimits {
    /// The norm was clipped.
    pub const NORM: Self = Self(1);
    /// The growth was limited.
    pub const SLEW: Self = Self(2);
    /// The power was limited.
    pub const POWER: Self = Self(4);
    /// The force is still rising from zero.
    pub const RAMP: Self = Self(8);

    /// A value was not finite; the force is zero.
    pub const FAULT: Self = Self(16);

    /// Return whether all of `other` is set.
    pub fn contains(self, other: Self) -> bool {
        self.0 & other.0 == other.0
    }

    /// Return the union.
    pub(crate) fn and(self, other: Self) -> Self {
        Self(self.0 | other.0)
    }

    /// Return the bits for records: norm 1, slew 2, power 4, ramp 8, fault 16.
    pub fn bits(self) -> u8 {
        self.0
    }
}

/// Limited force and the limits that acted.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Limited<const N: usize> {
    /// The force in N.
    pub force: Axes<N>,
    /// The limits that acted.
    pub acted: ActiveLimits,
}

/// Limited force and the mask of each limit.
#[derive(Clone, Copy, Debug)]
pub struct SaturatedForce<const N: usize, S: Real = f64> {
    /// The force in N.
    pub force: Axes<N, S>,
    /// Lanes in which the norm was clipped.
    pub norm: S::SimdBool,
    /// Lanes in which the growth was limited.
    pub slew: S::SimdBool,
    /// Lanes in which the power was limited.
    pub power: S::SimdBool,
    /// Lanes in which the force is still rising from zero.
    pub ramp: S::SimdBool,
    /// Lanes in which a value was not finite; the force is zero.
    pub fault: S::SimdBool,
}

impl<const N: usize, S: Real> SaturatedForce<N, S> {
    /// Return the limits that acted in one lane.
    #[inline(always)]
    pub fn acted(&self, lane: usize) -> ActiveLimits {
        let bit = |mask: S::SimdBool, bound: ActiveLimits| {
            if mask.bitmask() >> lane & 1 == 1 { bound.0 } else { 0 }
        };
        ActiveLimits(
            bit(self.norm, ActiveLimits::NORM)
                | bit(self.slew, ActiveLimits::SLEW)
                | bit(self.power, ActiveLimits::POWER)
                | bit(self.ramp, ActiveLimits::RAMP)
                | bit(self.fault, ActiveLimits::FAULT),
        )
    }
}

/// Limiter of the device force as a vector. No axis is clipped on its own, since that would rotate the force.
///
/// The steps, in this order:
///
/// 1. The ramp-in scales the force.
/// 2. The norm is clipped to `max_force_n`.
/// 3. The growth from the last force is limited to `max_slew dT`; the part of the change that only unloads is free.
/// 4. The component along V is reduced so that `F·V <= max_power`.
///
/// The limits on norm and power therefore hold at every tick. Step 4 comes last and may change the force by more than
/// step 3 allows.
#[derive(Clone, Debug, PartialEq)]
pub struct Limiter<const N: usize, S = f64> {
    max_force_n: S,
    max_power_w: S,
    step_n: S,
    ramp_ticks: S,
    /// Elapsed ticks of the ramp, per lane: a lane with an invalid value does not advance.
    ticks: S,
    last: Axes<N, S>,
}

impl<const N: usize> Limiter<N> {
    /// Create a limiter for a loop of period `period_s`.
    pub fn new(period_s: f64, settings: LimiterSettings) -> Result<Self, ParameterError> {
        let period_s = positive("period_s", "dT", period_s)?;
        let max_force_n = positive("max_force_n", "F_max", settings.max_force_n)?;
        let slew = positive("max_slew_n_per_s", "dF/dt", settings.max_slew_n_per_s)?;
        let max_power_w = positive("max_power_w", "P_max", settings.max_power_w)?;
        let ramp = in_range("ramp_in_s", "time", settings.ramp_in_s, 0.0, 60.0, "between 0 and 60 s")?;
        Ok(Self {
            max_force_n,
            max_power_w,
            step_n: slew * period_s,
            ramp_ticks: (ramp / period_s).round(),
            ticks: 0.0,
            last: Axes::zeros(),
        })
    }

    /// Limit the requested force at this tick, with V in m/s.
    #[inline(always)]
    pub fn step(&mut self, requested_force: &Axes<N>, velocity: &Axes<N>) -> Limited<N> {
        let saturated = self.limit(requested_force, velocity);
        Limited { force: saturated.force, acted: saturated.acted(0) }
    }
}

/// Change a force in the lanes of a mask, which is empty in most ticks.
macro_rules! change {
    ($S:ty, $force:ident, $place:expr, $changed:expr) => {
        if $place.any() {
            rare_branch();
            $force = choose_axes!($S, $place, $changed, $force);
        }
    };
}

impl<const N: usize, S: Real> Limiter<N, S> {
    /// Gather one limiter per lane; return None if there are more limiters than lanes.
    pub fn gather(of: &[&Limiter<N>]) -> Option<Self> {
        Some(Self {
            max_force_n: pack(of, |one| one.max_force_n)?,
            max_power_w: pack(of, |one| one.max_power_w)?,
            step_n: pack(of, |one| one.step_n)?,
            ramp_ticks: pack(of, |one| one.ramp_ticks)?,
            ticks: pack(of, |one| one.ticks)?,
            last: pack(of, |one| one.last)?,
        })
    }

    /// Scale a force by `gain` (0 to 1). If `gain` < 1, first clip its norm to `max_force_n`.
    ///
    /// Without the clip, a larger request would reach `max_force_n` before the fade has ended.
    #[inline(always)]
    pub(crate) fn faded(&self, requested_force: &Axes<N, S>, gain: f64) -> Axes<N, S> {
        let mut force = *requested_force;
        if gain < 1.0 {
            let length = norm(&force);
            let long = length.simd_gt(self.max_force_n);
            change!(S, force, long, force * (self.max_force_n / length));
        }
        force * S::splat(gain)
    }

    /// Limit the requested force in each lane at this tick, with V in m/s.
    #[inline(always)]
    pub fn limit(&mut self, requested_force: &Axes<N, S>, velocity: &Axes<N, S>) -> SaturatedForce<N, S> {
        // Copy the arguments: passed by address, they and the caller's values next to them would be stored
        // to memory every tick, even when this call is inlined.
        let (mut force, velocity) = (*requested_force, *velocity);
        let Self { max_force_n, max_power_w, step_n: most_growth, ramp_ticks, ticks, .. } = *self;
        // A comparison with NaN is false, so the limits below would let a NaN pass.
        let mut is_finite = !no_lanes::<S>();
        for axis in 0..N {
            for number in [force[axis], velocity[axis]] {
                is_finite = is_finite & number.magnitude().simd_lt(S::splat(f64::INFINITY));
            }
        }
        let ramp = is_finite & ticks.simd_lt(ramp_ticks);
        change!(S, force, ramp, force * (ticks / ramp_ticks));
        self.ticks = (ticks + S::splat(1.0)).select(ramp, ticks);
        if S::LANES == 1 && is_finite.all() && is_none(&force) {
            // A zero force meets every limit.
            let no = no_lanes::<S>();
            self.last = force;
            return SaturatedForce { force, norm: no, slew: no, power: no, ramp, fault: no };
        }
        let length = norm(&force);
        let long = is_finite & length.simd_gt(max_force_n);
        change!(S, force, long, force * (max_force_n / length));
        // Point between zero and the last force that is nearest to the request; reducing the last force to
        // it is pure unloading.
        let unloaded = self.last * nearest_share(&self.last, &force);
        let growth = force - unloaded;
        let step_n = norm(&growth);
        let slew = is_finite & step_n.simd_gt(most_growth);
        change!(S, force, slew, unloaded + growth * (most_growth / step_n));
        let watts = force.dot(&velocity);
        let power = is_finite & watts.simd_gt(max_power_w);
        change!(S, force, power, force - velocity * ((watts - max_power_w) / velocity.dot(&velocity)));
        self.last = choose_axes!(S, is_finite, force, Axes::zeros());
        SaturatedForce { force: self.last, norm: long, slew, power, ramp, fault: !is_finite }
    }

    /// Express the force of the last tick in other axes.
    pub(crate) fn turn(&mut self, turned: impl FnOnce(&Axes<N, S>) -> Axes<N, S>) {
        self.last = turned(&self.last);
    }

    /// Set the force to zero and restart the ramp.
    pub fn reset(&mut self) {
        (self.last, self.ticks) = (Axes::zeros(), S::splat(0.0));
    }
}

/// Return whether a force is zero in all lanes.
#[inline(always)]
fn is_none<const N: usize, S: Real>(force: &Axes<N, S>) -> bool {
    force.iter().all(|force| force.simd_eq(S::splat(0.0)).all())
}

/// Mark a rare branch, so that the compiler does not compute its division and root at every tick.
#[cold]
fn rare_branch() {}

/// Return the share s in [0, 1] for which `s last` is nearest to `force`.
#[inline(always)]
fn nearest_share<const N: usize, S: Real>(last: &Axes<N, S>, force: &Axes<N, S>) -> S {
    let (none, all) = (S::splat(0.0), S::splat(1.0));
    let squared = last.dot(last);
    // With one scenario, most ticks need no division.
    if S::LANES == 1 && (last.dot(force).simd_ge(squared) & squared.simd_gt(none)).all() {
        return all;
    }
    choose!(
        S,
        squared.simd_gt(none),
        {
            let share = last.dot(force) / squared;
            // Not simd_clamp: over lanes it turns NaN into a number.
            none.select(share.simd_lt(none), all.select(share.simd_gt(all), share))
        },
        none
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const OPEN: LimiterSettings =
        LimiterSettings { max_force_n: 1e3, max_slew_n_per_s: 1e9, max_power_w: 1e9, ramp_in_s: 0.0 };

    #[test]
    fn bounds_are_distinct() {
        let bounds = [
            ActiveLimits::NORM,
            ActiveLimits::SLEW,
            ActiveLimits::POWER,
            ActiveLimits::RAMP,
            ActiveLimits::FAULT,
        ];
        for (place, one) in bounds.into_iter().enumerate() {
            assert_eq!(one.bits(), 1 << place);
            assert!(one.contains(ActiveLimits::default()) && !ActiveLimits::default().contains(one));
            for other in bounds {
                let both = one.and(other);
                assert_eq!(both.bits(), one.bits() | other.bits());
                assert!(both.contains(one) && both.contains(other) && both.contains(both));
                assert_eq!((one.contains(other), one.contains(both)), (one == other, one == other));
            }
        }
    }

    #[test]
    fn each_lane_has_its_own_bounds() {
        use nalgebra::SimdValue as _;
        use simba::simd::{AutoBoolx4, AutoF64x4};
        let only = |lane: usize| {
            let mut mask = AutoBoolx4::splat(false);
            mask.replace(lane, true);
            mask
        };
        let force = Axes::<1, AutoF64x4>::new(AutoF64x4::splat(0.0));
        let saturated = SaturatedForce {
            force,
            norm: only(0),
            slew: only(1),
            power: only(2),
            ramp: only(3),
            fault: only(3),
        };
        let acted = [
            ActiveLimits::NORM,
            ActiveLimits::SLEW,
            ActiveLimits::POWER,
            ActiveLimits::RAMP.and(ActiveLimits::FAULT),
        ];
        for (lane, acted) in acted.into_iter().enumerate() {
            assert_eq!(saturated.acted(lane), acted);
        }
    }

    #[test]
    fn the_ramp_is_a_line_from_zero() {
        let settings = LimiterSettings { ramp_in_s: 8e-3, ..OPEN };
        let mut limiter = Limiter::<2>::new(1e-3, settings).unwrap();
        let requested = Axes::<2>::new(3.0, -4.0);
        for tick in 0..20_u8 {
            let Limited { force, acted } = limiter.step(&requested, &Axes::zeros());
            // Multiples of 1/8 are exact.
            assert_eq!(force, requested * (f64::from(tick.min(8)) / 8.0));
            assert_eq!(acted.contains(ActiveLimits::RAMP), tick < 8);
        }
        limiter.reset();
        assert_eq!(limiter.step(&requested, &Axes::zeros()).force, Axes::<2>::zeros());
        assert_eq!(limiter.step(&requested, &Axes::zeros()).force, requested / 8.0);
    }

    #[test]
    fn non_finite_input_gives_no_force() {
        for bad in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
            for places in 1_u8..64 {
                let mut values = [0.5; 6];
                for (place, value) in values.iter_mut().enumerate() {
                    if places >> place & 1 == 1 {
                        *value = bad;
                    }
                }
                let mut limiter = Limiter::<3>::new(1e-3, OPEN).unwrap();
                let seen = limiter
                    .step(&Axes::from_column_slice(&values[..3]), &Axes::from_column_slice(&values[3..]));
                assert_eq!((seen.force, seen.acted), (Axes::<3>::zeros(), ActiveLimits::FAULT), "{values:?}");
            }
        }
    }

    #[test]
    fn each_bound_reports_itself() {
        let still = Axes::<1>::zeros();
        let requested = Axes::<1>::new(10.0);
        for (settings, velocity, force, bound) in [
            (LimiterSettings { max_force_n: 4.0, ..OPEN }, still, 4.0, ActiveLimits::NORM),
            (LimiterSettings { max_slew_n_per_s: 500.0, ..OPEN }, still, 0.5, ActiveLimits::SLEW),
            (LimiterSettings { max_power_w: 3.0, ..OPEN }, Axes::<1>::new(2.0), 1.5, ActiveLimits::POWER),
            (LimiterSettings { ramp_in_s: 0.01, ..OPEN }, still, 0.0, ActiveLimits::RAMP),
            (OPEN, still, 10.0, ActiveLimits(0)),
        ] {
            let limited = Limiter::new(1e-3, settings).unwrap().step(&requested, &velocity);
            assert!((limited.force[0] - force).abs() < 1e-12, "{settings:?}");
            assert_eq!(limited.acted, bound, "{settings:?}");
        }
    }

    #[test]
    fn non_finite_input_after_a_force_gives_no_force() {
        let mut limiter = Limiter::<2>::new(1e-3, OPEN).unwrap();
        limiter.step(&Axes::<2>::new(1.0, 1.0), &Axes::zeros());
        for (force, speed) in [(f64::NAN, 0.0), (f64::INFINITY, 0.0), (1.0, f64::NAN)] {
            let limited = limiter.step(&Axes::<2>::new(0.0, force), &Axes::<2>::new(speed, 0.0));
            assert_eq!(limited, Limited { force: Axes::zeros(), acted: ActiveLimits::FAULT });
        }
    }

    #[test]
    fn unloading_is_free_and_reversal_is_not() {
        let settings = LimiterSettings { max_slew_n_per_s: 1000.0, ..OPEN };
        let mut limiter = Limiter::<1>::new(1e-3, settings).unwrap();
        let still = Axes::zeros();
        for _ in 0..8 {
            limiter.step(&Axes::<1>::new(8.0), &still);
        }
        assert!((limiter.step(&Axes::<1>::new(8.0), &still).force[0] - 8.0).abs() < 1e-12);
        assert!((limiter.step(&Axes::<1>::new(0.5), &still).force[0] - 0.5).abs() < 1e-12);
        assert!((limiter.step(&Axes::<1>::new(-8.0), &still).force[0] + 1.0).abs() < 1e-12);
    }

    proptest! {
        #[test]
        fn cap_and_power_hold_at_every_tick(
            ticks in prop::collection::vec(
                (prop::array::uniform3(-50.0..50.0f64), prop::array::uniform3(-5.0..5.0f64)), 1..60),
        ) {
            let settings = LimiterSettings {
                max_force_n: 7.9, max_slew_n_per_s: 1000.0, max_power_w: 5.0, ramp_in_s: 0.01,
            };
            let mut limiter = Limiter::<3>::new(1e-3, settings).unwrap();
            let mut last = Axes::<3>::zeros();
            for (requested, velocity) in ticks {
                let (requested, velocity) = (Axes::from(requested), Axes::from(velocity));
                let Limited { force, acted } = limiter.step(&requested, &velocity);
                prop_assert!(force.norm() <= 7.9 * (1.0 + 1e-12));
                prop_assert!(force.dot(&velocity) <= 5.0 + 1e-9);
                if !acted.contains(ActiveLimits::POWER) {
                    prop_assert!(force.norm() <= last.norm() + 1.0 + 1e-9);
                }
                last = force;
            }
        }

        /// The scalar shortcuts change no bit; the lanes compute every step.
        #[test]
        fn scalar_shortcuts_change_no_bit(
            ticks in prop::collection::vec((0..7usize, prop::array::uniform2(-9.0..9.0f64), -5.0..5.0f64), 1..80),
        ) {
            use nalgebra::SimdValue as _;
            use simba::simd::AutoF64x4;
            let settings = LimiterSettings { max_power_w: 5.0, ramp_in_s: 0.005, ..LimiterSettings::default() };
            let mut one = Limiter::<2>::new(1e-3, settings).unwrap();
            let mut lanes = Limiter::<2, AutoF64x4>::gather(&[&one; 4]).unwrap();
            let mut last = Axes::<2>::zeros();
            for (kind, force, speed) in ticks {
                let force = Axes::<2>::from(force);
                let requested = [
                    Axes::zeros(), -Axes::<2>::zeros(), force, last, last * 2.0, -last, Axes::repeat(f64::NAN),
                ][kind];
                let velocity = Axes::<2>::new(speed, if kind == 1 { f64::INFINITY } else { 0.0 });
                let saturated = one.limit(&requested, &velocity);
                let beside = lanes.limit(&requested.map(AutoF64x4::splat), &velocity.map(AutoF64x4::splat));
                for axis in 0..2 {
                    let (alone, lane) = (saturated.force[axis], beside.force[axis].extract(0));
                    prop_assert_eq!(alone.to_bits(), lane.to_bits(), "{} {}", alone, lane);
                }
                prop_assert_eq!(saturated.acted(0), beside.acted(0));
                prop_assert_eq!(one.ticks, lanes.ticks.extract(0));
                last = saturated.force;
            }
        }

        /// Limiting a rotated force gives the rotated limited force: the limiter does not depend on axes.
        #[test]
        fn rotates_with_the_frame(
            requested in prop::array::uniform2(-20.0..20.0f64),
            velocity in prop::array::uniform2(-3.0..3.0f64),
            angle in 0.0..6.3f64,
        ) {
            let rotation = nalgebra::Rotation2::new(angle);
            let settings = LimiterSettings { max_power_w: 2.0, ramp_in_s: 0.0, ..LimiterSettings::default() };
            let mut straight = Limiter::<2>::new(1e-3, settings).unwrap();
            let mut turned = straight.clone();
            let (requested, velocity) = (Axes::from(requested), Axes::from(velocity));
            for _ in 0..12 {
                let a = straight.step(&requested, &velocity).force;
                let b = turned.step(&(rotation * requested), &(rotation * velocity)).force;
                prop_assert!((rotation * a - b).norm() < 1e-9);
            }
        }
    }
}
