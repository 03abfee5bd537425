//! Translation of netem arguments to link settings.

use serde::Serialize;

use super::arguments::{Arguments, Chance, Loss, Rate, Table};
use super::{HEADERS, table};
use crate::checks::LinkSettingsError;
use crate::impairments::{Distribution, FourState, GilbertElliott, LinkSettings};

/// Index of the Pareto distribution in netem's table.
const PARETO_SHAPE: f64 = 3.0;

/// Packet-to-packet correlations of netem, 0 to 1, and its limit. [`translate`] does not represent them, and
/// netem's quirks stem from them.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[non_exhaustive]
pub struct Asked {
    /// Correlation of the delay.
    pub delay: f64,
    /// Correlation of the loss.
    pub loss: f64,
    /// Correlation of the duplication.
    pub duplicate: f64,
    /// Correlation of the corruption.
    pub corrupt: f64,
    /// Correlation of the reordering.
    pub reorder: f64,
    /// Maximum number of held packets.
    pub limit: usize,
}

impl Asked {
    /// Parse arguments of `tc netem`.
    pub fn read(text: &str) -> Result<Self, LinkSettingsError> {
        let Arguments { delay_rho, loss, duplicate, corrupt, reorder, limit, .. } = Arguments::read(text)?;
        let loss_rho = if let Loss::Random(chance) = loss { chance.rho } else { 0 };
        Ok(Self {
            delay: share(delay_rho),
            loss: share(loss_rho),
            duplicate: share(duplicate.rho),
            corrupt: share(corrupt.rho),
            reorder: share(reorder.rho),
            limit,
        })
    }
}

/// Link settings that do what arguments of `tc netem` request, where netem itself does something else.
///
/// - Jitter keeps order, mean and standard deviation. Without a distribution it is uniform, of standard
///   deviation J / sqrt(3). Without correlation it is as short as the order permits. A packet-to-packet
///   correlation cannot be given as a time, so the correlation time then has its default.
/// - A loss P with correlation rho becomes bursts of mean length 1 / ((1 - rho) (1 - P)). Their indicator has
///   the autocorrelation rho^n; the rate stays P.
/// - A reordered packet overtakes one packet; with a gap N, P / N of them are reordered. Correlations of
///   duplication, corruption and reordering are ignored.
/// - The wait for the rate adds to the delay, and the limit applies to the queue before it; without a rate
///   there is no limit.
pub fn translate(text: &str) -> Result<LinkSettings, LinkSettingsError> {
    let asked = Arguments::read(text)?;
    let mut settings = LinkSettings {
        delay_s: asked.latency_ns as f64 / 1e9,
        duplicate: share(asked.duplicate.probability),
        corrupt: share(asked.corrupt.probability),
        reorder: share(asked.reorder.probability) / f64::from(asked.gap.max(1)),
        ..LinkSettings::default()
    };
    if asked.jitter_ns > 0 {
        put_jitter(&mut settings, &asked);
    }
    put_loss(&mut settings, asked.loss)?;
    if let Some(rate) = asked.rate {
        put_rate(&mut settings, rate)?;
        settings.queue_packets = Some(asked.limit);
    }
    Ok(settings)
}

fn put_jitter(settings: &mut LinkSettings, asked: &Arguments) {
    let jitter_s = asked.jitter_ns as f64 / 1e9;
    settings.jitter_s = jitter_s;
    settings.jitter_correlation_s = (asked.delay_rho == 0).then_some(0.0);
    settings.distribution = match asked.table {
        Table::Uniform => {
            settings.jitter_s = jitter_s / 3_f64.sqrt();
            Distribution::Uniform
        }
        Table::Normal => Distribution::Normal,
        Table::Pareto => {
            settings.distribution_shape = Some(PARETO_SHAPE);
            Distribution::Pareto
        }
        Table::ParetoNormal => Distribution::Table(table::pareto_normal()),
    };
}

fn put_loss(settings: &mut LinkSettings, loss: Loss) -> Result<(), LinkSettingsError> {
    match loss {
        Loss::Random(Chance { probability, rho }) => {
            settings.loss = share(probability);
            if probability > 0 && rho > 0 && probability < u32::MAX {
                if rho == u32::MAX {
                    return Err(LinkSettingsError::contradiction(
                        "netem",
                        "a loss with a correlation of 100 % is lost for ever or never",
                    ));
                }
                settings.mean_burst = Some(1.0 / ((1.0 - share(rho)) * (1.0 - share(probability))));
            }
        }
        Loss::State { p13, p31, p32, p23, p14 } => {
            let [p13, p31, p32, p23, p14] = [p13, p31, p32, p23, p14].map(share);
            settings.four_state = Some(FourState { p13, p31, p32, p23, p14 });
        }
        Loss::Gilbert { p, r, loss_bad, loss_good } => {
            settings.gilbert_elliott = Some(GilbertElliott {
                to_bad: share(p),
                to_good: share(r),
                loss_good: share(loss_good),
                loss_bad: share(loss_bad),
            });
        }
    }
    Ok(())
}

fn put_rate(settings: &mut LinkSettings, rate: Rate) -> Result<(), LinkSettingsError> {
    if rate.cell_size > 0 {
        return Err(LinkSettingsError::contradiction(
            "netem",
            "cells have no equivalent in the settings of a link",
        ));
    }
    settings.rate_bps = Some(rate.bytes_per_s as f64 * 8.0);
    settings.overhead_bytes = usize::try_from(HEADERS + i64::from(rate.overhead)).map_err(|_| {
        LinkSettingsError::contradiction(
            "netem",
            format!("a packet overhead of {} leaves no header", rate.overhead),
        )
    })?;
    Ok(())
}

/// Probability from units of 2^-32 - 1, with the precision of the percentage as written.
fn share(part: u32) -> f64 {
    (f64::from(part) / f64::from(u32::MAX) * 1e9).round() / 1e9
}
