//! Loss: which packets never arrive. A link has one model of it at most.

mod bernoulli;
mod chain;
mod four_state;
mod gilbert;
mod gilbert_elliott;
mod gilbert_in_time;

use crate::random::Impairment;
use crate::rule::{Rule, Streams};
use crate::settings::{LinkError, LinkSettings, probability};

use bernoulli::Bernoulli;
use four_state::FourStateLoss;
use gilbert::Gilbert;
use gilbert_elliott::GilbertElliottLoss;
use gilbert_in_time::GilbertInTime;

/// Builds the one model that the settings name.
pub(crate) fn build(settings: &LinkSettings, streams: &Streams) -> Result<Option<Box<dyn Rule>>, LinkError> {
    let loss = settings.loss;
    probability("loss", loss)?;
    refuse_two_models(settings)?;
    if let Some(model) = &settings.gilbert_elliott {
        return Ok(Some(Box::new(GilbertElliottLoss::new(model, streams)?)));
    }
    if let Some(model) = &settings.four_state {
        return Ok(Some(Box::new(FourStateLoss::new(model, streams)?)));
    }
    let bursts: Option<Box<dyn Rule>> = match (settings.mean_burst, settings.mean_burst_s) {
        (Some(mean_burst), _) => Gilbert::new(loss, mean_burst, streams)?.map(|rule| Box::new(rule) as _),
        (_, Some(mean_burst_s)) => {
            GilbertInTime::new(loss, mean_burst_s, streams)?.map(|rule| Box::new(rule) as _)
        }
        (None, None) => None,
    };
    if bursts.is_some() || loss == 0.0 {
        return Ok(bursts);
    }
    Ok(Some(Box::new(Bernoulli::new(loss, streams.of(Impairment::Loss)))))
}

/// Names the first two settings that describe different models.
fn refuse_two_models(settings: &LinkSettings) -> Result<(), LinkError> {
    let models = [
        ("gilbert_elliott", settings.gilbert_elliott.is_some()),
        ("four_state", settings.four_state.is_some()),
        ("mean_burst", settings.mean_burst.is_some()),
        ("mean_burst_s", settings.mean_burst_s.is_some()),
        // A mean burst goes with `loss`; without one it is a model of its own.
        ("loss", settings.loss > 0.0 && settings.mean_burst.is_none() && settings.mean_burst_s.is_none()),
    ];
    let mut given = models.iter().filter_map(|&(key, given)| given.then_some(key));
    match (given.next(), given.next()) {
        (Some(first), Some(second)) => Err(LinkError::contradiction(
            first,
            format!("is a model of loss, and so is {second}: give one of them"),
        )),
        _ => Ok(()),
    }
}
