//! A delay that wanders along a path in time, whatever packets come.
//!
//! A run is keyed by the time at which it begins, so the path is the same at any packet rate. After a silence that the
//! path does not remember it begins anew from its law, keyed by the bin of time, so that no silence costs more than
//! about a thousand runs.

use super::path::{Path, Place, Way};
use super::{Cells, shifted, whole};
use crate::law::gaussian;
use crate::random::{Stream, unit};
use crate::rule::Rule;
use crate::verdict::{Packet, Verdict};

/// Length of a bin in correlation times: at the least age of what is forgotten, `exp(-16)` of it is left.
const BIN_TAUS: f64 = 16.0;

#[derive(Debug)]
pub(super) struct Wander {
    path: Path,
    mean_ns: u64,
    runs: Stream,
    beginnings: Stream,
    bin_ns: u64,
    run: Option<Run>,
    latest_ns: u64,
}

/// One way up or down.
#[derive(Clone, Copy, Debug)]
struct Run {
    rises: bool,
    begin_ns: u64,
    end_ns: u64,
    from: Place,
    to: Place,
}

impl Wander {
    pub(super) fn new(path: Path, mean_ns: u64, stream: Stream) -> Self {
        let bin_ns = whole(BIN_TAUS * path.tau_ns);
        Self { path, mean_ns, runs: stream, beginnings: stream.nth(1), bin_ns, run: None, latest_ns: 0 }
    }

    /// The run of a time that is not before an earlier one asked for.
    fn run_at(&mut self, time_ns: u64) -> Run {
        // The run of the packet before it may not have ended.
        if let Some(run) = &self.run
            && time_ns < run.end_ns
        {
            return *run;
        }
        let bin = time_ns / self.bin_ns;
        let mut run = match self.run {
            Some(run) if bin <= run.end_ns / self.bin_ns + 1 => run,
            _ => self.anew(bin * self.bin_ns),
        };
        while run.end_ns <= time_ns && run.end_ns < u64::MAX {
            run = self.next(run);
        }
        self.run = Some(run);
        run
    }

    /// The first run after a silence, from a place of the law.
    fn anew(&self, begin_ns: u64) -> Run {
        let [place, direction] = self.beginnings.pair(begin_ns / self.bin_ns);
        let (cell, part) = Cells::place(gaussian::quantile(unit(place)));
        let rises = direction & 1 == 1;
        let up = self.path.up.within(cell, part);
        let from = if rises { up } else { self.path.up.mirrored(up) };
        self.begin(rises, begin_ns, from)
    }

    fn next(&self, run: Run) -> Run {
        self.begin(!run.rises, run.end_ns, self.way(run.rises).mirrored(run.to))
    }

    fn begin(&self, rises: bool, begin_ns: u64, from: Place) -> Run {
        let way = self.way(rises);
        let to = way.turn(from, -libm::log(self.runs.unit(begin_ns)));
        // Time is whole: the run stops short of the turn by less than 1 ns.
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "never negative; saturates"
        )]
        let length_ns = ((to.y_ns - from.y_ns) as u64).max(1);
        let y_ns = from.y_ns + length_ns as f64;
        let to = Place { y_ns: y_ns.min(way.end_ns()), cell: way.cell(y_ns, from.cell, to.cell) };
        Run { rises, begin_ns, end_ns: begin_ns.saturating_add(length_ns), from, to }
    }

    fn way(&self, rises: bool) -> &Way {
        if rises { &self.path.up } else { &self.path.down }
    }

    fn delay_ns(&mut self, time_ns: u64) -> u64 {
        let run = self.run_at(time_ns);
        let way = self.way(run.rises);
        let y_ns = run.from.y_ns + (time_ns - run.begin_ns) as f64;
        let cell = way.cell(y_ns, run.from.cell, run.to.cell);
        whole(way.delay_ns(Place { y_ns, cell }))
    }
}

impl Rule for Wander {
    fn judge(&mut self, packet: &Packet, at_ns: u64) -> Verdict {
        // The path at the packet's place in the flow so far: as it falls by less than 1 s/s, what comes in order
        // leaves in order. One that comes before an earlier one meets the path where that one did.
        self.latest_ns = self.latest_ns.max(at_ns);
        let delay_ns = self.delay_ns(self.latest_ns);
        Verdict::Deliver { at_ns: shifted(at_ns, delay_ns, self.mean_ns, packet.sent_ns) }
    }
}
