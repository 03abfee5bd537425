"""What becomes of each packet of one direction."""

from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from haptether import _core
from haptether.netsim.link.resolve import link_json
from haptether.netsim.link.settings import Direction, LinkSettings

Times: TypeAlias = npt.NDArray[np.int64]

VERDICT_CAUSES: tuple[str, ...] = tuple(_core.verdict_causes())
"""Causes by their code: the first, "", is of a packet that arrives as it was sent."""
_BESIDE = VERDICT_CAUSES.index("duplicate")


class Verdicts:
    """What becomes of packets, a row each; what arrives beside a packet has rows directly after it."""

    def __init__(self, index: Times, t_in_ns: Times, t_out_ns: Times, cause_code: npt.NDArray[np.uint8]) -> None:
        self.index = index
        """Which packet, counted from 0."""
        self.t_in_ns = t_in_ns
        """When it was sent, in ns."""
        self.t_out_ns = t_out_ns
        """When it arrives, in ns; -1 for never."""
        self.cause_code = cause_code
        """Why it does not arrive, how it is damaged, or what it is beside the packet: place in `VERDICT_CAUSES`."""

    def __len__(self) -> int:
        return len(self.index)

    @property
    def causes(self) -> list[str]:
        """The causes by name; "" for a packet that arrives as it was sent."""
        return [VERDICT_CAUSES[code] for code in self.cause_code.tolist()]

    def causes_of(self, cause: str) -> npt.NDArray[np.bool_]:
        """Which rows have a cause, by its name.

        Raises:
            ValueError: No such cause.
        """
        has_cause: npt.NDArray[np.bool_] = self.cause_code == VERDICT_CAUSES.index(cause)
        return has_cause

    @property
    def is_packet(self) -> npt.NDArray[np.bool_]:
        """Which rows are the packets themselves, not what arrives beside them."""
        is_packet: npt.NDArray[np.bool_] = self.cause_code < _BESIDE
        return is_packet

    @property
    def packets(self) -> "Verdicts":
        """Only the packets themselves, one row for each."""
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
    """Decides what becomes of each packet of one direction: the core that every driver of netsim uses.

    A pure function of settings, seed, direction, and the packets up to each one, on every platform: one impairment
    shifts no draw of another.

    Args:
        settings: The network.
        sent_ns: When each packet was sent, in ns, 0 or more, not decreasing, shape `(n_packets,)`.
        direction: Forward and backward have their own draws.
        seed: Key of all draws, 0 to 2⁶⁴ - 1.
        sizes: Payload in bytes, one for all packets or one per packet, shape `(n_packets,)`.

    Raises:
        LinkError: Settings that describe no link.
        ValueError: A time or size below 0, with its index, times that decrease, or no such `direction`.

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
    """When each packet of one direction arrives, in ns, -1 for one that does not, shape `(n_packets,)`.

    As `judge_all`, without causes and without what arrives beside the packets.

    Raises:
        LinkError: Settings that describe no link.
        ValueError: A time or size below 0, with its index, times that decrease, or no such `direction`.
    """
    return judge_all(settings, sent_ns, direction=direction, seed=seed, sizes=sizes).packets.t_out_ns


def link_bounds(settings: LinkSettings, direction: Direction = "forward") -> tuple[float, float]:
    """Longest time in s that a packet is under way, and time in s of the last scheduled change; infinite for none.

    Raises:
        LinkError: Settings that describe no link.
    """
    return _core.link_bounds(link_json(settings, direction))
