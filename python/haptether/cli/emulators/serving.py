"""How an emulated device is served until it is stopped, with its control line beside it."""

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
        """Serves until it is so."""

    def close(self) -> None:
        """Close all that is open."""


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
    """Serves until Ctrl-C, a control line or the time ends it, and returns what `finish` does before all is closed.

    Args:
        server: What is run.
        line: Its control line.
        headline: Begins the first line of output, which names where it is reached, once it is.
        finish: Takes the figures of the run.
        control: Where control lines come from, if from anywhere.
        duration_s: The time, in s; without it, none.
        json: Where figures go: to standard output the headline does not.
        realtime: Whether it runs in real time; without it, that is not looked at.

    Raises:
        ValueError: A control port out of its bounds.
        OSError: A control line that cannot be had, or real time that is required and not granted.
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
                # What is there lives as long as the process; a collection that visited it would take 10 ms.
                gc.collect()
                gc.freeze()
                in_real_time = "" if granted is None else f", real time: {granted}"
                # Whoever started this process reads the line to learn where it is reached.
                stream = sys.stderr if table_goes_to_stderr(json) else sys.stdout
                print(f"{headline}{controlled}{in_real_time}", file=stream, flush=True)
                server.run(lambda: bool(stopped) or line.quit or time.monotonic() >= end_s)
        finally:
            figures = finish()
            server.close()
            if channel is not None:
                channel.close()
    return figures
