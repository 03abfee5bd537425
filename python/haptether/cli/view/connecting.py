"""Finds a running side, and waits for it to send what it does."""

import socket
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from haptether.bridge import TelemetryReader


@dataclass(frozen=True, kw_only=True)
class WaitOptions:
    """Of a command that connects to a running side."""

    wait_s: float = 0.0
    """Wait for a side that does not run yet for up to this time in s; by default that fails at once."""


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


def connected(path: Path, wait_s: float) -> "TelemetryReader":
    """Read the telemetry of a side, for which it waits up to `wait_s`.

    Raises:
        OSError: Nobody sends there.
        ValueError: What is sent is no telemetry; a time that nobody waits.
    """
    from haptether.bridge import TelemetryReader

    wait_for(path, "telemetry", time.monotonic() + checked_wait_s(wait_s))
    return TelemetryReader(path)


def checked_wait_s(wait_s: float) -> float:
    """The time, refused where it cannot be.

    Raises:
        ValueError: With the bounds.
    """
    from haptether.cli.shared.numbers import check_duration

    check_duration("wait-s", wait_s)
    return wait_s


def wait_for(path: Path, option: str, until_s: float) -> None:
    """Return once a side listens at a socket, whose `option` names it.

    Raises:
        OSError: Nobody listens there by `until_s` of the monotonic clock.
    """
    while True:
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
                probe.settimeout(0.5)
                probe.connect(str(path))
                return
        except (FileNotFoundError, ConnectionRefusedError) as error:
            if time.monotonic() >= until_s:
                seen = "no such file" if isinstance(error, FileNotFoundError) else "nobody sends there"
                message = (
                    f"{path}: {seen}: start master or slave with --{option} {path} first, or give --wait-s, how long"
                    " to wait for it in s"
                )
                raise FileNotFoundError(message) from None
            time.sleep(0.1)
