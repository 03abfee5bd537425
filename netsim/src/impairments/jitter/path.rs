//! Delay as a path in time that follows its distribution, decorrelates over tau, and never falls too fast.
//!
//! Order is kept if the delay falls by less than 1 s/s. The usual AR(1) process is so rough that it falls
//! faster over short times, however small its variance. Letting early packets wait for previous ones (a FIFO
//! queue) then raises the mean and cuts the variance. The path here has a bounded speed instead.
//!
//! z is a standard normal variate, and the delay is its quantile Q(Phi(z)) (Gaussian copula). z moves at the
//! speed `s(z) = min(c, m / |dD/dz|)`, alternately up and down. A run ends at the sum of two rates:
//!
//! - `-d ln(g) / dy` along the run, where positive. `y` is the travel time to z at that speed, and
//!   `g = phi(z) s(z)` is the density of y. A run continues towards more likely delays; away from them it
//!   ends sooner the faster the density falls. This rate preserves the distribution: the flows into and out
//!   of any stretch balance.
//! - `s(z)^2 tau / 2`, minus the mean of the former over both directions. It is equal for both directions, so
//!   it also preserves the distribution. It makes z diffuse at the rate 1 / tau everywhere. Over more than a
//!   run, z is the Ornstein-Uhlenbeck process, AR(1) in time, with autocorrelation `exp(-t / tau)`. Its tau
//!   is chosen so that the delay, a function of z, has correlation 1 / e over the time in the settings.
//!
//! With cells, the density is a step function of y and the delay is linear in each cell. For these the
//! process is exact, not an approximation in small steps.
//!
//! Source: J. Bierkens, P. Fearnhead, G. Roberts, "The zig-zag process and super-efficient sampling for
//! Bayesian analysis of big data", Annals of Statistics 47(3), 2019, section 2; M. Kac, "A stochastic model
//! related to the telegrapher's equation", Rocky Mountain J. Math. 4(3), 1974 (its diffusion).

use super::cells::{COUNT, Cells, WIDTH};

/// Maximum rate of change of the delay in s/s; at 1 a packet would catch up with the previous one.
const FASTEST: f64 = 0.9;
/// Minimum correlation time in standard deviations of the delay.
const MIN_TAU_SIGMAS: f64 = 4.0;
/// Minimum correlation time in ns; far above the time resolution.
const MIN_TAU_NS: f64 = 20_000.0;
/// Minimum number of velocity correlation times per tau, and the maximum, used unless order requires fewer.
const MIN_SWITCHES: f64 = 12.0;
const MAX_SWITCHES: f64 = 50.0;

#[derive(Clone, Debug)]
pub(super) struct Path {
    /// Down and up.
    traversals: [Traversal; 2],
    /// Correlation time of z.
    pub(super) tau_ns: f64,
}

impl Path {
    /// Build a path whose delay has correlation 1 / e over `tau_s`; with `keep_order`, over at least the
    /// minimum for order. Except for normal delays, delays decorrelate faster than z, so z gets a longer
    /// time.
    pub(super) fn new(cells: &Cells, tau_s: f64, sigma_s: f64, keep_order: bool) -> Self {
        let min_ns = if keep_order { MIN_TAU_SIGMAS * sigma_s * 1e9 } else { 0.0 };
        let wanted_ns = (tau_s * 1e9).max(min_ns).max(MIN_TAU_NS);
        // The cells are this accurate in correlation. A linear delay needs no integration.
        let rho = if cells.are_linear() { 0.0 } else { cells.correlation_for_one_e() };
        let tau_ns = if rho < libm::exp(-1.0) + 1e-4 { wanted_ns } else { wanted_ns / -libm::log(rho) };
        // c^2 tau eps = 1, where eps is the correlation time of the velocity. The slope of a normal delay is
        // then sigma / sqrt(tau eps): small for a long tau, large for a short one.
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
            // Switching rate due to the density slope, averaged over both directions.
            let jumps = libm::log(before.density / here.density).abs()
                + libm::log(here.density / after.density).abs();
            let by_slope = 0.25 * jumps / here.length_ns;
            let local = WIDTH / here.length_ns;
            cells[k].switching_rate = (0.5 * local * local * tau_ns - by_slope).max(0.0);
        }
        let up = Traversal::through(cells.iter().copied());
        let down = Traversal::through(cells.iter().rev().copied().map(Cell::reversed));
        Self { traversals: [down, up], tau_ns }
    }

    #[inline]
    pub(super) fn traversal(&self, rises: bool) -> &Traversal {
        &self.traversals[usize::from(rises)]
    }
}

/// Stretch of y that a run passes in `length_ns`, with a linear delay.
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

/// Start of a cell on a traversal.
#[derive(Clone, Copy, Debug)]
struct Border {
    /// In ns of travel.
    start_ns: f64,
    /// Switching rate integrated to just after the border.
    hazard: f64,
    /// Switching rate in the cell, per ns.
    switching_rate: f64,
    /// Reciprocal of the switching rate; a division would be on the critical path.
    per_rate: f64,
}

/// Cells in the order of one direction.
#[derive(Clone, Debug)]
pub(super) struct Traversal {
    /// Start of each cell, and the end of the traversal.
    borders: Box<[Border]>,
    /// Delay in ns at each border.
    delay_ns: Box<[f64]>,
    by_start: Bins,
    by_hazard: Bins,
    /// Start in ns, and slope per ns of travel, of a delay on one line through all cells. A normal delay at
    /// constant speed is such a line.
    line: Option<[f64; 2]>,
}

/// Position on a traversal, and its cell.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Place {
    pub(super) y_ns: f64,
    pub(super) cell: usize,
}

impl Traversal {
    fn through(cells: impl Iterator<Item = Cell>) -> Self {
        let cells: Vec<Cell> = cells.collect();
        let (mut start_ns, mut hazard, mut density) = (0.0, 0.0, 0.0);
        let mut delay_ns = cells.first().map_or(0.0, |cell| cell.from_ns);
        let (mut borders, mut delays) = (Vec::with_capacity(COUNT + 1), Vec::with_capacity(COUNT + 1));
        for cell in &cells {
            // A run enters a thinner cell with a probability equal to the ratio of their densities.
            hazard += libm::log(density / cell.density).max(0.0);
            density = cell.density;
            let switching_rate = cell.switching_rate;
            borders.push(Border { start_ns, hazard, switching_rate, per_rate: 1.0 / switching_rate });
            delays.push(delay_ns);
            start_ns += cell.length_ns;
            delay_ns = cell.to_ns;
            hazard += cell.switching_rate * cell.length_ns;
        }
        borders.push(Border {
            start_ns,
            hazard: f64::INFINITY,
            switching_rate: 0.0,
            per_rate: f64::INFINITY,
        });
        delays.push(delay_ns);
        let begins = |value: fn(&Border) -> f64| std::array::from_fn(|cell| value(&borders[cell]));
        let by_start = Bins::of(&begins(|border| border.start_ns), start_ns);
        let by_hazard = Bins::of(&begins(|border| border.hazard), hazard);
        let line = line_through(&borders, &delays);
        Self { borders: borders.into(), delay_ns: delays.into(), by_start, by_hazard, line }
    }

    /// Position at a fraction of a cell.
    pub(super) fn within(&self, cell: usize, part: f64) -> Place {
        let [start, end] = [self.borders[cell].start_ns, self.borders[cell + 1].start_ns];
        Place { y_ns: start + (end - start) * part, cell }
    }

    /// Same position in the other direction.
    pub(super) fn mirrored(&self, place: Place) -> Place {
        Place { y_ns: (self.end_ns() - place.y_ns).max(0.0), cell: COUNT - 1 - place.cell }
    }

    /// End of a run from `from`, at which its integrated rate reaches `exponential`.
    pub(super) fn switch(&self, from: Place, exponential: f64) -> Place {
        let first = &self.borders[from.cell];
        let passed = first.switching_rate * (from.y_ns - first.start_ns);
        let target = first.hazard + passed + exponential;
        let mut near = self.by_hazard.near(target).max(from.cell);
        // Usually this cell or a neighbour, unpredictably: select without branching.
        let before = near.saturating_sub(1).max(from.cell);
        if let Some([_, one, other]) = self.borders.get(before..before + 3) {
            near = before + usize::from(one.hazard <= target) + usize::from(other.hazard <= target);
        }
        let cell = self.last(near, from.cell, COUNT - 1, |border| border.hazard <= target);
        let [Border { start_ns, hazard, switching_rate: rate, per_rate }, Border { start_ns: end_ns, .. }] =
            [self.borders[cell], self.borders[cell + 1]];
        // The integral jumps at the end of the cell.
        let rest = target - hazard;
        let y_ns = if rate > 0.0 { (start_ns + rest * per_rate).min(end_ns) } else { end_ns };
        Place { y_ns, cell }
    }

    pub(super) fn end_ns(&self) -> f64 {
        self.borders[COUNT].start_ns
    }

    /// Delay in ns at a position between two cells.
    #[inline(always)] // per packet
    pub(super) fn delay_between(&self, y_ns: f64, first: usize, last: usize) -> f64 {
        if let Some([begin_ns, slope]) = self.line {
            return begin_ns + slope * y_ns;
        }
        self.delay_ns(Place { y_ns, cell: self.cell(y_ns, first, last) })
    }

    /// Cell of a position between two cells.
    fn cell(&self, y_ns: f64, first: usize, last: usize) -> usize {
        let near = self.by_start.near(y_ns).clamp(first, last);
        let [border, next] = [&self.borders[near], &self.borders[near + 1]];
        if (border.start_ns..next.start_ns).contains(&y_ns) {
            return near;
        }
        self.last(near, first, last, |border| border.start_ns <= y_ns)
    }

    /// Same for a position close to cell `last`: the end of a run less 1 ns, or beyond it.
    pub(super) fn cell_before(&self, y_ns: f64, first: usize, last: usize) -> usize {
        self.last(last, first, last, |border| border.start_ns <= y_ns)
    }

    /// Last cell in `first..=last` whose border satisfies `holds`; `first` if none does. `holds` must be true
    /// up to some border and false after it. The search starts at `near`.
    fn last(&self, near: usize, first: usize, last: usize, holds: impl Fn(&Border) -> bool) -> usize {
        let mut cell = near;
        while cell > first && !holds(&self.borders[cell]) {
            cell -= 1;
        }
        while cell < last && holds(&self.borders[cell + 1]) {
            cell += 1;
        }
        cell
    }

    fn delay_ns(&self, Place { y_ns, cell }: Place) -> f64 {
        let [start, end] = [self.borders[cell].start_ns, self.borders[cell + 1].start_ns];
        let [a, b] = [self.delay_ns[cell], self.delay_ns[cell + 1]];
        a + (b - a) * ((y_ns - start) / (end - start)).clamp(0.0, 1.0)
    }
}

/// Maximum distance of a border from the line, as a fraction of the delay range: its position is a sum over
/// the cells.
const MAX_OFF_BY_RANGE: f64 = COUNT as f64 * f64::EPSILON;
/// Same as a fraction of the delays, which are scaled and shifted.
const MAX_OFF_BY_DELAY: f64 = 8.0 * f64::EPSILON;

/// Start and slope of the delay if all borders lie on a line up to rounding.
fn line_through(borders: &[Border], delays: &[f64]) -> Option<[f64; 2]> {
    let (&first_ns, &last_ns) = (delays.first()?, delays.last()?);
    let range_ns = last_ns - first_ns;
    let slope = range_ns / borders.last()?.start_ns;
    let max_off_ns = MAX_OFF_BY_RANGE * range_ns.abs() + MAX_OFF_BY_DELAY * first_ns.max(last_ns);
    let mut places = borders.iter().zip(delays);
    let is_line =
        places.all(|(border, delay_ns)| (first_ns + slope * border.start_ns - delay_ns).abs() <= max_off_ns);
    is_line.then_some([first_ns, slope])
}

/// Approximate lookup of a cell by bins of equal width; exact for cells of equal width.
#[derive(Clone, Debug)]
struct Bins {
    per_unit: f64,
    /// Cell at the middle of each bin.
    cells: Box<[u16; COUNT]>,
}

impl Bins {
    /// From non-decreasing cell starts in 0 to `end`.
    fn of(begins: &[f64; COUNT], end: f64) -> Self {
        let width = end / COUNT as f64;
        let mut cells = Box::new([0; COUNT]);
        for (bin, cell) in cells.iter_mut().enumerate() {
            let middle = (bin as f64 + 0.5) * width;
            let beyond = begins.partition_point(|&begin| begin <= middle);
            *cell = u16::try_from(beyond.saturating_sub(1)).unwrap_or(0);
        }
        Self { per_unit: 1.0 / width, cells }
    }

    #[inline]
    fn near(&self, value: f64) -> usize {
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "what is outside saturates"
        )]
        let bin = (value * self.per_unit) as u32 as usize;
        usize::from(self.cells[bin.min(COUNT - 1)])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::impairments::law::DelayLaw;
    use crate::{Distribution, LinkSettings};

    /// On a line, the delay equals that by cells; otherwise it equals that of the searched cell. It does not
    /// jump at a turn.
    #[test]
    fn a_delay_is_that_of_the_cells_by_a_line_or_without() {
        for (distribution, delay_s, keep_order, has_line) in [
            (Distribution::Normal, 0.05, true, true),
            (Distribution::Normal, 3600.0, false, true),
            // Truncated at zero.
            (Distribution::Normal, 0.02, true, false),
            (Distribution::Uniform, 0.05, true, false),
            (Distribution::Lognormal, 0.05, false, false),
        ] {
            let base = LinkSettings { delay_s, jitter_s: 0.005, ..LinkSettings::default() };
            let settings = LinkSettings { distribution: distribution.clone(), ..base };
            let cells = Cells::of(&DelayLaw::new(&settings).unwrap());
            let path = Path::new(&cells, 0.1, 0.005, keep_order);
            // Half a unit in the last place for each sum over the cells, plus some for the delays.
            let range_ns = cells.delay_ns[COUNT] - cells.delay_ns[0];
            let most_ns =
                0.5 * COUNT as f64 * f64::EPSILON * range_ns + 4.0 * f64::EPSILON * cells.delay_ns[COUNT];
            for rises in [false, true] {
                let (traversal, other) = (path.traversal(rises), path.traversal(!rises));
                assert_eq!(traversal.line.is_some(), has_line, "{distribution:?} {delay_s}");
                for step in 0..=4 * COUNT {
                    let cell = (step / 4).min(COUNT - 1);
                    let place = traversal.within(cell, 0.25 * (step - 4 * cell) as f64);
                    let by_cell = traversal.delay_ns(place);
                    for [first, last] in [[place.cell; 2], [0, COUNT - 1], [place.cell / 2, place.cell]] {
                        let off_ns = traversal.delay_between(place.y_ns, first, last) - by_cell;
                        assert!(off_ns.abs() <= most_ns, "{distribution:?} {delay_s} {step}: {off_ns}");
                    }
                    let back = other.mirrored(place);
                    let jump_ns = other.delay_between(back.y_ns, back.cell, back.cell)
                        - traversal.delay_between(place.y_ns, place.cell, place.cell);
                    assert!(jump_ns.abs() <= 4.0 * most_ns, "{distribution:?} {delay_s} {step}: {jump_ns}");
                }
            }
        }
    }

    /// Lookups match a search through all cells, for equal and unequal cell widths.
    #[test]
    fn a_cell_is_found_as_by_bisection() {
        for (distribution, distribution_shape) in [
            (Distribution::Normal, None),
            (Distribution::Uniform, None),
            (Distribution::Lognormal, None),
            (Distribution::Pareto, Some(2.5)),
        ] {
            let base = LinkSettings { delay_s: 0.05, jitter_s: 0.02, ..LinkSettings::default() };
            let settings = LinkSettings { distribution, distribution_shape, ..base };
            let cells = Cells::of(&DelayLaw::new(&settings).unwrap());
            for (keep_order, rises) in [(true, true), (true, false), (false, true)] {
                let path = Path::new(&cells, 0.1, settings.jitter_s, keep_order);
                let traversal = path.traversal(rises);
                for step in 0..=4 * COUNT {
                    for first in [0, step / 5, COUNT / 2 - 1, (step / 4).min(COUNT - 1)] {
                        let last = (first + step % 70).min(COUNT - 1);
                        check(traversal, step, first, last);
                    }
                }
            }
        }
    }

    fn check(traversal: &Traversal, step: usize, first: usize, last: usize) {
        let borders = &traversal.borders;
        let begin = borders[step / 4].start_ns;
        let inside = begin + 0.25 * (step % 4) as f64 * (borders[(step / 4 + 1).min(COUNT)].start_ns - begin);
        for y_ns in [inside, inside.next_down().max(0.0)] {
            let found = first + borders[first + 1..=last].partition_point(|border| border.start_ns <= y_ns);
            assert_eq!(traversal.cell(y_ns, first, last), found, "{y_ns} from {first} to {last}");
            assert_eq!(traversal.cell_before(y_ns, first, last), found);
        }
        let from = traversal.within(first, 0.25 * (step % 4) as f64);
        let exponential = 4e-3 * ((step % 97) * (step % 89)) as f64;
        let passed = borders[first].switching_rate * (from.y_ns - borders[first].start_ns);
        let target = borders[first].hazard + passed + exponential;
        let beyond = borders[first..COUNT].partition_point(|border| border.hazard <= target);
        let cell = first + beyond.max(1) - 1;
        let Border { start_ns, hazard, switching_rate: rate, .. } = borders[cell];
        let passed_ns = if rate > 0.0 { (target - hazard) / rate } else { f64::INFINITY };
        let wanted_ns = (start_ns + passed_ns).min(borders[cell + 1].start_ns);
        let to = traversal.switch(from, exponential);
        assert_eq!(to.cell, cell, "{exponential}");
        // One side rounds reciprocal, product and sum; the other rounds quotient and sum.
        let most_ns = 2.0 * f64::EPSILON * (wanted_ns + (wanted_ns - start_ns));
        assert!((to.y_ns - wanted_ns).abs() <= most_ns, "{exponential}: {} {wanted_ns}", to.y_ns);
    }
}
