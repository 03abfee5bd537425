//! Which objects can be touched soon.

use crate::{Axes, contact::object::Object};

/// Distance in m within which an object is asked at every instant.
const NEAR: f64 = 0.01;

/// The objects near a place, and how far anything may move before another one can be touched.
///
/// An object at distance d cannot be touched before tool and object have moved by d between them. So all others are
/// left alone until the tool's way and the fastest object's way together reach the least of their distances: what is
/// left out would have exerted no force.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Reach<const N: usize> {
    /// In the order of the objects, so that forces are added in the same order as without leaving any out.
    pub(crate) near: Vec<usize>,
    place: Axes<N>,
    time: f64,
    /// Least distance in m among those that are not near; negative before the first look.
    clearance: f64,
    /// Top speed in m/s among those that are not near.
    speed: f64,
}

impl<const N: usize> Reach<N> {
    pub(crate) fn new(objects: usize) -> Self {
        let near = Vec::with_capacity(objects);
        Self { near, place: Axes::zeros(), time: 0.0, clearance: -1.0, speed: 0.0 }
    }

    /// Whether none but the near objects can be touched at `place` in m, `time` in s, nor within `margin` in m of it.
    pub(crate) fn covers(&self, place: &Axes<N>, time: f64, margin: f64) -> bool {
        (place - self.place).norm() + self.speed * (time - self.time).abs() + margin < self.clearance
    }

    /// Looks at all objects again; those within `radius` in m, or a little more, are near.
    pub(crate) fn look(&mut self, objects: &[Object<N>], place: &Axes<N>, time: f64, radius: f64) {
        let radius = radius.max(NEAR);
        self.near.clear();
        self.place = *place;
        self.time = time;
        self.clearance = f64::INFINITY;
        self.speed = 0.0;
        for (index, object) in objects.iter().enumerate() {
            let (displacement, _) = object.place(time, time);
            let clearance = object.shape().clearance(&(place - displacement));
            if clearance < radius {
                self.near.push(index);
            } else {
                self.clearance = self.clearance.min(clearance);
                self.speed = self.speed.max(object.top_speed());
            }
        }
        if self.clearance.is_finite() {
            // Distances carry rounding; what is near costs little.
            self.clearance -= 1e-9 * self.clearance + 1e-14 * place.norm();
        }
    }
}
