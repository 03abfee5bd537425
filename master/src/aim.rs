//! One aim of a hand: where it wants to be, and how it holds the device.

use crate::{Axes, ModelError, require};

/// Where the hand wants to be, and how it holds the device.
///
/// The target moves linearly from its present position to `target` within `over_s`.
/// `F_h = K_h (target - x) - B_h V`, its norm clipped to the grip strength.
///
/// Source: Hogan 1989 (impedance).
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Deserialize, schemars::JsonSchema))] // the table rejects unknown keys
pub struct Aim<const N: usize> {
    /// Position in m at the end of the leg, within 2 m of the origin.
    #[cfg_attr(feature = "serde", schemars(with = "Vec<f64>"))]
    pub target: Axes<N>,
    /// Duration of the leg in s (0.001 to 0.4).
    pub over_s: f64,
    /// `K_h` in N/m (0 to 2000).
    pub stiffness: f64,
    /// `B_h` in N s/m (0 to 50).
    pub damping: f64,
    /// Grip strength in N (0 to 50); 0 opens the hand.
    pub strength_n: f64,
}

impl<const N: usize> Aim<N> {
    /// Time in s after an aim at which the hand opens unless another aim follows.
    pub const EXPIRES_S: f64 = 0.4;

    /// An aim that opens the hand.
    pub fn open() -> Self {
        Self { target: Axes::zeros(), over_s: 0.001, stiffness: 0.0, damping: 0.0, strength_n: 0.0 }
    }

    /// The same aim with another number of axes.
    pub fn with_target<const M: usize>(&self, target: Axes<M>) -> Aim<M> {
        let Self { over_s, stiffness, damping, strength_n, .. } = *self;
        Aim { target, over_s, stiffness, damping, strength_n }
    }

    /// Reject numbers that are not finite or out of range.
    ///
    /// # Errors
    ///
    /// Name, value and range of the first invalid number.
    pub fn check(&self) -> Result<(), ModelError> {
        let Self { target, over_s, stiffness, damping, strength_n } = *self;
        let within = |name, seen: f64, least: f64, most: f64, allowed| {
            require(name, seen, (least..=most).contains(&seen), allowed)
        };
        for x in &target {
            require("target", *x, true, "finite")?;
        }
        require("|target|", target.norm(), target.norm() <= 2.0, "at most 2 m")?;
        within("over_s", over_s, 0.001, 0.4, "0.001 to 0.4 s")?;
        within("stiffness", stiffness, 0.0, 2000.0, "0 to 2000 N/m")?;
        within("damping", damping, 0.0, 50.0, "0 to 50 N s/m")?;
        within("strength_n", strength_n, 0.0, 50.0, "0 to 50 N")
    }
}
