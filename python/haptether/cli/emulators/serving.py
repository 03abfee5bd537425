"""Serving of an emulated device until it is stopped, with its control line."""

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, Protocol

import tyro

from haptether.cli.shared.numbers import check_duration
from haptether.cli.shared.output import FileOptions, check_target, table_goes_to_stderr, write_report

if TYPE_CHECKING:
    from haptether.control_channel import Answering, ControlChannel


class ServedDevice(Protocol):
    """A server of an emulated device."""

    channel: "ControlChannel | None"

    def run(self, ended: Callable[[], bool]) -> None:
        """Serve until `ended` returns true."""

    def close(self) -> None:
        """Close everything that is open."""


@dataclass(frozen=True, kw_only=True)
class EmulatorOptions(FileOptions):
    """Control, duration and figures of an emulator."""

    control: Annotated[str | None, tyro.conf.arg(metavar="-|127.0.0.1:PORT|PATH")] = None
    """Source of control lines: standard input, TCP of this machine, or a Unix socket."""
    duration_s: Annotated[float | None, tyro.conf.arg(metavar="S")] = None
    """End after this time in s; without it, run until Ctrl-C."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Write state and figures as JSON at the end; - for standard output."""

    def check(self) -> None:
        """Check the duration and the target of the figures.

        Raises:
            ValueError: The duration is invalid.
            OSError: The file cannot be written.
        """
        check_duration("duration_s", self.duration_s)
        check_target(self.json, force=self.force)

    def serve(
        self,
        server: ServedDevice,
        line: "Answering",
        headline: str,
        figures: Callable[[], object],
        realtime: Literal["auto", "off", "require"] | None = None,
    ) -> int:
        """Serve until Ctrl-C, a control line or the time ends it; write the figures.

        Args:
            server: The server to run.
            line: Its control line.
            headline: Start of the first line of output, which names the address once the server is reachable.
            figures: Returns the figures of the run; called before the close.
            realtime: Request for real time; None to leave the scheduling as it is.

        Raises:
            ValueError: A control port out of its bounds.
            OSError: A control line that cannot be opened, or real time that is required and not granted.
        """
        import gc
        import sys
        import time

        from haptether.cli.shared.stop import Stopped
        from haptether.control_channel import ControlChannel
        from haptether.realtime import realtime as requested

        end_s = time.monotonic() + (self.duration_s if self.duration_s is not None else float("inf"))
        with Stopped() as stopped:
            channel = None
            try:
                if self.control is not None:
                    try:
                        channel = server.channel = ControlChannel(self.control, line)
                    except OverflowError:
                        message = f"control = {self.control}: the port must be 0 to 65535"
                        raise ValueError(message) from None
                with nullcontext() if realtime is None else requested(realtime) as granted:
                    controlled = "" if channel is None else f", controlled by {channel.address}"
                    # These objects live as long as the process; a collection that visits them takes 10 ms.
                    gc.collect()
                    gc.freeze()
                    in_real_time = "" if granted is None else f", real time: {granted}"
                    # The parent process reads the address from this line.
                    stream = sys.stderr if table_goes_to_stderr(self.json) else sys.stdout
                    print(f"{headline}{controlled}{in_real_time}", file=stream, flush=True)
                    server.run(lambda: bool(stopped) or line.quit or time.monotonic() >= end_s)
            finally:
                report = figures()
                server.close()
                if channel is not None:
                    channel.close()
        write_report(self.json, report)
        return 0
