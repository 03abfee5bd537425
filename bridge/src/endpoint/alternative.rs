//! Couplings of a side to which an operator may switch during a run.

use crate::{
    command::OperatorCommand,
    coupling::{CouplingError, CouplingKind, MethodSettings},
    playout::PlayOut,
};

/// Parts of a coupling while another one is in use: halves `M` of the translation and `R` of the rotation.
///
/// All parts are built before the run, so that a switch only exchanges them.
#[derive(Clone, Debug)]
pub(super) struct Alternative<M, R> {
    /// Settings; None for position-force.
    pub(super) method: Option<MethodSettings>,
    pub(super) coupled: Option<Box<M>>,
    pub(super) turning: Option<Box<R>>,
    pub(super) play_out: PlayOut,
}

impl<M, R> Alternative<M, R> {
    /// Build the parts of a coupling; `method` is None for position-force.
    pub(super) fn new(
        method: Option<MethodSettings>,
        play_out: PlayOut,
        coupled: impl FnOnce(&MethodSettings) -> Option<M>,
        turning: impl FnOnce(&MethodSettings) -> Option<R>,
    ) -> Self {
        let coupled = method.as_ref().and_then(coupled).map(Box::new);
        let turning = method.as_ref().and_then(turning).map(Box::new);
        Self { method, coupled, turning, play_out }
    }

    pub(super) fn kind(&self) -> CouplingKind {
        kind_of(self.method.as_ref())
    }
}

/// Kind of a coupling with these settings.
pub(super) fn kind_of(method: Option<&MethodSettings>) -> CouplingKind {
    method.map_or(CouplingKind::PositionForce, |method| method.kind)
}

/// Return the place of a kind among the alternatives.
pub(super) fn place<M, R>(
    alternatives: &[Alternative<M, R>],
    kind: CouplingKind,
) -> Result<usize, CouplingError> {
    let place = alternatives.iter().position(|one| one.kind() == kind);
    place.ok_or(CouplingError::NoAlternative(kind.name()))
}

/// Return an error for a change that the coupling in use or an alternative does not allow: a switch keeps all scales.
pub(super) fn check_change<M, R>(
    method: Option<&MethodSettings>,
    alternatives: &[Alternative<M, R>],
    command: &OperatorCommand,
    is_open: bool,
) -> Result<(), CouplingError> {
    let others = alternatives.iter().filter_map(|one| one.method.as_ref());
    others.chain(method).try_for_each(|one| one.check_change(command, is_open))
}
