//! Model of the grasp force of the hand.

use crate::{
    Axes, ParameterError, Real,
    estimator::Motion,
    parameter::{finite, non_negative, positive},
};
use haptether_numeric::{choose_axes, norm, pack};

/// Dynamics of the haptic device as a point mass, per axis.
///
/// `m A + b V + c sign(V) = F_device + F_h`
///
/// For several axes `sign(V)` is the direction of motion `V / |V|`, so that the friction rotates with the frame.
///
/// Source: paper Eq. 3.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DeviceModel<const N: usize, S = f64> {
    mass: Axes<N, S>,
    viscous: Axes<N, S>,
    coulomb: Axes<N, S>,
}

impl<const N: usize> DeviceModel<N> {
    /// Create a device of mass m in kg (> 0), viscous friction b in N s/m (any sign) and Coulomb friction c in N (>=
    /// 0).
    pub fn new(mass_kg: Axes<N>, viscous: Axes<N>, coulomb: Axes<N>) -> Result<Self, ParameterError> {
        for axis in 0..N {
            positive("mass_kg", "m", mass_kg[axis])?;
            // The paper's own device has b = -0.005, since its amplifiers over-compensate.
            finite("viscous", "b", viscous[axis])?;
            non_negative("coulomb", "c", coulomb[axis])?;
        }
        Ok(Self { mass: mass_kg, viscous, coulomb })
    }

    /// Create a device with the same mass and friction on each axis.
    pub fn uniform(mass_kg: f64, viscous: f64, coulomb: f64) -> Result<Self, ParameterError> {
        Self::new(Axes::repeat(mass_kg), Axes::repeat(viscous), Axes::repeat(coulomb))
    }

    /// Return the paper's PHANTOM Desktop: m = 0.157 kg, b = -0.005 N s/m, c = 0.038 N (section 4.1).
    pub fn phantom_desktop() -> Self {
        Self { mass: Axes::repeat(0.157), viscous: Axes::repeat(-0.005), coulomb: Axes::repeat(0.038) }
    }

    /// Return the smallest mass, which bounds the damping that a sampled controller may apply.
    pub fn lightest_kg(&self) -> f64 {
        self.mass.min()
    }

    /// Return the mass of the lightest axis in kg.
    pub(crate) fn lightest(&self) -> f64 {
        self.mass.min()
    }

    /// Return the largest Coulomb friction of any axis in N; a larger force overcomes friction on every axis.
    pub fn largest_coulomb(&self) -> f64 {
        self.coulomb.max()
    }
}

impl<const N: usize, S: Real> DeviceModel<N, S> {
    /// Gather one device per lane; return None if there are more devices than lanes.
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

    /// Compute `F_h = m A + b V + c sign(V) - F_device` in N.
    ///
    /// `aligned_device_force` is the complete commanded force (rendered plus safety), filtered by
    /// [`Estimator::align`](crate::estimator::Estimator::align), because A is a mean over past ticks. The paper
    /// writes `F_v`, which is the same while no controller acts.
    ///
    /// Source: paper Eq. 4.
    #[inline(always)]
    pub fn grasp_force(&self, motion: &Motion<N, S>, aligned_device_force: &Axes<N, S>) -> Axes<N, S> {
        self.mass.component_mul(&motion.acceleration)
            + self.viscous.component_mul(&motion.velocity)
            + self.coulomb_force(&motion.velocity)
            - aligned_device_force
    }

    /// Return the Coulomb friction `c V / |V|` in N, zero at rest.
    #[inline(always)]
    pub(crate) fn coulomb_force(&self, velocity: &Axes<N, S>) -> Axes<N, S> {
        self.coulomb.component_mul(&direction(velocity))
    }

    /// Return the kinetic energy `V' M V / 2` in J.
    #[inline(always)]
    pub fn kinetic_energy_j(&self, velocity: &Axes<N, S>) -> S {
        S::splat(0.5) * self.mass.component_mul(velocity).dot(velocity)
    }
}

/// Return `V / |V|`, zero at rest. Along one axis it is a sign, without a root and a division at each tick.
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

    /// Eq. 4 for motions with one non-zero term gives the figures of section 4.1.
    #[test]
    fn phantom_desktop_has_the_figures_of_the_paper() {
        let model = DeviceModel::<1>::phantom_desktop();
        let force = |velocity, acceleration| {
            let motion =
                Motion { velocity: Axes::<1>::new(velocity), acceleration: Axes::<1>::new(acceleration) };
            model.grasp_force(&motion, &Axes::zeros())[0]
        };
        assert_eq!(force(0.0, 1.0), 0.157);
        // Powers of two: b V is exact, c sign(V) changes its sign with V, and the sum has one rounding.
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
    fn invalid_devices_are_refused() {
        for (m, b, c) in [(0.0, 0.0, 0.0), (f64::NAN, 0.0, 0.0), (0.1, f64::INFINITY, 0.0), (0.1, 0.0, -1e-9)]
        {
            assert!(DeviceModel::<2>::uniform(m, b, c).is_err(), "{m} {b} {c}");
        }
    }

    /// Along one axis the direction is the sign of V. It equals `V / |V|` unless the square
    /// overflows or underflows, and is 0 for NaN.
    #[test]
    fn direction_along_one_axis_is_a_sign() {
        let of = |v: f64| direction(&Axes::<1>::new(v))[0];
        for v in [1.0, 0.1, 3.0, 1e-150, 1e150] {
            assert_eq!([of(v), of(-v)], [1.0, -1.0]);
            assert_eq!(of(v), v / (v * v).sqrt());
        }
        for v in [5e-324, 1e-170, 1e200, f64::INFINITY] {
            assert_eq!([of(v), of(-v)], [1.0, -1.0], "its square over- or underflows");
        }
        assert_eq!([of(0.0), of(-0.0), of(f64::NAN)], [0.0; 3]);
        let lanes = direction(&Axes::<1, AutoF64x4>::new(AutoF64x4::new(-2.0, 0.0, f64::NAN, 1e-170)));
        assert_eq!((0..4).map(|lane| lanes[0].extract(lane)).collect::<Vec<_>>(), [-1.0, 0.0, 0.0, 1.0]);
    }
}
