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
