//! Environment of a scene around the tool of an arm that is modelled elsewhere, for example an emulated arm.

use dyn_clone::DynClone;
use haptether_safety::Axes;
use haptether_slave::Environment;

use super::{
    assemble::{SceneError, contradiction, scene_environment},
    outline::{scene_outline, scene_spec},
};

/// Environment along the first one to three axes of a base; positions and forces have three values.
pub trait ToolEnvironment: DynClone + Send + Sync {
    /// Return the number of axes.
    fn axes(&self) -> usize;

    /// Return true if the tool touched an object at the last force.
    fn touches(&self) -> bool;

    /// Start the pushers at a time in s; infinity keeps them at rest.
    fn push_from(&mut self, time_s: f64);

    /// Return the force in N on a tool at a position in m with a velocity in m/s.
    fn force(&mut self, time_s: f64, position: &[f64; 3], velocity: &[f64; 3]) -> [f64; 3];

    /// Advance the free parts of the environment by a step in s.
    fn advance(&mut self, time_s: f64, step_s: f64, position: &[f64; 3], velocity: &[f64; 3]);
}

dyn_clone::clone_trait_object!(ToolEnvironment);

fn first<const N: usize>(of: &[f64; 3]) -> Axes<N> {
    Axes::from_fn(|axis, _| of[axis])
}

fn padded<const N: usize>(of: &Axes<N>) -> [f64; 3] {
    std::array::from_fn(|axis| of.get(axis).copied().unwrap_or(0.0))
}

impl<const N: usize> ToolEnvironment for Environment<N> {
    fn axes(&self) -> usize {
        N
    }

    fn touches(&self) -> bool {
        Environment::touches(self)
    }

    fn push_from(&mut self, time_s: f64) {
        Environment::push_from(self, time_s);
    }

    fn force(&mut self, time_s: f64, position: &[f64; 3], velocity: &[f64; 3]) -> [f64; 3] {
        padded(&Environment::force(self, &first(position), &first(velocity), time_s))
    }

    fn advance(&mut self, time_s: f64, step_s: f64, position: &[f64; 3], velocity: &[f64; 3]) {
        Environment::advance(self, time_s, step_s, &first(position), &first(velocity));
    }
}

/// Return the environment of a scene as JSON, with its pushers at rest, and the start position in m of its arm.
///
/// # Errors
///
/// The text is not a scene, has more than three axes, or has a number that is invalid for an environment.
pub fn tool_environment(json: &[u8]) -> Result<(Box<dyn ToolEnvironment>, [f64; 3]), SceneError> {
    fn of<const N: usize>(json: &[u8]) -> Result<(Box<dyn ToolEnvironment>, [f64; 3]), SceneError> {
        let scene = scene_spec::<N>(json)?;
        let start = scene.slave.as_ref().map_or(&scene.master.position, |slave| &slave.position);
        let mut environment = scene_environment(&scene)?;
        environment.push_from(f64::INFINITY);
        Ok((Box::new(environment), padded(start)))
    }
    match scene_outline(json)?.axes {
        1 => of::<1>(json),
        2 => of::<2>(json),
        3 => of::<3>(json),
        axes => contradiction(format!("master.axes = {axes}: must be 1, 2 or 3 to lie around a tool")),
    }
}
