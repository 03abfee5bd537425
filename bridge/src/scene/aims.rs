//! Aims of a scene's hand: those of its file as commands of its master, or those of a person.

use super::{
    assemble::{SceneError, contradiction, ns},
    coupling::commands,
    spec::{AimSpec, SceneSpec},
};
use crate::{OperatorCommand, wire::padded};

/// Return true if the hand follows aims of a person, and none of a file.
pub(super) fn is_aimed_by_person<const N: usize>(scene: &SceneSpec<N>) -> bool {
    scene
        .operator
        .as_ref()
        .and_then(|operator| operator.aims.as_ref())
        .is_some_and(|aims| aims.rows.is_empty())
}

/// Return the commands of the master with their times in ns since the start: those of the coupling, and the aims.
pub(super) fn master_commands<const N: usize>(
    scene: &SceneSpec<N>,
) -> Result<Vec<(u64, OperatorCommand)>, SceneError> {
    let mut list = commands::<N>(scene.coupled()?.1)?;
    let Some(aims) = scene.operator.as_ref().and_then(|operator| operator.aims.as_ref()) else {
        return Ok(list);
    };
    let mut before_s = 0.0;
    for (index, AimSpec { at_s, aim }) in aims.rows.iter().enumerate() {
        if at_s.is_nan() || *at_s < before_s {
            return contradiction(format!(
                "operator.aims.rows.{index}.at_s = {at_s}: must be at least {before_s}"
            ));
        }
        before_s = *at_s;
        aim.check()?;
        list.push((ns(*at_s), OperatorCommand::Aim(aim.with_target(padded(&aim.target)))));
    }
    list.sort_by_key(|(at_ns, _)| *at_ns);
    Ok(list)
}
