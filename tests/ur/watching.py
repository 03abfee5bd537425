"""A process with the real driver, and its reported events."""

import json
import os
import select
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

START_S = 40.0


class Watching:
    """Events of `tests.ur.driven`, and its command lines."""

    def __init__(self, process: "subprocess.Popen[bytes]") -> None:
        self.process = process
        self.events: list[dict[str, Any]] = []
        self._waiting = b""

    def command(self, line: str) -> None:
        """Send a command of the operator: `ack`, `press`, `end`."""
        assert self.process.stdin is not None
        self.process.stdin.write(f"{line}\n".encode())
        self.process.stdin.flush()

    def look(self, patience_s: float) -> bool:
        """Read the reported events; return false if the process has ended."""
        assert self.process.stdout is not None
        if not select.select([self.process.stdout], [], [], patience_s)[0]:
            return True
        received = os.read(self.process.stdout.fileno(), 1 << 16)
        *lines, self._waiting = (self._waiting + received).split(b"\n")
        # The library prints further lines.
        self.events += [json.loads(line) for line in lines if line.startswith(b"{")]
        return bool(received)

    def wait_for(self, key: str, *values: object, since_s: float = 0.0, patience_s: float = 10.0) -> dict[str, Any]:
        """Return the first event since a time that gives a key one of these values; any value if none is given."""
        end_s = time.monotonic() + patience_s
        while True:
            for event in self.events:
                if event["at_s"] >= since_s and key in event and (not values or event[key] in values):
                    return event
            if time.monotonic() > end_s or not self.look(0.05):
                message = f"{key} was to become {values}: {self.events[-12:]}"
                raise AssertionError(message)

    def end(self) -> dict[str, Any]:
        """End the process with its command; return figures of the run."""
        self.command("end")
        result: dict[str, Any] = self.wait_for("end", patience_s=20.0)["end"]
        self.process.wait(10.0)
        return result


@contextmanager
def driven(options: dict[str, Any], *overrides: str) -> Iterator[Watching]:
    """Run hand, bridge and driver, and end them in any case."""
    command = [sys.executable, "-m", "tests.ur.driven", json.dumps(options), *overrides]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    watching = Watching(process)
    try:
        watching.wait_for("slave", patience_s=START_S)
        yield watching
    finally:
        process.kill()
        process.wait()
        for stream in (process.stdin, process.stdout):
            if stream is not None:
                stream.close()
