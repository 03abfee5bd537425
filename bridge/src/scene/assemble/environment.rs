//! What the arm of a scene touches, and what pushes there.

use haptether_slave::{
    Contact, ContactLaw, Environment, FreeBody, Object, ObjectMotion, PushShape, Pusher, Series, Shape,
};

use super::{
    super::spec::{
        ContactLawSpec, EnvironmentSpec, ObjectSpec, PusherShapeSpec, PusherSpec, SceneSpec, SeriesSpec,
        ShapeSpec,
    },
    axes::{axes, direction},
    error::{SceneError, contradiction},
};

/// What is touched in a scene and what pushes there, for an arm that the scene does not have.
pub fn scene_environment<const N: usize>(scene: &SceneSpec) -> Result<Environment<N>, SceneError> {
    if scene.master.axes != N {
        return contradiction(format!("master.axes = {}: must be {N}", scene.master.axes));
    }
    environment(scene.environment.as_ref())
}

pub(crate) fn environment<const N: usize>(
    spec: Option<&EnvironmentSpec>,
) -> Result<Environment<N>, SceneError> {
    let Some(spec) = spec else { return Ok(Environment::empty()) };
    let objects = spec.objects.iter().map(object).collect::<Result<Vec<_>, _>>()?;
    let pushers = spec.pushers.iter().map(pusher).collect::<Result<Vec<_>, _>>()?;
    Ok(Environment::new(objects, pushers))
}

fn object<const N: usize>(spec: &ObjectSpec) -> Result<Object<N>, SceneError> {
    let key = |name: &str| format!("environment.objects.{name}");
    let shape = match &spec.shape {
        ShapeSpec::Plane { point, normal } => {
            Shape::plane(axes(&key("shape.point"), point)?, direction(&key("shape.normal"), normal)?)?
        }
        ShapeSpec::Sphere { centre, radius } => Shape::sphere(axes(&key("shape.centre"), centre)?, *radius)?,
        ShapeSpec::Box { centre, half_extents } => Shape::cuboid(
            axes(&key("shape.centre"), centre)?,
            axes(&key("shape.half_extents"), half_extents)?,
        )?,
        ShapeSpec::Spring { anchor } => Shape::spring(axes(&key("shape.anchor"), anchor)?)?,
    };
    let (stiffness, damping) = (spec.contact.stiffness, spec.contact.damping);
    let law = match spec.contact.law {
        ContactLawSpec::KelvinVoigt => ContactLaw::KelvinVoigt { stiffness, damping },
        ContactLawSpec::HuntCrossley => {
            ContactLaw::HuntCrossley { stiffness, exponent: spec.contact.exponent, damping }
        }
    };
    let contact = Contact::new(law, spec.contact.friction)?;
    Ok(match (&spec.motion, &spec.body) {
        (None, None) => Object::fixed(shape, contact)?,
        (Some(motion), None) => {
            let velocity = axes(&key("motion.velocity"), &motion.velocity)?;
            let amplitude = axes(&key("motion.amplitude"), &motion.amplitude)?;
            let motion =
                ObjectMotion::new(velocity, motion.from_s, motion.until_s, amplitude, motion.frequency_hz)?;
            Object::moving(shape, contact, motion)?
        }
        (None, Some(body)) => {
            let velocity = axes(&key("body.velocity"), &body.velocity)?;
            Object::free(shape, contact, FreeBody::new(body.mass_kg, body.viscous, body.coulomb, velocity)?)?
        }
        (Some(_), Some(_)) => {
            return contradiction(
                "environment.objects: an object has a motion of its own or a body, not both",
            );
        }
    })
}

fn pusher<const N: usize>(spec: &PusherSpec) -> Result<Pusher<N>, SceneError> {
    if spec.shape == PusherShapeSpec::Recorded {
        let Some(SeriesSpec { time_s, values }) = &spec.recorded else {
            return contradiction("environment.pushers: a recorded push needs its recording");
        };
        let rows = values.iter().map(|row| axes("environment.pushers.recorded", row));
        let series = Series::new(time_s.clone(), rows.collect::<Result<_, _>>()?)?;
        return Ok(Pusher::recorded(series, spec.at_s, spec.duration_s)?);
    }
    let force = axes("environment.pushers.force_n", &spec.force_n)?;
    Ok(Pusher::shaped(push_shape(spec), spec.at_s, spec.duration_s, force)?)
}

pub(super) fn push_shape(pusher: &PusherSpec) -> PushShape {
    match pusher.shape {
        PusherShapeSpec::Step | PusherShapeSpec::Recorded => PushShape::Step,
        PusherShapeSpec::Ramp => PushShape::Ramp { rise_s: pusher.rise_s },
        PusherShapeSpec::HalfSine => PushShape::HalfSine,
        PusherShapeSpec::Sine => PushShape::Sine { frequency_hz: pusher.frequency_hz },
    }
}
