"""What a flight recorder wrote of a side that held or stopped, as a page shows it."""

import stat
from pathlib import Path
from typing import Any

import msgspec

from haptether.bridge.flight import Flight, read_flight

MAX_BYTES = 1 << 20
TICKS = 10
"""Before the fault, of the 50 that are kept."""
STEPS = 5
"""Of the ladder, the newest."""


class FlightWatch:
    """Reads a file of `--flight` again whenever it was written.

    Args:
        path: The file, which need not be there yet.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._seen: tuple[int, int] | None = None
        self.content: dict[str, Any] | None = None
        """What the page shows; none before anything was written."""

    def read(self) -> bool:
        """Whether there is something new."""
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
    """Cause and remedy, what led to it, and the ticks before it: until the last hold, or else until the end."""
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
