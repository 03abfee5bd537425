//! Frame map, scales and anchor between the sides: both halves of the coupling position-force (`PFm`).

use haptether_numeric::pack;
use haptether_safety::{Axes, Real};

use super::{CouplingError, FrameMap, change::Changing};
use crate::command::OperatorCommand;

/// Map between the motions and forces of both sides, with its anchor. Every coupling goes through it.
///
/// The coupling position-force is this map alone: the slave follows the master's position; the master renders the force
/// that the slave measures.
///
/// `x_s = x_s0 + lambda_p L R (x_m - x_m0)`, `F_v = lambda_f R' L F_e`, with R and L of [`FrameMap`].
///
/// The two sides set `x_m0` and `x_s0` when they engage, so the slave never jumps. While the scale or the map
/// changes, they are set again at each tick, so that neither position nor velocity has a step.
///
/// With a round trip T the hand feels the remote stiffness `lambda_f lambda_p K_e` with a delay. For a
/// hand of impedance `K_h - m w² + j w B_h` this is stable for every T if
/// `lambda_f lambda_p K_e < min_w |K_h - m w² + j w B_h|` (small gain).
///
/// Source: Hannaford 1989; Lawrence 1993 ("position-force"); the condition by the small-gain theorem.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Mapping<const N: usize, S = f64> {
    /// `lambda_p`, `lambda_f`, R and L.
    change: Changing<FrameMap<N>, S>,
    anchor: Option<(Axes<N, S>, Axes<N, S>)>,
}

pub(super) fn check(name: &'static str, symbol: &'static str, seen: f64) -> Result<f64, CouplingError> {
    if seen.is_finite() && seen > 0.0 { Ok(seen) } else { Err(CouplingError::scale(name, symbol, seen)) }
}

impl<const N: usize> Mapping<N> {
    /// Build the coupling with scales `lambda_p` and `lambda_f` (> 0).
    pub fn new(position_scale: f64, force_scale: f64) -> Result<Self, CouplingError> {
        let motion = check("position_scale", "lambda_p", position_scale)?;
        let force = check("force_scale", "lambda_f", force_scale)?;
        Ok(Self { change: Changing::new(motion, force, FrameMap::default()), anchor: None })
    }
}

impl<const N: usize> Mapping<N> {
    /// Rotation and locks at this tick.
    pub(super) fn map(&self) -> &FrameMap<N> {
        &self.change.map
    }

    /// Map a force of the device in N to the slave's frame, where a force of this size would have requested it.
    pub(crate) fn coupled_force(&self, of_device: &Axes<N>) -> Axes<N> {
        let Changing { force, ref map, .. } = self.change;
        if force > 0.0 { map.to_slave(of_device) / force } else { Axes::zeros() }
    }

    /// Map a displacement of the slave in m to the master's frame. Fades of a changing map do not apply.
    pub(super) fn back(&self, of_slave: &Axes<N>) -> Axes<N> {
        self.change.map.to_master(of_slave) / self.change.unfaded_motion()
    }
}

impl<const N: usize, S: Real> Mapping<N, S> {
    /// Gather couplings into lanes. Returns `None` if one has engaged or is changing, or if the maps differ.
    pub(crate) fn gather(of: &[&Mapping<N>]) -> Option<Self> {
        let map = of.first()?.change.map;
        let begins = |one: &&Mapping<N>| one.change.map == map && !one.change.moves && one.anchor.is_none();
        let [motion, force] = [pack(of, |one| one.change.motion)?, pack(of, |one| one.change.force)?];
        of.iter().all(begins).then(|| Self { change: Changing::new(motion, force, map), anchor: None })
    }

    /// Change `lambda_p` over `ticks` ticks, 0 means at once. The slave continues from its present position.
    pub fn set_position_scale(&mut self, scale: f64, ticks: u32) -> Result<(), CouplingError> {
        self.change.set_motion(S::splat(check("position_scale", "lambda_p", scale)?), ticks);
        self.drop_anchor(ticks);
        Ok(())
    }

    /// Change `lambda_f` over `ticks` ticks, 0 means at once.
    pub fn set_force_scale(&mut self, scale: f64, ticks: u32) -> Result<(), CouplingError> {
        self.change.set_force(S::splat(check("force_scale", "lambda_f", scale)?), ticks);
        Ok(())
    }

    /// Change rotation and locks: both scales fade out and in over `ticks` ticks each, 0 means at once. The
    /// slave continues from its present position.
    pub fn set_map(&mut self, map: FrameMap<N>, ticks: u32) {
        self.change.set_map(map, ticks);
        self.drop_anchor(ticks);
    }

    /// Drop the anchor after an immediate change, so that the slave continues from its present position.
    fn drop_anchor(&mut self, ticks: u32) {
        if ticks == 0 {
            self.anchor = None;
        }
    }

    /// Carry out an operator command at the master over `ticks` ticks; return whether it concerns this half.
    pub(crate) fn command_at_master(
        &mut self,
        command: OperatorCommand,
        ticks: u32,
    ) -> Result<bool, CouplingError> {
        match command {
            OperatorCommand::ForceScale(scale) => self.set_force_scale(scale, ticks)?,
            OperatorCommand::Frame { quat_wxyz, locked } => {
                self.set_map(FrameMap::rotated(quat_wxyz, &locked)?, ticks);
            }
            _ => return Ok(false),
        }
        Ok(true)
    }

    /// Carry out an operator command at the slave, which continues from its present position.
    pub(crate) fn command_at_slave(
        &mut self,
        command: OperatorCommand,
        ticks: u32,
    ) -> Result<bool, CouplingError> {
        match command {
            OperatorCommand::PositionScale(scale) => self.set_position_scale(scale, ticks)?,
            OperatorCommand::Frame { quat_wxyz, locked } => {
                self.set_map(FrameMap::rotated(quat_wxyz, &locked)?, ticks);
            }
            _ => return Ok(false),
        }
        Ok(true)
    }

    /// Step the changes by one tick of the master.
    #[inline]
    pub(crate) fn advance(&mut self) {
        if self.change.moves {
            self.change.step();
        }
    }

    /// Master half: `F_v` in N from the newest `F_e` in N.
    pub fn rendered_force(&self, environment_force: &Axes<N, S>) -> Axes<N, S> {
        self.change.map.to_master(environment_force) * self.change.force
    }

    /// Slave half: commanded position in m from the newest `x_m` in m. The first call after
    /// [`disengage`](Self::disengage) engages at `slave_position`. Each call steps the changes by one tick.
    pub fn commanded_position(
        &mut self,
        master_position: &Axes<N, S>,
        slave_position: &Axes<N, S>,
    ) -> Axes<N, S> {
        let (master, slave) = *self.anchor.get_or_insert((*master_position, *slave_position));
        let wanted = slave + self.change.map.to_slave(&(master_position - master)) * self.change.motion;
        if self.change.moves {
            self.change.step();
            self.anchor = Some((*master_position, wanted));
        }
        wanted
    }

    /// Slave half: velocity of the commanded position in m/s, from the newest V in m/s.
    pub fn commanded_velocity(&self, master_velocity: &Axes<N, S>) -> Axes<N, S> {
        self.change.map.to_slave(master_velocity) * self.change.motion
    }

    /// End the coupling and complete all changes.
    pub fn disengage(&mut self) {
        self.anchor = None;
        if self.change.moves {
            self.change.settle();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Change of a coupling at a tick.
    type Changing<'a> = &'a dyn Fn(&mut Mapping<1>, u32);

    #[test]
    fn engages_where_both_are_and_scales_from_there() {
        let mut coupling = Mapping::<2>::new(2.0, 0.5).unwrap();
        let slave = Axes::<2>::new(1.0, -1.0);
        assert_eq!(coupling.commanded_position(&Axes::<2>::new(0.3, 0.1), &slave), slave);
        let command = coupling.commanded_position(&Axes::<2>::new(0.4, 0.1), &Axes::<2>::zeros());
        assert!((command - Axes::<2>::new(1.2, -1.0)).norm() < 1e-15);
        assert_eq!(coupling.rendered_force(&Axes::<2>::new(4.0, -2.0)), Axes::<2>::new(2.0, -1.0));
        coupling.disengage();
        let elsewhere = Axes::<2>::new(5.0, 5.0);
        assert_eq!(coupling.commanded_position(&Axes::<2>::new(9.0, 9.0), &elsewhere), elsewhere);
    }

    /// At once, as while uncoupled, and over 4 ticks: the command never jumps, and its velocity has no step.
    #[test]
    fn a_change_of_scale_or_axes_moves_nothing_by_itself() {
        for ticks in [0, 4] {
            let mut coupling = Mapping::<2>::new(1.0, 1.0).unwrap();
            let mut command = coupling.commanded_position(&Axes::<2>::zeros(), &Axes::<2>::new(1.0, 1.0));
            let hand = Axes::<2>::new(0.5, -0.2);
            command = coupling.commanded_position(&hand, &command);
            coupling.set_position_scale(3.0, ticks).unwrap();
            for _ in 0..=ticks {
                assert!((coupling.commanded_position(&hand, &command) - command).norm() < 1e-15);
            }
            coupling.set_map(FrameMap::locking([true, false]), ticks);
            for _ in 0..=2 * ticks {
                assert!((coupling.commanded_position(&hand, &command) - command).norm() < 1e-15);
            }
            let moved = coupling.commanded_position(&(hand + Axes::<2>::new(0.1, 0.1)), &command);
            assert!((moved - command - Axes::<2>::new(0.0, 0.3)).norm() < 1e-15);
            coupling.set_force_scale(2.0, ticks).unwrap();
            (0..ticks).for_each(|_| coupling.advance());
            assert_eq!(coupling.rendered_force(&Axes::<2>::new(4.0, 1.0)), Axes::<2>::new(0.0, 2.0));
            assert!(coupling.set_force_scale(f64::NAN, ticks).is_err());
            assert!(coupling.set_position_scale(0.0, ticks).is_err());
        }
    }

    /// Steps of command and force for a hand of constant velocity, written by hand:
    /// `lambda(k) = lambda_0 + (lambda - lambda_0) k / n`. A second change starts at the present value. A map
    /// fades out and in.
    #[test]
    fn changes_fade_tick_by_tick() {
        let steps = |change: &dyn Fn(&mut Mapping<1>, u32)| -> Vec<[f64; 2]> {
            let mut slave = Mapping::<1>::new(1.0, 1.0).unwrap();
            let mut master = slave;
            let mut before = slave.commanded_position(&Axes::<1>::zeros(), &Axes::<1>::zeros());
            (1..=10)
                .map(|tick| {
                    change(&mut slave, tick);
                    change(&mut master, tick);
                    let velocity = slave.commanded_velocity(&Axes::<1>::new(1.0))[0];
                    let command =
                        slave.commanded_position(&Axes::<1>::new(f64::from(tick)), &Axes::<1>::zeros());
                    let force = master.rendered_force(&Axes::<1>::new(1.0))[0];
                    master.advance();
                    let step = (command - before)[0];
                    assert!((step - velocity).abs() < 1e-12, "{tick}: {step} {velocity}");
                    before = command;
                    [step, force]
                })
                .collect()
        };
        let scale = |coupling: &mut Mapping<1>, to: f64| {
            coupling.set_position_scale(to, 4).unwrap();
            coupling.set_force_scale(to, 4).unwrap();
        };
        let locked = FrameMap::locking([true]);
        let cases: [(Changing<'_>, [f64; 10]); 3] = [
            (
                &|one, tick| {
                    if tick == 3 {
                        scale(one, 2.0);
                    }
                },
                [1.0, 1.0, 1.0, 1.25, 1.5, 1.75, 2.0, 2.0, 2.0, 2.0],
            ),
            (
                &|one, tick| {
                    if tick == 2 {
                        scale(one, 2.0);
                    } else if tick == 4 {
                        scale(one, 0.5);
                    }
                },
                [1.0, 1.0, 1.25, 1.5, 1.25, 1.0, 0.75, 0.5, 0.5, 0.5],
            ),
            (
                &|one, tick| {
                    if tick == 2 {
                        one.set_map(locked, 2);
                    } else if tick == 5 {
                        one.set_map(FrameMap::default(), 2);
                    }
                },
                [1.0, 1.0, 0.5, 0.0, 0.0, 0.0, 0.0, 0.5, 1.0, 1.0],
            ),
        ];
        for (case, (change, expected)) in cases.into_iter().enumerate() {
            for (tick, (seen, expected)) in steps(change).into_iter().zip(expected).enumerate() {
                for seen in seen {
                    assert!((seen - expected).abs() < 1e-12, "{case} at {}: {seen} {expected}", tick + 1);
                }
            }
        }
    }

    /// After the sides part, the changes are complete, so the next engagement uses the commanded values.
    #[test]
    fn disengaging_completes_changes() {
        let mut coupling = Mapping::<1>::new(1.0, 1.0).unwrap();
        coupling.commanded_position(&Axes::<1>::zeros(), &Axes::<1>::zeros());
        coupling.set_position_scale(2.0, 100).unwrap();
        coupling.set_map(FrameMap::locking([false]), 100);
        coupling.disengage();
        assert_eq!(coupling.commanded_velocity(&Axes::<1>::new(1.0))[0], 2.0);
    }

    #[test]
    fn invalid_scales_are_refused() {
        for (p, f) in [(0.0, 1.0), (1.0, -1.0), (f64::NAN, 1.0), (1.0, f64::INFINITY)] {
            assert!(Mapping::<1>::new(p, f).is_err());
        }
    }
}
