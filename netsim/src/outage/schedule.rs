//! When there is an outage: once, periodically, or at random.

use crate::on_off::{MAX_MEAN_S, OnOff};
use crate::random::Stream;
use crate::settings::{LinkError, MAX_TIME_S, OutageTimes, nanoseconds, within};

/// Least duration in s: a clock tick of the model.
const MIN_S: f64 = 1e-9;
/// Least mean time of random outages in s.
const MIN_MEAN_S: f64 = 1e-6;
/// How many times longer than the mean time up the mean time down may be; the work of finding the end of an outage
/// grows with it.
const MAX_DOWN_PER_UP: f64 = 1000.0;

#[derive(Clone, Copy, Debug)]
pub(super) enum Schedule {
    Once { from_ns: u64, until_ns: u64 },
    Periodic { from_ns: u64, period_ns: u64, duration_ns: u64 },
    Random(OnOff),
}

impl Schedule {
    /// Checks the times found under a key.
    pub(super) fn new(key: &str, times: &OutageTimes, stream: Stream) -> Result<Self, LinkError> {
        let check = |name, seen, least, most| within(&format!("{key}.{name}"), seen, least, most);
        match *times {
            OutageTimes::Once { at_s, duration_s } => {
                check("at_s", at_s, 0.0, MAX_TIME_S)?;
                check("duration_s", duration_s, MIN_S, MAX_TIME_S)?;
                let from_ns = nanoseconds(at_s);
                Ok(Self::Once { from_ns, until_ns: from_ns + nanoseconds(duration_s) })
            }
            OutageTimes::Periodic { at_s, period_s, duration_s } => {
                check("at_s", at_s, 0.0, MAX_TIME_S)?;
                check("period_s", period_s, MIN_S, MAX_TIME_S)?;
                check("duration_s", duration_s, MIN_S, MAX_TIME_S)?;
                let [period_ns, duration_ns] = [period_s, duration_s].map(nanoseconds);
                if duration_ns >= period_ns {
                    return Err(LinkError::contradiction(
                        format!("{key}.duration_s"),
                        format!(
                            "{duration_s} is not below period_s = {period_s}: nothing would ever pass again"
                        ),
                    ));
                }
                Ok(Self::Periodic { from_ns: nanoseconds(at_s), period_ns, duration_ns })
            }
            OutageTimes::Random { mean_up_s, mean_down_s } => {
                check("mean_up_s", mean_up_s, MIN_MEAN_S, MAX_MEAN_S)?;
                let most_s = MAX_MEAN_S.min(mean_up_s * MAX_DOWN_PER_UP);
                check("mean_down_s", mean_down_s, MIN_MEAN_S, most_s)?;
                Ok(Self::Random(OnOff::by_means(mean_up_s, mean_down_s, stream)))
            }
        }
    }

    /// Whether there is an outage at a time.
    pub(super) fn is_out(&mut self, at_ns: u64) -> bool {
        match self {
            // Its end is not needed, and not for nothing.
            Self::Random(process) => process.is_off(at_ns),
            _ => self.out_until(at_ns).is_some(),
        }
    }

    /// When the outage at a time ends, if there is one.
    pub(super) fn out_until(&mut self, at_ns: u64) -> Option<u64> {
        match self {
            Self::Once { from_ns, until_ns } => (*from_ns..*until_ns).contains(&at_ns).then_some(*until_ns),
            Self::Periodic { from_ns, period_ns, duration_ns } => {
                let phase_ns = at_ns.checked_sub(*from_ns)? % *period_ns;
                (phase_ns < *duration_ns).then(|| (at_ns - phase_ns).saturating_add(*duration_ns))
            }
            Self::Random(process) => process.off_until(at_ns),
        }
    }
}
