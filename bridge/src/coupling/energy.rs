//! Energy that goes in and out of the link at one side's port, each a sum that never falls.

/// Largest sum in J that a frame tells; a port of 1 kW takes eleven days to it.
pub const MAX_ENERGY_J: f64 = 1e9;

/// Cumulative energies at a port, for the couplings that balance them.
///
/// `E_in += max(P, 0) dT`, `E_out += max(-P, 0) dT`, where P is the power from the plant into the link: `-F_v·V` at the
/// master, `F_e·V` of the commanded velocity at the slave. Two sums that only rise survive loss: the newest frame has
/// all that the lost ones had, where a difference of powers in each frame would not.
///
/// Source: Ryu, Artigas and Preusche, *A passive bilateral control scheme for a teleoperator with time-varying
/// communication delay*, 2010, Eq. 5-8.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PortEnergy {
    /// From the plant into the link, in J.
    pub in_j: f64,
    /// From the link into the plant, in J.
    pub out_j: f64,
}

impl PortEnergy {
    /// Adds a power in W, from the plant into the link, over a time in s; one that is no number adds nothing.
    pub fn add(&mut self, power_w: f64, over_s: f64) {
        let energy_j = power_w * over_s;
        if !energy_j.is_finite() {
            return;
        }
        let sum = if energy_j > 0.0 { &mut self.in_j } else { &mut self.out_j };
        *sum = (*sum + energy_j.abs()).min(MAX_ENERGY_J);
    }

    /// Whether both sums can be.
    pub fn is_possible(&self) -> bool {
        [self.in_j, self.out_j].iter().all(|sum| (0.0..=MAX_ENERGY_J).contains(sum))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// P = sin(2 pi t) W over ten periods: each sum is 10 integral of a half wave, 10 / pi J.
    #[test]
    fn a_power_that_swings_fills_both_sums() {
        let (mut energy, ticks) = (PortEnergy::default(), 100_000);
        for tick in 0..ticks {
            // The middle of each step: its error is below (pi dT)^2 / 6 of the whole.
            let time_s = (f64::from(tick) + 0.5) * 1e-4;
            energy.add((std::f64::consts::TAU * time_s).sin(), 1e-4);
        }
        let exact = 10.0 / std::f64::consts::PI;
        for sum in [energy.in_j, energy.out_j] {
            assert!((sum / exact - 1.0).abs() < 2e-8, "{sum} J, must be {exact} J");
        }
    }

    #[test]
    fn what_is_no_number_adds_nothing_and_the_sums_have_an_end() {
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
