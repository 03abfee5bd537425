//! One thing that the tool may touch.

use crate::{Axes, Contact, ContactLaw, FreeBody, ModelError, ObjectMotion, Shape, require};

/// Whether and how an object moves.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Mobility<const N: usize> {
    Fixed,
    Moving(ObjectMotion<N>),
    Free(FreeBody<N>),
}

/// A shape that resists, and may move on its own or be pushed.
///
/// An object with the shape of a spring exerts `F = K (anchor - x) - B V` everywhere, with K and B of its contact.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Object<const N: usize> {
    shape: Shape<N>,
    contact: Contact,
    mobility: Mobility<N>,
}

impl<const N: usize> Object<N> {
    /// An object that stays.
    pub fn fixed(shape: Shape<N>, contact: Contact) -> Result<Self, ModelError> {
        Self::checked(shape, contact, Mobility::Fixed)
    }

    /// An object that moves on its own, whatever touches it.
    pub fn moving(shape: Shape<N>, contact: Contact, motion: ObjectMotion<N>) -> Result<Self, ModelError> {
        Self::checked(shape, contact, Mobility::Moving(motion))
    }

    /// An object that is pushed by the tool and pushes back.
    pub fn free(shape: Shape<N>, contact: Contact, body: FreeBody<N>) -> Result<Self, ModelError> {
        Self::checked(shape, contact, Mobility::Free(body))
    }

    fn checked(shape: Shape<N>, contact: Contact, mobility: Mobility<N>) -> Result<Self, ModelError> {
        if shape.is_spring() {
            let friction = contact.friction();
            require("friction of a spring", friction, friction == 0.0, "0: a spring has no surface")?;
            if let ContactLaw::HuntCrossley { exponent, .. } = contact.law() {
                require("exponent of a spring", exponent, false, "that of Kelvin and Voigt, a linear law")?;
            }
        }
        Ok(Self { shape, contact, mobility })
    }

    /// Its shape, where it was put.
    pub fn shape(&self) -> &Shape<N> {
        &self.shape
    }

    /// How it resists.
    pub fn contact(&self) -> &Contact {
        &self.contact
    }

    /// Its body, if it is free.
    pub fn body(&self) -> Option<&FreeBody<N>> {
        if let Mobility::Free(body) = &self.mobility { Some(body) } else { None }
    }

    pub(crate) fn body_mut(&mut self) -> Option<&mut FreeBody<N>> {
        if let Mobility::Free(body) = &mut self.mobility { Some(body) } else { None }
    }

    pub(crate) fn is_fixed(&self) -> bool {
        self.mobility == Mobility::Fixed
    }

    /// Whether it moves on its own.
    pub(crate) fn moves(&self) -> bool {
        matches!(self.mobility, Mobility::Moving(_))
    }

    /// Displacement in m and velocity in m/s at t in s, on the smooth piece that holds at `piece`; of a free body: as
    /// it is now.
    pub(crate) fn place(&self, piece: f64, t: f64) -> (Axes<N>, Axes<N>) {
        match &self.mobility {
            Mobility::Fixed => (Axes::zeros(), Axes::zeros()),
            Mobility::Moving(motion) => motion.on(piece, t),
            Mobility::Free(body) => (body.displacement, body.velocity),
        }
    }

    /// Speed in m/s that it does not exceed unless it is touched.
    pub(crate) fn top_speed(&self) -> f64 {
        match &self.mobility {
            Mobility::Fixed => 0.0,
            Mobility::Moving(motion) => motion.top_speed(),
            Mobility::Free(body) => body.velocity.norm(),
        }
    }

    pub(crate) fn next_kink(&self, t: f64) -> f64 {
        if let Mobility::Moving(motion) = &self.mobility { motion.next_kink(t) } else { f64::INFINITY }
    }
}
