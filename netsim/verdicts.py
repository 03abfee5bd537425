"""Verdict on each packet of one direction."""

from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from haptether import _core
from haptether.netsim.link.resolve import link_json
from haptether.netsim.link.settings import Direction, LinkSettings

Times: TypeAlias = npt.NDArray[np.int64]

VERDICT_CAUSES: tuple[str, ...] = tuple(_core.verdict_causes())
"""Causes by code; the first, "", means that a packet arrives unchanged."""
_BESIDE = VERDICT_CAUSES.index("duplicate")


class Verdicts:
    """Verdicts on packets, one row each; additional arrivals follow directly after their packet.

    Each array has the shape `(n_rows,)`.
    """

    def __init__(self, index: Times, t_in_ns: Times, t_out_ns: Times, cause_code: npt.NDArray[np.uint8]) -> None:
        self.index = index
        """Index of the packet, from 0."""
        self.t_in_ns = t_in_ns
        """Sending time in ns."""
        self.t_out_ns = t_out_ns
        """Arrival time in ns; -1 for a loss."""
        self.cause_code = cause_code
        """Index into `VERDICT_CAUSES`: cause of loss, kind of damage, or kind of additional arrival."""

    def __len__(self) -> int:
        return len(self.index)

    @property
    def causes(self) -> list[str]:
        """Cause names; "" for a packet that arrives unchanged."""
        return [VERDICT_CAUSES[code] for code in self.cause_code.tolist()]

    def causes_of(self, cause: str) -> npt.NDArray[np.bool_]:
        """Return the mask of rows with a cause, given by name.

        Raises:
            ValueError: The cause does not exist.
        """
        has_cause: npt.NDArray[np.bool_] = self.cause_code == VERDICT_CAUSES.index(cause)
        return has_cause

    @property
    def is_packet(self) -> npt.NDArray[np.bool_]:
        """Mask of rows that are packets, not additional arrivals."""
        is_packet: npt.NDArray[np.bool_] = self.cause_code < _BESIDE
        return is_packet

    @property
    def packets(self) -> "Verdicts":
        """Rows of the packets only, one each."""
        kept = self.is_packet
        return Verdicts(self.index[kept], self.t_in_ns[kept], self.t_out_ns[kept], self.cause_code[kept])


def judge_all(
    settings: LinkSettings,
    sent_ns: Times,
    *,
    direction: Direction = "forward",
    seed: int = 0,
    sizes: Times | int = 0,
) -> Verdicts:
    """Decide the verdict on each packet of one direction, by the core that all drivers of netsim use.

    A pure function of settings, seed, direction and the preceding packets, equal on every platform. No impairment
    shifts the draws of another.

    Args:
        settings: Settings of the link.
        sent_ns: Sending times in ns, 0 or more, not decreasing, shape `(n_packets,)`.
        direction: Direction; each has its own draws.
        seed: Seed of all draws, 0 to 2⁶⁴ - 1.
        sizes: Payload in bytes, one for all packets or one per packet, shape `(n_packets,)`.

    Raises:
        LinkError: The settings are invalid.
        ValueError: A time or size is negative (gives its index), times decrease, or the `direction` does not exist.

    Source: Salmon et al. 2011 (counter-based draws).
    """
    if direction not in {"forward", "backward"}:
        message = f'direction = "{direction}": must be "forward" or "backward"'
        raise ValueError(message)
    if isinstance(sizes, int | np.integer):
        sizes = np.full(np.shape(sent_ns), sizes, dtype=np.int64)
    return Verdicts(*_core.judge_packets(link_json(settings, direction), sent_ns, sizes, direction, seed))


def judge(
    settings: LinkSettings,
    sent_ns: Times,
    *,
    direction: Direction = "forward",
    seed: int = 0,
    sizes: Times | int = 0,
) -> Times:
    """Return the arrival time of each packet of one direction in ns, -1 for a loss, shape `(n_packets,)`.

    Same as `judge_all`, with the same arguments, without causes and additional arrivals.

    Raises:
        LinkError: The settings are invalid.
        ValueError: A time or size is negative (gives its index), times decrease, or the `direction` does not exist.
    """
    return judge_all(settings, sent_ns, direction=direction, seed=seed, sizes=sizes).packets.t_out_ns


def link_bounds(settings: LinkSettings, direction: Direction = "forward") -> tuple[float, float]:
    """Return the longest delay of a packet in s, and the time in s of the last scheduled change; infinite if unbounded.

    Raises:
        LinkError: The settings are invalid.
    """
    return _core.link_bounds(link_json(settings, direction))
