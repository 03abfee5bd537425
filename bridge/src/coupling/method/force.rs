//! Bounds on the force of a coupling, for an arm that takes forces.

use haptether_safety::Axes;

use super::{super::CouplingError, super::mapping::check, capped};

/// Time constant in s with which a bound on speed or reach brakes the arm.
const BRAKES_S: f64 = 0.02;

/// An arm that takes forces: `F_c` moves the arm itself, without a virtual tool.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ForceArm {
    /// M in kg (kg m²).
    mass: f64,
    /// Largest `F_c` in N (N m).
    most: f64,
}

/// State of an arm against its bounds.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Room<'a, const N: usize> {
    /// Displacement in m from the arm's start.
    pub(crate) away: &'a Axes<N>,
    /// Velocity in m/s.
    pub(crate) velocity: &'a Axes<N>,
    /// Bounds on speed in m/s and on distance in m.
    pub(crate) bounds: [f64; 2],
}

#[cfg(test)]
impl<'a, const N: usize> Room<'a, N> {
    /// Rest at the start, without bounds.
    pub(crate) fn free(zero: &'a Axes<N>) -> Self {
        Self { away: zero, velocity: zero, bounds: [f64::INFINITY; 2] }
    }
}

impl ForceArm {
    /// Check mass and largest force: both above 0.
    pub fn new(mass: f64, most: f64) -> Result<Self, CouplingError> {
        Ok(Self { mass: check("mass_kg", "M", mass)?, most: check("max_force_n", "F_max", most)? })
    }

    /// Return the force in N that the bounds leave of `force`, and whether speed and reach acted.
    ///
    /// - Force: `|F| <= F_max`; the bounds below come first.
    /// - Speed: no force along V, and `-M (|V| - v_max) / tau` against it.
    /// - Reach: no force outwards, and a critically damped spring back, `K = M / (4 tau²)` and `B = M / tau`.
    ///
    /// tau is 20 ms. Source: critical damping of a mass, `B² = 4 K M`; derived here.
    pub(crate) fn bounded<const N: usize>(
        &self,
        force: &Axes<N>,
        room: &Room<'_, N>,
    ) -> (Axes<N>, [bool; 2]) {
        let Room { away, velocity, bounds: [max_speed, reach] } = *room;
        let (speed, distance) = (velocity.norm(), away.norm());
        let (hurries, leaves) = (speed > max_speed, distance > reach);
        let damping = self.mass / BRAKES_S;
        let (mut force, mut brake) = (capped(force, self.most), Axes::zeros());
        if hurries {
            let along = velocity / speed;
            force -= along * force.dot(&along).max(0.0);
            brake -= along * (damping * (speed - max_speed));
        }
        if leaves {
            let outwards = away / distance;
            let back = damping * velocity.dot(&outwards) + 0.25 * damping / BRAKES_S * (distance - reach);
            force -= outwards * force.dot(&outwards).max(0.0);
            brake -= outwards * back;
        }
        // The brake comes first: a large force across a bound gets what it leaves.
        let brake = capped(&brake, self.most);
        (brake + capped(&force, self.most - brake.norm()), [hurries, leaves])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MASS: f64 = 4.0;
    const T: f64 = 1e-3;

    /// Push a mass with 20 N at a tick of 1 ms; return the largest speed and distance, and those at the end.
    fn pushed(bounds: [f64; 2]) -> [[f64; 2]; 2] {
        let arm = ForceArm::new(MASS, 50.0).unwrap();
        let (mut x, mut v) = (Axes::<2>::zeros(), Axes::<2>::zeros());
        let force = Axes::<2>::new(12.0, 16.0);
        let mut most = [0.0_f64; 2];
        for _ in 0..20_000 {
            let (bounded, _) = arm.bounded(&force, &Room { away: &x, velocity: &v, bounds });
            assert!(bounded.norm() <= 50.0 + 1e-12);
            v += bounded * (T / MASS);
            x += v * T;
            most = [most[0].max(v.norm()), most[1].max(x.norm())];
        }
        [most, [v.norm(), x.norm()]]
    }

    #[test]
    fn a_constant_force_meets_the_bounds_on_speed_and_reach() {
        // One tick beyond the bound, then the bound brakes.
        let [[speed, _], [last, _]] = pushed([0.2, f64::INFINITY]);
        assert!((0.2..0.2 + 20.0 / MASS * T + 1e-12).contains(&speed), "{speed}");
        assert!((0.195..=speed).contains(&last), "{last}");
        let [[_, far], [rest, at]] = pushed([0.2, 0.1]);
        // From 0.2 m/s a mass brakes over at most v tau of a critically damped spring with the pole 1 / (2 tau).
        assert!((0.1..0.1 + 2.0 * 0.2 * BRAKES_S).contains(&far), "{far}");
        assert!(rest < 0.01 && (at - 0.1).abs() < 1e-3, "{rest}, {at}");
        let free = pushed([f64::INFINITY; 2]);
        assert!((free[1][0] - 20.0 / MASS * 20.0).abs() < 1e-6, "{free:?}");
    }

    /// A force of ten times the cap, across the bounds, does not dilute the brakes: a mass on a string swings within them.
    #[test]
    fn a_large_force_across_a_bound_leaves_the_brake() {
        let arm = ForceArm::new(MASS, 10.0).unwrap();
        let (mut x, mut v) = (Axes::<2>::zeros(), Axes::<2>::new(0.08, 0.0));
        let (mut far, mut fast) = (0.0_f64, 0.0_f64);
        for tick in 0..20_000 {
            let turn = f64::from(tick) * T;
            let force = Axes::<2>::new(60.0 * turn.cos(), 80.0 * turn.sin());
            let room = Room { away: &x, velocity: &v, bounds: [0.1, 0.05] };
            v += arm.bounded(&force, &room).0 * (T / MASS);
            x += v * T;
            (far, fast) = (far.max(x.norm()), fast.max(v.norm()));
        }
        assert!((0.05..0.05 + 2.0 * 0.1 * BRAKES_S).contains(&far), "{far}");
        assert!((0.095..0.1 + 10.0 / MASS * T * 2.0).contains(&fast), "{fast}");
    }

    #[test]
    fn a_force_inwards_passes_and_a_large_one_keeps_its_direction() {
        let arm = ForceArm::new(MASS, 5.0).unwrap();
        let (away, velocity) = (Axes::<2>::new(0.3, 0.0), Axes::<2>::zeros());
        let room = Room { away: &away, velocity: &velocity, bounds: [1.0, 0.3] };
        let (force, limited) = arm.bounded(&Axes::<2>::new(-30.0, 40.0), &room);
        assert!((force - Axes::<2>::new(-3.0, 4.0)).norm() < 1e-12 && limited == [false; 2]);
        for bad in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            assert!(ForceArm::new(bad, 1.0).is_err() && ForceArm::new(1.0, bad).is_err());
        }
    }
}
