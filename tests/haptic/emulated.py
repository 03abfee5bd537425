"""An emulated Inverse Service as a process, and its control line."""

import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from tests.ur.emulated import START_S, Emulated, process_of


class EmulatedInverse(Emulated):
    """A running service."""

    port = 0
    event_port = 0

    @property
    def options(self) -> dict[str, object]:
        """Options of a driver for this service; a test machine may take more than 10 ms for a reply."""
        return {"port": self.port, "event_port": self.event_port, "reply_timeout_s": 0.015}


@contextmanager
def emulated_service(*arguments: str) -> Iterator[EmulatedInverse]:
    """Run `haptether inverse3-emulator` with its control line on standard input, and end it in any case."""
    command = [sys.executable, "-m", "haptether", "inverse3-emulator", "--port", "0", "--event-port", "0"]
    with process_of([*command, "--control", "-", *arguments]) as process:
        emulated = EmulatedInverse(process, "127.0.0.1")
        headline = emulated.line(START_S)
        ports = re.fullmatch(r"an Inverse3 on 127\.0\.0\.1:(\d+), events on (\d+), controlled by -", headline)
        assert ports is not None, headline
        emulated.port, emulated.event_port = int(ports[1]), int(ports[2])
        yield emulated
