"""A person at a terminal, or a program in its place."""

import os
import select
import sys
from typing import Final

READ: Final = 4096
MAX_READS: Final = 100


class Operator:
    """Reads lines of standard input without waiting for them."""

    def __init__(self) -> None:
        self._received = b""

    def say(self, line: str) -> None:
        """Print a line; one that begins with a carriage return replaces the last, and is for terminals alone."""
        if not line.startswith("\r"):
            print(line, flush=True)
        elif sys.stdout.isatty():
            print(line, end="", flush=True)

    def answer(self, patience_s: float) -> str | None:
        """The next line within so many seconds; none yet: none.

        Raises:
            RuntimeError: There will be none.
        """
        if b"\n" not in self._received:
            readable, _, _ = select.select([0], [], [], patience_s)
            if not readable:
                return None
            received = os.read(0, READ)
            if not received:
                message = "standard input has ended: a person must answer"
                raise RuntimeError(message)
            self._received += received
        line, found, rest = self._received.partition(b"\n")
        if not found:
            return None
        self._received = rest
        return line.decode(errors="replace")

    def forget(self) -> None:
        """Drop what was typed so far: it answers no question that is asked next.

        Raises:
            RuntimeError: There is no end of it.
        """
        self._received = b""
        for _ in range(MAX_READS):
            if not select.select([0], [], [], 0.0)[0] or not os.read(0, READ):
                return
        message = "standard input does not wait for questions: a person must answer"
        raise RuntimeError(message)

    def wait(self) -> str:
        """The next line."""
        while True:
            line = self.answer(1.0)
            if line is not None:
                return line
