"""Finds a running side, and waits for it to send what it does."""

import time
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from haptether.bridge import TelemetryReader

WAIT_S = 10.0


def only_side() -> Path:
    """The socket of the one side that runs with its telemetry in the user's folder for that.

    Raises:
        ValueError: None runs, or several do.
    """
    from haptether.cli.live.run_folder import running_sides

    sides = running_sides()
    if len(sides) == 1:
        return sides[0]
    if not sides:
        message = "no side of this user runs here: start master or slave, or give the PATH of its --telemetry"
    else:
        message = f"{len(sides)} sides run here: give the PATH of one: {', '.join(map(str, sides))}"
    raise ValueError(message)


def connected(path: Path) -> "TelemetryReader":
    """Reads the telemetry of a side, for which it waits up to 10 s.

    Raises:
        OSError: Nobody sends there.
        ValueError: What is sent is no telemetry.
    """
    from haptether.bridge import TelemetryReader

    until_s = time.monotonic() + WAIT_S
    while True:
        try:
            return TelemetryReader(path)
        except (FileNotFoundError, ConnectionRefusedError):
            if time.monotonic() > until_s:
                message = f"{path}: nobody sends there: start master or slave with --telemetry {path}"
                raise FileNotFoundError(message) from None
            time.sleep(0.1)
