//! What of an environment acts on the device itself: planes and springs.

use haptether_master::ContinuousWall;
use haptether_safety::Axes;
use haptether_slave::{RenderedPush, RenderedWall, RenderedWalls};

use super::{
    super::spec::{
        ContactLawSpec, EnvironmentSpec, ObjectSpec, PusherShapeSpec, RenderingSpec, SceneSpec, ShapeSpec,
    },
    axes::{axes, direction},
    environment::push_shape,
    error::{SceneError, contradiction},
};

/// The walls that a continuous environment is made of.
fn continuous_walls<const N: usize>(spec: &SceneSpec) -> Result<Vec<ContinuousWall<N>>, SceneError> {
    let Some(environment) = &spec.environment else { return Ok(Vec::new()) };
    let mut walls = Vec::new();
    for (point, normal, stiffness, damping, is_two_sided) in planes::<N>(environment)? {
        walls.push(ContinuousWall::new(point, normal, stiffness, damping, is_two_sided)?);
    }
    Ok(walls)
}

type Plane<const N: usize> = (Axes<N>, Axes<N>, f64, f64, bool);

/// Planes and springs of an environment, as planes.
fn planes<const N: usize>(environment: &EnvironmentSpec) -> Result<Vec<Plane<N>>, SceneError> {
    let mut planes = Vec::new();
    for object in &environment.objects {
        let (stiffness, damping) = (object.contact.stiffness, object.contact.damping);
        match &object.shape {
            ShapeSpec::Plane { point, normal } => planes.push((
                axes("environment.objects.shape.point", point)?,
                direction("environment.objects.shape.normal", normal)?,
                stiffness,
                damping,
                false,
            )),
            ShapeSpec::Spring { anchor } => {
                let anchor = axes("environment.objects.shape.anchor", anchor)?;
                for axis in 0..N {
                    let mut normal = Axes::zeros();
                    normal[axis] = 1.0;
                    planes.push((anchor, normal, stiffness, damping, true));
                }
            }
            ShapeSpec::Sphere { .. } | ShapeSpec::Box { .. } => {
                return contradiction("environment: only planes and springs act continuously");
            }
        }
    }
    Ok(planes)
}

/// Whether all that is touched are resting planes and springs of Kelvin and Voigt, and formulas push.
pub(crate) fn is_plain(environment: &EnvironmentSpec) -> bool {
    let is_plain = |object: &ObjectSpec| {
        matches!(object.shape, ShapeSpec::Plane { .. } | ShapeSpec::Spring { .. })
            && object.contact.law == ContactLawSpec::KelvinVoigt
            && object.contact.friction == 0.0
            && object.motion.is_none()
            && object.body.is_none()
    };
    environment.objects.iter().all(is_plain)
        && environment.pushers.iter().all(|pusher| pusher.shape != PusherShapeSpec::Recorded)
}

pub(crate) fn rendered_walls<const N: usize>(
    environment: Option<&EnvironmentSpec>,
    with_objects: bool,
) -> Result<RenderedWalls<N>, SceneError> {
    let Some(environment) = environment else { return Ok(RenderedWalls::new(&[], &[])?) };
    let planes = if with_objects { planes::<N>(environment)? } else { Vec::new() };
    let walls: Vec<_> = planes
        .into_iter()
        .map(|(point, normal, stiffness, damping, is_two_sided)| RenderedWall {
            normal,
            point,
            stiffness,
            damping,
            is_two_sided,
        })
        .collect();
    let pushes = environment.pushers.iter().map(|pusher| {
        Ok(RenderedPush {
            shape: push_shape(pusher),
            at_s: pusher.at_s,
            duration_s: pusher.duration_s,
            force_n: axes("environment.pushers.force_n", &pusher.force_n)?,
        })
    });
    Ok(RenderedWalls::new(&walls, &pushes.collect::<Result<Vec<_>, SceneError>>()?)?)
}

/// Whether the environment acts on the device at every instant.
pub(crate) fn is_continuous(scene: &SceneSpec) -> bool {
    let continuous = RenderingSpec::Continuous;
    scene.environment.as_ref().is_some_and(|environment| environment.rendering == continuous)
}

/// Walls that act on the device by themselves.
pub(super) fn walls_on_device<const N: usize>(
    scene: &SceneSpec,
) -> Result<Vec<ContinuousWall<N>>, SceneError> {
    if !is_continuous(scene) {
        return Ok(Vec::new());
    }
    if scene.environment.as_ref().is_some_and(|environment| !is_plain(environment)) {
        return contradiction(
            "environment.rendering = \"continuous\": only resting planes and springs of Kelvin and Voigt, \
             without friction, act continuously",
        );
    }
    continuous_walls(scene)
}
