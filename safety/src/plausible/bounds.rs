//! Bounds on the samples of a device, and the speed beyond them.

use std::fmt;

use crate::{Axes, Fault, ParameterError, Real, Signal};
use haptether_numeric::no_lanes;

/// Bounds on the samples of a device.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SampleBounds {
    /// Speed bound of the device in m/s (rad/s).
    pub speed: f64,
    /// dV: largest change of velocity in m/s (rad/s) from one sample to the next. A sample may deviate by dV times the
    /// period from the path, the position extrapolated at constant velocity. At 1 kHz, 0.5 m/s allows 0.5 mm.
    pub velocity_change: f64,
    /// Resolution of the position in m (rad).
    pub quantum: f64,
    /// If true, each axis must meet the bounds separately, as for joints; else the norm must.
    pub per_axis: bool,
}

impl SampleBounds {
    /// Bounds of a point: 20 m/s, and 0.5 mm off its path at 1 kHz.
    ///
    /// The speed is twice that of known motions: a hand throws at 10 m/s at most, and a motor of 8.5 N on 75 g reaches
    /// 9.3 m/s over its workspace.
    pub const LINEAR: Self = Self { speed: 20.0, velocity_change: 0.5, quantum: 0.0, per_axis: false };

    /// Bounds of joints: 60 rad/s. A point at a lever of 0.1 m, a short link, may change its velocity as in
    /// [`LINEAR`](Self::LINEAR).
    pub const JOINTS: Self = Self {
        speed: 60.0,
        velocity_change: Self::LINEAR.velocity_change / 0.1,
        quantum: 0.0,
        per_axis: true,
    };

    /// No bounds: every sample is valid.
    pub const UNBOUNDED: Self =
        Self { speed: f64::INFINITY, velocity_change: f64::INFINITY, quantum: 0.0, per_axis: false };

    /// Default bounds for a number of axes: joints from four axes on, else a point.
    pub const fn of_axes(axes: usize) -> Self {
        if axes <= 3 { Self::LINEAR } else { Self::JOINTS }
    }

    /// Check that speed and velocity change are above 0, and the quantum finite and 0 or more. NaN is refused.
    pub fn checked(self) -> Result<Self, ParameterError> {
        let refused = |name, symbol, seen: f64, accepted: bool, allowed| {
            if accepted { Ok(()) } else { Err(ParameterError { name, symbol, seen, allowed }) }
        };
        let Self { speed, velocity_change, quantum, .. } = self;
        refused("speed_bound", "V_max", speed, speed > 0.0, "above 0")?;
        refused("velocity_change", "dV", velocity_change, velocity_change > 0.0, "above 0")?;
        refused("quantum", "q", quantum, quantum >= 0.0 && quantum.is_finite(), "finite and 0 or more")?;
        Ok(self)
    }

    /// Bounds of the rotation of a handle that the hand holds at lever r in m.
    ///
    /// A point at distance r from the axis may deviate from its path as far as `self` allows. The speed bound is that
    /// of [`JOINTS`](Self::JOINTS).
    #[must_use]
    pub fn at_lever(self, lever_m: f64) -> Self {
        Self {
            speed: Self::JOINTS.speed,
            velocity_change: self.velocity_change / lever_m,
            quantum: self.quantum / lever_m,
            per_axis: false,
        }
    }

    /// Bounds of a device whose motors alone may change its velocity by more than dV in a period.
    ///
    /// A release under the force `F_max` changes V by `F_max dT / m`. That motion is true: held samples would delay
    /// the controllers. `dV = min(max(dV, 1.1 F_max dT / m), V_max)`; the tenth is for rounding and friction.
    pub(crate) fn with_acceleration(self, acceleration: f64, period_s: f64) -> Self {
        let own = 1.1 * acceleration * period_s;
        // Without a limit on the force nothing is known of the acceleration.
        if own > self.velocity_change && own.is_finite() {
            return Self { velocity_change: own.min(self.speed.max(self.velocity_change)), ..self };
        }
        self
    }

    /// Convert the bounds to units per tick of `period_s`.
    pub(super) fn per_tick(self, period_s: f64) -> PerTick {
        let Self { speed, velocity_change, quantum, per_axis } = self;
        PerTick { period_s, speed: speed * period_s, change: velocity_change * period_s, quantum, per_axis }
    }
}

/// [`SampleBounds`] in m (rad) per tick.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct PerTick {
    period_s: f64,
    pub(super) speed: f64,
    pub(super) change: f64,
    pub(super) quantum: f64,
    pub(super) per_axis: bool,
}

impl PerTick {
    /// Test a velocity in m/s: its speed is within the bound, and it differs from the one before by at most `share` of dV.
    #[inline(always)]
    pub(super) fn is_steady<const N: usize, S: Real>(
        &self,
        from: &Axes<N, S>,
        to: &Axes<N, S>,
        share: S,
    ) -> S::SimdBool {
        let [period_s, speed, change] = [self.period_s, self.speed, self.change].map(S::splat);
        is_short(&((to - from) * period_s), change * share, self.per_axis)
            & is_short(&(to * period_s), speed, self.per_axis)
    }
}

/// Return the mask of vectors within a limit: by their norm, or by each component if `per_axis` is true.
#[inline(always)]
pub(super) fn is_short<const N: usize, S: Real>(
    vector: &Axes<N, S>,
    limit: S,
    per_axis: bool,
) -> S::SimdBool {
    if N == 1 || per_axis {
        return vector.iter().fold(!no_lanes::<S>(), |all, x| all & x.magnitude().simd_le(limit));
    }
    vector.dot(vector).simd_le(limit * limit)
}

/// Speed beyond the bound of the device.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Excess {
    /// Signal that exceeds the bound.
    pub signal: Signal,
    /// Seen speed in m/s (rad/s).
    pub seen: f64,
    /// Bound in m/s (rad/s).
    pub bound: f64,
    /// True if both are in rad/s.
    pub is_angular: bool,
}

impl Excess {
    /// Return the fault.
    pub fn fault(&self) -> Fault {
        Fault::TooFast(self.signal)
    }
}

impl fmt::Display for Excess {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { signal, seen, bound, is_angular } = self;
        let what = if signal.is_velocity() { "is" } else { "stepped at" };
        let unit = if *is_angular { "rad/s" } else { "m/s" };
        write!(
            f,
            "{} {what} {seen:.3} {unit}: must be at most {bound} {unit}, its speed_bound; check sensor and cable",
            signal.name()
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A PHANTOM Premium at 1 kHz and 200 Hz, a device with little mass, one without a limit on its force.
    #[test]
    fn own_acceleration_widens_the_bounds_up_to_the_speed_bound() {
        let bounds = SampleBounds { speed: 16.0, quantum: 1e-5, ..SampleBounds::LINEAR };
        for (acceleration, period_s, change) in [
            (8.5 / 0.075, 1e-3, 0.5),
            (8.5 / 0.075, 5e-3, 1.1 * 8.5 / 0.075 * 5e-3),
            (8.0 / 1e-3, 5e-3, 16.0),
            (f64::INFINITY, 1e-3, 0.5),
        ] {
            let widened = bounds.with_acceleration(acceleration, period_s);
            assert_eq!(widened, SampleBounds { velocity_change: change, ..bounds });
        }
        assert_eq!(SampleBounds::UNBOUNDED.with_acceleration(1e9, 1e-3), SampleBounds::UNBOUNDED);
    }
}
