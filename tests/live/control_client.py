"""Client of a control socket for tests: lines out, lines in."""

import contextlib
import json
import socket
import time
from pathlib import Path
from types import TracebackType
from typing import Any, Self


class Control:
    """One connection to a control socket."""

    def __init__(self, path: Path) -> None:
        self.socket = socket.socket(socket.AF_UNIX)
        # A connect with a timeout would fail while others wait to be accepted.
        self.socket.connect(str(path))
        self.socket.settimeout(10.0)
        self._lines = self.socket.makefile("rb")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, _: type[BaseException] | None, __: BaseException | None, ___: TracebackType | None) -> None:
        self._lines.close()
        self.socket.close()

    def send(self, line: bytes) -> None:
        self.socket.sendall(line)

    def answer(self) -> dict[str, Any]:
        """Return the next line; empty at the end."""
        line = self._lines.readline()
        return dict(json.loads(line)) if line else {}

    def ask(self, do: str, **given: object) -> dict[str, Any]:
        self.send(json.dumps({"do": do, **given}).encode() + b"\n")
        return self.answer()

    def set(self, do: str, **given: object) -> dict[str, Any]:
        """Send a request that changes state, with the token of a new status."""
        return self.ask(do, **given, token=self.ask("status")["token"])


def fill(path: Path, count: int, stack: contextlib.ExitStack, sent: bytes = b"") -> None:
    """Open that many connections until the end of `stack`; each sends these bytes and reads nothing."""
    for _ in range(count):
        one = stack.enter_context(socket.socket(socket.AF_UNIX))
        one.setblocking(False)
        # With too many in the backlog, connect fails at once.
        while True:
            with contextlib.suppress(BlockingIOError):
                one.connect(str(path))
                break
            time.sleep(0.001)
        # The server may have closed the connection already.
        with contextlib.suppress(OSError):
            one.send(sent)
