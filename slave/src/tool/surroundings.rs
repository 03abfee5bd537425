//! What a point of a rigid body touches: objects of a scene, and holes.

use nalgebra::Unit;

use super::settings::{HoleSettings, ToolWorldSettings, direction, finite, non_negative, positive};
use crate::{Axes, Contact, FULL_SLIP, ModelError, Object, ObjectSettings};

/// A round hole in a half space, with a chamfer.
///
/// At depth s below the entrance, `rho` from the axis, a point is `s` deep in the half space and `rho - r` deep in the
/// wall of the hole, `(rho - r - h + s) / sqrt 2` in its chamfer of height h, `s - depth` in its bottom. It is pushed
/// out the nearest way.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Hole {
    entrance: Axes<3>,
    axis: Unit<Axes<3>>,
    radius: f64,
    depth: f64,
    chamfer: f64,
    contact: Contact,
}

impl Hole {
    fn new(settings: &HoleSettings) -> Result<Self, ModelError> {
        Ok(Self {
            entrance: finite("hole entrance", settings.entrance)?,
            axis: direction("hole axis", settings.axis)?,
            radius: positive("hole radius", settings.radius)?,
            depth: positive("hole depth", settings.depth)?,
            chamfer: non_negative("hole chamfer_m", settings.chamfer_m)?,
            contact: settings.contact.contact()?,
        })
    }

    /// How deep in the material a point is (> 0 inside), and the way out.
    fn surface(&self, point: &Axes<3>) -> (f64, Axes<3>) {
        let from = point - self.entrance;
        let s = -from.dot(&self.axis);
        let across = from + self.axis.into_inner() * s;
        let rho = across.norm();
        let inward = if rho > 0.0 { across / -rho } else { Axes::zeros() };
        let wall = (rho - self.radius, inward);
        let slope =
            ((rho - self.radius - self.chamfer + s) / 2_f64.sqrt(), (inward + *self.axis) / 2_f64.sqrt());
        let side = if s < self.chamfer && slope.0 < wall.0 { slope } else { wall };
        let top = (s, self.axis.into_inner());
        if side.0 <= 0.0 {
            // In the opening: only the bottom is there.
            return (s - self.depth, self.axis.into_inner());
        }
        if side.0 < top.0 { side } else { top }
    }

    /// How deep a point is below the entrance, in m; below 0 outside, and zero beside the opening.
    pub(super) fn depth_of(&self, point: &Axes<3>) -> f64 {
        let from = point - self.entrance;
        let s = -from.dot(&self.axis);
        let rho = (from + self.axis.into_inner() * s).norm();
        if s > 0.0 && rho > self.radius + self.chamfer { 0.0 } else { s }
    }
}

/// What is there to be touched.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Surroundings {
    objects: Vec<Object<3>>,
    pub(super) holes: Vec<Hole>,
}

impl Surroundings {
    pub(super) fn new(world: &ToolWorldSettings) -> Result<Self, ModelError> {
        for object in &world.objects {
            if let Some(body) = &object.body {
                let allowed = "left out around a tool that turns: environment.bodies has bodies that move";
                return Err(ModelError { name: "object body mass_kg", seen: body.mass_kg, allowed });
            }
        }
        Ok(Self {
            objects: world.objects.iter().map(ObjectSettings::object).collect::<Result<_, _>>()?,
            holes: world.holes.iter().map(Hole::new).collect::<Result<_, _>>()?,
        })
    }

    /// K and B in N/m and N s/m of the stiffest.
    pub(super) fn stiffest(&self) -> (f64, f64) {
        let contacts =
            self.objects.iter().map(Object::contact).chain(self.holes.iter().map(|hole| &hole.contact));
        contacts
            .map(Contact::linear)
            .fold((0.0, 0.0), |(k, b), (stiffness, damping)| (stiffness.max(k), damping.max(b)))
    }

    /// First time in s after t at which the motion of an object jumps.
    pub(super) fn next_kink(&self, t: f64) -> f64 {
        self.objects.iter().map(|object| object.next_kink(t)).fold(f64::INFINITY, f64::min)
    }

    /// Force in N on a point in m that moves with a velocity in m/s, at t in s, on the smooth piece of the objects' motion
    /// that holds at time `piece`; and whether it is inside of something.
    pub(super) fn force(&self, point: &Axes<3>, velocity: &Axes<3>, piece: f64, t: f64) -> (Axes<3>, bool) {
        let (mut force, mut touches) = (Axes::zeros(), false);
        for object in &self.objects {
            let (moved, speed) = object.place(piece, t);
            if object.shape().is_spring() {
                let (stiffness, damping) = object.contact().linear();
                force +=
                    (object.shape().reference() + moved - point) * stiffness + (speed - velocity) * damping;
                continue;
            }
            let (distance, normal) = object.shape().surface(&(point - moved));
            if distance < 0.0 {
                touches = true;
                force += reaction(object.contact(), -distance, &normal, &(velocity - speed));
            }
        }
        for hole in &self.holes {
            let (depth, normal) = hole.surface(point);
            if depth > 0.0 {
                touches = true;
                force += reaction(&hole.contact, depth, &normal, velocity);
            }
        }
        (force, touches)
    }
}

/// Of a surface on a point that is `depth` in m inside, and moves with `velocity` in m/s relative to it.
///
/// `F_n = max(0, law)`, `F_t = -mu_f F_n v_t / max(|v_t|, 1 mm/s)`.
fn reaction(contact: &Contact, depth: f64, normal: &Axes<3>, velocity: &Axes<3>) -> Axes<3> {
    let along = velocity.dot(normal);
    let pressed = contact.normal_force(depth, -along);
    let slip = velocity - normal * along;
    normal * pressed - slip * (contact.friction() * pressed / slip.norm().max(FULL_SLIP))
}
