"""A person at a terminal, or a program in its place."""

import os
import select
import sys


class Person:
    """Reads lines of standard input without waiting for them."""

    def __init__(self) -> None:
        self._received = b""

    def say(self, line: str) -> None:
        """Prints a line; one that begins with a carriage return replaces the last, and is for terminals alone."""
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
            received = os.read(0, 4096)
            if not received:
                message = "standard input has ended: a person must answer"
                raise RuntimeError(message)
            self._received += received
        line, found, rest = self._received.partition(b"\n")
        if not found:
            return None
        self._received = rest
        return line.decode(errors="replace")

    def wait(self) -> str:
        """The next line."""
        while True:
            line = self.answer(1.0)
            if line is not None:
                return line
