"""Sockets of a bridge: a master and a slave, or one of them."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True, kw_only=True)
class Pair:
    """Sockets and files of the sides of a bridge; each side identifies itself."""

    name: str = ""
    """Name of the pair; empty if a page shows one pair only."""
    telemetry: Sequence[Path]
    """Sockets of `--telemetry`."""
    control: Sequence[Path]
    """Sockets of `--control`."""
    flight: Sequence[Path] = ()
    """Files of `--flight`."""


def side_id(pair: str, side: str) -> str:
    """Return the identifier of a side on a page: `master`, or `left.master` with several pairs."""
    return f"{pair}.{side}" if pair else side
