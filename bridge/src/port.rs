//! State of a side's plant as a frame carries it.

use haptether_safety::Axes;

use crate::coupling::{CouplingKind, GripperState, RotationState};

/// Largest number of axes of a device or an arm.
pub const MAX_AXES: usize = 7;

/// One value per axis of a side; zero beyond its axes.
pub type Padded = Axes<MAX_AXES>;

/// Pad the values of a side with zeros.
#[inline]
pub fn padded<const N: usize>(values: &Axes<N>) -> Padded {
    let mut padded = Padded::zeros();
    padded.as_mut_slice()[..N].copy_from_slice(values.as_slice());
    padded
}

/// Return the first `N` values.
#[inline]
pub fn unpadded<const N: usize>(values: &Padded) -> Axes<N> {
    Axes::from_column_slice(&values.as_slice()[..N])
}

/// Largest sum in J that a frame carries; a port of 1 kW reaches it after eleven days.
pub const MAX_ENERGY_J: f64 = 1e9;

/// Energies that a port has exchanged since the engagement.
///
/// `E_in += max(W, 0)`, `E_out += max(-W, 0)` a tick. W is the work of the plant on the link, exactly: the force that was
/// held since the last tick times the way that was made. It is `-F·dx` at the master, with the force of the coupling
/// that the device exerted: after ladder and limiter, without the damping of the controllers. At the slave it is
/// `-F_c·dx` of the tool for a coupling with `F_c`, and `F_e·dx` for position-force.
///
/// Two sums that only rise survive loss: the newest frame contains everything that lost frames contained. A
/// difference of powers in each frame would not.
///
/// Source: Ryu, Artigas and Preusche, *A passive bilateral control scheme for a teleoperator with
/// time-varying communication delay*, 2010, Eq. 5-8.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PortEnergy {
    /// Energy from the plant into the link, in J.
    pub in_j: f64,
    /// Energy from the link into the plant, in J.
    pub out_j: f64,
}

impl PortEnergy {
    /// Add the work in J of the plant on the link. NaN and infinity add nothing.
    pub fn add(&mut self, energy_j: f64) {
        if !energy_j.is_finite() {
            return;
        }
        let sum = if energy_j > 0.0 { &mut self.in_j } else { &mut self.out_j };
        *sum = (*sum + energy_j.abs()).min(MAX_ENERGY_J);
    }

    /// Return whether both sums are within their range.
    pub fn is_possible(&self) -> bool {
        [self.in_j, self.out_j].iter().all(|sum| (0.0..=MAX_ENERGY_J).contains(sum))
    }
}

/// Numbers of a coupling in a frame. All are zero while the sender is not engaged.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CouplingMessage {
    /// Count of the sender's engagements, from 1; 0 while its half of the coupling is not engaged.
    pub epoch: u16,
    /// One number per axis: a motion in m since the engagement, `F_c` in N of a slave, or the integral of a wave, see
    /// [`Sends`](crate::coupling::Sends).
    pub vector: Padded,
    /// The same for the rotation, in rad or N m; only of kind `pose`.
    pub turned: Axes<3>,
    /// Energies in J that only rise, of translation and rotation, for couplings that balance them.
    pub sums: [f64; 2],
}

impl Default for CouplingMessage {
    fn default() -> Self {
        Self::ZERO
    }
}

impl CouplingMessage {
    pub(crate) const ZERO: Self = Self {
        epoch: 0,
        vector: Padded::from_array_storage(nalgebra::ArrayStorage([[0.0; MAX_AXES]])),
        turned: Axes::<3>::new(0.0, 0.0, 0.0),
        sums: [0.0; 2],
    };

    /// Copy the numbers of a coupling; those of position-force are always zero.
    #[inline(always)] // takes a frame: docs/decisions/060-ticks-in-a-row.md
    pub(crate) fn replace(&mut self, other: &Self, coupling: CouplingKind) {
        if coupling == CouplingKind::PositionForce {
            self.epoch = other.epoch;
        } else {
            *self = *other;
        }
    }
}

/// Plant state in a frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PortState {
    /// Position in m.
    pub position: Padded,
    /// Velocity in m/s.
    pub velocity: Padded,
    /// Force in N.
    pub force: Padded,
    /// Energy into and out of the link.
    pub energy: PortEnergy,
    /// Numbers of the coupling.
    pub message: CouplingMessage,
    /// Orientation, angular velocity and torque; only for kind `pose`.
    pub rotation: Option<RotationState>,
    /// Gripper or trigger, if the session has a gripper.
    pub gripper: Option<GripperState>,
    /// Buttons of the master, if the session has buttons.
    pub buttons: Option<u32>,
}

impl PortState {
    /// Store the measured state; other fields stay.
    #[inline]
    pub(crate) fn report<const N: usize>(
        &mut self,
        position: &Axes<N>,
        velocity: &Axes<N>,
        force: &Axes<N>,
        rotation: Option<RotationState>,
    ) {
        // In place: values beyond the axes stay zero.
        for (part, values) in
            [(&mut self.position, position), (&mut self.velocity, velocity), (&mut self.force, force)]
        {
            part.as_mut_slice()[..N].copy_from_slice(values.as_slice());
        }
        // A point has no rotation, so skip the write.
        if rotation.is_some() || self.rotation.is_some() {
            self.rotation = rotation;
        }
    }
}

impl Default for PortState {
    fn default() -> Self {
        let [position, velocity, force] = [Padded::zeros(); 3];
        let (energy, message) = (PortEnergy::default(), CouplingMessage::default());
        Self { position, velocity, force, energy, message, rotation: None, gripper: None, buttons: None }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// P = sin(2 pi t) W over ten periods: each sum is 10 times the integral of a half wave, 10 / pi J.
    #[test]
    fn alternating_power_fills_both_sums() {
        let (mut energy, ticks) = (PortEnergy::default(), 100_000);
        for tick in 0..ticks {
            // Midpoint rule: the relative error is below (pi dT)^2 / 6.
            let time_s = (f64::from(tick) + 0.5) * 1e-4;
            energy.add((std::f64::consts::TAU * time_s).sin() * 1e-4);
        }
        let exact = 10.0 / std::f64::consts::PI;
        for sum in [energy.in_j, energy.out_j] {
            assert!((sum / exact - 1.0).abs() < 2e-8, "{sum} J, must be {exact} J");
        }
    }

    #[test]
    fn nan_adds_nothing_and_sums_saturate() {
        let mut energy = PortEnergy { in_j: 1.0, out_j: 2.0 };
        for power_w in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 0.0, -0.0] {
            energy.add(power_w);
            assert_eq!(energy, PortEnergy { in_j: 1.0, out_j: 2.0 });
        }
        energy.add(1e300);
        energy.add(-1e300);
        assert_eq!(energy, PortEnergy { in_j: MAX_ENERGY_J, out_j: MAX_ENERGY_J });
        assert!(energy.is_possible());
        for bad in [-1e-300, f64::NAN, f64::INFINITY, 1.1e9] {
            assert!(!PortEnergy { in_j: bad, out_j: 0.0 }.is_possible());
            assert!(!PortEnergy { in_j: 0.0, out_j: bad }.is_possible());
        }
    }
}
