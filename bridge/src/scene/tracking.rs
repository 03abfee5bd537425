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
    master_position: Option<Axes<N, S>>,
    /// `F_e` in N at the newest tick of the slave.
    slave_force: Axes<N, S>,
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
            master_position: None,
            slave_force: Axes::zeros(),
            anchor: None,
            squares: [S::zero(); 2],
            samples: [0; 2],
        }
    }

    /// Combine runs into lanes before their first tick; None unless their metrics and commands are equal.
    pub(super) fn gather(of: &[&Tracking<N>]) -> Option<Self> {
        let metrics = of.first()?.metrics;
        let begins = |one: &&Tracking<N>| one.metrics == metrics && one.master_position.is_none();
        if !of.iter().all(begins) {
            return None;
        }
        let coupling = Present::gather(&of.iter().map(|one| &one.coupling).collect::<Vec<_>>())?;
        Some(Self::new(metrics, coupling))
    }

    /// Restart from the present positions: after a change of the coupling, the slave continues from where it is.
    pub(super) fn restart(&mut self) {
        self.anchor = None;
    }

    /// Take a tick of the master: x and `F_device`. `is_coupled` is true if both sides are coupled.
    #[inline(always)] // once a tick, from few places
    pub(super) fn take_master(&mut self, is_coupled: bool, position: &Axes<N, S>, device_force: &Axes<N, S>) {
        if is_coupled && self.metrics.has(Metric::ForceError) {
            let difference = device_force - self.coupling.to_master(&self.slave_force);
            self.squares[1] += difference.dot(&difference);
            self.samples[1] += 1;
        }
        self.master_position = Some(*position);
    }

    /// Take a tick of the slave: x and `F_e`. `is_coupled` is true if both sides are coupled.
    #[inline(always)] // as near
    pub(super) fn take_slave(
        &mut self,
        is_coupled: bool,
        position: &Axes<N, S>,
        environment_force: &Axes<N, S>,
    ) {
        self.slave_force = *environment_force;
        if !self.metrics.has(Metric::PositionError) {
            // The metric is not requested.
        } else if !is_coupled {
            // The next engagement starts from the positions at that time.
            self.anchor = None;
        } else if let Some(master_position) = &self.master_position {
            let [master, slave] = self.anchor.get_or_insert([*master_position, *position]);
            let wanted = self.coupling.to_slave(&(master_position - *master));
            let difference = position - *slave - wanted;
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
