//! Jitter: arrival + (D - E[D]), where D follows the delay distribution.
//!
//! With `keep_order` or a correlation time, D is a [path](path) in time; otherwise it is independent per
//! packet.

mod cells;
mod exponential;
mod path;

use std::{cell::RefCell, sync::Arc};

use cells::Cells;
use exponential::exponential;
use path::{Path, Place};

use crate::checks::{LinkSettingsError, MAX_DELAY_S, nanoseconds, within};
use crate::impairments::Distribution;
use crate::impairments::Impairment;
use crate::impairments::LinkSettings;
use crate::impairments::Streams;
use crate::impairments::law::{DelayLaw, gaussian};
use crate::packet::Packet;
use crate::random::{InTurn, Stream, unit};
use crate::rule::Rule;
use crate::verdict::Verdict;

/// Probability of a neglected delay.
const RARE: f64 = 1e-9;
const DEFAULT_CORRELATION_S: f64 = 0.1;

pub(crate) fn build(
    settings: &LinkSettings,
    streams: &Streams,
) -> Result<Option<Box<dyn Rule>>, LinkSettingsError> {
    within("jitter_s", settings.jitter_s, 0.0, MAX_DELAY_S)?;
    let tau_s = settings.jitter_correlation_s.unwrap_or(DEFAULT_CORRELATION_S);
    within("jitter_correlation_s", tau_s, 0.0, MAX_DELAY_S)?;
    if settings.jitter_s == 0.0 {
        return Ok(None);
    }
    let law = DelayLaw::new(settings)?;
    check_timeline(settings, &law)?;
    if nanoseconds(settings.jitter_s) == 0 {
        // Arrivals are whole ns, and so narrow a distribution has no distinct quantiles.
        return Ok(None);
    }
    let mean_ns = nanoseconds(settings.delay_s);
    if settings.keep_order || tau_s > 0.0 {
        let path = shared_path(settings, &law, tau_s);
        let stream = streams.of(Impairment::Wander);
        return Ok(Some(Box::new(Wander::new(path, mean_ns, stream))));
    }
    let cells = Cells::of(&law);
    Ok(Some(Box::new(Independent { cells, mean_ns, draws: InTurn::new(streams.of(Impairment::Jitter)) })))
}

#[derive(Clone, Debug, PartialEq)]
struct PathSource {
    delay_s: f64,
    jitter_s: f64,
    distribution: Distribution,
    distribution_shape: Option<f64>,
    tau_s: f64,
    keep_order: bool,
}

/// Number of paths that a thread caches: both directions of the previous and of the current scenario.
const PATHS_KEPT: usize = 4;

thread_local! {
    static PATHS: RefCell<Vec<(PathSource, Arc<Path>)>> = const { RefCell::new(Vec::new()) };
}

/// Path of a distribution. Computing it takes half a millisecond, so the thread reuses a cached path of equal
/// parameters, as in a sweep.
fn shared_path(settings: &LinkSettings, law: &DelayLaw, tau_s: f64) -> Arc<Path> {
    let source = PathSource {
        delay_s: settings.delay_s,
        jitter_s: settings.jitter_s,
        distribution: settings.distribution.clone(),
        distribution_shape: settings.distribution_shape,
        tau_s,
        keep_order: settings.keep_order,
    };
    PATHS.with_borrow_mut(|paths| {
        if let Some((_, path)) = paths.iter().find(|(kept, _)| *kept == source) {
            return Arc::clone(path);
        }
        let path = Arc::new(Path::new(&Cells::of(law), tau_s, settings.jitter_s, settings.keep_order));
        if paths.len() == PATHS_KEPT {
            paths.remove(0);
        }
        paths.push((source, Arc::clone(&path)));
        path
    })
}

/// Reject a mean delay that the jitter would take below zero: delays would be truncated silently.
fn check_timeline(settings: &LinkSettings, law: &DelayLaw) -> Result<(), LinkSettingsError> {
    let below_s = settings.delay_s - law.quantile_s(RARE);
    for (index, change) in settings.timeline.iter().enumerate() {
        // Tolerates rounding of the distribution.
        if change.delay_s < below_s * (1.0 - 1e-9) {
            let problem = format!(
                "{} s is less than the jitter reaches below its mean, {below_s:.3e} s: give a larger delay, or less \
                 jitter_s",
                change.delay_s
            );
            return Err(LinkSettingsError::contradiction(format!("timeline.{index}.delay_s"), problem));
        }
    }
    Ok(())
}

/// Move an arrival by the deviation of its delay from the mean, but not before the packet was sent.
fn shifted(at_ns: u64, delay_ns: u64, mean_ns: u64, sent_ns: u64) -> u64 {
    at_ns.saturating_add(delay_ns).saturating_sub(mean_ns).max(sent_ns)
}

/// Round as `round` does, which is a function call if the target has no guaranteed rounding instruction.
#[inline]
fn rounded_ns(ns: f64) -> u64 {
    /// From here up to its double, floats are the consecutive integers, in value and in bits.
    const INTEGERS_FROM: f64 = 4_503_599_627_370_496.0;
    if (0.0..INTEGERS_FROM).contains(&ns) {
        // The sum rounds to nearest, ties to even; the last term rounds ties up.
        let nearest = ns + INTEGERS_FROM;
        return (nearest.to_bits() - INTEGERS_FROM.to_bits())
            + u64::from(ns - (nearest - INTEGERS_FROM) >= 0.5);
    }
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "never negative; saturates")]
    let integer = ns as u64;
    integer
}

#[derive(Clone, Debug)]
struct Independent {
    cells: Cells,
    mean_ns: u64,
    draws: InTurn,
}

impl Rule for Independent {
    fn judge(&mut self, packet: &Packet, at_ns: u64) -> Verdict {
        let z = gaussian::quantile(unit(self.draws.bits(packet.index)));
        let delay_ns = rounded_ns(self.cells.delay_ns(z));
        Verdict::Deliver { at_ns: shifted(at_ns, delay_ns, self.mean_ns, packet.sent_ns) }
    }
}

/// Bin length in correlation times: `exp(-16)` remains of the youngest forgotten state.
const BIN_TAUS: f64 = 16.0;

/// Delay that follows a path in time, independent of the packets.
///
/// A run is keyed by its start time, so the path is the same at any packet rate. After a silence longer than
/// its memory the path restarts from its distribution, keyed by the time bin. A silence therefore costs at
/// most about a thousand runs.
#[derive(Clone, Debug)]
struct Wander {
    path: Arc<Path>,
    mean_ns: u64,
    lengths: Stream,
    beginnings: Stream,
    bin_ns: u64,
    /// Run of the latest packet, at index `at`, and the next run. Drawing it ahead hides its latency.
    /// Initially a run that ends at 0, as no real run does.
    runs: [Run; 2],
    at: usize,
    latest_ns: u64,
}

#[derive(Clone, Copy, Debug)]
struct Run {
    rises: bool,
    begin_ns: u64,
    end_ns: u64,
    from: Place,
    to: Place,
}

impl Run {
    const NONE: Self = {
        let place = Place { y_ns: 0.0, cell: 0 };
        Self { rises: false, begin_ns: 0, end_ns: 0, from: place, to: place }
    };
}

impl Wander {
    fn new(path: Arc<Path>, mean_ns: u64, stream: Stream) -> Self {
        let bin_ns = rounded_ns(BIN_TAUS * path.tau_ns);
        Self {
            path,
            mean_ns,
            lengths: stream,
            beginnings: stream.nth(1),
            bin_ns,
            runs: [Run::NONE; 2],
            at: 0,
            latest_ns: 0,
        }
    }

    /// Advances to the run at `time_ns`, which must not decrease between calls.
    #[inline]
    fn advance_to(&mut self, time_ns: u64) {
        if self.run().end_ns <= time_ns {
            self.advance_to_later_run(time_ns);
        }
    }

    /// Advance past an ended run, and draw the run after the new one.
    #[inline(never)] // about every second packet
    fn advance_to_later_run(&mut self, time_ns: u64) {
        let end_ns = self.run().end_ns;
        if end_ns == 0 || self.forgets(end_ns, time_ns) {
            self.restart_at(time_ns / self.bin_ns * self.bin_ns);
        }
        while self.run().end_ns <= time_ns && self.run().end_ns < u64::MAX {
            self.at = 1 - self.at;
            self.draw_next();
        }
    }

    #[inline]
    fn run(&self) -> &Run {
        &self.runs[self.at & 1]
    }

    /// Test if a whole bin lies between the bins of two times.
    fn forgets(&self, from_ns: u64, to_ns: u64) -> bool {
        to_ns - from_ns > self.bin_ns && to_ns / self.bin_ns > from_ns / self.bin_ns + 1
    }

    /// Draw the first run after a silence from the distribution, and the next run.
    #[inline(never)] // rare
    fn restart_at(&mut self, begin_ns: u64) {
        let [place, direction] = self.beginnings.pair(begin_ns / self.bin_ns);
        let (cell, part) = Cells::place(gaussian::quantile(unit(place)));
        let rises = direction & 1 == 1;
        let up = self.path.traversal(true).within(cell, part);
        let from = if rises { up } else { self.path.traversal(true).mirrored(up) };
        self.draw(self.at, rises, begin_ns, from);
        self.draw_next();
    }

    fn draw_next(&mut self) {
        let Run { rises, end_ns, to, .. } = *self.run();
        self.draw(1 - self.at, !rises, end_ns, self.path.traversal(rises).mirrored(to));
    }

    /// Draw a run in place; copying a value just written would stall.
    #[inline(always)]
    fn draw(&mut self, at: usize, rises: bool, begin_ns: u64, from: Place) {
        let traversal = self.path.traversal(rises);
        let to = traversal.switch(from, exponential(self.lengths.unit(begin_ns)));
        // Times are whole ns: the run stops less than 1 ns before its end.
        #[expect(clippy::cast_possible_truncation, reason = "saturates")]
        let length_ns = ((to.y_ns - from.y_ns) as i64).max(1);
        let y_ns = from.y_ns + length_ns as f64;
        let cell = traversal.cell_before(y_ns, from.cell, to.cell);
        let to = Place { y_ns: y_ns.min(traversal.end_ns()), cell };
        self.runs[at & 1] =
            Run { rises, begin_ns, end_ns: begin_ns.saturating_add(length_ns.cast_unsigned()), from, to };
    }

    #[inline(always)] // as `judge`
    fn delay_ns(&mut self, time_ns: u64) -> u64 {
        self.advance_to(time_ns);
        let run = self.run();
        let traversal = self.path.traversal(run.rises);
        let y_ns = run.from.y_ns + (time_ns - run.begin_ns).cast_signed() as f64;
        rounded_ns(traversal.delay_between(y_ns, run.from.cell, run.to.cell))
    }
}

impl Rule for Wander {
    #[inline(always)] // in the per-packet loop
    fn judge(&mut self, packet: &Packet, at_ns: u64) -> Verdict {
        // Evaluates the path at the latest arrival so far. It falls by less than 1 s/s, so packets in order
        // stay in order. An arrival before an earlier one gets the delay of the earlier one.
        self.latest_ns = self.latest_ns.max(at_ns);
        let delay_ns = self.delay_ns(self.latest_ns);
        Verdict::Deliver { at_ns: shifted(at_ns, delay_ns, self.mean_ns, packet.sent_ns) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "as the code under test")]
    fn whole_is_round() {
        let edges = [
            0.0,
            -0.0,
            0.499_999_999_999_999_94,
            0.5,
            0.500_000_000_000_000_1,
            1.5,
            2.5,
            2f64.powi(52) - 0.5,
            2f64.powi(52) + 1.0,
            2f64.powi(53) + 2.0,
            2f64.powi(63),
            2f64.powi(64),
            f64::MIN_POSITIVE,
            f64::MAX,
            f64::INFINITY,
            f64::NAN,
        ];
        for ns in edges {
            assert_eq!(rounded_ns(ns), ns.round() as u64, "{ns}");
        }
    }

    /// After a silence the delay does not depend on earlier packets, and the maximum time is valid.
    #[test]
    fn a_silence_forgets_what_was_before() {
        let settings = LinkSettings { delay_s: 0.05, jitter_s: 0.005, ..LinkSettings::default() };
        let direction = crate::Direction::Backward;
        let after = |times_ns: &[u64]| {
            let mut rule = build(&settings, &Streams { seed: 3, direction }).unwrap().unwrap();
            times_ns.iter().fold(None, |_, &sent_ns| {
                let packet = Packet { direction, index: 0, sent_ns, size: 100 };
                Some(rule.judge(&packet, sent_ns))
            })
        };
        for later_ns in [1_000_000_000_000, u64::MAX / 2, u64::MAX - 1] {
            let alone = after(&[later_ns]);
            for packets in 1..8 {
                let mut times_ns: Vec<_> = (0..packets).map(|index| index * 7_000_000).collect();
                times_ns.push(later_ns);
                assert_eq!(after(&times_ns), alone, "{packets} before {later_ns}");
            }
        }
        assert!(after(&[u64::MAX - 1, u64::MAX, u64::MAX]).is_some());
    }

    /// Arrivals of the first packets of a link.
    fn delays(settings: &LinkSettings) -> Vec<u64> {
        let direction = crate::Direction::Forward;
        let streams = Streams { seed: 7, direction };
        let mut rule = build(settings, &streams).unwrap().unwrap();
        let packet = |index: u64| Packet { direction, index, sent_ns: index * 1_000_000, size: 100 };
        (0..200)
            .map(|index| match rule.judge(&packet(index), packet(index).sent_ns + 50_000_000) {
                Verdict::Deliver { at_ns } => at_ns,
                verdict @ Verdict::Drop { .. } => panic!("{verdict:?}"),
            })
            .collect()
    }

    /// Parameters that differ in one field, built in turn: each gets its own path.
    #[test]
    fn a_shared_path_is_that_of_its_own_law() {
        let base = LinkSettings {
            delay_s: 0.05,
            jitter_s: 0.005,
            distribution: Distribution::Gamma,
            jitter_correlation_s: Some(0.1),
            ..LinkSettings::default()
        };
        let laws = [
            base.clone(),
            LinkSettings { delay_s: 0.06, ..base.clone() },
            LinkSettings { jitter_s: 0.006, ..base.clone() },
            LinkSettings { distribution: Distribution::Normal, ..base.clone() },
            LinkSettings {
                distribution: Distribution::Pareto,
                distribution_shape: Some(3.0),
                ..base.clone()
            },
            LinkSettings {
                distribution: Distribution::Pareto,
                distribution_shape: Some(4.0),
                ..base.clone()
            },
            LinkSettings { jitter_correlation_s: Some(0.2), ..base.clone() },
            LinkSettings { keep_order: !base.keep_order, ..base },
        ];
        // A separate thread shares no path.
        let alone: Vec<_> = laws
            .iter()
            .map(|law| std::thread::scope(|scope| scope.spawn(|| delays(law)).join().unwrap()))
            .collect();
        for step in [1, 3, 5] {
            for turn in 0..2 * laws.len() {
                let place = turn * step % laws.len();
                assert_eq!(delays(&laws[place]), alone[place], "{place}");
            }
        }
        // Correlated delays keep order in any case: the last settings have the delays of the first.
        let different = &alone[..laws.len() - 1];
        for (place, one) in different.iter().enumerate() {
            assert!(different[place + 1..].iter().all(|other| other != one), "{place} is that of another");
        }
    }
}
