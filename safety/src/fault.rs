//! Named faults: what the checks on entry to the safety layer refuse.

use crate::lanes::{Axes, is_within};

/// A signal that enters the safety layer, with the largest magnitude that is not absurd.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Signal {
    /// Device position x.
    Position,
    /// Device velocity V.
    Velocity,
    /// Force requested by the remote side, `F_v`.
    RenderedForce,
    /// Estimated grasp force `F_h`.
    GraspForce,
    /// Force of the environment on the slave's tool, `F_e`.
    EnvironmentForce,
}

impl Signal {
    /// Largest magnitude per axis, in SI, that is taken for a measurement rather than for a broken source.
    ///
    /// Chosen two orders of magnitude above any desktop haptic device (0.5 m, 5 m/s, 40 N) and leader arm
    /// (6 rad, 30 rad/s), so that no true sample is refused.
    pub const fn bound(self) -> f64 {
        match self {
            Self::Position | Self::Velocity => 1e3,
            Self::RenderedForce | Self::GraspForce | Self::EnvironmentForce => 1e4,
        }
    }

    /// The signal's name in messages.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Position => "position",
            Self::Velocity => "velocity",
            Self::RenderedForce => "rendered force",
            Self::GraspForce => "grasp force",
            Self::EnvironmentForce => "environment force",
        }
    }

    const fn unit(self) -> &'static str {
        match self {
            Self::Position => "m",
            Self::Velocity => "m/s",
            Self::RenderedForce | Self::GraspForce | Self::EnvironmentForce => "N",
        }
    }

    /// Passes a value within its bound, or names the fault.
    #[inline]
    pub fn check<const N: usize>(self, value: &Axes<N>) -> Result<(), Fault> {
        if is_within(value, self.bound()) {
            return Ok(());
        }
        Err(if value.iter().all(|x| x.is_finite()) {
            Fault::OutOfRange(self)
        } else {
            Fault::NotFinite(self)
        })
    }
}

/// Why the safety layer renders no force.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Fault {
    /// A sample was NaN or infinite.
    #[error("{} is not a finite number", .0.name())]
    NotFinite(Signal),
    /// A sample was finite and absurd.
    #[error("{} exceeds {} {}", .0.name(), .0.bound(), .0.unit())]
    OutOfRange(Signal),
    /// What drives the device has failed, or says that the device has.
    #[error("the device failed")]
    Device,
}

impl Fault {
    /// A small number for records: 0 is reserved for "no fault".
    pub const fn code(self) -> u8 {
        match self {
            Self::NotFinite(signal) => 1 + signal as u8,
            Self::OutOfRange(signal) => 6 + signal as u8,
            Self::Device => 11,
        }
    }

    /// The fault with that [`code`](Fault::code), if there is one.
    pub fn from_code(code: u8) -> Option<Self> {
        const SIGNALS: [Signal; 5] = [
            Signal::Position,
            Signal::Velocity,
            Signal::RenderedForce,
            Signal::GraspForce,
            Signal::EnvironmentForce,
        ];
        match code {
            1..=5 => Some(Self::NotFinite(SIGNALS[usize::from(code - 1)])),
            6..=10 => Some(Self::OutOfRange(SIGNALS[usize::from(code - 6)])),
            11 => Some(Self::Device),
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_bad_number_has_a_name() {
        let bad = |x: f64| Signal::RenderedForce.check(&Axes::<3>::new(0.0, x, 0.0));
        assert_eq!(bad(f64::NAN), Err(Fault::NotFinite(Signal::RenderedForce)));
        assert_eq!(bad(f64::NEG_INFINITY), Err(Fault::NotFinite(Signal::RenderedForce)));
        assert_eq!(bad(-1.1e4), Err(Fault::OutOfRange(Signal::RenderedForce)));
        assert_eq!(bad(-1e4), Ok(()));
        assert_eq!(Fault::OutOfRange(Signal::Velocity).to_string(), "velocity exceeds 1000 m/s");
    }

    #[test]
    fn codes_are_distinct_and_reversible() {
        for code in 1..=11 {
            assert_eq!(Fault::from_code(code).map(Fault::code), Some(code));
        }
        assert_eq!((Fault::from_code(0), Fault::from_code(12)), (None, None));
    }
}
