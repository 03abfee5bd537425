"""Serving of an emulated device until it is stopped, with its control line."""

from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Protocol, TypeVar

if TYPE_CHECKING:
    from haptether.control_channel import Answering, ControlChannel

Figures = TypeVar("Figures")


class ServedDevice(Protocol):
    """A server of an emulated device."""

    channel: "ControlChannel | None"

    def run(self, ended: Callable[[], bool]) -> None:
        """Serve until `ended` returns true."""

    def close(self) -> None:
        """Close everything that is open."""


def serve(
    server: ServedDevice,
    line: "Answering",
    headline: str,
    finish: Callable[[], Figures],
    *,
    control: str | None,
    duration_s: float | None,
    json: Path | None,
    realtime: Literal["auto", "off", "require"] | None = None,
) -> Figures:
    """Serve until Ctrl-C, a control line or the time ends it; return the result of `finish`, called before the close.

    Args:
        server: The server to run.
        line: Its control line.
        headline: Start of the first line of output, which names the address once the server is reachable.
        finish: Takes the figures of the run.
        control: Source of control lines; None for none.
        duration_s: Duration in s; None for no limit.
        json: Target of the figures; if it is standard output, the headline goes to standard error.
        realtime: Request for real time; None to leave the scheduling as it is.

    Raises:
        ValueError: A control port out of its bounds.
        OSError: A control line that cannot be opened, or real time that is required and not granted.
    """
    import gc
    import sys
    import time

    from haptether.cli.shared.output import table_goes_to_stderr
    from haptether.cli.shared.stop import Stopped
    from haptether.control_channel import ControlChannel
    from haptether.realtime import realtime as requested

    end_s = time.monotonic() + (duration_s if duration_s is not None else float("inf"))
    with Stopped() as stopped:
        channel = None
        try:
            if control is not None:
                try:
                    channel = server.channel = ControlChannel(control, line)
                except OverflowError:
                    message = f"control = {control}: the port must be 0 to 65535"
                    raise ValueError(message) from None
            with nullcontext() if realtime is None else requested(realtime) as granted:
                controlled = "" if channel is None else f", controlled by {channel.address}"
                # These objects live as long as the process; a collection that visits them takes 10 ms.
                gc.collect()
                gc.freeze()
                in_real_time = "" if granted is None else f", real time: {granted}"
                # The parent process reads the address from this line.
                stream = sys.stderr if table_goes_to_stderr(json) else sys.stdout
                print(f"{headline}{controlled}{in_real_time}", file=stream, flush=True)
                server.run(lambda: bool(stopped) or line.quit or time.monotonic() >= end_s)
        finally:
            figures = finish()
            server.close()
            if channel is not None:
                channel.close()
    return figures
