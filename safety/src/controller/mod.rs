//! Safety controllers: when an observer calls the hand unsafe, remove the push and damp the motion.
//!
//! A controller is one file in this folder, which implements [`Controller`], and one line in the registry below. That
//! line defines its [`ControllerKind`], its bit in [`Tripped`], its order in the tick and its column in records. It
//! also defines its name in scenes, on the command line and in Python.

mod combined;
mod hand_grasp;
mod passivity;
mod probe;
mod registry;
mod research;
mod velocity_force;
mod windowed;

pub use combined::{Intervention, Response, SafetyController, SafetySettings};
pub(crate) use combined::{Judged, UNDECIDED};
pub(crate) use probe::NOT_FELT;
pub use probe::{FRICTION_ROOM, PROBED_DAMPING};
pub use registry::{Controllers, PerController, Tripped};
pub(crate) use research::Research;
pub use research::{ResearchController, ResearchObservation};

use crate::{
    About, Axes, DeviceModel, Observation, ParameterError, Real,
    parameter::{in_range, non_negative},
};
use haptether_numeric::{no_lanes, option};

registry::controllers! {
    /// VFC, Eq. 2.
    Vfc: velocity_force::VelocityForceController;
    /// HSC, Eq. 14.
    Hsc: hand_grasp::HandGraspController;
    /// WSC, Eq. 13.
    Wsc: windowed::WindowedSafetyController;
    /// PC, Eq. 12.
    Pc: passivity::PassivityController;
}

/// Controller that the registry builds, steps and names.
pub trait Controller<const N: usize, S: Real>: Sized {
    /// The same controller over `f64`.
    type One;
    /// Name, title and source.
    const ABOUT: &'static About;
    /// Names of the observer's value.
    const OBSERVED: &'static Observed;
    /// True if it reads `F_h`, which is then estimated.
    const READS_GRASP_FORCE: bool = false;
    /// True if it compares `F_v` with `F_h`; `F_v` then gets the lag of `F_h`.
    const READS_ALIGNED_FORCE: bool = false;
    /// True if it adds its own force; the other controllers request `-F_v - mu V`.
    const ADDS_FORCE: bool = false;

    /// Build the controller from `settings`, for a device sampled every `period_s`.
    ///
    /// All values are checked, also for an unused controller. An unused controller reserves no memory and applies no
    /// damping.
    fn build(
        device: &DeviceModel<N>,
        period_s: f64,
        settings: &SafetySettings,
        is_used: bool,
    ) -> Result<Self::One, ParameterError>;

    /// Gather one controller per lane; return None if they cannot be stepped at once.
    fn gather(of: &[&Self::One]) -> Option<Self>;

    /// Observe one tick and return the verdict.
    fn step(&mut self, seen: &Observation<N, S>) -> Verdict<N, S>;

    /// Return the threshold of the observer's value.
    fn threshold(settings: &SafetySettings) -> f64;

    /// Return the energy in J that it wanted dissipated and that the force `delivered` will not dissipate in this
    /// tick.
    ///
    /// `observed` is the observer's value, `delivered` the force in N after every limit.
    #[inline(always)]
    fn owed_energy_j(&self, _observed: S, _delivered: &Axes<N, S>, _velocity: &Axes<N, S>) -> S {
        S::splat(0.0)
    }

    /// Clear the memory of past ticks.
    fn reset(&mut self) {}
}

/// Names of the value of a controller's observer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Observed {
    /// Symbol with the unit.
    pub symbol: &'static str,
    /// Column in records and traces.
    pub column: &'static str,
    /// Description of the column in a record.
    pub meaning: &'static str,
}

/// Result of a controller at one tick.
#[derive(Clone, Copy, Debug)]
pub struct Verdict<const N: usize, S: Real = f64> {
    /// Value of its observer.
    pub observed: S,
    /// Lanes in which the tick is unsafe.
    pub is_unsafe: S::SimdBool,
    /// Own force in N of a controller that [adds one](Controller::ADDS_FORCE).
    pub force: Axes<N, S>,
}

impl<const N: usize, S: Real> Verdict<N, S> {
    /// Return the verdict of a controller that adds no force.
    #[inline(always)]
    fn without_force(observed: S, is_unsafe: S::SimdBool) -> Self {
        Self { observed, is_unsafe, force: Axes::zeros() }
    }
}

/// Cancel the rendered force and damp the motion, `F_c = -F_v - mu V`, so that the device renders `-mu V`.
///
/// Source: paper Eq. 2, 13 and 14, which share it.
#[inline(always)]
fn cancel_and_damp<const N: usize, S: Real>(seen: &Observation<N, S>, damping: S) -> Axes<N, S> {
    -seen.rendered_force - seen.velocity * damping
}

/// Check a damping mu in N s/m: up to `m / (5 dT)`, a sampled loop applies it without adding energy to the motion.
///
/// Held over a tick, `-mu V` turns V into `V (1 - mu dT / m)`, which reverses the motion above `m / dT`. An estimated
/// V lags by several ticks, and damping that lags acts as a spring that pushes. At a fifth of `m / dT`, every
/// smoothing estimator of this crate still brings a device to rest (`tests/all/damping.rs`).
///
/// The bound applies only where the damping is used; the defaults suit a stylus at 1 kHz.
fn dampable<const N: usize>(
    name: &'static str,
    symbol: &'static str,
    damping: f64,
    device: &DeviceModel<N>,
    period_s: f64,
    is_applied: bool,
) -> Result<f64, ParameterError> {
    if !is_applied {
        return non_negative(name, symbol, damping);
    }
    // A scene computes the bound from its decimal period, an endpoint from whole ns: they differ by rounding.
    let highest = device.lightest_kg() / (5.0 * period_s) * (1.0 + 8.0 * f64::EPSILON);
    in_range(name, symbol, damping, 0.0, highest, "between 0 and m / (5 dT)")
}
