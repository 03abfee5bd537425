//! Delay distributions with exactly the mean and standard deviation of the settings.

mod gamma;
pub(crate) mod gaussian;
mod shapes;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use gamma::Gamma;
use shapes::{Exponential, Lognormal, Normal, Pareto, Table, Uniform};

use super::LinkSettings;
use crate::checks::{LinkSettingsError, MAX_DELAY_S, within};

/// Delay distribution with the mean `delay_s` and the standard deviation `jitter_s`.
#[derive(Clone, Debug, Default, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Distribution {
    /// Normal; truncated at zero if it would reach below, with mean and deviation kept.
    #[default]
    Normal,
    /// Uniform.
    Uniform,
    /// Minimum delay plus an exponential excess.
    Exponential,
    /// Gamma from zero; with `distribution_shape` from a minimum delay.
    Gamma,
    /// Lognormal from zero.
    Lognormal,
    /// Minimum delay plus a Pareto excess of index `distribution_shape`, at least 2.5, by default 5.
    Pareto,
    /// Inverse distribution function at evenly spaced probabilities, as in the `.dist` files of iproute2, in
    /// units of 1/8192 standard deviation around the mean.
    Table(Vec<i16>),
}

/// Point of a distribution: both tails, each in full precision, and the normal variate.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Tails {
    /// Probability of a smaller value.
    pub(crate) below: f64,
    /// Probability of a larger value.
    pub(crate) above: f64,
    /// Standard normal variate at this point.
    pub(crate) z: f64,
}

impl Tails {
    pub(crate) fn of_normal(z: f64) -> Self {
        Self { below: gaussian::cdf(z), above: gaussian::cdf(-z), z }
    }
}

/// Delay distribution of a link with jitter, for ordered, unordered, correlated and independent delays.
///
/// Equation: `D = Q(p)`, p uniform; `E[D] = delay_s`, `sqrt(Var[D]) = jitter_s`, `D >= 0`.
#[derive(Clone, Debug)]
pub struct DelayLaw {
    mean_s: f64,
    sigma_s: f64,
    shape: Shape,
}

#[derive(Clone, Debug)]
enum Shape {
    Normal(Normal),
    Uniform(Uniform),
    Exponential(Exponential),
    Gamma(Gamma),
    Lognormal(Lognormal),
    Pareto(Pareto),
    Table(Table),
}

impl DelayLaw {
    /// Build the distribution from `delay_s`, `jitter_s`, `distribution` and `distribution_shape`.
    ///
    /// Fails if no such distribution has this mean and standard deviation without negative delays.
    pub fn new(settings: &LinkSettings) -> Result<Self, LinkSettingsError> {
        let (mean_s, sigma_s, shape) = (settings.delay_s, settings.jitter_s, settings.distribution_shape);
        within("delay_s", mean_s, 0.0, MAX_DELAY_S)?;
        within("jitter_s", sigma_s, 0.0, MAX_DELAY_S)?;
        let shape = match (&settings.distribution, shape) {
            (Distribution::Gamma, Some(shape)) => Shape::Gamma(Gamma::shifted(mean_s, sigma_s, shape)?),
            (Distribution::Gamma, None) => Shape::Gamma(Gamma::new(mean_s, sigma_s)?),
            (Distribution::Pareto, shape) => Shape::Pareto(Pareto::new(mean_s, sigma_s, shape)?),
            (_, Some(_)) => {
                return Err(LinkSettingsError::contradiction(
                    "distribution_shape",
                    "only the distributions gamma and pareto have a shape to choose",
                ));
            }
            (Distribution::Normal, None) => Shape::Normal(Normal::new(mean_s, sigma_s)?),
            (Distribution::Uniform, None) => Shape::Uniform(Uniform::new(mean_s, sigma_s)?),
            (Distribution::Exponential, None) => Shape::Exponential(Exponential::new(mean_s, sigma_s)?),
            (Distribution::Lognormal, None) => Shape::Lognormal(Lognormal::new(mean_s, sigma_s)?),
            (Distribution::Table(values), None) => Shape::Table(Table::new(mean_s, sigma_s, values)?),
        };
        Ok(Self { mean_s, sigma_s, shape })
    }

    /// Mean in s.
    pub fn mean_s(&self) -> f64 {
        self.mean_s
    }

    /// Standard deviation in s.
    pub fn sigma_s(&self) -> f64 {
        self.sigma_s
    }

    /// Delay in s that a fraction `p` of the packets stays below; NaN if `p` is outside 0 to 1.
    pub fn quantile_s(&self, p: f64) -> f64 {
        if !(0.0..=1.0).contains(&p) {
            return f64::NAN;
        }
        self.at(Tails { below: p, above: 1.0 - p, z: gaussian::quantile(p) })
    }

    pub(crate) fn at(&self, point: Tails) -> f64 {
        if self.sigma_s == 0.0 {
            return self.mean_s;
        }
        match &self.shape {
            Shape::Normal(law) => law.at(point),
            Shape::Uniform(law) => law.at(point),
            Shape::Exponential(law) => law.at(point),
            Shape::Gamma(law) => law.at(point),
            Shape::Lognormal(law) => law.at(point),
            Shape::Pareto(law) => law.at(point),
            Shape::Table(law) => law.at(point),
        }
    }
}

/// Reject a standard deviation above the maximum at this mean.
fn at_most(sigma_s: f64, max_s: f64, law: &str, mean_s: f64, remedy: &str) -> Result<(), LinkSettingsError> {
    // Their quotient may round past a limit that the settings just meet.
    if sigma_s <= max_s * (1.0 + 1e-12) {
        return Ok(());
    }
    if mean_s == 0.0 {
        return Err(LinkSettingsError::contradiction(
            "jitter_s",
            format!("{sigma_s:?}: needs delay_s above 0 to vary around"),
        ));
    }
    Err(LinkSettingsError::contradiction(
        "jitter_s",
        format!(
            "{sigma_s:?}: a delay that is {law} with the mean delay_s = {mean_s:?} and never negative has a standard \
             deviation of at most {max_s:?}; {remedy}"
        ),
    ))
}
