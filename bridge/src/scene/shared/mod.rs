//! Shared parts of the runs of a sweep, computed once: their beginning, or link and ladders.

mod beginning;
mod connection;
mod follower;

use std::sync::atomic::AtomicBool;

use super::{assemble::SceneError, measures::Outcome, pose, spec::SceneSpec};
use crate::coupling::CouplingKind;
use beginning::share_beginning;
use connection::Connection;

/// Outcome of each scene; None for a scene that was not run.
type Outcomes = Vec<Option<Result<Outcome, SceneError>>>;

/// Return whether a run may share parts with others.
///
/// Its controllers must change nothing but the force on the hand, and a copy of the run must be cheap. A felt trigger
/// has controllers that depend on those of the hand. Rotation, sessions and the halves of couplings other than
/// position-force are not followed. Recordings are long.
pub(super) fn can_share<const N: usize>(scene: &SceneSpec<N>) -> bool {
    let links = scene.link.iter().flat_map(|links| [&links.forward, &links.backward]).flatten();
    let is_recorded = links.clone().any(|link| link.trace.is_some() || link.opportunities.is_some())
        || scene
            .operator
            .as_ref()
            .is_some_and(|operator| operator.recorded.is_some() || operator.aims.is_some())
        || scene.environment.iter().flat_map(|one| &one.pushers).any(|pusher| pusher.recorded.is_some());
    !is_recorded
        && scene.slave.as_ref().is_some_and(|slave| slave.gripper.is_none())
        && scene.master.gripper.is_none()
        && scene.safety.gripper.is_none()
        && scene.safety.research.is_none()
        && scene.coupling.as_ref().is_none_or(|coupling| {
            coupling.numbers.kind == CouplingKind::PositionForce && coupling.alternatives.is_empty()
        })
        && !scene.security.is_some_and(|security| security.secure)
        && pose::as_pose(scene).is_ok_and(|scene| scene.is_none())
}

/// Compute the outcomes of scenes, each equal to that of a separate run.
///
/// If all scenes begin as the first one does, they share the beginning. Otherwise scenes with the same link and ladders
/// share those, in lanes if `lanes` is true.
///
/// # Errors
///
/// [`SceneError::Stopped`].
pub(super) fn outcomes<const N: usize>(
    scenes: &[&SceneSpec<N>],
    lanes: bool,
    stop: &AtomicBool,
) -> Result<Vec<Result<Outcome, SceneError>>, SceneError> {
    let mut outcomes: Outcomes = vec![None; scenes.len()];
    if let [first, others @ ..] = scenes
        && !others.is_empty()
        && can_share(first)
    {
        if others.iter().all(|other| share_beginning(first, other)) {
            outcomes = beginning::outcomes(scenes, stop)?;
        } else if let Ok(connection) = Connection::of(first) {
            // The fade of a change depends on the ladder.
            let never_changes = |scene: &SceneSpec<N>| {
                scene.coupling.as_ref().is_some_and(|coupling| coupling.changes.is_empty())
            };
            let is_shared = |other: &&SceneSpec<N>| {
                can_share(other)
                    && never_changes(other)
                    && Connection::of(other).is_ok_and(|other| other == connection)
            };
            if never_changes(first) && others.iter().all(is_shared) {
                outcomes = follower::outcomes(&connection, scenes, lanes, stop)?;
            }
        }
    }
    let alone = |scene: &SceneSpec<N>| match super::outcome(scene, stop, None) {
        Err(SceneError::Stopped) => Err(SceneError::Stopped),
        outcome => Ok(outcome),
    };
    outcomes
        .into_iter()
        .zip(scenes)
        .map(|(outcome, scene)| outcome.map_or_else(|| alone(scene), Ok))
        .collect()
}
