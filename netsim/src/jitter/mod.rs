//! Jitter: arrival + (D - E[D]), where D follows the law of the delay.
//!
//! With `keep_order` or a correlation time D is a [path](path) in time, else it is drawn for each packet by itself.

mod cells;
mod independent;
mod path;
mod wander;

use cells::Cells;
use independent::Independent;
use wander::Wander;

use crate::law::DelayLaw;
use crate::random::Impairment;
use crate::rule::{Rule, Streams};
use crate::settings::{LinkError, LinkSettings, MAX_DELAY_S, nanoseconds, within};

/// Probability of a delay that need not be thought of.
const RARE: f64 = 1e-9;
/// Correlation time in s where none is given.
const DEFAULT_CORRELATION_S: f64 = 0.1;

pub(crate) fn build(settings: &LinkSettings, streams: &Streams) -> Result<Option<Box<dyn Rule>>, LinkError> {
    within("jitter_s", settings.jitter_s, 0.0, MAX_DELAY_S)?;
    let tau_s = settings.jitter_correlation_s.unwrap_or(DEFAULT_CORRELATION_S);
    within("jitter_correlation_s", tau_s, 0.0, MAX_DELAY_S)?;
    if settings.jitter_s == 0.0 {
        return Ok(None);
    }
    let law = DelayLaw::new(settings)?;
    check_timeline(settings, &law)?;
    if nanoseconds(settings.jitter_s) == 0 {
        // Arrivals are whole ns, and a law that narrow has no quantiles to tell apart.
        return Ok(None);
    }
    let cells = Cells::of(&law);
    let mean_ns = nanoseconds(settings.delay_s);
    if settings.keep_order || tau_s > 0.0 {
        let path = path::Path::new(&cells, tau_s, settings.jitter_s, settings.keep_order);
        let stream = streams.of(Impairment::Wander);
        return Ok(Some(Box::new(Wander::new(path, mean_ns, stream))));
    }
    Ok(Some(Box::new(Independent::new(cells, mean_ns, streams.of(Impairment::Jitter)))))
}

/// Refuses a mean delay that is less than the law reaches below it: delays would be cut off at zero, unseen.
fn check_timeline(settings: &LinkSettings, law: &DelayLaw) -> Result<(), LinkError> {
    let below_s = settings.delay_s - law.quantile_s(RARE);
    for (index, change) in settings.timeline.iter().enumerate() {
        // A rounding of the law is no reason to refuse.
        if change.delay_s < below_s * (1.0 - 1e-9) {
            let problem = format!(
                "{} s is less than the jitter reaches below its mean, {below_s:.3e} s: give a larger delay, or less \
                 jitter_s",
                change.delay_s
            );
            return Err(LinkError::contradiction(format!("timeline.{index}.delay_s"), problem));
        }
    }
    Ok(())
}

/// Moves an arrival by how far a delay lies off its mean, though not to before the packet was sent.
fn shifted(at_ns: u64, delay_ns: u64, mean_ns: u64, sent_ns: u64) -> u64 {
    at_ns.saturating_add(delay_ns).saturating_sub(mean_ns).max(sent_ns)
}

#[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "never negative; saturates")]
fn whole(ns: f64) -> u64 {
    ns.round() as u64
}
