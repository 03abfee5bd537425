"""Script interfaces (30001, 30002, 30003): splits text into programs and single lines, and reports their errors.

Source: Universal Robots, "Client Interfaces", robot message of type 10 (runtime exception).
"""

import re
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Final

MAX_PROGRAM: Final = 2_000_000
"""Bytes of a program; that of ur_rtde has some 50 kB."""
MAX_HELD: Final = 8_000_000
"""Bytes of all programs without an end together."""
BEGINS: Final = re.compile(r"(def|sec)\s+(\w+)\s*\(\s*\)\s*:")
ENDS: Final = b"end"
"""The line that ends a program: nothing before it, nothing but space behind it."""
MAX_FIRST_LINE: Final = 200
"""Characters of a line that are searched for the begin of a program."""

ROBOT_MESSAGE, RUNTIME_EXCEPTION, CONTROLLER = 20, 10, -2
HEAD: Final = struct.Struct(">iBQbbii")
"""Size, type, time stamp in us, source, type of the message, line and column of the script."""
MAX_TEXT: Final = 1000
"""Bytes of a text."""


def ignored(_error: str) -> None:
    """Reports an error to no client."""


@dataclass(frozen=True, slots=True)
class Submitted:
    """A program, or a single line without a name."""

    name: str
    text: str
    secondary: bool = False
    """Whether it runs beside the program that runs (`sec`)."""
    failed: Callable[[str], None] = field(default=ignored, compare=False)
    """Takes the reason why it was refused, or the error that stopped it."""


class ScriptBudget:
    """Bytes of programs without an end that all connections hold together."""

    def __init__(self, limit: int = MAX_HELD) -> None:
        self.limit = limit
        self.bytes = 0

    def add(self, count: int) -> None:
        """Adds to the bytes that are held, or subtracts.

        Raises:
            ValueError: More than the limit.
        """
        if self.bytes + count > self.limit:
            message = f"scripts without an end hold {self.bytes + count} bytes: must be at most {self.limit} together"
            raise ValueError(message)
        self.bytes += count


class ScriptReader:
    """Splits the text of one connection, in however many pieces it arrives.

    Args:
        held: Bytes that all connections hold together.
        failed: Takes errors of the programs.
    """

    def __init__(self, held: ScriptBudget | None = None, failed: Callable[[str], None] = ignored) -> None:
        self._budget = held or ScriptBudget()
        self._failed = failed
        self._waiting = bytearray()
        """Bytes of the program or the line that has no end yet."""
        self._line = 0
        """Where its last line begins."""
        self._is_program = False

    def receive(self, received: bytes) -> Iterator[Submitted]:
        """Programs and lines that are complete.

        Raises:
            ValueError: A program or a line without end.
        """
        for piece in _lines(received):
            if (size := len(self._waiting) + len(piece)) > MAX_PROGRAM:
                message = f"script of {size} bytes without an end: must be at most {MAX_PROGRAM}"
                raise ValueError(message)
            self._budget.add(len(piece))
            self._waiting += piece
            if piece.endswith(b"\n") and (submitted := self._ended()) is not None:
                yield submitted

    def clear(self) -> None:
        """Frees what the connection holds."""
        self._budget.add(-len(self._waiting))
        self._waiting, self._line, self._is_program = bytearray(), 0, False

    def _ended(self) -> Submitted | None:
        """The program or single line that the end of a line completes, if any."""
        line = bytes(self._waiting[self._line :]).rstrip(b"\r\n")
        if not self._is_program:
            text = line.decode("utf-8", "replace")
            if BEGINS.match(text[:MAX_FIRST_LINE]):
                self._is_program, self._line = True, len(self._waiting)
                return None
            self.clear()
            text = text.strip()
            return Submitted("", text, failed=self._failed) if text and not text.startswith("#") else None
        self._line = len(self._waiting)
        if line.rstrip() != ENDS:
            return None
        text = self._waiting.decode("utf-8", "replace").replace("\r\n", "\n").removesuffix("\n")
        self.clear()
        begun = BEGINS.match(text)
        assert begun is not None
        kind, name = begun.groups()
        return Submitted(name, text, secondary=kind == "sec", failed=self._failed)


def _lines(received: bytes) -> Iterator[bytes]:
    """Lines with their end; a carriage return alone ends none."""
    begin = 0
    while (end := received.find(b"\n", begin)) >= 0:
        yield received[begin : end + 1]
        begin = end + 1
    if begin < len(received):
        yield received[begin:]


def runtime_exception(text: str, timestamp_s: float) -> bytes:
    """The robot message of an error of a script, at an unknown line; at most MAX_TEXT bytes of whole characters."""
    # What UTF-8 cannot encode is escaped.
    encoded = text[:MAX_TEXT].encode("utf-8", "backslashreplace")[:MAX_TEXT]
    packed = encoded.decode("utf-8", "ignore").encode()
    stamp_us = int(1e6 * timestamp_s)
    return HEAD.pack(HEAD.size + len(packed), ROBOT_MESSAGE, stamp_us, CONTROLLER, RUNTIME_EXCEPTION, -1, -1) + packed
