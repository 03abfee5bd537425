//! How the axes of the slave stand to those of the master: rotation and locks.

use haptether_safety::Axes;
use nalgebra::SMatrix;

use super::CouplingError;

/// Rotation between master and slave, and the slave's axes that do not follow.
///
/// `V_s = lambda_p L R V_m`, `F_v = lambda_f R' L F_e`, with R orthonormal and L diagonal of 0 and 1. Then
/// `F_v · V_m = (lambda_f / lambda_p) F_e · V_s`: no power is made or lost beyond the scales.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FrameMap<const N: usize> {
    rotation: SMatrix<f64, N, N>,
    locked: [bool; N],
}

impl<const N: usize> Default for FrameMap<N> {
    fn default() -> Self {
        Self { rotation: SMatrix::identity(), locked: [false; N] }
    }
}

/// How far the norm of a quaternion may be from 1: digits that a person left out.
const UNIT: f64 = 1e-6;

/// How far R' R may be from the identity, in its largest element.
const ORTHONORMAL: f64 = 1e-9;

impl<const N: usize> FrameMap<N> {
    /// With R as rows, orthonormal; for at most 3 axes, because more are no axes of one space.
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
        Ok(Self { rotation, locked })
    }

    /// With R of a unit quaternion, and the slave's axes that are locked, those beyond N left out.
    ///
    /// With 2 axes the rotation is about z, which neither has; of 1, 6 or 7 axes there is none.
    pub fn turned(quat_wxyz: [f64; 4], locked: &[bool]) -> Result<Self, CouplingError> {
        let norm = quat_wxyz.iter().map(|part| part * part).sum::<f64>().sqrt();
        if norm.is_nan() || (norm - 1.0).abs() > UNIT {
            return Err(CouplingError::Quaternion(norm));
        }
        let [w, x, y, z] = quat_wxyz.map(|part| part / norm);
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
        let locked = std::array::from_fn(|axis| locked.get(axis).copied().unwrap_or(false));
        Ok(Self { rotation, locked })
    }

    /// Without a rotation.
    pub fn locking(locked: [bool; N]) -> Self {
        Self { locked, ..Self::default() }
    }

    fn straight() -> SMatrix<f64, N, N> {
        SMatrix::identity()
    }

    fn lock(&self, mut vector: Axes<N>) -> Axes<N> {
        for (value, locked) in vector.iter_mut().zip(self.locked) {
            if locked {
                *value = 0.0;
            }
        }
        vector
    }

    /// `L R v`: a motion of the master as one of the slave.
    pub fn to_slave(&self, of_master: &Axes<N>) -> Axes<N> {
        if self.rotation == Self::straight() {
            return self.lock(*of_master);
        }
        self.lock(self.rotation * of_master)
    }

    /// `R' L f`: a force on the slave as one on the master.
    pub fn to_master(&self, of_slave: &Axes<N>) -> Axes<N> {
        let unlocked = self.lock(*of_slave);
        if self.rotation == Self::straight() {
            return unlocked;
        }
        self.rotation.transpose() * unlocked
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Rodrigues' formula, for an axis along `k` and the angle `a`.
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
            let turned = FrameMap::<3>::turned(quat_wxyz, &[]).unwrap();
            let expected = FrameMap::new(about(axis, angle), [false; 3]).unwrap();
            assert!((turned.rotation - expected.rotation).abs().max() < 1e-14);
            FrameMap::new(
                std::array::from_fn(|row| std::array::from_fn(|c| turned.rotation[(row, c)])),
                [false; 3],
            )
            .unwrap();
        }
        let half = std::f64::consts::FRAC_1_SQRT_2;
        let plane = FrameMap::<2>::turned([half, 0.0, 0.0, half], &[false, true]).unwrap();
        assert!((plane.to_slave(&Axes::<2>::new(0.0, 1.0)) - Axes::<2>::new(-1.0, 0.0)).norm() < 1e-15);
        assert_eq!(plane.to_slave(&Axes::<2>::new(1.0, 0.0))[1], 0.0, "locked");
        assert_eq!(FrameMap::<6>::turned([-1.0, 0.0, 0.0, 0.0], &[]), Ok(FrameMap::default()));
        for (refused, told) in [
            (
                FrameMap::<2>::turned([half, half, 0.0, 0.0], &[]).map(|_| ()).unwrap_err(),
                "a rotation of 2 axes",
            ),
            (
                FrameMap::<1>::turned([half, 0.0, 0.0, half], &[]).map(|_| ()).unwrap_err(),
                "a rotation of 1 axes",
            ),
            (
                FrameMap::<6>::turned([0.0, 0.0, 0.0, 1.0], &[]).map(|_| ()).unwrap_err(),
                "a rotation of 6 axes",
            ),
            (FrameMap::<3>::turned([0.5; 4].map(|w| 2.0 * w), &[]).map(|_| ()).unwrap_err(), "norm of 2"),
            (FrameMap::<3>::turned([f64::NAN; 4], &[]).map(|_| ()).unwrap_err(), "norm of NaN"),
        ] {
            assert!(refused.to_string().contains(told), "{refused}");
        }
    }

    #[test]
    fn what_is_no_rotation_is_refused() {
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
