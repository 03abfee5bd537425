"""Statistics of a link's effect on packets."""

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from haptether.netsim.link.resolve import link_spec
from haptether.netsim.link.settings import Direction, LinkSettings
from haptether.netsim.verdicts import Verdicts


class LinkFigures(Struct, frozen=True, kw_only=True):
    """Figures of a link, as requested or as realised; None if unknown. Delays in s."""

    mean_s: float | None = None
    """Mean delay."""
    sigma_s: float | None = None
    """Standard deviation of the delay."""
    p50_s: float | None = None
    """Median of the delay."""
    p99_s: float | None = None
    """Delay that 1 % of the packets exceed."""
    loss: float | None = None
    """Fraction of packets that never arrive, for any cause."""
    mean_burst: float | None = None
    """Mean number of consecutive losses."""
    reordered: float | None = None
    """Fraction of arrived packets that follow a later-sent one (RFC 4737)."""
    duplicates: float | None = None
    """Copies made by the network per packet sent."""
    damaged: float | None = None
    """Fraction of packets that arrive with flipped bits or truncated."""


def repeats_every_s(settings: LinkSettings, direction: Direction) -> float | None:
    """Return the period in s after which a replayed recording repeats; None if nothing repeats.

    Args:
        settings: Settings of one direction, with its files read.
        direction: Direction of the link.

    Raises:
        LinkError: Same as for `link_spec`.
    """
    spec = link_spec(settings, direction)
    trace, opportunities = spec["trace"], spec["opportunities"]
    if trace and trace["repeat"] and len(trace["time_s"]) > 1:
        # The last spacing applies once more after the last time.
        return float(2.0 * trace["time_s"][-1] - trace["time_s"][-2])
    return float(opportunities["time_ms"][-1]) * 1e-3 if opportunities else None


def realised(verdicts: Verdicts) -> LinkFigures:
    """Return the figures of judged packets.

    Source: RFC 4737 (reordering).
    """
    packets = verdicts.packets
    arrived = packets.t_out_ns >= 0
    causes = verdicts.causes_of
    delays = (packets.t_out_ns - packets.t_in_ns)[arrived] * 1e-9
    sent = max(len(packets), 1)
    bursts = burst_lengths(packets)
    return LinkFigures(
        mean_s=float(delays.mean()) if delays.size else None,
        sigma_s=float(delays.std()) if delays.size else None,
        p50_s=float(np.quantile(delays, 0.5)) if delays.size else None,
        p99_s=float(np.quantile(delays, 0.99)) if delays.size else None,
        loss=float(np.count_nonzero(~arrived)) / sent,
        mean_burst=float(bursts.mean()) if bursts.size else None,
        reordered=_reordered(packets) / max(delays.size, 1),
        duplicates=float(np.count_nonzero(causes("duplicate"))) / max(delays.size, 1),
        damaged=float(np.count_nonzero(causes("corrupt") | causes("truncate"))) / max(delays.size, 1),
    )


def burst_lengths(packets: Verdicts) -> npt.NDArray[np.int64]:
    """Return the length of each run of consecutive losses."""
    lost = np.concatenate([[False], packets.t_out_ns < 0, [False]]).astype(np.int8)
    edges = np.diff(lost)
    return np.flatnonzero(edges == -1) - np.flatnonzero(edges == 1)


def _reordered(packets: Verdicts) -> int:
    arrived = np.flatnonzero(packets.t_out_ns >= 0)
    in_order_of_arrival = arrived[np.argsort(packets.t_out_ns[arrived], kind="stable")]
    if not in_order_of_arrival.size:
        return 0
    return int(np.count_nonzero(in_order_of_arrival < np.maximum.accumulate(in_order_of_arrival)))


def asked(settings: LinkSettings, direction: Direction) -> LinkFigures:
    """Return the figures that settings state directly.

    Raises:
        LinkError: The settings are invalid.
    """
    spec = link_spec(settings, direction)
    delayed_otherwise = ("rate_bps", "opportunities", "slots", "trace", "netem")
    is_simple = all(spec[name] is None for name in delayed_otherwise) and not spec["timeline"] and not spec["outages"]
    loses_otherwise = any(spec[name] is not None for name in ("mtu", *delayed_otherwise)) or spec["outages"]
    loss = spec["loss"]
    chain = spec["gilbert_elliott"]
    if chain is not None:
        both = chain["to_bad"] + chain["to_good"]
        bad = chain["to_bad"] / both if both else 0.0
        loss = bad * chain["loss_bad"] + (1.0 - bad) * chain["loss_good"]
    known_loss = not loses_otherwise and not spec["attacks"] and spec["four_state"] is None
    is_single = spec["reorder_depth"] == 1 or spec["reorder_hold_s"] is not None or spec["reorder"] == 0.0
    burst = spec["mean_burst"]
    if burst is None and chain is None and spec["mean_burst_s"] is None and 0.0 < loss < 1.0:
        burst = 1.0 / (1.0 - loss)
    return LinkFigures(
        mean_s=spec["delay_s"] if is_simple else None,
        sigma_s=spec["jitter_s"] if is_simple else None,
        loss=loss if known_loss else None,
        mean_burst=burst if known_loss else None,
        # A packet that overtakes several makes each of them late.
        reordered=spec["reorder"] if spec["keep_order"] and spec["netem"] is None and is_single else None,
        duplicates=spec["duplicate"] if spec["netem"] is None else None,
        damaged=None if spec["netem"] else 1.0 - (1.0 - spec["corrupt"]) * (1.0 - spec["truncate"]),
    )
