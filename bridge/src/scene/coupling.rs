//! Operator commands from `[coupling]`, and the coupling at a given time.

use haptether_numeric::pack;
use haptether_safety::{Axes, Real};

use super::{
    assemble::{SceneError, contradiction, ns},
    spec::{ChangeSpec, CouplingSpec},
};
use crate::{
    EndpointError, OperatorCommand,
    coupling::{CouplingError, FrameMap},
};

/// Return rotation and locks as one command.
fn frame<const N: usize>(quat_wxyz: [f64; 4], locked_axes: &[usize]) -> Result<OperatorCommand, SceneError> {
    let mut locked = [false; 7];
    for &axis in locked_axes {
        if axis >= N {
            return contradiction(format!(
                "coupling.locked_axes: {axis}, must be below {N}, the number of axes"
            ));
        }
        locked[axis] = true;
    }
    Ok(OperatorCommand::Frame { quat_wxyz, locked })
}

/// Return the commands of both sides with their times in ns since the start: rotation and locks first, then the
/// changes.
pub(crate) fn commands<const N: usize>(
    spec: &CouplingSpec,
) -> Result<Vec<(u64, OperatorCommand)>, SceneError> {
    let (mut quat_wxyz, mut locked_axes) = (spec.quat_wxyz, &spec.locked_axes);
    let mut commands = vec![(0, frame::<N>(quat_wxyz, locked_axes)?)];
    let mut before_s = 0.0;
    for (index, change) in spec.changes.iter().enumerate() {
        let ChangeSpec { at_s, position_scale, force_scale, rotation_scale, torque_scale, .. } = change;
        if at_s.is_nan() || *at_s < before_s {
            return contradiction(format!(
                "coupling.changes.{index}.at_s = {at_s}: must be at least {before_s}"
            ));
        }
        before_s = *at_s;
        let mut add = |command| commands.push((ns(*at_s), command));
        if let Some(scale) = position_scale {
            add(OperatorCommand::PositionScale(*scale));
        }
        if let Some(scale) = force_scale {
            add(OperatorCommand::ForceScale(*scale));
        }
        if let Some(scale) = rotation_scale {
            add(OperatorCommand::RotationScale(*scale));
        }
        if let Some(scale) = torque_scale {
            add(OperatorCommand::TorqueScale(*scale));
        }
        if let Some(kind) = change.kind {
            let kinds = spec.alternatives.iter().map(|one| one.kind);
            if kinds.chain([spec.numbers.kind]).all(|one| one != kind) {
                return contradiction(format!(
                    "coupling.changes.{index}.kind = {:?}: must be that of [coupling] or of one of its alternatives",
                    kind.name()
                ));
            }
            add(OperatorCommand::Coupling(kind));
        }
        if change.quat_wxyz.is_some() || change.locked_axes.is_some() {
            quat_wxyz = change.quat_wxyz.unwrap_or(quat_wxyz);
            locked_axes = change.locked_axes.as_ref().unwrap_or(locked_axes);
            add(frame::<N>(quat_wxyz, locked_axes)?);
        }
    }
    for (_, command) in &commands {
        command.check::<N>().map_err(EndpointError::from)?;
    }
    Ok(commands)
}

/// Coupling at a given time; a run is measured against it.
#[derive(Clone)]
pub(crate) struct Present<const N: usize, S = f64> {
    map: FrameMap<N>,
    position_scale: S,
    force_scale: S,
    commands: Vec<(u64, OperatorCommand)>,
    done: usize,
}

impl<const N: usize> Present<N> {
    /// Build the initial coupling; `commands` are in order of time.
    pub(crate) fn new(spec: &CouplingSpec, commands: Vec<(u64, OperatorCommand)>) -> Self {
        let CouplingSpec { position_scale, force_scale, .. } = *spec;
        Self { map: FrameMap::default(), position_scale, force_scale, commands, done: 0 }
    }

    /// Return the largest `lambda_p` of the whole run.
    pub(crate) fn max_position_scale(&self) -> f64 {
        self.commands.iter().fold(self.position_scale, |max, (_, command)| match command {
            OperatorCommand::PositionScale(scale) => max.max(*scale),
            _ => max,
        })
    }
}

impl<const N: usize, S: Real> Present<N, S> {
    /// Combine initial couplings into lanes; None unless their commands are equal.
    pub(crate) fn gather(of: &[&Present<N>]) -> Option<Self> {
        let first = of.first()?;
        if !of.iter().all(|one| one.done == 0 && one.commands == first.commands) {
            return None;
        }
        Some(Self {
            map: first.map,
            position_scale: pack(of, |one| one.position_scale)?,
            force_scale: pack(of, |one| one.force_scale)?,
            commands: first.commands.clone(),
            done: 0,
        })
    }

    /// Return the number of commands taken so far.
    pub(crate) fn done(&self) -> usize {
        self.done
    }

    /// Return the commands taken after the first `before` ones.
    pub(crate) fn since(&self, before: usize) -> impl Iterator<Item = &OperatorCommand> {
        self.commands[before..self.done].iter().map(|(_, command)| command)
    }

    /// Return true if a command is due at `now_ns`.
    #[inline]
    pub(crate) fn is_due(&self, now_ns: u64) -> bool {
        self.commands.get(self.done).is_some_and(|(at_ns, _)| *at_ns <= now_ns)
    }

    /// Take the commands due at `now_ns`; return true if there was one.
    pub(crate) fn advance(&mut self, now_ns: u64) -> Result<bool, CouplingError> {
        let before = self.done;
        while let Some((_, command)) = self.commands.get(self.done).filter(|(at, _)| *at <= now_ns) {
            match command {
                OperatorCommand::PositionScale(scale) => self.position_scale = S::splat(*scale),
                OperatorCommand::ForceScale(scale) => self.force_scale = S::splat(*scale),
                OperatorCommand::Frame { quat_wxyz, locked } => {
                    self.map = FrameMap::rotated(*quat_wxyz, locked)?;
                }
                _ => {}
            }
            self.done += 1;
        }
        Ok(self.done > before)
    }

    /// Map a motion of the master to the slave: `lambda_p L R v`.
    pub(crate) fn to_slave(&self, of_master: &Axes<N, S>) -> Axes<N, S> {
        self.map.to_slave(of_master) * self.position_scale
    }

    /// Map a force of the slave to the master: `lambda_f R' L f`.
    pub(crate) fn to_master(&self, of_slave: &Axes<N, S>) -> Axes<N, S> {
        self.map.to_master(of_slave) * self.force_scale
    }
}
