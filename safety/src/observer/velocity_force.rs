//! Velocity and force observer, VFO.

use crate::{About, Observation, ParameterError, Real, parameter::positive};
use haptether_numeric::{choose, lesser, norm, pack, shared};

/// Form of the comparison of velocity and force with their thresholds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(
    feature = "serde",
    derive(serde::Deserialize, schemars::JsonSchema),
    serde(rename_all = "kebab-case")
)]
pub enum VelocityForceForm {
    /// `S_vf = V·F_v / (V_t F_t)`: Eq. 1 as printed. A large force trips it far below `V_t`.
    #[default]
    Product,
    /// `S_vf = min(V/V_t, |F_v|/F_t)`, with V the speed along `F_v`.
    ///
    /// This follows the paper's text ("larger than the thresholds at the same time") and its Fig. 8 (tripped at
    /// `V_t`).
    Both,
}

/// VFO: large while the device pushes the hand and the hand moves along with the push.
///
/// Source: paper Eq. 1.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct VelocityForceObserver<S = f64> {
    velocity_threshold: S,
    force_threshold_n: S,
    form: VelocityForceForm,
}

impl VelocityForceObserver {
    /// Name, title and source.
    pub const ABOUT: About = About { name: "vfo", title: "velocity and force", source: "paper Eq. 1" };

    /// Create an observer with thresholds `V_t` in m/s and `F_t` in N, both > 0.
    pub fn new(
        velocity_threshold: f64,
        force_threshold_n: f64,
        form: VelocityForceForm,
    ) -> Result<Self, ParameterError> {
        Ok(Self {
            velocity_threshold: positive("velocity_threshold", "V_t", velocity_threshold)?,
            force_threshold_n: positive("force_threshold_n", "F_t", force_threshold_n)?,
            form,
        })
    }
}

impl<S: Real> VelocityForceObserver<S> {
    /// Gather one observer per lane, all of one form; else return None.
    pub fn gather(of: &[&VelocityForceObserver]) -> Option<Self> {
        Some(Self {
            velocity_threshold: pack(of, |one| one.velocity_threshold)?,
            force_threshold_n: pack(of, |one| one.force_threshold_n)?,
            form: shared(of, |one| one.form)?,
        })
    }

    /// Compute `S_vf`, without unit. Above 1 is unsafe; it is negative while the hand moves against the force.
    #[inline(always)]
    pub fn observe<const N: usize>(&self, seen: &Observation<N, S>) -> S {
        let power = seen.velocity.dot(&seen.rendered_force);
        match self.form {
            VelocityForceForm::Product => power / (self.velocity_threshold * self.force_threshold_n),
            VelocityForceForm::Both => {
                let force = norm(&seen.rendered_force);
                let nothing = S::splat(0.0);
                choose!(
                    S,
                    force.simd_eq(nothing),
                    nothing,
                    lesser(power / force / self.velocity_threshold, force / self.force_threshold_n)
                )
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Axes;

    fn seen(v: f64, f: f64) -> Observation<1> {
        Observation::exact(Axes::<1>::new(v), Axes::<1>::new(f), Axes::zeros())
    }

    #[test]
    fn table() {
        let product = VelocityForceObserver::new(0.6, 1.0, VelocityForceForm::Product).unwrap();
        let both = VelocityForceObserver::new(0.6, 1.0, VelocityForceForm::Both).unwrap();
        for (v, f, as_printed, as_described) in [
            (0.6, 1.0, 1.0, 1.0),
            (0.1, 7.8, 1.3, 1.0 / 6.0),
            (3.0, 0.5, 2.5, 0.5),
            (-1.0, 2.0, -2.0 / 0.6, -1.0 / 0.6),
            (1.0, 0.0, 0.0, 0.0),
        ] {
            assert!((product.observe(&seen(v, f)) - as_printed).abs() < 1e-12, "{v} {f}");
            assert!((both.observe(&seen(v, f)) - as_described).abs() < 1e-12, "{v} {f}");
        }
        // Other thresholds: P = 0.9 W against 0.3 m/s and 2 N.
        let observed = |form| VelocityForceObserver::new(0.3, 2.0, form).unwrap().observe(&seen(0.6, 1.5));
        assert!((observed(VelocityForceForm::Product) - 1.5).abs() < 1e-12);
        assert!((observed(VelocityForceForm::Both) - 0.75).abs() < 1e-12);
    }
}
