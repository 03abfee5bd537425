//! Measuring a real network: an echo, and a client that records what it does to a stream of probes.

mod estimate;
mod live;
mod wire;

use std::io::{self, Write};

pub use live::{
    Echo, EchoStatistics, MAX_PROBES, MAX_RATE_HZ, ProbeError, RecordSettings, answering, record,
};

/// What became of one probe.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Probe {
    /// When it was sent, in s since the first one.
    pub sent_s: f64,
    /// How long it took in s; `None` was lost forward.
    pub forward_s: Option<f64>,
    /// How long its answer took in s; `None` was lost backward. Where the other direction lost it, this is that of the
    /// probe before: there was nothing to measure.
    pub backward_s: Option<f64>,
}

/// A measurement of a network.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct Recording {
    /// All probes, in the order in which they were sent.
    pub probes: Vec<Probe>,
    /// Lost forward.
    pub lost_forward: u64,
    /// Lost backward.
    pub lost_backward: u64,
    /// Shortest round trip in s, without the time at the echo.
    pub shortest_s: f64,
    /// How far the echo's clock was taken to be ahead, in s, in the middle of the measurement.
    pub offset_s: f64,
    /// How much faster the echo's clock was taken to run, as a share.
    pub drift: f64,
    /// How late the latest probe was sent, in s.
    pub latest_s: f64,
}

/// First line of the data, below the comments.
const HEADER: &str = "time_s,forward_delay_s,backward_delay_s";

impl Recording {
    /// Writes it as CSV, with lines that begin with `#` on how it was measured; an empty cell is a loss.
    pub fn write_csv(&self, out: &mut impl Write) -> io::Result<()> {
        let Self { probes, lost_forward, lost_backward, shortest_s, offset_s, drift, latest_s } = self;
        let sent = probes.len();
        writeln!(out, "# probes: {sent}, lost forward: {lost_forward}, lost backward: {lost_backward}")?;
        writeln!(out, "# shortest round trip: {shortest_s:.9} s, split in halves: only the sum is certain")?;
        writeln!(out, "# clock of the echo ahead by {offset_s:.9} s, drift {:.3} ppm", drift * 1e6)?;
        writeln!(out, "# probes left up to {latest_s:.9} s late; the times are those at which they left")?;
        writeln!(out, "{HEADER}")?;
        for Probe { sent_s, forward_s, backward_s } in probes {
            write!(out, "{sent_s:.9}")?;
            for delay_s in [forward_s, backward_s] {
                match delay_s {
                    Some(delay_s) => write!(out, ",{delay_s:.9}")?,
                    None => write!(out, ",")?,
                }
            }
            writeln!(out)?;
        }
        Ok(())
    }
}
