"""Connection to a running side, and the wait until it sends."""

import socket
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from haptether.bridge import TelemetryReader


@dataclass(frozen=True, kw_only=True)
class WaitOptions:
    """Option of a command that connects to a running side."""

    wait_s: float = 0.0
    """Wait up to this time in s for a side that does not run yet; by default fail at once."""


def only_side() -> Path:
    """Return the socket of the one running side that has its telemetry in the user's folder.

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
    """Return the sockets of the sides that run here, at most one master and one slave.

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
    """Read the telemetry of a side; wait up to `wait_s` for it.

    Raises:
        OSError: Nobody sends there.
        ValueError: The sender does not send telemetry, or an invalid time.
    """
    from haptether.bridge import TelemetryReader

    wait_for(path, "telemetry", time.monotonic() + checked_wait_s(wait_s))
    return TelemetryReader(path)


def checked_wait_s(wait_s: float) -> float:
    """Return the time; refuse an invalid one.

    Raises:
        ValueError: A time out of its bounds; the message names them.
    """
    from haptether.cli.shared.numbers import check_duration

    check_duration("wait-s", wait_s)
    return wait_s


def wait_for(path: Path, option: str, until_s: float) -> None:
    """Return once a side listens at the socket that `option` names.

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
