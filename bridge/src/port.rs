//! State of a side's plant as a frame carries it.

use haptether_safety::Axes;

use crate::coupling::{GripperState, RotationState};

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

/// Cumulative energies at a port, for the couplings that balance them.
///
/// `E_in += max(P, 0) dT`, `E_out += max(-P, 0) dT`. P is the power from the plant into the link: `-F_v·V` at
/// the master, `F_e·V` with the commanded velocity at the slave.
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
    /// Add a power in W, from the plant into the link, over a time in s. NaN and infinity add nothing.
    pub fn add(&mut self, power_w: f64, over_s: f64) {
        let energy_j = power_w * over_s;
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
        let energy = PortEnergy::default();
        Self { position, velocity, force, energy, rotation: None, gripper: None, buttons: None }
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
            energy.add((std::f64::consts::TAU * time_s).sin(), 1e-4);
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
            energy.add(power_w, 1.0);
            assert_eq!(energy, PortEnergy { in_j: 1.0, out_j: 2.0 });
        }
        energy.add(1e300, 1.0);
        energy.add(-1e300, 1.0);
        assert_eq!(energy, PortEnergy { in_j: MAX_ENERGY_J, out_j: MAX_ENERGY_J });
        assert!(energy.is_possible());
        for bad in [-1e-300, f64::NAN, f64::INFINITY, 1.1e9] {
            assert!(!PortEnergy { in_j: bad, out_j: 0.0 }.is_possible());
            assert!(!PortEnergy { in_j: 0.0, out_j: bad }.is_possible());
        }
    }
}
