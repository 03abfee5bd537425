"""A person at a terminal, or a program instead."""

import os
import select
import sys
from typing import Final

READ: Final = 4096
MAX_READS: Final = 100


class Operator:
    """Reads lines of standard input without blocking."""

    def __init__(self) -> None:
        self._received = b""

    def say(self, line: str) -> None:
        """Print a line; a line that begins with a carriage return replaces the last one, and is for terminals only."""
        if not line.startswith("\r"):
            print(line, flush=True)
        elif sys.stdout.isatty():
            print(line, end="", flush=True)

    def answer(self, patience_s: float) -> str | None:
        """Return the next line within `patience_s`; None if none has come yet.

        Raises:
            RuntimeError: Standard input has ended.
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
        """Drop earlier input: it must not answer the next question.

        Raises:
            RuntimeError: The input does not end.
        """
        self._received = b""
        for _ in range(MAX_READS):
            if not select.select([0], [], [], 0.0)[0] or not os.read(0, READ):
                return
        message = "standard input does not wait for questions: a person must answer"
        raise RuntimeError(message)

    def wait(self) -> str:
        """Wait for the next line and return it."""
        while True:
            line = self.answer(1.0)
            if line is not None:
                return line
