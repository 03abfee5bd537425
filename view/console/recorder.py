"""Flight recorder data of a side that held or stopped, for a page."""

import stat
from pathlib import Path
from typing import Any

import msgspec

from haptether.bridge.flight import Flight, read_flight
from haptether.view.console.pair import side_id

MAX_BYTES = 1 << 20
TICKS = 10
"""Ticks shown before the fault, out of the 50 stored."""
STEPS = 5
"""Latest ladder transitions shown."""


class FlightWatch:
    """Reader of a `--flight` file after each write.

    Args:
        path: File; it may not exist yet.
        pair: Name of the pair of its side; empty with one pair only.
    """

    def __init__(self, path: Path, pair: str = "") -> None:
        self._path = path
        self._pair = pair
        self._seen: tuple[int, int] | None = None
        self.content: dict[str, Any] | None = None
        """Content for the page; None before the first write."""

    def read(self) -> bool:
        """Return True if the file has changed."""
        try:
            found = self._path.stat()
            seen = found.st_mtime_ns, found.st_size
            if seen == self._seen:
                return False
            self._seen = seen
            if not stat.S_ISREG(found.st_mode) or found.st_size > MAX_BYTES:
                message = f"{self._path}: must be a file of at most {MAX_BYTES} bytes"
                raise ValueError(message)
            content = _content(read_flight(self._path))
            self.content = {**content, "id": side_id(self._pair, content["side"]), "written_s": found.st_mtime}
        except FileNotFoundError:
            return False
        except (OSError, ValueError) as error:
            self.content = {"error": str(error)}
        return True


def _content(flight: Flight) -> dict[str, Any]:
    """Return cause and remedy, the preceding transitions, and the ticks until the last hold or the end."""
    ticks = flight.at_hold or flight.latest
    cause = flight.causes[-1] if flight.causes else None
    return {
        "side": flight.side,
        "cause": msgspec.to_builtins(cause),
        "steps": [[one.time_s, one.from_, one.to, one.reason] for one in flight.transitions[-STEPS:]],
        "interventions": [str(one) for one in flight.interventions[-STEPS:]],
        "until": "the last hold" if flight.at_hold else "the end",
        "ticks": msgspec.to_builtins(ticks[-TICKS:]),
    }
