//! Position-force coupling with measured force (`PFm`).

use haptether_safety::{Axes, Real};

use super::{CouplingError, FrameMap};
use crate::{command::OperatorCommand, lanes::packed};

/// The slave follows the master's position; the master renders the force that the slave measures.
///
/// `x_s = x_s0 + lambda_p L R (x_m - x_m0)`, `F_v = lambda_f R' L F_e`, with R and L of [`FrameMap`].
///
/// `x_m0` and `x_s0` are taken when the two engage, so the slave never jumps; they are taken anew when the scale or the
/// map changes. Under a round trip T the hand feels
/// the remote stiffness `lambda_f lambda_p K_e` late; with a hand of impedance `K_h - m w² + j w B_h` it is stable
/// for every T if `lambda_f lambda_p K_e < min_w |K_h - m w² + j w B_h|` (small gain).
///
/// Source: Hannaford 1989; Lawrence 1993 ("position-force"); the condition by the small-gain theorem.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PositionForce<const N: usize, S = f64> {
    position_scale: S,
    force_scale: S,
    map: FrameMap<N>,
    anchor: Option<(Axes<N, S>, Axes<N, S>)>,
}

pub(super) fn check(name: &'static str, symbol: &'static str, seen: f64) -> Result<f64, CouplingError> {
    if seen.is_finite() && seen > 0.0 { Ok(seen) } else { Err(CouplingError::scale(name, symbol, seen)) }
}

impl<const N: usize> PositionForce<N> {
    /// Scales `lambda_p` and `lambda_f` (> 0).
    pub fn new(position_scale: f64, force_scale: f64) -> Result<Self, CouplingError> {
        Ok(Self {
            position_scale: check("position_scale", "lambda_p", position_scale)?,
            force_scale: check("force_scale", "lambda_f", force_scale)?,
            map: FrameMap::default(),
            anchor: None,
        })
    }
}

impl<const N: usize, S: Real> PositionForce<N, S> {
    /// Couplings side by side, none of which has engaged, under the same map; else None.
    pub(crate) fn gather(of: &[&PositionForce<N>]) -> Option<Self> {
        let map = of.first()?.map;
        of.iter().all(|one| one.map == map && one.anchor.is_none()).then(|| Self {
            position_scale: packed(of, |one| one.position_scale),
            force_scale: packed(of, |one| one.force_scale),
            map,
            anchor: None,
        })
    }

    /// Changes `lambda_p`; the slave goes on from where it is.
    pub fn set_position_scale(&mut self, scale: f64) -> Result<(), CouplingError> {
        self.position_scale = S::splat(check("position_scale", "lambda_p", scale)?);
        self.disengage();
        Ok(())
    }

    /// Changes `lambda_f`; how fast the force follows is the limiter's.
    pub fn set_force_scale(&mut self, scale: f64) -> Result<(), CouplingError> {
        self.force_scale = S::splat(check("force_scale", "lambda_f", scale)?);
        Ok(())
    }

    /// Changes rotation and locks; the slave goes on from where it is.
    pub fn set_map(&mut self, map: FrameMap<N>) {
        self.map = map;
        self.disengage();
    }

    /// Carries out a command of the operator at the master; returns whether it was one of this half.
    pub(crate) fn command_at_master(&mut self, command: OperatorCommand) -> Result<bool, CouplingError> {
        match command {
            OperatorCommand::ForceScale(scale) => self.set_force_scale(scale)?,
            OperatorCommand::Frame { quat_wxyz, locked } => {
                self.set_map(FrameMap::rotated(quat_wxyz, &locked)?);
            }
            _ => return Ok(false),
        }
        Ok(true)
    }

    /// The same at the slave, which goes on from where it is.
    pub(crate) fn command_at_slave(&mut self, command: OperatorCommand) -> Result<bool, CouplingError> {
        match command {
            OperatorCommand::PositionScale(scale) => self.set_position_scale(scale)?,
            OperatorCommand::Frame { quat_wxyz, locked } => {
                self.set_map(FrameMap::rotated(quat_wxyz, &locked)?);
            }
            _ => return Ok(false),
        }
        Ok(true)
    }

    /// Master half: `F_v` in N from the newest `F_e` in N.
    pub fn rendered_force(&self, environment_force: &Axes<N, S>) -> Axes<N, S> {
        self.map.to_master(environment_force) * self.force_scale
    }

    /// Slave half: the position to command, in m, from the newest `x_m` in m; the first call since
    /// [`disengage`](Self::disengage) engages at `slave_position`.
    pub fn commanded_position(
        &mut self,
        master_position: &Axes<N, S>,
        slave_position: &Axes<N, S>,
    ) -> Axes<N, S> {
        let (master, slave) = *self.anchor.get_or_insert((*master_position, *slave_position));
        slave + self.map.to_slave(&(master_position - master)) * self.position_scale
    }

    /// Slave half: the velocity of the commanded position, in m/s, from the newest V in m/s.
    pub fn commanded_velocity(&self, master_velocity: &Axes<N, S>) -> Axes<N, S> {
        self.map.to_slave(master_velocity) * self.position_scale
    }

    /// The two are no longer coupled.
    pub fn disengage(&mut self) {
        self.anchor = None;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn engages_where_both_are_and_scales_from_there() {
        let mut coupling = PositionForce::<2>::new(2.0, 0.5).unwrap();
        let slave = Axes::<2>::new(1.0, -1.0);
        assert_eq!(coupling.commanded_position(&Axes::<2>::new(0.3, 0.1), &slave), slave);
        let command = coupling.commanded_position(&Axes::<2>::new(0.4, 0.1), &Axes::<2>::zeros());
        assert!((command - Axes::<2>::new(1.2, -1.0)).norm() < 1e-15);
        assert_eq!(coupling.rendered_force(&Axes::<2>::new(4.0, -2.0)), Axes::<2>::new(2.0, -1.0));
        coupling.disengage();
        let elsewhere = Axes::<2>::new(5.0, 5.0);
        assert_eq!(coupling.commanded_position(&Axes::<2>::new(9.0, 9.0), &elsewhere), elsewhere);
    }

    #[test]
    fn a_change_of_scale_or_axes_moves_nothing_by_itself() {
        let mut coupling = PositionForce::<2>::new(1.0, 1.0).unwrap();
        let mut command = coupling.commanded_position(&Axes::<2>::zeros(), &Axes::<2>::new(1.0, 1.0));
        let hand = Axes::<2>::new(0.5, -0.2);
        command = coupling.commanded_position(&hand, &command);
        coupling.set_position_scale(3.0).unwrap();
        assert_eq!(coupling.commanded_position(&hand, &command), command);
        coupling.set_map(FrameMap::locking([true, false]));
        assert_eq!(coupling.commanded_position(&hand, &command), command);
        let moved = coupling.commanded_position(&(hand + Axes::<2>::new(0.1, 0.1)), &command);
        assert!((moved - command - Axes::<2>::new(0.0, 0.3)).norm() < 1e-15);
        coupling.set_force_scale(2.0).unwrap();
        assert_eq!(coupling.rendered_force(&Axes::<2>::new(4.0, 1.0)), Axes::<2>::new(0.0, 2.0));
        assert!(coupling.set_force_scale(f64::NAN).is_err() && coupling.set_position_scale(0.0).is_err());
    }

    #[test]
    fn refuses_scales_that_couple_nothing() {
        for (p, f) in [(0.0, 1.0), (1.0, -1.0), (f64::NAN, 1.0), (1.0, f64::INFINITY)] {
            assert!(PositionForce::<1>::new(p, f).is_err());
        }
    }
}
