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


def sides_here() -> tuple[Path, ...]:
    """The sockets of the sides that run here, at most one master and one slave.

    Raises:
        ValueError: None runs, or two of a kind.
    """
    from haptether.cli.live.run_folder import running_sides

    sides = running_sides()
    names = [path.name.partition("-")[0] for path in sides]
    if len(set(names)) != len(names):
        message = f"{len(sides)} sides run here: --connect must name those of one pair: {', '.join(map(str, sides))}"
        raise ValueError(message)
    return tuple(sides)


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
