//! Tracking errors between the two sides, for one run or for several lanes.

use haptether_safety::{Axes, Real};

use super::{
    coupling::Present,
    metrics::{Metric, Metrics},
};

/// Differences of motion and force between the two sides, with the coupling at each time.
#[derive(Clone)]
pub(super) struct Tracking<const N: usize, S: Real = f64> {
    metrics: Metrics,
    pub(super) coupling: Present<N, S>,
    /// True position in m of the master at its newest tick.
    near_position: Option<Axes<N, S>>,
    /// `F_e` in N at the newest tick of the slave.
    far_force: Axes<N, S>,
    /// Positions in m of master and slave at engagement.
    anchor: Option<[Axes<N, S>; 2]>,
    /// Sums of the squared differences of position and force; `samples` counts them.
    squares: [S; 2],
    samples: [u64; 2],
}

impl<const N: usize, S: Real> Tracking<N, S> {
    /// Build the measure before the first tick.
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

    /// Combine runs into lanes before their first tick; None unless their metrics and commands are equal.
    pub(super) fn gather(of: &[&Tracking<N>]) -> Option<Self> {
        let metrics = of.first()?.metrics;
        let begins = |one: &&Tracking<N>| one.metrics == metrics && one.near_position.is_none();
        if !of.iter().all(begins) {
            return None;
        }
        let coupling = Present::gather(&of.iter().map(|one| &one.coupling).collect::<Vec<_>>())?;
        Some(Self::new(metrics, coupling))
    }

    /// Restart from the present positions: after a change of the coupling, the slave continues from where it is.
    pub(super) fn begin_anew(&mut self) {
        self.anchor = None;
    }

    /// Take a tick of the master: x and `F_device`. `is_coupled` is true if both sides are coupled.
    #[inline(always)] // once a tick, from few places
    pub(super) fn near(&mut self, is_coupled: bool, position: &Axes<N, S>, device_force: &Axes<N, S>) {
        if is_coupled && self.metrics.has(Metric::ForceError) {
            let difference = device_force - self.coupling.to_master(&self.far_force);
            self.squares[1] += difference.dot(&difference);
            self.samples[1] += 1;
        }
        self.near_position = Some(*position);
    }

    /// Take a tick of the slave: x and `F_e`. `is_coupled` is true if both sides are coupled.
    #[inline(always)] // as near
    pub(super) fn far(&mut self, is_coupled: bool, position: &Axes<N, S>, environment_force: &Axes<N, S>) {
        self.far_force = *environment_force;
        if !self.metrics.has(Metric::PositionError) {
            // The metric is not requested.
        } else if !is_coupled {
            // The next engagement starts from the positions at that time.
            self.anchor = None;
        } else if let Some(near_position) = &self.near_position {
            let [near, far] = self.anchor.get_or_insert([*near_position, *position]);
            let wanted = self.coupling.to_slave(&(near_position - *near));
            let difference = position - *far - wanted;
            self.squares[0] += difference.dot(&difference);
            self.samples[0] += 1;
        }
    }

    /// Return the root mean square of the differences in one lane: position in m, force in N; none without samples.
    pub(super) fn rmse(&self, lane: usize) -> [Option<f64>; 2] {
        [0, 1].map(|which| {
            let mean = (self.samples[which] > 0)
                .then(|| (self.squares[which].extract(lane) / self.samples[which] as f64).sqrt());
            // A sum that overflows has no useful value.
            mean.filter(|rmse| rmse.is_finite())
        })
    }
}
