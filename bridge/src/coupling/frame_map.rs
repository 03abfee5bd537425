//! Rotation between master and slave, and locked axes.

use haptether_safety::{Axes, Real};
use nalgebra::SMatrix;

use super::CouplingError;

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
pub(super) const UNIT: f64 = 1e-6;

/// Tolerance of the largest element of R' R minus the identity.
const ORTHONORMAL: f64 = 1e-9;

/// Normalise a quaternion written by hand; its norm must be 1 to within [`UNIT`].
pub(super) fn normalised(quat_wxyz: [f64; 4]) -> Result<[f64; 4], CouplingError> {
    let norm = quat_wxyz.iter().map(|part| part * part).sum::<f64>().sqrt();
    if norm.is_nan() || (norm - 1.0).abs() > UNIT {
        return Err(CouplingError::Quaternion(norm));
    }
    Ok(quat_wxyz.map(|part| part / norm))
}

impl<const N: usize> FrameMap<N> {
    /// Build the map from R, given as rows and orthonormal. With more than 3 axes, which do not
    /// span one space, R must be the identity.
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
    /// With 2 axes (x and y) the rotation must be about z. With 1 axis, or more than 3, it must be the
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
#[inline(always)] // once or twice per tick
fn turned<const N: usize, S: Real>(vector: &Axes<N, S>, element: impl Fn(usize, usize) -> f64) -> Axes<N, S> {
    Axes::from_fn(|row, _| {
        let first = vector[0] * S::splat(element(row, 0));
        (1..N).fold(first, |sum, column| sum + vector[column] * S::splat(element(row, column)))
    })
}

#[cfg(test)]
mod tests {
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
                "quat_wxyz with 2 axes",
            ),
            (
                FrameMap::<1>::rotated([half, 0.0, 0.0, half], &[]).map(|_| ()).unwrap_err(),
                "quat_wxyz with 1 axes",
            ),
            (
                FrameMap::<6>::rotated([0.0, 0.0, 0.0, 1.0], &[]).map(|_| ()).unwrap_err(),
                "quat_wxyz with 6 axes",
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
