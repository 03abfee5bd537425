//! The hand grasp force model.

use crate::{
    Axes, ParameterError, Real,
    estimator::Motion,
    lanes::{choose_axes, norm, pack},
    parameter::{finite, non_negative, positive},
};

/// Dynamics of the haptic device as a point mass, per axis.
///
/// `m A + b V + c sign(V) = F_device + F_h`
///
/// For several axes `sign(V)` is the direction of motion `V / |V|`, so that a rotation of the frame rotates the
/// friction with it.
///
/// Source: paper Eq. 3.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DeviceModel<const N: usize, S = f64> {
    mass: Axes<N, S>,
    viscous: Axes<N, S>,
    coulomb: Axes<N, S>,
}

impl<const N: usize> DeviceModel<N> {
    /// A device of mass m in kg (> 0), viscous friction b in N s/m (any sign) and Coulomb friction c in N (>= 0).
    pub fn new(mass_kg: Axes<N>, viscous: Axes<N>, coulomb: Axes<N>) -> Result<Self, ParameterError> {
        for axis in 0..N {
            positive("mass_kg", "m", mass_kg[axis])?;
            // The paper's own device has b = -0.005: its amplifiers over-compensate.
            finite("viscous", "b", viscous[axis])?;
            non_negative("coulomb", "c", coulomb[axis])?;
        }
        Ok(Self { mass: mass_kg, viscous, coulomb })
    }

    /// The same mass and friction on each axis.
    pub fn uniform(mass_kg: f64, viscous: f64, coulomb: f64) -> Result<Self, ParameterError> {
        Self::new(Axes::repeat(mass_kg), Axes::repeat(viscous), Axes::repeat(coulomb))
    }

    /// The paper's PHANTOM Desktop: m = 0.157 kg, b = -0.005 N s/m, c = 0.038 N (section 4.1).
    pub fn phantom_desktop() -> Self {
        Self { mass: Axes::repeat(0.157), viscous: Axes::repeat(-0.005), coulomb: Axes::repeat(0.038) }
    }

    /// The smallest of the masses: it bounds the damping that a sampled controller may apply.
    pub fn lightest_kg(&self) -> f64 {
        self.mass.min()
    }

    /// The largest of the Coulomb frictions in N: a force below it moves nothing.
    pub fn largest_coulomb(&self) -> f64 {
        self.coulomb.max()
    }
}

impl<const N: usize, S: Real> DeviceModel<N, S> {
    /// As many devices as there are lanes; None for another number of them.
    pub fn gather(of: &[&DeviceModel<N>]) -> Option<Self> {
        Some(Self {
            mass: pack(of, |device| device.mass)?,
            viscous: pack(of, |device| device.viscous)?,
            coulomb: pack(of, |device| device.coulomb)?,
        })
    }

    /// m in kg.
    #[inline(always)]
    pub fn mass_kg(&self) -> &Axes<N, S> {
        &self.mass
    }

    /// `F_h = m A + b V + c sign(V) - F_device`, in N.
    ///
    /// `aligned_device_force` is all the force that the device was commanded to exert (rendered plus safety), passed
    /// through [`Estimator::align`](crate::estimator::Estimator::align), because A belongs to the past ticks that
    /// the estimator averaged. The paper writes `F_v` for it, which is the same as long as no controller acts.
    ///
    /// Source: paper Eq. 4.
    #[inline(always)]
    pub fn grasp_force(&self, motion: &Motion<N, S>, aligned_device_force: &Axes<N, S>) -> Axes<N, S> {
        let direction = direction(&motion.velocity);
        self.mass.component_mul(&motion.acceleration)
            + self.viscous.component_mul(&motion.velocity)
            + self.coulomb.component_mul(&direction)
            - aligned_device_force
    }

    /// Kinetic energy `V' M V / 2` in J.
    #[inline(always)]
    pub fn kinetic_energy_j(&self, velocity: &Axes<N, S>) -> S {
        S::splat(0.5) * self.mass.component_mul(velocity).dot(velocity)
    }
}

/// `V / |V|`, zero at rest: along one axis a sign, without a root and a division at each tick.
#[inline(always)]
fn direction<const N: usize, S: Real>(velocity: &Axes<N, S>) -> Axes<N, S> {
    let nothing = S::splat(0.0);
    if N == 1 {
        let sign = |v: S| {
            let one = S::splat(1.0);
            one.select(v.simd_gt(nothing), (-one).select(v.simd_lt(nothing), nothing))
        };
        return velocity.map(sign);
    }
    let speed = norm(velocity);
    choose_axes!(S, speed.simd_gt(nothing), velocity / speed, Axes::zeros())
}

#[cfg(test)]
mod tests {
    use nalgebra::SimdValue as _;
    use simba::simd::AutoF64x4;

    use super::*;

    #[test]
    fn balances_eq_3() {
        let model =
            DeviceModel::<1>::new(Axes::<1>::new(0.2), Axes::<1>::new(0.5), Axes::<1>::new(0.1)).unwrap();
        let motion = Motion { velocity: Axes::<1>::new(-2.0), acceleration: Axes::<1>::new(3.0) };
        let force = model.grasp_force(&motion, &Axes::<1>::new(1.5));
        // 0.2*3 + 0.5*(-2) - 0.1 - 1.5
        assert!((force[0] - (-2.0)).abs() < 1e-15);
    }

    /// By Eq. 4 of a motion that has one term at a time, against the figures of section 4.1.
    #[test]
    fn the_papers_device_has_the_papers_figures() {
        let model = DeviceModel::<1>::phantom_desktop();
        let force = |velocity, acceleration| {
            let motion =
                Motion { velocity: Axes::<1>::new(velocity), acceleration: Axes::<1>::new(acceleration) };
            model.grasp_force(&motion, &Axes::zeros())[0]
        };
        assert_eq!(force(0.0, 1.0), 0.157);
        // Powers of two: b V is exact, and c sign(V) changes its sign with V while the sum has one rounding.
        assert!((force(2.0, 0.0) - (0.038 - 0.010)).abs() < 1e-16);
        assert!((force(-4.0, 0.0) - (-0.038 + 0.020)).abs() < 1e-16);
    }

    #[test]
    fn at_rest_there_is_no_dynamic_friction() {
        let model = DeviceModel::<3>::phantom_desktop();
        let motion = Motion { velocity: Axes::zeros(), acceleration: Axes::zeros() };
        let device_force = Axes::<3>::new(1.0, -2.0, 0.5);
        assert_eq!(model.grasp_force(&motion, &device_force), -device_force);
    }

    #[test]
    fn refuses_what_is_no_device() {
        for (m, b, c) in [(0.0, 0.0, 0.0), (f64::NAN, 0.0, 0.0), (0.1, f64::INFINITY, 0.0), (0.1, 0.0, -1e-9)]
        {
            assert!(DeviceModel::<2>::uniform(m, b, c).is_err(), "{m} {b} {c}");
        }
    }

    /// Along one axis: the sign of V, as `V / |V|` is where its square is a number; nothing of what is none.
    #[test]
    fn the_direction_along_an_axis_is_a_sign() {
        let of = |v: f64| direction(&Axes::<1>::new(v))[0];
        for v in [1.0, 0.1, 3.0, 1e-150, 1e150] {
            assert_eq!([of(v), of(-v)], [1.0, -1.0]);
            assert_eq!(of(v), v / (v * v).sqrt());
        }
        for v in [5e-324, 1e-170, 1e200, f64::INFINITY] {
            assert_eq!([of(v), of(-v)], [1.0, -1.0], "its square is no number");
        }
        assert_eq!([of(0.0), of(-0.0), of(f64::NAN)], [0.0; 3]);
        let lanes = direction(&Axes::<1, AutoF64x4>::new(AutoF64x4::new(-2.0, 0.0, f64::NAN, 1e-170)));
        assert_eq!((0..4).map(|lane| lanes[0].extract(lane)).collect::<Vec<_>>(), [-1.0, 0.0, 0.0, 1.0]);
    }
}
