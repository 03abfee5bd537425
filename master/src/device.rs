//! A haptic device: mechanics, encoder and motors.

use haptether_numeric::{is_finite, norm, selected};
use nalgebra::SimdBool as _;

use crate::{Axes, ModelError, Real, require};

/// Friction over several axes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(
    feature = "serde",
    derive(serde::Deserialize, schemars::JsonSchema),
    serde(rename_all = "kebab-case")
)]
pub enum Friction {
    /// `c V / |V|`, in any frame: a stylus in space.
    #[default]
    Vector,
    /// `c sign(V)` on each axis: joints.
    Axis,
}

/// Mechanics, encoder and motors of a device.
///
/// Source: paper Eq. 3.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Deserialize, schemars::JsonSchema))] // the table rejects unknown keys
pub struct DeviceParameters<const N: usize> {
    /// m in kg (> 0).
    #[cfg_attr(feature = "serde", schemars(with = "Vec<f64>"))]
    pub mass_kg: Axes<N>,
    /// b in N s/m; may be negative.
    #[cfg_attr(feature = "serde", schemars(with = "Vec<f64>"))]
    pub viscous: Axes<N>,
    /// c in N (>= 0): friction while moving, and the largest force that friction withstands at rest. All axes
    /// have the same value with [`Friction::Vector`].
    #[cfg_attr(feature = "serde", schemars(with = "Vec<f64>"))]
    pub coulomb: Axes<N>,
    /// Friction over several axes.
    pub friction: Friction,
    /// Resolution of the position measurement in m (>= 0); 0 is exact.
    pub encoder_quantum: f64,
    /// True if the device measures V itself, exactly.
    pub measures_velocity: bool,
    /// Positions in m of the mechanical stops, which absorb all speed; infinite without stops.
    #[cfg_attr(
        feature = "serde",
        serde(deserialize_with = "stops"),
        schemars(with = "Option<Vec<(f64, f64)>>")
    )]
    pub stops: (Axes<N>, Axes<N>),
    /// Largest `|F|` in N that the motors exert; infinite without a bound.
    #[cfg_attr(feature = "serde", serde(deserialize_with = "infinite_or"), schemars(with = "Option<f64>"))]
    pub max_force_n: f64,
    /// Resolution of the force in N, per axis (>= 0); 0 is exact.
    pub force_quantum_n: f64,
}

impl<const N: usize> DeviceParameters<N> {
    /// A device with the same m in kg, b in N s/m and c in N on each axis, exact measurement, no stops and no
    /// bounds.
    pub fn ideal(mass_kg: f64, viscous: f64, coulomb: f64) -> Self {
        Self {
            mass_kg: Axes::repeat(mass_kg),
            viscous: Axes::repeat(viscous),
            coulomb: Axes::repeat(coulomb),
            friction: Friction::Vector,
            encoder_quantum: 0.0,
            measures_velocity: true,
            stops: (Axes::repeat(f64::NEG_INFINITY), Axes::repeat(f64::INFINITY)),
            max_force_n: f64::INFINITY,
            force_quantum_n: 0.0,
        }
    }

    /// PHANTOM Desktop: m, b, c from the paper, section 4.1; 0.023 mm is the vendor's nominal resolution.
    ///
    /// Stops are left out: the paper throws the stylus over 0.14 m and plots no stop.
    pub fn phantom_desktop() -> Self {
        Self { encoder_quantum: 2.3e-5, measures_velocity: false, ..Self::ideal(0.157, -0.005, 0.038) }
    }

    /// Return an error if a parameter is invalid.
    pub fn check(&self) -> Result<(), ModelError> {
        for axis in 0..N {
            require("mass_kg", self.mass_kg[axis], self.mass_kg[axis] > 0.0, "finite and above 0")?;
            require("viscous", self.viscous[axis], true, "finite")?;
            require("coulomb", self.coulomb[axis], self.coulomb[axis] >= 0.0, "finite and 0 or more")?;
            if self.friction == Friction::Vector {
                let same = self.coulomb[axis] == self.coulomb[0];
                require("coulomb", self.coulomb[axis], same, "the same on each axis of vector friction")?;
            }
            // `require` would refuse infinite stops, which are valid.
            let (lower, upper) = (self.stops.0[axis], self.stops.1[axis]);
            if lower.is_nan() || upper.is_nan() || lower >= upper {
                return Err(ModelError { name: "lower stop", seen: lower, allowed: "below the upper stop" });
            }
        }
        require(
            "encoder_quantum",
            self.encoder_quantum,
            self.encoder_quantum >= 0.0,
            "finite and 0 or more",
        )?;
        require(
            "force_quantum_n",
            self.force_quantum_n,
            self.force_quantum_n >= 0.0,
            "finite and 0 or more",
        )?;
        if self.max_force_n > 0.0 {
            Ok(())
        } else {
            Err(ModelError { name: "max_force_n", seen: self.max_force_n, allowed: "above 0" })
        }
    }

    pub(crate) fn rubs_along_motion(&self) -> bool {
        N > 1 && self.friction == Friction::Vector && self.coulomb[0] > 0.0
    }
}

/// Read one pair of stops per axis; no value means infinite stops.
#[cfg(feature = "serde")]
fn stops<'de, D: serde::Deserializer<'de>, const N: usize>(
    deserializer: D,
) -> Result<(Axes<N>, Axes<N>), D::Error> {
    use serde::{Deserialize as _, de::Error as _};
    let Some(pairs) = Option::<Vec<(f64, f64)>>::deserialize(deserializer)? else {
        return Ok((Axes::repeat(f64::NEG_INFINITY), Axes::repeat(f64::INFINITY)));
    };
    if pairs.len() != N {
        let text = format!("master.stops: {} pairs, must have {N}, one per axis", pairs.len());
        return Err(D::Error::custom(text));
    }
    Ok((Axes::from_fn(|axis, _| pairs[axis].0), Axes::from_fn(|axis, _| pairs[axis].1)))
}

/// Read a bound; no value means infinite.
#[cfg(feature = "serde")]
fn infinite_or<'de, D: serde::Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    use serde::Deserialize as _;
    Ok(Option::deserialize(deserializer)?.unwrap_or(f64::INFINITY))
}

/// 2^52: every number from here on is whole.
const INTEGERS_FROM: f64 = 4_503_599_627_370_496.0;

/// Rounds to a multiple of `quantum`; 0 leaves the value unchanged.
#[inline(always)]
pub(crate) fn quantised<S: Real>(value: S, quantum: S, is_exact: bool) -> S {
    if is_exact {
        return value;
    }
    let count = value / quantum;
    // From 2^52 quanta on, a value is already whole or infinite.
    let has_parts = count.magnitude().simd_lt(S::splat(INTEGERS_FROM));
    let integer = if S::LANES == 1 { S::splat(nearest_integer(count.extract(0))) } else { count.rounded() };
    (integer * quantum).select(quantum.simd_gt(S::splat(0.0)) & has_parts, value)
}

/// The nearest whole number below 2^52 in absolute value, halves away from zero: [`f64::round`] without a
/// call.
#[inline(always)]
#[allow(clippy::cast_possible_truncation, clippy::cast_precision_loss)] // truncation is intended
fn nearest_integer(number: f64) -> f64 {
    // Exactly 0.5 would round 0.49999999999999994 up to 1.
    let shifted = number + (0.5_f64).next_down().copysign(number);
    (shifted as i64 as f64).copysign(number)
}

/// Rounds each axis, as [`quantised`].
#[inline(always)]
pub(crate) fn quantised_axes<const N: usize, S: Real>(
    value: &Axes<N, S>,
    quantum: S,
    is_exact: bool,
) -> Axes<N, S> {
    // A copy instead of a closure: a closure takes addresses, and the caller's values would then stay in
    // memory.
    let mut rounded = *value;
    for axis in 0..N {
        rounded[axis] = quantised(value[axis], quantum, is_exact);
    }
    rounded
}

/// Force that the motors exert for a command: zero unless it is finite, bounded as a vector, then rounded per
/// axis.
#[inline(always)]
pub(crate) fn exerted<const N: usize, S: Real>(
    command: &Axes<N, S>,
    max_force_n: S,
    quantum: S,
    is_exact: bool,
) -> Axes<N, S> {
    let commanded = selected(is_finite(command), *command, &Axes::zeros());
    let length = norm(&commanded);
    let is_within = length.simd_le(max_force_n);
    if is_exact && is_within.all() {
        return commanded;
    }
    // Avoid infinity / 0 for an infinite bound.
    let share = S::splat(1.0).select(is_within, max_force_n / length);
    quantised_axes(&(commanded * share), quantum, is_exact)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn quantum_below_rounding_has_no_effect() {
        for quantum in [5e-324, 1e-300, 1e-18] {
            for value in [0.0, -0.3, 7.9, 1e9] {
                assert_eq!(quantised(value, quantum, false), value);
            }
        }
        assert_eq!(quantised(0.26, 0.5, false), 0.5);
    }

    proptest! {
        #[test]
        fn rounding_matches_the_library(
            number in prop_oneof![
                -4e15..4e15f64,
                -10.0..10.0f64,
                (-1_000_000..1_000_000i32, -2..=2i32).prop_map(|(halves, ulps)| {
                    let half = f64::from(halves) / 2.0;
                    (0..ulps.abs()).fold(half, |at, _| if ulps > 0 { at.next_up() } else { at.next_down() })
                }),
                Just(-0.0),
                Just(5e-324),
                Just(INTEGERS_FROM.next_down()),
                Just(-INTEGERS_FROM.next_down()),
            ],
        ) {
            prop_assert_eq!(nearest_integer(number).to_bits(), number.round().to_bits(), "{}", number);
        }
    }

    #[test]
    fn motors_bound_the_vector_and_round_each_axis() {
        let commanded = Axes::<2>::new(6.0, 8.0);
        assert!((exerted(&commanded, 5.0, 0.0, true) - Axes::<2>::new(3.0, 4.0)).norm() < 1e-15);
        assert_eq!(exerted(&commanded, f64::INFINITY, 0.0, true), commanded);
        assert!((exerted(&commanded, 5.0, 0.7, false) - Axes::<2>::new(2.8, 4.2)).norm() < 1e-15);
        assert_eq!(exerted(&Axes::<1>::zeros(), 5.0, 0.0, true)[0], 0.0);
    }

    #[test]
    fn rejects_invalid_device() {
        let good = DeviceParameters::<3>::phantom_desktop();
        assert!(good.check().is_ok());
        let bad = [
            DeviceParameters { mass_kg: Axes::<3>::new(0.1, 0.0, 0.1), ..good },
            DeviceParameters { coulomb: Axes::<3>::new(0.1, 0.2, 0.1), ..good },
            DeviceParameters { viscous: Axes::<3>::new(0.1, f64::NAN, 0.1), ..good },
            DeviceParameters { encoder_quantum: -1.0, ..good },
            DeviceParameters { force_quantum_n: f64::INFINITY, ..good },
            DeviceParameters { max_force_n: 0.0, ..good },
            DeviceParameters { stops: (Axes::repeat(0.1), Axes::repeat(0.1)), ..good },
        ];
        for device in bad {
            assert!(device.check().is_err(), "{device:?}");
        }
        let joints =
            DeviceParameters { friction: Friction::Axis, coulomb: Axes::<3>::new(0.1, 0.2, 0.3), ..good };
        assert!(joints.check().is_ok());
    }
}
