//! Research controllers: custom controllers of the caller, one for each simulated run.

use std::fmt::Debug;

use haptether_safety::controller::ResearchController;

use super::{
    assemble::{SceneError, contradiction},
    spec::{ResearchSpec, SceneSpec},
};

/// Factory of a controller for each run, on any thread.
pub trait ResearchFactory: Sync + Debug {
    /// Return a new controller for a device with this number of axes, sampled every `period_s`, or the reason of a
    /// refusal.
    fn controller(
        &self,
        spec: &ResearchSpec,
        axes: usize,
        period_s: f64,
    ) -> Result<Box<dyn ResearchController>, String>;
}

/// Return the controller that the scene names, if any. Without a factory the scene is refused: its author expects that
/// the controller acts.
pub(crate) fn research_controller<const N: usize>(
    scene: &SceneSpec<N>,
    factory: Option<&dyn ResearchFactory>,
) -> Result<Option<Box<dyn ResearchController>>, SceneError> {
    let Some(spec) = &scene.safety.research else { return Ok(None) };
    let Some(factory) = factory else {
        return contradiction("safety.research: runs in simulated runs and sweeps only, leave it out");
    };
    let made = factory.controller(spec, N, scene.run.period_s);
    made.map(Some).or_else(|why| contradiction(format!("safety.research: {why}")))
}
