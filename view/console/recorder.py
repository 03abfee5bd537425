"""Flight recording of a side that held or stopped, prepared for a page."""

import stat
from pathlib import Path
from typing import Any

import msgspec

from haptether.bridge.flight import Flight, read_flight

MAX_BYTES = 1 << 20
TICKS = 10
"""Ticks shown before the fault, out of the 50 recorded."""
STEPS = 5
"""Newest transitions of the ladder that are shown."""


class FlightWatch:
    """Reader of a `--flight` file; reads it again after each write.

    Args:
        path: The file, which need not exist yet.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._seen: tuple[int, int] | None = None
        self.content: dict[str, Any] | None = None
        """Content for the page; None before the first write."""

    def read(self) -> bool:
        """Read the file if it has changed; return True if there is new content."""
        try:
            found = self._path.stat()
            seen = found.st_mtime_ns, found.st_size
            if seen == self._seen:
                return False
            self._seen = seen
            if not stat.S_ISREG(found.st_mode) or found.st_size > MAX_BYTES:
                message = f"{self._path}: must be a file of at most {MAX_BYTES} bytes"
                raise ValueError(message)
            self.content = {**_content(read_flight(self._path)), "written_s": found.st_mtime}
        except FileNotFoundError:
            return False
        except (OSError, ValueError) as error:
            self.content = {"error": str(error)}
        return True


def _content(flight: Flight) -> dict[str, Any]:
    """Cause, remedy, events and ticks up to the last hold, or else up to the end."""
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
