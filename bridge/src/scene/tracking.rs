//! How far the two sides of a run are apart, of one run or of several side by side.

use haptether_safety::{Axes, Real};

use super::{
    coupling::Present,
    metrics::{Metric, Metrics},
};

/// The differences of motion and force between two sides, under the coupling as it is at each time.
#[derive(Clone)]
pub(super) struct Tracking<const N: usize, S: Real = f64> {
    metrics: Metrics,
    pub(super) coupling: Present<N, S>,
    /// True position in m of the master at its newest tick.
    near_position: Option<Axes<N, S>>,
    /// `F_e` in N at the newest tick of the slave.
    far_force: Axes<N, S>,
    /// Where master and slave were when both had engaged.
    anchor: Option<[Axes<N, S>; 2]>,
    /// Sums of the squared differences of position and force, and how many.
    squares: [S; 2],
    samples: [u64; 2],
}

impl<const N: usize, S: Real> Tracking<N, S> {
    /// Before the first tick.
    pub(super) fn new(metrics: Metrics, coupling: Present<N, S>) -> Self {
        Self {
            metrics,
            coupling,
            near_position: None,
            far_force: Axes::zeros(),
            anchor: None,
            squares: [S::zero(); 2],
            samples: [0; 2],
        }
    }

    /// Run side by side, before their first tick; None unless they measure the same under the same commands.
    pub(super) fn gather(of: &[&Tracking<N>]) -> Option<Self> {
        let metrics = of.first()?.metrics;
        let begins = |one: &&Tracking<N>| one.metrics == metrics && one.near_position.is_none();
        if !of.iter().all(begins) {
            return None;
        }
        let coupling = Present::gather(&of.iter().map(|one| &one.coupling).collect::<Vec<_>>())?;
        Some(Self::new(metrics, coupling))
    }

    /// The operator has changed the coupling: the slave goes on from where it is, so it is measured from there.
    pub(super) fn begin_anew(&mut self) {
        self.anchor = None;
    }

    /// Take a tick of the master: x and `F_device`, and whether both sides are coupled.
    #[inline(always)] // once a tick, from few places
    pub(super) fn near(&mut self, is_coupled: bool, position: &Axes<N, S>, device_force: &Axes<N, S>) {
        if is_coupled && self.metrics.has(Metric::ForceError) {
            let difference = device_force - self.coupling.to_master(&self.far_force);
            self.squares[1] += difference.dot(&difference);
            self.samples[1] += 1;
        }
        self.near_position = Some(*position);
    }

    /// Take a tick of the slave: x and `F_e`, and whether both sides are coupled.
    #[inline(always)] // as of the master
    pub(super) fn far(&mut self, is_coupled: bool, position: &Axes<N, S>, environment_force: &Axes<N, S>) {
        self.far_force = *environment_force;
        if !self.metrics.has(Metric::PositionError) {
            // Nobody asks for it.
        } else if !is_coupled {
            // They engage anew from where both are then.
            self.anchor = None;
        } else if let Some(near_position) = &self.near_position {
            let [near, far] = self.anchor.get_or_insert([*near_position, *position]);
            let wanted = self.coupling.to_slave(&(near_position - *near));
            let difference = position - *far - wanted;
            self.squares[0] += difference.dot(&difference);
            self.samples[0] += 1;
        }
    }

    /// The roots of the mean squared differences of position in m and of force in N, of one lane; none where none was measured.
    pub(super) fn rmse(&self, lane: usize) -> [Option<f64>; 2] {
        [0, 1].map(|which| {
            let mean = (self.samples[which] > 0)
                .then(|| (self.squares[which].extract(lane) / self.samples[which] as f64).sqrt());
            // What overflows says nothing beyond that it did.
            mean.filter(|rmse| rmse.is_finite())
        })
    }
}
