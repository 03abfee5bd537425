//! The delay as a path in time that follows its law, forgets itself over tau, and never falls too fast.
//!
//! Order is kept if the delay falls by less than 1 s/s. The usual AR(1) process is so rough that it falls faster over
//! short times, however small its variance; to let early packets wait for the ones before them (a queue served in turn)
//! then raises the mean and cuts the variance. So the path here has a bounded speed instead.
//!
//! z is the standard normal variate of which the delay is the quantile Q(Phi(z)) (Gaussian copula). It moves at a speed
//! `s(z) = min(c, m / |dD/dz|)`, up and down alternately. A run ends at a rate that is the sum of two:
//!
//! - `-d ln(g) / dy` along the run, where positive; `y` is the time it takes to get to z at that speed, and
//!   `g = phi(z) s(z)` the density of y. Towards likelier delays a run goes on, away from them it ends the sooner the
//!   faster they thin out. This alone leaves the law as it is: what enters any stretch balances what leaves it.
//! - `s(z)^2 tau / 2`, less the mean of the former over both directions. It is the same for both directions and so
//!   leaves the law too. It makes z diffuse at the rate 1 / tau everywhere: seen over more than a run, z is the
//!   Ornstein-Uhlenbeck process, AR(1) in time, of the autocorrelation `exp(-t / tau)`. Its tau is such that the delay,
//!   a function of z, is correlated by 1 / e over the time of the settings.
//!
//! With the cells of the law the density is a step function of y and the delay a line in each cell; for these the
//! process is exact, not an approximation in small steps.
//!
//! Source: J. Bierkens, P. Fearnhead, G. Roberts, "The zig-zag process and super-efficient sampling for Bayesian
//! analysis of big data", Annals of Statistics 47(3), 2019, section 2; M. Kac, "A stochastic model related to the
//! telegrapher's equation", Rocky Mountain J. Math. 4(3), 1974 (its diffusion).

use super::cells::{COUNT, Cells, WIDTH};

/// Fastest change of the delay in s/s: a little short of what would let a packet catch up with the one before.
const FASTEST: f64 = 0.9;
/// Shortest correlation time by standard deviations of the delay.
const MIN_TAU_SIGMAS: f64 = 4.0;
/// Shortest correlation time in ns; far above the resolution of time.
const MIN_TAU_NS: f64 = 20_000.0;
/// Number of velocity's correlation times in tau: at least, and where the order requires no less, at most.
const MIN_SWITCHES: f64 = 12.0;
const MAX_SWITCHES: f64 = 50.0;

/// Cells that a run often passes.
const NEAR: usize = 16;

/// The traversals up and down through the cells, and the memory of the path.
#[derive(Debug)]
pub(super) struct Path {
    pub(super) up: Traversal,
    pub(super) down: Traversal,
    /// Correlation time of z.
    pub(super) tau_ns: f64,
}

impl Path {
    /// The delay is correlated by 1 / e over `tau_s`, with `keep_order` over no less than the order permits. Delays
    /// forget themselves sooner than z does, unless they are normal, so z is given a longer time.
    pub(super) fn new(cells: &Cells, tau_s: f64, sigma_s: f64, keep_order: bool) -> Self {
        let min_ns = if keep_order { MIN_TAU_SIGMAS * sigma_s * 1e9 } else { 0.0 };
        let wanted_ns = (tau_s * 1e9).max(min_ns).max(MIN_TAU_NS);
        // Nearer than this the cells are not to the law; what is linear is not further off, and need not be integrated.
        let rho = if cells.are_linear() { 0.0 } else { cells.correlation_for_one_e() };
        let tau_ns = if rho < libm::exp(-1.0) + 1e-4 { wanted_ns } else { wanted_ns / -libm::log(rho) };
        // c^2 tau eps = 1, where eps is the time over which the velocity forgets itself. The slope of a normal delay
        // is then sigma / sqrt(tau eps): gentle where that is free, steep where tau is short.
        let switches = if keep_order {
            let ratio = tau_ns / (sigma_s * 1e9);
            (0.5 * ratio * ratio).clamp(MIN_SWITCHES, MAX_SWITCHES)
        } else {
            MAX_SWITCHES
        };
        let speed = switches.sqrt() / tau_ns;
        let fastest = if keep_order { FASTEST } else { f64::INFINITY };
        let mut cells: Vec<Cell> = (0..COUNT)
            .map(|k| {
                let [from_ns, to_ns] = [cells.delay_ns[k], cells.delay_ns[k + 1]];
                let length_ns = (WIDTH / speed).max((to_ns - from_ns) / fastest);
                Cell { length_ns, from_ns, to_ns, density: cells.mass[k] / length_ns, switching_rate: 0.0 }
            })
            .collect();
        for k in 0..COUNT {
            let [before, here, after] = [k.saturating_sub(1), k, (k + 1).min(COUNT - 1)].map(|k| cells[k]);
            // What the slope of the density makes runs end, on the mean of both directions.
            let jumps = libm::log(before.density / here.density).abs()
                + libm::log(here.density / after.density).abs();
            let by_slope = 0.25 * jumps / here.length_ns;
            let local = WIDTH / here.length_ns;
            cells[k].switching_rate = (0.5 * local * local * tau_ns - by_slope).max(0.0);
        }
        let up = Traversal::through(cells.iter().copied());
        let down = Traversal::through(cells.iter().rev().copied().map(Cell::reversed));
        Self { up, down, tau_ns }
    }
}

/// A stretch of y that a run passes in `length_ns`, on which the delay goes linearly from one value to another.
#[derive(Clone, Copy, Debug)]
struct Cell {
    length_ns: f64,
    from_ns: f64,
    to_ns: f64,
    density: f64,
    switching_rate: f64,
}

impl Cell {
    fn reversed(self) -> Self {
        Self { from_ns: self.to_ns, to_ns: self.from_ns, ..self }
    }
}

/// The cells in the order in which one direction meets them.
#[derive(Debug)]
pub(super) struct Traversal {
    /// Where each cell begins, in ns of travel, and last where the traversal ends.
    starts_ns: Box<[f64]>,
    /// Delay in ns there.
    delays_ns: Box<[f64]>,
    /// Switching rate summed up to just after each of these places.
    hazard: Box<[f64]>,
    /// Switching rate in each cell, per ns.
    switching_rate: Box<[f64]>,
}

/// A place on a traversal, and the cell in which it lies.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Place {
    pub(super) y_ns: f64,
    pub(super) cell: usize,
}

impl Traversal {
    fn through(cells: impl Iterator<Item = Cell>) -> Self {
        let cells: Vec<Cell> = cells.collect();
        let (mut start, mut sum) = (0.0, 0.0);
        let (mut starts_ns, mut hazard, mut density) = (Vec::new(), Vec::new(), 0.0);
        for cell in &cells {
            // Into a thinner cell a run goes on with the probability of the quotient of their densities.
            sum += libm::log(density / cell.density).max(0.0);
            density = cell.density;
            starts_ns.push(start);
            hazard.push(sum);
            start += cell.length_ns;
            sum += cell.switching_rate * cell.length_ns;
        }
        starts_ns.push(start);
        let ends = cells.first().map(|cell| cell.from_ns).into_iter();
        Self {
            starts_ns: starts_ns.into(),
            delays_ns: ends.chain(cells.iter().map(|cell| cell.to_ns)).collect(),
            hazard: hazard.into(),
            switching_rate: cells.iter().map(|cell| cell.switching_rate).collect(),
        }
    }

    /// The place a part into a cell.
    pub(super) fn within(&self, cell: usize, part: f64) -> Place {
        let [start, end] = [self.starts_ns[cell], self.starts_ns[cell + 1]];
        Place { y_ns: start + (end - start) * part, cell }
    }

    /// The same place in the other direction.
    pub(super) fn mirrored(&self, place: Place) -> Place {
        Place { y_ns: (self.end_ns() - place.y_ns).max(0.0), cell: COUNT - 1 - place.cell }
    }

    /// Where a run from `from` ends whose summed rate reaches `exponential`.
    pub(super) fn switch(&self, from: Place, exponential: f64) -> Place {
        let passed = self.switching_rate[from.cell] * (from.y_ns - self.starts_ns[from.cell]);
        let target = self.hazard[from.cell] + passed + exponential;
        // Most runs are short: look near first.
        let mut end = (from.cell + NEAR).min(COUNT);
        while end < COUNT && self.hazard[end] <= target {
            end = (end + 4 * NEAR).min(COUNT);
        }
        let beyond = self.hazard[from.cell..end].partition_point(|&hazard| hazard <= target);
        let cell = from.cell + beyond.max(1) - 1;
        let end_ns = self.starts_ns[cell + 1];
        let rate = self.switching_rate[cell];
        // At the end of the cell the sum jumps.
        let rest = target - self.hazard[cell];
        let y_ns = if rate > 0.0 { (self.starts_ns[cell] + rest / rate).min(end_ns) } else { end_ns };
        Place { y_ns, cell }
    }

    /// Where the traversal ends.
    pub(super) fn end_ns(&self) -> f64 {
        self.starts_ns[COUNT]
    }

    /// The cell of a place between two others.
    pub(super) fn cell(&self, y_ns: f64, first: usize, last: usize) -> usize {
        first + self.starts_ns[first + 1..=last].partition_point(|&start| start <= y_ns)
    }

    /// The delay in ns at a place.
    pub(super) fn delay_ns(&self, Place { y_ns, cell }: Place) -> f64 {
        let [start, end] = [self.starts_ns[cell], self.starts_ns[cell + 1]];
        let [a, b] = [self.delays_ns[cell], self.delays_ns[cell + 1]];
        a + (b - a) * ((y_ns - start) / (end - start)).clamp(0.0, 1.0)
    }
}
