"""Comparison of `tc netem` arguments as requested, as netem applies them, and as netsim does."""

from collections.abc import Iterator
from math import sqrt

import msgspec
import numpy as np
import numpy.typing as npt
from msgspec import Struct
from msgspec.structs import replace

from haptether import _core
from haptether.netsim.figures import LinkFigures, asked, realised
from haptether.netsim.link.errors import LinkError, of_rules
from haptether.netsim.link.settings import FourState, GilbertElliott, LinkSettings
from haptether.netsim.verdicts import Times, Verdicts, judge_all

_P99_NORMAL = 2.3263478740408408
"""99 % quantile of the standard normal distribution."""
_DOUBT = 4.0
"""Number of standard errors above which a difference is significant."""


class Correlations(Struct, frozen=True, kw_only=True):
    """Netem arguments without a link setting: correlations between packets, and a queue limit."""

    delay: float
    loss: float
    duplicate: float
    corrupt: float
    reorder: float
    limit: int


class NetemComparison(Struct, frozen=True, kw_only=True):
    """Result of `tc netem` arguments: requested, in netem, and in netsim."""

    settings: LinkSettings
    """Link settings equivalent to the request."""
    asked: LinkFigures
    """Requested figures; None if not stated."""
    netem: LinkFigures
    """Figures of packets in netem."""
    ours: LinkFigures
    """Figures of packets under `settings`; all None if no link can satisfy the request."""
    refused: str | None
    """Reason why no link can satisfy the request, or None."""
    quirks: tuple[str, ...]
    """Deviations of netem from the request, one line each."""


def translate_netem(text: str) -> LinkSettings:
    """Translate `tc netem` arguments to link settings that satisfy the request, even where netem does not.

    Raises:
        LinkError: netem refuses the text (gives the column), or no link setting exists.
    """
    return _translated(text)[0]


def _translated(text: str) -> tuple[LinkSettings, Correlations]:
    class Both(Struct):
        settings: LinkSettings
        asked: Correlations

    try:
        both = msgspec.json.decode(_core.translate_netem(text), type=Both)
    except ValueError as error:
        raise of_rules(error) from None
    return both.settings, both.asked


def compare_netem(text: str, sent_ns: Times, *, seed: int = 0, size: int = 92) -> NetemComparison:
    """Send packets through netem and through a link that satisfies the same request.

    Args:
        text: Arguments of `tc netem`, such as `delay 50ms 10ms 25% loss 1%`.
        sent_ns: Sending time of each packet in ns, shape `(n_packets,)`.
        seed: Seed of all draws.
        size: Payload of a packet in bytes.

    Raises:
        LinkError: netem refuses the text (gives the column), or no link setting exists.
    """
    settings, correlations = _translated(text)
    verdicts = judge_all(LinkSettings(netem=text), sent_ns, seed=seed, sizes=size)
    netem, wanted = realised(verdicts), _requested(settings)
    ours, refused = LinkFigures(), None
    try:
        ours = realised(judge_all(settings, sent_ns, seed=seed, sizes=size))
    except LinkError as error:
        refused = str(error)
    return NetemComparison(
        settings=settings,
        asked=wanted,
        netem=netem,
        ours=ours,
        refused=refused,
        quirks=tuple(_quirks(settings, correlations, wanted, netem, verdicts)),
    )


def _requested(settings: LinkSettings) -> LinkFigures:
    """Return the figures that the text states; with a rate, delays depend on the traffic."""
    # Jitter that no link can have, such as 10 ms around 10 ms, still counts as requested.
    without = dict.fromkeys(("jitter_s", "distribution", "distribution_shape", "jitter_correlation_s"))
    figures = asked(replace(settings, **without), "forward")
    mean_s, sigma_s = figures.mean_s, None if figures.mean_s is None else settings.jitter_s
    figures = replace(figures, sigma_s=sigma_s)
    if mean_s is not None and sigma_s is not None and settings.distribution in {"normal", "uniform"}:
        # Uniform law with half-width sqrt(3) sigma: 0.98 half-widths above the mean.
        above = _P99_NORMAL if settings.distribution == "normal" else 0.98 * sqrt(3.0)
        figures = replace(figures, p50_s=mean_s, p99_s=mean_s + above * sigma_s)
    return replace(figures, **_chain_figures(settings.gilbert_elliott, settings.four_state))


def _chain_figures(two: GilbertElliott | None, four: FourState | None) -> dict[str, float | None]:
    """Return loss fraction and mean loss run of a chain in its stationary state.

    A run of losses begins with a loss after an arrival: mean run = P(lost) / P(arrived, then lost).

    Source: Salsano et al. 2009 (the chains of netem).
    """
    if two is not None:
        move = np.array([[1.0 - two.to_bad, two.to_bad], [two.to_good, 1.0 - two.to_good]])
        losing = np.array([two.loss_good, two.loss_bad])
    elif four is not None:
        # Numbering of netem: 1 arrives, 2 arrives within a burst, 3 lost in a burst, 4 isolated loss.
        move = np.array(
            [
                [1.0 - four.p13 - four.p14, 0.0, four.p13, four.p14],
                [0.0, 1.0 - four.p23, four.p23, 0.0],
                [four.p31, four.p32, 1.0 - four.p31 - four.p32, 0.0],
                [1.0, 0.0, 0.0, 0.0],
            ]
        )
        losing = np.array([0.0, 0.0, 1.0, 1.0])
    else:
        return {}
    begin = np.zeros(len(move))
    begin[0] = 1.0
    stationary = _stationary(move, begin)
    loss = float(stationary @ losing)
    begins = float((stationary * (1.0 - losing)) @ move @ losing)
    return {"loss": loss, "mean_burst": loss / begins if begins > 0.0 else None}


def _stationary(move: npt.NDArray[np.float64], begin: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the stationary distribution from an initial one; for a periodic chain the mean over its period."""
    long = 0.5 * (move + np.eye(len(move)))
    for _ in range(64):
        # Normalise, because the error of a row sum would double each time.
        long = long @ long
        long /= long.sum(axis=1, keepdims=True)
    where: npt.NDArray[np.float64] = begin @ long
    return where


def _quirks(
    settings: LinkSettings, correlations: Correlations, wanted: LinkFigures, netem: LinkFigures, verdicts: Verdicts
) -> Iterator[str]:
    packets = verdicts.packets
    arrived = packets.t_out_ns >= 0
    delays = (packets.t_out_ns - packets.t_in_ns)[arrived]
    if settings.jitter_s and delays.size:
        yield from _of_delay(settings, correlations, netem, delays, _lag_1(packets))
    at_once = float(np.mean(delays == 0)) if delays.size else 0.0
    if settings.reorder and at_once > 0.0 and (netem.reordered or 0.0) > 0.0:
        yield (
            f"what is reordered is sent without delay and overtakes all that is under way: {_share(at_once)} of the "
            f"packets leave at once, {_share(netem.reordered or 0.0)} come late"
        )
    # Only these send packets immediately.
    reordered = None if settings.jitter_s or settings.rate_bps is not None else at_once
    yield from _of_draws(correlations, wanted, replace(netem, reordered=reordered), len(packets))
    overflow = float(np.mean(packets.causes_of("queue")))
    if overflow > 0.0:
        yield (
            f"limit: more than {correlations.limit} packets held, those that are delayed included: "
            f"{_share(overflow)} dropped"
        )
    if settings.rate_bps is not None:
        yield "rate: the delay runs while a packet waits for the line, it is not added to the wait"
    if wanted.duplicates and (wanted.loss is None or wanted.loss > 0.0):
        yield "duplicate and loss: a packet that is to be doubled and to be lost passes once"


def _of_delay(
    settings: LinkSettings,
    correlations: Correlations,
    netem: LinkFigures,
    delays: Times,
    lag_1: float,
) -> Iterator[str]:
    mean_s, sigma_s = settings.delay_s or 0.0, settings.jitter_s or 0.0
    if settings.distribution == "uniform":
        half_width_s = sigma_s * sqrt(3.0)
        yield f"without a distribution jitter is a half-width: {_ms(half_width_s)} give a sigma of {_ms(sigma_s)}"
    at_once = float(np.mean(delays == 0))
    if mean_s > 0.0 and not settings.reorder and settings.rate_bps is None and at_once > 0.0:
        yield f"a delay below zero is none: {_share(at_once)} of the packets leave at once, which raises the mean"
    longest = float(np.mean(delays == delays.max()))
    # Each of the 4096 entries of an uncut table has a share of 1 / 4096.
    if settings.distribution != "uniform" and settings.rate_bps is None and longest > 1e-3:
        yield (
            f"the table ends at four sigma: {_share(longest)} of the packets have exactly the longest delay, "
            f"{_ms(float(delays.max()) * 1e-9)}"
        )
    if correlations.delay > 0.0 and lag_1 < 0.5 * correlations.delay and settings.rate_bps is None:
        yield (
            f"the correlation of the delay does nothing: {_share(correlations.delay)} asked, {lag_1:.3f} from packet "
            "to packet, because the draw is taken modulo the jitter"
        )
    late = netem.reordered or 0.0
    if settings.rate_bps is not None:
        yield "rate: jitter reorders nothing, because each packet leaves after the one before it"
    elif late > (settings.reorder or 0.0) + _DOUBT * sqrt(max(late, 1e-9) / delays.size):
        yield f"jitter reorders: {_share(late)} of the packets arrive after one that was sent later"


def _of_draws(correlations: Correlations, wanted: LinkFigures, netem: LinkFigures, sent: int) -> Iterator[str]:
    of = (
        ("loss", correlations.loss, wanted.loss, netem.loss),
        ("duplicate", correlations.duplicate, wanted.duplicates, netem.duplicates),
        ("corrupt", correlations.corrupt, wanted.damaged, netem.damaged),
        ("reorder", correlations.reorder, wanted.reordered, netem.reordered),
    )
    for name, correlation, requested, found in of:
        if correlation <= 0.0 or not requested or found is None:
            continue
        if abs(found - requested) > _DOUBT * sqrt(requested * (1.0 - requested) / sent):
            yield (
                f"the correlation of {name} narrows its draws around one half: {_share(requested)} with "
                f"{_share(correlation)} became {_share(found)}"
            )


def _lag_1(packets: Verdicts) -> float:
    """Return the delay correlation of consecutive packets; 0 if undefined."""
    delays = (packets.t_out_ns - packets.t_in_ns).astype(np.float64)
    both = (packets.t_out_ns[:-1] >= 0) & (packets.t_out_ns[1:] >= 0)
    first, second = delays[:-1][both], delays[1:][both]
    if first.size < 2 or first.std() == 0.0 or second.std() == 0.0:
        return 0.0
    return float(np.corrcoef(first, second)[0, 1])


def _ms(seconds: float) -> str:
    return f"{seconds * 1e3:.4g} ms"


def _share(share: float) -> str:
    return f"{share * 100:.3g} %"
