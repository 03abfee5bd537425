"""A program at a control socket, as tests need it: lines out, lines in."""

import contextlib
import json
import socket
import time
from pathlib import Path
from types import TracebackType
from typing import Any, Self


class Control:
    """One connection."""

    def __init__(self, path: Path) -> None:
        self.socket = socket.socket(socket.AF_UNIX)
        # With a timeout it would fail where others wait to be accepted.
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
        """The next line; empty at the end."""
        line = self._lines.readline()
        return dict(json.loads(line)) if line else {}

    def ask(self, do: str, **given: object) -> dict[str, Any]:
        self.send(json.dumps({"do": do, **given}).encode() + b"\n")
        return self.answer()

    def set(self, do: str, **given: object) -> dict[str, Any]:
        """A request that changes something, with the token of a status of now."""
        return self.ask(do, **given, token=self.ask("status")["token"])


def fill(path: Path, count: int, stack: contextlib.ExitStack, sent: bytes = b"") -> None:
    """Open so many connections until the end of `stack`, each of which sends this and reads nothing."""
    for _ in range(count):
        one = stack.enter_context(socket.socket(socket.AF_UNIX))
        one.setblocking(False)
        # Where too many wait to be accepted, it fails at once.
        while True:
            with contextlib.suppress(BlockingIOError):
                one.connect(str(path))
                break
            time.sleep(0.001)
        # It may have been closed already.
        with contextlib.suppress(OSError):
            one.send(sent)
