//! Named faults of the checks at the entry of the safety layer.

use haptether_numeric::{Axes, is_within};

/// Signal that enters the safety layer, with the largest valid magnitude.
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
    /// Device orientation R.
    Orientation,
    /// Angular velocity w of the device.
    AngularVelocity,
    /// Torque requested by the remote side.
    RenderedTorque,
    /// Estimated grasp torque.
    GraspTorque,
    /// Torque of the environment on the slave's tool.
    EnvironmentTorque,
}

impl Signal {
    const ALL: [Self; 10] = [
        Self::Position,
        Self::Velocity,
        Self::RenderedForce,
        Self::GraspForce,
        Self::EnvironmentForce,
        Self::Orientation,
        Self::AngularVelocity,
        Self::RenderedTorque,
        Self::GraspTorque,
        Self::EnvironmentTorque,
    ];

    /// Return the corresponding signal of a rotation, with the same bound: rad/s for m/s, N m for N.
    pub(crate) const fn of_rotation(self) -> Self {
        match self {
            Self::Position | Self::Orientation => Self::Orientation,
            Self::Velocity | Self::AngularVelocity => Self::AngularVelocity,
            Self::RenderedForce | Self::RenderedTorque => Self::RenderedTorque,
            Self::GraspForce | Self::GraspTorque => Self::GraspTorque,
            Self::EnvironmentForce | Self::EnvironmentTorque => Self::EnvironmentTorque,
        }
    }

    /// Return whether it is a velocity, of a point or of a rotation.
    pub(crate) const fn is_velocity(self) -> bool {
        matches!(self, Self::Velocity | Self::AngularVelocity)
    }

    /// Return the largest valid magnitude per axis in SI units; a larger value indicates a broken source.
    ///
    /// The bounds are two orders of magnitude above any desktop haptic device (0.5 m, 5 m/s, 40 N) and leader arm (6
    /// rad, 30 rad/s), so that no true sample is refused. For an orientation, the bound limits the deviation of the
    /// quaternion's norm from 1.
    pub const fn bound(self) -> f64 {
        match self {
            Self::Position | Self::Velocity | Self::AngularVelocity => 1e3,
            Self::Orientation => 1e-9,
            _ => 1e4,
        }
    }

    /// Return the signal's name in messages.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Position => "position",
            Self::Velocity => "velocity",
            Self::RenderedForce => "rendered force",
            Self::GraspForce => "grasp force",
            Self::EnvironmentForce => "environment force",
            Self::Orientation => "orientation",
            Self::AngularVelocity => "angular velocity",
            Self::RenderedTorque => "rendered torque",
            Self::GraspTorque => "grasp torque",
            Self::EnvironmentTorque => "environment torque",
        }
    }

    const fn unit(self) -> &'static str {
        match self {
            Self::Position => "m",
            Self::Velocity => "m/s",
            Self::RenderedForce | Self::GraspForce | Self::EnvironmentForce => "N",
            Self::AngularVelocity => "rad/s",
            Self::RenderedTorque | Self::GraspTorque | Self::EnvironmentTorque => "N m",
            Self::Orientation => "",
        }
    }

    /// Describe a finite value that is out of range.
    fn out_of_range(self) -> String {
        match self {
            Self::Orientation => "orientation is no unit quaternion: its norm is not 1 to 1e-9".to_owned(),
            _ => format!("{} exceeds {} {}", self.name(), self.bound(), self.unit()),
        }
    }

    /// Return a fault unless the value is within its bound.
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

/// Reason why the safety layer renders no force.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Fault {
    /// A sample was NaN or infinite.
    #[error("{} is not a finite number", .0.name())]
    NotFinite(Signal),
    /// A sample was finite and out of range.
    #[error("{}", .0.out_of_range())]
    OutOfRange(Signal),
    /// The device, or its driver, has failed.
    #[error("the device failed")]
    Device,
    /// Positions or velocities exceed the speed bound of the device and do not revert: [`crate::Excess`].
    #[error("{} exceeds the speed bound of the device", .0.name())]
    TooFast(Signal),
}

impl Fault {
    /// Return a code for records; 0 is reserved for "no fault".
    pub const fn code(self) -> u8 {
        match self {
            Self::NotFinite(signal) if signal as u8 <= Signal::EnvironmentForce as u8 => 1 + signal as u8,
            Self::OutOfRange(signal) if signal as u8 <= Signal::EnvironmentForce as u8 => 6 + signal as u8,
            Self::Device => 11,
            Self::NotFinite(signal) => 12 + signal as u8 - Signal::Orientation as u8,
            Self::OutOfRange(signal) => 17 + signal as u8 - Signal::Orientation as u8,
            Self::TooFast(Signal::Position) => 22,
            Self::TooFast(Signal::Orientation) => 23,
            Self::TooFast(Signal::AngularVelocity) => 24,
            Self::TooFast(_) => 25,
        }
    }

    /// Return the fault with that [`code`](Fault::code), if there is one.
    pub fn from_code(code: u8) -> Option<Self> {
        let all =
            Signal::ALL.into_iter().flat_map(|signal| [Self::NotFinite(signal), Self::OutOfRange(signal)]);
        let too_fast = [Signal::Position, Signal::Orientation, Signal::AngularVelocity, Signal::Velocity]
            .map(Self::TooFast);
        all.chain([Self::Device]).chain(too_fast).find(|fault| fault.code() == code)
    }

    /// Return the corresponding fault of a rotation.
    pub(crate) const fn of_rotation(self) -> Self {
        match self {
            Self::NotFinite(signal) => Self::NotFinite(signal.of_rotation()),
            Self::OutOfRange(signal) => Self::OutOfRange(signal.of_rotation()),
            Self::TooFast(signal) => Self::TooFast(signal.of_rotation()),
            Self::Device => Self::Device,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_invalid_value_has_a_name() {
        let bad = |x: f64| Signal::RenderedForce.check(&Axes::<3>::new(0.0, x, 0.0));
        assert_eq!(bad(f64::NAN), Err(Fault::NotFinite(Signal::RenderedForce)));
        assert_eq!(bad(f64::NEG_INFINITY), Err(Fault::NotFinite(Signal::RenderedForce)));
        assert_eq!(bad(-1.1e4), Err(Fault::OutOfRange(Signal::RenderedForce)));
        assert_eq!(bad(-1e4), Ok(()));
        assert_eq!(Fault::OutOfRange(Signal::Velocity).to_string(), "velocity exceeds 1000 m/s");
        let of_rotation = Fault::OutOfRange(Signal::GraspForce).of_rotation();
        assert_eq!(of_rotation.to_string(), "grasp torque exceeds 10000 N m");
        for signal in Signal::ALL {
            assert_eq!(signal.of_rotation().of_rotation(), signal.of_rotation());
        }
    }

    #[test]
    fn codes_are_distinct_and_reversible() {
        for code in 1..=25 {
            assert_eq!(Fault::from_code(code).map(Fault::code), Some(code));
        }
        // Records and packets contain these codes.
        assert_eq!(Fault::NotFinite(Signal::Position).code(), 1);
        assert_eq!(Fault::OutOfRange(Signal::EnvironmentForce).code(), 10);
        assert_eq!(Fault::Device.code(), 11);
        assert_eq!(Fault::NotFinite(Signal::Orientation).code(), 12);
        assert_eq!(Fault::OutOfRange(Signal::Orientation).code(), 17);
        assert_eq!(Fault::TooFast(Signal::Position).code(), 22);
        assert_eq!((Fault::from_code(0), Fault::from_code(26)), (None, None));
    }
}
