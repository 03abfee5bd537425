//! Measurement of a real network: an echo, and a client that records delay and loss of a stream of probes.

mod estimate;
mod live;
mod wire;

use std::io::{self, Write};

pub use live::{
    Echo, EchoStatistics, MAX_PROBES, MAX_RATE_HZ, ProbeError, RecordSettings, answering, record,
};

/// Result of one probe.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Probe {
    /// Time of sending, in s since the first probe.
    pub sent_s: f64,
    /// Forward delay in s; `None` if lost forward. If the answer was lost, this repeats the previous value.
    pub forward_s: Option<f64>,
    /// Backward delay of the answer in s; `None` if lost backward. If the probe was lost forward, this
    /// repeats the previous value, as there is nothing to measure.
    pub backward_s: Option<f64>,
}

/// Measurement of a network.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct Recording {
    /// All probes, in sending order.
    pub probes: Vec<Probe>,
    /// Probes lost forward.
    pub lost_forward: u64,
    /// Answers lost backward.
    pub lost_backward: u64,
    /// Shortest round trip in s, without the time at the echo.
    pub shortest_s: f64,
    /// Estimated lead of the echo's clock in s, in the middle of the measurement.
    pub offset_s: f64,
    /// Estimated relative drift of the echo's clock; positive is fast.
    pub drift: f64,
    /// Maximum lateness of a sent probe, in s.
    pub latest_s: f64,
}

/// Header line of the data, below the comments.
const HEADER: &str = "time_s,forward_delay_s,backward_delay_s";

impl Recording {
    /// Write CSV with `#` comments on the measurement; an empty cell is a loss.
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
