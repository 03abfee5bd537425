//! Controllers of the caller's own, for research: one for each simulated run.

use std::fmt::Debug;

use haptether_safety::controller::ResearchController;

use super::{
    assemble::{SceneError, contradiction},
    spec::{ResearchSpec, SceneSpec},
};

/// Makes a controller for each run, on any thread.
pub trait ResearchFactory: Sync + Debug {
    /// One that has seen nothing, of a device with so many axes that is sampled every `period_s`, or why there is none.
    fn controller(
        &self,
        spec: &ResearchSpec,
        axes: usize,
        period_s: f64,
    ) -> Result<Box<dyn ResearchController>, String>;
}

/// The controller that the scene asks for, if any. Without a factory it is refused, never left out: whoever wrote the
/// scene takes it that somebody watches.
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
