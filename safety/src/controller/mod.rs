//! Safety controllers: when an observer calls the hand unsafe, take the push away and damp.
//!
//! A controller is one file here, which implements [`Controller`], and one line in the registry below. From that line
//! come its [`ControllerKind`], its bit in [`Tripped`], its place in the tick, its name in scenes, on the command line
//! and in Python, and its column in what is recorded.

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
    lanes::{nowhere, option},
    parameter::{in_range, non_negative},
};

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

/// A controller: what the registry builds, steps and names.
pub trait Controller<const N: usize, S: Real>: Sized {
    /// The same controller over `f64`.
    type One;
    /// What it is called.
    const ABOUT: &'static About;
    /// What its observer's value is called.
    const OBSERVED: &'static Observed;
    /// Whether it reads `F_h`, which is then estimated.
    const READS_GRASP_FORCE: bool = false;
    /// Whether it compares `F_v` with `F_h`: `F_v` is then made as late as `F_h`.
    const READS_ALIGNED_FORCE: bool = false;
    /// Whether it adds a force of its own; the others call for `-F_v - mu V`.
    const ADDS_FORCE: bool = false;

    /// The controller that `settings` describe, for a device sampled every `period_s`. All numbers are checked also
    /// where it is not used, but then it reserves no memory and applies no damping.
    fn build(
        device: &DeviceModel<N>,
        period_s: f64,
        settings: &SafetySettings,
        is_used: bool,
    ) -> Result<Self::One, ParameterError>;

    /// As many controllers as there are lanes, if they can be stepped at once; else None.
    fn gather(of: &[&Self::One]) -> Option<Self>;

    /// What it makes of one tick.
    fn step(&mut self, seen: &Observation<N, S>) -> Verdict<N, S>;

    /// What its observer's value is compared with.
    fn threshold(settings: &SafetySettings) -> f64;

    /// Energy in J that it wanted dissipated at a tick that `observed` so much, and the force `delivered` (N, after
    /// every limit) will not have dissipated by the end of that tick.
    #[inline(always)]
    fn owed_energy_j(&self, _observed: S, _delivered: &Axes<N, S>, _velocity: &Axes<N, S>) -> S {
        S::splat(0.0)
    }

    /// Clears what it remembers of past ticks.
    fn reset(&mut self) {}
}

/// What the value of a controller's observer is called.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Observed {
    /// Its symbol, with the unit.
    pub symbol: &'static str,
    /// Its column in records and traces.
    pub column: &'static str,
    /// What a record says of that column.
    pub meaning: &'static str,
}

/// What a controller makes of one tick.
#[derive(Clone, Copy, Debug)]
pub struct Verdict<const N: usize, S: Real = f64> {
    /// The value of its observer.
    pub observed: S,
    /// Where the tick is unsafe.
    pub is_unsafe: S::SimdBool,
    /// A force in N of its own, for a controller that [adds one](Controller::ADDS_FORCE).
    pub force: Axes<N, S>,
}

impl<const N: usize, S: Real> Verdict<N, S> {
    /// The verdict of a controller that adds no force.
    #[inline(always)]
    fn without_force(observed: S, is_unsafe: S::SimdBool) -> Self {
        Self { observed, is_unsafe, force: Axes::zeros() }
    }
}

/// `F_c = -F_v - mu V`: cancels the rendered force and damps the motion, so that the device renders `-mu V`.
///
/// Source: paper Eq. 2, 13 and 14, which share it.
#[inline(always)]
fn cancel_and_damp<const N: usize, S: Real>(seen: &Observation<N, S>, damping: S) -> Axes<N, S> {
    -seen.rendered_force - seen.velocity * damping
}

/// Passes a damping mu in N s/m that a sampled loop can apply without feeding the motion: up to `m / (5 dT)`.
///
/// Held over a tick, `-mu V` turns V into `V (1 - mu dT / m)`, which reverses the motion above `m / dT`; but an
/// estimated V lags by several ticks, and damping that is late becomes a spring that pushes. At a fifth, every
/// smoothing estimator of this crate still brings a device to rest (`tests/damping.rs`).
///
/// The bound holds only where the damping is applied: the defaults suit a stylus at 1 kHz.
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
    let highest = device.lightest_kg() / (5.0 * period_s);
    in_range(name, symbol, damping, 0.0, highest, "between 0 and m / (5 dT)")
}
