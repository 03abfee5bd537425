//! Environment of a scene: around an arm, or rendered on the device itself.

use haptether_master::ContinuousWall;
use haptether_safety::Axes;
use haptether_slave::{
    ContactLawKind, Environment, ObjectSettings, PushKind, PusherSettings, RenderedPush, RenderedWall,
    RenderedWalls, ShapeSettings,
};

use super::{
    super::spec::{EnvironmentSpec, RenderingSpec, SceneSpec},
    SceneError, contradiction,
};

/// Build the environment of a scene for an arm outside the scene.
pub fn scene_environment<const N: usize>(scene: &SceneSpec<N>) -> Result<Environment<N>, SceneError> {
    environment(scene.environment.as_ref())
}

pub(crate) fn environment<const N: usize>(
    spec: Option<&EnvironmentSpec<N>>,
) -> Result<Environment<N>, SceneError> {
    let Some(spec) = spec else { return Ok(Environment::empty()) };
    let objects = spec.objects.iter().map(ObjectSettings::object).collect::<Result<_, _>>()?;
    let pushers = spec.pushers.iter().map(PusherSettings::pusher).collect::<Result<_, _>>()?;
    Ok(Environment::new(objects, pushers))
}

/// Return true if all objects are resting Kelvin-Voigt planes or springs without friction, and no push is recorded.
pub(crate) fn is_formula<const N: usize>(environment: &EnvironmentSpec<N>) -> bool {
    let is_wall = |object: &ObjectSettings<N>| {
        matches!(object.shape, ShapeSettings::Plane { .. } | ShapeSettings::Spring { .. })
            && object.contact.law == ContactLawKind::KelvinVoigt
            && object.contact.friction == 0.0
            && object.motion.is_none()
            && object.body.is_none()
    };
    environment.objects.iter().all(is_wall)
        && environment.pushers.iter().all(|pusher| pusher.shape != PushKind::Recorded)
}

/// Return true if the environment acts on the device continuously.
pub(crate) fn is_continuous<const N: usize>(scene: &SceneSpec<N>) -> bool {
    let continuous = RenderingSpec::Continuous;
    scene.environment.as_ref().is_some_and(|environment| environment.rendering == continuous)
}

/// Build the planes and springs, if `with_objects`, and the pushes that are rendered on the device at each tick.
pub(crate) fn rendered_walls<const N: usize>(
    environment: Option<&EnvironmentSpec<N>>,
    with_objects: bool,
) -> Result<RenderedWalls<N>, SceneError> {
    let Some(environment) = environment else { return Ok(RenderedWalls::new(&[], &[])?) };
    let walls = if with_objects { walls(environment)? } else { Vec::new() };
    let pushes: Vec<_> = environment
        .pushers
        .iter()
        .map(|pusher| RenderedPush {
            shape: pusher.push_shape(),
            at_s: pusher.at_s,
            duration_s: pusher.duration_s,
            force_n: pusher.force_n,
        })
        .collect();
    Ok(RenderedWalls::new(&walls, &pushes)?)
}

/// Build the walls of a continuous environment, which act on the device without rendering.
pub(super) fn walls_on_device<const N: usize>(
    scene: &SceneSpec<N>,
) -> Result<Vec<ContinuousWall<N>>, SceneError> {
    let Some(environment) = scene.environment.as_ref().filter(|_| is_continuous(scene)) else {
        return Ok(Vec::new());
    };
    if !is_formula(environment) {
        return contradiction(
            "environment.rendering = \"continuous\": only resting planes and springs of Kelvin and Voigt, \
             without friction, act continuously",
        );
    }
    let wall = |RenderedWall { normal, point, stiffness, damping, is_two_sided }| {
        ContinuousWall::new(point, normal, stiffness, damping, is_two_sided)
    };
    Ok(walls(environment)?.into_iter().map(wall).collect::<Result<_, _>>()?)
}

/// Return the planes and springs of an environment as planes.
fn walls<const N: usize>(environment: &EnvironmentSpec<N>) -> Result<Vec<RenderedWall<N>>, SceneError> {
    let mut walls = Vec::new();
    for object in &environment.objects {
        let (stiffness, damping) = (object.contact.stiffness, object.contact.damping);
        match object.shape {
            ShapeSettings::Plane { point, normal } => {
                // Scaled, because the square of a very short vector is 0.
                let largest = normal.amax();
                let normal = if largest > 0.0 { normal / largest } else { normal };
                walls.push(RenderedWall { normal, point, stiffness, damping, is_two_sided: false });
            }
            ShapeSettings::Spring { anchor: point } => {
                for axis in 0..N {
                    let mut normal = Axes::zeros();
                    normal[axis] = 1.0;
                    walls.push(RenderedWall { normal, point, stiffness, damping, is_two_sided: true });
                }
            }
            ShapeSettings::Sphere { .. } | ShapeSettings::Box { .. } => {
                return contradiction("environment: only planes and springs act continuously");
            }
        }
    }
    Ok(walls)
}
