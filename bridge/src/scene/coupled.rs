//! From the numbers of `[coupling]` and `[safety.ladder]` to what the endpoints have.

use haptether_safety::Axes;

use super::{
    assemble::SceneError,
    spec::{ChangeSpec, CouplingSpec, LadderSpec},
};
use crate::{
    EndpointError, LadderSettings, OperatorCommand,
    coupling::{CommandBounds, CouplingError, FrameMap},
};

/// A time of a scene in ns.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // not negative, and saturates
fn ns(seconds: f64) -> u64 {
    (seconds * 1e9).round() as u64
}

/// Times of the ladder; the defaults where a scene has none.
pub(crate) fn ladder(spec: Option<&LadderSpec>) -> Result<LadderSettings, SceneError> {
    let Some(spec) = spec else { return Ok(LadderSettings::default()) };
    let settings = LadderSettings {
        stale_after_ns: ns(spec.stale_after_s),
        hold_after_ns: ns(spec.hold_after_s),
        stop_after_ns: ns(spec.stop_after_s),
        extrapolate_ns: ns(spec.extrapolate_s),
        fade_out_ns: ns(spec.fade_out_s),
        fade_in_ns: ns(spec.fade_in_s),
        ..LadderSettings::default()
    };
    settings.check().map_err(EndpointError::from)?;
    Ok(settings)
}

/// What the slave takes of a remote command.
pub(crate) fn bounds(spec: &CouplingSpec) -> CommandBounds {
    CommandBounds {
        speed: spec.command_speed.unwrap_or(f64::INFINITY),
        reach: spec.command_reach.unwrap_or(f64::INFINITY),
    }
}

/// Rotation and locks as one act.
fn frame<const N: usize>(quat_wxyz: &[f64], locked_axes: &[usize]) -> Result<OperatorCommand, SceneError> {
    let Ok(quat_wxyz) = <[f64; 4]>::try_from(quat_wxyz) else {
        let text = format!("coupling.quat_wxyz: {} numbers, must be 4", quat_wxyz.len());
        return Err(SceneError::Contradiction(text));
    };
    let mut locked = [false; 7];
    for &axis in locked_axes {
        if axis >= N {
            let text = format!("coupling.locked_axes: {axis}, must be below {N}, the number of axes");
            return Err(SceneError::Contradiction(text));
        }
        locked[axis] = true;
    }
    Ok(OperatorCommand::Frame { quat_wxyz, locked })
}

/// What is done at both sides when, in ns since the start: rotation and locks at once, then the changes.
pub(crate) fn acts<const N: usize>(spec: &CouplingSpec) -> Result<Vec<(u64, OperatorCommand)>, SceneError> {
    let (mut quat_wxyz, mut locked_axes) = (&spec.quat_wxyz, &spec.locked_axes);
    let mut acts = vec![(0, frame::<N>(quat_wxyz, locked_axes)?)];
    let mut before_s = 0.0;
    for (index, change) in spec.changes.iter().enumerate() {
        let ChangeSpec { at_s, position_scale, force_scale, .. } = change;
        if at_s.is_nan() || *at_s < before_s {
            let text = format!("coupling.changes.{index}.at_s = {at_s}: must be at least {before_s}");
            return Err(SceneError::Contradiction(text));
        }
        before_s = *at_s;
        let mut add = |act| acts.push((ns(*at_s), act));
        if let Some(scale) = position_scale {
            add(OperatorCommand::PositionScale(*scale));
        }
        if let Some(scale) = force_scale {
            add(OperatorCommand::ForceScale(*scale));
        }
        if change.quat_wxyz.is_some() || change.locked_axes.is_some() {
            quat_wxyz = change.quat_wxyz.as_ref().unwrap_or(quat_wxyz);
            locked_axes = change.locked_axes.as_ref().unwrap_or(locked_axes);
            add(frame::<N>(quat_wxyz, locked_axes)?);
        }
    }
    for (_, act) in &acts {
        act.check::<N>().map_err(EndpointError::from)?;
    }
    Ok(acts)
}

/// The coupling as it is at a time: what a run is measured against.
pub(crate) struct Present<const N: usize> {
    map: FrameMap<N>,
    position_scale: f64,
    force_scale: f64,
    acts: Vec<(u64, OperatorCommand)>,
    done: usize,
}

impl<const N: usize> Present<N> {
    /// As it begins; `acts` in the order of their times.
    pub(crate) fn new(spec: &CouplingSpec, acts: Vec<(u64, OperatorCommand)>) -> Self {
        let CouplingSpec { position_scale, force_scale, .. } = *spec;
        Self { map: FrameMap::default(), position_scale, force_scale, acts, done: 0 }
    }

    /// Does what is due by `now_ns`; says whether anything was.
    pub(crate) fn advance(&mut self, now_ns: u64) -> Result<bool, CouplingError> {
        let before = self.done;
        while let Some((_, act)) = self.acts.get(self.done).filter(|(at, _)| *at <= now_ns) {
            match act {
                OperatorCommand::PositionScale(scale) => self.position_scale = *scale,
                OperatorCommand::ForceScale(scale) => self.force_scale = *scale,
                OperatorCommand::Frame { quat_wxyz, locked } => {
                    self.map = FrameMap::turned(*quat_wxyz, locked)?
                }
                OperatorCommand::Acknowledge => {}
            }
            self.done += 1;
        }
        Ok(self.done > before)
    }

    /// Largest `lambda_p` that there will be.
    pub(crate) fn most_position_scale(&self) -> f64 {
        self.acts.iter().fold(self.position_scale, |most, (_, act)| match act {
            OperatorCommand::PositionScale(scale) => most.max(*scale),
            _ => most,
        })
    }

    /// `lambda_p L R v`.
    pub(crate) fn to_slave(&self, of_master: &Axes<N>) -> Axes<N> {
        self.map.to_slave(of_master) * self.position_scale
    }

    /// `lambda_f R' L f`.
    pub(crate) fn to_master(&self, of_slave: &Axes<N>) -> Axes<N> {
        self.map.to_master(of_slave) * self.force_scale
    }
}
