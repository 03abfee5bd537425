//! Surroundings of the points of a rigid body: objects of a scene, and holes.

use nalgebra::Unit;

use super::settings::{HoleSettings, ToolWorldSettings, direction, finite, non_negative, positive};
use crate::{Axes, Contact, FULL_SLIP, ModelError, Object, ObjectSettings};

/// A round hole in a half space, with a chamfer.
///
/// A point at depth s below the entrance and at distance `rho` from the axis is `s` deep in the half space. Its depth
/// is `rho - r` in the wall of the hole, `(rho - r - h + s) / sqrt 2` in the chamfer of height h and `s - depth` in the
/// bottom. It is pushed out along the shortest way.
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

    /// Depth of a point in the material (> 0 inside), and the direction out of it.
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
            // In the opening there is only the bottom.
            return (s - self.depth, self.axis.into_inner());
        }
        if side.0 < top.0 { side } else { top }
    }

    /// Depth of a point below the entrance, in m; negative outside, and zero beside the opening.
    pub(super) fn depth_of(&self, point: &Axes<3>) -> f64 {
        let from = point - self.entrance;
        let s = -from.dot(&self.axis);
        let rho = (from + self.axis.into_inner() * s).norm();
        if s > 0.0 && rho > self.radius + self.chamfer { 0.0 } else { s }
    }
}

/// Objects and holes that can be touched.
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

    /// K in N/m and B in N s/m of the stiffest contact.
    pub(super) fn stiffest(&self) -> (f64, f64) {
        let contacts =
            self.objects.iter().map(Object::contact).chain(self.holes.iter().map(|hole| &hole.contact));
        contacts
            .map(Contact::linear)
            .fold((0.0, 0.0), |(k, b), (stiffness, damping)| (stiffness.max(k), damping.max(b)))
    }

    /// First time in s after t at which the velocity of an object jumps.
    pub(super) fn next_kink(&self, t: f64) -> f64 {
        self.objects.iter().map(|object| object.next_kink(t)).fold(f64::INFINITY, f64::min)
    }

    /// Force in N on a point in m that moves with a velocity in m/s, at t in s, on the smooth piece of the objects'
    /// motion valid at time `piece`. The flag is true if the point is inside an object.
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

/// Force of a surface on a point `depth` in m inside it, at `velocity` in m/s relative to it.
///
/// `F_n = max(0, law)`, `F_t = -mu_f F_n v_t / max(|v_t|, 1 mm/s)`.
fn reaction(contact: &Contact, depth: f64, normal: &Axes<3>, velocity: &Axes<3>) -> Axes<3> {
    let along = velocity.dot(normal);
    let pressed = contact.normal_force(depth, -along);
    let slip = velocity - normal * along;
    normal * pressed - slip * (contact.friction() * pressed / slip.norm().max(FULL_SLIP))
}
