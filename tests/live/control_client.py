"""A program at a control socket, as tests need it: lines out, lines in."""

import json
import socket
from pathlib import Path
from types import TracebackType
from typing import Any, Self


class Control:
    """One connection."""

    def __init__(self, path: Path) -> None:
        self.socket = socket.socket(socket.AF_UNIX)
        self.socket.settimeout(10.0)
        self.socket.connect(str(path))
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
