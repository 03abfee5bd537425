//! Couplings: the request of each side to its device, from the newest state of the other side.

mod alignment;
mod change;
mod command;
#[cfg(test)]
pub(crate) mod drawn;
mod gripper;
mod orientation;
mod position_force;
mod reference_point;
mod rotation;
mod rotational_spring;
mod wrench;

use haptether_safety::{Axes, Real};
use nalgebra::SMatrix;

pub use alignment::{
    ALIGNED_RAD, Alignment, AlignmentError, AlignmentSettings, AlignmentStep, ROUND_TRIP_S, SETTLED_S,
};
pub use change::{CHANGE_FACTOR, OPEN_FACTOR, ScaleRange, ScaleRanges};
pub use command::{CommandBounds, Limited, RotationBounds};
pub(crate) use command::{bounded, decayed, turned_within};
pub use gripper::{GripperFollower, GripperState};
pub use orientation::{MAX_NORM_ERROR, RotationState, canonical, checked, is_canonical, measured, quat_wxyz};
pub use position_force::PositionForce;
pub use reference_point::{ReferencePoint, ReferencePointError};
pub use rotation::{ANCHOR_REACH_RAD, RotationCoupling, RotationLock};
pub use rotational_spring::{FULL_SPRING_RAD, RotationalSpring};
pub use wrench::{Twist, Wrench};

/// Invalid parameter of a coupling.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum CouplingError {
    /// Scale or bound that is not above 0, or not finite where it must be.
    #[error("{name} ({symbol}) = {seen}: must be finite and above 0")]
    Scale {
        /// Name of the parameter.
        name: &'static str,
        /// Symbol of the parameter.
        symbol: &'static str,
        /// Given value.
        seen: f64,
    },
    /// Scale out of its range during the run.
    #[error(
        "{name} ({symbol}) = {seen:?}: must be between {} and {}, with an open clutch between {} and {}; {}",
        change::rounded(closed[0]), change::rounded(closed[1]), change::rounded(open[0]), change::rounded(open[1]),
        change::remedy(name, *seen, *open)
    )]
    Change {
        /// Name of the scale.
        name: &'static str,
        /// Symbol of the scale.
        symbol: &'static str,
        /// Given value.
        seen: f64,
        /// Smallest and largest value while the clutch is closed.
        closed: [f64; 2],
        /// Smallest and largest value while the clutch is open.
        open: [f64; 2],
    },
    /// Scale that this side does not have.
    #[error("{0}: only a side of kind \"pose\" has it")]
    NoScale(&'static str),
    /// Matrix that is not a rotation.
    #[error("rotation: R' R differs from the identity by {0}, must be by at most 1e-9")]
    Orthonormal(f64),
    /// Quaternion that is not a unit quaternion.
    #[error("quat_wxyz has a norm of {0}: must be 1 to within 1e-6")]
    Quaternion(f64),
    /// Quaternion whose rotation leaves the space of the axes.
    #[error("quat_wxyz: a rotation of {0} axes, must be of 3 axes, or of 2 about z")]
    Turn(usize),
    /// Rotation of more than three axes.
    #[error("rotation of {0} axes: must be of at most 3")]
    Rotation(usize),
    /// Measured or received quaternion that is not a unit quaternion.
    #[error(
        "orientation: quat_wxyz = {seen:?} has a norm of {norm}: must be 1 to within 1e-9; normalise it where it is made"
    )]
    Orientation {
        /// Given value.
        seen: [f64; 4],
        /// Norm of the value; NaN if a component is NaN.
        norm: f64,
    },
    /// Axis that is not a unit vector.
    #[error("axis of rotation has a length of {0}: must be 1 to within 1e-6")]
    Axis(f64),
    /// Angle out of range: no two orientations are farther apart than pi.
    #[error("{name} = {seen} rad: must be above 0 and at most pi")]
    Angle {
        /// Name of the angle.
        name: &'static str,
        /// Given value.
        seen: f64,
    },
    /// Angle between master and slave beyond the largest angle of an alignment.
    #[error(
        "master and slave are turned {seen_rad} rad from one another, alignment is allowed up to {allowed_rad} rad: turn \
         the handle towards the slave's tool"
    )]
    Misaligned {
        /// Angle between them in rad.
        seen_rad: f64,
        /// Largest allowed angle in rad.
        allowed_rad: f64,
    },
    /// Alignment that does not fit this coupling.
    #[error(transparent)]
    Alignment(#[from] AlignmentError),
}

impl CouplingError {
    const fn scale(name: &'static str, symbol: &'static str, seen: f64) -> Self {
        Self::Scale { name, symbol, seen }
    }
}

/// Rotation between master and slave, and locked axes of the slave, which do not follow.
///
/// `V_s = lambda_p L R V_m`, `F_v = lambda_f R' L F_e`, with R orthonormal and L diagonal of 0 and 1. Then
/// `F_v · V_m = (lambda_f / lambda_p) F_e · V_s`: the map conserves power up to the scales.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FrameMap<const N: usize> {
    /// R; none for the identity.
    rotation: Option<SMatrix<f64, N, N>>,
    locked: [bool; N],
}

impl<const N: usize> Default for FrameMap<N> {
    fn default() -> Self {
        Self { rotation: None, locked: [false; N] }
    }
}

/// Tolerance of the norm of a quaternion written by hand, for omitted digits.
const UNIT: f64 = 1e-6;

/// Tolerance of the largest element of R' R minus the identity.
const ORTHONORMAL: f64 = 1e-9;

/// Normalise a quaternion written by hand; its norm must be 1 to within [`UNIT`].
fn normalised(quat_wxyz: [f64; 4]) -> Result<[f64; 4], CouplingError> {
    let norm = quat_wxyz.iter().map(|part| part * part).sum::<f64>().sqrt();
    if norm.is_nan() || (norm - 1.0).abs() > UNIT {
        return Err(CouplingError::Quaternion(norm));
    }
    Ok(quat_wxyz.map(|part| part / norm))
}

impl<const N: usize> FrameMap<N> {
    /// Build the map from R, given as rows and orthonormal. More than 3 axes do not span one space and allow
    /// no rotation.
    pub fn new(rotation: [[f64; N]; N], locked: [bool; N]) -> Result<Self, CouplingError> {
        let rotation = SMatrix::<f64, N, N>::from_fn(|row, column| rotation[row][column]);
        if N > 3 && rotation != Self::straight() {
            return Err(CouplingError::Rotation(N));
        }
        let off = (rotation.transpose() * rotation - Self::straight())
            .iter()
            .map(|element| if element.is_nan() { f64::INFINITY } else { element.abs() })
            .fold(0.0, f64::max);
        if off > ORTHONORMAL {
            return Err(CouplingError::Orthonormal(off));
        }
        Ok(Self::of(rotation, locked))
    }

    fn of(rotation: SMatrix<f64, N, N>, locked: [bool; N]) -> Self {
        Self { rotation: (rotation != Self::straight()).then_some(rotation), locked }
    }

    /// Build the map from a unit quaternion and the locked axes of the slave; missing locks are false,
    /// surplus locks are ignored.
    ///
    /// With 2 axes the rotation must be about z, which neither side has. With 1, 6 or 7 axes it must be the
    /// identity.
    pub fn rotated(quat_wxyz: [f64; 4], locked: &[bool]) -> Result<Self, CouplingError> {
        let [w, x, y, z] = normalised(quat_wxyz)?;
        let lies_in_space = match N {
            3 => true,
            2 => x == 0.0 && y == 0.0,
            _ => x == 0.0 && y == 0.0 && z == 0.0,
        };
        if !lies_in_space {
            return Err(CouplingError::Turn(N));
        }
        let rows = [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
            [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
            [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
        ];
        let rotation = SMatrix::<f64, N, N>::from_fn(|row, column| {
            if N <= 3 { rows[row][column] } else { f64::from(u8::from(row == column)) }
        });
        Ok(Self::of(rotation, std::array::from_fn(|axis| locked.get(axis).copied().unwrap_or(false))))
    }

    /// Build the map without a rotation.
    pub fn locking(locked: [bool; N]) -> Self {
        Self { locked, ..Self::default() }
    }

    fn straight() -> SMatrix<f64, N, N> {
        SMatrix::identity()
    }

    #[inline(always)] // once or twice per tick
    fn lock<S: Real>(&self, mut vector: Axes<N, S>) -> Axes<N, S> {
        for (value, locked) in vector.iter_mut().zip(self.locked) {
            if locked {
                *value = S::zero();
            }
        }
        vector
    }

    /// `L R v`: map a motion of the master to the slave.
    #[inline]
    pub fn to_slave<S: Real>(&self, of_master: &Axes<N, S>) -> Axes<N, S> {
        self.lock(match &self.rotation {
            Some(rotation) => turned(of_master, |row, column| rotation[(row, column)]),
            None => *of_master,
        })
    }

    /// `R' L f`: map a force on the slave to the master.
    #[inline]
    pub fn to_master<S: Real>(&self, of_slave: &Axes<N, S>) -> Axes<N, S> {
        let unlocked = self.lock(*of_slave);
        match &self.rotation {
            Some(rotation) => turned(&unlocked, |row, column| rotation[(column, row)]),
            None => unlocked,
        }
    }
}

/// Multiply a matrix by a vector.
#[inline(always)] // as its callers
fn turned<const N: usize, S: Real>(vector: &Axes<N, S>, element: impl Fn(usize, usize) -> f64) -> Axes<N, S> {
    Axes::from_fn(|row, _| {
        let first = vector[0] * S::splat(element(row, 0));
        (1..N).fold(first, |sum, column| sum + vector[column] * S::splat(element(row, column)))
    })
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

#[cfg(test)]
mod frame_tests {
    use super::*;
    use proptest::prelude::*;

    /// Rodrigues' formula for the axis `k` and the angle `a`.
    fn about(k: [f64; 3], a: f64) -> [[f64; 3]; 3] {
        let k = Axes::<3>::from(k).normalize();
        let cross = SMatrix::<f64, 3, 3>::new(0.0, -k[2], k[1], k[2], 0.0, -k[0], -k[1], k[0], 0.0);
        let matrix = SMatrix::<f64, 3, 3>::identity() + cross * a.sin() + cross * cross * (1.0 - a.cos());
        std::array::from_fn(|row| std::array::from_fn(|column| matrix[(row, column)]))
    }

    proptest! {
        #[test]
        fn power_is_the_same_on_both_sides(
            (axis, angle) in (prop::array::uniform3(0.1..1.0f64), -3.0..3.0f64),
            (velocity, force) in (prop::array::uniform3(-2.0..2.0f64), prop::array::uniform3(-9.0..9.0f64)),
            locked in prop::array::uniform3(any::<bool>()),
        ) {
            let map = FrameMap::new(about(axis, angle), locked).unwrap();
            let (velocity, force) = (Axes::<3>::from(velocity), Axes::<3>::from(force));
            let (moved, felt) = (map.to_slave(&velocity), map.to_master(&force));
            prop_assert!((felt.dot(&velocity) - force.dot(&moved)).abs() < 1e-12);
            for (axis, locked) in locked.into_iter().enumerate() {
                prop_assert!(!locked || moved[axis] == 0.0);
            }
            let elsewhere = Axes::<3>::from_fn(|axis, _| if locked[axis] { force[axis] } else { 0.0 });
            prop_assert_eq!(map.to_master(&elsewhere), Axes::<3>::zeros());
        }
    }

    #[test]
    fn identity_rotation_is_the_default_map() {
        let identity =
            FrameMap::new([[1.0, 0.0, -0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], [false; 3]).unwrap();
        let by_quaternion = FrameMap::<3>::rotated([1.0, 0.0, 0.0, 0.0], &[]).unwrap();
        assert_eq!([identity, by_quaternion], [FrameMap::default(); 2]);
        let force = Axes::<3>::new(1.0, -2.0, 3.0);
        assert_eq!([identity.to_slave(&force), identity.to_master(&force)], [force; 2]);
    }

    #[test]
    fn a_quarter_turn_goes_the_right_way() {
        let map = FrameMap::new([[0.0, -1.0], [1.0, 0.0]], [false; 2]).unwrap();
        assert_eq!(map.to_slave(&Axes::<2>::new(1.0, 0.0)), Axes::<2>::new(0.0, 1.0));
        assert_eq!(map.to_master(&Axes::<2>::new(0.0, 3.0)), Axes::<2>::new(3.0, 0.0));
    }

    /// Against Rodrigues' formula.
    #[test]
    fn a_quaternion_turns_as_its_axis_and_angle_do() {
        for (axis, angle) in [([0.0, 0.0, 1.0], 0.7_f64), ([1.0, -2.0, 0.5], 2.1), ([0.0, 1.0, 0.0], -3.0)] {
            let k = Axes::<3>::from(axis).normalize() * (0.5 * angle).sin();
            let quat_wxyz = [(0.5 * angle).cos(), k[0], k[1], k[2]];
            let turned = FrameMap::<3>::rotated(quat_wxyz, &[]).unwrap();
            let expected = FrameMap::new(about(axis, angle), [false; 3]).unwrap();
            let [turned, expected] = [turned, expected].map(|map| map.rotation.unwrap());
            assert!((turned - expected).abs().max() < 1e-14);
            FrameMap::new(std::array::from_fn(|row| std::array::from_fn(|c| turned[(row, c)])), [false; 3])
                .unwrap();
        }
        let half = std::f64::consts::FRAC_1_SQRT_2;
        let plane = FrameMap::<2>::rotated([half, 0.0, 0.0, half], &[false, true]).unwrap();
        assert!((plane.to_slave(&Axes::<2>::new(0.0, 1.0)) - Axes::<2>::new(-1.0, 0.0)).norm() < 1e-15);
        assert_eq!(plane.to_slave(&Axes::<2>::new(1.0, 0.0))[1], 0.0, "locked");
        assert_eq!(FrameMap::<6>::rotated([-1.0, 0.0, 0.0, 0.0], &[]), Ok(FrameMap::default()));
        for (refused, text) in [
            (
                FrameMap::<2>::rotated([half, half, 0.0, 0.0], &[]).map(|_| ()).unwrap_err(),
                "a rotation of 2 axes",
            ),
            (
                FrameMap::<1>::rotated([half, 0.0, 0.0, half], &[]).map(|_| ()).unwrap_err(),
                "a rotation of 1 axes",
            ),
            (
                FrameMap::<6>::rotated([0.0, 0.0, 0.0, 1.0], &[]).map(|_| ()).unwrap_err(),
                "a rotation of 6 axes",
            ),
            (FrameMap::<3>::rotated([0.5; 4].map(|w| 2.0 * w), &[]).map(|_| ()).unwrap_err(), "norm of 2"),
            (FrameMap::<3>::rotated([f64::NAN; 4], &[]).map(|_| ()).unwrap_err(), "norm of NaN"),
        ] {
            assert!(refused.to_string().contains(text), "{refused}");
        }
    }

    #[test]
    fn invalid_rotations_are_refused() {
        for rows in [[[1.0, 0.0], [0.1, 1.0]], [[2.0, 0.0], [0.0, 0.5]], [[f64::NAN, 0.0], [0.0, 1.0]]] {
            assert!(matches!(FrameMap::new(rows, [false; 2]), Err(CouplingError::Orthonormal(_))));
        }
        let mut rows = [[0.0; 6]; 6];
        for axis in 0..6 {
            rows[axis][(axis + 1) % 6] = 1.0;
        }
        let error = FrameMap::new(rows, [false; 6]).unwrap_err();
        assert_eq!(error.to_string(), "rotation of 6 axes: must be of at most 3");
    }
}

#[cfg(test)]
mod energy_tests {
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
