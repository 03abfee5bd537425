//! Contact laws: how a surface resists.

use crate::{Axes, ModelError, require};

/// Slip in m/s below which Coulomb friction is linear in it.
///
/// No integrator can follow a step at zero slip, so an invisible slip stands for stiction.
pub const FULL_SLIP: f64 = 1e-3;

/// How a surface resists along its normal.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum ContactLaw {
    /// `F = max(0, K d + B d')` at depth d > 0.
    ///
    /// Source: paper Eq. 15; J. E. Colgate, J. M. Brown, "Factors affecting the Z-width of a haptic display",
    /// ICRA 1994 (the virtual wall).
    KelvinVoigt {
        /// K in N/m (>= 0).
        stiffness: f64,
        /// B in N s/m (>= 0).
        damping: f64,
    },
    /// `F = max(0, K d^n (1 + chi d'))` at depth d > 0.
    ///
    /// Source: K. H. Hunt, F. R. E. Crossley, "Coefficient of restitution interpreted as damping in vibroimpact",
    /// J. Appl. Mech. 42, 1975.
    HuntCrossley {
        /// K in N/m^n (>= 0).
        stiffness: f64,
        /// n (>= 1); 1.5 is Hertz's ball on a plane.
        exponent: f64,
        /// chi in s/m (>= 0).
        damping: f64,
    },
}

/// Contact with an object: a law along the normal and Coulomb friction along the surface.
///
/// `F_t = -mu_f F_n v_t / max(|v_t|, 1 mm/s)`, with the slip `v_t` relative to the object.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Contact {
    law: ContactLaw,
    friction: f64,
}

/// Smooth piece of its law that a contact is on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Mode {
    /// Outside.
    Apart,
    /// Inside and pushing.
    Touching,
    /// Inside, but leaving so fast that the law would pull.
    Leaving,
}

/// A contact at one instant, and its slopes over depth and speed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Reaction<const N: usize> {
    pub(crate) force: Axes<N>,
    pub(crate) normal: Axes<N>,
    /// `dF_n / dd` in N/m (>= 0).
    pub(crate) stiffness: f64,
    /// `dF_n / dd'` in N s/m (>= 0).
    pub(crate) damping: f64,
    /// `|F_t| / |v_t|` in N s/m.
    pub(crate) drag: f64,
}

impl Contact {
    /// A law and a coefficient of friction (>= 0).
    pub fn new(law: ContactLaw, friction: f64) -> Result<Self, ModelError> {
        let (ContactLaw::KelvinVoigt { stiffness, damping }
        | ContactLaw::HuntCrossley { stiffness, damping, .. }) = law;
        require("contact stiffness", stiffness, stiffness >= 0.0, "finite and 0 or more")?;
        require("contact damping", damping, damping >= 0.0, "finite and 0 or more")?;
        if let ContactLaw::HuntCrossley { exponent, .. } = law {
            require("contact exponent", exponent, (1.0..=10.0).contains(&exponent), "between 1 and 10")?;
        }
        require("contact friction", friction, friction >= 0.0, "finite and 0 or more")?;
        Ok(Self { law, friction })
    }

    /// The law along the normal.
    pub fn law(&self) -> ContactLaw {
        self.law
    }

    /// `mu_f`.
    pub fn friction(&self) -> f64 {
        self.friction
    }

    /// K and B of a linear law; springs always have one.
    pub(crate) fn linear(&self) -> (f64, f64) {
        let (ContactLaw::KelvinVoigt { stiffness, damping }
        | ContactLaw::HuntCrossley { stiffness, damping, .. }) = self.law;
        (stiffness, damping)
    }

    /// K and B, if the law is Kelvin-Voigt.
    pub(crate) fn kelvin_voigt(&self) -> Option<(f64, f64)> {
        matches!(self.law, ContactLaw::KelvinVoigt { .. }).then(|| self.linear())
    }

    /// `F_n` in N at depth d in m and d' in m/s.
    pub fn normal_force(&self, depth: f64, rate: f64) -> f64 {
        if depth > 0.0 { self.continued(depth, rate).max(0.0) } else { 0.0 }
    }

    /// The law without its maximum, smooth beyond the surface, so that an integrator may step across it.
    fn continued(&self, depth: f64, rate: f64) -> f64 {
        match self.law {
            ContactLaw::KelvinVoigt { stiffness, damping } => stiffness * depth + damping * rate,
            ContactLaw::HuntCrossley { stiffness, exponent, damping } => {
                stiffness * depth.abs().powf(exponent).copysign(depth) * (1.0 + damping * rate)
            }
        }
    }

    pub(crate) fn mode(&self, depth: f64, rate: f64) -> Mode {
        if depth <= 0.0 {
            Mode::Apart
        } else if self.continued(depth, rate) > 0.0 {
            Mode::Touching
        } else {
            Mode::Leaving
        }
    }

    /// Force on the touching body at `velocity` in m/s relative to the object, on the smooth piece `mode`.
    pub(crate) fn force<const N: usize>(
        &self,
        mode: Mode,
        distance: f64,
        normal: &Axes<N>,
        velocity: &Axes<N>,
    ) -> Axes<N> {
        if mode != Mode::Touching {
            return Axes::zeros();
        }
        let along = normal.dot(velocity);
        let pressing = self.continued(-distance, -along);
        let mut force = normal * pressing;
        if self.friction > 0.0 {
            let slip = velocity - normal * along;
            force -= slip * (self.friction * pressing / slip.norm().max(FULL_SLIP));
        }
        force
    }

    /// Force and its slopes, on the present piece of the law.
    pub(crate) fn reaction<const N: usize>(
        &self,
        distance: f64,
        normal: &Axes<N>,
        velocity: &Axes<N>,
    ) -> Option<Reaction<N>> {
        let along = normal.dot(velocity);
        let (depth, rate) = (-distance, -along);
        let mode = self.mode(depth, rate);
        if mode != Mode::Touching {
            return None;
        }
        let (stiffness, damping) = match self.law {
            ContactLaw::KelvinVoigt { stiffness, damping } => (stiffness, damping),
            ContactLaw::HuntCrossley { stiffness, exponent, damping } => (
                stiffness * exponent * depth.powf(exponent - 1.0) * (1.0 + damping * rate).max(0.0),
                stiffness * depth.powf(exponent) * damping,
            ),
        };
        let slip = (velocity - normal * along).norm();
        let drag = self.friction * self.normal_force(depth, rate) / slip.max(FULL_SLIP);
        let force = self.force(mode, distance, normal, velocity);
        Some(Reaction { force, normal: *normal, stiffness, damping, drag })
    }
}
